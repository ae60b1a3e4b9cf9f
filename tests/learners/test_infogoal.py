"""InfoGoal's loss, multiplier and intrinsic reward are those of the paper, in the readings that
docs/reference/infogoal.md states."""

import itertools

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from infogoal_jax.learners import infogoal
from infogoal_jax.learners.infogoal import InfoGoalHyperparameters
from infogoal_jax.learners.learner import GoalCode
from infogoal_jax.pairs import GoalPairs


def test_kl_is_zero_for_the_standard_normal_and_matches_the_formula():
    assert infogoal.kl_to_standard_normal(GoalCode(jnp.zeros(32), jnp.ones(32))) == 0
    by_hand = 0.5 * (1.5**2 + 0.5**2 - 1 - 2 * np.log(0.5))
    assert np.isclose(infogoal.kl_to_standard_normal(GoalCode(jnp.asarray([1.5]), jnp.asarray([0.5]))), by_hand)


def test_score_is_symmetric_and_largest_for_equal_codes():
    first, second = jax.random.normal(jax.random.key(0), (2, 10, 32))
    np.testing.assert_array_equal(infogoal.log_score({}, first, second), infogoal.log_score({}, second, first))
    assert (infogoal.log_score({}, first, second) < infogoal.log_score({}, first, first)).all()


def mutual_information(joint: np.ndarray) -> float:
    """I(x0; x1) in nats of a joint distribution [X, Y]."""
    independent = joint.sum(1, keepdims=True) * joint.sum(0, keepdims=True)
    return float((joint[joint > 0] * np.log(joint[joint > 0] / independent[joint > 0])).sum())


bound_of = jax.jit(infogoal.contrastive_bound)


@pytest.mark.parametrize("seed", range(6))
def test_bound_of_theorem_3_never_exceeds_the_mutual_information(seed):
    """Exactly, by enumeration: the sum over the whole of X, and one or two negatives drawn from the marginal with log(K
    + 1) added."""
    generator = np.random.default_rng(seed)
    size = 4
    joint = generator.dirichlet(np.full(size * size, 0.2)).reshape(size, size)
    information, marginal = mutual_information(joint), joint.sum(0)
    # The score for which the sampled bound is tightest.
    best = np.log(joint / (joint.sum(1, keepdims=True) * marginal) + 1e-12)
    for log_f in (best, generator.normal(size=(size, size)), generator.normal(size=(size, size)) * 5):
        others = np.stack([[np.delete(log_f[x], y) for y in range(size)] for x in range(size)])
        whole = np.asarray(bound_of(log_f, others))
        assert (joint * whole).sum() <= information + 1e-5
        for num_negatives in (1, 2):
            bound = np.log(num_negatives + 1)
            for drawn in itertools.product(range(size), repeat=num_negatives):
                negatives = np.broadcast_to(log_f[:, None, list(drawn)], (size, size, num_negatives))
                terms = np.asarray(bound_of(log_f, negatives))
                bound += marginal[list(drawn)].prod() * (joint * terms).sum()
            assert bound <= information + 1e-5


def test_bound_is_tight_where_it_can_be():
    """A perfect code over four equal goals: the sum over X reaches I - log 4 = 0, so the test above could fail."""
    log_f = np.where(np.eye(4, dtype=bool), 0.0, -50.0)
    others = np.stack([np.delete(log_f[x], x) for x in range(4)])
    assert abs(np.asarray(bound_of(np.diagonal(log_f), others)).mean()) < 1e-6


@pytest.mark.parametrize(
    ("rule", "accuracy", "expected"),
    [
        ("linear", 1.0, 0.5 + 2.5e-4 * 0.04),
        ("linear", 0.5, 0.5 - 2.5e-4 * 0.46),
        ("sign", 0.97, 0.5 + 1e-5),
        ("sign", 0.2, 0.5 - 1e-5),
    ],
)
def test_beta_follows_equation_15(rule, accuracy, expected):
    config = infogoal.InfoGoalConfig(beta_rule=rule)
    assert np.isclose(
        infogoal.next_beta(config, jnp.asarray(0.5), jnp.asarray(accuracy), 0.96, InfoGoalHyperparameters()),
        expected,
        atol=1e-8,
    )


