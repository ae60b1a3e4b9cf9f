"""Runs, searches and finals that are killed or stopped while they start, compile, train, write or draw, at random,
end with the same bits as those that were left alone, and leave no stale file; of two that want one folder one is
refused.

Their program is a small one (`killed_run.small_train`), so that hundreds of processes start, compile and are killed in
minutes; test_resume.py kills the real one.
"""

import os
import random
import signal
import time
from collections import Counter
from pathlib import Path

import killed_run
import pytest

from infogoal_jax.runs.tables import read_table

FILES = {
    "train": (
        "checkpoint",
        "policy",
        "config.json",
        "epochs.csv",
        "epochs.jsonl",
        "evaluations.csv",
        "evaluations.jsonl",
    ),
    "tune": ("checkpoint", "config.json", "trials.jsonl"),
    "final": ("checkpoint", "config.json", "trials.jsonl"),
}
LONGEST = 900
"""Seconds for a run on a busy machine."""
LASTING = (killed_run.TRAINING, killed_run.WRITING)
"""Moments that come again and again, from the first chunk to the last."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """For a kind: a run that was left alone, once everything is compiled, and the seconds that it took."""
    found = {}

    def run(kind: str) -> tuple[Path, float]:
        if kind not in found:
            folder = tmp_path_factory.mktemp(kind)
            for name in ("first", "second"):
                started = time.monotonic()
                process, _ = killed_run.start(kind, folder / name)
                process.join(LONGEST)
                assert process.exitcode == 0
            found[kind] = folder / "second", time.monotonic() - started
        return found[kind]

    return run


def check_same(kind: str, folder: Path, other: Path) -> None:
    """Assert that two runs left the same bits and the same files."""
    assert {path.name for path in folder.iterdir()} == {path.name for path in other.iterdir()}
    assert not list(folder.rglob(".*"))
    for name in FILES[kind]:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name


def wait_for(process, moment_of, wanted: str, seconds: float) -> None:
    """Return when a process, or a part of it that is drawn, is at the moment that is wanted, or has ended."""
    if wanted in LASTING:
        process.join(random.uniform(0.0, seconds))
    deadline = time.monotonic() + LONGEST
    while moment_of() != wanted and process.is_alive():
        assert time.monotonic() < deadline
        time.sleep(0.0002)
    time.sleep(random.choice([0.0, 0.001, 0.01]))


def end_at_random(kind: str, whole, folder: Path, number: int, times: int) -> Counter:
    """Send a signal to runs at random moments of each kind and go on after each; those that finish are compared and
    followed by new ones. Returns how often each moment was hit; at least `times` in all, and each once."""
    other, seconds = whole(kind)
    moments = killed_run.MOMENTS if kind == "train" else killed_run.MOMENTS[:-1]  # A search draws nothing.
    hit, finished = Counter(), 0
    while (missing := set(moments) - set(hit)) or hit.total() < times or finished == 0:
        process, moment_of = killed_run.start(kind, folder / str(finished))
        last, started = not missing and hit.total() >= times, time.monotonic()
        if last:
            process.join(LONGEST)
        else:
            wait_for(process, moment_of, random.choice(sorted(missing) or moments), seconds)
        if process.is_alive():
            assert not last
            hit[moment_of()] += 1
            os.kill(process.pid, number)
            process.join(LONGEST)
            if number == signal.SIGTERM:
                # Finished if the signal came after the last chunk; killed by it if before the first import's end.
                assert process.exitcode in (0, killed_run.STOPPED, -signal.SIGTERM), process.exitcode
        if process.exitcode == 0:
            check_same(kind, folder / str(finished), other)
            finished += 1
            seconds = min(seconds, time.monotonic() - started)  # The machine may be less busy than before.
        else:
            assert process.exitcode != killed_run.REFUSED
    print(f"{kind}: hit {dict(hit)}, {finished} finished")
    return hit


@pytest.mark.long
@pytest.mark.parametrize(("kind", "kills"), [("train", 24), ("tune", 13), ("final", 13)])
def test_killed_at_random_moments_it_ends_with_the_same_bits(kind, kills, whole, tmp_path):
    assert end_at_random(kind, whole, tmp_path, signal.SIGKILL, kills).total() >= kills


@pytest.mark.long
@pytest.mark.parametrize(("kind", "times"), [("train", 10), ("tune", 5), ("final", 5)])
def test_stopped_at_random_moments_it_ends_with_the_same_bits(kind, times, whole, tmp_path):
    assert end_at_random(kind, whole, tmp_path, signal.SIGTERM, times).total() >= times


@pytest.mark.parametrize("races", [1, pytest.param(50, marks=pytest.mark.long)])
def test_of_two_writers_one_is_refused_and_the_other_s_run_is_whole(races, tmp_path):
    for race in range(races):
        folder = tmp_path / str(race)
        processes = [killed_run.start("short", folder)[0] for _ in range(2)]
        for process in processes:
            process.join(LONGEST)
        assert sorted(process.exitcode for process in processes) == [0, killed_run.REFUSED]
        assert [(row["seed"], row["epoch"]) for row in read_table(folder, "epochs")] == [(0, 1)]
        assert not list(folder.glob(".*"))
