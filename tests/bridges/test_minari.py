"""Minari reads and records our tasks, and recorded episodes go there and back. Needs Minari; without it only its
absence is tested, and what is refused before it is asked for."""

import dataclasses
import gc
import importlib.util
import sys
from types import SimpleNamespace

import hand_made
import jax
import numpy as np
import pytest
from gymnasium import spaces

from infogoal_jax.bridges.minari import episodes_of, import_minari, to_minari
from infogoal_jax.cli.main import main
from infogoal_jax.data.episodes import Episodes, save
from infogoal_jax.errors import UserError

needs_minari = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("minari", "h5py", "PIL")),
    reason='needs pip install "minari[hdf5]" pillow',
)


@pytest.mark.parametrize("missing", ["minari", "h5py", "PIL"])
def test_without_minari_the_message_says_what_to_install(missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UserError, match=r'pip install "minari\[hdf5\]" pillow'):
        import_minari()


@needs_minari
@pytest.mark.filterwarnings("ignore::UserWarning:minari")  # A test has no author, address or registered environment.
@pytest.mark.filterwarnings("ignore:Implicitly cleaning up:ResourceWarning")  # Of Minari's own folder.
def test_minari_collects_a_task_whose_images_have_one_channel(tmp_path, monkeypatch):
    """Which it cannot keep as JPEG."""
    import gymnasium
    import minari

    from infogoal_jax.bridges.gymnasium import TaskGymnasium

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
    del collector
    gc.collect()


def made_up(seen: np.dtype, goals: bool) -> Episodes:
    """Three episodes of 1, 2 and 4 steps."""
    numbers = np.random.default_rng(0)
    last = np.isin(np.arange(10), (1, 4, 9))
    shape = (10, 4, 4, 3) if seen == np.uint8 else (10, 3)
    observations = numbers.integers(0, 255, shape).astype(seen)
    actions = np.where(last[:, None], 0, numbers.uniform(-1, 1, (10, 2)))
    both = {name: numbers.normal(size=(10, 2)) for name in ("achieved_goals", "desired_goals")}
    return Episodes(observations, actions, last, **(both if goals else {}))


@needs_minari
@pytest.mark.parametrize("seen", [np.float32, np.uint8])
@pytest.mark.parametrize("goals", [True, False])
def test_recorded_episodes_go_to_minari_and_back(tmp_path, monkeypatch, capsys, seen, goals):
    import minari

    episodes = made_up(seen, goals)
    save(tmp_path / "walks.npz", episodes)
    assert main(["data", "export-minari", str(tmp_path / "walks.npz"), "--out", str(tmp_path / "walks-v0")]) == 0
    assert "3 episodes of 1 to 4 steps" in capsys.readouterr().out
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    back = episodes_of(minari.load_dataset("walks-v0"))
    assert back.members().keys() == episodes.members().keys()
    for name, values in episodes.members().items():
        np.testing.assert_array_equal(back.members()[name], values, err_msg=name)