def loss_of(kind: str, std: float, negative: list, negative_weight: list):
    """Loss and metrics of three pairs, of which the last is none, of codes at 0, 1, 3 and -2; beta is 0.5."""
    learner = infogoal.make(infogoal.InfoGoalConfig(loss=kind, latent_size=1, num_negatives=2))
    codes = GoalCode(jnp.array([[0.0], [1.0], [3.0], [-2.0]]), jnp.full((4, 1), std))
    pairs = GoalPairs(
        anchor=jnp.array([0, 0, 1]),
        positive=jnp.array([1, 1, 2]),
        contrast=jnp.array([[0, 0], [0, 0], [1, 1]]),
        negative=jnp.array(negative),
        positive_weight=jnp.array([1.0, 1.0, 0.0]),
        negative_weight=jnp.array(negative_weight),
    )
    state = infogoal.InfoGoalState(jnp.asarray(0.5), jnp.ones(()))
    batch = hand_made.learner_batch(codes.__getitem__, pairs=pairs)
    return learner.loss({}, state, batch, InfoGoalHyperparameters(), jax.random.key(0))[:2]


@pytest.mark.parametrize("kind", ["nce", "ratio"])
def test_loss_is_the_bound_and_the_kl_of_what_took_part(kind):
    """Eq. 13 by hand. One pair has one negative: scores -1 and -3. Another has none: it is in the KL of anchors and
    positives, and not in the bound."""
    found, metrics = loss_of(kind, 1e-3, [[2, 3], [3, 2], [0, 3]], [[1.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    of_zero = 0.5 * (1e-6 - 1.0) - np.log(1e-3)
    kl = np.mean([of_zero, of_zero + 0.5 * 1.0**2, of_zero + 0.5 * 3.0**2])  # Of anchors, positives and negatives.
    np.testing.assert_allclose(metrics["kl"], kl, rtol=1e-5)
    expected = np.log1p(np.exp(-2.0)) + 0.5 * kl if kind == "nce" else np.exp(-2.0) + 0.5 * kl / np.log(2.0)
    np.testing.assert_allclose(found, expected, rtol=2e-3)  # Codes have some noise.


def test_ties_count_as_wrong():
    _, metrics = loss_of("nce", 0.0, [[1, 2], [1, 2], [0, 3]], [[1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    assert metrics["accuracy"] == 0


def test_beta_never_leaves_zero_to_one():
    for start, accuracy in ((0.0, 0.0), (1.0, 1.0)):
        hyper = InfoGoalHyperparameters(beta_step=10.0)
        beta = infogoal.next_beta(infogoal.InfoGoalConfig(), jnp.asarray(start), jnp.asarray(accuracy), 0.96, hyper)
        assert beta == start


def test_beta_stays_above_its_floor():
    hyper = InfoGoalHyperparameters(beta_floor=1e-3)
    beta = jnp.asarray(0.0)
    for accuracy, expected in ((0.0, 1e-3), (1.0, 1e-3 + 2.5e-4 * 0.04)):
        beta = infogoal.next_beta(infogoal.InfoGoalConfig(), beta, jnp.asarray(accuracy), 0.96, hyper)
        assert np.isclose(beta, expected, atol=1e-8)


def test_fixed_beta_ramps_to_its_value_and_stays():
    config, hyper = infogoal.InfoGoalConfig(beta_rule="fixed"), InfoGoalHyperparameters(fixed_beta=3e-5)
    example = hand_made.example(np.zeros((1, 4), np.float32))
    _, state = hand_made.initial(infogoal.make(config), jax.random.key(0), example, hyper)
    betas, beta = [], state.beta
    for _ in range(5):
        beta = infogoal.next_beta(config, beta, jnp.asarray(0.0), 0.96, hyper)
        betas.append(float(beta))
    np.testing.assert_allclose(betas, [1e-5, 2e-5, 3e-5, 3e-5, 3e-5], rtol=1e-5)


def after_pairs(rule: str, noise: float, weight: float):
    """Metrics and state after a loss of 64 pairs of this weight under a beta of 0.5. Half of the positives lie nearer
    than their negative."""
    learner = infogoal.make(infogoal.InfoGoalConfig(beta_rule=rule, latent_size=1))
    codes = GoalCode(jnp.array([[0.0], [1.0], [2.0]]), jnp.full((3, 1), noise))
    pairs = GoalPairs(
        jnp.zeros(64, int),
        jnp.tile(jnp.array([1, 2]), 32),
        jnp.zeros((64, 1), int),
        jnp.tile(jnp.array([[2], [1]]), (32, 1)),
        jnp.full(64, weight),
        jnp.ones((64, 1)),
    )
    state, hyper = infogoal.InfoGoalState(jnp.asarray(0.5), jnp.ones(())), InfoGoalHyperparameters()

    @jax.jit
    def loss(state, codes, pairs, hyper, key):
        return learner.loss({}, state, hand_made.learner_batch(codes.__getitem__, pairs=pairs), hyper, key)

    return loss(state, codes, pairs, hyper, jax.random.key(0))[1:]


@pytest.mark.parametrize(
    ("rule", "noise", "grows"), [("relative", 1e-3, True), ("relative", 30.0, False), ("linear", 1e-3, False)]
)
def test_relative_threshold_asks_what_the_noise_costs(rule, noise, grows):
    """Half of the pairs cannot be told apart by their mean codes. The paper's threshold is then out of reach; relative
    to the mean codes, beta grows for as long as noise costs nothing."""
    metrics, after = after_pairs(rule, noise, 1.0)
    assert (after.beta > 0.5) == grows
    if rule == "relative":
        assert metrics["mean_code_accuracy"] == 0.5


@pytest.mark.parametrize(("rule", "expected"), [("linear", 0.5), ("sign", 0.5), ("relative", 0.5), ("fixed", 0.01)])
def test_beta_stays_where_no_pair_was_found(rule, expected):
    """There is no accuracy then, neither of samples nor of means. A ramp goes on, or has ended."""
    assert after_pairs(rule, 1e-3, 0.0)[1].beta == np.float32(expected)


def test_intrinsic_reward_is_never_positive_and_zero_at_the_goal():
    learner = infogoal.make(infogoal.InfoGoalConfig())
    codes = GoalCode(jax.random.normal(jax.random.key(0), (5, 32)), jnp.ones((5, 32)))
    state = infogoal.InfoGoalState(beta=jnp.zeros(()), scale=jnp.ones(()))
    achieved = jnp.asarray([[[0, -1], [1, -1], [-1, -1], [3, 0]]])
    seen = hand_made.visited(0, achieved, jnp.ones((1, 4)))
    reward, after = jax.jit(lambda state: learner.intrinsic_reward(state, codes.__getitem__, seen))(state)
    assert reward[0, 0] == 0 and reward[0, 3] == 0  # The goal itself, and the goal beside another.
    assert reward[0, 1] < 0 and reward[0, 2] == reward.min()  # Seeing nothing is no better than the farthest goal seen.
    assert after.scale != state.scale


def test_steps_that_were_not_taken_count_for_nothing_in_the_intrinsic_reward():
    """Neither the farthest goal, which stands in for nothing achieved, nor the running mean looks at them."""
    learner = infogoal.make(infogoal.InfoGoalConfig(latent_size=1))
    codes = GoalCode(jnp.array([[0.0], [1.0], [50.0]]), jnp.ones((3, 1)))
    state = infogoal.InfoGoalState(beta=jnp.zeros(()), scale=jnp.ones(()))
    achieved, mask = jnp.asarray([[[-1], [1], [2]]]), jnp.asarray([[1.0, 1.0, 0.0]])
    seen = hand_made.visited(0, achieved, mask)
    reward, after = jax.jit(lambda state: learner.intrinsic_reward(state, codes.__getitem__, seen))(state)
    np.testing.assert_allclose(reward[0, :2], [-1.0, -1.0], rtol=1e-5)
    np.testing.assert_allclose(after.scale, 1.0, rtol=1e-5)


def test_a_batch_that_achieves_nothing_tells_nothing_of_the_scale_of_distances():
    """A mean of 0 would make the first distances that there are large rewards."""
    learner = infogoal.make(infogoal.InfoGoalConfig(latent_size=1))
    state = infogoal.InfoGoalState(beta=jnp.zeros(()), scale=jnp.full((), 0.7))
    codes = GoalCode(jnp.array([[0.0], [50.0]]), jnp.ones((2, 1)))
    achieved, mask = jnp.asarray([[[-1], [-1], [1]]]), jnp.asarray([[1.0, 1.0, 0.0]])
    seen = hand_made.visited(0, achieved, mask)
    reward, after = jax.jit(lambda state: learner.intrinsic_reward(state, codes.__getitem__, seen))(state)
    assert after.scale == state.scale and (reward[0, :2] == 0).all()


def test_intrinsic_reward_does_not_train_the_encoder():
    learner = infogoal.make(infogoal.InfoGoalConfig())
    inputs = jax.random.normal(jax.random.key(1), (4, 8))
    params, state = hand_made.initial(learner, jax.random.key(0), hand_made.example(inputs), InfoGoalHyperparameters())

    def total(params):
        codes = learner.encode(params, inputs)
        visited = hand_made.visited(0, jnp.asarray([[[1], [2]]]), jnp.ones((1, 2)))
        return learner.intrinsic_reward(state, codes.__getitem__, visited)[0].sum()

    assert all(not leaf.any() for leaf in jax.tree.leaves(jax.jit(jax.grad(total))(params)))


def train_codes(loss: str, beta: jax.Array, updates: int = 1500) -> jax.Array:
    """Accuracy after training the codes of 12 goals in 3 groups under a beta that is held still."""
    config = infogoal.InfoGoalConfig(loss=loss, hidden=(64, 64))
    learner = infogoal.make(config)
    hyper = InfoGoalHyperparameters(beta_start=beta, beta_step=0.0)
    inputs = jax.random.normal(jax.random.key(0), (12, 16))
    params, state = hand_made.initial(learner, jax.random.key(1), hand_made.example(inputs), hyper)
    optimizer = optax.adam(1e-3)

    def step(carry, key):
        params, optimizer_state = carry
        keys = jax.random.split(key, 4)
        anchor = jax.random.randint(keys[0], (64,), 0, 12)
        positive = anchor % 3 + 3 * jax.random.randint(keys[1], (64,), 0, 4)  # Same remainder: same group.
        negative = (anchor % 3 + jax.random.randint(keys[2], (64,), 1, 3)) % 3 + 3 * (anchor // 3)
        batch = GoalPairs(anchor, positive, anchor[:, None], negative[:, None], jnp.ones(64), jnp.ones((64, 1)))

        def objective(params):
            codes = learner.encode(params, inputs)
            loss, metrics, _ = learner.loss(
                params, state, hand_made.learner_batch(codes.__getitem__, pairs=batch), hyper, keys[3]
            )
            return loss, metrics

        gradient, metrics = jax.grad(objective, has_aux=True)(params)
        change, optimizer_state = optimizer.update(gradient, optimizer_state)
        return (optax.apply_updates(params, change), optimizer_state), metrics["accuracy"]

    _, accuracy = jax.lax.scan(step, (params, optimizer.init(params)), jax.random.split(jax.random.key(2), updates))
    return accuracy[-200:].mean()


@pytest.mark.long
@pytest.mark.parametrize("loss", ["nce", "ratio"])
def test_large_beta_collapses_the_code_and_a_small_one_does_not(loss):
    """The story of the paper's Figs. 14 and 15."""
    large, small = jax.jit(jax.vmap(lambda beta: train_codes(loss, beta)))(jnp.array([0.1, 1e-4]))
    assert large < 0.75
    assert small > 0.97
