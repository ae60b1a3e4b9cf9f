"""The work on a folder by a Ray cluster: a worker on each device takes one program after another.

This process keeps the folder. It takes the lock of the runs that it hands out and writes what workers send, so that
they need not see the folder, and other processes may work on it as before. What a lost worker had is begun again by
another one.
"""

import contextlib
import dataclasses
import logging
import math
import os
from collections import deque
from pathlib import Path
from typing import Any

import infogoal_jax
from infogoal_jax.errors import UserError
from infogoal_jax.reproduce import checkpoints, files, progress
from infogoal_jax.reproduce.manifest import Run
from infogoal_jax.reproduce.plan import Program, programs_of
from infogoal_jax.reproduce.processes import MEMORY
from infogoal_jax.reproduce.remote import Job, News, Worker, write
from infogoal_jax.reproduce.work import BEGINNING, Outcome, Work, claim, report_failure, to_do
from infogoal_jax.stopping import StopRequest, stop_on_signal

WAIT = 0.5
"""Seconds between two looks at workers that say nothing."""
LOSSES = 3
"""A program whose worker was lost so often has failed: it may be what kills them."""
THREADS = 3
"""Of a worker: one trains, the others answer."""


def work_on_cluster(runs: list[Run], work: Work, workers: int = 0, address: str = "") -> Outcome:
    """Train what is not done of these runs, as `work_on` does, by the workers of a Ray cluster.

    workers: how many, 0: one a GPU, or where there is none, one a machine; address: of the cluster, as `ray.init` takes
    it; empty: one of this machine, which ends with the work. A cluster that this process is connected to already is
    used as it is. Raises `UserError` where there is no Ray, no cluster, or none of its workers can be used.
    """
    with connected(address) as ray, stop_on_signal() as stop:
        keeper = Keeper(ray, runs, work, workers, stop)
        stop.finishing = "the evaluations of its workers"
        try:
            return keeper.run()
        finally:
            stop.finishing = ""
            keeper.dismiss()
            progress.write(work.folder, runs, at_once=True)


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
        self.workers: list[Hired] = []
        self.hired = self.unfit = 0
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
                mine = claim(program, self.work, hired.claims, whole)
                if mine:
                    self.give(hired, program._replace(runs=tuple(mine)))

    def give(self, hired: Hired, program: Program) -> None:
        """Let a worker train these runs."""
        work = self.work
        job = Job(program.runs, work.left(), self.files_of(program), work.retry, work.goal_images, work.most_lanes)
        hired.program, hired.job, hired.news = program, hired.actor.train.remote(job), hired.actor.news.remote()

    def files_of(self, program: Program) -> dict[str, bytes]:
        """What is there of these runs, which are not done: files of some, and checkpoints of what was stopped."""
        names, there = (
            {run.name for run in program.runs},
            [files.path_of(self.work.folder, run) for run in program.runs],
        )
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
        for hired in list(self.workers):
            try:
                if hired.starting is not None and self.is_there(hired.starting):
                    self.check_version(self.ray.get(hired.starting))
                    hired.starting, self.unfit = None, 0
                if hired.job is None:
                    continue
                if self.is_there(hired.news):
                    # The job is looked at first: news that come after its end hold nothing.
                    ended = self.is_there(hired.job)
                    self.keep(hired, self.ray.get(hired.news))
                    if ended:
                        self.end(hired)
                    else:
                        hired.news = hired.actor.news.remote()
            except self.ray.exceptions.RayTaskError:
                raise  # A mistake in what it was asked, and not the loss of the worker.
            except self.ray.exceptions.RayError as error:
                self.lose(hired, error)

    def is_there(self, answer: Any) -> bool:
        """Whether an answer has come."""
        return bool(self.ray.wait([answer], timeout=0)[0])

    def check_version(self, version: str) -> None:
        """Raise `UserError` for a worker whose package is another one."""
        if version != infogoal_jax.__version__:
            raise UserError(
                f"ray_address: a worker has infogoal-jax {version}, and this machine {infogoal_jax.__version__}; "
                "install the same one everywhere"
            )

    def keep(self, hired: Hired, news: News) -> None:
        """Write what a worker sent, and repeat what it said."""
        folder = self.work.folder
        for words in news.said:
            self.work.say(f"{hired.number}: {words}")
        for path, content in news.files.items():
            write(folder, path, content)
            hired.received.add(path)
        if news.times:
            with open(folder / progress.TIMES, "a") as file:
                file.write(news.times)

    def end(self, hired: Hired) -> None:
        """Keep what a job came to."""
        try:
            self.keep(hired, self.ray.get(hired.job))
        except self.ray.exceptions.RayTaskError as error:
            self.give_up(hired.program, error)
        for run in hired.program.runs:
            failure = files.path_of(self.work.folder, run, "failed.json")
            if self.sent_as(files.path_of(self.work.folder, run)) in hired.received:
                failure.unlink(missing_ok=True)
                self.outcome.finished.append(run)
            elif self.sent_as(failure) in hired.received:
                self.outcome.failed.append(run)
        checkpoints.delete_measured(self.work.folder, hired.program.runs)
        self.release(hired)

    def give_up(self, program: Program, error: Exception) -> None:
        """Write of what is left of a program that it failed."""
        report_failure([run for run in program.runs if to_do(run, self.work)], error, self.work, self.outcome)

    def release(self, hired: Hired) -> None:
        """Let a worker have no job, and its runs be free."""
        hired.program = hired.job = hired.news = None
        hired.received.clear()
        hired.claims.close()

    def lose(self, hired: Hired, error: Exception) -> None:
        """Go on without a worker, and have what it left done by another one. Raises `UserError` where workers cannot
        even start."""
        self.workers.remove(hired)
        self.ray.kill(hired.actor)  # It may only have been out of reach: nothing is trained twice.
        if hired.starting is not None:
            self.unfit += 1
            if self.unfit >= LOSSES:
                raise UserError(f"ray_address: workers cannot start there: {error}") from error
            return
        self.work.say(f"{hired.number}: is lost: {str(error).strip().splitlines()[0]}")
        if hired.program is None:
            return
        program, name = hired.program, hired.program.runs[0].name
        self.release(hired)
        self.losses[name] = self.losses.get(name, 0) + 1
        if self.losses[name] < LOSSES:
            self.queue.appendleft((program, False))
        else:
            self.give_up(program, error)

    def dismiss(self) -> None:
        """Send all workers away, and let all runs be free."""
        for hired in self.workers:
            self.ray.kill(hired.actor)
            hired.claims.close()
