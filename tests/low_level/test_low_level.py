"""The low levels of HRAC: hindsight stays within an episode, targets can be reached, and shipped weights reach them;
training learns to reach, is reproducible, keeps what it learned, and names what it refuses."""

import csv
import dataclasses
import json
import signal

import hand_made_frames
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import replay
from infogoal_jax.agents.hrac import LowLevelConfig
from infogoal_jax.cli.main import main
from infogoal_jax.envs import object_manipulation
from infogoal_jax.envs.fetch.targets import BESIDE, FARTHEST, HELD, TargetSpace
from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.errors import UserError
from infogoal_jax.low_level import joints, pretraining
from infogoal_jax.low_level import trainer as low_levels
from infogoal_jax.low_level.fetch import PRESETS
from infogoal_jax.low_level.pretraining import make_agent, preset
from infogoal_jax.low_level.trainer import COLLECT, EVALUATE, INITIAL, UPDATE, make_trainer
from infogoal_jax.relabelling import her
from infogoal_jax.replay import Trajectories
from infogoal_jax.runs import checkpoint, tables
from infogoal_jax.train.parts import numbered

each_task = pytest.mark.parametrize("task", PRESETS)


@pytest.fixture(scope="module")
def rows() -> Trajectories:
    """Four rows of 30 transitions, several episodes in each. A record is (episode, step, 0) in m: no two are within a
    tolerance."""
    generator = np.random.default_rng(0)
    record, valid = np.zeros((4, 31, 3), np.float32), np.zeros((4, 30), bool)
    episode = 0
    for row in range(4):
        column = 0
        while column < 31:
            length = min(int(generator.integers(1, 12)), 30 - column)
            episode += 1
            for step in range(length + 1):
                record[row, column + step] = episode, step, 0
                valid[row, column + step - 1] |= step > 0
            column += length + 1
    never = np.zeros_like(valid)
    goal = record[:, :-1] + [0.0, 0.0, 100.0]
    return jax.tree.map(
        jnp.asarray, Trajectories(record, record, np.zeros((4, 30, 4), np.float32), goal, valid, never, never, ~never)
    )


@pytest.fixture(scope="module")
def reaching():
    """The training of fetch_reach with 128 environments, and the agent's `run`, compiled."""
    trainer = make_trainer(make_agent(preset("fetch_reach", num_envs=128)))
    return trainer, jax.jit(trainer.agent.run)


def drawn(rows: Trajectories, num: int = 2000):
    """Valid transitions, and what each achieved later."""
    row, step = replay.draw(jax.random.key(0), replay.running_count(rows.valid), num, rows.valid.shape[1])
    later = her.future_record(jax.random.key(1), rows, replay.steps_left(rows.valid), row, step)
    return row, step, later


@pytest.mark.long
def test_hindsight_takes_any_later_step_of_the_same_episode(rows):
    row, step, later = drawn(rows)
    now, left = rows.record[row, step], replay.steps_left(rows.valid)[row, step]
    np.testing.assert_array_equal(later[:, 0], now[:, 0])
    ahead = later[:, 1] - now[:, 1]
    assert (ahead >= 1).all() and (ahead <= left).all()
    for most in range(2, 8):  # Every later step has its turn, the last one too.
        assert set(np.asarray(ahead[left == most]).astype(int)) == set(range(1, most + 1))


def test_a_relabelled_reward_is_that_of_the_new_target(rows):
    row, step, later = drawn(rows)
    batch = replay.transitions_at(rows, row, step, 1)
    target = her.relabel(jax.random.key(2), batch.goal, later, 0.8)
    replaced = (target == later).all(-1)
    assert 0.75 < replaced.mean() < 0.85
    np.testing.assert_array_equal(target[~replaced], batch.goal[~replaced])
    reward = TargetSpace(TASKS["fetch_reach"]).reward(batch.records[:, 0], target)
    # Only the step that leads to the very next record reaches it.
    arrived = replaced & (later[:, 1] == rows.record[row, step, 1] + 1)
    np.testing.assert_array_equal(reward, jnp.where(arrived, 0.0, -1.0))
    assert arrived.any() and (replaced & ~arrived).any()


