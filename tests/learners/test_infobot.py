"""InfoBot's code pays for what it tells of the goal, and its bonus leads to states that were seldom visited."""

import functools

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hand_made import rows_of

from infogoal_jax import make_train
from infogoal_jax.learners import infobot
from infogoal_jax.learners.goal_encoder import kl_to_standard_normal
from infogoal_jax.learners.infobot import InfoBotHyperparameters
from infogoal_jax.learners.learner import GoalCode, Visited
from infogoal_jax.relabelling.her import first_seen
from infogoal_jax.train.experience import collect_epoch, make_experience
from infogoal_jax.train.update import sample

FEATURES, GOALS = 4, 8


class Transitions:
    """As much of an agent's batch as InfoBot looks at."""

    def __init__(self, features):
        self.features = features


@functools.cache
def start(**changes):
    """A small learner with its parameters and state, and inputs of eight goals; beta does not warm up."""
    learner = infobot.make(infobot.InfoBotConfig(**({"hidden": (32,), "latent_size": 8, "warm_up": 0} | changes)))
    inputs = jax.random.normal(jax.random.key(0), (GOALS, 16))
    return (
        learner,
        *hand_made.initial(
            learner, jax.random.key(1), hand_made.example(inputs, FEATURES, num_cells=5), InfoBotHyperparameters()
        ),
        inputs,
    )


def by_hand(code: GoalCode) -> np.ndarray:
    """KL to N(0, I) in nats."""
    mean, std = np.asarray(code.mean, float), np.asarray(code.std, float)
    return 0.5 * (mean**2 + std**2 - 1 - np.log(std**2)).sum(-1)


@pytest.mark.parametrize("state_conditioned", [False, True])
def test_loss_is_beta_times_the_kl_of_the_desired_goals_in_bits(state_conditioned):
    learner, params, state, inputs = start(state_conditioned=state_conditioned)
    desired_goal, features = jnp.array([0, 0, 3]), jax.random.normal(jax.random.key(2), (3, FEATURES))
    state = state.replace(counts=jnp.array([0.0, 2.0, 0.0, 1.0, 0.0]))

    @jax.jit
    def codes_and_loss(params, state):
        code = learner.encode(params, inputs[desired_goal])
        code = learner.condition(params, code, features) if state_conditioned else code
        encode = learner.encode(params, inputs).__getitem__
        batch = hand_made.learner_batch(encode, desired_goal=desired_goal, transitions=Transitions(features))
        return code, learner.loss(params, state, batch, InfoBotHyperparameters(beta=0.03), jax.random.key(3))

    code, (loss, metrics, after) = codes_and_loss(params, state)
    kl = by_hand(code).mean()  # Goal 0 counts twice.
    np.testing.assert_allclose(loss, 0.03 * kl / np.log(2), rtol=1e-4)
    np.testing.assert_allclose([metrics["kl"], metrics["beta"], metrics["visited_cells"]], [kl, 0.03, 2], rtol=1e-4)
    assert after.updates == 1
    jax.tree.map(np.testing.assert_array_equal, after, state.replace(updates=after.updates))


def test_beta_rises_to_its_value_over_the_warm_up():
    learner, params, state, inputs = start(warm_up=4)
    batch, betas = (
        hand_made.learner_batch(learner.encode(params, inputs).__getitem__, desired_goal=jnp.array([0, 3])),
        [],
    )
    for _ in range(6):
        loss, metrics, state = learner.loss(params, state, batch, InfoBotHyperparameters(beta=0.4), jax.random.key(0))
        np.testing.assert_allclose(loss, metrics["beta"] * metrics["kl"] / np.log(2), rtol=1e-5)
        betas.append(metrics["beta"])
    np.testing.assert_allclose(betas, [0.1, 0.2, 0.3, 0.4, 0.4, 0.4], rtol=1e-6)


@pytest.mark.long  # The loss by hand is above.
def test_the_code_tells_less_of_the_goal_the_greater_beta_is():
    """A code that has to tell eight goals apart (a regression in the place of the agent), under three betas."""
    learner, params, state, inputs = start()
    targets = jax.random.normal(jax.random.key(2), (GOALS, 4))
    params = {"goal": params, "head": jax.random.normal(jax.random.key(3), (8, 4)) / 3}
    optimizer, desired_goal = optax.adam(3e-3), jnp.tile(jnp.arange(GOALS), 4)

    def train(beta):
        def step(carry, key):
            params, optimizer_state = carry

            def objective(params):
                codes = learner.encode(params["goal"], inputs)
                batch = hand_made.learner_batch(codes.__getitem__, desired_goal=desired_goal)
                loss, metrics, _ = learner.loss(params["goal"], state, batch, InfoBotHyperparameters(beta=beta), key)
                error = ((codes[desired_goal].sample(key) @ params["head"] - targets[desired_goal]) ** 2).mean()
                return loss + error, (metrics["kl"], error)

            gradient, measured = jax.grad(objective, has_aux=True)(params)
            change, optimizer_state = optimizer.update(gradient, optimizer_state)
            return (optax.apply_updates(params, change), optimizer_state), measured

        _, (kl, error) = jax.lax.scan(step, (params, optimizer.init(params)), jax.random.split(jax.random.key(4), 500))
        return kl[-50:].mean(), error[-50:].mean()

    kl, error = jax.jit(jax.vmap(train))(jnp.array([0.0, 0.01, 1.0]))
    assert kl[0] > 1.5 * kl[1] and kl[1] > 5 * kl[2]
    assert error[0] < error[1] < error[2]


