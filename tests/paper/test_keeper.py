"""What the keeper of a Ray cluster does when workers cannot start, are lost, or the disk refuses: what others train is
kept, and no run is handed out twice. The cluster is `FakeRay`, a Ray without Ray, whose workers answer in this process
what a test has them answer; test_cluster.py has a real one."""

import contextlib
import types
from collections.abc import Callable, Sequence
from typing import Any

import killed_reproduction
import pytest
from killed_reproduction import runs

import infogoal_jax
from infogoal_jax.errors import UserError
from infogoal_paper import checkpoints, cluster, files, work, workers
from infogoal_paper.work import Outcome, Work
from infogoal_paper.workers import News


class RayError(Exception):
    """That of Ray."""


class RayTaskError(RayError):
    """That of Ray: the code of a worker raised."""


class Answer:
    """What a call will return, or raise. ready: whether it is there."""

    def __init__(self, value: Any, ready: Callable[[], bool] = lambda: True):
        self.value, self.ready = value, ready


class Scripted:
    """A worker that keeps the jobs that it got in `jobs`. after: how often it is asked for news before its job has come
    to its end, None: not before it is told to stop; files: (job) -> what it sends at its end; starting: what it answers
    first; news: what is raised when it is asked for news."""

    def __init__(self, after: int | None = 0, files=lambda job: {}, starting=infogoal_jax.__version__, news=None):
        self.after, self.files, self.starting, self.failing = after, files, starting, news
        self.jobs, self.asked, self.stopped = [], 0, False

    def version(self) -> Answer:
        return Answer(self.starting)

    def train(self, job) -> Answer:
        self.jobs.append(job)
        self.asked, self.stopped = 0, False
        return Answer(News([], self.files(job)), self.is_at_its_end)

    def is_at_its_end(self) -> bool:
        return self.stopped or (self.after is not None and self.asked > self.after)

    def news(self) -> Answer:
        self.asked += 1
        return Answer(self.failing or News([], {}))

    def stop(self) -> Answer:
        self.stopped = True
        return Answer(None)


class Called:
    """An actor, or one of its methods, as Ray has them called."""

    def __init__(self, of: Any):
        self.of = of

    def __getattr__(self, name: str) -> Any:
        return types.SimpleNamespace(remote=getattr(self.of, name))


class FakeRay:
    """The module `ray`. machines: how many there are; workers: those that are hired, in order; the last entry makes all
    further ones."""

    exceptions = types.SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self, machines: int, workers: Sequence[Scripted], further: Callable[[], Scripted] = Scripted):
        self.machines, self.further, self.killed = machines, further, []
        self.workers, self.left = list(workers), list(workers)

    def nodes(self) -> list[dict]:
        return [{"Alive": True, "Resources": {"CPU": 1.0}}] * self.machines

    def remote(self, kind: type) -> Any:
        return types.SimpleNamespace(options=lambda **named: types.SimpleNamespace(remote=self.hire))

    def hire(self) -> Called:
        if not self.left:
            self.left.append(self.further())
            self.workers.append(self.left[0])
        return Called(self.left.pop(0))

    def wait(self, answers: list[Answer], timeout: float) -> tuple[list, list]:
        there = [answer for answer in answers if answer.ready()]
        return there, [answer for answer in answers if answer not in there]

    def get(self, answer: Answer) -> Any:
        if isinstance(answer.value, Exception):
            raise answer.value
        return answer.value

    def kill(self, actor: Called) -> None:
        self.killed.append(actor.of)


@pytest.fixture(autouse=True)
def quick(monkeypatch, tmp_path):
    """Nobody waits, and programs are small."""
    monkeypatch.setattr(cluster, "WAIT", 0.0)
    with killed_reproduction.small_programs(tmp_path):
        yield


def finishing(job) -> dict[str, bytes]:
    """Files of finished runs, as far as the keeper looks into them."""
    return {f"runs/{run.name}.npz": b"numbers" for run in job.runs}


def failing(job) -> dict[str, bytes]:
    """Files of runs that failed."""
    return {f"runs/{run.name}.failed.json": b'{"why": "out of luck", "trace": ""}' for run in job.runs}


def work_with(ray: FakeRay, monkeypatch, folder, wanted, **settings) -> tuple[Outcome, list[str]]:
    """What came of these runs on this cluster, and what was said."""
    said: list[str] = []
    monkeypatch.setattr(cluster, "connected", lambda address: contextlib.nullcontext(ray))
    return cluster.work_on_cluster(wanted, Work(folder, say=said.append, **settings)), said


def handed_out(ray: FakeRay) -> list[str]:
    """Names of the runs of all jobs."""
    return sorted(run.name for worker in ray.workers for job in worker.jobs for run in job.runs)


@pytest.mark.parametrize("answer", [RayError("out of disk"), RayTaskError("no such module"), "0.0.1"])
def test_a_machine_without_workers_leaves_the_others_at_work(answer, tmp_path, monkeypatch):
    """One machine of two cannot start a worker, or has another version: the other trains everything."""
    good = Scripted(after=5, files=finishing)
    ray = FakeRay(2, [Scripted(starting=answer), good], lambda: Scripted(starting=answer))
    outcome, said = work_with(ray, monkeypatch, tmp_path, runs(3))
    assert sorted(run.name for run in outcome.finished) == sorted(run.name for run in runs(3)) == handed_out(ray)
    # Those before the good one started do not count.
    assert sum("cannot start" in words for words in said) <= cluster.LOSSES + 1, "it is tried without end"


