"""HRAC's losses: its adjacency network against the numbers of its authors' code (fixtures/README.md), and where ours is
meant to differ; which loss trains which network, and the targets of the critics."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import places
import pytest

from infogoal_jax import networks, pairs, replay
from infogoal_jax.agents import hrac, td3
from infogoal_jax.envs.target_states import Cells
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.update import agent_batch

FIXTURE = places.recorded("hrac")
INTERVAL = int(FIXTURE["interval"])


def assert_relatively_close(found, recorded):
    """To 1e-5 of the largest number recorded."""
    np.testing.assert_allclose(found, recorded, rtol=1e-5, atol=1e-5 * np.abs(recorded).max())


def test_margins_are_those_of_the_authors_code():
    recorded = tuple(float(FIXTURE[name]) for name in ("margin_positive", "margin_negative", "goal_margin"))
    assert recorded == (hrac.ADJACENT, hrac.APART, hrac.PENALTY_STARTS)


def test_adjacency_loss_and_its_gradients_are_those_of_the_authors_code():
    """Among the pairs are two that coincide, one adjacent and one not: their gradient is 0."""
    first, second, adjacent = (
        jnp.asarray(FIXTURE["first"]),
        jnp.asarray(FIXTURE["second"]),
        jnp.asarray(FIXTURE["labels"] == 1),
    )

    def loss(first, second, weight):
        return hrac.adjacency_loss(hrac.length(first - second), adjacent, weight)

    assert_relatively_close(hrac.length(first - second), FIXTURE["distance"])
    of_each = jax.vmap(lambda weight: loss(first, second, weight))(jnp.eye(len(adjacent)))
    assert_relatively_close(of_each, FIXTURE["pair_losses"])
    value, gradients = jax.value_and_grad(loss, argnums=(0, 1))(first, second, jnp.ones(len(adjacent)))
    assert_relatively_close(value, FIXTURE["loss"])
    assert_relatively_close(gradients[0], FIXTURE["gradient_first"])
    assert_relatively_close(gradients[1], FIXTURE["gradient_second"])
    assert not gradients[0][:2].any()


def test_penalty_of_subgoals_and_its_gradient_are_those_of_the_authors_code():
    """Through the authors' network. They add 1e-6 to each difference of codes and nothing under the root: less than
    1e-5 of the numbers here."""
    network = networks.MLP((24, 24, 24), 32)
    layers = {
        f"Dense_{n}": {"kernel": FIXTURE[f"network_kernel_{n + 1}"], "bias": FIXTURE[f"network_bias_{n + 1}"]}
        for n in range(4)
    }
    states = jnp.asarray(FIXTURE["states"])

    def embed(states):
        return network.apply({"params": layers}, states)

    def penalties(subgoals):
        return hrac.adjacency_penalty(hrac.length(embed(states) - embed(states + subgoals)))

    subgoals = jnp.asarray(FIXTURE["subgoals"])
    assert_relatively_close(embed(states), FIXTURE["embedding_states"])
    assert_relatively_close(embed(states + subgoals), FIXTURE["embedding_targets"])
    assert_relatively_close(penalties(subgoals), FIXTURE["goal_losses"])
    value, gradient = jax.value_and_grad(lambda subgoals: penalties(subgoals).mean())(subgoals)
    assert_relatively_close(value, FIXTURE["goal_loss"])
    assert_relatively_close(gradient, FIXTURE["gradient_subgoals"])


def high_level(interval: int):
    """HRAC's high level over positions in the plane, with cells of side 1 around whole numbers; and those cells."""
    reach = np.abs(FIXTURE["cells"]).max()
    cells = Cells.over(np.array([[-reach, -reach], [reach, reach]]), 1.0)
    space = SimpleNamespace(
        size=2, components=1, cells=lambda side: cells, of=lambda states: states, parts=lambda states: states[None]
    )
    return hrac.make(hrac.HRACConfig(interval=interval, cell=1.0), SimpleNamespace(space=space)), cells


def rows_of(trajectories) -> Trajectories:
    """Trajectories [R, T, 2] as rows of which each is one episode that does not end."""
    going_on = jnp.ones((trajectories.shape[0], trajectories.shape[1] - 1), bool)
    others = dict.fromkeys(Trajectories.__dataclass_fields__)
    return Trajectories(**(others | {"observation": jnp.asarray(trajectories), "valid": going_on}))


def remembered(interval: int, trajectories) -> np.ndarray:
    """What `observe` remembers as adjacent after these trajectories, three at a time, between the recorded cells: bool
    [49, 49]."""
    agent, cells = high_level(interval)
    apart = pairs.initial_dissimilarity(cells.count)[None]
    for start in range(0, len(trajectories), 3):
        apart = agent.observe(apart, rows_of(trajectories[start : start + 3]))
    place = np.asarray(cells.of(jnp.asarray(FIXTURE["cells"], jnp.float32)))
    assert (place >= 0).all() and len(set(place.tolist())) == len(place)
    return ~np.asarray(apart[0])[np.ix_(place, place)]


@pytest.mark.parametrize(("count", "recorded"), [(3, "adjacency_after_three"), (6, "adjacency")])
def test_adjacent_cells_are_those_of_the_authors_code_for_an_interval_one_longer(count, recorded):
    """Theirs are adjacent up to k - 1 steps apart, ours up to k."""
    known = len(FIXTURE[recorded])
    np.testing.assert_array_equal(
        remembered(INTERVAL - 1, FIXTURE["trajectories"][:count])[:known, :known], FIXTURE[recorded]
    )


