"""The work on a folder by a Ray cluster: a worker on each device takes one program after another.

This process keeps the folder. It takes the lock of the runs that it hands out and writes what workers send, so that
they need not see the folder, and other processes may work on it as before. Another worker goes on with what a lost one
had, from its last checkpoint.
"""

import contextlib
import dataclasses
import math
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import infogoal_jax
from infogoal_jax.errors import UserError
from infogoal_jax.stopping import StopRequest, stop_on_signal
from infogoal_paper import checkpoints, files, progress
from infogoal_paper.manifest import Run
from infogoal_paper.plan import Program, programs_of
from infogoal_paper.work import BEGINNING, Outcome, Work, claim, report_failure, to_do
from infogoal_paper.workers import MEMORY, Job, News, Worker, connected, write

WAIT = 0.5
"""Seconds between two looks at workers that say nothing."""
LOSSES = 3
"""A program whose worker was lost so often has failed: it may be what kills them. After so many workers in succession
that could not start, none is hired for a while."""
PAUSE = 60.0
"""Seconds of that while."""
THREADS = 3
"""Of a worker: one trains, the others answer."""


def work_on_cluster(runs: list[Run], work: Work, workers: int = 0, address: str = "") -> Outcome:
    """Train what is not done of these runs, as `work_on` does, by the workers of a Ray cluster.

    workers: how many, 0: one a GPU, or where there is none, one a machine; address: of the cluster, as `ray.init` takes
    it; empty: one of this machine, which ends with the work. A cluster that this process is connected to already is
    used as it is. Raises `UserError` where there is no Ray, no cluster, or none of its workers can be used.
    """
    checkpoints.tidy(work.folder, runs)
    with connected(address) as ray, stop_on_signal() as stop:
        keeper = Keeper(ray, runs, work, workers, stop)
        stop.finishing = "the evaluations of its workers"
        try:
            return keeper.run()
        except Exception:
            keeper.drain()
            raise
        finally:
            stop.finishing = ""
            keeper.dismiss()
            checkpoints.tidy(work.folder, runs)
            progress.write(work.folder, runs, at_once=True)


@dataclasses.dataclass(eq=False)
class Hired:
    """A worker of the cluster, and what it does. starting: its answer when it is there; job, news: answers that are
    awaited; received: names of the files of the job that were sent; claims: locks of the runs that it has."""

    number: int
    actor: Any
    starting: Any = None
    program: Program | None = None
    job: Any = None
    news: Any = None
    received: set[str] = dataclasses.field(default_factory=set)
    claims: contextlib.ExitStack = dataclasses.field(default_factory=contextlib.ExitStack)


