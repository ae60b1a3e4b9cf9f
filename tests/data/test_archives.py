"""What is no file, or unpacks to gigabytes, is refused at once; what is written is whole or not there."""

import contextlib
import errno
import os
import threading
import zipfile

import numpy as np
import pytest

from infogoal_jax import stopping
from infogoal_jax.data import archives, frames
from infogoal_jax.data.splits import load_split
from infogoal_jax.data.text import load
from infogoal_jax.errors import UserError


@pytest.mark.parametrize("read", [frames.load, load, load_split])
def test_a_pipe_in_the_place_of_a_dataset_is_refused(read, tmp_path):
    """Reading it would wait for a writer for ever."""
    os.mkfifo(tmp_path / "pipe.npz")
    with pytest.raises(UserError, match="pipe.npz.*not a regular file"):
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
