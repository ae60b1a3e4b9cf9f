"""The trajectories of an image dataset as a Minari dataset and back. Needs Minari; without it only its absence is
tested."""

import dataclasses
import importlib.util
import sys

import hand_made
import jax
import numpy as np
import pytest

from infogoal_jax.bridges.minari import from_minari, to_minari
from infogoal_jax.cli.main import main
from infogoal_jax.data import frames
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.errors import UserError

needs_minari = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("minari", "h5py", "PIL")),
    reason='needs pip install "minari[hdf5]" pillow',
)


def walks(num_frames: int = 40, poses: bool = True) -> FrameDataset:
    """Noise that JPEG would change, of 36 x 40, large enough for Minari to take it for an image; trajectories of 1 to 5
    moves along the frames."""
    generator = np.random.default_rng(0)
    lengths = [1, 5, 2, 3, 1, 4] * 50
    lengths = lengths[: np.searchsorted(np.cumsum(lengths), num_frames - 1)]
    total = sum(lengths)
    frame = np.arange(total, dtype=np.int32)
    fields = {
        "frames": generator.integers(0, 256, (total + 1, 36, 40, 3), np.uint8),
        "state": np.arange(total + 1, dtype=np.int32)[::-1].copy(),
        "actions": ("go on", "weiter →"),
        "frame": frame,
        "action": (frame % 2).astype(np.int32),
        "next_frame": frame + 1,
        "trajectory": np.repeat(np.arange(len(lengths), dtype=np.int32) * 2, lengths),
        "time": np.concatenate([np.arange(length, dtype=np.int32) for length in lengths]),
        "terminal": np.concatenate([np.arange(length) == length - 1 for length in lengths]),
        "about": {"name": "walks", "stand_in": True, "made_by": "a test"},
    }
    if poses:
        fields |= {
            "rotation": np.repeat(np.eye(3, dtype=np.float32)[None], total + 1, 0),
            "position": generator.normal(size=(total + 1, 3)).astype(np.float32),
            "joints": generator.normal(size=(total + 1, 2)).astype(np.float32),
            "joint_names": ("a", "b"),
            "detected": generator.random((total + 1, 3)) < 0.5,
            "objects": ("cup", "ball", "日本"),
        }
    return FrameDataset(**fields)


def assert_same(one: FrameDataset, other: FrameDataset) -> None:
    """Bit by bit, types too."""
    for field in dataclasses.fields(FrameDataset):
        first, second = getattr(one, field.name), getattr(other, field.name)
        if isinstance(first, np.ndarray):
            assert (
                first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
            ), field.name
        else:
            assert first == second, field.name


@needs_minari
@pytest.mark.parametrize(
    "dataset", [walks(), walks(poses=False), walks(900, poses=False)], ids=["poses", "images only", "several batches"]
)
def test_there_and_back_every_bit_is_kept(dataset, tmp_path):
    assert_same(dataset, from_minari(to_minari(dataset, tmp_path / "walks-v0")))
    assert [path.name for path in tmp_path.iterdir()] == ["walks-v0"]


@needs_minari
def test_minari_itself_reads_it(tmp_path, monkeypatch):
    import minari

    dataset = walks()
    frames.save(tmp_path / "walks.npz", dataset)
    assert (
        main(["data", "export-minari", str(tmp_path / "walks.npz"), "--out", str(tmp_path / "minari" / "walks-v3")])
        == 0
    )
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    loaded = minari.load_dataset("walks-v3")
    assert loaded.total_episodes == dataset.terminal.sum() and loaded.total_steps == len(dataset.frame)
    assert loaded.action_space.n == 2 and set(loaded.observation_space.spaces) >= {
        "frame",
        "state",
        "image",
        "rotation",
        "detected",
    }
    episode = loaded[1]
    np.testing.assert_array_equal(episode.observations["image"], dataset.frames[1:7])
    np.testing.assert_array_equal(episode.actions, dataset.action[1:6])
    assert (
        episode.truncations.tolist() == [False] * 4 + [True]
        and not episode.terminations.any()
        and not episode.rewards.any()
    )
    assert "ndarray" in repr(episode)


@needs_minari
def test_frames_that_no_move_shows_are_left_out_and_the_rest_numbered_anew(tmp_path):
    dataset = walks()
    kept = dataset.trajectory >= 2  # Frame 0, and its state, are seen in trajectory 0 alone.
    moves = {
        name: getattr(dataset, name)[kept]
        for name in ("frame", "action", "next_frame", "trajectory", "time", "terminal")
    }
    back = from_minari(to_minari(dataclasses.replace(dataset, **moves), tmp_path / "walks-v0"))
    np.testing.assert_array_equal(back.frames, dataset.frames[1:])
    np.testing.assert_array_equal(back.frame, dataset.frame[1:] - 1)
    frames.save(tmp_path / "walks.npz", back)


@needs_minari
def test_mistakes_are_named(tmp_path):
    (tmp_path / "there-v0").mkdir()
    (tmp_path / "a_file").write_text("kept")
    for out, expected in (
        ("walks", "names with a version"),
        ("there-v0", "is there already"),
        ("a_file/walks-v0", "cannot be written"),
    ):
        with pytest.raises(UserError, match=expected):
            to_minari(walks(), tmp_path / out)
    with pytest.raises(UserError, match="no dataset of infogoal data export-minari"):
        from_minari(tmp_path / "there-v0")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_file", "there-v0"]


@pytest.mark.parametrize("missing", ["minari", "h5py", "PIL"])
def test_without_minari_the_message_says_what_to_install(missing, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UserError, match=r'pip install "minari\[hdf5\]" pillow'):
        to_minari(walks(), tmp_path / "walks-v0")
    assert not list(tmp_path.iterdir())


@needs_minari
def test_what_minari_drops_when_it_combines_is_said(tmp_path, monkeypatch):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    datasets = [to_minari(walks(20), tmp_path / name) and minari.load_dataset(name) for name in ("one-v0", "two-v0")]
    minari.combine_datasets(datasets, "both-v0")
    with pytest.raises(UserError, match="was combined of one-v0, two-v0 by Minari, which drops the names of actions"):
        from_minari(tmp_path / "both-v0")


@needs_minari
def test_minari_collects_a_task_whose_images_have_one_channel(tmp_path, monkeypatch):
    """Which it cannot keep as JPEG."""
    import gymnasium
    import minari

    from infogoal_jax.bridges.gymnasium_tasks import TaskGymnasium

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    rooms = hand_made.environment(3)
    env = TaskGymnasium(rooms.replace(images=jax.device_put(np.kron(rooms.images, np.ones((1, 4, 4), np.uint8)))))
    collector = minari.DataCollector(gymnasium.wrappers.PassiveEnvChecker(env), jpeg_encoding=False)
    seen = [collector.reset(seed=0)[0]["observation"]]
    for _ in range(3):
        observation, _, terminated, truncated, _ = collector.step(0)
        seen.append(observation["observation"])
        if terminated or truncated:
            break
    kept = collector.create_dataset("rooms-v0", eval_env=None)
    assert seen[0].shape == (32, 32, 1)
    np.testing.assert_array_equal(next(iter(kept)).observations["observation"], np.stack(seen))


@pytest.mark.parametrize("path", [None, "", 3, b"x"])
def test_what_is_no_path_is_refused(path):
    with pytest.raises(UserError, match="path|out"):
        from_minari(path)
    with pytest.raises(UserError, match="out"):
        to_minari(walks(4), path)
    with pytest.raises(UserError, match="dataset = 'NoneType'"):
        to_minari(None, "x-v0")
