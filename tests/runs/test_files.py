"""A file of a run that holds something else than what was written is refused in one sentence that names file, line,
field, value and remedy, and nothing is changed."""

import dataclasses
import json
import os
from pathlib import Path

import hand_made
import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from places import FIXTURES

from infogoal_jax import presets
from infogoal_jax.errors import UserError
from infogoal_jax.runs import checkpoint, configuration, tables
from infogoal_jax.runs.configuration import ADDED, Description, from_dict, to_dict
from infogoal_jax.runs.tables import Timing

WATCHED = {"agent/loss": 0.5, "agent/gradient_norm": 0.1}
ROWS = [{"seed": seed, "epoch": epoch, **WATCHED, "steps": [1]} for epoch in (1, 2) for seed in (0, 1)]
TREE = {"weight": np.arange(4.0)}


@pytest.fixture
def run(tmp_path) -> Path:
    """A folder with one file of each kind."""
    about = Description(hand_made.config(), [0, 1], "rooms", {"jax": "1"}, "cpu")
    configuration.write(tmp_path, about)
    tables.append_rows(tmp_path, "epochs", ROWS)
    tables.write_timing(tmp_path, Timing(1.0, 2.0, 3.0, 4.0))
    checkpoint.save(tmp_path / "checkpoint", {"epoch": 2, **about.values()}, TREE)
    return tmp_path


READERS = {
    "config.json": configuration.read,
    "epochs.jsonl": lambda folder: tables.read_table(folder, "epochs"),
    "timing.json": tables.read_timing,
    "checkpoint": lambda folder: checkpoint.load(folder / "checkpoint", TREE),
}
DAMAGES = {
    "empty": lambda content: b"",
    "not UTF-8": lambda content: b"\xff\xfe" + content,
    "NUL": lambda content: b"\0" + content,
    "cut": lambda content: content[: len(content) // 2] + b"\n",
    "deep": lambda content: b"[" * 100_000 + b"\n" + content,
    "list": lambda content: b"[1, 2]\n" + content,
    "text": lambda content: b"hello\n" + content,
    "blank": lambda content: b"\n" + content,
    "long number": lambda content: b"1" * 5000 + b"\n" + content,
}


HARMLESS = {("epochs.jsonl", "empty"), ("config.json", "blank"), ("timing.json", "blank")}
"""No rows yet, and what JSON allows."""


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", READERS)
def test_every_damage_is_one_sentence_that_names_the_file(name, damage, run):
    content = DAMAGES[damage]((run / name).read_bytes())
    (run / name).write_bytes(content)
    if (name, damage) in HARMLESS:
        READERS[name](run)
        return
    with pytest.raises(UserError, match=rf"{name}.*; .*(copy|train again|start)"):
        READERS[name](run)
    assert (run / name).read_bytes() == content


@pytest.mark.parametrize("name", READERS)
def test_a_folder_or_a_pipe_in_a_file_s_place_is_named(name, run):
    (run / name).unlink()
    os.mkfifo(run / name)
    with pytest.raises(UserError, match=f"{name}.*no regular file"):
        READERS[name](run)
    (run / name).unlink()
    (run / name).mkdir()
    with pytest.raises(UserError, match=f"{name}.*it is a folder"):
        READERS[name](run)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"seed": "a", "epoch": 1, "loss": 0.5, "steps": [1]}', "line 3: .*seed = 'a': expected int, got str"),
        ('{"seed": 0, "loss": 0.5, "steps": [1]}', "line 3: .*epoch is missing"),
        ('{"seed": 0, "epoch": 1, "loss": null, "steps": [1]}', "line 3: .*agent/loss = None: should be a number"),
        ('{"seed": 0, "epoch": 1, "steps": [1]}', "line 3: .*agent/gradient_norm is missing"),
        ('{"seed": 0, "epoch": 1, "loss": 0.5, "steps": [1, "a"]}', "line 3: .*steps = "),
        ('{"seed": 0, "epoch": 1, "loss": 0.5, "steps": [1], "x": 2}', "line 3: .*x is in this row and not in"),
        ('{"seed": 0, "epoch": 1, "loss": 0.5}', "line 3: .*steps is missing"),
        ('{"seed": 0, "epoch": 1, "loss": 0.5, "steps": [1, 2]}', r"line 3: .*steps = .*of the first row, \[1\]"),
        ('{"seed": 0, "epoch": 1, "loss": 0.5, "steps": [[1], [1, 2]]}', "line 3: .*steps = .* a list of numbers"),
        ("junk", "line 3: .*not JSON"),
        ("", "line 3: .*not JSON"),
    ],
)
def test_a_foreign_line_of_a_table_is_named(line, message, run):
    lines = (run / "epochs.jsonl").read_text().splitlines()
    line = line.replace('"loss"', '"agent/gradient_norm": 0.1, "agent/loss"')
    (run / "epochs.jsonl").write_text("\n".join([*lines[:2], line, *lines[2:]]) + "\n")
    with pytest.raises(UserError, match=message):
        tables.read_table(run, "epochs")


def leaves(values, path=()):
    """The place of every value within JSON values."""
    items = values.items() if isinstance(values, dict) else []
    for name, value in items:
        yield (*path, name)
        yield from leaves(value, (*path, name))


def changed(values: dict, path: tuple[str, ...], value) -> dict:
    """The JSON values with another one at this place; without it for `KeyError`."""
    name, *rest = path
    inner = changed(values[name], tuple(rest), value) if rest else value
    return {key: inner if key == name else old for key, old in values.items() if key != name or inner is not KeyError}


