"""Tasks of a user's own on the command line: `--import my_task.py`, entry points, and what a run remembers of them."""

import json
import os
import pickle
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from zipfile import ZipFile

import hand_made
import pytest
from PIL import Image

from infogoal_jax import envs, imports, presets
from infogoal_jax.cli import main as command
from infogoal_jax.cli.main import main
from infogoal_jax.cli.training import with_synonyms
from infogoal_jax.envs.named import GymnasiumConfig
from infogoal_jax.errors import UserError
from infogoal_jax.runner.jobs import Plan, read_plan, start
from infogoal_jax.runs import configuration, tables

TASK = """
import dataclasses
import flax.struct
import hand_made
import jax.numpy as jnp
from infogoal_jax import envs, presets
from infogoal_jax.registry import Entry


@dataclasses.dataclass(frozen=True)
class RoomsConfig:
    episode_length: int = 8

    def check(self, config):
        pass


ROOMS = hand_made.environment()


@flax.struct.dataclass
class Drawn(type(ROOMS)):
    def draw(self, state):
        return jnp.full((4, 6, 3), 20 * state.time, jnp.uint8)


def make(config):
    return Drawn(**{field.name: getattr(ROOMS, field.name) for field in dataclasses.fields(ROOMS)})


envs.registry["my_rooms"] = Entry(RoomsConfig, make)
training = dict(num_epochs=2, epochs_per_evaluation=1, rollout_steps=8, num_envs=4, updates_per_epoch=2)
presets.registry["my_rooms"] = presets.Preset(
    agent="dqn", training=dict(**training, batch_size=8, buffer_steps=320), hyper={}, methods={}
)
"""


@pytest.fixture
def my_task(tmp_path, monkeypatch):
    """A file that registers a task."""
    (tmp_path / "my_task.py").write_text(TASK)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "my_task.py"


def forget():
    """As in a new process."""
    for name in imports.imported:
        sys.modules.pop(Path(name).stem, None)
    imports.imported.clear()
    for registry in (envs.registry, presets.registry):
        registry.pop("my_rooms", None)


def refused(words, capsys):
    """The one line that is printed for a command that fails."""
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_task_of_a_file_trains_and_its_run_says_which_file_it_needs(my_task, monkeypatch, capsys):
    """Everything a run promises is there, and it goes on. A run with updates is among the long tests of the command
    line."""
    hand_made.leave_out_updates(monkeypatch)
    words = "train my_rooms --method none --import my_task.py --out run"
    assert main(f"{words} --seeds 2 --tensorboard".split()) == 0
    assert "success rate" in capsys.readouterr().out
    run = my_task.parent / "run"
    written = [f"{table}{end}" for table in tables.TABLES for end in (".csv", ".jsonl")]
    for name in ("config.json", "timing.json", "checkpoint", "policy", "figures/learning_curves.png", *written):
        assert (run / name).stat().st_size > 0, name
    assert list(run.glob("events.out.tfevents*"))
    line = refused(words.split(), capsys)  # The folder holds a run.
    assert "--resume run" in line
    assert main("train --resume run --import my_task.py --num-epochs 3 --no-figures".split()) == 0
    assert main("pack run --out run.zip --import my_task.py".split()) == 0
    assert "for example: infogoal evaluate run.zip --import my_task.py\n" in capsys.readouterr().out
    assert imports.typed_command("train", "--resume", run) == f"infogoal train --resume {run} --import my_task.py"
    rows = (run / "evaluations.jsonl").read_text().splitlines()
    assert [json.loads(row)["epoch"] for row in rows] == [1, 1, 2, 2, 3, 3]
    description = json.loads((run / "config.json").read_text())
    assert description["imports"] == {"my_task.py": imports.checksums()["my_task.py"]}
    forget()
    Path("moved.py").write_text(TASK)
    assert main("pack run --out moved.zip --import moved.py".split()) == 0
    assert ZipFile("moved.zip").read("imports/my_task.py") == TASK.encode()
    forget()
    ran = my_task.parent / "ran"
    for folder in (run, run / "imports"):
        (folder / "other_task.py").write_text(f"open({str(ran)!r}, 'w')")
    capsys.readouterr()
    line = refused("evaluate run --starts 1".split(), capsys)
    assert "run/config.json: the run was made with my_task.py; if" in line and "--import run/imports/my_task.py" in line
    assert not ran.exists()  # Nothing runs because a folder names it or holds it.
    assert main("evaluate run --starts 1 --import=my_task.py".split()) == 0
    assert "test" in capsys.readouterr().out
    line = refused("evaluate run --corruption 0.4 --import my_task.py".split(), capsys)
    assert "goals of my_rooms are not images" in line
    assert main("video run --out episode.gif --height 40 --episodes 2".split()) == 0  # By the task's own `draw`.
    assert "episode.gif: 2 episodes of the policy of seed 0; the goal is reached in" in capsys.readouterr().out
    with Image.open("episode.gif") as video:
        assert video.size == (60, 40) and video.n_frames > 1
    forget()
    Path("other.py").write_text(TASK + "# Another task of this name.")
    line = refused("evaluate run --import other.py".split(), capsys)
    assert "run/config.json: the run was made with my_task.py; if" in line and "--import run/imports/my_task.py" in line
    forget()
    my_task.write_text(TASK + "# Changed.")
    line = refused("evaluate run --import my_task.py".split(), capsys)
    assert "made with another 'my_task.py'" in line
    forget()
    words = line.partition("give the file as it was: ")[2].split()
    assert main(["evaluate", "run", "--starts", "1", *words]) == 0
    forget()
    shutil.rmtree(run)
    line = refused("evaluate run.zip --starts 1".split(), capsys)
    assert main(["evaluate", "run.zip", "--starts", "1", *line.partition("is in it, give ")[2].split()]) == 0


