"""Hypothesis strategies for configurations, files of runs and command lines, made from the declarations: a field, a
flag or a command that is added is fuzzed without a line here."""

import contextlib
import dataclasses
import hashlib
import inspect
import json
import os
import typing
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import hand_made
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from tyro.conf import Positional

from infogoal_jax import agents, presets
from infogoal_jax.cli.commands import Group
from infogoal_jax.cli.main import BY_TASK
from infogoal_jax.cli.main import commands as all_commands
from infogoal_jax.errors import UserError
from infogoal_jax.runs import checkpoint, tables
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.search import Trial, TuneResult, write_plan, write_scores
from infogoal_jax.runs.tables import Timing

WHOLE = st.sampled_from([0, -1, 1, 2, 7, 2**31 - 1, 2**31, 2**32, 2**63, 10**20]) | st.integers()
REAL = st.sampled_from([0.0, -1.0, 1.0, 1e39, 1e308, float("inf"), float("nan")]) | st.floats()
TEXT = st.sampled_from(["", "x" * 300, "a\nb", "../..", "/dev/zero", "é", "\ud800", "--help"]) | st.text(max_size=8)
JSON = st.recursive(
    st.none() | st.booleans() | WHOLE | REAL | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=5,
)
ODD = st.sampled_from([np.float32(0.9), np.int64(4), np.float64(9.0), np.ones(2), object(), int, (), ((1,),), {1}])
WORDS = (
    WHOLE.map(str)
    | REAL.map(str)
    | st.sampled_from(
        [
            "",
            "x" * 300,
            "None",
            "True",
            "a_file",
            "a_run",
            "not_there",
            ".",
            "/dev/zero",
            "a_run/config.json",
            "é",
            "--",
            "-h",
        ]
    )
)

IMPORTS = ("--import", "--import=", "--import not_there.py", "--import a_file", "--import a_run", "--import task.py")
IMPORTS += ("--import pipe.py", "--import ends.py", "--import fails.py", "--import=task.py --import task.py")


