"""What several files of tests use: made-up numbers of every run, and a reproduction whose clock runs out."""

import made_up_results
import pytest

from infogoal_jax.reproduce import lanes


@pytest.fixture(scope="session")
def results():
    """Made-up numbers of every run, of three seeds; nobody changes them."""
    return made_up_results.results(seeds=3)


@pytest.fixture
def evaluations(monkeypatch) -> list[int]:
    """The number of each evaluation as it comes. The third one that this test makes seems to take so long that the
    clock, where there is one, leaves no time for another."""
    go_on, count = lanes.go_on, []

    def slow(training):
        go_on(training)
        count.append(training.evaluations)
        training.last_seconds = 1e9 if len(count) == 3 else 1e-3

    monkeypatch.setattr(lanes, "go_on", slow)
    return count
