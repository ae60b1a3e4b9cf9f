"""The low level of HRAC: hindsight stays within an episode, targets can be reached, and shipped weights reach them."""

import csv
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import replay
from infogoal_jax.envs.fetch.targets import BESIDE, FARTHEST, HELD, PRECISE, REACHED, TargetSpace
from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.errors import UserError
from infogoal_jax.relabelling import her
from infogoal_jax.replay import Trajectories
from infogoal_jax.runs import checkpoint
from infogoal_jax.train.low_level import trainer as low_levels
from infogoal_jax.train.low_level.fetch import PRESETS
from infogoal_jax.train.low_level.host import make_agent, preset
from infogoal_jax.train.low_level.trainer import make_trainer

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


def test_steps_left_counts_to_the_end_of_the_episode(rows):
    valid = np.asarray(rows.valid)
    expected = np.zeros(valid.shape, int)
    for row, column in np.ndindex(*valid.shape):
        while column + expected[row, column] < valid.shape[1] and valid[row, column + expected[row, column]]:
            expected[row, column] += 1
    np.testing.assert_array_equal(replay.steps_left(rows.valid), expected)


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


def test_a_target_is_reached_within_the_tolerance_of_each_component():
    reach, push = TargetSpace(TASKS["fetch_reach"]), TargetSpace(TASKS["fetch_push"])
    origin = jnp.zeros(6)

    def shifted(grip: float, thing: float):
        return jnp.array([grip, 0.0, 0.0, 0.0, 0.0, thing])

    near, far = 0.99, 1.01
    assert push.reached(shifted(near * BESIDE, near * REACHED), origin)
    assert not push.reached(shifted(far * BESIDE, 0.0), origin)
    assert not push.reached(shifted(0.0, far * REACHED), origin)
    assert reach.reached(jnp.array([0.0, near * REACHED, 0.0]), jnp.zeros(3))
    assert not reach.reached(jnp.array([0.0, far * REACHED, 0.0]), jnp.zeros(3))
    assert push.reward(shifted(near * BESIDE, near * PRECISE), origin) == 0.0
    assert push.reward(shifted(0.0, far * PRECISE), origin) == -1.0


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
