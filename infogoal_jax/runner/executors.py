"""Where jobs run: in this process, in several that share a folder, or on a Ray cluster.

A job is what one program trains. It leaves its files in a folder and goes on from what it finds there, so that it runs
the same, to the same bits, wherever it is. Any number of processes, on any machines that see the folder, may work on
its jobs: a job is taken by locks in the folder, which go with the process, however it ends.
"""

import contextlib
import dataclasses
import functools
import logging
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

from rich.console import Console

import infogoal_jax
from infogoal_jax.errors import UserError, counted, require
from infogoal_jax.files import read_bytes
from infogoal_jax.imports import contents, import_contents, import_flags
from infogoal_jax.runner import progress
from infogoal_jax.runner.compilation import use_compilation_cache
from infogoal_jax.runs import disk
from infogoal_jax.stopping import StopRequest, stop_on_signal

BEGINNING = 45.0
"""Seconds that have to be left for a job to be begun."""
WAIT = 0.5
"""Seconds between two looks at what others do."""
MEMORY = 0.9
"""Of a GPU's memory, what its processes have together."""
VISIBLE = "CUDA_VISIBLE_DEVICES"
MPS = "nvidia-cuda-mps-control"
"""The daemon by which processes compute on an NVIDIA GPU at the same time; without it they take turns."""
LOSSES = 3
"""How often Ray begins a job anew whose machine or process was lost: it may be what kills them."""
OWN = (".lock", ".partial", ".html")
"""Endings of files that are of no use elsewhere."""


def check_flags(engine: str, processes: int, gpus: int, ray_address: str) -> None:
    """Raise `UserError` for flags of where jobs run that do not go together."""
    by_ray = engine == "ray"
    require(0 <= processes <= 1000, "processes", processes, "give 0 to 1000")
    require(gpus >= 0, "gpus", gpus, "give 0 or more")
    names = names_of(gpus)
    require(gpus <= len(names), "gpus", gpus, f"give at most {len(names)}: {VISIBLE} is {','.join(names)}")
    require(by_ray or not ray_address, "ray_address", ray_address, "goes with --engine ray")
    require(not (by_ray and gpus), "gpus", gpus, "Ray spreads programs over GPUs by itself; leave it out")
    spread = "goes with --processes of at least 2, which are spread over them"
    require(processes > 1 or not gpus, "gpus", gpus, spread)


@dataclasses.dataclass
class Place:
    """Where a process works, and until when.

    folder: of the files.
    deadline: seconds of `time.time()` at which it has to have stopped.
    say: prints a line.
    show: the line of progress that a job is shown on; None: it prints lines of its own.
    stopping: set when it is to stop as soon as it can.
    """

    folder: Path
    deadline: float = math.inf
    say: Callable[[str], None] = print
    show: Callable[[Any], Any] | None = None
    stopping: threading.Event = dataclasses.field(default_factory=threading.Event)

    def left(self) -> float:
        """Seconds until it has to have stopped."""
        return -math.inf if self.stopping.is_set() else self.deadline - time.time()


@dataclasses.dataclass
class Outcome:
    """What came of jobs: members that are finished and that failed, and whether work stopped before the end."""

    finished: list[Any] = dataclasses.field(default_factory=list)
    failed: list[Any] = dataclasses.field(default_factory=list)
    stopped: bool = False


class Job(Protocol):
    """What one program trains. It can be pickled.

    name: for people.
    members: what it consists of, such as runs; a part of them may be claimed.
    """

    name: str
    members: tuple[Hashable, ...]

    def without(self, members: set[Hashable]) -> Self:
        """The job without some of its members."""

    def claim(self, place: Place, claims: contextlib.ExitStack, whole: bool) -> Self | None:
        """The part that this process may train: not done, and locked until `claims` is closed. whole: None if another
        process has begun a part of it. None if nothing is left."""

    def files(self, folder: Path) -> list[Path]:
        """What there is of it in the folder, to go on from."""

    def train(self, place: Place) -> None:
        """Train it until it is done or there is no more time, a signal included. What fails is written down."""

    def fail(self, place: Place, error: Exception) -> None:
        """Write down why its members failed, but for those that are done."""

    def outcome(self, folder: Path) -> Outcome:
        """Which of its members are finished and which failed, by what is in the folder."""

    def tidy(self, folder: Path) -> None:
        """Delete what is of no use once it has come to its end."""


