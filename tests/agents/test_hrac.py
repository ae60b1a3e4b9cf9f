"""HRAC's high level on a task without physics: adjacency, transitions from decision to decision, their returns; which
loss trains which network, and the targets of the critics."""

import dataclasses

import hand_made
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made_points import EPISODE_LENGTH

from infogoal_jax import Hyperparameters, make_train, pairs, replay
from infogoal_jax.agents.hrac import HRACConfig
from infogoal_jax.envs.environment import Environment
from infogoal_jax.envs.target_states import Cells, SubgoalEnv, SubgoalState
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.learners.infogoal import InfoGoalState
from infogoal_jax.learners.learner import GoalCode
from infogoal_jax.train.experience import external_reward, usable_goals
from infogoal_jax.train.parts import Networks, Setup
from infogoal_jax.train.rollout import collect
from infogoal_jax.train.update import Sample, agent_batch, returns

K = hand_made_points.LONG_INTERVAL
"""Steps between decisions here: an episode of 12 steps ends within an interval, at the goal or when time is up."""


@pytest.fixture(scope="module")
def train():
    agent = HRACConfig(interval=hand_made_points.LONG_INTERVAL, hidden=(32,), adjacency_hidden=(32,))
    return make_train(
        hand_made_points.config(agent=agent), hand_made_points.steered(interval=hand_made_points.LONG_INTERVAL)
    )


@pytest.fixture(scope="module")
def params(train):
    return hand_made_points.random_params(train)


@pytest.fixture(scope="module")
def rows(train):
    """24 rows of 40 steps from fresh episodes, under subgoals that lead to the goal in half of the episodes and astray
    in the others."""
    env = train.env

    def policy(observation, goal, key):
        ahead = (env.unwrapped.positions[goal] - observation[:, :3]) / env.subgoal_scale
        astray = jax.random.uniform(key, ahead.shape, minval=-1.0)
        return jnp.clip(jnp.where((jnp.arange(24) % 2 == 0)[:, None], ahead, astray), -1.0, 1.0)

    def run(key):
        return collect(env, jax.vmap(env.reset)(jax.random.split(key, 24)), policy, key, 40)[1]

    return jax.jit(run)(jax.random.key(0))


def steps_of_episodes(rows):
    """int [R, T]: how many steps of its episode came before each step of rows that start with a fresh episode."""
    time, valid = np.zeros(rows.valid.shape, int), np.asarray(rows.valid)
    for column in range(1, valid.shape[1]):
        time[:, column] = np.where(valid[:, column - 1], time[:, column - 1] + 1, 0)
    return time


def test_cells_are_adjacent_once_they_were_k_steps_apart_and_stay_so(train, rows):
    agent, env, rows = train.parts.agent, train.env, jax.device_get(rows)
    cells = Cells.over(env.space.bounds, train.config.agent.cell)
    apart = np.asarray(pairs.initial_dissimilarity(cells.count))[None]
    place, episode = np.asarray(jax.jit(cells.of)(rows.observation[..., :3])), np.asarray(rows.episode())
    expected = np.asarray(apart[0]).copy()
    observe = jax.jit(agent.observe)
    for half in (slice(0, 12), slice(12, 24)):
        after = np.asarray(observe(apart, jax.tree.map(lambda leaf, half=half: leaf[half], rows)))
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
    assert (apart == apart.transpose(0, 2, 1)).all() and not np.diagonal(apart, axis1=1, axis2=2).any()


def test_what_the_low_level_does_not_change_is_that_of_the_task(train):
    """Every value of an environment: one that was forgotten would have its default."""
    values = {name for name, value in vars(Environment).items() if not (name.startswith("_") or callable(value))}
    assert values <= vars(SubgoalEnv).keys()
    members = {"can_fail": True, "simulated": False, "costly_reset": True, "failed": lambda self, state: state > 1}
    failing = type("Failing", (type(train.env.env),), members)(**vars(train.env.env))
    env = train.env.replace(env=failing)
    assert env.can_fail and not env.simulated and env.costly_reset
    assert [env.failed(SubgoalState(inner=state, target=None)) for state in (1, 2)] == [False, True]


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


@pytest.mark.parametrize("intrinsic_weight", [pytest.param(0.0, marks=pytest.mark.long), 3.0])
def test_returns_are_those_of_the_definition(train, rows, params, intrinsic_weight):
    """Eq. 5 and Eq. 16 over the steps of an interval; nothing after the end of an episode counts, and only termination
    ends what follows."""
    env, parts = train.env, train.parts
    everything = pairs.KnownGoals(jnp.ones(env.goals.num_goals, bool))
    codes = GoalCode(jax.random.normal(jax.random.key(1), (env.goals.num_goals, 4)), jnp.ones((env.goals.num_goals, 4)))
    experience = hand_made.experience(rows, rows.record == 0, everything, codes=codes)
    row, first = (index.astype(np.int32) for index in np.nonzero(np.asarray(rows.valid) & np.asarray(rows.decided)))
    batch = jax.jit(lambda rows: replay.transitions_at(rows, row, first, parts.agent.num_steps))(rows)
    hyper = Hyperparameters(discount=0.8, intrinsic_weight=intrinsic_weight)
    setup = train.setup(hyper)
    drawn = Sample(batch, external_reward(env, batch), usable_goals(setup, env.goals_of(batch.records)), pairs=None)
    before = InfoGoalState(beta=jnp.zeros(()), scale=jnp.asarray(2.0))

    @jax.jit
    def transitions():
        reward, after, metrics = returns(setup, {"goal": None}, before, experience, drawn)
        networks = Networks(params, params, view_key=None)
        return reward, after, metrics, agent_batch(setup, networks, batch, reward, jax.random.key(0))

    reward, after, metrics, made = transitions()

    record, mean = np.asarray(rows.record), np.asarray(codes.mean)
    goal, position = np.asarray(rows.desired_goal), np.asarray(env.unwrapped.positions)
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


