"""A worker that sees no folder of others: it trains in one of its own, and what it writes there is asked for as bytes.

Runs are trained by the same work as everywhere, so that their numbers are the same.
"""

import contextlib
import os
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import infogoal_jax
from infogoal_jax.reproduce.checkpoints import UNFINISHED
from infogoal_jax.reproduce.manifest import Run
from infogoal_jax.reproduce.progress import TIMES
from infogoal_jax.reproduce.work import Work, work_on
from infogoal_jax.runs import disk
from infogoal_jax.train.compilation import use_compilation_cache

SENT = "runs", UNFINISHED
"""Folders whose files are sent."""
OWN = (".lock", ".partial")
"""Endings of files that are of no use elsewhere."""


class Job(NamedTuple):
    """What a worker is to train. runs: of one program; seconds: that it has; files: what is there of these runs, {path
    in the folder: content}; retry, goal_images, most_lanes: as in `Work`."""

    runs: tuple[Run, ...]
    seconds: float = float("inf")
    files: dict[str, bytes] = {}  # noqa: RUF012 (never written to)
    retry: bool = False
    goal_images: Path | None = None
    most_lanes: int = 64


class News(NamedTuple):
    """What a worker did since it was asked last. said: lines; files: {path in the folder: content, None where it was
    deleted}; times: what it added to the file of times."""

    said: list[str]
    files: dict[str, bytes | None]
    times: str = ""


class Worker:
    """Trains one job at a time. `news` and `stop` are called from other threads while `train` is under way."""

    def __init__(self):
        self.lock, self.said, self.seen = threading.Lock(), [], {}
        self.work: Work | None = None

    def version(self) -> str:
        """That of the package, where the worker is."""
        return infogoal_jax.__version__

    def train(self, job: Job) -> News:
        """Train these runs until they are done or `stop` is called. Returns the news that nobody asked for."""
        use_compilation_cache()
        with tempfile.TemporaryDirectory(prefix="infogoal-") as name:
            folder = Path(name)
            for path, content in job.files.items():
                write(folder, path, content)
            with self.lock:
                self.said, self.seen = [], stamps(folder)
                self.work = Work(
                    folder,
                    time.time() + job.seconds,
                    job.retry,
                    job.goal_images,
                    job.most_lanes,
                    say=lambda words: self.said.append(words),
                )
            try:
                work_on(list(job.runs), self.work)
                news, times = self.news(), folder / TIMES
                return news._replace(times=times.read_text() if times.exists() else "")
            finally:
                with self.lock:
                    self.work = None

    def news(self) -> News:
        """What was said and written since the last call; nothing where no job is under way."""
        with self.lock:
            if self.work is None:
                return News([], {})
            said, self.said, before = self.said, [], self.seen
            self.seen = stamps(self.work.folder)
            changed = {path: self.content(path) for path, stamp in self.seen.items() if before.get(path) != stamp}
            return News(said, changed | {path: None for path in before if path not in self.seen})

    def content(self, path: str) -> bytes | None:
        """What a file holds; None where it was deleted a moment ago."""
        with contextlib.suppress(FileNotFoundError):
            return (self.work.folder / path).read_bytes()
        return None

    def stop(self) -> None:
        """Let the job under way end after its evaluation, with a checkpoint."""
        with self.lock:
            if self.work is not None:
                self.work.deadline = 0.0


def stamps(folder: Path) -> dict[str, tuple[int, int, int]]:
    """What changes when a file of the folder does, by its path, of all that are sent."""
    found = {}
    for path in (path for top in SENT for path in folder.glob(f"{top}/**/*")):
        with contextlib.suppress(FileNotFoundError):
            about = path.stat()
            if path.is_file() and path.suffix not in OWN:
                found[os.fspath(path.relative_to(folder))] = about.st_ino, about.st_mtime_ns, about.st_size
    return found


def write(folder: Path, path: str, content: bytes | None) -> None:
    """Write a file that was sent, or delete it. Raises `UserError` if the disk refuses."""
    there = folder / path
    if content is None:
        there.unlink(missing_ok=True)
    else:
        disk.make_folder(there.parent)
        disk.write_atomically(there, lambda file: file.write(content))