def test_a_run_on_a_robot_that_a_file_registers_says_which_file_it_needs(my_task, capsys):
    """The task is that of the library, which is known without the file."""
    imports.import_file(my_task)
    config = presets.load("gymnasium", "none", env=GymnasiumConfig(id="Mine-v0"))
    configuration.write(Path("run"), configuration.Description(config, [0], "", {}, "cpu", imports=imports.checksums()))
    assert configuration.read(Path("run")).config == config
    forget()
    for words in ("evaluate run", "train --resume run"):
        assert "the run was made with my_task.py; if you trust" in refused(words.split(), capsys)


def test_a_sweep_says_which_file_it_needs(my_task, capsys):
    imports.import_file(my_task)
    plan = Plan([{"learning_rate": 1e-3}], seeds=[0], seeds_at_once=0)
    config = presets.load("my_rooms", "none")
    start(config, plan, Path("rates"))
    assert read_plan(Path("rates")) == (config, plan)
    assert refused("report rates".split(), capsys).endswith("is of a sweep; give one of its runs")
    Path("rates/of_one").mkdir()
    Path("rates/of_one/config.json").write_text("{}")
    such = "such as rates/of_one; `infogoal compare` takes all of them, rates/*=*/"
    assert refused("compare rates --out a.pdf".split(), capsys).endswith(such)
    shutil.rmtree("rates/of_one")
    forget()
    line = refused("train --resume rates".split(), capsys)
    assert "rates/sweep.json: the run was made with my_task.py" in line and "--import rates/imports/my_task.py" in line
    my_task.write_text(TASK + "# Changed.")
    assert "made with another 'my_task.py'" in refused("train --resume rates --import my_task.py".split(), capsys)


@pytest.mark.parametrize(
    ("content", "words", "said"),
    [
        (None, "--import gone.py", "import = 'gone.py': No such file or directory; give the file"),
        ("", "--import my_task.txt", "import = 'my_task.txt': give a file that ends in .py"),
        ("", "--import", "import = '': give the file"),
        ("1 +", "--import my_task.py", "line 1: SyntaxError"),
        ("import sys\nsys.exit(0)", "--import my_task.py", "import = 'my_task.py', line 2: SystemExit: 0; mend"),
        ("class E(Exception):\n    def __str__(self): 1 / 0\nraise E", "--import my_task.py", "line 3: E; mend"),
        ("a = 1\nb = c", "--import my_task.py", "import = 'my_task.py', line 2: NameError: name 'c' is not defined"),
    ],
)
def test_a_file_that_cannot_be_imported_is_one_line(content, words, said, my_task, capsys):
    if content is not None:
        my_task.write_text(content)
    assert said in refused(["methods", *words.split()], capsys)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero"), lambda path: path.mkdir()])