def test_cells_k_steps_apart_are_adjacent_here():
    """By HRAC's definition (a subgoal is reached within k steps). Nothing else is added, and the network here is
    trained on pairs k steps apart."""
    ours = remembered(INTERVAL, FIXTURE["trajectories"])
    expected = FIXTURE["adjacency"].astype(bool)
    number = {tuple(cell): index for index, cell in enumerate(FIXTURE["cells"].tolist())}
    visited = [
        [number[tuple(cell)] for cell in trajectory]
        for trajectory in np.round(FIXTURE["trajectories"]).astype(int).tolist()
    ]
    for trajectory in visited:
        for first, second in zip(trajectory, trajectory[INTERVAL:], strict=False):
            expected[first, second] = expected[second, first] = True
    np.testing.assert_array_equal(ours, expected)
    assert (ours & ~FIXTURE["adjacency"].astype(bool)).any()


def test_recorded_training_pairs_carry_the_labels_that_are_remembered():
    """The authors train on every pair of cells once; here the label of a pair of states is looked up by their cells in
    the same way."""
    number = {tuple(cell): index for index, cell in enumerate(FIXTURE["cells"].tolist())}
    first, second = (
        [number[tuple(cell)] for cell in FIXTURE[f"training_{name}"].tolist()] for name in ("first", "second")
    )
    ours = remembered(INTERVAL - 1, FIXTURE["trajectories"])
    np.testing.assert_array_equal(ours[first, second], FIXTURE["training_labels"])


@pytest.fixture(scope="module")
def gradients(train, rows):
    """The gradient of HRAC's loss, and its metrics, for parameters, target parameters, hyperparameters and whether goal
    encoders are left alone."""
    row, first = (jnp.asarray(index[:64]) for index in np.nonzero(np.asarray(rows.valid & rows.decided)))
    batch = replay.transitions_at(rows, row, first, train.parts.agent.num_steps)
    cells = Cells.over(train.env.space.bounds, train.config.agent.cell)
    apart = train.parts.agent.observe(pairs.initial_dissimilarity(cells.count)[None], rows)

    def gradient(params, target_params, hyper, stop=False):
        parts = train.parts._replace(config=dataclasses.replace(train.config, stop_encoder_gradient=stop))

        def loss(params):
            codes = agent_batch(
                parts, train.env, hyper, params, target_params, batch, jnp.ones(64), None, jax.random.key(1)
            )
            return parts.agent.loss(
                params["agent"], target_params["agent"], codes, apart, hyper.agent, jax.random.key(2)
            )

        return jax.grad(loss, has_aux=True)(params)

    return jax.jit(gradient, static_argnums=3)


def scaled(params, name: str):
    """The parameters with another actor, critic or adjacency network."""
    return params | {
        "agent": params["agent"] | {name: jax.tree.map(lambda leaf: 1.5 * leaf + 0.01, params["agent"][name])}
    }


def norm(tree) -> float:
    """The largest entry."""
    return max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(tree))


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
    assert norm(jax.tree.map(jnp.subtract, other_critic["agent"]["actor"], found["agent"]["actor"])) > 1e-4
    assert_close(other_critic["agent"]["adjacency"], found["agent"]["adjacency"])


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
    far_off["agent"]["adjacency"] = jax.tree.map(lambda leaf: 4.0 * leaf, far_off["agent"]["adjacency"])
    free, metrics = gradients(far_off, far_off, with_values(train.config.hyper, {"agent.adjacency_weight": 0.0}))
    bound, _ = gradients(far_off, far_off, with_values(train.config.hyper, {"agent.adjacency_weight": 20.0}))
    assert metrics["adjacency_penalty"] > 0
    assert norm(jax.tree.map(jnp.subtract, bound["agent"]["actor"], free["agent"]["actor"])) > 1e-3
    for name in ("critic", "adjacency"):
        assert_close(bound["agent"][name], free["agent"][name])
    assert_close(bound["goal"], free["goal"])


def test_smoothing_noise_is_clipped_and_actions_stay_in_range():
    """As in TD3's own code: noise of standard deviation 0.2, clipped at 0.5."""
    action = jnp.tile(jnp.array([0.0, 0.9, -1.0]), (20_000, 1))
    noisy = np.asarray(td3.smoothed(jax.random.key(0), action, 0.2))
    assert abs(noisy[:, 0]).max() == pytest.approx(0.5) and 0.18 < noisy[:, 0].std() < 0.2
    assert abs(noisy).max() <= 1
    explored = np.asarray(td3.explore(jax.random.key(0), action, 0.01, 0.25))
    assert abs(explored).max() <= 1
    assert np.mean(abs(explored[:, 0]) > 0.06) == pytest.approx(0.25 * 0.94, abs=0.02)
    np.testing.assert_array_equal(td3.explore(jax.random.key(0), action, 0.0, 0.0), action)


def test_the_smaller_critic_sets_the_target_for_both():
    values, target = jnp.array([[0.0, 3.0], [2.0, 3.0]]), jnp.array([1.0, 3.0])
    assert td3.critic_loss(values, target, huber=True) == pytest.approx((0.5 + 0.5) / 2)
    assert jax.grad(lambda target: td3.critic_loss(values, target, huber=True))(target).max() == 0
    both = td3.TwinCritic((8,))
    params = both.init(jax.random.key(0), jnp.zeros(2), jnp.zeros(1))
    one, other = both.apply(params, jnp.ones((5, 2)), jnp.ones((5, 1)))
    assert one.shape == (5,) and not np.allclose(one, other)
