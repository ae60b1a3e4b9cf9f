"""COGOAL pulls together goals that are achieved close together in time, against goals drawn at random, similar ones
too."""

import functools
from types import SimpleNamespace

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from infogoal_jax import make_train, pairs
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import NoHyperparameters
from infogoal_jax.learners import cogoal
from infogoal_jax.learners.learner import GoalCode, SampleSpec
from infogoal_jax.pairs import GoalPairs
from infogoal_jax.train.experience import Experience
from infogoal_jax.train.parts import Setup
from infogoal_jax.train.update import sample_pairs

GROUPS, SIZE = 3, 4
GOALS = GROUPS * SIZE
GROUP = np.arange(GOALS) % GROUPS


@functools.partial(jax.jit, static_argnames="norm_penalty")
def loss_of(codes, batch: GoalPairs, norm_penalty: float = 0.0):
    """Loss and metrics of these codes [N, d]."""
    learner = cogoal.make(cogoal.CoGoalConfig(norm_penalty=norm_penalty))
    seen = hand_made.learner_batch(GoalCode(codes).__getitem__, pairs=batch)
    return learner.loss({}, (), seen, NoHyperparameters(), jax.random.key(0))[:2]


def pairs_of(anchor, positive, negative, positive_weight=None, negative_weight=None) -> GoalPairs:
    """Pairs of weight 1, but for the weights given."""
    anchor, positive, negative = map(jnp.asarray, (anchor, positive, negative))
    weights = [
        jnp.ones(shape) if given is None else jnp.asarray(given)
        for given, shape in ((positive_weight, anchor.shape), (negative_weight, negative.shape))
    ]
    return GoalPairs(anchor, positive, jnp.broadcast_to(anchor[:, None], negative.shape), negative, *weights)


def test_loss_is_the_contrastive_bound_of_codes_without_noise():
    """By hand, with two negatives: -log f+ / (f+ + f1 + f2), f = exp(-mean absolute difference)."""
    codes = jnp.array([[0.0, 0.0], [0.2, 0.6], [2.0, 0.0], [0.0, -3.0]])
    loss, metrics = loss_of(codes, pairs_of([0], [1], [[2, 3]]))
    f = np.exp(-np.array([0.4, 1.0, 1.5]))
    np.testing.assert_allclose(loss, -np.log(f[0] / f.sum()), rtol=1e-5)
    assert metrics["accuracy"] == 1 and loss_of(codes, pairs_of([0], [2], [[1, 3]]))[1]["accuracy"] == 0.5


def test_pairs_and_negatives_without_weight_count_for_nothing():
    codes = jax.random.normal(jax.random.key(0), (6, 8))
    alone, metrics = loss_of(codes, pairs_of([0], [1], [[2]]), 0.1)
    beside = pairs_of([0, 4], [1, 5], [[2, 3], [3, 2]], [1.0, 0.0], [[1.0, 0.0], [1.0, 1.0]])
    together, with_others = loss_of(codes, beside, 0.1)
    np.testing.assert_allclose(together, alone, rtol=1e-5)
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-5), metrics, with_others)
    without_negative = pairs_of([0, 4], [1, 5], [[2], [3]], negative_weight=[[1.0], [0.0]])
    np.testing.assert_allclose(loss_of(codes, without_negative)[0], metrics["contrastive"], rtol=1e-5)
    nothing = pairs_of([0], [1], [[2]], [0.0])
    gradient = jax.jit(jax.grad(lambda codes: loss_of(codes, nothing, 0.1)[0]))(codes)
    assert not gradient.any() and np.isfinite(gradient).all()


def test_norm_penalty_is_the_mean_squared_norm():
    codes = jnp.array([[3.0, 4.0], [0.0, 1.0], [2.0, 0.0]])
    batch = pairs_of([0], [1], [[2]])
    difference = loss_of(codes, batch, 0.5)[0] - loss_of(codes, batch)[0]
    np.testing.assert_allclose(difference, 0.5 * (25 + 1 + 4) / 3, rtol=1e-5)


