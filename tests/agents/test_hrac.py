"""HRAC's high level: subgoals, adjacency, and transitions from decision to decision, on a task without physics."""

import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made_points import EPISODE_LENGTH

from infogoal_jax import Hyperparameters, pairs, presets, replay
from infogoal_jax.agents import hrac
from infogoal_jax.agents.hrac import HRACConfig, adjacency_loss, adjacency_penalty
from infogoal_jax.envs.fetch.targets import TargetSpace
from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.envs.target_states import Cells
from infogoal_jax.learners.infogoal import InfoGoalState
from infogoal_jax.learners.learner import GoalCode
from infogoal_jax.train.experience import Experience
from infogoal_jax.train.sampling import with_rewards
from infogoal_jax.train.update import agent_batch, returns

K = hand_made_points.LONG_INTERVAL
"""Steps between decisions here: an episode of 12 steps ends within an interval, at the goal or when time is up."""


def steps_of_episodes(rows):
    """int [R, T]: how many steps of its episode came before each step of rows that start with a fresh episode."""
    time, valid = np.zeros(rows.valid.shape, int), np.asarray(rows.valid)
    for column in range(1, valid.shape[1]):
        time[:, column] = np.where(valid[:, column - 1], time[:, column - 1] + 1, 0)
    return time


def test_adjacent_states_may_lie_1_apart_and_others_have_to_lie_1_2_apart():
    distance, weight = jnp.array([0.0, 0.9, 1.0, 1.1, 1.2, 1.3, 3.0]), jnp.ones(7)
    for adjacent, errors in ((True, [0, 0, 0, 0.1, 0.2, 0.3, 2.0]), (False, [1.2, 0.3, 0.2, 0.1, 0, 0, 0])):
        for position in range(7):
            one = jnp.zeros(7).at[position].set(1.0)
            np.testing.assert_allclose(
                adjacency_loss(distance, jnp.full(7, adjacent), one), errors[position], atol=1e-6
            )
        np.testing.assert_allclose(adjacency_loss(distance, jnp.full(7, adjacent), weight), np.mean(errors), atol=1e-6)
    assert adjacency_loss(distance, jnp.full(7, True), jnp.zeros(7)) == 0.0


def test_subgoals_cost_from_1_1_on():
    np.testing.assert_allclose(adjacency_penalty(jnp.array([0.0, 1.0, 1.1, 1.2, 2.1])), [0, 0, 0, 0.1, 1.0], atol=1e-6)
    slope = jax.vmap(jax.grad(adjacency_penalty))(jnp.array([0.5, 1.05, 1.15, 4.0]))
    np.testing.assert_array_equal(slope, [0, 0, 1, 1])


def test_lengths_have_a_finite_gradient_at_0():
    assert np.isfinite(jax.grad(lambda vector: hrac.length(vector))(jnp.zeros(3))).all()


@pytest.mark.parametrize("task", presets.FETCH_TASKS)
@pytest.mark.parametrize("side", [0.05, 0.07])
def test_a_position_lies_in_the_cell_whose_centre_is_nearest(task, side):
    space = TargetSpace(TASKS[task])
    cells = Cells.over(space.bounds, side)
    centres = cells.low + side * (
        np.stack(np.meshgrid(*map(np.arange, cells.shape), indexing="ij"), -1).reshape(-1, 3) + 0.5
    )
    assert len(centres) == cells.count
    place = np.random.default_rng(0).uniform(space.bounds[0] - 0.99 * side, space.bounds[1] + 0.99 * side, (500, 3))
    found = np.asarray(cells.of(jnp.asarray(place, jnp.float32)))
    distance = np.linalg.norm(place[:, None] - centres, axis=-1)
    assert (found >= 0).all()
    np.testing.assert_allclose(distance[np.arange(500), found], distance.min(1), atol=1e-5)
    beyond = np.concatenate([space.bounds[0] - 2.6 * side * np.eye(3), space.bounds[1] + 2.6 * side * np.eye(3)])
    assert (cells.of(jnp.asarray(beyond)) == -1).all()


@pytest.mark.parametrize("task", presets.FETCH_TASKS)
def test_robot_and_object_at_rest_do_not_waver_between_cells(task):
    """All grips start at one place, and all objects lie at one height: neither may be a border."""
    space, grip, height = TargetSpace(TASKS[task]), np.array(TASKS[task].start_grip), TASKS[task].object_height
    cells = Cells.over(space.bounds, HRACConfig.cell)
    for place in (grip, grip if height is None else np.array([*grip[:2], height])):
        around = place + 0.005 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        assert len(np.unique(cells.of(jnp.asarray(around)))) == 1


def test_cells_are_adjacent_once_they_were_k_steps_apart_and_stay_so(train, rows):
    agent, env = train.parts.agent, train.env
    cells = Cells.over(env.space.bounds, train.config.agent.cell)
    apart = pairs.initial_dissimilarity(cells.count)[None]
    place, episode = np.asarray(cells.of(rows.observation[..., :3])), np.asarray(rows.episode())
    expected = np.asarray(apart[0]).copy()
    for half in (slice(0, 12), slice(12, 24)):
        after = jax.jit(agent.observe)(apart, jax.tree.map(lambda leaf, half=half: leaf[half], rows))
        assert not (after & ~apart).any() and (after != apart).any()
        apart = after
        for row in range(half.start, half.stop):
            for first in range(41):
                for second in range(first, min(first + K + 1, 41)):
                    if episode[row, first] == episode[row, second] and min(place[row, first], place[row, second]) >= 0:
                        expected[place[row, first], place[row, second]] = expected[
                            place[row, second], place[row, first]
                        ] = False
        np.testing.assert_array_equal(apart[0], expected)
    assert (apart == apart.transpose(0, 2, 1)).all() and not jnp.diagonal(apart, axis1=1, axis2=2).any()