@each_task
def test_every_subgoal_means_a_target_within_reach(task):
    space = TargetSpace(TASKS[task])
    low, high = space.bounds
    generator = np.random.default_rng(0)
    inside = np.arange(500) < 250
    margin = np.where(inside, 0.0, 0.1)[:, None]
    position = generator.uniform(low - margin, high + margin)
    state = np.concatenate([generator.normal(position, 0.1), position], 1)[:, -space.size :]
    observation = jnp.concatenate([jnp.asarray(state, jnp.float32), jnp.ones((500, 4))], -1)
    subgoal = jnp.asarray(generator.uniform(-1.5, 1.5, (500, space.size)), jnp.float32)
    target = space.from_subgoal(observation, subgoal, FARTHEST)
    assert target.shape == (500, space.size)
    moved = target[:, -3:]
    assert (moved >= low - 1e-6).all() and (moved <= high + 1e-6).all()
    assert (jnp.abs(moved - position)[inside] <= FARTHEST + 1e-6).all()
    assert (jnp.linalg.norm(target[:, :3] - moved, axis=-1) < BESIDE).all()
    stay = space.from_subgoal(observation, jnp.zeros_like(subgoal), FARTHEST)
    np.testing.assert_allclose(stay[inside, -3:], position[inside], atol=1e-6)


@pytest.mark.long
def test_shipped_reach_policy_reaches_and_follows(reaching):
    trainer, run = reaching
    rows, metrics = run(low_levels.load("", "fetch_reach"), jax.random.key(7), False, trainer.agent.config.hyper)
    assert metrics["success_rate"] >= 0.95
    assert metrics["following_rate"] >= 0.95
    assert (jnp.abs(rows.action) <= 1.0).all() and rows.valid.all()
    np.testing.assert_array_equal(rows.goal[:64], jnp.broadcast_to(rows.goal[:64, :1], rows.goal[:64].shape))


@pytest.fixture(scope="module")
def moving_targets():
    """Episodes of the shipped low level while its target moves, of half as many environments: (seed) -> rows."""
    trainer = make_trainer(make_agent(preset("fetch_reach", num_envs=64)))
    policy, run = low_levels.load("", "fetch_reach"), jax.jit(trainer.agent.run)
    return lambda seed: run(policy, jax.random.key(seed), True, trainer.agent.config.hyper)[0]


@pytest.mark.long
def test_targets_move_as_a_high_level_moves_them(moving_targets):
    rows = moving_targets(8)
    changes = np.asarray((rows.goal[:, 1:] != rows.goal[:, :-1]).any(-1))
    assert not changes[:8].any()  # The eighth that is measured.
    moving = changes.any(1)
    assert 0.3 < moving[8:].mean() < 0.7
    assert changes.sum() == changes[:, HELD - 1 :: HELD].sum()  # Only where one is due.
    low, high = TargetSpace(TASKS["fetch_reach"]).bounds
    aimed, grip = np.asarray(rows.goal)[moving][:, ::HELD], np.asarray(rows.record)[moving][:, :-1:HELD]
    assert (aimed >= low - 1e-6).all() and (aimed <= high + 1e-6).all()
    assert (np.abs(aimed - np.clip(grip, low, high)) <= FARTHEST + 1e-6).all()


@pytest.mark.long
def test_same_key_gives_the_same_bits(moving_targets):
    first, again, other = (moving_targets(seed) for seed in (8, 8, 9))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(first.observation, other.observation)


@each_task
def test_shipped_files_say_what_made_them(task):
    header, policy = low_levels.load_with_header("", task)
    assert header["command"].startswith(f"infogoal pretrain {task}")
    assert header["config"]["hyper"] == dataclasses.asdict(preset(task).hyper)
    with open(low_levels.SHIPPED / "curves.csv", newline="") as file:
        curve = [row for row in csv.DictReader(file) if row["task"] == task]
    assert {int(row["seed"]) for row in curve} == {report["seed"] for report in header["seeds"]}
    assert max(int(row["epoch"]) for row in curve) == header["epochs"]
    assert low_levels.shipped(task).stat().st_size < 700_000
    observation = jnp.zeros((5, len(policy.mean)))
    assert policy.act(observation, jnp.zeros((5, TargetSpace(TASKS[task]).size))).shape == (5, 4)