def examples_of(count: int, short: int) -> settings:
    """Settings of hypothesis for so many inputs, each within half a minute; as many as `short` are the same each
    time."""
    return settings(
        max_examples=count,
        deadline=timedelta(seconds=30),
        derandomize=count == short,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def places(record: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The path and the declared type of every field of a configuration, and of the records in it."""
    hints = typing.get_type_hints(type(record))
    for field in dataclasses.fields(record):
        value, here = getattr(record, field.name), (*path, field.name)
        yield here, hints[field.name]
        if dataclasses.is_dataclass(value):
            yield from places(value, here)


def replaced(record: Any, path: tuple[str, ...], value: Any) -> Any:
    """The configuration with another value at this path; `AttributeError` where another change took the record away."""
    name, *rest = path
    return dataclasses.replace(record, **{name: replaced(getattr(record, name), tuple(rest), value) if rest else value})


def values_of(hint: Any) -> st.SearchStrategy:
    """Values of a declared type, near the ends of what a program can hold."""
    if hint is Any or dataclasses.is_dataclass(hint):
        return st.nothing()
    return REAL if hint is float else WHOLE if hint is int else st.from_type(hint)


@st.composite
def configurations(draw) -> tuple[Any, list[tuple[tuple[str, ...], Any]]]:
    """The preset of a task, a method and an agent, and up to three changes of its fields: values of their type, and of
    others."""
    config = presets.load(draw(st.sampled_from(presets.TASKS)), "none")
    method, agent = draw(st.sampled_from(list(presets.METHODS))), draw(st.none() | st.sampled_from([*agents.registry]))
    with contextlib.suppress(UserError):  # Methods that do not go with the task keep the bare agent.
        config = presets.load(config.task, method, agent=agent)
    known = list(places(config))
    changes = []
    for _ in range(draw(st.integers(1, 3))):
        path, hint = draw(st.sampled_from(known))
        changes.append((path, draw(values_of(hint) | WHOLE | REAL | JSON | ODD)))
    return config, changes


def leaves(values: Any, path: tuple = ()) -> Iterator[tuple]:
    """The place of every value within JSON values."""
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for name, value in items:
        yield (*path, name)
        yield from leaves(value, (*path, name))


@st.composite
def damaged(draw, content: bytes) -> bytes:
    """A file of JSON (or with a first line of it) with another value somewhere, or with bytes of nobody's."""
    first, newline, rest = content.partition(b"\n") if draw(st.booleans()) else (content, b"", b"")
    try:
        values = json.loads(first)
    except (ValueError, RecursionError):
        values = None
    if (found := list(leaves(values))) and draw(st.booleans()):
        *path, name = draw(st.sampled_from(found))
        inner = values
        for step in path:
            inner = inner[step]
        if draw(st.booleans()):
            inner[name] = draw(JSON)
        else:
            del inner[name]
        return json.dumps(values).encode() + newline + rest
    start = draw(st.integers(0, len(content)))
    length = draw(st.integers(0, 40))
    noise = draw(
        st.binary(max_size=20) | st.sampled_from([b"\n", b"\0", b"\xff", b"[" * 100_000, b"\n{}\n", b"1" * 5000])
    )
    return content[:start] + noise + content[start + length :]


def commands(group: Group | None = None, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The words and the function of every command."""
    for name, command in (group or all_commands()).commands.items():
        if isinstance(command, Group):
            yield from commands(command, (*words, name))
        else:
            yield (*words, name), command


def flags_of(command: Any) -> tuple[list[str], int]:
    """The flags of a command's function, and how many words it takes without one."""
    flags, positional = [], 0
    for name, parameter in inspect.signature(command).parameters.items():
        metadata = getattr(parameter.annotation, "__metadata__", ())
        if dataclasses.is_dataclass(parameter.default):  # Its fields are flags of their own.
            flags += [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(parameter.default)]
            continue
        if any(marker in metadata for marker in getattr(Positional[str], "__metadata__", ())):
            positional += 1
        elif name not in ("parts", "config", "command"):
            flags.append(f"--{name.replace('_', '-')}")
    return flags, positional


@st.composite
def command_lines(draw) -> list[str]:
    """The words of a command and some of its flags, with words that may be values."""
    words, command = draw(st.sampled_from(list(commands())))
    flags, positional = flags_of(command)
    line = list(words)
    if words[0] in BY_TASK:
        task = draw(st.sampled_from(presets.TASKS))
        line.append(task)
        config = presets.load(task)
        flags += ["--" + ".".join(path).replace("_", "-") for path, _ in places(config) if path != ("task",)]
        flags += [f"--{kind}" for kind in ("method", *presets.REGISTRIES)]
    if draw(st.integers(0, 9)) == 0:
        given = draw(st.sampled_from(IMPORTS)).split()
        line = [*given, *line] if draw(st.booleans()) else [*line, *given]
    line += [draw(WORDS) for _ in range(draw(st.integers(0, positional + 1)))]
    for _ in range(draw(st.integers(0, 3)) if flags else 0):
        line += [draw(st.sampled_from(flags)), *draw(st.lists(WORDS, max_size=2))]
    return line


TREE = {"weight": np.arange(4.0)}
"""What the checkpoints of `write_run` hold."""


def write_imports(folder: Path) -> None:
    """The files that `IMPORTS` names and that are there."""
    for name, content in {"task.py": "", "ends.py": "raise SystemExit(0)", "fails.py": "1 / 0"}.items():
        (folder / name).write_text(content)
    os.mkfifo(folder / "pipe.py")


def write_run(folder: Path) -> None:
    """A folder with a file of every kind: of a run, and of a search."""
    config = hand_made.config(num_epochs=2, epochs_per_evaluation=1)
    about = Description(config, [1000, 1001], "rooms", {"jax": "1"}, "cpu")
    rows = [
        {"seed": seed, "epoch": epoch, "loss": 0.5, "agent/loss": 1.0, "agent/gradient_norm": 1.0, "steps": [1, 2]}
        for epoch in (1, 2)
        for seed in (1000, 1001)
    ]
    folder.mkdir()
    trial = Trial(0, {"discount": 0.9}, [[0.0, 1.0]] * 2, [[0.1, 0.2]] * 2)
    found = TuneResult(about, "train", [trial])
    write_plan(folder, found)
    write_scores(folder, found)
    for table in tables.TABLES:
        tables.append_rows(folder, table, rows)
    tables.write_timing(folder, Timing(1.0, 2.0, 3.0, 4.0))
    checkpoint.save(folder / "checkpoint", {"epoch": 2, **about.values()}, TREE)
    checkpoint.save(folder / "policy", {"epoch": 2, **about.values()}, TREE)


def digest(folder: Path) -> str:
    """What tells a folder, with all that is in it, from another."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        found.update(f"{path.relative_to(folder)} {path.is_file()}".encode())
        found.update(path.read_bytes() if path.is_file() else b"")
    return found.hexdigest()
