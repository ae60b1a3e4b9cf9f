"""Files of arrays: what is no file, or unpacks to gigabytes, is refused at once, and what is written is whole or not
there. An image dataset keeps every bit in one, and its cache costs nothing but time."""

import contextlib
import dataclasses
import errno
import os
import threading
import zipfile

import numpy as np
import pytest
from hand_made_frames import OPTIONAL, changed, small

from infogoal_jax import files, stopping
from infogoal_jax.cli.data import print_size
from infogoal_jax.cli.main import main
from infogoal_jax.data import archives, frames, frames_check
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.data.splits import load_split
from infogoal_jax.data.text import load
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import cube


@pytest.mark.parametrize("read", [frames.load, load, load_split])
def test_a_pipe_in_the_place_of_a_dataset_is_refused(read, tmp_path):
    """Reading it would wait for a writer for ever."""
    os.mkfifo(tmp_path / "pipe.npz")
    with pytest.raises(UserError, match="pipe.npz.*no regular file"):
        read(str(tmp_path / "pipe.npz"))
    with pytest.raises(UserError, match="/dev/zero"):
        read("/dev/zero")


def test_an_archive_of_kilobytes_that_unpacks_to_far_more_is_refused_unread(tmp_path, monkeypatch):
    """By the sizes that stand in it; a gigabyte is allowed, here a megabyte."""
    monkeypatch.setattr(archives, "MOST_UNPACKED", 2**20)
    monkeypatch.setattr(archives, "member", lambda *arguments: pytest.fail("unpacked"))
    archives.write(tmp_path / "bomb.npz", {"frames": np.zeros(10**7, np.uint8)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(UserError, match="bytes that unpack to 10,000,"):
        frames.load(str(tmp_path / "bomb.npz"))


def test_an_archive_may_be_larger_than_other_files(tmp_path, monkeypatch):
    """As one of recorded images, which is written at any size."""
    monkeypatch.setattr(files.read_bytes, "__defaults__", (100,))
    archives.write(tmp_path / "ones.npz", {"frames": np.ones(1000, np.uint8)}, zipfile.ZIP_STORED)
    assert archives.read(tmp_path / "ones.npz", "").sizes["frames"] >= 1000
    with pytest.raises(OSError, match="more than 100 bytes"):
        files.read_bytes(tmp_path / "ones.npz")


def test_an_archive_that_packs_well_is_read(tmp_path):
    archives.write(tmp_path / "zeros.npz", {"frames": np.zeros(10**6, np.uint8)}, zipfile.ZIP_DEFLATED)
    assert archives.read(tmp_path / "zeros.npz", "").sizes["frames"] > 10**6


@pytest.mark.parametrize("there", [False, True], ids=["new", "empty"])
def test_a_folder_that_is_written_is_whole_or_not_there(there, tmp_path):
    folder = tmp_path / "house"
    if there:
        folder.mkdir()
    refused = pytest.raises(UserError, match="path = .*house.*No space left.*give another place")
    with refused, archives.new_folder(folder, "path") as beside:
        (beside / "half").write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.rglob("*")) == [folder] * there
    with archives.new_folder(folder, "path") as beside:
        (beside / "whole").write_text("whole")
        (beside / "images").mkdir()
    assert {path.name for path in tmp_path.rglob("*")} == {"house", "whole", "images"}


def test_a_folder_that_is_half_written_goes_when_the_process_stops_at_once(tmp_path):
    """Although another thread is still writing into it."""

    def write():
        number = 0
        with contextlib.suppress(OSError):
            while number < 10**6:
                (beside / f"{number}.jpg").write_bytes(bytes(1000))
                number += 1

    with archives.new_folder(tmp_path / "house", "path") as beside:
        thread = threading.Thread(target=write)
        thread.start()
        while not (beside / "20.jpg").exists():
            assert thread.is_alive()
        stopping.remove_temporaries()
        assert list(tmp_path.iterdir()) == []
        thread.join()
        beside.mkdir()  # For the end of the block.


def test_what_cannot_be_saved_is_not_said_to_be_a_file(tmp_path):
    """`infogoal data check` of a file that was not written was the remedy."""
    path = tmp_path / "row"
    with pytest.raises(UserError) as refused:
        frames.save(path, dataclasses.replace(small(), frames=small().frames[:2]))
    remedy = "give [frames] with as many in both; nothing is written"
    assert str(refused.value) == f"{path}: state: has 6 frames, but frames has 2; {remedy}"
    with pytest.raises(UserError, match="dataset = 'int': give a FrameDataset"):
        frames.save(path, 3)
    assert not path.exists()


@pytest.mark.parametrize("changes", [{}, OPTIONAL, {"frames": small().frames[..., :1]}], ids=["all", "few", "grey"])
def test_what_is_saved_is_loaded_bit_by_bit(changes, tmp_path):
    saved = small(**changes)
    path = tmp_path / "new" / "row"  # numpy would add an ending to the name
    frames.save(path, saved)
    loaded = frames.load(path)
    for field in dataclasses.fields(FrameDataset):
        one, other = getattr(saved, field.name), getattr(loaded, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
        else:
            assert one == other and type(one) is type(other)
    frames.save(tmp_path / "again", loaded)
    assert (tmp_path / "again").read_bytes() == path.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == ["row"]


def test_next_state_follows_the_moves_and_stays_where_none_is_recorded():
    table = frames.next_state(small())
    assert table.dtype == np.int32
    np.testing.assert_array_equal(table, [[1, 0], [2, 1], [3, 2], [3, 3], [0, 4]])


def test_next_state_names_the_two_moves_that_contradict_each_other():
    contradicting = small(state=np.array([0, 1, 2, 3, 0, 4], np.int32), action=np.zeros(5, np.int32))
    with pytest.raises(
        UserError, match=r"a row of five: next_frame\[3\]: moves 0 and 3 are both action 0 in state 0.* states 1 and 4"
    ):
        frames.next_state(contradicting)


@pytest.mark.parametrize("kept", [0, 1, 40, 0.3, 0.7, -1])
def test_a_file_cut_short_is_named(kept, tmp_path):
    path = tmp_path / "row.npz"
    frames.save(path, small())
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if 0 < kept < 1 else kept])
    with pytest.raises(
        UserError, match=r"image dataset = '.*row\.npz': format = 'not an npz': the file is cut short.*data import"
    ):
        frames.load(path)
    assert [finding.problem.split(":")[0] for finding in frames_check.check_frames(path)] == ["format = 'not an npz'"]