def run_here(jobs: Sequence[Job], place: Place) -> Outcome:
    """Train what is not done of these jobs, one after another, until all are done or taken by others, the clock says
    stop, or a signal does. Raises `UserError` where the disk refuses."""
    outcome, tried = Outcome(), set[Hashable]()
    with stop_on_signal() as stop:
        # First whole jobs that nobody has begun, then what others left of those that they have.
        for whole in (True, False):
            for number, job in enumerate(jobs, 1):
                outcome.stopped |= stop.requested or place.left() < BEGINNING
                if outcome.stopped:
                    return outcome
                with contextlib.ExitStack() as claims:
                    mine = job.without(tried).claim(place, claims, whole)
                    if mine is None:
                        continue
                    tried.update(mine.members)  # What fails here is not begun again before the next start.
                    which = f", program {number} of {len(jobs)}" if len(jobs) > 1 else ""
                    place.say(f"{mine.name}: {counted(len(mine.members), 'run')}{which}")
                    mine.train(place)
                    end(mine, place.folder, outcome)
                    outcome.stopped |= stop.requested
    return outcome


def end(job: Job, folder: Path, outcome: Outcome) -> None:
    """Add what a job came to, and tidy after it."""
    found = job.outcome(folder)
    outcome.finished += found.finished
    outcome.failed += found.failed
    outcome.stopped |= len(found.finished) + len(found.failed) < len(job.members)
    job.tidy(folder)


