"""A run that was stopped goes on to the same bits; a checkpoint that is damaged or of another configuration is refused;
nothing on disk is lost. Runs are killed in test_signals.py and in runs/test_folder.py."""

import dataclasses
import json
import os
import shutil
import signal
import time

import hand_made
import jax
import jax.numpy as jnp
import killed_run
import numpy as np
import pytest
from killed_run import same_run, small_config

from infogoal_jax.errors import UserError
from infogoal_jax.runner import training
from infogoal_jax.runs import checkpoint, tables
from infogoal_jax.runs.checkpoint import BEGINNING, last_point


@pytest.fixture(scope="module")
def env():
    return hand_made.environment()


@pytest.fixture(autouse=True)
def small_program(monkeypatch):
    """The small program in place of InfoGoal's own, in this process as in those of `small` runs."""
    monkeypatch.setattr(training, "make_train", killed_run.small_train)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory, env):
    """A run that was never killed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "make_train", killed_run.small_train)
        return training.run(small_config(), [0, 1], tmp_path_factory.mktemp("whole") / "run", env=env).folder


def test_large_checkpoints_take_a_tenth_of_the_time_at_most(uninterrupted, env, tmp_path, monkeypatch):
    """Where writing takes two seconds and a chunk none, there are checkpoints after the first chunk, so that a killed
    run can go on, and after the last, where the clock stops it. It ends with the same bits."""
    now, saved = [0.0], []

    def save(path, header, tree):
        checkpoint_save(path, header, tree)
        if path.name == "checkpoint":
            now[0] += 2.0
            saved.append(header["epoch"])

    checkpoint_save = checkpoint.save
    monkeypatch.setattr(checkpoint, "save", save)
    monkeypatch.setattr(training.time, "monotonic", lambda: now[0])
    chunks = small_config().num_evaluations
    calls = iter([1e9] * (chunks - 1) + [0.0] * 9)
    first, last = small_config().epochs_per_evaluation, small_config().num_epochs
    training.run(small_config(), [0, 1], tmp_path / "run", env=env, left=lambda: next(calls))
    assert saved == [first, last - first] and chunks > 3
    training.run(small_config(), [0, 1], tmp_path / "run", resume=True, env=env)
    assert saved == [first, last - first, last] and same_run(tmp_path / "run", uninterrupted)


def test_rows_after_the_last_checkpoint_are_dropped(tmp_path):
    rows = [
        {"seed": seed, "epoch": epoch, "x": 0.1 * epoch, "steps": [epoch]} for epoch in (1, 2, 3) for seed in (0, 1)
    ]
    tables.append_rows(tmp_path, "evaluations", rows)
    with open(tmp_path / "evaluations.jsonl", "a") as file:
        file.write('{"seed": 0, "epo')  # The line that the kill cut short.
    tables.replace_table(tmp_path, "evaluations", tables.rows_until(tmp_path, "evaluations", [0, 1], [1, 2]))
    assert tables.read_table(tmp_path, "evaluations") == rows[:4]
    assert (tmp_path / "evaluations.csv").read_text().splitlines() == [
        "seed,epoch,x",
        "0,1,0.1",
        "1,1,0.1",
        "0,2,0.2",
        "1,2,0.2",
    ]


@pytest.fixture
def copy_of_whole(uninterrupted, tmp_path):
    """A finished run that a test may spoil."""
    for path in uninterrupted.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text", "missing"])
def test_a_damaged_checkpoint_is_refused_and_left_alone(copy_of_whole, env, damage):
    path = copy_of_whole / "checkpoint"
    content = bytearray(path.read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 1
    spoiled = {"cut": bytes(content[:-100]), "flipped": bytes(content), "empty": b"", "text": b"hello\nworld"}.get(
        damage
    )
    path.unlink() if spoiled is None else path.write_bytes(spoiled)
    with pytest.raises(UserError, match="damaged|no checkpoint|cannot be resumed"):
        training.run(small_config(), [0, 1], copy_of_whole, resume=True, env=env)
    assert (path.read_bytes() == spoiled) if spoiled is not None else not path.exists()


def without_half(content: bytes) -> bytes:
    """The first half of the lines."""
    lines = content.splitlines(keepends=True)
    return b"".join(lines[: len(lines) // 2])


TABLE_DAMAGES = {
    "missing": lambda content: None,
    "empty": lambda content: b"",
    "half": without_half,
    "folder": lambda content: "folder",
    "another row": lambda content: content.replace(b'"epoch": 4', b'"epoch": 5', 1),
    "junk": lambda content: content.replace(b"{", b"\0", 1),
}


@pytest.mark.parametrize("num_epochs", [24, 26], ids=["finished", "longer"])
@pytest.mark.parametrize("damage", TABLE_DAMAGES)
def test_a_damaged_table_is_refused_before_anything_is_changed(copy_of_whole, env, damage, num_epochs):
    table = copy_of_whole / ("epochs.jsonl" if num_epochs == 24 else "evaluations.jsonl")
    spoiled = TABLE_DAMAGES[damage](table.read_bytes())
    table.unlink()
    if spoiled == "folder":
        table.mkdir()
    elif spoiled is not None:
        table.write_bytes(spoiled)
    before = {path.name: path.is_dir() or path.read_bytes() for path in copy_of_whole.iterdir()}
    longer = dataclasses.replace(small_config(), num_epochs=num_epochs)
    with pytest.raises(UserError, match=f"{table.name}.*(; bring back a copy|not there)"):
        last_point(copy_of_whole, training.describe(longer, env, [0, 1]), states_shape(env))
    assert before == {path.name: path.is_dir() or path.read_bytes() for path in copy_of_whole.iterdir()}


def states_shape(env):
    """Shapes of the states of two seeds."""
    train = training.make_train(small_config(), env)
    keys = jax.vmap(jax.random.key)(jnp.arange(2, dtype=jnp.uint32))
    return jax.eval_shape(jax.vmap(lambda key: train.initial(key, train.config.hyper, env)), keys)


@pytest.mark.parametrize("epoch", [-1, 0, 3, "2", None, 2.5])
def test_a_checkpoint_of_an_epoch_that_is_none_is_refused(copy_of_whole, env, epoch):
    header, _ = checkpoint.read_header(copy_of_whole / "checkpoint")
    checkpoint.save(copy_of_whole / "checkpoint", header | {"epoch": epoch}, {})
    with pytest.raises(UserError, match="checkpoint.*epoch = "):
        last_point(copy_of_whole, training.describe(small_config(), env, [0, 1]), None)


def test_a_run_that_was_stopped_before_its_first_checkpoint_begins_again(uninterrupted, copy_of_whole, env):
    for name in ("checkpoint", "policy", "timing.json"):
        (copy_of_whole / name).unlink()
    lines = (copy_of_whole / "epochs.jsonl").read_bytes().splitlines(keepends=True)
    (copy_of_whole / "epochs.jsonl").write_bytes(b"".join(lines[:3]) + b'{"seed": 0, "epo')
    (copy_of_whole / "evaluations.jsonl").unlink()
    (copy_of_whole / "evaluations.csv").unlink()
    now = training.describe(small_config(), env, [0, 1])
    assert last_point(copy_of_whole, now, None) == BEGINNING
    (copy_of_whole / "epochs.jsonl").write_bytes(b"".join(lines))  # Later rows: a checkpoint was lost.
    with pytest.raises(UserError, match="there is no checkpoint"):
        last_point(copy_of_whole, now, None)


def test_a_checkpoint_of_another_configuration_names_the_fields(copy_of_whole, env):
    other = small_config(batch_size=64)
    with pytest.raises(UserError, match="batch_size was 32, now 64"):
        training.run(other, [0, 1], copy_of_whole, resume=True, env=env)
    with pytest.raises(UserError, match=r"seeds was \[0, 1\], now \[0, 1, 2\]"):
        training.run(small_config(), [0, 1, 2], copy_of_whole, resume=True, env=env)


def test_a_folder_that_holds_a_run_is_not_written_over(copy_of_whole, env):
    before = {path.name: path.read_bytes() for path in copy_of_whole.iterdir()}
    with pytest.raises(UserError, match="holds a run already"):
        training.run(small_config(), [0, 1], copy_of_whole, env=env)
    assert before == {path.name: path.read_bytes() for path in copy_of_whole.iterdir()}


def test_a_seed_that_diverged_is_named_and_the_others_go_on_unchanged(uninterrupted, env, tmp_path):
    """Poison one seed's parameters in a checkpoint of the small program, go on for a chunk, and compare with going on
    from the sound checkpoint. `test_training.py` poisons a seed of the real one."""
    folder, sound, longer = tmp_path / "run", tmp_path / "sound", dataclasses.replace(small_config(), num_epochs=26)
    for copy in (folder, sound):
        shutil.copytree(uninterrupted, copy)
    header, states = checkpoint.load(folder / "checkpoint", states_shape(env))
    params = jax.tree.map(lambda leaf: np.array(leaf), states.params)
    for leaf in jax.tree.leaves(params):
        leaf[1] = np.nan
    checkpoint.save(folder / "checkpoint", header, states.replace(params=params))
    poisoned = training.run(longer, [0, 1], folder, resume=True, env=env)
    healthy = training.run(longer, [0, 1], sound, resume=True, env=env)
    assert poisoned.diverged == {1: 25} and healthy.diverged == {}
    first, second = (jax.tree.map(lambda leaf: leaf[0], sweep.params) for sweep in (poisoned, healthy))
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_ctrl_c_stops_with_a_checkpoint_that_goes_on(uninterrupted, env, tmp_path):
    process, _ = killed_run.start("small", tmp_path / "run")
    while not (tmp_path / "run" / "checkpoint").exists():
        assert process.is_alive()
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGINT)
    process.join()
    reached = json.loads((tmp_path / "run" / "checkpoint").read_bytes().partition(b"\n")[0])["epoch"]
    assert 2 <= reached <= 24 and process.exitcode == (0 if reached == 24 else killed_run.STOPPED)
    training.run(small_config(), [0, 1], tmp_path / "run", resume=True, env=env)
    assert same_run(tmp_path / "run", uninterrupted)


def test_a_run_of_an_earlier_version_says_so(copy_of_whole, env):
    """Its fields have other names, and its checkpoint another first line."""
    path = copy_of_whole / "checkpoint"
    path.write_bytes(b'{"format": "infogoal-jax checkpoint 1", "sha256": "0", "epoch": 2}\n')
    with pytest.raises(UserError, match="format = .infogoal-jax checkpoint 1.: should be .*train again"):
        training.run(small_config(), [0, 1], copy_of_whole, resume=True, env=env)
    about = json.loads((copy_of_whole / "config.json").read_text())
    del about["config"]["format"]
    (copy_of_whole / "config.json").write_text(json.dumps(about))
    with pytest.raises(UserError, match="config.format = 1.*use the version that wrote the run"):
        training.run(small_config(), [0, 1], copy_of_whole, resume=True, env=env)
