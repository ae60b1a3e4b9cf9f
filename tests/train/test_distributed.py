"""One run of several processes: each trains its share of the seeds, one writes the run, and it is the run that one
process would have made."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import hand_made
import numpy as np
import pytest
from places import TESTS

from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.runs import checkpoint
from infogoal_jax.train import distributed, host

ONE_OF_TWO = """
import os, sys
from pathlib import Path
import hand_made
from infogoal_jax.errors import UserError
from infogoal_jax.train import distributed, host
folder, coordinator, number, epochs, resume, seeds = sys.argv[1:]
distributed.join(coordinator, 2, int(number))
import jax
assert len(jax.devices()) == 2 * len(jax.local_devices())
def stop(progress):
    if os.environ.get("STOP") == str(progress.epoch):
        os.kill(os.getpid(), 15)
try:
    config = hand_made.config("none", num_epochs=int(epochs), epochs_per_evaluation=1, updates_per_epoch=3)
    sweep = host.run(config, range(int(seeds)), Path(folder), resume == "True", (stop,), hand_made.environment())
except UserError as error:
    sys.exit(str(error))
print(sorted(sweep.train.parts.name), sweep.params is not None, sweep.stopped)
"""


def free_port() -> int:
    """One that nobody listens at."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def start_two(folder: Path, epochs: int, resume: bool = False, seeds: int = 4, **environment) -> list[subprocess.Popen]:
    """Two processes on this machine, as on two hosts; the second has no sight of the folder unless it goes on."""
    coordinator = f"127.0.0.1:{free_port()}"
    folders = folder, folder if resume else folder / "never"
    return [
        subprocess.Popen(
            [sys.executable, "-c", ONE_OF_TWO, str(place), coordinator, *map(str, (number, epochs, resume, seeds))],
            cwd=TESTS,
            env=os.environ | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number, place in enumerate(folders)
    ]


def run_two(*arguments, **named) -> list[tuple[int, str, str]]:
    """Exit status and what was printed of each, when both have ended."""
    both = start_two(*arguments, **named)
    return [(process.returncode, *printed) for process, printed in [(each, each.communicate()) for each in both]]


def rows_of(folder: Path) -> list[dict]:
    """Rows of both tables of a run, as they were written."""
    names = "epochs", "evaluations"
    return [json.loads(line) for name in names for line in (folder / f"{name}.jsonl").read_text().splitlines()]


def assert_same_rows(folder: Path, other: Path) -> None:
    """Both runs have the same rows in the same order, but for what a program of fewer seeds rounds otherwise."""
    for mine, theirs in zip(rows_of(folder), rows_of(other), strict=True):
        assert mine.keys() == theirs.keys() and (mine["seed"], mine["epoch"]) == (theirs["seed"], theirs["epoch"])
        for name, value in mine.items():
            np.testing.assert_allclose(value, theirs[name], rtol=1e-4, err_msg=name)


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """The run as one process makes it."""
    folder = tmp_path_factory.mktemp("alone") / "run"
    config = hand_made.config("none", num_epochs=2, epochs_per_evaluation=1, updates_per_epoch=3)
    host.run(config, [0, 1, 2, 3], folder, env=hand_made.environment())
    return folder


@pytest.mark.long
def test_two_processes_make_the_run_of_one(alone, tmp_path):
    """Each has half of the seeds in its program; what is written is in the order of the seeds."""
    folder = tmp_path / "run"
    for status, _, errors in run_two(folder, 2):
        assert status == 0, errors
    assert not (folder / "never").exists()
    assert_same_rows(folder, alone)
    mine, other = (checkpoint.read_header(path / "checkpoint")[0] for path in (folder, alone))
    assert mine["seeds"] == other["seeds"] and mine["epoch"] == other["epoch"] == 2
    assert {path.name for path in folder.iterdir()} == {path.name for path in alone.iterdir()}


@pytest.mark.long
def test_a_signal_to_one_stops_both_and_both_go_on(alone, tmp_path):
    """With a checkpoint of all seeds, from which one process can go on, too."""
    folder = tmp_path / "run"
    for status, printed, errors in run_two(folder, 2, STOP="1"):
        assert status == 0 and printed.strip().endswith("True"), errors
    assert checkpoint.read_header(folder / "checkpoint")[0]["epoch"] == 1
    for status, printed, errors in run_two(folder, 2, resume=True):
        assert status == 0 and printed.strip().endswith("False"), errors
    assert_same_rows(folder, alone)


@pytest.mark.long
def test_seeds_that_cannot_be_shared_are_refused(tmp_path):
    for status, _, errors in run_two(tmp_path / "run", 1, seeds=3):
        assert status != 0 and "give a multiple of 2" in errors
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("coordinator", "count", "number", "named"),
    [("nowhere", 2, 0, "distributed"), ("here:1", 1, 0, "num_processes"), ("here:1", 2, 2, "process")],
)
def test_what_cannot_be_joined_is_refused(coordinator, count, number, named):
    with pytest.raises(UserError, match=f"^{named} = "):
        distributed.join(coordinator, count, number)


@pytest.mark.parametrize("flags", [["--num-processes", "2"], ["--distributed", "auto", "--resume", "auto"]])
def test_flags_that_do_not_go_together_are_refused(flags, tmp_path, capsys):
    assert main(["train", "object_search", "--out", str(tmp_path), *flags]) == 2
    assert "distributed" in capsys.readouterr().err or "resume" in flags[-2]


def test_one_process_shares_with_nobody():
    seeds = range(3)
    assert distributed.is_writer() and list(distributed.share(seeds)) == [0, 1, 2]
    tree = {"losses": [1.0]}
    assert distributed.gathered(tree) is tree and distributed.any_process(True) and not distributed.any_process(False)
