"""A disk that is full from any write of a run on: one sentence says so, the last checkpoint goes on once there is space
again, and the run ends with the bits of one that was left alone."""

import errno
import functools
import os
from pathlib import Path

import hand_made
import killed_run
import pytest

from infogoal_jax import files
from infogoal_jax.errors import UserError
from infogoal_jax.runner import training
from infogoal_jax.runs import checkpoint
from infogoal_jax.runs import folder as folders


class Disk:
    """The system as `infogoal_jax.files` sees it. It counts what is asked of the disk, and refuses everything from
    `room` on; of what is written it takes half before."""

    def __init__(self, room: float = float("inf")):
        self.room, self.asked = room, 0

    def take(self) -> bool:
        """Whether there is space for this."""
        self.asked += 1
        return self.asked <= self.room

    def refuse(self) -> None:
        if not self.take():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def __getattr__(self, name: str):
        return getattr(os, name)

    def open(self, path, flags, *mode):
        if flags & os.O_CREAT:
            self.refuse()
        return os.open(path, flags, *mode)

    def write(self, descriptor, content):
        if not self.take():
            if len(content) > 1 and self.asked == self.room + 1:
                return os.write(descriptor, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return os.write(descriptor, content)

    def fsync(self, descriptor):
        self.refuse()
        os.fsync(descriptor)

    def replace(self, first, second):
        self.refuse()
        os.replace(first, second)

    def create(self, path):
        """What `files.create` makes, whose writes are counted."""
        return self.counted(CREATE(path))

    def open_lock(self, path, make=True):
        """What `files.open_lock` opens, whose writes are counted."""
        return self.counted(files.open_lock(path, make))

    def counted(self, file):
        """The file, whose writes are counted."""
        disk = self

        class Counted:
            def __getattr__(self, name):
                return getattr(file, name)

            def __enter__(self):
                return self

            def __exit__(self, *error):
                file.close()

            def write(self, content):
                if not disk.take():
                    file.write(content[: len(content) // 2])
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return file.write(content)

        return Counted()


CREATE = files.create


def config():
    return killed_run.chunk_config(num_epochs=6)


@pytest.fixture(autouse=True)
def small_program(monkeypatch):
    monkeypatch.setattr(training, "make_train", functools.partial(killed_run.small_train, size=1000))


@pytest.fixture(scope="module")
def env():
    return hand_made.environment()


def run(folder: Path, env, disk: Disk, monkeypatch) -> None:
    """The run, or what is left of it, on this disk."""
    monkeypatch.setattr(files, "os", disk)
    monkeypatch.setattr(files, "create", disk.create)
    monkeypatch.setattr(folders, "open_lock", disk.open_lock)
    training.run(config(), [0, 1], folder, (folder / "config.json").exists(), env=env)


def epoch_of(folder: Path) -> int:
    """Of the checkpoint; 0 where there is none. It is whole, whatever happened."""
    if not (folder / "checkpoint").exists():
        return 0
    return checkpoint.read_header(folder / "checkpoint")[0]["epoch"]


def fill_from(number: int, folder: Path, whole: Path, env, monkeypatch) -> None:
    """Let the disk be full from this write on, and go on when it has space."""
    with pytest.raises(UserError, match="could not be written.*(No space left|free some space)") as refused:
        run(folder, env, Disk(number), monkeypatch)
    assert not list(folder.glob(".*")), list(folder.glob(".*"))  # No lock, and nothing half written.
    before = epoch_of(folder)
    assert ("--resume" in str(refused.value)) == (before > 0)
    run(folder, env, Disk(), monkeypatch)
    assert before <= epoch_of(folder) == 6
    assert killed_run.same_run(folder, whole), number


@pytest.mark.parametrize("every", [40, pytest.param(1, marks=pytest.mark.long)])
def test_a_disk_that_is_full_from_any_write_on(every, env, tmp_path, monkeypatch):
    disk = Disk()
    run(tmp_path / "whole", env, disk, monkeypatch)
    assert disk.asked > 70
    for number in range(every // 2, disk.asked, every):
        fill_from(number, tmp_path / str(number), tmp_path / "whole", env, monkeypatch)