@needs_minari
def test_bounds_of_actions_go_to_minari_and_back(tmp_path, monkeypatch):
    import minari

    bounds = np.array([[0.0, -0.5], [3.0, 0.5]], np.float32)
    episodes = dataclasses.replace(made_up(np.float32, False), action_bounds=bounds)
    to_minari(episodes, tmp_path / "walks-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    kept = minari.load_dataset("walks-v0")
    np.testing.assert_array_equal([kept.action_space.low, kept.action_space.high], bounds)
    back = episodes_of(kept)
    np.testing.assert_array_equal(back.action_bounds, bounds)
    np.testing.assert_allclose(back.actions, episodes.actions, atol=1e-6)


@needs_minari
@pytest.mark.parametrize("kept", ["achieved_goals", "desired_goals"])
def test_goals_of_one_kind_go_to_minari_and_back(tmp_path, monkeypatch, kept):
    import minari

    whole = made_up(np.float32, True)
    one = {"achieved_goals": None, "desired_goals": None} | {kept: getattr(whole, kept)}
    to_minari(dataclasses.replace(whole, **one), tmp_path / "walks-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    back = episodes_of(minari.load_dataset("walks-v0"))
    np.testing.assert_array_equal(getattr(back, kept), getattr(whole, kept))
    assert (back.achieved_goals is None) == (kept != "achieved_goals") and back.observations.shape == (10, 3)


def test_an_episode_of_a_single_observation_is_nothing_for_minari(tmp_path):
    single = dataclasses.replace(made_up(np.float32, False), last=np.isin(np.arange(10), (0, 4, 9)))
    with pytest.raises(UserError, match="^episodes = 'one of a single observation': Minari's have a step"):
        to_minari(single, tmp_path / "walks-v0")


@pytest.mark.parametrize(
    ("name", "said"),
    [("walks", "Minari wants names with a version"), ("here-v0", "is there already; give a new folder")],
)
def test_a_folder_that_cannot_be_minari_s_is_one_line_and_nothing_is_touched(tmp_path, name, said):
    (tmp_path / "here-v0").mkdir()
    with pytest.raises(UserError, match=said):
        to_minari(made_up(np.float32, True), tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["here-v0"]


def test_actions_are_scaled_by_the_bounds_of_their_space():
    space = spaces.Box(np.array([0.0, -0.2]), np.array([3.0, 0.2]), dtype=np.float64)
    episode = SimpleNamespace(observations=np.zeros((4, 1)), actions=np.array([[0.0, 0.2], [3.0, -0.1], [1.5, 0.0]]))
    recorded = SimpleNamespace(action_space=space, iterate_episodes=lambda: [episode])
    expected = [[-1.0, 1.0], [1.0, -0.5], [0.0, 0.0], [0.0, 0.0]]
    np.testing.assert_allclose(episodes_of(recorded).actions, expected, atol=1e-7)
    for bound in (np.inf, np.finfo(np.float32).max):  # Neither is a bound.
        space = spaces.Box(-bound, bound, (2,))
        recorded = SimpleNamespace(action_space=space, iterate_episodes=lambda: [SimpleNamespace(**vars(episode))])
        with pytest.raises(UserError, match=r"^actions\[1\] = \[3.0, -0.1\]: lies outside of the dataset's space, Box"):
            episodes_of(recorded)


def test_several_moves_at_once_are_refused():
    """Of a `MultiDiscrete` space, which are no vectors to be learned."""
    episode = SimpleNamespace(observations=np.zeros((4, 1)), actions=np.array([[0, 1], [1, 1], [1, 0]]))
    recorded = SimpleNamespace(action_space=spaces.MultiDiscrete([2, 2]), iterate_episodes=lambda: [episode])
    with pytest.raises(UserError, match=r"^action_space = 'MultiDiscrete\(\[2 2\]\)': give a dataset whose actions"):
        episodes_of(recorded)


def test_parts_of_a_tuple_stand_one_behind_the_other_and_what_is_no_number_is_named():
    parts = np.arange(8.0).reshape(4, 2), np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(episodes_of(as_it_is(parts)).observations, np.concatenate(parts, 1))
    with pytest.raises(UserError, match=r"^observations\['mission'\] = .*: give numbers for each step"):
        episodes_of(as_it_is({"mission": np.array(["go"] * 4), "place": parts[0]}))
    with pytest.raises(UserError, match=r"^observations = 'float32 \[4, 8, 8, 3\]': give images as uint8"):
        episodes_of(as_it_is(np.zeros((4, 8, 8, 3), np.float32)))


THINGS = spaces.Dict({"microwave": spaces.Box(-1, 1, (1,)), "kettle": spaces.Box(-1, 1, (2,))})
KITCHEN = spaces.Dict({"observation": spaces.Box(-1, 1, (3,)), "achieved_goal": THINGS, "desired_goal": THINGS})
ACTIONS = np.array([[0.5], [-0.5], [1.0]])


def as_it_is(observations):
    """An episode as Minari hands it out."""
    return SimpleNamespace(iterate_episodes=lambda: [SimpleNamespace(observations=observations, actions=ACTIONS)])


def kept_by_minari(observations):
    """The same from a dataset of Minari."""
    import minari
    from minari.data_collector import EpisodeBuffer

    last = np.arange(3) == 2
    minari.create_dataset_from_buffers(
        "kitchen-v0",
        [EpisodeBuffer(None, None, None, observations, ACTIONS, np.zeros(3), last, last)],
        observation_space=KITCHEN,
        action_space=spaces.Box(-1, 1, (1,), np.float64),
        jpeg_encoding=False,
    )
    return minari.load_dataset("kitchen-v0")


@pytest.mark.filterwarnings("ignore::UserWarning:minari")  # A test has no author, address or registered environment.
@pytest.mark.filterwarnings("ignore:Implicitly cleaning up:ResourceWarning")  # Of Minari's own folder.
@pytest.mark.parametrize("recorded", [as_it_is, pytest.param(kept_by_minari, marks=needs_minari)])
def test_goals_that_are_dictionaries_become_vectors_as_in_gymnasium(recorded, tmp_path, monkeypatch):
    """A goal for each thing to do, as in the kitchen."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    KITCHEN.seed(0)
    steps = [KITCHEN.sample() for _ in range(4)]
    episodes = episodes_of(recorded(jax.tree.map(lambda *each: np.stack(each), *steps)))
    for name in ("achieved_goal", "desired_goal"):
        flat = np.stack([spaces.flatten(THINGS, step[name]) for step in steps])
        np.testing.assert_array_equal(getattr(episodes, f"{name}s"), flat)
    np.testing.assert_array_equal(episodes.observations, [step["observation"] for step in steps])