def test_gradient_is_finite_where_codes_are_equal():
    inputs = jnp.ones((4, 16))
    learner = cogoal.make(cogoal.CoGoalConfig())
    params, state = hand_made.initial(learner, jax.random.key(0), hand_made.example(inputs), NoHyperparameters())
    batch = pairs_of([0, 1], [0, 2], [[3], [3]])

    def objective(params):
        codes = learner.encode(params, inputs)
        assert codes.std is None
        return learner.loss(
            params,
            state,
            hand_made.learner_batch(codes.__getitem__, pairs=batch),
            NoHyperparameters(),
            jax.random.key(0),
        )[0]

    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.jit(jax.grad(objective))(params)))


def share_told_apart(codes: jax.Array) -> jax.Array:
    """Exactly: of all goals with another of their group and one of another group, the share whose code lies nearer to
    that of their group."""
    distance = jnp.abs(codes[:, None] - codes[None]).mean(-1)
    similar = (GROUP[:, None] == GROUP[None]) & ~np.eye(GOALS, dtype=bool)
    triples = similar[:, :, None] & (GROUP[:, None] != GROUP[None])[:, None, :]
    return ((distance[:, :, None] < distance[:, None, :]) & triples).sum() / triples.sum()


@pytest.mark.long
def test_goals_of_a_group_are_pulled_together_and_others_apart():
    """Three seeds; inputs say nothing of the groups, and three of eleven negatives are similar goals."""
    learner = cogoal.make(cogoal.CoGoalConfig(hidden=(64, 64)))
    optimizer = optax.adam(1e-3)

    def seed(key):
        input_key, init_key, train_key = jax.random.split(key, 3)
        inputs = jax.random.normal(input_key, (GOALS, 16))
        params, state = learner.init(init_key, hand_made.example(inputs), NoHyperparameters())

        def step(carry, key):
            params, optimizer_state = carry
            anchor_key, positive_key, negative_key = jax.random.split(key, 3)
            anchor = jax.random.randint(anchor_key, (64,), 0, GOALS)
            positive = anchor % GROUPS + GROUPS * jax.random.randint(positive_key, (64,), 0, SIZE)
            negative = jax.random.randint(negative_key, (64, 1), 0, GOALS)
            batch = pairs_of(
                anchor, positive, negative, negative_weight=(negative != anchor[:, None]).astype(jnp.float32)
            )

            def objective(params):
                seen = hand_made.learner_batch(learner.encode(params, inputs).__getitem__, pairs=batch)
                return learner.loss(params, state, seen, NoHyperparameters(), key)[0]

            change, optimizer_state = optimizer.update(jax.grad(objective)(params), optimizer_state)
            return (optax.apply_updates(params, change), optimizer_state), None

        (trained, _), _ = jax.lax.scan(step, (params, optimizer.init(params)), jax.random.split(train_key, 300))
        return tuple(share_told_apart(learner.encode(given, inputs).mean) for given in (params, trained))

    before, after = jax.jit(jax.vmap(seed))(jax.random.split(jax.random.key(0), 3))
    assert abs(before.mean() - 0.5) < 0.15
    assert after.min() > 0.9


STEPS, UNKNOWN = 8, GOALS - 1
GOAL_SET = SimpleNamespace(finite=True, usable=lambda goals, known_goals: jnp.ones(goals.shape, bool))
ENV = SimpleNamespace(goals=GOAL_SET, goals_of=lambda record: record[..., None])


def parts(spec: SampleSpec) -> SimpleNamespace:
    """A learner that asks for this."""
    return SimpleNamespace(learner=SimpleNamespace(sample_spec=spec), config=SimpleNamespace(known_goals="visited"))