def bonus(learner, state, codes: GoalCode, desired_goal, cell):
    """Bonus of single steps into these cells."""
    cell = jnp.asarray(cell)[:, None]
    visited = Visited(jnp.asarray(desired_goal), jnp.full((*cell.shape, 1), -1), cell, jnp.ones(cell.shape))
    reward, state = jax.jit(lambda state: learner.intrinsic_reward(state, codes.__getitem__, visited))(state)
    return reward[:, 0], state


@pytest.mark.parametrize("state_conditioned", [pytest.param(False, marks=pytest.mark.long), True])
def test_bonus_falls_as_one_over_the_root_of_the_visits(state_conditioned):
    learner, _, state, _ = start(state_conditioned=state_conditioned)
    codes = GoalCode(jnp.ones((GOALS, 8)), None if state_conditioned else jnp.ones((GOALS, 8)))
    state = state.replace(counts=jnp.array([0.0, 3.0, 8.0, 99.0, 0.0]))
    reward, _ = bonus(learner, state, codes, [0, 0, 0, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(reward / reward[0], [1, 1 / 2, 1 / 3, 1 / 10], rtol=1e-5)
    assert reward[0] > 0


def test_bonus_grows_with_what_the_code_tells_and_is_of_the_order_of_one():
    learner, params, state, inputs = start()
    reward, _ = bonus(learner, state, jax.jit(learner.encode)(params, inputs), np.arange(GOALS), np.zeros(GOALS, int))
    assert 0.5 < reward.mean() < 2  # From the first update on.
    codes = GoalCode(jnp.zeros((2, 8)).at[1].set(2.0), jnp.full((2, 8), 0.5))
    step = jax.jit(lambda state: bonus(learner, state, codes, [0, 1, 1], [0, 0, 0]))
    for _ in range(1000):
        reward, state = step(state)
    kl = by_hand(codes)
    np.testing.assert_allclose(reward, kl[[0, 1, 1]] / (kl[[0, 1, 1]].mean()), rtol=1e-3)
    assert reward[1] > reward[0]


def test_bonus_stays_finite_for_a_code_that_tells_nothing():
    learner, _, state, _ = start()
    state = state.replace(scale=jnp.zeros(()))
    reward, after = bonus(learner, state, GoalCode(jnp.zeros((1, 8)), jnp.ones((1, 8))), [0], [0])
    assert np.isfinite(reward).all() and np.isfinite(after.scale)


def test_bonus_does_not_train_the_encoder():
    learner, params, state, inputs = start()

    def total(params):
        visited = Visited(jnp.array([1, 2]), jnp.full((2, 3, 1), -1), jnp.zeros((2, 3), int), jnp.ones((2, 3)))
        return learner.intrinsic_reward(state, learner.encode(params, inputs).__getitem__, visited)[0].sum()

    assert all(not leaf.any() for leaf in jax.tree.leaves(jax.jit(jax.grad(total))(params)))


def test_counts_are_those_of_valid_visits():
    learner, _, state, _ = start()
    random = np.random.default_rng(0)
    expected = np.zeros(5)
    for _ in range(2):
        cell, valid = random.integers(0, 5, (6, 20)), random.random((6, 20)) < 0.7
        cell[cell == 4], valid[0, :3], cell[0, :3] = 3, False, 4  # Cell 4 by invalid steps alone.
        state = learner.observe(state, hand_made.new_steps(cell, valid))
        expected += np.bincount(cell[valid], minlength=5)
    np.testing.assert_array_equal(state.counts, expected)
    assert state.counts[4] == 0 and expected.sum() > 0


def test_code_of_the_plain_form_is_the_same_in_every_state():
    learner, params, _, inputs = start()
    assert learner.condition is None and "joint" not in params
    assert learner.encode(params, inputs).std.shape == (GOALS, 8)


def test_code_of_the_state_conditioned_form_depends_on_state_and_goal():
    learner, params, _, inputs = start(state_conditioned=True)
    features = jax.random.normal(jax.random.key(5), (2, FEATURES))
    half = learner.encode(params, inputs[jnp.array([0, 0, 1])])
    assert half.std is None
    code = learner.condition(params, half, features[jnp.array([0, 1, 0])])
    for part in (code.mean, code.std):
        assert part.shape == (3, 8)
        assert not np.allclose(part[0], part[1]) and not np.allclose(part[0], part[2])
    assert (code.std > 0).all()


def test_kl_of_the_state_conditioned_form_shapes_both_encoders():
    """Its gradient reaches the goal's half, the joint layers and the features of the state; it is finite for a state
    without any feature."""
    learner, params, state, inputs = start(state_conditioned=True)
    for features in (jax.random.normal(jax.random.key(6), (3, FEATURES)), jnp.zeros((3, FEATURES))):

        def loss(params, features):
            encode = learner.encode(params, inputs).__getitem__
            batch = hand_made.learner_batch(
                encode, desired_goal=jnp.array([0, 1, 2]), transitions=Transitions(features)
            )
            return learner.loss(params, state, batch, InfoBotHyperparameters(), jax.random.key(0))[0]

        of_params, of_features = jax.tree.map(np.asarray, jax.jit(jax.grad(loss, argnums=(0, 1)))(params, features))
        assert of_features.any()
        for part in ("encoder", "joint"):
            assert any(leaf.any() for leaf in jax.tree.leaves(of_params[part]))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((of_params, of_features)))


def test_gradient_is_zero_and_finite_at_the_standard_normal():
    def kl(mean, std):
        return kl_to_standard_normal(GoalCode(mean, std)).sum()

    for gradient in jax.jit(jax.grad(kl, argnums=(0, 1)))(jnp.zeros(8), jnp.ones(8)):
        np.testing.assert_array_equal(gradient, np.zeros(8))


@pytest.mark.long
def test_a_run_is_finite_and_counts_every_collected_step():
    config = hand_made.config(
        "infobot", num_epochs=1, epochs_per_evaluation=1, learner=infobot.InfoBotConfig(warm_up=0)
    )
    train = make_train(config, hand_made.environment())
    result = jax.jit(train)(jax.random.key(0), train.config.hyper.replace(intrinsic_weight=1.0))
    for name, values in (result.metrics | result.epochs).items():
        assert np.isfinite(values).all(), name
    assert result.state.learner.counts.sum() == result.state.env_steps > 0
    assert result.epochs["agent/intrinsic_reward"][0] > 0
    np.testing.assert_allclose(result.epochs["infobot/beta"], config.hyper.learner.beta, rtol=1e-5)


def test_reward_for_goals_first_seen_is_one_for_each():
    """Counted by hand: two episodes in a row; a goal at the start of an episode, and one that comes again, say
    nothing."""
    rows = rows_of([[1, 1, 1, 0, 1, 1]], [[[1, -1], [1, 2], [3, 4], [2, 5], [1, 2], [2, 3], [1, 3]]])
    found = jax.jit(lambda rows: first_seen(rows.record, rows, 6))(rows)
    np.testing.assert_array_equal(found, [[1, 1, 2, 1, 2, 1, 0]])
    learner = infobot.make(infobot.InfoBotConfig(reward="first_seen"))
    seen = jnp.asarray([[1.0, 0.0], [2.0, 1.0]])
    visited = Visited(None, None, jnp.zeros((2, 2), jnp.int32), jnp.ones((2, 2)), seen)
    reward, _ = learner.intrinsic_reward(None, None, visited)
    np.testing.assert_array_equal(reward, seen)


@pytest.mark.long
def test_goals_first_seen_are_those_of_the_step_that_is_learned_from():
    """One update of a run: the sampled rewards are those of the steps after each drawn observation."""
    config = hand_made.config("infobot", learner=infobot.InfoBotConfig(reward="first_seen"))
    train = make_train(config, hand_made.environment())

    def drawn(key):
        setup = train.setup()
        state, _ = collect_epoch(setup, train.initial(key, config.hyper, train.env), 0)
        experience, _ = make_experience(setup, state, jnp.asarray(0))
        found = sample(setup, experience, jax.random.key(1))
        return experience.first_seen, experience.buffer, found.achieved, found.first_seen, found.transitions.mask

    table, buffer, achieved, found, mask = jax.tree.map(np.asarray, jax.jit(drawn)(jax.random.key(0)))
    assert table.sum() > 0 and (found <= (achieved >= 0).sum(-1))[mask > 0].all()
    led_to = np.pad(buffer.valid, ((0, 0), (1, 0)))
    assert (found * mask).sum() > 0 and (found[mask > 0].max() <= table[led_to].max())


@pytest.mark.long  # Its parts are tested above, and other methods are traced in train/test_every_method.py.
def test_the_state_conditioned_form_fits_the_program():
    """Traced, not run: shapes of the code agree wherever it is given a state."""
    config = hand_made.config("infobot", learner=infobot.InfoBotConfig(state_conditioned=True))
    result = jax.eval_shape(make_train(config, hand_made.environment()), jax.random.key(0))
    assert result.epochs["infobot/kl"].shape == (config.num_epochs,)
