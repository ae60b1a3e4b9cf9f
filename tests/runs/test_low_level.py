"""Low levels: the shipped ones are those that runs of before name, JAX and NumPy run one program, what cannot be used
is refused; and `infogoal pretrain` leaves one that HRAC takes."""

import csv
import dataclasses
import json
from types import SimpleNamespace

import hand_made_frames
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import envs, load_run, presets
from infogoal_jax.cli.main import main
from infogoal_jax.envs import joint_targets
from infogoal_jax.envs.graph import frame_edges
from infogoal_jax.envs.object_manipulation import Posed
from infogoal_jax.errors import UserError
from infogoal_jax.loading import load_environment
from infogoal_jax.policy_file import ExportedPolicy
from infogoal_jax.report import summary
from infogoal_jax.runner import training
from infogoal_jax.runs import folder, low_level, tables
from infogoal_jax.runs.low_level import LowLevel, read, shipped

TASKS = {"fetch_reach": (10, 3), "fetch_push": (25, 6), "fetch_pick_and_place": (25, 6), "object_manipulation": (3, 3)}
"""Numbers of an observation and of a target state."""


@pytest.mark.parametrize("task", TASKS)
def test_a_program_run_by_jax_is_the_one_run_by_numpy(task):
    policy = ExportedPolicy(shipped(task))
    given, target = (jax.random.normal(jax.random.key(n), (20, size)) for n, size in enumerate(TASKS[task]))
    observation = Posed(jnp.zeros(20, jnp.int32), given) if task == "object_manipulation" else given
    found = np.asarray(jax.vmap(LowLevel.of(policy).act)(observation, target))
    for row, body, goal in zip(found, np.asarray(given), np.asarray(target), strict=True):
        if task == "object_manipulation":
            assert row == policy.act(body, goal)
        else:
            np.testing.assert_allclose(row, policy.drive(body, goal, step=0)[0], atol=1e-5)


@pytest.mark.parametrize("task", TASKS)
def test_runs_of_before_find_the_low_level_that_they_were_trained_with(task):
    """By the checksum of the file that it was read from then."""
    about = ExportedPolicy(shipped(task)).about
    assert f"low level, content {about['content']}" in load_run(f"shipped/{task}").data


def test_shipped_files_say_what_made_them():
    with open(low_level.SHIPPED / "curves.csv", newline="") as file:
        curves = list(csv.DictReader(file))
    for task in TASKS:
        about = ExportedPolicy(shipped(task)).about
        assert about["task"] == task and shipped(task).stat().st_size < 700_000
        if task != "object_manipulation":
            assert about["command"].startswith(f"infogoal pretrain {task}")
            curve = [row for row in curves if row["task"] == task]
            assert {int(row["seed"]) for row in curve} == {report["seed"] for report in about["seeds"]}


def test_a_low_level_that_cannot_be_used_is_refused(tmp_path):
    env = hand_made_points.points()
    with pytest.raises(UserError, match="of the task 'fetch_push', not 'fetch_reach'; give one of `infogoal pretrain"):
        read(str(shipped("fetch_push")), env)
    with pytest.raises(UserError, match="no such file; give one of `infogoal pretrain fetch_reach`"):
        read(str(tmp_path / "nothing"), env)
    with pytest.raises(UserError, match="no such file"):
        read(str(tmp_path), env)
    with pytest.raises(UserError, match="none is shipped for fetch_slide.*fetch_pick_and_place, fetch_push"):
        shipped("fetch_slide")
    (tmp_path / "damaged").write_bytes(shipped("fetch_reach").read_bytes()[:-9])
    with pytest.raises(UserError, match="is no policy"):
        read(str(tmp_path / "damaged"), env)
    with np.load(shipped("fetch_reach")) as members:
        members = dict(members)
    members["about"] = np.array(json.dumps(json.loads(str(members["about"])) | {"task": "object_manipulation"}))
    np.savez(tmp_path / "other.npz", **members)
    with pytest.raises(UserError, match="3 numbers of a target state and the 6 moves of object_manipulation"):
        read(str(tmp_path / "other.npz"), hand_made_frames.manipulation())


@pytest.mark.long
def test_pretrain_leaves_a_run_whose_policy_hrac_takes(tmp_path, monkeypatch, capsys):
    """Several seeds in one program by the ordinary runner; the best of them in the folder of the run."""
    data = hand_made_frames.arm()
    small = joint_targets.from_data(data.joints, frame_edges(data)[0], "an arm", 8)
    entry = envs.registry["object_manipulation_targets"]._replace(make=lambda config: small)
    monkeypatch.setitem(envs.registry, "object_manipulation_targets", entry)
    words = "pretrain object_manipulation --seeds 2 --num-epochs 2 --epochs-per-evaluation 1 --num-envs 8"
    sizes = "--rollout-steps 8 --updates-per-epoch 3 --batch-size 16 --buffer-steps 500 --evaluation-starts 1"
    assert main([*words.split(), *sizes.split(), "--out", str(tmp_path / "run"), "--agent.hidden", "8"]) == 0
    rates = [row["train_goal/success_rate"] for row in tables.read_table(tmp_path / "run", "evaluations")[-2:]]
    seed = int(np.argmax(rates))
    assert f"{tmp_path / 'run' / low_level.NAME}, seed {seed}" in capsys.readouterr().out

    env = hand_made_frames.manipulation()
    config = presets.load("object_manipulation", "none")
    given = dataclasses.replace(config, agent=dataclasses.replace(config.agent, low_level=str(tmp_path / "run")))
    steered = load_environment(given, env)
    observation, target = env.observe_frame(jnp.arange(30)), small.goals.evaluated[:30]
    moves = jax.vmap(steered.low_level.act)(observation, target)
    policy = load_run(tmp_path / "run").policy(seed, use_mean=True)
    np.testing.assert_array_equal(moves, policy(observation.joints, target, jax.random.key(0)))
    assert low_level.NAME in folder.RUN and "content" in steered.source


def test_a_low_level_that_was_stopped_goes_on_as_one(tmp_path, monkeypatch, capsys):
    """`infogoal train --resume` would leave no low level at its end."""
    told = []

    def stopped(*arguments, onward, **named):
        told.append(onward)
        return SimpleNamespace(stopped=True)

    monkeypatch.setattr(training, "run", stopped)
    monkeypatch.setattr(summary, "print_run", lambda folder: None)
    assert main(["pretrain", "fetch_reach", "--out", str(tmp_path / "low")]) == 130
    onward = f"infogoal pretrain fetch_reach --resume {tmp_path / 'low'}"
    assert capsys.readouterr().out == f"Stopped. Go on with: {onward}\n" and told == [onward]


def test_what_cannot_be_pretrained_is_refused(capsys):
    assert main(["pretrain", "fetch_slide"]) == 2
    assert "Known: fetch_reach, fetch_push, fetch_pick_and_place, object_manip" in capsys.readouterr().err
    assert main(["pretrain"]) == 2 and "Known: fetch_reach, fetch_push" in capsys.readouterr().err
    assert main(["pretrain", "--seeds", "3"]) == 2 and "'--seeds': flags come after" in capsys.readouterr().err
    assert main(["pretrain", "fetch_reach", "--task", "fetch_push"]) == 2 and "--task" in capsys.readouterr().err
    assert main(["pretrain", "fetch_reach", "--method", "her", "--agent", "dqn"]) == 2
    assert "agent = 'dqn'" in capsys.readouterr().err
