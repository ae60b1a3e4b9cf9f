"""HRAC's losses by hand, and its adjacency network against the numbers of its authors' code (fixtures/README.md), and
where ours is meant to differ; cells of positions; TD3's targets."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import assert_relatively_close, recorded

from infogoal_jax import networks, pairs, presets
from infogoal_jax.agents import hrac, td3
from infogoal_jax.agents.hrac import HRACConfig, adjacency_loss, adjacency_penalty
from infogoal_jax.envs.fetch.targets import TargetSpace
from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.envs.target_states import Cells
from infogoal_jax.replay import Trajectories

FIXTURE = recorded("hrac")
INTERVAL = int(FIXTURE["interval"])


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
    assert np.isfinite(jax.jit(jax.grad(lambda vector: hrac.length(vector)))(jnp.zeros(3))).all()


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
    value, gradients = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(first, second, jnp.ones(len(adjacent)))
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

    @jax.jit
    def embed(states):
        return network.apply({"params": layers}, states)

    @jax.jit
    def penalties(subgoals):
        return hrac.adjacency_penalty(hrac.length(embed(states) - embed(states + subgoals)))

    subgoals = jnp.asarray(FIXTURE["subgoals"])
    assert_relatively_close(embed(states), FIXTURE["embedding_states"])
    assert_relatively_close(embed(states + subgoals), FIXTURE["embedding_targets"])
    assert_relatively_close(penalties(subgoals), FIXTURE["goal_losses"])
    value, gradient = jax.jit(jax.value_and_grad(lambda subgoals: penalties(subgoals).mean()))(subgoals)
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
    apart, observe = pairs.initial_dissimilarity(cells.count)[None], jax.jit(agent.observe)
    for start in range(0, len(trajectories), 3):
        apart = observe(apart, rows_of(trajectories[start : start + 3]))
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


def test_smoothing_noise_is_clipped_and_actions_stay_in_range():
    """As in TD3's own code: noise of standard deviation 0.2, clipped at 0.5."""
    action = jnp.tile(jnp.array([0.0, 0.9, -1.0]), (20_000, 1))
    noisy = np.asarray(jax.jit(td3.smoothed)(jax.random.key(0), action, 0.2))
    assert abs(noisy[:, 0]).max() == pytest.approx(0.5) and 0.18 < noisy[:, 0].std() < 0.2
    assert abs(noisy).max() <= 1
    explore = jax.jit(td3.explore)
    explored = np.asarray(explore(jax.random.key(0), action, 0.01, 0.25))
    assert abs(explored).max() <= 1
    assert np.mean(abs(explored[:, 0]) > 0.06) == pytest.approx(0.25 * 0.94, abs=0.02)
    np.testing.assert_array_equal(explore(jax.random.key(0), action, 0.0, 0.0), action)


def test_the_smaller_critic_sets_the_target_for_both():
    values, target = jnp.array([[0.0, 3.0], [2.0, 3.0]]), jnp.array([1.0, 3.0])
    loss, slope = jax.jit(jax.value_and_grad(lambda target: td3.critic_loss(values, target, huber=True)))(target)
    assert loss == pytest.approx((0.5 + 0.5) / 2) and slope.max() == 0
    both = td3.TwinCritic((8,))
    seen = np.ones((5, 2), np.float32), np.ones((5, 1), np.float32)
    one, other = jax.jit(lambda key: both.apply(both.init(key, *seen), *seen))(jax.random.key(0))
    assert one.shape == (5,) and not np.allclose(one, other)