@pytest.mark.parametrize(("answer", "named"), [(RayError("out of disk"), "out of disk"), ("0.0.1", "install the same")])
def test_where_no_worker_can_start_the_user_is_told_why(answer, named, tmp_path, monkeypatch):
    ray = FakeRay(2, [], lambda: Scripted(starting=answer))
    with pytest.raises(UserError, match=f"ray_address.*{named}"):
        work_with(ray, monkeypatch, tmp_path, runs(1))


def test_a_worker_is_hired_in_place_of_the_only_good_one(tmp_path, monkeypatch):
    """Also while no more are hired, as others could not start."""
    bad = [Scripted(starting=RayError("out of disk")) for _ in range(cluster.LOSSES)]
    lost = Scripted(after=None)
    lost.news = lambda: Answer(RayError("its machine is gone") if lost.asked > 9 else workers.News([], {}))
    lost.is_at_its_end = lambda: (setattr(lost, "asked", lost.asked + 1), False)[1]
    ray = FakeRay(2, [bad[0], lost, *bad[1:]], lambda: Scripted(files=finishing))
    outcome, _ = work_with(ray, monkeypatch, tmp_path, runs(1))
    assert outcome.finished == runs(1)


def test_an_error_in_the_news_is_the_loss_of_that_worker(tmp_path, monkeypatch):
    ray = FakeRay(1, [Scripted(news=RayTaskError("disk is full there"))], lambda: Scripted(files=finishing))
    outcome, said = work_with(ray, monkeypatch, tmp_path, runs(1))
    assert outcome.finished == runs(1) and any("0: is lost: disk is full there" in words for words in said)


def test_what_a_lost_worker_had_finished_counts(tmp_path, monkeypatch):
    """One of its two runs had come; another worker gets the other one alone."""
    killed_reproduction.reproduce(tmp_path / "before", 1)
    first, second = runs(1)
    path = files.path_of(tmp_path / "before", first)
    lost, sent = Scripted(after=None), News([], {f"runs/{first.name}.npz": path.read_bytes()})
    answers = iter([sent, RayError("killed")])
    lost.news = lambda: Answer(next(answers))
    ray = FakeRay(1, [lost, Scripted(files=finishing)])
    outcome, _ = work_with(ray, monkeypatch, tmp_path / "folder", runs(1))
    assert outcome.finished == [first, second] and [job.runs for job in ray.workers[1].jobs] == [(second,)]


@pytest.mark.parametrize("engine", ["this process", "cluster"])
def test_what_killed_processes_left_is_deleted(engine, tmp_path, monkeypatch):
    """One was killed between the file of its last run and the deletion of its checkpoint, others within a write."""
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "delete_measured", lambda folder, runs: None)
        killed_reproduction.reproduce(tmp_path, 2, keeping=0.0)
    one, other = checkpoints.kept(tmp_path)
    files.path_of(tmp_path, runs(2)[-1]).unlink()
    left = tmp_path / checkpoints.UNFINISHED
    partial = [folder / ".abc.1.partial" for folder in (left, files.path_of(tmp_path, runs(1)[0]).parent)]
    for path in partial:
        path.write_bytes(b"the first half")
    if engine == "cluster":
        work_with(FakeRay(1, [Scripted()]), monkeypatch, tmp_path, runs(1))
    else:
        killed_reproduction.reproduce(tmp_path, 1)
    (kept,) = left.iterdir()
    assert not any(path.exists() for path in partial)
    assert kept in (one, other) and runs(2)[-1].name in checkpoints.kept(tmp_path)[kept]


def test_after_an_error_busy_workers_bring_their_checkpoints(tmp_path, monkeypatch):
    """The folder refuses what one sends: the other one stops after its evaluation, and its checkpoint is kept."""
    refused, slow = Scripted(files=finishing), Scripted(after=None, files=lambda job: {"unfinished/abc": b"states"})
    whole = workers.write

    def write(folder, path, content):
        if path.startswith("runs/"):
            raise UserError("out = full")
        whole(folder, path, content)

    monkeypatch.setattr(cluster, "write", write)
    ray = FakeRay(2, [slow, refused])
    with pytest.raises(UserError, match="out = full"):
        work_with(ray, monkeypatch, tmp_path, runs(2))
    assert slow.stopped and (tmp_path / "unfinished" / "abc").read_bytes() == b"states"
    assert not list(tmp_path.rglob("*.lock"))


def test_without_locks_no_run_is_handed_out_twice(tmp_path, monkeypatch):
    """As on file systems that have none, where whoever asks for a lock gets it."""
    monkeypatch.setattr(work, "locked", lambda path, folder: contextlib.nullcontext())
    ray = FakeRay(2, [Scripted(after=20, files=finishing), Scripted(files=finishing)])
    outcome, _ = work_with(ray, monkeypatch, tmp_path, runs(2))
    assert handed_out(ray) == sorted(run.name for run in runs(2)) and len(outcome.finished) == 4


@pytest.mark.parametrize("end", ["fails", "kills its workers"])
def test_what_fails_again_is_tried_once_a_retry(end, tmp_path, monkeypatch):
    for run in runs(1):
        files.write_failure(tmp_path, run, "out of luck", "")
    if end == "fails":
        ray, times = FakeRay(1, [Scripted(files=failing)]), 1
    else:
        ray, times = FakeRay(1, [], lambda: Scripted(news=RayError("killed"))), cluster.LOSSES
    outcome, _ = work_with(ray, monkeypatch, tmp_path, runs(1), retry=True)
    assert outcome.failed == runs(1) and handed_out(ray) == sorted(run.name for run in runs(1) * times)
