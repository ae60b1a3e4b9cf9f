"""Work by the workers of a Ray cluster: nothing is lost with a worker, nothing is trained twice, the numbers are those
of one process, and who asks for no engine needs no Ray."""

import collections
import os
import signal
import subprocess
import sys
import threading
import time

import killed_reproduction
import numpy as np
import pytest
from killed_reproduction import lines_of, log_of, reproduce, runs
from two_machines import cluster_of_two

from infogoal_jax.cli.main import main
from infogoal_jax.runner.executors import run_on_ray
from infogoal_paper import files
from infogoal_paper.work import Work, work_on

pytestmark = pytest.mark.filterwarnings("ignore:os.fork")  # Ray starts its processes so, and they begin anew at once.
TOY = "reproduce table1 --quick --tasks object_search --methods none --variants paper".split()
PROGRAMS = 24
"""Of two runs each."""


def arrays_of(folder, run) -> dict[str, np.ndarray]:
    """All numbers of a finished run."""
    result = files.read(files.path_of(folder, run))
    return result.evaluations | result.arrays


def assert_same_numbers(folder, other, runs) -> None:
    """The runs of both folders have the same bits."""
    for run in runs:
        one, two = arrays_of(folder, run), arrays_of(other, run)
        assert one.keys() == two.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], two[name], err_msg=f"{run.name}: {name}")


@pytest.mark.parametrize("flags", [["--ray-address", "auto"], ["--engine", "ray", "--gpus", "2"]])
def test_flags_of_another_engine_are_refused(tmp_path, capsys, flags):
    assert main([*TOY, "--out", str(tmp_path), *flags]) == 2
    assert flags[-2].strip("-").replace("-", "_") in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.fixture
def cluster(tmp_path):
    """The cluster and its machines, whose workers train small programs."""
    with cluster_of_two("killed_reproduction.prepare_worker", {"LOG_IN": str(tmp_path)}) as found:
        yield found


def processes_of(folder, what: str) -> dict[str, int]:
    """The process that last began or finished each run."""
    return {name: int(process) for _, name, process in map(str.split, lines_of(folder, what))}


def kill_in_the_middle(folder) -> None:
    """When a third of the runs is finished, kill the process of one that is under way."""
    while len(log_of(folder, "finished")) < 2 * PROGRAMS // 3:
        time.sleep(0.02)
    while True:
        begun, finished = processes_of(folder, "begun"), processes_of(folder, "finished")
        under_way = [process for name, process in begun.items() if name not in finished]
        if under_way:
            return os.kill(under_way[0], signal.SIGKILL)


@pytest.mark.long
def test_48_runs_survive_the_loss_of_a_worker(cluster, tmp_path):
    """runner/test_jobs.py has that of a machine, runner/test_executors.py jobs whose workers die again and again."""
    folder, alone = tmp_path / "cluster", tmp_path / "alone"
    killer = threading.Thread(target=kill_in_the_middle, args=(tmp_path,), daemon=True)
    killer.start()
    said = []
    with killed_reproduction.small_programs(tmp_path):
        outcome = work_on(runs(PROGRAMS), Work(folder, say=said.append), run_on_ray)
    killer.join(60)
    assert not killer.is_alive()
    assert sorted(run.name for run in outcome.finished) == sorted(run.name for run in runs(PROGRAMS))
    assert not outcome.failed and not outcome.stopped and len(runs(PROGRAMS)) == 48
    begun = collections.Counter(log_of(tmp_path, "begun"))
    again = [name for name, times in begun.items() if times > 1]
    # What was lost of one program, if that had not come to its end.
    assert len({name.split("/")[3] for name in again}) <= 1 and max(begun.values()) <= 2
    assert len(set(processes_of(tmp_path, "begun").values())) >= 2
    reproduce(alone, PROGRAMS)
    assert_same_numbers(folder, alone, runs(PROGRAMS))
    with killed_reproduction.small_programs(tmp_path):
        assert not work_on(runs(PROGRAMS), Work(folder, say=said.append), run_on_ray).finished
    assert collections.Counter(log_of(tmp_path, "begun")) == begun


@pytest.mark.long
def test_a_signal_leaves_checkpoints_that_go_on(cluster, tmp_path):
    """Of every worker's program; with the numbers of runs that were left alone."""
    folder, alone, said = tmp_path / "folder", tmp_path / "alone", []

    def listen(words: str) -> None:
        said.append(words)
        if "evaluation 1," in words and sum("evaluation 1," in each for each in said) == 2:
            os.kill(os.getpid(), signal.SIGTERM)

    with killed_reproduction.small_programs(tmp_path):
        (tmp_path / killed_reproduction.SLOW).touch()
        outcome = work_on(runs(3), Work(folder, say=listen), run_on_ray)
        assert outcome.stopped and not outcome.finished and len(list((folder / "unfinished").iterdir())) == 2
        assert not list(folder.rglob("*.lock"))
        (tmp_path / killed_reproduction.SLOW).unlink()
        outcome = work_on(runs(3), Work(folder, say=said.append), run_on_ray)
    assert len(outcome.finished) == 6 and not list((folder / "unfinished").iterdir())
    assert sum("goes on after evaluation" in words for words in said) == 2
    reproduce(alone, 3)
    assert_same_numbers(folder, alone, runs(3))


@pytest.mark.long
def test_ctrl_c_ends_the_command_and_its_own_cluster(tmp_path):
    pytest.importorskip("ray")
    words = [sys.executable, "-m", "infogoal_jax", *TOY, "--out", str(tmp_path), "--engine", "ray", "--no-draw"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as command:
        printed = []
        for line in command.stdout:
            printed.append(line)
            if "none: 1 run" in line:
                command.send_signal(signal.SIGINT)
    assert command.returncode == 130 and "1 left" in printed[-1], printed
    assert any("Stopping after the evaluations of its workers" in line for line in printed)
    assert not list(tmp_path.rglob("*.lock"))
    again = subprocess.run(words, capture_output=True, text=True)
    assert again.returncode == 0 and "1 done" in again.stdout, again.stderr
