"""A Ray cluster without Ray: its workers answer in this process what a test has them answer."""

import types
from collections.abc import Callable, Sequence
from typing import Any

import infogoal_jax
from infogoal_jax.reproduce.workers import News


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
