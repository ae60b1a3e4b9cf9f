"""Whatever a configuration, a file of a run or a command line holds: it works, or one `UserError` says why not, within
30 seconds and without a change of any file."""

import contextlib
import dataclasses
import json
import re
import shutil
from pathlib import Path

import hand_made
import numpy as np
import pytest
from fuzzing import (
    TREE,
    command_lines,
    configurations,
    damaged,
    digest,
    examples_of,
    replaced,
    write_imports,
    write_run,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from places import forgotten

from infogoal_drone import cli as fly
from infogoal_jax import presets
from infogoal_jax.cli import main as command_line
from infogoal_jax.data import backgrounds, sentence_encoder
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import values_of
from infogoal_jax.report import runs
from infogoal_jax.runner import search as searching
from infogoal_jax.runner import training
from infogoal_jax.runs import checkpoint, configuration, tables
from infogoal_jax.runs.configuration import from_dict, to_dict
from infogoal_jax.runs.search import read_plan, read_trials
from infogoal_jax.stand_ins import cube, shelf
from infogoal_paper import command, goal_rendering, numbers

SHORT, LONG = 40, 4300
"""Inputs of this file; with those of test_fuzz_formats.py 10,000 in the long tests."""
SHARES = {"configurations": 0.5, "files": 0.35, "command lines": 0.15}


def examples(what: str, count: int) -> settings:
    """Settings of hypothesis for this part of so many inputs; short ones are the same each time."""
    return examples_of(round(SHARES[what] * count), short=round(SHARES[what] * SHORT))


each_count = pytest.mark.parametrize("count", [SHORT, pytest.param(LONG, marks=pytest.mark.long)])


@each_count
def test_a_configuration_is_one_or_is_refused(count):
    @examples("configurations", count)
    @given(configurations())
    def check(given_config):
        config, changes = given_config
        try:
            for path, value in changes:
                config = replaced(config, path, value)
        except UserError:
            return
        arrays = any(isinstance(value, np.ndarray) for value in values_of(config.hyper).values())
        if config.task in presets.TASKS and not arrays:  # Such runs can be kept.
            assert from_dict(json.loads(json.dumps(to_dict(config)))) == config

    check()


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz") / "a_run"
    write_run(folder)
    return folder


def go_on(folder: Path) -> None:
    """Read all that a run goes on from."""
    checkpoint.last_point(folder, configuration.read(folder), TREE)


READERS = (
    configuration.read,
    go_on,
    read_trials,
    read_plan,
    tables.read_timing,
    lambda folder: checkpoint.load(folder / "policy", TREE),
    lambda folder: tables.read_table(folder, "evaluations"),
)
FILES = ("config.json", "epochs.jsonl", "evaluations.jsonl", "checkpoint", "policy", "timing.json", "trials.jsonl")


@each_count
def test_a_file_is_read_or_refused_and_nothing_is_changed(count, run, tmp_path):
    @examples("files", count)
    @given(st.data())
    def check(data):
        folder = tmp_path / "damaged"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(run, folder)
        for name in data.draw(st.lists(st.sampled_from(FILES), min_size=1, max_size=2, unique=True)):
            (folder / name).write_bytes(data.draw(damaged((run / name).read_bytes())))
        before = digest(folder)
        for read in READERS:
            with contextlib.suppress(UserError):
                read(folder)
        assert digest(folder) == before

    check()


@each_count
def test_a_header_with_a_right_checksum_is_read_or_refused(count, run, tmp_path):
    header, _ = checkpoint.read_header(run / "checkpoint")
    names = [*header, *(f"config.{field.name}" for field in dataclasses.fields(hand_made.config()))]

    @examples("command lines", count)
    @given(st.sampled_from(names), st.none() | st.booleans() | st.integers() | st.text() | st.lists(st.integers()))
    def check(name, value):
        shutil.copytree(run, tmp_path / "run", dirs_exist_ok=True)
        changed = dict(header)
        if name.startswith("config."):
            changed["config"] = header["config"] | {name.removeprefix("config."): value}
        else:
            changed[name] = value
        checkpoint.save(tmp_path / "run" / "checkpoint", changed, TREE)
        with contextlib.suppress(UserError):
            go_on(tmp_path / "run")

    check()


class WorkBegins(BaseException):
    """The command would begin its work now."""


@pytest.fixture
def no_work(monkeypatch):
    """Commands stop where they would load data, compile, draw, download or build."""

    def accept(*arguments, **named):
        raise WorkBegins

    work = [(training, "run"), (searching, "tune"), (searching, "final")]
    work += [(runs, "make_train"), (cube, "build"), (shelf, "build")]
    work += [(goal_rendering, "build"), (backgrounds, "download_cifar10")]
    work += [(sentence_encoder, "embed_file"), (fly, "ask_to_take_off"), (fly, "depart")]
    work += [(command, "draw"), (numbers, "save")]
    for module, name in work:
        monkeypatch.setattr(module, name, accept)
    for engine in command.ENGINES:
        monkeypatch.setitem(command.ENGINES, engine, accept)
    monkeypatch.setattr("infogoal_jax.stand_ins.house.build_house", accept)
    monkeypatch.setattr("infogoal_jax.report.video.drawn_video", accept)


@each_count
def test_a_command_line_is_accepted_or_refused_and_nothing_is_changed(
    count, run, tmp_path, monkeypatch, no_work, capsys
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(run, tmp_path / "a_run")
    (tmp_path / "a_file").write_text("kept")
    write_imports(tmp_path)
    before = digest(tmp_path)

    @examples("command lines", count)
    @given(command_lines())
    def check(line):
        with forgotten(), contextlib.suppress(WorkBegins):
            try:
                status = command_line.main(line)
            except SystemExit as stopped:  # After a help.
                status = stopped.code
            said = capsys.readouterr().err
            assert status in (0, 1) or (status == 2 and re.fullmatch("infogoal: .*\n", said)), said
        capsys.readouterr()
        assert digest(tmp_path) == before

    check()
