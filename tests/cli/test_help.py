"""The help of every command fits a screen, names what there is, and comes quickly."""

import dataclasses
import subprocess
import sys

import pytest

import infogoal_jax
from infogoal_jax import agents, envs, presets
from infogoal_jax.cli.main import main
from infogoal_jax.hyperparameters import floats
from infogoal_jax.presets import load

SCREEN = 45
"""Lines."""


@pytest.fixture
def help_of(capsys, monkeypatch):
    """What is printed for these arguments, which ask for a help."""
    monkeypatch.setenv("COLUMNS", "120")

    def printed(arguments: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            main(arguments.split())
        assert stopped.value.code == 0
        return capsys.readouterr().out

    return printed


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("", ["train", "evaluate", "report", "data", "final", "--version"]),
        ("train", [*presets.registry, "--resume"]),
        (
            "train object_search",
            [
                "--seeds",
                "--num-epochs",
                "--method",
                "--agent",
                ", ".join(agents.registry),
                "--help-all",
                "default: 100",
            ],
        ),
        ("train fetch_push --method her", ["default: her", "--relabelling", "default: hrac"]),
        ("tune object_search", ["--trials", "--space-seed", "--help-all"]),
        ("data build", ["house", "cube", "shelf", "backgrounds", "fetch"]),
        ("evaluate", ["RUN", "--starts", "default: 50"]),
        ("pretrain fetch_push", ["--evaluation-episodes", "--hyper.discount"]),
    ],
)
def test_help_fits_a_screen_and_names_what_there_is(arguments, expected, help_of):
    text = help_of(f"{arguments} --help")
    assert all(words in text for words in expected) and "--task" not in text
    assert text == help_of(f"{arguments} -h") and (len(text.splitlines()) <= SCREEN or arguments.startswith("pretrain"))


def test_the_help_of_all_flags_has_every_field_and_the_interval_of_every_number(help_of):
    text = " ".join(help_of("train object_search --learner vae --agent cql --help-all").replace("│", " ").split())
    config = load("object_search", learner="vae", agent="cql")
    fields = {
        f"{kind}.{field.name}"
        for kind in ("env", "learner", "agent", "state_encoder")
        for field in dataclasses.fields(getattr(config, kind))
    }
    for name in fields:
        assert f"--{name.replace('_', '-')}" in text
    for name, value, number in floats(config.hyper):
        assert f"--hyper.{name.replace('_', '-')} FLOAT" in text
        assert f"(in {number.interval}, default: {value})" in text


def test_a_task_that_is_registered_later_is_a_subcommand(monkeypatch, help_of):
    monkeypatch.setitem(envs.registry, "mine", envs.registry["object_search"])
    monkeypatch.setitem(
        presets.registry,
        "mine",
        dataclasses.replace(presets.registry["object_search"], description="A task of my own."),
    )
    assert "A task of my own." in help_of("train --help")
    assert "A task of my own." in help_of("train mine --help")


def test_help_and_the_version_come_without_jax():
    code = """
import sys
from infogoal_jax.cli.main import main
assert main(["--version"]) == 0
for words in ("", "--help", "train --help", "tune -h", "data --help", "evaluate --help", "methods --help"):
    try:
        main(words.split())
    except SystemExit as stopped:
        assert stopped.code == 0
assert not {"jax", "flax", "numpy", "scipy"} & {*sys.modules}
"""
    assert (
        infogoal_jax.__version__
        in subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    )