class Keeper:
    """Hands programs out and keeps what comes back."""

    def __init__(self, ray: Any, runs: list[Run], work: Work, count: int, stop: StopRequest):
        self.ray, self.runs, self.work, self.count, self.stop = ray, runs, work, count, stop
        programs = programs_of(runs, work.goal_images)
        # As in `work_on`: first whole programs that nobody has begun.
        self.queue = deque((program, whole) for whole in (True, False) for program in programs)
        self.losses: dict[str, int] = {}
        self.ended: set[Run] = set()  # Their job came to its end, or they were given up.
        self.workers: list[Hired] = []
        self.hired = self.unfit = 0
        self.pause_until = 0.0
        self.outcome = Outcome()

    def run(self) -> Outcome:
        """Until all is done, or nothing is to be begun and all workers have stopped."""
        while True:
            ending = self.stop.requested or self.work.left() < BEGINNING
            if self.stop.requested:
                for hired in self.busy():
                    hired.actor.stop.remote()  # Again each time: one may just be beginning.
            if not ending:
                self.hand_out()
            if not self.busy() and (ending or not self.queue):
                self.outcome.stopped |= ending
                return self.outcome
            if not ending and self.queue:
                self.hire()
            self.listen()
            progress.write(self.work.folder, self.runs)

    def busy(self) -> list[Hired]:
        """The workers that have a job."""
        return [hired for hired in self.workers if hired.job is not None]

    def hire(self) -> None:
        """Start workers until there are as many as there should be; one is lost with its machine, or joins with it."""
        if time.monotonic() < self.pause_until:
            return
        machines = [node["Resources"] for node in self.ray.nodes() if node["Alive"]]
        gpus = int(sum(machine.get("GPU", 0) for machine in machines))
        wanted = self.count or gpus or sum(machine.get("CPU", 0) >= 1 for machine in machines)
        for _ in range(len(self.workers), wanted):
            needs: dict[str, Any] = {"num_cpus": 1, "scheduling_strategy": "SPREAD"}
            if gpus:
                on_one = math.ceil(wanted / gpus)
                memory = {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{MEMORY / on_one:.3f}"}
                needs |= {"num_gpus": 1 / on_one, "runtime_env": {"env_vars": memory}}
            actor = self.ray.remote(Worker).options(max_concurrency=THREADS, **needs).remote()
            self.workers.append(Hired(self.hired, actor, starting=actor.version.remote()))
            self.hired += 1

    def hand_out(self) -> None:
        """Give each worker that is there and has nothing to do the next program of which there is something left."""
        for hired in self.workers:
            while hired.starting is None and hired.job is None and self.queue:
                program, whole = self.queue.popleft()
                # Where the file system has no locks, nothing else keeps a run from two workers.
                taken = self.ended.union(*(other.program.runs for other in self.busy()))
                free = tuple(run for run in program.runs if run not in taken)
                mine = claim(program._replace(runs=free), self.work, hired.claims, whole)
                if mine:
                    self.give(hired, program._replace(runs=tuple(mine)))

    def give(self, hired: Hired, program: Program) -> None:
        """Let a worker train these runs."""
        work = self.work
        job = Job(program.runs, work.left(), self.files_of(program), work.retry, work.goal_images, work.most_lanes)
        hired.program, hired.job, hired.news = program, hired.actor.train.remote(job), hired.actor.news.remote()

    def files_of(self, program: Program) -> dict[str, bytes]:
        """What is there of these runs, which are not done: files of some, and checkpoints of what was stopped."""
        names = {run.name for run in program.runs}
        there = [files.path_of(self.work.folder, run) for run in program.runs]
        found = {self.sent_as(path): path.read_bytes() for path in there if path.exists()}
        for path, own in checkpoints.kept(self.work.folder).items():
            if names & own:
                with contextlib.suppress(FileNotFoundError):  # Another process came to its end with it.
                    found[self.sent_as(path)] = path.read_bytes()
        return found

    def sent_as(self, path: Path) -> str:
        """The name by which a file of the folder is sent."""
        return path.relative_to(self.work.folder).as_posix()

    def listen(self) -> None:
        """Wait a moment for what workers answer, and keep it."""
        awaited = [hired.starting or hired.job for hired in self.workers if hired.starting or hired.job]
        if awaited:
            self.ray.wait(awaited, timeout=WAIT)
        else:
            time.sleep(WAIT)
        for hired in list(self.workers):
            try:
                self.hear(hired)
            except self.ray.exceptions.RayError as error:  # Also one that its own code raised, but for its job's.
                self.lose(hired, error)

    def hear(self, hired: Hired) -> None:
        """Keep what a worker answered, if it did."""
        if hired.starting is not None and self.is_there(hired.starting):
            version = self.ray.get(hired.starting)
            if version != infogoal_jax.__version__:
                self.lose(hired, UserError(another_version(version)))
                return
            hired.starting, self.unfit = None, 0
        if hired.job is None or not self.is_there(hired.news):
            return
        # The job is looked at first: news that come after its end hold nothing.
        ended = self.is_there(hired.job)
        self.keep(hired, self.ray.get(hired.news))
        if ended:
            self.end(hired)
        else:
            hired.news = hired.actor.news.remote()

    def is_there(self, answer: Any) -> bool:
        """Whether an answer has come."""
        return bool(self.ray.wait([answer], timeout=0)[0])

    def keep(self, hired: Hired, news: News) -> None:
        """Write what a worker sent, and repeat what it said."""
        folder = self.work.folder
        for words in news.said:
            self.work.say(f"{hired.number}: {words}")
        for path, content in news.files.items():
            write(folder, path, content)
            hired.received.add(path)
        if news.times:
            progress.append_times(folder, news.times)

    def end(self, hired: Hired) -> None:
        """Keep what a job came to."""
        try:
            self.keep(hired, self.ray.get(hired.job))
        except self.ray.exceptions.RayTaskError as error:
            self.give_up(hired.program, error)
        self.count_ended(hired, hired.program.runs)
        self.ended.update(hired.program.runs)
        checkpoints.delete_measured(self.work.folder, hired.program.runs)
        self.release(hired)

    def count_ended(self, hired: Hired, ended: Iterable[Run]) -> None:
        """Count these runs of a worker, which have ended, by what it sent."""
        for run in ended:
            failure = files.path_of(self.work.folder, run, "failed.json")
            if self.sent_as(files.path_of(self.work.folder, run)) in hired.received:
                failure.unlink(missing_ok=True)
                self.outcome.finished.append(run)
            elif self.sent_as(failure) in hired.received:
                self.outcome.failed.append(run)

    def give_up(self, program: Program, error: Exception) -> None:
        """Write of what is left of a program that it failed."""
        report_failure([run for run in program.runs if to_do(run, self.work)], error, self.work, self.outcome)

    def release(self, hired: Hired) -> None:
        """Let a worker have no job, and its runs be free."""
        hired.program = hired.job = hired.news = None
        hired.received.clear()
        hired.claims.close()

    def lose(self, hired: Hired, error: Exception) -> None:
        """Go on without a worker, and have what it left done by another one. Raises `UserError` where none is left and
        none can start."""
        self.workers.remove(hired)
        self.ray.kill(hired.actor)  # It may only have been out of reach: nothing is trained twice.
        if hired.starting is not None:
            self.count_unfit(hired, error)
            return
        self.work.say(f"{hired.number}: is lost: {first_line(error)}")
        self.unfit, self.pause_until = 0, 0.0  # Its place is free, and may be the only good one.
        if hired.program is None:
            return
        program, name = hired.program, hired.program.runs[0].name
        self.count_ended(hired, [run for run in program.runs if not to_do(run, self.work)])  # No other one gets them.
        self.release(hired)
        self.losses[name] = self.losses.get(name, 0) + 1
        if self.losses[name] < LOSSES:
            self.queue.appendleft((program, False))
        else:
            self.give_up(program, error)
            self.ended.update(program.runs)

    def count_unfit(self, hired: Hired, error: Exception) -> None:
        """Hire none for a while if too many in succession could not start; the others go on. Raises `UserError` where
        there are no others."""
        self.unfit += 1
        self.work.say(f"{hired.number}: cannot start: {first_line(error)}")
        if self.unfit >= LOSSES:
            self.pause_until = time.monotonic() + PAUSE
            if not self.workers:
                raise UserError(f"ray_address: workers cannot start there: {error}") from error

    def drain(self) -> None:
        """After an error: have busy workers stop, each after its evaluation, and keep what they send."""
        while self.busy():
            for hired in self.busy():
                try:
                    hired.actor.stop.remote()
                    self.hear(hired)
                except Exception as error:  # The first error is the one to be raised; here as much is kept as can be.
                    self.work.say(f"{hired.number}: what it had is not kept: {first_line(error)}")
                    self.workers.remove(hired)
                    self.ray.kill(hired.actor)
                    hired.claims.close()
            time.sleep(WAIT)

    def dismiss(self) -> None:
        """Send all workers away, and let all runs be free."""
        for hired in self.workers:
            self.ray.kill(hired.actor)
            hired.claims.close()


def another_version(version: str) -> str:
    """What is wrong with a worker whose package is of this version."""
    return f"a worker has infogoal-jax {version}, this machine {infogoal_jax.__version__}; install the same everywhere"


def first_line(error: Exception) -> str:
    """What an error says, in one line."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