def test_decisions_come_every_k_steps_of_an_episode(rows):
    np.testing.assert_array_equal(rows.decided, steps_of_episodes(rows) % K == 0)
    assert rows.terminated.any() and rows.truncated.any()


def test_the_low_level_follows_each_decision_until_the_next(train, rows):
    """What a robot that knows nothing but the decisions would do is what happened."""
    env, time, seen = train.env, steps_of_episodes(rows), np.asarray(rows.observation)
    low, high = env.space.bounds
    targets, differs = [], 0
    for row, column in zip(*np.nonzero(np.asarray(rows.valid)), strict=True):
        decision = column - time[row, column] % K
        target = np.clip(
            seen[row, decision, :3] + env.subgoal_scale * np.asarray(rows.action[row, decision]), low, high
        )
        moved = np.clip(target - seen[row, column, :3], -hand_made_points.SPEED, hand_made_points.SPEED)
        np.testing.assert_allclose(seen[row, column + 1, :3], seen[row, column, :3] + moved, atol=1e-5)
        differs += not np.allclose(rows.action[row, column], rows.action[row, decision])
        targets.append(target)
    assert differs > 100  # Actions between decisions would have led elsewhere.


def by_hand(rows, discount: float, step_reward):
    """{(row, step of a decision): (return, discount of what follows, steps taken)}, from the definition."""
    valid, ends, found = np.asarray(rows.valid), np.asarray(rows.terminated), {}
    for row, first in zip(*np.nonzero(valid & np.asarray(rows.decided)), strict=True):
        total, taken = 0.0, 0
        while taken < K and first + taken < valid.shape[1] and valid[row, first + taken]:
            total += discount**taken * step_reward(row, first + taken)
            taken += 1
        found[row, first] = total, 0.0 if ends[row, first + taken - 1] else discount**taken, taken
    return found


@pytest.mark.parametrize("intrinsic_weight", [0.0, 3.0])
def test_returns_are_those_of_the_definition(train, rows, params, intrinsic_weight):
    """Eq. 5 and Eq. 16 over the steps of an interval; nothing after the end of an episode counts, and only termination
    ends what follows."""
    env, parts = train.env, train.parts
    everything = jnp.ones(env.goals.num_goals, bool)
    codes = GoalCode(jax.random.normal(jax.random.key(1), (env.goals.num_goals, 4)), jnp.ones((env.goals.num_goals, 4)))
    experience = Experience(
        buffer=rows,
        decision_count=replay.running_count(rows.valid & rows.decided),
        achieved=None,
        achieved_count=None,
        known=everything,
        usable=everything,
        dissimilarity=None,
        codes=codes,
    )
    row, first = (jnp.asarray(index) for index in np.nonzero(np.asarray(rows.valid & rows.decided)))
    batch = replay.transitions_at(rows, row, first, parts.agent.num_steps)
    hyper = Hyperparameters(discount=0.8, intrinsic_weight=intrinsic_weight)
    before = InfoGoalState(beta=jnp.zeros(()), scale=jnp.asarray(2.0))

    @jax.jit
    def transitions():
        reward, after, metrics = returns(
            parts, {"goal": None}, before, env, hyper, experience, with_rewards(env, experience, batch)
        )
        return (
            reward,
            after,
            metrics,
            agent_batch(parts, env, hyper, params, params, batch, reward, None, jax.random.key(0)),
        )

    reward, after, metrics, made = transitions()

    record, mean = np.asarray(rows.record), np.asarray(codes.mean)
    goal, position = np.asarray(rows.goal), np.asarray(env.unwrapped.positions)
    grid = position[: len(position) - len(env.goals.evaluated)]
    achieved = np.linalg.norm(record[:, :, None] - grid, axis=-1).argmin(-1)
    assert (env.goals_of(rows.record) >= 0).all()
    distance, scale = np.linalg.norm(mean[achieved[:, 1:]] - mean[goal], axis=-1), float(after.scale)
    reached = np.linalg.norm(record[:, 1:] - position[goal], axis=-1) < 0.05

    def step_reward(row, step):
        return reached[row, step] - intrinsic_weight / EPISODE_LENGTH * distance[row, step] / scale

    expected = by_hand(rows, 0.8, step_reward)
    assert list(expected) == list(zip(row.tolist(), first.tolist(), strict=True))
    np.testing.assert_allclose(reward, [total for total, _, _ in expected.values()], atol=1e-4)
    taken = np.concatenate([distance[r, f : f + steps] for (r, f), (_, _, steps) in expected.items()])
    np.testing.assert_allclose(scale, 2.0 + 0.01 * (taken.mean() - 2.0), rtol=1e-4)
    np.testing.assert_allclose(metrics["intrinsic_reward"], -taken.mean() / scale, rtol=1e-4)
    wins = np.concatenate([reached[r, f : f + steps] for (r, f), (_, _, steps) in expected.items()])
    np.testing.assert_allclose(metrics["external_reward"], wins.mean(), rtol=1e-4)

    np.testing.assert_allclose(made.discount, [following for _, following, _ in expected.values()], rtol=1e-5)
    np.testing.assert_array_equal(made.action, rows.action[row, first])
    steps = np.array([steps for _, _, steps in expected.values()])
    terminated = np.asarray(made.discount == 0)
    assert (steps[terminated] < K).any() and (
        (steps < K) & ~terminated
    ).any()  # Ends within an interval, of both kinds.
