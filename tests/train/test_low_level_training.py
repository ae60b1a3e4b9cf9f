"""Training of the low levels: it learns to reach, is reproducible, keeps what it learned, and names what it refuses."""

import dataclasses
import json
import signal

import hand_made_frames
import jax
import numpy as np
import pytest

from infogoal_jax.agents.hrac import LowLevelConfig
from infogoal_jax.cli.main import main
from infogoal_jax.envs import object_manipulation
from infogoal_jax.errors import UserError
from infogoal_jax.runs import tables
from infogoal_jax.train.low_level import host, joints
from infogoal_jax.train.low_level import trainer as low_levels
from infogoal_jax.train.low_level.host import make_agent, preset
from infogoal_jax.train.low_level.trainer import COLLECT, EVALUATE, INITIAL, UPDATE, make_trainer
from infogoal_jax.train.parts import numbered


@pytest.fixture(scope="module")
def reaching():
    """The training of fetch_reach with 128 environments, and the agent's `run`, compiled."""
    trainer = make_trainer(make_agent(preset("fetch_reach", num_envs=128)))
    return trainer, jax.jit(trainer.agent.run)


def test_no_key_of_the_joints_is_used_twice():
    """Of parameters, updates, and the episodes that measure: the first updates too."""
    key = jax.random.key(0)
    found = [joints.key_of(key, INITIAL, 0)] + [
        joints.key_of(key, purpose, number) for purpose in (UPDATE, COLLECT, EVALUATE) for number in range(5)
    ]
    assert len({tuple(jax.random.key_data(each).tolist()) for each in found}) == len(found)


def test_the_low_level_of_the_joints_is_trained_and_written_as_any_other(tmp_path, monkeypatch):
    """Several seeds in one program, a curve, the best of them in a file that HRAC loads."""
    env = hand_made_frames.manipulation()
    monkeypatch.setattr(object_manipulation, "make", lambda config: env)
    config = preset(
        "object_manipulation", num_envs=200, num_epochs=4, updates_per_epoch=5, network=LowLevelConfig((32, 32))
    )
    result = host.pretrain(config, [0, 1], tmp_path, evaluation_episodes=400)
    lines = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert [(line["seed"], line["epoch"]) for line in lines] == [
        (seed, epoch) for epoch in range(1, 5) for seed in (0, 1)
    ]
    header, policy = low_levels.load_joint_level(str(tmp_path), 3, 6)
    assert header["seeds"] == result.seeds and header["evaluation_episodes"] == 400 and policy.hidden == (32, 32)
    assert (
        header["kept"] == max(result.seeds, key=lambda report: report["success_rate"])["seed"] and not header["stopped"]
    )
    assert (header["joints"], header["moves"], header["data"]) == (3, 6, env.source)


def test_what_cannot_be_trained_is_refused_before_compiling(tmp_path, capsys):
    assert main(["pretrain", "fetch_slide"]) == 2
    assert "Known: fetch_reach, fetch_push, fetch_pick_and_place" in capsys.readouterr().err
    assert main(["pretrain"]) == 2 and "Known: fetch_reach, fetch_push" in capsys.readouterr().err
    assert main(["pretrain", "--seeds", "3"]) == 2 and "'--seeds': flags come after" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stopped:
        main(["pretrain", "fetch_reach", "--task", "fetch_push"])
    assert stopped.value.code == 2 and "--task" in capsys.readouterr().err
    assert main(["pretrain", "fetch_reach", "--seeds", "0", "--out", str(tmp_path / "new")]) == 2
    (tmp_path / "low_level").write_bytes(b"precious")
    assert main(["pretrain", "fetch_reach", "--out", str(tmp_path)]) == 2
    assert "give another folder" in capsys.readouterr().err
    assert (tmp_path / "low_level").read_bytes() == b"precious" and not (tmp_path / "new").exists()
    with pytest.raises(UserError, match=r"hyper.moving_share = 2\.0: give a number in"):
        preset("fetch_push", hyper=dataclasses.replace(preset("fetch_push").hyper, moving_share=2))
    with pytest.raises(UserError, match="hyper.discount = 1"):
        preset("object_manipulation", hyper=dataclasses.replace(preset("object_manipulation").hyper, discount=1.0))
    with pytest.raises(UserError, match="num_envs = 4"):
        preset("fetch_push", num_envs=4)


@pytest.mark.long
def test_training_learns_to_reach_and_is_reproducible(reaching):
    trainer, run = reaching
    hyper = trainer.agent.config.hyper
    learn, policy, initial = jax.jit(trainer.learn), jax.jit(trainer.policy), jax.jit(trainer.initial)

    def train(num_epochs: int):
        state = initial(jax.random.key(0), hyper)
        for number in range(num_epochs):
            rows, _ = run(policy(state), numbered(state.key, COLLECT, number), True, hyper)
            state, _ = learn(state, rows, number, hyper)
        return policy(state)

    untrained, trained = (run(train(epochs), jax.random.key(1), False, hyper)[1] for epochs in (0, 7))
    assert untrained["success_rate"] < 0.3
    assert trained["success_rate"] > 0.9 and trained["following_rate"] > 0.9
    jax.tree.map(np.testing.assert_array_equal, train(2), train(2))


@pytest.mark.long
def test_a_stopped_training_leaves_its_curve_and_what_was_learned(tmp_path, monkeypatch):
    append = tables.append_rows

    def interrupted(*arguments):
        append(*arguments)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(tables, "append_rows", interrupted)
    config = preset("fetch_reach", num_envs=16, num_epochs=3, updates_per_epoch=2)
    result = host.pretrain(config, [5, 6], tmp_path, evaluation_episodes=16, command="infogoal pretrain fetch_reach")
    assert result.stopped
    lines = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert [(line["seed"], line["epoch"], line["env_steps"]) for line in lines] == [(5, 1, 800), (6, 1, 800)]
    header, policy = low_levels.load_with_header(str(tmp_path), "fetch_reach")
    assert header["stopped"] and header["epochs"] == 1 and header["kept"] in (5, 6) and len(policy.mean) == 10