def test_what_is_no_regular_file_is_refused_at_once(make, my_task, capsys):
    my_task.unlink()
    make(my_task)
    assert "import = 'my_task.py': " in refused(["methods", "--import", "my_task.py"], capsys)


def test_a_file_that_fails_leaves_no_module_behind(my_task):
    my_task.write_text("1 / 0")
    with pytest.raises(UserError, match="ZeroDivisionError"):
        imports.import_file(my_task)
    assert "my_task" not in sys.modules and not imports.imported


def test_packages_register_tasks_by_an_entry_point(monkeypatch, capsys):
    loaded = []
    points = [
        SimpleNamespace(group="infogoal.plugins", name="mine", value="my_package", load=lambda: loaded.append("mine"))
    ]
    monkeypatch.setattr(imports, "entry_points", lambda group: points if group == "infogoal.plugins" else [])
    imports.import_installed()
    assert loaded == ["mine"]
    points[0].load = lambda: 1 / 0
    assert "infogoal.plugins: mine = 'my_package': ZeroDivisionError" in refused(["methods"], capsys)


def test_a_wrong_name_of_a_task_lists_what_the_help_lists(capsys):
    line = refused(["train", "objct_search"], capsys)
    assert "'object_search'" in line and f"Known: {', '.join(presets.registry)}; one of your own" in line


def test_flags_of_other_libraries_say_what_they_come_to(capsys):
    config = presets.load("object_search", num_envs=4, rollout_steps=10, num_epochs=6, epochs_per_evaluation=2)
    changed = with_synonyms(config, 1e-4, 250)
    assert changed.hyper.learning_rate == 1e-4 and changed.num_epochs == 6
    assert "240 environment steps at most: 6 epochs, 3 evaluations" in capsys.readouterr().out
    assert with_synonyms(config, None, 0) == config
    assert "total_steps = -1: give 0 or more" in refused("train object_search --total-steps -1".split(), capsys)
    for more in ("1" + "0" * 20, "1" + "0" * 400):
        assert "total_steps = 1000" in refused(f"train object_search --total-steps {more}".split(), capsys)
    assert "learns from recorded steps" in refused("train embodied_qa --total-steps 100".split(), capsys)


@pytest.mark.parametrize(
    "words",
    [
        "--lr 1e-3 --hyper.learning-rate 1e-4",
        "--lr=1e-3 --hyper.learning_rate=1e-3",
        "--total-steps 100 --num-epochs 3",
        "--lr 1e-3 --sweep learning_rate=1e-3,1e-4",
        "--sweep discount=0.9,0.95 --tensorboard",
        "--vmap-size 1 --wandb mine",
    ],
)
def test_a_flag_that_would_be_ignored_is_refused(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = refused(["train", "point_maze", *words.split()], capsys)
    assert any(said in line for said in ("give one of both", "leave one of both out", "goes with neither"))
    assert not os.listdir(tmp_path)


def test_commands_of_packages_that_fail_are_one_line(monkeypatch, capsys):
    point = SimpleNamespace(group="infogoal.commands", name="mine", value="my_package:mine", load=lambda: 1 / 0)
    monkeypatch.setattr(command, "entry_points", lambda group: [point] if group == point.group else [])
    assert "infogoal.commands: mine = 'my_package:mine': ZeroDivisionError" in refused(["mine"], capsys)


def test_another_process_imports_what_it_is_sent(my_task, monkeypatch):
    """As a worker of Ray does, on a machine without the file."""
    imports.import_file(my_task)
    my_task.write_text(TASK + "# More.\n")  # What ran is sent.
    checksums, sent = imports.checksums(), imports.contents()
    assert sent == {"my_task.py": TASK.encode()}
    forget()
    my_task.unlink()
    imports.import_contents(sent)
    assert imports.checksums() == checksums and "my_rooms" in presets.registry
    imports.import_contents(sent)  # A worker gets several jobs.


def test_the_configuration_of_a_registered_task_is_found_by_another_process():
    """By the name of its class, which a process that has registered the task has too, as a worker of Ray."""
    presets.register("a_maze", envs.load("point_maze"))
    config = envs.registry["a_maze"].config(radius=0.2)
    assert pickle.loads(pickle.dumps(config)) == config
