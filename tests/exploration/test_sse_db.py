"""The dynamic bottleneck: its bonus knows moves that were made, is of the scale promised, and trains nothing that is
not its own."""

import dataclasses

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from infogoal_jax import presets
from infogoal_jax.errors import UserError
from infogoal_jax.exploration import sse_db
from infogoal_jax.exploration.explorer import Moves
from infogoal_jax.loading import load_environment, make_train
from infogoal_jax.replay import Trajectories

STATES, ACTIONS, FEATURES, DISCOUNT = 24, 4, 16, 0.9
SMALL = sse_db.SSEDBConfig(latent_size=8, width=32, projection_size=16, kl_weight=0.1)


@dataclasses.dataclass(frozen=True)
class World:
    """A few states [K, F], and where each move leads, [K, A]."""

    features: jax.Array
    following: jax.Array

    def moves(self, state, action) -> Moves:
        """These moves, int32 [B] each."""
        return Moves(self.features[state], action, self.features[self.following[state, action]])


def make_world(key: jax.Array) -> World:
    return World(*drawn_world(key))


@jax.jit
def drawn_world(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    features_key, following_key = jax.random.split(key)
    features = jax.nn.relu(jax.random.normal(features_key, (STATES, FEATURES)))
    return features, jax.random.randint(following_key, (STATES, ACTIONS), 0, STATES)


def rows_of(observation, action, valid) -> Trajectories:
    """Rows in which nothing matters but what was seen and done."""
    nothing = jnp.zeros(valid.shape, bool)
    return Trajectories(
        observation, observation, action, jnp.zeros(valid.shape, jnp.int32), valid, nothing, nothing, nothing
    )


@jax.jit
def random_rows(key: jax.Array) -> Trajectories:
    num_rows, steps, keys = 6, 15, jax.random.split(key, 3)
    return rows_of(
        jax.random.randint(keys[0], (num_rows, steps + 1), 0, STATES),
        jax.random.randint(keys[1], (num_rows, steps), 0, ACTIONS),
        jax.random.bernoulli(keys[2], 0.9, (num_rows, steps)),
    )


def compute_bonus(explorer, params, state, world: World, rows: Trajectories, written=None):
    written = jnp.ones(rows.valid.shape[0], bool) if written is None else written
    bonus = jax.jit(explorer.compute_bonus, static_argnums=5)
    return bonus(params, state, world.features, rows, written, DISCOUNT)


def trained(explorer, params, state, world: World, share: jax.Array, key: jax.Array, updates: int):
    """Parameters after updates on moves drawn with these shares [K, A], and the metrics of each update."""
    optimizer = optax.adam(1e-3)

    def update(carry, key):
        params, optimizer_state = carry
        draw_key, loss_key = jax.random.split(key)
        drawn = jax.random.choice(draw_key, STATES * ACTIONS, (64,), p=share.reshape(-1))
        moves = world.moves(drawn // ACTIONS, drawn % ACTIONS)

        def total(params):
            loss, metrics, _ = explorer.loss(params, state, moves, loss_key)
            return loss, metrics

        gradient, metrics = jax.grad(total, has_aux=True)(params)
        change, optimizer_state = optimizer.update(gradient, optimizer_state)
        return (optax.apply_updates(params, change), optimizer_state), metrics

    (params, _), metrics = jax.lax.scan(update, (params, optimizer.init(params)), jax.random.split(key, updates))
    return params, metrics


@pytest.mark.long
def test_bonus_falls_with_familiarity():
    """Early in training (docs/reference/methods.md says what becomes of it): made often, a move ends with less of a
    bonus than it began with, and than moves that are never made.

    Never made are an action, wherever it is possible, and half of the states with the other actions; on the mean of
    each of four worlds.
    """
    explorer = sse_db.make(SMALL)
    often = ((jnp.arange(STATES) < STATES // 2)[:, None] & (jnp.arange(ACTIONS) > 0)).astype(jnp.float32)
    new_action = jnp.zeros_like(often).at[:, 0].set(1.0)
    new_state = 1.0 - jnp.maximum(often, new_action)

    def bonuses(key):
        world_key, init_key, train_key, rows_key = jax.random.split(key, 4)
        world, rows = make_world(world_key), random_rows(rows_key)
        params, state = explorer.init(init_key, world.features[0], ACTIONS)
        after, _ = trained(explorer, params, state, world, often / often.sum(), train_key, 200)
        tables = []
        for each in (params, after):
            table, surveyed = compute_bonus(explorer, each, state, world, rows)
            tables.append(table * surveyed.scale)  # In nats again: two scales could not be compared.
        return [
            (table * moves).sum() / moves.sum()
            for table, moves in zip([tables[0]] + [tables[1]] * 3, (often, often, new_state, new_action), strict=True)
        ]

    before, known, unknown, never = np.asarray(jax.jit(jax.vmap(bonuses))(jax.random.split(jax.random.key(0), 4)))
    assert (known < before / 2).all() and (known < unknown).all() and (known < never).all()


@pytest.mark.long
def test_next_state_is_learned_to_be_told():
    """Given time and a wide bottleneck, the code of a move tells where it leads: accuracy and likelihood rise."""
    world = make_world(jax.random.key(1))
    size = world.features.shape[1]
    explorer = sse_db.make(dataclasses.replace(SMALL, kl_weight=1e-3, prediction_weight=0.1 * size))
    params, state = hand_made.initial(explorer, jax.random.key(2), world.features[0], ACTIONS)
    share = jnp.full((STATES, ACTIONS), 1 / (STATES * ACTIONS))
    metrics = jax.jit(lambda key: trained(explorer, params, state, world, share, key, 400)[1])(jax.random.key(3))
    first, last = (
        jax.tree.map(lambda values, part=part: float(values[part].mean()), metrics)
        for part in (slice(10), slice(-10, None))
    )
    assert first["accuracy"] < 0.3 and last["accuracy"] > 0.4
    assert (
        last["prediction_loss"] < first["prediction_loss"] - 3 / size
        and last["contrastive_loss"] < first["contrastive_loss"] - 1
    )


def test_contrast_is_the_softmax_of_bilinear_scores():
    """By hand: -log of exp(u W v+) over the sum over all next states of the batch; log B for predictions that tell
    nothing."""
    score, predicted, followed = (
        jax.random.normal(jax.random.key(seed), shape) for seed, shape in enumerate([(6, 6), (5, 6), (5, 6)])
    )
    by_hand = np.exp(
        [[u @ np.asarray(score) @ v / np.sqrt(6) for v in np.asarray(followed)] for u in np.asarray(predicted)]
    )
    np.testing.assert_allclose(
        sse_db.contrast(score, predicted, followed),
        np.log(by_hand / by_hand.sum(1, keepdims=True)),
        rtol=1e-4,
        atol=1e-5,
    )
    nothing_told = sse_db.contrast(score, predicted, jnp.broadcast_to(followed[:1], followed.shape))
    np.testing.assert_allclose(-jnp.diagonal(nothing_told), np.log(5), rtol=1e-5)


def test_loss_is_the_sum_of_its_parts_and_a_state_is_right_wherever_it_stands():
    """Weights apply to the parts they are named after; where all moves lead to one state, every choice is right."""
    world, weights = (
        make_world(jax.random.key(0)),
        {"kl_weight": 0.3, "prediction_weight": 0.02, "contrastive_weight": 5.0},
    )
    explorer = sse_db.make(dataclasses.replace(SMALL, **weights))
    params, state = hand_made.initial(explorer, jax.random.key(1), world.features[0], ACTIONS)
    moves, loss_of = world.moves(jnp.arange(STATES), jnp.arange(STATES) % ACTIONS), jax.jit(explorer.loss)
    loss, metrics, _ = loss_of(params, state, moves, jax.random.key(2))
    parts = sum(
        weight * metrics[name]
        for name, weight in zip(("kl", "prediction_loss", "contrastive_loss"), weights.values(), strict=True)
    )
    np.testing.assert_allclose(loss, parts, rtol=1e-5)
    same = moves.replace(next_features=jnp.broadcast_to(world.features[:1], moves.next_features.shape))
    assert loss_of(params, state, same, jax.random.key(2))[1]["accuracy"] == 1


def test_gradient_reaches_the_state_and_never_the_next_state():
    """The loss shapes the state encoder through the state that is left; the momentum code of the next is a target
    only."""
    explorer, world = sse_db.make(SMALL), make_world(jax.random.key(0))
    params, state = hand_made.initial(explorer, jax.random.key(1), world.features[0], ACTIONS)
    moves = world.moves(jnp.arange(STATES), jnp.arange(STATES) % ACTIONS)

    def loss(params, features, following):
        return explorer.loss(
            params, state, moves.replace(features=features, next_features=following), jax.random.key(2)
        )[0]

    own, to_state, to_next = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(params, moves.features, moves.next_features)
    own, to_state, to_next = jax.device_get((own, to_state, to_next))
    assert (np.abs(to_state).max(1) > 0).all() and not to_next.any()
    assert all(leaf.any() for leaf in jax.tree.leaves(own))


def returns_by_hand(bonus: np.ndarray, rows: Trajectories, written: np.ndarray) -> list[float]:
    """Discounted returns of the bonus at every valid step of the written rows, an episode at a time."""
    found = []
    for row in np.flatnonzero(written):
        for first in np.flatnonzero(rows.valid[row]):
            total, step = 0.0, first
            while step < rows.valid.shape[1] and rows.valid[row, step]:
                total += DISCOUNT ** (step - first) * bonus[rows.observation[row, step], rows.action[row, step]]
                step += 1
            found.append(total)
    return found


@pytest.mark.long
def test_returns_of_the_bonus_have_deviation_one():
    """After every compute_bonus, over valid steps of written rows. Both kinds of bonus have one order of moves."""
    world, rows, tables = make_world(jax.random.key(0)), random_rows(jax.random.key(1)), []
    written = jnp.arange(6) < 4
    for square_root in (False, True):
        explorer = sse_db.make(dataclasses.replace(SMALL, square_root=square_root))
        params, state = hand_made.initial(explorer, jax.random.key(2), world.features[0], ACTIONS)
        bonus, after = compute_bonus(explorer, params, state, world, rows, written)
        assert bonus.shape == (STATES, ACTIONS) and (bonus >= 0).all()
        np.testing.assert_allclose(
            np.std(returns_by_hand(np.asarray(bonus), rows, np.asarray(written))), 1.0, rtol=1e-4
        )
        wider = jax.tree.map(lambda leaf: 3.0 * leaf, params)
        later, _ = compute_bonus(explorer, wider, after, world, rows, written)
        np.testing.assert_allclose(
            np.std(returns_by_hand(np.asarray(later), rows, np.asarray(written))), 1.0, rtol=1e-4
        )
        tables.append(bonus * after.scale)
    np.testing.assert_allclose(tables[1] ** 2, tables[0], rtol=1e-3, atol=1e-5)


def test_steps_that_were_not_taken_do_not_enter_the_scale():
    """Whatever stands at invalid steps and in rows that are not written yet."""
    explorer, world, rows = sse_db.make(SMALL), make_world(jax.random.key(0)), random_rows(jax.random.key(1))
    params, state = hand_made.initial(explorer, jax.random.key(2), world.features[0], ACTIONS)
    written = jnp.arange(6) < 4
    other = random_rows(jax.random.key(3))
    counted = rows.valid & written[:, None]
    changed = rows.replace(
        action=jnp.where(counted, rows.action, other.action), valid=jnp.where(written[:, None], rows.valid, other.valid)
    )
    assert (changed.action != rows.action).any() and (changed.valid != rows.valid).any()
    bonus, same, other = (
        compute_bonus(explorer, params, state, world, *given)[0]
        for given in ((rows, written), (changed, written), (rows, np.ones(6, bool)))
    )
    np.testing.assert_array_equal(bonus, same)
    assert not np.allclose(bonus, other)


def test_nothing_collected_gives_no_endless_bonus():
    explorer, world, rows = sse_db.make(SMALL), make_world(jax.random.key(0)), random_rows(jax.random.key(1))
    params, state = hand_made.initial(explorer, jax.random.key(2), world.features[0], ACTIONS)
    bonus, after = compute_bonus(explorer, params, state, world, rows, jnp.zeros(6, bool))
    assert np.isfinite(bonus).all() and after.scale == 0  # The next compute_bonus is the first.


@pytest.mark.long
@pytest.mark.parametrize("method", ["none", "infogoal"])
def test_a_run_with_the_explorer(method):
    """Beside any learner: every number is finite, the explorer's have their names, and the scale is that of moves that
    were made."""
    config = hand_made.config(
        method, num_epochs=1, epochs_per_evaluation=1, updates_per_epoch=2, evaluation_starts=1, explorer=SMALL
    )
    result = jax.jit(make_train(config, hand_made.environment()))(jax.random.key(0))
    names = {name for name in result.epochs if name.startswith("explorer/")}
    assert names == {f"explorer/{name}" for name in ("kl", "prediction_loss", "contrastive_loss", "accuracy")}
    assert all(
        np.isfinite(leaf).all() for leaf in jax.tree.leaves((result.epochs, result.params, result.state.explorer))
    )
    assert result.state.explorer.scale > sse_db.MINIMUM_RETURN


def test_method_by_its_own_name_is_the_bare_agent_with_the_explorer():
    config = presets.load("object_search", "sse_db")
    assert (presets.names_of(config)["learner"], presets.names_of(config)["explorer"], presets.name_of(config)) == (
        "none",
        "sse_db",
        "sse_db",
    )
    assert presets.name_of(presets.load("object_search", "infogoal", explorer="sse_db")) == "infogoal+sse_db"


def test_a_task_without_a_finite_set_of_observations_is_refused():
    config = presets.load("fetch_reach", "none", explorer="sse_db")
    with pytest.raises(UserError, match="explorer = 'sse_db': .*bonus is kept.*give none"):
        load_environment(config)