def experience(known: np.ndarray) -> Experience:
    """Rows that each stay in one group of goals, and the dissimilarity that a window of all steps leaves. A record is
    the goal achieved there."""
    generator = np.random.default_rng(0)
    row_group = np.arange(4 * GROUPS) % GROUPS
    record = jnp.asarray(
        row_group[:, None] + GROUPS * generator.integers(0, SIZE, (len(row_group), STEPS + 1)), jnp.int32
    )
    record = jnp.where(record == UNKNOWN, row_group[:, None], record)
    rows = hand_made.rows_of(np.ones((len(row_group), STEPS)), record)
    dissimilarity = pairs.remove_similar(pairs.initial_dissimilarity(GOALS), record[..., None], rows.episode(), STEPS)
    known = pairs.KnownGoals(jnp.asarray(known))
    return hand_made.experience(rows, jnp.ones(record.shape, bool), known, dissimilarity)


@pytest.mark.parametrize("dissimilar", [pytest.param(True, marks=pytest.mark.long), False])
def test_random_negatives_may_be_similar_to_the_anchor_and_dissimilar_ones_never(dissimilar):
    known = np.arange(GOALS) != UNKNOWN
    spec = SampleSpec(num_pairs=6000, window=STEPS, num_negatives=1, dissimilar=dissimilar)
    drawn = jax.jit(lambda key: sample_pairs(Setup(parts(spec), None, ENV), experience(known), key))(jax.random.key(0))
    anchor, negative, weight = (
        np.asarray(drawn.anchor),
        np.asarray(drawn.negative)[:, 0],
        np.asarray(drawn.negative_weight)[:, 0],
    )
    used = weight > 0
    assert known[negative[used]].all() and (negative != anchor)[used].all()
    similar = GROUP[anchor] == GROUP[negative]
    if dissimilar:
        assert not similar[used].any()
    else:
        np.testing.assert_array_equal(used, negative != anchor)  # Nothing else is left out.
        counts = np.bincount(negative, minlength=GOALS)[known]
        assert (np.abs(counts - 6000 / 11) < 5 * np.sqrt(6000 / 11)).all()  # Uniform, and so independent of the anchor:
        assert abs(similar.mean() - (GROUP[anchor][:, None] == GROUP[:UNKNOWN]).mean()) < 5 * 0.5 / np.sqrt(6000)


def test_no_random_negative_carries_weight_while_no_goal_is_known():
    spec = SampleSpec(num_pairs=20, window=STEPS, num_negatives=2, dissimilar=False)
    drawn = jax.jit(lambda key: sample_pairs(Setup(parts(spec), None, ENV), experience(np.zeros(GOALS, bool)), key))(
        jax.random.key(0)
    )
    assert not drawn.negative_weight.any()


def test_the_learner_asks_for_random_negatives_and_gives_no_intrinsic_reward():
    learner = cogoal.make(cogoal.CoGoalConfig(window=2, num_pairs=5, num_negatives=3))
    assert learner.sample_spec == SampleSpec(
        num_pairs=5, window=2, num_negatives=3, anchored=True, dissimilar=False, num_goals=0
    )
    reward, _ = learner.intrinsic_reward(
        (), GoalCode(jnp.ones((2, 4))).__getitem__, hand_made.visited(0, jnp.ones((1, 3, 1), int), jnp.ones((1, 3)))
    )
    assert not reward.any()


@pytest.mark.parametrize("window", [21, -1])
def test_a_window_longer_than_an_episode_is_named(window):
    with pytest.raises(UserError, match="learner.window = "):
        hand_made.config("cogoal", learner=cogoal.CoGoalConfig(window=window))


@pytest.mark.long
def test_a_run_is_finite():
    train = make_train(hand_made.config("cogoal", num_epochs=1, epochs_per_evaluation=1), hand_made.environment())
    result = jax.jit(train)(jax.random.key(0))
    assert {"cogoal/contrastive", "cogoal/accuracy"} <= set(result.epochs)
    for name, values in (result.metrics | result.epochs).items():
        assert np.isfinite(values).all(), name
