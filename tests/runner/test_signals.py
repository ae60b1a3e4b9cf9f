"""`infogoal train` as a process of its own, ended by signals: half of the times while its program is compiled, half
while it trains. Whatever ends it, the run goes on and has the bits of one that was left alone; asked to stop, it is
gone at once where nothing would be lost, and says what is on disk.

SIGNALS=all in the environment sends every one of `TIMES`, which takes an hour on two cores; otherwise a tenth.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from killed_run import same_run

EPOCHS = 12
FLAGS = (
    f"--method none --seeds 2 --no-figures --num-epochs {EPOCHS} --epochs-per-evaluation 2 --num-envs 2 "
    "--rollout-steps 4 --updates-per-epoch 20 --batch-size 4 --buffer-steps 64 --evaluation-starts 1"
).split()
LONGEST = 600
"""Seconds of anything here, on a busy machine."""
AT_ONCE = 1.0 if (os.cpu_count() or 1) > 2 else 5.0
"""Seconds after which a process that has nothing to lose is gone; others may be waiting for the same two cores."""
FRACTION = 1.0 if os.environ.get("SIGNALS") == "all" else 0.1
TIMES = {signal.SIGKILL: 50, signal.SIGINT: 20, signal.SIGTERM: 20, signal.SIGHUP: 20}


LARGE = "fetch_pick_and_place --seeds 64 --no-figures".split()
"""A program that takes a compiler minutes, on any device."""


class Command:
    """`infogoal train` in this folder. words: of the command; cache: of compiled programs."""

    def __init__(self, folder: Path, words: list[str], cache: Path):
        self.folder, self.log = folder, folder.with_suffix(".log")
        self.log.write_text("")
        with open(self.log, "w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "infogoal_jax", "train", *words],
                env=os.environ | {"XDG_CACHE_HOME": str(cache), "PYTHONUNBUFFERED": "1"},
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def wait_for(self, condition) -> None:
        """Until this holds, or the process has ended."""
        deadline = time.monotonic() + LONGEST
        while not condition() and self.process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def printed(self) -> str:
        return self.log.read_text()

    def compiles(self) -> bool:
        return "compiling" in self.printed()

    def has_trained(self) -> bool:
        return (self.folder / "checkpoint").exists()

    def end(self) -> int:
        return self.process.wait(LONGEST)


def searching(folder: Path, house: Path, cache: Path) -> Command:
    """A short run of object search, or what is left of it."""
    there = (folder / "config.json").exists()
    words = ["--resume", str(folder)] if there else ["--out", str(folder), "--env.dataset", str(house)]
    return Command(folder, ["object_search", *words, *FLAGS], cache)


@pytest.fixture(scope="module")
def whole(tiny_house, tmp_path_factory) -> tuple[Path, Path, float]:
    """A run that was left alone, the cache of its programs, and the seconds that they took to compile."""
    place = tmp_path_factory.mktemp("whole")
    command = searching(place / "run", tiny_house, place / "cache")
    command.wait_for(command.compiles)
    began = time.monotonic()
    command.wait_for(command.has_trained)
    seconds = time.monotonic() - began
    assert command.end() == 0, command.printed()
    return place / "run", place / "cache", seconds


@pytest.mark.long
@pytest.mark.parametrize("number", TIMES, ids=lambda number: number.name)
def test_whatever_ends_it_the_run_goes_on(number, whole, tiny_house, tmp_path):
    """`pytest -s` prints what each signal met, a process that compiled, that trained, or none any more, and after how
    many seconds it was gone."""
    other, cache, seconds = whole
    met = Counter()
    for time_of in range(round(FRACTION * TIMES[number])):
        compiling, folder = time_of % 2 == 0, tmp_path / f"run_{time_of}"
        command = searching(folder, tiny_house, tmp_path / f"cache_{time_of}" if compiling else cache)
        command.wait_for(command.compiles if compiling else command.has_trained)
        time.sleep(random.uniform(0.0, 0.8 * seconds if compiling else 0.5))
        hit, before = command.process.poll() is None, command.has_trained()
        began = time.monotonic()
        command.process.send_signal(number)
        status, took = command.end(), time.monotonic() - began
        where = "ended before" if not hit else "training" if before else "compiling"
        met[where] += 1
        print(f"{number.name} {time_of}: {where}, status {status} after {took:.2f} s", flush=True)
        if number == signal.SIGKILL:
            assert status in (-signal.SIGKILL, 0)
        elif hit:
            assert status in (130, 0), command.printed()
            assert "Traceback" not in command.printed()
            assert status == 0 or f"--resume {folder}" in command.printed()
            assert before or command.has_trained() or took < AT_ONCE, command.printed()
        command = searching(folder, tiny_house, cache)
        assert command.end() == 0, command.printed()
        assert same_run(folder, other), time_of
        assert not list(folder.glob(".*"))
    print(f"{number.name}: the same bits after all of {dict(met)}")


@pytest.mark.long
@pytest.mark.parametrize("seconds", [0.0, 2.0, 5.0, 10.0])
def test_compilation_of_many_seeds_ends_with_the_process(seconds, tmp_path):
    """The threads of a compiler cannot be stopped: 64 seeds, on whichever device jax has, go with their process."""
    folder = tmp_path / "run"
    command = Command(folder, [*LARGE, "--out", str(folder)], tmp_path / "cache")
    try:
        command.wait_for(command.compiles)
        time.sleep(seconds)
        assert command.process.poll() is None, command.printed()
        assert "tracing" not in command.printed()  # The line of times that ends compilation.
        began = time.monotonic()
        command.process.send_signal(signal.SIGTERM)
        status, took = command.end(), time.monotonic() - began
    finally:
        command.process.kill()
    print(f"SIGTERM {seconds:.0f} s into compilation: status {status} after {took:.2f} s", flush=True)
    said = command.printed()
    assert status == 130 and took < AT_ONCE and "Traceback" not in said, (status, took, said)
    assert f"{folder} has no checkpoint yet; go on with: infogoal train --resume {folder}" in said
    assert (folder / "config.json").exists() and not (folder / "checkpoint").exists()
    assert not list(folder.glob(".*.partial*")), list(folder.iterdir())
