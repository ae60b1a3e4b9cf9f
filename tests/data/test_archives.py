"""What is no file, or unpacks to gigabytes, is refused at once."""

import io
import os
import time
import zipfile

import numpy as np
import pytest

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


def test_an_archive_of_kilobytes_that_unpacks_to_gigabytes_is_refused_unread(tmp_path):
    """By the sizes that stand in it."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (2**31,)})
    with (
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as bomb,
        bomb.open("frames.npy", "w") as member,
    ):
        member.write(header.getvalue())
        for _ in range(2**11):
            member.write(bytes(2**20))
    started = time.monotonic()
    with pytest.raises(UserError, match="bytes that unpack to 2,147,4"):
        frames.load(str(tmp_path / "bomb.npz"))
    assert time.monotonic() - started < 5


def test_an_archive_that_packs_well_is_read(tmp_path):
    archives.write(tmp_path / "zeros.npz", {"frames": np.zeros(10**6, np.uint8)}, zipfile.ZIP_DEFLATED)
    assert archives.read(tmp_path / "zeros.npz", "").sizes["frames"] > 10**6
