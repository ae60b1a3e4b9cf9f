"""What works on runs beside this process. Several processes on one folder, so that programs are compiled side by side
and small ones share a GPU. And over a Ray cluster workers that see no folder of others: each trains in one of its own,
and what it writes there is asked for as bytes.

Runs are trained by the same work as everywhere, so that their numbers are the same.
"""

import contextlib
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import infogoal_jax
from infogoal_jax.errors import UserError, require
from infogoal_jax.runner.compilation import use_compilation_cache
from infogoal_jax.runs import disk
from infogoal_jax.stopping import stop_on_signal
from infogoal_paper.checkpoints import UNFINISHED
from infogoal_paper.manifest import Run
from infogoal_paper.progress import TIMES
from infogoal_paper.work import Work, work_on

MEMORY = 0.9
"""Share of a GPU's memory that its processes have together."""
MPS = "nvidia-cuda-mps-control"
"""The daemon by which processes compute on an NVIDIA GPU at the same time; without it they take turns."""
WAIT = 0.5
"""Seconds between two looks at a signal."""
SENT = "runs", UNFINISHED
"""Folders whose files are sent."""
OWN = (".lock", ".partial")
"""Endings of files that are of no use elsewhere."""


def work_side_by_side(arguments: list[str], processes: int, gpus: int, say=print) -> list[int]:
    """Run `infogoal ARGUMENTS` in so many processes, spread over GPUs 0, 1, ...; gpus: how many, 0: leave devices as
    they are. What they print is printed, with the number of the process. Returns their exit statuses.

    A signal is handed on: each process stops after its evaluation.
    """
    children, readers = [], []
    if take_turns(processes, gpus):
        say(f"infogoal: processes on one GPU take turns; start `{MPS} -d` before, and they compute at the same time")
    with stop_on_signal() as stop:
        for number in range(processes):
            child = subprocess.Popen(
                [sys.executable, "-m", "infogoal_jax", *arguments],
                env=environment(number, processes, gpus),
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
            )
            children.append(child)
            readers.append(threading.Thread(target=repeat, args=(number, child, say), daemon=True))
            readers[-1].start()
        stop.finishing = "the evaluations of its processes"
        try:
            wait(children, stop)
        finally:
            stop.finishing = ""
            for child in children:
                if child.poll() is None:
                    child.terminate()
    for reader in readers:
        reader.join()
    return [child.wait() for child in children]


def wait(children: list[subprocess.Popen], stop) -> None:
    """Wait for all processes; hand a signal on to them once."""
    told = False
    while any(child.poll() is None for child in children):
        if stop.requested and not told:
            told = True
            for child in children:
                child.terminate()
        for child in children:
            try:
                child.wait(WAIT / len(children))
            except subprocess.TimeoutExpired:
                continue


def environment(number: int, processes: int, gpus: int) -> dict[str, str]:
    """The environment of a process: its GPU, and its share of the memory."""
    if not gpus:
        return dict(os.environ)
    on_one = -(-processes // gpus)
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    names = visible.split(",") if visible else [str(gpu) for gpu in range(gpus)]
    return os.environ | {
        "CUDA_VISIBLE_DEVICES": names[number % min(gpus, len(names))],
        "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{MEMORY / on_one:.3f}",
    }


def take_turns(processes: int, gpus: int) -> bool:
    """Whether processes that share a GPU will take turns on it, although this machine has what ends that."""
    talks = Path(os.environ.get("CUDA_MPS_PIPE_DIRECTORY", "/tmp/nvidia-mps"), "control")
    return processes > gpus > 0 and shutil.which(MPS) is not None and not talks.exists()


def repeat(number: int, child: subprocess.Popen, say) -> None:
    """Print what a process prints."""
    with child.stdout:
        for line in child.stdout:
            say(f"{number}: {line.rstrip()}", flush=True)


def arguments_of(asked, minutes: float) -> list[str]:
    """The arguments of one process: what was asked for, without drawing, for so many minutes."""
    words = ["reproduce", asked.name, "--no-draw", "--out", str(Path(asked.out)), "--seeds", str(asked.seeds)]
    words += ["--vmap-size", str(asked.vmap_size), "--minutes", str(minutes)]
    for flag, values in (
        ("tasks", asked.tasks),
        ("methods", asked.methods),
        ("variants", asked.variants),
        ("sets", asked.sets),
        ("known-goals", asked.known_goals),
    ):
        words += [f"--{flag}", *map(str, values)] if values else []
    words += ["--known", str(asked.known)] if asked.known else []
    words += ["--goal-images", str(asked.goal_images)] if asked.goal_images else []
    return words + ["--retry"] * asked.retry + ["--quick"] * asked.quick


@contextlib.contextmanager
def connected(address: str):
    """Inside, the process is connected to the cluster. Gives the module `ray`."""
    try:
        import ray
    except ImportError as error:
        raise UserError("engine = 'ray': is not installed; pip install 'infogoal-jax[ray]'") from error
    if ray.is_initialized():
        yield ray
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Of the cluster that is started here.
    own = {} if address else {"include_dashboard": False}
    try:
        ray.init(address=address or "local", log_to_driver=False, logging_level=logging.ERROR, **own)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise UserError(
            f"ray_address = {address!r}: {str(error).strip() or type(error).__name__}; give HOST:PORT of a cluster "
            "that this machine belongs to, auto for the one that runs here, or ray://HOST:10001"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


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
    """Write a file that was sent, or delete it. Raises `UserError` if the disk refuses, and for a path that is not
    within `SENT`: whoever sends may be another machine."""
    parts = Path(path).parts
    within = len(parts) > 1 and parts[0] in SENT and ".." not in parts
    require(within, "path", path, f"a worker sends files below {', '.join(SENT)} alone")
    there = folder / path
    for place in (there, *there.parents[: len(parts) - 1]):
        require(not place.is_symlink(), "path", path, f"{place} is a link, through which nothing is written")
    if content is None:
        there.unlink(missing_ok=True)
    else:
        disk.make_folder(there.parent)
        disk.write_atomically(there, lambda file: file.write(content))
