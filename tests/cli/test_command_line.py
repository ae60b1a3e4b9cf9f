"""The command line: a newcomer is understood, and a mistake is named with its field, its value and the remedy, before
anything is compiled."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys

import jax
import pytest
from places import TINY

import infogoal_jax
from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.presets import load
from infogoal_jax.presets.loading import train_flags
from infogoal_jax.runner import compilation, training
from infogoal_jax.runs import configuration, tables
from infogoal_jax.runs.configuration import Description, from_dict, to_dict


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def no_compilation(monkeypatch):
    """Make ahead-of-time compilation of the training program fail the test."""
    monkeypatch.setattr(compilation, "is_known", lambda option, value: True)  # It compiles nothing, to find out.

    def refuse(*arguments, **options):
        raise AssertionError("compiled before the mistake was found")

    monkeypatch.setattr(jax.stages.Lowered, "compile", refuse)


MISTAKES = [
    ("train objct_search", ["task", "objct_search", "Did you mean 'object_search'"]),
    ("train my_rooms", ["task = 'my_rooms': no such task", "one of your own is registered first: --import FILE"]),
    ("train object_search --method infogaol", ["method", "infogaol", "Did you mean 'infogoal'"]),
    ("train object_search --seeds 0", ["seeds = 0", "at least 1"]),
    ("train point_maze --small", ["small = True: point_maze has no small preset", "Known: object_search"]),
    ("train object_search --env.dataset HOUSE --seeds 100000", ["seeds = 100000", "at most"]),
    (
        "train object_search --env.dataset HOUSE --evaluation-starts 1000000000",
        ["evaluation_starts = 1000000000", "GiB", "such as 10"],
    ),
    ("train object_search --seeds 99999999999999999999", ["seeds = ", "below 2^32"]),
    (
        "train object_search --env.dataset HOUSE --learner.num-pairs 1000000000",
        ["learner.num_pairs = 1000000000", "GiB", "such as 256"],
    ),
    (
        "train object_search --env.dataset HOUSE --learner.latent-size 100000000",
        ["learner.latent_size = 100000000", "such as 32"],
    ),
    ("train object_search --updates-per-epoch 99999999999999999999", ["updates_per_epoch = 99999999999999999999"]),
    ("train object_search --env.image-size 1000000000", ["env.image_size = 1000000000", "at most 512"]),
    ("tune object_search --space-seed 99999999999999999999", ["space_seed = ", "below 2^32"]),
    ("evaluate not_there --starts 99999999999", ["starts = 99999999999"]),
    ("evaluate not_there --start-seed 99999999999999999999", ["start_seed = "]),
    ("data build cube a.npz --seed -1", ["seed = -1", "below 2^32"]),
    (f"train object_search --out {'x' * 300}", ["could not be written", "shorter path"]),
    (f"data check {'x' * 300}", ["path = 'xxx", "File name too long; give a shorter path"]),
    (f"train object_search --env.dataset={'x' * 300}/y", ["env.dataset = 'xxx", "give a shorter path"]),
    (f"reproduce table1 --known {'x' * 300}", ["known = 'xxx", "give a shorter path"]),
    ("train object_search --first-seed -1", ["seeds = '-1 to -1'", "from 0 to below"]),
    ("report a_file", ["a_file", "could not be read"]),
    ("train --seeds 2 object_search", ["name the task first: infogoal train object_search --seeds 2"]),
    ("--seeds 2 train object_search", ["'--seeds': flags come after the command", "Known: train"]),
    ("data --seed 1 build house a", ["data '--seed': flags come after the command", "Known: check"]),
    ("tune --seeds 2", ["name the task first: infogoal tune TASK --seeds 2", "Known: object_search"]),
    ("train object_search --num-envs 0", ["num_envs = 0", "greater than 0"]),
    ("train object_search --num-epochs 25", ["num_epochs = 25", "multiple of epochs_per_evaluation = 10", "give 20"]),
    ("train object_search --buffer-steps 10", ["buffer_steps = 10", "3200"]),
    ("train object_search --learner.window 101", ["learner.window = 101", "episode length, 100"]),
    (
        "train object_search --learner.loss ratio --learner.score bilinear",
        ["learner.loss = 'ratio'", "--learner.score distance"],
    ),
    ("train object_search --agent.num-steps 0", ["agent.num_steps = 0", "between 1 and"]),
    ("train object_search --hyper.discount 1.5", ["hyper.discount = 1.5", "[0, 1)"]),
    ("train object_search --hyper.learning-rate nan", ["hyper.learning_rate = nan", "finite"]),
    ("train object_search --env.image-size 30", ["env.image_size = 30", "multiple of state_encoder.patch = 8"]),
    ("train object_search --env.min-box-size 2", ["env.min_box_size = 2.0", "from 0 to below 1"]),
    ("train object_search --env.dataset not_there", ["not_there"]),
    ("train object_search --env.dataset HOUSE --env.scenes Home_999_1", ["Home_999_1", "Home_101_1"]),
    ("train object_search --env.split not_there.json", ["not_there.json"]),
    ("train object_search --env.dataset HOUSE --env.min-box-size 0.9", ["min_box_size"]),
    ("train object_search --env.text-embeddings not_there.npz", ["not_there.npz"]),
    ("train object_search --resume .", ["resume = '.': holds no config.json"]),
    ("train object_search --out a_file/run", ["a_file/run", "could not be written", "does not lead through a file"]),
    ("trian object_search", ["trian", "Did you mean 'train'"]),
    ("evaluate not_there", ["run = 'not_there': there is no such folder"]),
    ("evaluate ~not_there/run", ["run = '~not_there/run': there is no such folder"]),
    ("tune --resume not_there", ["resume = 'not_there'", "`infogoal tune` or `infogoal final`"]),
    ("final --resume not_there", ["resume = 'not_there'", "`infogoal tune` or `infogoal final`"]),
    ("compare --out a.png", ["runs = ()", "give at least one folder of a run"]),
    ("reproduce table1 --known not_there", ["known = 'not_there'", "infogoal reproduce merge"]),
    ("final --resume not_there --trials 3", ["--trials: a final that goes on has its own"]),
    ("report not_there", ["run = 'not_there'"]),
    ("evaluate not_there --test-epsilon 3", ["test_epsilon = 3.0", "a probability from 0 to 1"]),
    ("evaluate not_there --corruption 1.5", ["corruption = 1.5", "from 0 to 1"]),
    ("video fetch_reach --out a.mp4 --corruption 0.4", ["corruption = 0.4", "random policy"]),
    ("video fetch_reach --out a.avi", ["out = 'a.avi'", ".mp4 or .gif"]),
    ("video fetch_reach --out not_there/a.mp4", ["out = 'not_there/a.mp4'", "make it first"]),
    ("video runs/not_there --out a.mp4", ["run = 'runs/not_there'", "no such folder"]),
    ("train fetch_slide", ["fetch_slide", "no preset", "fetch_push"]),
    ("train object_search --method index", ["method = 'index'", "no such method", "leo"]),
    ("train object_search --relabelling.num-goals 3", ["no such flag", "Did you mean '--agent.num-goals'?"]),
    ("train fetch_reach --env.backgrounds not_there", ["backgrounds = 'not_there'", "give a folder of images"]),
    ("methods her", ["task = 'her': is a method", "infogoal methods TASK her"]),
    ("record somewhere --simulate --size 0 0", ["size = (0, 0)", "such as 48 64"]),
    ("reproduce table1 --list --out a_file/x", ["out = 'a_file/x'", "a_file is a file"]),
    ("data build castle somewhere", ["castle", "Known: house"]),
    ("data build house a_folder", ["a_folder", "not empty"]),
    ("data chekc somewhere", ["chekc", "Did you mean 'check'"]),
    ("data embed --out file.npz", ["text"]),
    ("train object_search --lr abc", ["lr = 'abc': give a number (see infogoal train object_search --help)"]),
    ("train object_search --hyper.learning-rate=abc", ["hyper.learning_rate = 'abc': give a number"]),
    ("train object_search --seeds 1e3", ["seeds = '1e3': give a whole number"]),
    ("train object_search --seeds 2 --seeds", ["seeds: no value follows; give a whole number"]),
    ("train object_search --method", ["method: no value follows", "infogoal train --help"]),
    ("train object_search --known-goals vistied", ["give train, held_out, visited or all. Did you mean 'visited'"]),
    ("train object_search --learner.windw 3", ["--learner.windw: there is no such flag. Did you mean '--learner.wind"]),
    ("train object_search --task fetch_push", ["--task: there is no such flag (see"]),
    ("tune object_search --small", ["--small: there is no such flag (see infogoal tune object_search --help)"]),
    ("train object_search --seed 3", ["--seed: there is no such flag. Did you mean '--seeds'"]),
    ("train object_search --epochs 3", ["--epochs: there is no such flag. Did you mean '--num-epochs'"]),
    ("train object_search --hidden 8", ["--hidden: there is no such flag. Did you mean '--"]),
    ("train object_search --imprt my_task.py", ["--imprt: there is no such flag. Did you mean '--import'?"]),
    ("report run --imports=my_task.py", ["--imports: there is no such flag. Did you mean '--import'?"]),
    ("video fetch_reach --out a.gif --height 1", ["height = 1: give 64 to 1620 pixels"]),
    ("train point_maze --sweep --seeds 2", ["sweep: no value follows; give at least one, or leave the flag out"]),
    ("compare run --out a.png --labels", ["labels: no value follows"]),
    ("reproduce all_goals --known-goals --list", ["known_goals: no value follows"]),
    ("reproduce table1 --sets --list", ["sets: no value follows; give at least one, or leave the flag out"]),
    ("reproduce table1 --sets 1 b", ["sets = '1 b': give a whole number"]),
    ("train push", ["task = 'push'", "Did you mean 'fetch_push'?"]),
    ("train object_search 3", ["'3': no flag takes it; leave it out"]),
    ("train object_search --agent.hidden --seeds 1", ["agent.hidden = (): give widths greater than 0"]),
    ("pretrain fetch_push --resume auto", ["resume = 'auto': name the folder of the run"]),
    ("pretrain fetch_push --seeds x", ["seeds = 'x'", "infogoal pretrain fetch_push --help"]),
    ("evaluate run --starts", ["starts: no value follows", "infogoal evaluate --help"]),
    ("evaluate run --corruption much", ["corruption = 'much': give a number"]),
    ("export run --seed x --out a.npz", ["seed = 'x': give a whole number"]),
    ("export run", ["out: is missing; give it"]),
    ("report run --format bmp", ["format = 'bmp': give png, pdf or svg"]),
    ("data build cube", ["PATH: is missing; give it", "infogoal data build cube --help"]),
    ("record somewhere --size 3", ["size: too few values follow; give 2 whole numbers"]),
    ("record somewhere --size 3 x", ["size = '3 x': give 2 whole numbers"]),
    ("reproduce table1 --engine slurm", ["engine = 'slurm': give processes or ray"]),
]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        pytest.param(words, expected, id=words[:80], marks=pytest.mark.long if "num-pairs" in words else [])
        for words, expected in MISTAKES
    ],
)
def test_a_mistake_is_named_with_its_value_and_the_remedy(
    arguments, expected, tiny_house, tmp_path, capsys, no_compilation
):
    (tmp_path / "a_file").write_text("kept")
    (tmp_path / "a_folder").mkdir()
    (tmp_path / "a_folder" / "kept").write_text("kept")
    status = main(arguments.replace("HOUSE", str(tiny_house)).split())
    printed = capsys.readouterr().err
    assert status == 2
    assert printed.startswith("infogoal: ") and printed.count("\n") == 1
    for words in expected:
        assert words in printed
    assert (tmp_path / "a_file").read_text() == (tmp_path / "a_folder" / "kept").read_text() == "kept"
    assert not (tmp_path / "runs").exists()


def test_small_is_the_preset_for_first_trials_and_what_a_run_that_goes_on_has_already(tmp_path, monkeypatch, capsys):
    asked = []

    def run(config, *others, **named):
        asked.append(config)
        raise UserError("that is enough")

    monkeypatch.setattr(training, "run", run)
    small = load("object_search", "her", small=True)
    flags = train_flags(load("object_search", small=True))
    assert main("train object_search --small --method her --seeds 2".split()) == 2
    assert main("train object_search --small --method her --batch-size 32".split()) == 2
    assert main(["train", "object_search", *flags]) == 2
    assert asked == [small, dataclasses.replace(small, batch_size=32), load("object_search", small=True)]
    (tmp_path / "first").mkdir()
    configuration.write(tmp_path / "first", Description(small, [0], "a house", {}, "cpu"))
    assert main("train --resume first --small".split()) == 2
    assert "--small: a run that goes on has its own; leave the flag out" in capsys.readouterr().err


def test_resume_auto_goes_on_with_the_newest_run_or_starts_one(tmp_path, monkeypatch, capsys):
    """Of this configuration and these seeds, or that in --out."""
    asked = []

    def run(config, seeds, folder, resume, *listeners, **named):
        asked.append((str(folder), resume, list(seeds)))
        raise UserError("that is enough")

    monkeypatch.setattr(training, "run", run)
    started = Description(load("object_search", num_epochs=200), [0, 1], "a house", {}, "cpu")
    assert main("train object_search --seeds 2 --resume auto".split()) == 2
    (tmp_path / "runs" / "first").mkdir(parents=True)
    configuration.write(tmp_path / "runs" / "first", started)
    assert main("train object_search --seeds 2 --resume auto".split()) == 2
    assert main("train object_search --seeds 2 --resume auto --batch-size 32".split()) == 2
    assert main("train object_search --seeds 2 --resume auto --out runs/mine".split()) == 2
    assert main("train object_search --seeds 2 --resume auto --out runs/first".split()) == 2
    assert main("train --resume runs/first --out runs/mine".split()) == 2
    assert "out = 'runs/mine': what is resumed stays in its folder, runs/first" in capsys.readouterr().err
    assert not (tmp_path / "runs" / "mine").exists()
    for typed in ("", " --seeds 1", " --first-seed 3"):
        assert main(f"train --resume runs/first{typed}".split()) == 2
    new, continued, other, mine, first, *typed = asked
    assert [seeds for _, _, seeds in typed] == [[0, 1], [0], [3, 4]]  # The last two are refused by `training.run`.
    assert not new[1] and not other[1] and new[0] != "runs/first" != other[0]
    assert continued == first == ("runs/first", True, [0, 1]) and mine == ("runs/mine", False, [0, 1])


def test_a_dataset_cut_short_is_named_with_the_command_that_lists_what_is_wrong(
    tiny_house, tmp_path, capsys, no_compilation
):
    shutil.copytree(tiny_house, tmp_path / "house")
    image = sorted((tmp_path / "house" / "Home_101_1" / "jpg_rgb").iterdir())[5]
    image.write_bytes(image.read_bytes()[:100])
    assert main(["train", "object_search", "--env.dataset", "house"]) == 2
    assert "infogoal data check" in capsys.readouterr().err
    assert main(["data", "check", "house"]) == 2
    assert re.search(r"house: (1 error|\d+ errors), (1 warning|\d+ warnings)\n", capsys.readouterr().out)


def test_an_object_that_the_dataset_does_not_have_is_named(tmp_path, capsys, no_compilation):
    """More goals in the split than the dataset has."""
    split = {
        "objects": {
            "red_bul": {"room": "kitchen", "use": "train"},
            "advil_liqui_gels": {"room": "kitchen", "use": "test"},
        }
    }
    (tmp_path / "split.json").write_text(json.dumps(split))
    assert main(["train", "object_search", "--env.split", "split.json"]) == 2
    assert "red bul" in capsys.readouterr().err.replace("_", " ")


def test_no_traceback_and_a_failing_exit_status_in_a_process_of_its_own():
    command = [sys.executable, "-m", "infogoal_jax", "train", "object_search", "--hyper.epsilon", "3"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert "hyper.epsilon = 3.0" in done.stderr and "Traceback" not in done.stderr


def test_names_of_the_package_are_imported_when_they_are_asked_for():
    assert {*infogoal_jax.__all__} <= {*dir(infogoal_jax)} and all(
        getattr(infogoal_jax, name) for name in infogoal_jax.__all__
    )
    with pytest.raises(AttributeError, match="nothing_of_that_name"):
        _ = infogoal_jax.nothing_of_that_name


def test_a_configuration_comes_back_from_its_json():
    for method in ("infogoal", "none"):
        config = load("object_search", method, num_envs=7)
        assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


@pytest.mark.long
def test_train_evaluate_and_report_from_the_command_line(tiny_house, tmp_path, capsys):
    """A small house, two seeds: everything a run promises is there, and the run can be resumed."""
    flags = f"--method none --env.dataset {tiny_house} {TINY}"
    assert main(f"train object_search --seeds 2 --out run --tensorboard {flags}".split()) == 0
    printed = capsys.readouterr().out
    assert "a stand-in" in printed and "success rate" in printed
    run = tmp_path / "run"
    written = [f"{table}{end}" for table in tables.TABLES for end in (".csv", ".jsonl")]
    for name in ("config.json", "timing.json", "checkpoint", "policy", *written):
        assert (run / name).stat().st_size > 0, name
    assert (run / "figures" / "learning_curves.png").exists()
    assert list(run.glob("events.out.tfevents*"))
    assert main(["evaluate", "run", "--starts", "2"]) == 0
    assert re.search(r"evaluating +[0-9.]+ s\n", capsys.readouterr().out)
    assert main(["evaluate", "run", "--corruption", "0.4"]) == 2
    assert "goals of object_search are not images" in capsys.readouterr().err
    assert main(["video", "run", "--out", "a.mp4"]) == 0 and (tmp_path / "a.mp4").stat().st_size > 0
    assert main("train --resume run --num-epochs 3 --no-figures".split()) == 0
    rows = (run / "evaluations.jsonl").read_text().splitlines()
    assert [json.loads(row)["epoch"] for row in rows] == [1, 1, 2, 2, 3, 3]
    capsys.readouterr()
    assert main(f"train object_search --out run {TINY}".split()) == 2  # The folder holds a run.
    assert "--resume run" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--resume", ""], ["--out="], ["--env.dataset", ""], ["--wandb="], ["--seeds", ""]])
def test_an_empty_word_is_not_one_that_is_left_out(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "object_search", *words]) == 2
    field = words[0].strip("-=")
    assert f"{field} = '': is empty; give a value, or leave it out" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_folder_of_the_user_is_known_behind_a_flag_too(tmp_path, monkeypatch, capsys):
    """A shell leaves `--out=~/run` as it is."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("mine")
    assert main(["train", "object_search", "--out=~/run"]) == 2
    assert f"out = '{tmp_path}/run': holds a run already" in capsys.readouterr().err
    assert main(["evaluate", "~/run"]) == 2
    assert f"{tmp_path}/run/config.json: is damaged" in capsys.readouterr().err


def test_the_run_in_a_folder_comes_before_the_task_of_its_name(tmp_path, monkeypatch, capsys):
    """`infogoal train fetch_reach --out fetch_reach` leaves such a folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fetch_reach").mkdir()
    (tmp_path / "fetch_reach" / "config.json").write_text("{")
    assert main(["video", "fetch_reach", "--out", "episode.mp4"]) == 2
    assert "config.json: is damaged" in capsys.readouterr().err


def test_an_error_is_one_line_that_a_narrow_terminal_breaks_between_words(monkeypatch, capsys):
    assert main(["train", "objct_search"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["train", "objct_search"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert max(map(len, lines)) <= 60 and " ".join(lines) == line
