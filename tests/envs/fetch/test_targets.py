"""Target states of Fetch: what is near enough, targets that can be reached, targets that move as a high level moves
them; and the shipped low levels reach them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import envs
from infogoal_jax.envs.contract import check_contract
from infogoal_jax.envs.fetch.targets import BESIDE, FARTHEST, HELD, PRECISE, TargetSpace
from infogoal_jax.envs.fetch.tasks import TASKS, TargetsConfig
from infogoal_jax.errors import UserError
from infogoal_jax.policy_file import ExportedPolicy
from infogoal_jax.runs import low_level as low_levels
from infogoal_jax.train.evaluation import evaluate
from infogoal_jax.train.rollout import collect

each_task = pytest.mark.parametrize("task", ["fetch_reach", "fetch_push", "fetch_pick_and_place"])


def shipped(task: str) -> low_levels.LowLevel:
    """The low level of a task, without its environment."""
    policy = ExportedPolicy(low_levels.shipped(task))
    return low_levels.LowLevel.of(policy)


def acting(task: str):
    """The policy of the shipped low level."""
    low_level = shipped(task)
    return lambda observation, goal, key: jax.vmap(low_level.act)(observation, goal)


def test_a_target_is_reached_within_the_tolerance_of_each_component():
    reach, push = TargetSpace(TASKS["fetch_reach"]), TargetSpace(TASKS["fetch_push"])
    origin = jnp.zeros(6)

    def shifted(grip: float, thing: float):
        return jnp.array([grip, 0.0, 0.0, 0.0, 0.0, thing])

    near, far = 0.99, 1.01
    assert push.reached(shifted(near * BESIDE, near * PRECISE), origin)
    assert not push.reached(shifted(far * BESIDE, 0.0), origin)
    assert not push.reached(shifted(0.0, far * PRECISE), origin)
    assert reach.reached(jnp.array([0.0, near * PRECISE, 0.0]), jnp.zeros(3))
    assert not reach.reached(jnp.array([0.0, far * PRECISE, 0.0]), jnp.zeros(3))
    several = jnp.stack([shifted(0.0, 0.0), shifted(0.0, far * PRECISE)])
    np.testing.assert_array_equal(push.reached(several, origin), [True, False])


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


@pytest.mark.parametrize(
    "task",
    [*(pytest.param(task, marks=pytest.mark.long) for task in ("fetch_reach", "fetch_push")), "fetch_pick_and_place"],
)
def test_target_states_are_an_ordinary_task(task):
    """It keeps the contract; a goal is the finished task, the grip at the object's place."""
    env = envs.load(f"{task}_targets")
    check_contract(env)
    goals = np.asarray(env.goals.evaluated)
    low, high = env.space.bounds
    assert (
        goals.shape == (32, env.space.size)
        and (goals[:, -3:] >= low - 1e-6).all()
        and (goals[:, -3:] <= high + 1e-6).all()
    )
    np.testing.assert_array_equal(goals[:, :3], goals[:, -3:])
    assert np.abs(env.goals.inputs_of(goals)).max() < 6  # 10 cm each.
    with pytest.raises(UserError, match="env.moving_share = 2"):
        envs.load(f"{task}_targets", TargetsConfig(moving_share=2.0))


@pytest.mark.long
def test_targets_move_as_a_high_level_moves_them():
    """In half of the training episodes; where an evaluation asks for a target, it stays."""
    env = envs.load("fetch_reach_targets")
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(8), 64))
    _, rows = jax.jit(lambda states: collect(env, states, acting("fetch_reach"), jax.random.key(9), 50))(starts)
    changes = np.asarray((rows.desired_goal[:, 1:] != rows.desired_goal[:, :-1]).any(-1))
    moving = changes.any(1)
    assert 0.3 < moving.mean() < 0.7 and not rows.terminated.any()
    assert changes.sum() == changes[:, HELD - 1 :: HELD].sum()  # Only where one is due.
    low, high = env.space.bounds
    aimed, grip = np.asarray(rows.desired_goal)[moving][:, ::HELD], np.asarray(rows.record)[moving][:, :-1:HELD]
    assert (aimed >= low - 1e-6).all() and (aimed <= high + 1e-6).all()
    assert (np.abs(aimed - np.clip(grip, low, high)) <= FARTHEST + 1e-6).all()
    asked = jax.jit(jax.vmap(env.reset_to))(jax.random.split(jax.random.key(8), 32), env.goals.evaluated)
    assert not asked.moving.any()


@pytest.mark.long
@each_task
def test_shipped_low_levels_reach_target_states(task):
    env = envs.load(f"{task}_targets")
    scores = jax.jit(lambda: evaluate(acting(task), env, env.goals.evaluated, 4))()
    assert scores.success.mean() >= 0.95
