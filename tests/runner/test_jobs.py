"""Settings and seeds as jobs: the run that parts make, a sweep that goes on, the same bits wherever it runs, and what
cannot be run."""

import collections
import dataclasses
import io
import json
import os
import re
import subprocess
import sys
import threading
import time
import types

import hand_made
import killed_run
import numpy as np
import pytest
from killed_run import FILES, same_run
from places import TINY
from rich.console import Console
from two_machines import cluster_of_two

import infogoal_jax
from infogoal_jax import presets
from infogoal_jax.cli.main import main
from infogoal_jax.envs.environment import data_of
from infogoal_jax.errors import UserError
from infogoal_jax.report.runs import table_of
from infogoal_jax.runner import executors, jobs, progress, training
from infogoal_jax.runner.executors import Place, run_on_ray
from infogoal_jax.runner.jobs import PARTS, Plan, combinations, jobs_of, read_plan, run_plan
from infogoal_jax.runs import checkpoint, configuration, tables
from infogoal_jax.stopping import Stopped

pytestmark = pytest.mark.filterwarnings("ignore:os.fork")  # Ray starts its processes so, and they begin anew at once.
CONFIG = hand_made.config("none", num_epochs=4, epochs_per_evaluation=2)
LOG = "LOG_BEGUN"


def small_train(config, env=None):
    """The small program; the file that `LOG` names gets a line for each that is made."""
    if LOG in os.environ:
        with open(os.environ[LOG], "a") as file:
            file.write(f"{config.hyper.learning_rate:g} {os.getpid()}\n")
        time.sleep(0.3)
    return killed_run.small_train(config, hand_made.environment(), size=1000)


def prepare_worker() -> None:
    """Let every run of this process be of the small program."""
    training.make_train = small_train


@pytest.fixture(autouse=True)
def small_program(monkeypatch):
    monkeypatch.setattr(training, "make_train", small_train)
    monkeypatch.setattr(jobs, "load_environment", lambda config: hand_made.environment())


@pytest.mark.parametrize("words", ["--lr 0.5", "--batch-size 8", "--env.radius 0.3", "--num-epochs 4"])
def test_a_sweep_does_not_go_on_with_other_settings(words, tmp_path, monkeypatch, capsys):
    """They were taken, and not used."""
    jobs.start(presets.load("point_maze", num_epochs=2, epochs_per_evaluation=1), Plan([{}], [0], 0), tmp_path / "s")
    assert main(["train", "--resume", str(tmp_path / "s"), *words.split()]) == 2
    assert "sweep.json: is of another configuration: " in capsys.readouterr().err


def test_parts_make_the_run_that_others_read(tmp_path):
    plan = Plan([{}], [0, 1, 2, 3, 4], 2)
    outcome = run_plan(CONFIG, plan, tmp_path / "run", say=lambda words: None)
    assert outcome.finished == [f"{PARTS}/0-1", f"{PARTS}/2-3", f"{PARTS}/4-4"]
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert left == {*FILES, "timing.json"}
    assert configuration.read(tmp_path / "run").seeds == plan.seeds
    header, payload = checkpoint.read_header(tmp_path / "run" / "policy")
    assert header["epoch"] == 4 and header["seeds"] == plan.seeds and payload
    for table, epochs in (("epochs", 4), ("evaluations", 2)):
        assert table_of(tmp_path / "run", table).values["env_steps"].shape == (5, epochs)
    longer = infogoal_jax.TrainConfig(**(vars(CONFIG) | {"num_epochs": 6}))
    assert not training.run(longer, plan.seeds, tmp_path / "run", resume=True).stopped  # It goes on as any run.


def test_a_part_is_the_run_of_its_seeds(tmp_path):
    run_plan(CONFIG, Plan([{}], [0, 1, 2, 3], 2), tmp_path / "run", say=lambda words: None)
    training.run(CONFIG, [2, 3], tmp_path / "alone")
    rows, alone = (tables.read_table(tmp_path / name, "epochs") for name in ("run", "alone"))
    assert [row for row in rows if row["seed"] in (2, 3)] == alone