def run_in_processes(arguments: list[str], processes: int, gpus: int) -> list[int]:
    """Run `infogoal ARGUMENTS`, which works on a folder, in so many processes. What they print is printed, with the
    number of the process. Returns their exit statuses.

    gpus: how many, over which processes are spread; 0: leave devices as they are. A signal is handed on: each process
    stops after its evaluation.
    """
    children, readers, say = [], [], functools.partial(progress.say, Console())
    if take_turns(processes, gpus):
        say(f"infogoal: processes on one GPU take turns; start `{MPS} -d` before, and they compute at the same time")
    with stop_on_signal() as stop:
        for number in range(processes):
            child = subprocess.Popen(
                [sys.executable, "-m", "infogoal_jax", *arguments, *import_flags()],
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


def wait(children: list[subprocess.Popen], stop: StopRequest) -> None:
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


def names_of(gpus: int) -> list[str]:
    """The names of the GPUs that this process sees; where nothing says it, of so many."""
    visible = os.environ.get(VISIBLE, "")
    return visible.split(",") if visible else [str(gpu) for gpu in range(gpus)]


def environment(number: int, processes: int, gpus: int) -> dict[str, str]:
    """The environment of a process: its GPU, and what it may take of the memory."""
    if not gpus:
        return dict(os.environ)
    gpu = {VISIBLE: names_of(gpus)[number % gpus]}
    return os.environ | gpu | memory_of_each(-(-processes // gpus))


def memory_of_each(processes: int) -> dict[str, str]:
    """What tells each of several processes on one GPU how much of its memory to take."""
    return {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{MEMORY / processes:.3f}"}


def take_turns(processes: int, gpus: int) -> bool:
    """Whether processes that share a GPU will take turns on it, although this machine has what ends that."""
    talks = Path(os.environ.get("CUDA_MPS_PIPE_DIRECTORY", "/tmp/nvidia-mps"), "control")
    return processes > gpus > 0 and shutil.which(MPS) is not None and not talks.exists()


def repeat(number: int, child: subprocess.Popen, say) -> None:
    """Print what a process prints."""
    with child.stdout:
        for line in child.stdout:
            say(f"{number}: {line.rstrip()}")


# A Ray cluster. Ray places jobs on machines and GPUs, and begins one anew whose machine or process was lost. Workers
# see no folder: what they write goes through a mailbox, from which a job that is begun anew has its last checkpoint.


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
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


class Message(NamedTuple):
    """What a worker sends.

    job: its name.
    said: lines.
    files: {path in the folder: content, None where it was deleted}.
    """

    job: str
    said: list[str]
    files: dict[str, bytes | None]


class Mailbox:
    """What goes between workers and the process that keeps the folder."""

    def __init__(self):
        self.messages: list[Message] = []
        self.files: dict[str, dict[str, bytes]] = {}
        self.stopping = False

    def put(self, message: Message) -> bool:
        """Take a message. Returns whether its job is to stop."""
        kept = self.files.setdefault(message.job, {})
        kept |= message.files
        self.files[message.job] = {path: content for path, content in kept.items() if content is not None}
        self.messages.append(message)
        return self.stopping

    def take(self) -> list[Message]:
        """The messages since the last call."""
        messages, self.messages = self.messages, []
        return messages

    def files_of(self, job: str) -> dict[str, bytes]:
        """What was sent of a job, for one that begins it anew."""
        return self.files.get(job, {})

    def forget(self, job: str) -> None:
        """A job has come to its end."""
        self.files.pop(job, None)

    def stop(self) -> None:
        """Let every job stop after its evaluation."""
        self.stopping = True


class Parcel(NamedTuple):
    """What a worker is sent.

    job: pickled, since what it holds may be of a file that a worker imports first.
    imports: files that `--import` named, {name: content}.
    version: of the package where the folder is kept.
    seconds: that it has.
    files: {path in the folder: content}, what there is of it, unless the mailbox has later ones.
    """

    job: bytes
    imports: dict[str, bytes]
    version: str
    seconds: float
    files: dict[str, bytes]


def train_remotely(parcel: Parcel, mailbox: Any) -> None:
    """What a worker does with a job: train it in a folder of its own, and send what it says and writes."""
    import ray

    if parcel.version != infogoal_jax.__version__:
        raise UserError(
            f"a worker has infogoal-jax {infogoal_jax.__version__}, the folder's machine {parcel.version}; install the "
            "same everywhere"
        )
    import_contents(parcel.imports)
    job: Job = ray.cloudpickle.loads(parcel.job)
    use_compilation_cache()
    with tempfile.TemporaryDirectory(prefix="infogoal-") as name:
        folder, said = Path(name), []
        for path, content in (parcel.files | ray.get(mailbox.files_of.remote(job.name))).items():
            write(folder, path, content)
        place, seen, errors = Place(folder, time.time() + parcel.seconds, said.append), stamps(folder), []

        def train() -> None:
            try:
                job.train(place)
            except BaseException as error:
                errors.append(error)

        thread = threading.Thread(target=train)  # Signals of a worker are Ray's.
        thread.start()
        working = True
        while working:
            thread.join(WAIT)
            working = thread.is_alive()  # Looked at first: what comes after its end is sent once more.
            words, said[:] = said[:], []
            now = stamps(folder)
            changed = {path: read(folder / path) for path, stamp in now.items() if seen.get(path) != stamp}
            message = Message(job.name, words, changed | {path: None for path in seen if path not in now})
            seen = now
            if ray.get(mailbox.put.remote(message)):
                place.stopping.set()
        if errors:
            raise errors[0]


def stamps(folder: Path) -> dict[str, tuple[int, int, int]]:
    """What changes when a file below the folder does, by its path."""
    found = {}
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            about = path.stat()
            if path.is_file() and path.suffix not in OWN:
                found[path.relative_to(folder).as_posix()] = about.st_ino, about.st_mtime_ns, about.st_size
    return found


def read(path: Path) -> bytes | None:
    """What a file holds; None where it was deleted a moment ago."""
    with contextlib.suppress(FileNotFoundError):
        return read_bytes(path)
    return None


def write(folder: Path, path: str, content: bytes | None) -> None:
    """Write a file that was sent, or delete it. Raises `UserError` for a path that leads out of the folder or through a
    link, and if the disk refuses."""
    if not Path(path).parts:
        raise UserError(f"{path!r}: names no file of {folder}")
    there = disk.below(folder, path)
    if content is None:
        there.unlink(missing_ok=True)
    else:
        disk.make_folder(there.parent)
        disk.write_atomically(there, lambda file: file.write(content))


def run_on_ray(jobs: Sequence[Job], place: Place, workers: int = 0, address: str = "") -> Outcome:
    """Train what is not done of these jobs, as `run_here` does, on a Ray cluster.

    workers: how many jobs at a time; 0: one a GPU, or where there is none, one a machine.
    address: of the cluster, as `ray.init` takes it; empty: one of this machine, which ends with the work. A cluster
    that this process is connected to already is used as it is.
    Raises `UserError` where there is no Ray or no cluster.
    """
    with connected(address) as ray, stop_on_signal() as stop:
        return Cluster(ray, place, stop, workers).run(jobs)


class UnderWay(NamedTuple):
    """A job that a worker has, and the locks of its members."""

    job: Job
    claims: contextlib.ExitStack


class Cluster:
    """Hands jobs to Ray, and keeps what comes back."""

    def __init__(self, ray: Any, place: Place, stop: StopRequest, workers: int):
        self.ray, self.place, self.stop, self.workers = ray, place, stop, workers
        here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=False
        )
        self.mailbox = ray.remote(Mailbox).options(num_cpus=0, scheduling_strategy=here).remote()
        self.under_way: dict[Any, UnderWay] = {}
        self.outcome = Outcome()

    def run(self, jobs: Sequence[Job]) -> Outcome:
        """Until all is done, or nothing is to be begun and all workers have stopped."""
        queue, tried = deque((job, whole) for whole in (True, False) for job in jobs), set[Hashable]()
        self.stop.finishing = "the evaluations of its workers"
        try:
            while True:
                ending = self.stop.requested or self.place.left() < BEGINNING
                if self.stop.requested:
                    self.mailbox.stop.remote()
                while not ending and queue and len(self.under_way) < self.count()[0]:
                    job, whole = queue.popleft()
                    # Where the file system has no locks, nothing else keeps a member from two workers.
                    self.submit(job.without(tried), whole, tried)
                if not self.under_way and (ending or not queue):
                    self.outcome.stopped |= ending
                    return self.outcome
                self.listen()
        except BaseException:
            self.drain()
            raise
        finally:
            self.stop.finishing = ""
            for task, each in self.under_way.items():
                self.ray.cancel(task, force=True)
                each.claims.close()
            self.ray.kill(self.mailbox)

    def count(self) -> tuple[int, int]:
        """How many jobs at a time, and how many GPUs there are."""
        machines = [node["Resources"] for node in self.ray.nodes() if node["Alive"]]
        gpus = int(sum(machine.get("GPU", 0) for machine in machines))
        return self.workers or gpus or max(1, sum(machine.get("CPU", 0) >= 1 for machine in machines)), gpus

    def submit(self, job: Job, whole: bool, tried: set[Hashable]) -> None:
        """Let a worker train what is left of a job."""
        claims = contextlib.ExitStack()
        mine = job.claim(self.place, claims, whole)
        if mine is None:
            return
        tried.update(mine.members)
        needs: dict[str, Any] = {"num_cpus": 1, "scheduling_strategy": "SPREAD", "max_retries": LOSSES - 1}
        workers, gpus = self.count()
        if gpus:
            on_one = math.ceil(workers / gpus)
            needs |= {"num_gpus": 1 / on_one, "runtime_env": {"env_vars": memory_of_each(on_one)}}
        folder = self.place.folder
        files = {path.relative_to(folder).as_posix(): content for path in mine.files(folder) if (content := read(path))}
        train = self.ray.remote(train_remotely).options(**needs)
        pickled = self.ray.cloudpickle.dumps(mine)
        parcel = Parcel(pickled, contents(), infogoal_jax.__version__, self.place.left(), files)
        task = train.remote(parcel, self.mailbox)
        self.under_way[task] = UnderWay(mine, claims)
        self.place.say(f"{mine.name}: {counted(len(mine.members), 'run')}")

    def listen(self) -> None:
        """Wait a moment for what workers send, and keep it."""
        ended, _ = self.ray.wait(list(self.under_way), timeout=WAIT)
        for message in self.ray.get(self.mailbox.take.remote()):  # Looked at after the tasks: it holds their last.
            for words in message.said:
                self.place.say(f"{message.job}: {words}" if message.job not in words else words)
            for path, content in message.files.items():
                write(self.place.folder, path, content)
        for task in ended:
            self.end(task)

    def end(self, task: Any) -> None:
        """Keep what a job came to."""
        job, claims = self.under_way.pop(task)
        try:
            self.ray.get(task)
        except self.ray.exceptions.RayTaskError as error:
            job.fail(self.place, error.cause if isinstance(error.cause, Exception) else error)
        except self.ray.exceptions.RayError as error:
            job.fail(self.place, error)
        finally:
            end(job, self.place.folder, self.outcome)
            self.mailbox.forget.remote(job.name)
            claims.close()

    def drain(self) -> None:
        """After an error: have workers stop, each after its evaluation, and keep what they send."""
        self.mailbox.stop.remote()
        while self.under_way:
            try:
                self.listen()
            except Exception as error:  # The first error is the one to be raised; here as much is kept as can be.
                self.place.say(f"what workers had is not kept: {error}")
                return
