"""One run of several processes: each trains its share of the seeds, one writes the run, and it is the run that one
process would have made."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import hand_made
import jax
import numpy as np
import pytest
from jax.experimental import multihost_utils
from places import TESTS

from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.report import figures, summary
from infogoal_jax.runner import distributed, training
from infogoal_jax.runs import checkpoint
from infogoal_jax.stopping import Stopped, stop_on_signal

ONE_OF_TWO = """
import os, sys
from pathlib import Path
import hand_made
from infogoal_jax.errors import UserError
from infogoal_jax.stopping import Stopped, stop_on_signal
from infogoal_jax.runner import distributed, training
folder, coordinator, number, epochs, resume, seeds = sys.argv[1:]
watching = stop_on_signal()  # Before they join, as the command line does.
watching.__enter__()
distributed.join(coordinator, 2, int(number))
import jax
assert len(jax.devices()) == 2 * len(jax.local_devices())
assert distributed.agreed(f"runs/of-{number}-é") == "runs/of-0-é"
lines = [line.split() for name in ("tcp", "tcp6") for line in open(f"/proc/net/{name}").readlines()[1:]]
port = f"{int(coordinator.split(':')[1]):04X}"
hosts = {where.split(":")[0] for _, where, _, state, *_ in lines if state == "0A" and where.split(":")[1] == port}
assert len(hosts) == 1 and hosts.pop().endswith("0100007F")  # 127.0.0.1 alone, as it was named.
def stop(progress):
    if os.environ.get("STOP") == str(progress.epoch):
        os.kill(os.getpid(), 15)
def phase(name, epoch):
    if name == "compiling" and os.environ.get("STOP") == f"compiling {number}":
        os.kill(os.getpid(), 15)
try:
    config = hand_made.config("none", num_epochs=int(epochs), epochs_per_evaluation=1, updates_per_epoch=3)
    env = hand_made.environment()
    sweep = training.run(config, range(int(seeds)), Path(folder), resume == "True", (stop,), env, phase)
except UserError as error:
    sys.exit(str(error))
except Stopped as stopped:
    print("Stopped:", stopped)
    sys.exit(0)
distributed.part()
if os.environ.get("DRAW") and number == "0":
    sys.stdin.readline()
    jax.block_until_ready(jax.jit(lambda params: jax.tree.map(lambda leaf: leaf + 1, params))(sweep.params))
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
            stdin=subprocess.PIPE,
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
    training.run(config, [0, 1, 2, 3], folder, env=hand_made.environment())
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
@pytest.mark.parametrize("number", [0, 1])
def test_a_signal_to_one_before_the_first_chunk_stops_both(number, tmp_path):
    for status, printed, errors in run_two(tmp_path / "run", 2, STOP=f"compiling {number}"):
        assert status == 0 and "Stopped:" in printed and "has no checkpoint yet" in printed, errors
    assert not (tmp_path / "run" / "checkpoint").exists()


@pytest.mark.long
def test_nobody_waits_for_the_figures_of_the_first(tmp_path):
    """They may take longer than processes of jax wait for each other at their end."""
    first, second = start_two(tmp_path / "run", 1, DRAW="1")
    assert second.wait(300) == 0 and first.poll() is None
    printed, errors = first.communicate("drawn\n")
    assert first.returncode == 0 and printed.strip().endswith("False"), errors
    second.communicate()


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


def test_processes_that_do_not_reach_each_other_are_told_so(monkeypatch):
    """Such as those of two hosts whose names stand for 127.0.1.1 on each."""

    def refused(said):
        raise jax.errors.JaxRuntimeError("Connection refused")

    monkeypatch.setattr(jax.distributed, "initialize", lambda **given: None)
    monkeypatch.setattr(distributed, "any_process", refused)
    with pytest.raises(UserError, match="Connection refused; the name of each host"):
        distributed.join("here:1", 2, 0)


@pytest.mark.parametrize("flags", [["--num-processes", "2"], ["--distributed", "auto", "--resume", "auto"]])
def test_flags_that_do_not_go_together_are_refused(flags, tmp_path, capsys):
    assert main(["train", "object_search", "--out", str(tmp_path), *flags]) == 2
    assert "distributed" in capsys.readouterr().err or "resume" in flags[-2]


def test_one_process_shares_with_nobody():
    seeds = range(3)
    assert distributed.is_writer() and list(distributed.own_seeds(seeds)) == [0, 1, 2]
    tree = {"losses": [1.0]}
    assert distributed.gathered(tree) is tree and distributed.any_process(True) and not distributed.any_process(False)


@pytest.fixture
def first_of_two(monkeypatch):
    """This process is the first of two, whose other one has the negative of every number. Returns the sizes of what
    devices held, and whether the process is the first, which may be changed."""
    held, first = [], {"number": 0}

    def process_allgather(own, tiled=False):
        held.append(own.size)
        return np.concatenate([own, -own]) if tiled else np.stack([own, -own])

    monkeypatch.setattr(multihost_utils, "process_allgather", process_allgather)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "process_index", lambda: first["number"])
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
    return held, first


def test_no_device_holds_the_states_of_all_seeds(first_of_two):
    """One array of one seed at a time comes together, in the order of the seeds, and the writer alone keeps it."""
    held, first = first_of_two
    states = {"a": np.arange(1.0, 7).reshape(3, 2), "b": np.arange(1, 4), "key": jax.random.split(jax.random.key(0), 3)}
    found = distributed.gathered_by_writer(states)
    np.testing.assert_array_equal(found["a"], [[1, 2], [3, 4], [5, 6], [-1, -2], [-3, -4], [-5, -6]])
    np.testing.assert_array_equal(found["b"], [1, 2, 3, -1, -2, -3])
    np.testing.assert_array_equal(jax.random.key_data(found["key"][:3]), jax.random.key_data(states["key"]))
    assert max(held) == 2 and len(held) == 9
    first["number"] = 1
    assert distributed.gathered_by_writer(states) is None and len(held) == 18, "all take part"


def test_a_signal_to_another_process_stops_this_one(monkeypatch):
    monkeypatch.setattr(distributed, "any_process", lambda said: True)
    with stop_on_signal() as stop, pytest.raises(Stopped, match="nothing yet"):
        stop.advice = "nothing yet"
        distributed.check(stop)


@pytest.mark.parametrize("number", [0, 1])
def test_processes_part_between_training_and_figures(number, tmp_path, monkeypatch, capsys):
    """`train` lets the others go as soon as the run is trained, before anything is drawn."""
    done = []
    sweep = SimpleNamespace(stopped=False, train=SimpleNamespace(env=None))
    monkeypatch.setattr(distributed, "join", lambda *arguments: None)
    monkeypatch.setattr(distributed, "is_writer", lambda: number == 0)
    monkeypatch.setattr(training, "run", lambda *arguments, **named: done.append("trained") or sweep)
    monkeypatch.setattr(jax.distributed, "shutdown", lambda: done.append("parted"))
    monkeypatch.setattr(summary, "print_run", lambda folder: done.append("summed up"))
    monkeypatch.setattr(figures, "draw_figures", lambda folder, env: done.append("drawn") or [])
    words = [
        "--distributed",
        "here:1",
        "--num-processes",
        "2",
        "--process",
        str(number),
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(["train", "object_search", *words]) == 0, capsys.readouterr().err
    assert done == ["trained", "parted", "summed up", "drawn"][: 4 if number == 0 else 2]