def test_a_sweep_that_was_stopped_goes_on(tmp_path, monkeypatch):
    plan = Plan(combinations({"learning_rate": [1e-4, 3e-4], "discount": [0.9]}), [0, 1], 1)
    run_plan(CONFIG, plan, tmp_path / "whole", say=lambda words: None)
    assert plan.names == ["learning_rate=0.0001,discount=0.9", "learning_rate=0.0003,discount=0.9"]

    def stopping(words: str) -> None:
        if "epoch 2/4" in words and "0.0003" in words:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_plan(CONFIG, plan, tmp_path / "sweep", say=stopping)
    assert (tmp_path / "sweep" / plan.names[0] / PARTS / "0-0" / "policy").exists()
    assert read_plan(tmp_path / "sweep") == (CONFIG, plan)
    with pytest.raises(UserError, match="or go on with the sweep by --resume"):
        run_plan(CONFIG, plan, tmp_path / "sweep")
    run_plan(CONFIG, plan, tmp_path / "sweep", resume=True, say=lambda words: None)
    for name in plan.names:
        assert same_run(tmp_path / "sweep" / name, tmp_path / "whole" / name)
    assert not list((tmp_path / "sweep").rglob("*.lock")) and not list((tmp_path / "sweep").rglob(PARTS))


def test_a_sweep_goes_on_from_another_folder_and_where_its_data_were_moved(tmp_path, monkeypatch, capsys):
    """A path that was typed was kept as it was, and one given to go on with passed over."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "house").mkdir()
    own = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, dataset="house"))
    plan = Plan(combinations({"discount": [0.9, 0.95]}), [0, 1], 1)
    jobs.start(own, plan, tmp_path / "sweep")
    first = jobs_of(own, plan)[0]
    training.run(first.config, first.seeds, first.folder(tmp_path / "sweep"))

    def places() -> set[str]:
        folders = [path.parent for path in (tmp_path / "sweep").rglob(configuration.NAME)]
        configs = [configuration.read(folder).config for folder in folders]
        return {config.env.dataset for config in [*configs, read_plan(tmp_path / "sweep")[0]]}

    assert places() == {str(tmp_path / "house")}
    (tmp_path / "house").rename(tmp_path / "moved")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    onward = ["train", "--resume", "../sweep", "--no-figures", "--env.dataset", "../moved"]
    source = hand_made.environment().source
    for found in ("another house", ""), (source, "of other recordings"):
        env = types.SimpleNamespace(source=found[0], recorded_checksum=found[1])
        monkeypatch.setattr(jobs, "load_environment", lambda config, env=env: env)
        assert main(onward) == 2 and places() == {str(tmp_path / "house")}
        told = capsys.readouterr().err.replace("../sweep", str(tmp_path / "sweep"))
        assert f"data = {data_of(env)!r}: {first.folder(tmp_path / 'sweep')} has {source!r}" in told
    monkeypatch.setattr(
        jobs, "load_environment", lambda config: types.SimpleNamespace(source=source, recorded_checksum="")
    )
    assert main(onward) == 0 and places() == {str(tmp_path / "moved")}


def test_what_is_said_of_a_stop_goes_on_with_the_whole_sweep(tmp_path, monkeypatch):
    """A part was named, with which nothing but that part goes on."""
    told = []

    def stopped(*arguments, onward, **named):
        told.append(onward)
        raise Stopped

    monkeypatch.setattr(training, "run", stopped)
    with pytest.raises(Stopped):
        run_plan(CONFIG, Plan([{"discount": 0.9}], [0, 1], 1), tmp_path / "sweep", say=lambda words: None)
    assert told == [f"infogoal train --resume {tmp_path / 'sweep'}"]
    assert training.how_to_go_on(tmp_path, 0, told[0]) == f"{tmp_path} has no checkpoint yet; go on with: {told[0]}"


def test_joining_that_was_stopped_is_done_again(tmp_path, monkeypatch):
    plan = Plan([{}], [0, 1], 1)
    run_plan(CONFIG, plan, tmp_path / "whole", say=lambda words: None)

    def killed(folder):
        """In the middle of what is deleted."""
        delete(folder / "0-0")
        (folder / "1-1" / configuration.NAME).unlink()
        raise KeyboardInterrupt

    delete = jobs.shutil.rmtree
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(jobs.shutil, "rmtree", killed)
        run_plan(CONFIG, plan, tmp_path / "run", say=lambda words: None)
    run_plan(CONFIG, plan, tmp_path / "run", resume=True, say=lambda words: None)
    assert same_run(tmp_path / "run", tmp_path / "whole")
    assert {path.name for path in (tmp_path / "run").iterdir()} == {*FILES, "timing.json"}


def test_from_python_with_a_table_and_a_figure(tmp_path, capsys):
    values = {"learning_rate": [1e-4, 3e-4], "learner_weight": [0.5]}
    result = infogoal_jax.sweep(CONFIG, range(2), tmp_path / "sweep", seeds_at_once=np.int64(2), **values)
    assert result.plan.seeds_at_once == 2 and read_plan(tmp_path / "sweep") == (CONFIG, result.plan)
    printed = capsys.readouterr().out
    assert printed.count(": compiling, ") == 2 and printed.count("left  train 0.") == 2
    assert re.search(r"=0.0003,learner_weight=0.5: epoch 2/4  \d+:\d\d  \d+:\d\d left  train 0\.\d\d  test ", printed)
    assert "learning_rate=0.0001" in repr(result) and str(tmp_path / "sweep") in repr(result)
    rows = result.rows()
    assert [(row["learning_rate"], row["seed"]) for row in rows] == [(1e-4, 0), (1e-4, 1), (3e-4, 0), (3e-4, 1)]
    assert all(row["epoch"] == 4 and 0 <= row["train_goal/success_rate"] <= 1 for row in rows)


@pytest.mark.parametrize(
    "width", [60, pytest.param(80, marks=pytest.mark.long), pytest.param(120, marks=pytest.mark.long)]
)
def test_programs_share_a_line_on_a_terminal(width, tmp_path, monkeypatch):
    """Bar, count, time left and success, as of a single run, over all that is to be trained."""
    terminal, drawn = Console(file=io.StringIO(), force_terminal=True, width=width), []
    monkeypatch.setattr(jobs, "Console", lambda: terminal)
    advance = progress.ProgressLine.advance

    def look(line, *numbers):
        advance(line, *numbers)
        drawn.append(line.of_width(width))

    monkeypatch.setattr(progress.ProgressLine, "advance", look)
    plan = Plan(combinations({"learning_rate": [1e-4, 3e-4]}), [0, 1], 0)
    run_plan(CONFIG, plan, tmp_path / "sweep")
    assert [line.split()[1] for line in drawn] == ["2/8", "4/8", "6/8", "8/8"] and "left" not in drawn[3]
    for line in drawn:
        assert "━" * 2 in line and "train 0." in line and "test 0." in line and len(line) <= width
    assert all(re.search(r" \d+:\d\d left ", line) for line in drawn[:3])
    printed = terminal.file.getvalue()
    for number, rate in ((1, "0.0001"), (2, "0.0003")):
        first = f"object_search learning_rate={rate}: "
        assert f"{first}1 run, program {number} of 2" in printed and f"{first}train 0." in printed
    assert printed.count("loading 0.") >= 2 and "epoch 2/4" not in printed and "━" in printed


@pytest.mark.long  # The line of one run in a notebook is in test_host.py.
def test_programs_share_a_line_in_a_notebook(tmp_path, monkeypatch, capsys):
    shown = []

    def display(line, display_id):
        shown.append(repr(line))
        return types.SimpleNamespace(update=lambda line: shown.append(repr(line)))

    monkeypatch.setitem(sys.modules, "IPython.display", types.SimpleNamespace(display=display))
    monkeypatch.setattr(jobs, "Console", lambda: Console(force_jupyter=True))
    monkeypatch.setattr(progress, "REFRESHED", 0.01)
    infogoal_jax.sweep(CONFIG, range(2), tmp_path / "sweep", learning_rate=[1e-4, 3e-4])
    for words in ("0/8  compiling", r"4/8  \d+:\d\d left  compiling"):
        assert any(re.search(words, line) for line in shown)
    assert "8/8  train 0." in shown[-1] and capsys.readouterr().out.count("learning_rate=0.0003: train 0.") == 1


@pytest.mark.long  # A run that goes on counts its own epochs in test_host.py.
def test_a_sweep_that_goes_on_counts_what_is_done(tmp_path, monkeypatch):
    plan = Plan(combinations({"learning_rate": [1e-4, 3e-4, 1e-3]}), [0], 0)
    jobs.start(CONFIG, plan, tmp_path / "sweep")
    first = jobs_of(CONFIG, plan)[0]
    training.run(first.config, first.seeds, first.folder(tmp_path / "sweep"))
    begun = []
    monkeypatch.setattr(jobs, "Console", lambda: Console(file=io.StringIO(), force_terminal=True))
    monkeypatch.setattr(
        progress.ProgressLine, "phase", lambda line, name, epoch=0: begun.append((name, line.before + epoch))
    )
    run_plan(CONFIG, plan, tmp_path / "sweep", resume=True)
    assert [epoch for name, epoch in begun if name == "compiling"] == [4, 8]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--sweep", "learning_rat=1e-4"], "sweep = 'learning_rat': no such float. Did you mean 'learning_rate'?"),
        (["--sweep", "learning_rate=fast"], "sweep = 'learning_rate=fast'"),
        (["--sweep", "learning_rate"], "FIELD=NUMBER"),
        (["--sweep", "discount=0.9", "discount=0.8"], "sweep = 'discount=0.8': discount is given already"),
        (["--sweep", "learning_rate=1e-4,1e-4"], "give each setting once"),
        (["--sweep", "learning_rate=-1"], "learning_rate = -1"),
        (["--vmap-size", "-1"], "vmap_size = -1"),
        (["--gpus", "2"], "gpus = 2"),
        (["--ray-address", "auto"], "ray_address = "),
        (["--engine", "ray", "--gpus", "2"], "gpus = 2"),
        (["--sweep", "learning_rate=1e-4", "--num-processes", "2"], "num_processes = 2: goes with --distributed"),
        (["--process", "1"], "process = 1: goes with --distributed"),
        (["--distributed", "auto", "--process", "1"], "process = 1: auto finds it out"),
    ],
)
def test_what_cannot_be_run_leaves_nothing(words, named, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "object_search", "--out", "new", *words]) == 2
    assert named in capsys.readouterr().err and not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("statuses", "status", "said"),
    [
        ([0, 2], 2, "infogoal: process 1 ended with status 2; what it said stands above\n"),
        ([-9, 130], 137, "infogoal: process 0 ended by signal 9\n"),
        ([0, 130], 130, ""),
    ],
)
def test_a_process_that_fails_is_no_stop(statuses, status, said, tmp_path, monkeypatch, capsys):
    """Its error counted as a signal, after which a script goes on for ever."""
    monkeypatch.setattr(executors, "run_in_processes", lambda *_: statuses)
    words = "train point_maze --seeds 2 --vmap-size 1 --processes 2 --out"
    assert main([*words.split(), str(tmp_path / "sweep")]) == status
    printed = capsys.readouterr()
    assert printed.err == said and ("Stopped. Go on with: " in printed.out) == (status == 130)


@pytest.mark.parametrize("flags", [[], ["--quiet"]])
def test_a_sweep_that_a_signal_stopped_says_so_by_its_status(flags, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "run_plan", lambda *_: executors.Outcome(stopped=True))
    words = "train point_maze --seeds 2 --vmap-size 1 --out"
    assert main([*words.split(), str(tmp_path / "sweep"), *flags]) == 130


def test_a_folder_that_holds_a_run_is_left_alone(tmp_path):
    training.run(CONFIG, [0], tmp_path / "run")
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    with pytest.raises(UserError, match="holds a run already"):
        run_plan(CONFIG, Plan([{}], [0, 1], 1), tmp_path / "run")
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}


def test_a_run_is_not_written_into_the_folder_of_a_sweep(tmp_path, capsys):
    """Which read as a run from then on."""
    jobs.start(CONFIG, Plan(combinations({"discount": [0.9]}), [0], 0), tmp_path / "sweep")
    assert main(["train", "point_maze", "--out", str(tmp_path / "sweep")]) == 2
    assert f"or go on with the sweep by --resume {tmp_path / 'sweep'}" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "sweep").iterdir()] == ["sweep.json"]


@pytest.mark.parametrize(
    ("config", "plan", "said"),
    [
        (CONFIG, Plan([{}], [0, 1, 2], 1), "seeds = [0, 1, 2]: "),
        (CONFIG, Plan([{}], [0, 1], 2), "seeds_at_once = 2: "),
        (CONFIG, Plan([{"discount": 0.5}], [0, 1], 1), "settings = [{'discount': 0.5}]: "),
        (hand_made.config("none", num_epochs=6, epochs_per_evaluation=2), Plan([{}], [0, 1], 1), "num_epochs"),
    ],
)
def test_a_folder_goes_on_with_its_own_plan_alone(config, plan, said, tmp_path):
    """Another one was trained beside it, and their runs were joined."""
    jobs.start(CONFIG, Plan([{}], [0, 1], 1), tmp_path / "run")
    with pytest.raises(UserError) as refused:
        run_plan(config, plan, tmp_path / "run", resume=True)
    assert said in str(refused.value) and "sweep.json" in str(refused.value)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["sweep.json"]
    with pytest.raises(UserError, match=r"holds no sweep.json"):
        run_plan(CONFIG, plan, tmp_path / "nowhere", resume=True)
    assert not (tmp_path / "nowhere").exists()


def test_what_is_of_no_part_is_not_deleted(tmp_path):
    def with_notes(words: str) -> None:
        (tmp_path / "run" / PARTS).mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / PARTS / "notes.txt").write_text("mine")

    with pytest.raises(UserError, match=r"parts = \['notes.txt'\]: is of no part"):
        run_plan(CONFIG, Plan([{}], [0, 1], 1), tmp_path / "run", say=with_notes)
    (tmp_path / "run" / PARTS / "notes.txt").unlink()
    run_plan(CONFIG, Plan([{}], [0, 1], 1), tmp_path / "run", resume=True, say=lambda words: None)
    assert configuration.read(tmp_path / "run").seeds == [0, 1]


def test_parts_are_written_through_no_link(tmp_path):
    plan = Plan([{}], [0, 1], 1)
    (tmp_path / "elsewhere").mkdir()
    jobs.start(CONFIG, plan, tmp_path / "run")
    (tmp_path / "run" / PARTS).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="is a link, through which nothing is written"):
        run_plan(CONFIG, plan, tmp_path / "run", resume=True)
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.fixture
def two_machines(tmp_path):
    """A cluster and its machines, whose workers log the parts that they begin."""
    with cluster_of_two("test_jobs.prepare_worker", {LOG: str(tmp_path / "begun"), "JAX_PLATFORMS": "cpu"}) as found:
        yield found


@pytest.mark.long
def test_a_sweep_of_48_runs_survives_the_loss_of_a_machine(two_machines, tmp_path):
    """Four settings of twelve seeds in parts of three: all there, none of them twice but what the lost machine had, and
    the bits are those of one process."""
    there, machines = two_machines
    plan = Plan(combinations({"learning_rate": [1e-4, 2e-4, 3e-4, 4e-4]}), list(range(12)), 3)
    run_plan(CONFIG, plan, tmp_path / "alone", say=lambda words: None)
    begun, folder = tmp_path / "begun", tmp_path / "cluster"

    def kill() -> None:
        while not begun.exists() or len(begun.read_text().splitlines()) < 6:
            time.sleep(0.02)
        there.remove_node(machines[0], allow_graceful=False)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    outcome = run_plan(CONFIG, plan, folder, execute=run_on_ray, say=lambda words: None)
    killer.join(60)
    assert not killer.is_alive() and len(outcome.finished) == len(jobs_of(CONFIG, plan)) == 16
    assert len(set(outcome.finished)) == 16 and not outcome.stopped
    for name in plan.names:
        assert same_run(folder / name, tmp_path / "alone" / name)
        assert configuration.read(folder / name).seeds == list(range(12))
    times = collections.Counter(line.split()[0] for line in begun.read_text().splitlines())
    assert sum(times.values()) <= 16 + 2  # What the machine had, once more.
    again = run_plan(CONFIG, plan, folder, resume=True, execute=run_on_ray, say=lambda words: None)
    assert not again.finished and not again.stopped


@pytest.mark.long
def test_several_processes_share_a_sweep(tmp_path):
    """By the command line, with its own program."""
    command = [sys.executable, "-m", "infogoal_jax", "train", "object_search", "--method", "her", *TINY.split()]
    command += ["--seeds", "2", "--vmap-size", "1", "--no-figures"]
    for name, flags in (("one", []), ("two", ["--processes", "2"])):
        done = subprocess.run([*command, "--out", str(tmp_path / name), *flags], capture_output=True, text=True)
        assert done.returncode == 0 and done.stdout.count("success rate") == 1, done.stdout + done.stderr
    for name in ("epochs.csv", "evaluations.csv"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_settings_are_named_by_as_many_digits_as_tell_them_apart():
    """Two that agreed to six were refused as one given twice. Names of settings that do not are as they were, so that
    their folders are found again."""
    plan = Plan(combinations({"discount": [0.9, 0.99999991, 0.99999992], "learning_rate": [1e-4, 1 / 3]}), [0], 0)
    jobs.check(CONFIG, plan)
    assert plan.names[::2] == [f"discount={value},learning_rate=0.0001" for value in (0.9, 0.99999991, 0.99999992)]
    assert plan.names[1] == "discount=0.9,learning_rate=0.333333"
    with pytest.raises(UserError, match="give each setting once"):
        jobs.check(CONFIG, Plan([{"discount": 0.9}, {"discount": 0.9}], [0], 0))


def test_a_job_says_what_it_is(tmp_path):
    names = [job.name for job in jobs_of(CONFIG, Plan(combinations({"discount": [0.9]}), [0, 1], 1))]
    assert names == [f"{CONFIG.task} discount=0.9/0-0", f"{CONFIG.task} discount=0.9/1-1"]
    assert [jobs_of(CONFIG, Plan([{}], seeds, 0))[0].name for seeds in ([0], [0, 1])] == [
        f"{CONFIG.task} 1 seed",
        f"{CONFIG.task} 2 seeds",
    ]
    assert json.dumps(names) and Place(tmp_path).left() == float("inf") and executors.LOSSES > 1