@pytest.fixture(scope="module")
def gradients(train, rows):
    """The gradient of HRAC's loss, and its metrics, for parameters, target parameters, hyperparameters and whether goal
    encoders are left alone."""
    row, first = (index[:64] for index in np.nonzero(np.asarray(rows.valid) & np.asarray(rows.decided)))
    cells = Cells.over(train.env.space.bounds, train.config.agent.cell)

    @jax.jit
    def seen(rows):
        apart = train.parts.agent.observe(pairs.initial_dissimilarity(cells.count)[None], rows)
        return replay.transitions_at(rows, row, first, train.parts.agent.num_steps), apart

    batch, apart = seen(rows)

    def gradient(params, target_params, hyper, stop=False):
        parts = train.parts._replace(config=dataclasses.replace(train.config, stop_encoder_gradient=stop))

        def loss(params):
            networks = Networks(params, target_params, view_key=None)
            setup = Setup(parts, hyper, train.env)
            codes = agent_batch(setup, networks, batch, jnp.ones(64), jax.random.key(1))
            return parts.agent.loss(
                params["agent"], target_params["agent"], codes, apart, hyper.agent, jax.random.key(2)
            )

        return jax.grad(loss, has_aux=True)(params)

    return jax.jit(gradient, static_argnums=3)


def scaled(params, name: str):
    """The parameters with another actor, critic or adjacency network."""
    other = jax.tree.map(lambda leaf: 1.5 * np.asarray(leaf) + np.float32(0.01), params["agent"][name])
    return params | {"agent": params["agent"] | {name: other}}


def norm(tree) -> float:
    """The largest entry."""
    return max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(tree))


def assert_close(one, other):
    jax.tree.map(lambda first, second: np.testing.assert_allclose(first, second, atol=1e-5), one, other)


def test_the_critic_trains_the_encoders_and_the_actor_trains_nothing_but_itself(train, params, gradients):
    hyper = train.config.hyper
    found, _ = gradients(params, params, hyper)
    for part in (found["goal"], found["state"], *(found["agent"][name] for name in ("actor", "critic", "adjacency"))):
        assert norm(part) > 0
    other_actor, _ = gradients(scaled(params, "actor"), params, hyper)
    for gradient in (found, other_actor):
        gradient["others"] = [
            gradient["goal"],
            gradient["state"],
            gradient["agent"]["critic"],
            gradient["agent"]["adjacency"],
        ]
    assert_close(other_actor["others"], found["others"])
    other_critic, _ = gradients(scaled(params, "critic"), params, hyper)
    # It climbs the critic.
    assert norm(jax.tree.map(np.subtract, other_critic["agent"]["actor"], found["agent"]["actor"])) > 1e-4
    assert_close(other_critic["agent"]["adjacency"], found["agent"]["adjacency"])


@pytest.mark.long
def test_the_goal_encoder_can_be_left_to_its_own_loss(train, params, gradients):
    hyper = train.config.hyper
    let_through, _ = gradients(params, params, hyper)
    stopped, _ = gradients(params, params, hyper, True)
    assert norm(stopped["goal"]) == 0 and norm(let_through["goal"]) > 0
    assert_close(stopped["state"], let_through["state"])


def test_targets_come_from_the_target_networks_where_an_episode_goes_on(train, params, gradients):
    hyper = train.config.hyper
    _, near = gradients(params, params, hyper.replace(discount=0.0))
    _, blind = gradients(params, scaled(params, "critic"), hyper.replace(discount=0.0))
    assert near["td_error"] == blind["td_error"]  # Nothing follows.
    _, far = gradients(params, scaled(params, "critic"), hyper)
    _, smooth = gradients(params, params, hyper)
    assert len({float(found["td_error"]) for found in (near, far, smooth)}) == 3
    _, sharp = gradients(params, params, with_values(hyper, {"agent.target_noise": 0.0}))
    assert smooth["td_error"] != sharp["td_error"]


def test_the_adjacency_penalty_moves_the_actor_alone(train, params, gradients):
    far_off = scaled(params, "adjacency")
    # Everything lies far apart.
    far_off["agent"]["adjacency"] = jax.tree.map(lambda leaf: np.float32(4) * leaf, far_off["agent"]["adjacency"])
    free, metrics = gradients(far_off, far_off, with_values(train.config.hyper, {"agent.adjacency_weight": 0.0}))
    bound, _ = gradients(far_off, far_off, with_values(train.config.hyper, {"agent.adjacency_weight": 20.0}))
    assert metrics["adjacency_penalty"] > 0
    assert norm(jax.tree.map(np.subtract, bound["agent"]["actor"], free["agent"]["actor"])) > 1e-3
    for name in ("critic", "adjacency"):
        assert_close(bound["agent"][name], free["agent"][name])
    assert_close(bound["goal"], free["goal"])