ADDED_NAMES = {name for fields in ADDED.values() for name in fields}
PLACES = list(leaves(to_dict(hand_made.config())))


@pytest.mark.parametrize("value", [KeyError, None, "text", {"a": [1]}, [[1]], 1e400], ids=str)
def test_a_wrong_value_at_any_depth_of_a_configuration_is_named(value):
    """Every field, those that were added yesterday too: taken away, or with a value of another type."""
    values = to_dict(hand_made.config())
    text = {path for path in PLACES if isinstance(value_at(values, path), str)}
    for path in PLACES:
        if value == "text" and path in text:
            continue  # Another name, or another path: of the right type.
        if value is KeyError and path[-1] in ADDED_NAMES:
            continue  # Files of earlier versions lack it.
        with pytest.raises(UserError, match=path[-1] if path[-1] != "name" else path[-2]):
            from_dict(changed(values, path, value))


@pytest.mark.parametrize("agent", ["dqn", "hrac"])
def test_runs_of_all_goals_from_before_a_field_was_there_are_read(agent):
    """What was added since has the value of what was done before; all goals were a relabelling, and LEO's learner had
    another name."""
    method = "leo" if agent == "dqn" else "infogoal+all_goals"
    config = presets.load("object_manipulation", method, agent=agent)
    values = to_dict(config)
    of_relabelling = {
        name: values["agent"].pop(name) for name in ("num_goals", "achieved_share", "desired_share", "code")
    }
    former = values | {"relabelling": {"name": "all_goals", **of_relabelling}}
    former["learner"] = former["learner"] | ({"name": "index"} if method == "leo" else {})
    del former["agent"]["all_goals"]
    assert from_dict(former) == config
    del former["relabelling"]["desired_share"], former["agent"]["layer_norm"]
    found = from_dict(former).agent
    assert (found.all_goals, found.num_goals, found.desired_share, found.layer_norm) == (True, 512, 0.0, False)


def value_at(values: dict, path: tuple[str, ...]):
    for name in path:
        values = values[name]
    return values


def test_runs_of_the_first_version_of_this_format_are_read():
    """Configurations of twelve methods as they were written when the format was new: a field that has been added since
    has the value that says what was done then."""
    lines = (FIXTURES / "configurations_of_format_2.jsonl").read_text().splitlines()
    configurations = [json.loads(line) for line in lines]
    for values in configurations:
        config = from_dict(values)
        now = to_dict(config)
        assert from_dict(json.loads(json.dumps(now))) == config
        for path in leaves(values):
            assert isinstance(value_at(values, path), dict) or value_at(now, path) == plain(value_at(values, path))
    found = [from_dict(values) for values in configurations]
    assert {config.agent.head for config in found if hasattr(config.agent, "head")} == {"concatenated"}
    assert {config.agent.critic for config in found if hasattr(config.agent, "critic")} == {"concatenated"}


def plain(value):
    """Lists as the tuples that a configuration has."""
    return tuple(value) if isinstance(value, list) else value


def test_an_unknown_field_is_named():
    values = to_dict(hand_made.config())
    with pytest.raises(UserError, match=r"learner.windw = 3: no such field. Known: .*window"):
        from_dict(values | {"learner": values["learner"] | {"windw": 3}})


@pytest.mark.parametrize("change", [{"epoch": 3}, {"epoch": -1}, {"seeds": [5]}, {"extra": 1}, {"data": "others"}])
def test_a_header_that_was_edited_does_not_have_its_checksum(change, run):
    first, _, payload = (run / "checkpoint").read_bytes().partition(b"\n")
    (run / "checkpoint").write_bytes(json.dumps(json.loads(first) | change).encode() + b"\n" + payload)
    with pytest.raises(UserError, match="checkpoint: is damaged.*does not have its checksum"):
        checkpoint.read_header(run / "checkpoint")


def test_every_kind_of_file_comes_back_as_it_was_written(run):
    about = configuration.read(run)
    assert about == Description(hand_made.config(), [0, 1], "rooms", {"jax": "1"}, "cpu")
    assert tables.read_table(run, "epochs") == ROWS and tables.read_timing(run) == Timing(1.0, 2.0, 3.0, 4.0)
    header, tree = checkpoint.load(run / "checkpoint", TREE)
    assert header["epoch"] == 2 and from_dict(header["config"]) == about.config
    np.testing.assert_array_equal(tree["weight"], TREE["weight"])
    assert dataclasses.replace(about, seeds=[0]) != about


def test_a_state_of_any_pytree_comes_back(tmp_path):
    """`mjx.Data`, which MuJoCo Playground and tasks of one's own have in their states, is unknown to flax."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mjx.make_data(model).replace(qpos=np.arange(7, dtype=np.float32))
    tree = {"env": (data, None), "key": jax.random.key(3), "seeds": [np.arange(3, dtype=np.int32)]}
    checkpoint.save(tmp_path / "checkpoint", {"epoch": 1}, tree)
    found = checkpoint.load(tmp_path / "checkpoint", jax.eval_shape(lambda: tree))[1]
    assert jax.tree.structure(found) == jax.tree.structure(tree)
    assert (jax.random.key_data(found.pop("key")) == jax.random.key_data(tree.pop("key"))).all()
    assert jax.tree.all(jax.tree.map(np.array_equal, found, tree))


def test_a_run_of_a_task_that_a_script_registers_is_not_called_damaged():
    values = to_dict(hand_made.config()) | {"task": "walled_square"}
    with pytest.raises(UserError, match="task = 'walled_square': no such task here; import the file that registers it"):
        from_dict(values)