def test_a_changed_byte_is_found(tmp_path):
    path = tmp_path / "row.npz"
    frames.save(path, small())
    content = bytearray(path.read_bytes())
    content[len(content) // 4] ^= 255
    path.write_bytes(content)
    with pytest.raises(UserError, match="frames: unreadable"):
        frames.load(path)


def test_files_that_cannot_be_read_or_written_are_named(tmp_path, capsys):
    assert main(["data", "check", str(tmp_path / "nothing.npz")]) == 2
    assert "no such file; give an npz of `infogoal data import`" in capsys.readouterr().out
    with pytest.raises(UserError, match="no such file; give an npz of `infogoal data import`"):
        frames.load(tmp_path / "nothing.npz")
    with pytest.raises(UserError, match="cannot be read"):
        frames.load(tmp_path)
    with pytest.raises(UserError, match="cannot be written"):
        frames.save(tmp_path, small())
    with pytest.raises(UserError, match=r"row\.npz: rotation\[1\]: is no rotation"):
        frames.save(tmp_path / "row.npz", small(**changed("rotation", 1, 0)))
    with pytest.raises(UserError, match="give values that JSON has"):
        frames.save(tmp_path / "row.npz", small(about={"name": np.zeros(3)}))
    assert not list(tmp_path.iterdir())


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    frames.save(tmp_path / "row.npz", small())

    def disk_full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(archives.os, "fsync", disk_full)
    with pytest.raises(UserError, match="No space left"):
        frames.save(tmp_path / "row.npz", small(**OPTIONAL))
    assert frames.load(tmp_path / "row.npz").objects and len(list(tmp_path.iterdir())) == 1


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The user's cache folder, moved; it is not there yet."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(archives, "user_cache", lambda: folder)
    return folder


def test_a_dataset_is_built_once_and_then_comes_from_the_cache(cache, capsys):
    built = []

    def build():
        built.append(small())
        return built[-1]

    first = frames.cached("row-1", build)
    message = capsys.readouterr().err
    assert "row-1 is not in the cache yet; it is built now" in message and len(message.splitlines()) == 1
    second = frames.cached("row-1", build)
    np.testing.assert_array_equal(first.frames, second.frames)
    assert len(built) == 1 and capsys.readouterr() == ("", "")
    path = cache / "row-1.npz"
    path.write_bytes(path.read_bytes()[:-100])
    frames.cached("row-1", build)
    assert len(built) == 2 and "damaged" in capsys.readouterr().err
    frames.cached("row-1", build)
    assert len(built) == 2


def test_a_cache_that_cannot_be_written_to_costs_only_time(cache, capsys):
    cache.write_text("a file in the way")
    dataset = frames.cached("row-1", small)
    assert (
        len(dataset.frames) == 6
        and "cannot be written" in capsys.readouterr().err
        and cache.read_text() == "a file in the way"
    )


def test_one_action_is_not_called_several(tmp_path, capsys):
    (tmp_path / "row.npz").write_bytes(b"")
    print_size(str(tmp_path / "row.npz"), dataclasses.replace(small(), actions=("on",)))
    assert "5 states, 5 moves of 1 action; " in capsys.readouterr().out


def test_the_command_builds_a_dataset_in_a_new_file(tmp_path, monkeypatch, capsys):
    def build(seed, physical_limits, size=64, progress=None):
        progress(0.5)
        return small(about=small().about | {"seed": seed, "physical_limits": physical_limits})

    monkeypatch.setattr(cube, "build", build)
    path = tmp_path / "cube.npz"
    assert main(["data", "build", "cube", str(path), "--seed", "5", "--physical-limits"]) == 0
    assert "6 frames" in capsys.readouterr().out
    assert frames.load(path).about["seed"] == 5 and frames.load(path).about["physical_limits"] is True
    (tmp_path / "nowhere.npz").symlink_to(tmp_path / "elsewhere.npz")  # It was refused after minutes of drawing.
    mistakes = {
        ("cube", str(path)): "is there already",
        ("cube", str(tmp_path / "nowhere.npz")): "is there already",
        ("house", str(tmp_path / "nowhere.npz")): "is there already and not empty",
        ("cube", "cube"): "path = 'cube': a dataset is one file, an npz; let it end in .npz",
        ("castle",): "Known: house, cube",
    }
    for arguments, expected in mistakes.items():
        assert main(["data", "build", *arguments]) == 2
        assert expected in capsys.readouterr().err