def test_a_low_level_that_cannot_be_used_is_refused(tmp_path):
    shipped = low_levels.shipped("fetch_push")
    with pytest.raises(UserError, match="of the task 'fetch_push', not 'fetch_reach'"):
        low_levels.load(str(shipped), "fetch_reach")
    with pytest.raises(UserError, match="no such file; give one that `infogoal pretrain fetch_push`"):
        low_levels.load(str(tmp_path / "nothing"), "fetch_push")
    with pytest.raises(
        UserError, match="no low level is shipped for fetch_slide.*fetch_pick_and_place, fetch_push, fetch_reach$"
    ):
        low_levels.load("", "fetch_slide")
    damaged = tmp_path / "damaged"
    damaged.write_bytes(shipped.read_bytes()[:-1])
    with pytest.raises(UserError, match="damaged"):
        low_levels.load(str(damaged), "fetch_push")
    checkpoint.save(tmp_path / "other", {"epoch": 3}, {"weights": jnp.zeros(3)})
    with pytest.raises(UserError, match="something else"):
        low_levels.load(str(tmp_path / "other"), "fetch_push")
    low_levels.save(tmp_path / "shapes", {"task": "fetch_push"}, low_levels.load("", "fetch_reach"))
    with pytest.raises(UserError, match="other shapes"):
        low_levels.load(str(tmp_path / "shapes"), "fetch_push")


def test_a_low_level_survives_its_file(tmp_path):
    policy = low_levels.load("", "fetch_reach")
    low_levels.save(tmp_path / "low_level", {"task": "fetch_reach"}, policy)
    jax.tree.map(np.testing.assert_array_equal, low_levels.load(str(tmp_path), "fetch_reach"), policy)


@pytest.mark.long
@pytest.mark.parametrize("task", ["fetch_push", "fetch_pick_and_place"])
def test_shipped_policies_move_the_object(task):
    agent = make_agent(preset(task, num_envs=256))
    metrics = jax.jit(agent.run)(low_levels.load("", task), jax.random.key(3), False, agent.config.hyper)[1]
    assert metrics["success_rate"] >= 0.95
    assert metrics["following_rate"] >= 0.95


def test_no_key_of_the_joints_is_used_twice():
    """Of parameters, updates, and the episodes that measure: the first updates too."""
    key = jax.random.key(0)
    found = [joints.key_of(key, INITIAL, 0)] + [
        joints.key_of(key, purpose, number) for purpose in (UPDATE, COLLECT, EVALUATE) for number in range(5)
    ]
    assert len({tuple(jax.random.key_data(each).tolist()) for each in found}) == len(found)


@pytest.mark.long
def test_the_low_level_of_the_joints_is_trained_and_written_as_any_other(tmp_path, monkeypatch):
    """Several seeds in one program, a curve, the best of them in a file that HRAC loads."""
    env = hand_made_frames.manipulation()
    monkeypatch.setattr(object_manipulation, "make", lambda config: env)
    config = preset(
        "object_manipulation", num_envs=200, num_epochs=4, updates_per_epoch=5, network=LowLevelConfig((32, 32))
    )
    result = pretraining.pretrain(config, [0, 1], tmp_path, evaluation_episodes=400)
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
    result = pretraining.pretrain(
        config, [5, 6], tmp_path, evaluation_episodes=16, command="infogoal pretrain fetch_reach"
    )
    assert result.stopped
    lines = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert [(line["seed"], line["epoch"], line["env_steps"]) for line in lines] == [(5, 1, 800), (6, 1, 800)]
    header, policy = low_levels.load_with_header(str(tmp_path), "fetch_reach")
    assert header["stopped"] and header["epochs"] == 1 and header["kept"] in (5, 6) and len(policy.mean) == 10
