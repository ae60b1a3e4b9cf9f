"""GCB's distances between pairs of state and goal are those of its paper, with the numbers of the authors' code
(fixtures/README.md)."""

import functools

import hand_made
import hand_made_frames
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from places import assert_relatively_close, recorded

from infogoal_jax import UserError, make_train, networks
from infogoal_jax.hyperparameters import NoHyperparameters
from infogoal_jax.learners import gcb
from infogoal_jax.learners.learner import GoalCode, Steps, conditioned

FIXTURE = recorded("gcb")


@pytest.mark.parametrize(
    ("variant", "reward_weight"), [("next_observation", 1.0), ("next_observation_weight_10", 10.0)]
)
def test_paired_loss_and_its_gradient_are_those_of_the_authors_code(variant, reward_weight):
    phi, following, rewards, partner = (
        jnp.asarray(FIXTURE[name]) for name in ("phi", "phi_next", "rewards", "permutation")
    )

    def loss(codes):
        target = gcb.bisimulation_target(
            rewards, following, jnp.full(len(rewards), FIXTURE["discount"]), partner, reward_weight
        )
        return gcb.paired_loss(codes, target, partner)

    value, gradient = jax.jit(jax.value_and_grad(loss))(phi)
    assert_relatively_close(value, FIXTURE[f"{variant}_loss"])
    assert_relatively_close(gradient, FIXTURE[f"{variant}_gradient_phi"])


@pytest.mark.parametrize(("variant", "grounded"), [("delta", True), ("delta_without_grounding", False)])
def test_difference_loss_and_its_gradients_are_those_of_the_authors_code(variant, grounded):
    state, goal, paired, grounding = (
        jnp.asarray(FIXTURE[name]) for name in ("psi_state", "psi_goal", "phi_state_goal", "phi_goal_goal")
    )

    def loss(state, goal):
        return gcb.difference_loss(goal - state, paired, *([grounding] if grounded else []))

    value, (of_state, of_goal) = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(state, goal)
    assert_relatively_close(value, FIXTURE[f"psi_{variant}_loss"])
    assert_relatively_close(of_state, FIXTURE[f"psi_{variant}_gradient_state"])
    assert_relatively_close(of_goal, FIXTURE[f"psi_{variant}_gradient_goal"])


def test_code_spread_is_what_the_authors_code_logs_and_0_for_one_code():
    assert_relatively_close(1.0 - gcb.code_spread(jnp.asarray(FIXTURE["phi"])), FIXTURE["phi_collapse_level"])
    assert gcb.code_spread(jnp.ones((8, 4))) < 1e-6 and gcb.code_spread(jnp.zeros((8, 4))) == 0
    noise = jax.random.normal(jax.random.key(0), (2000, 32))
    np.testing.assert_allclose(gcb.code_spread(noise), 1.25 / np.sqrt(32), rtol=0.05)


def test_what_terminated_has_no_successor():
    """Codes (3, 4) and (6, 8) follow, of length 5 and 10 and 5 apart; rewards 2 apart, which costs 1.5."""
    following = jnp.array([[3.0, 4.0], [6.0, 8.0]])
    for discounts, distance in (
        ((0.9, 0.9), 4.5),
        ((0.0, 0.0), 0.0),
        ((0.9, 0.0), 4.5),
        ((0.0, 0.9), 9.0),
        ((0.8, 0.4), 0.0),
    ):
        target = gcb.bisimulation_target(jnp.array([2.0, 0.0]), following, jnp.array(discounts), jnp.array([1, 0]), 2.0)
        np.testing.assert_allclose(target, 2 * [2.0 * 1.5 + distance], rtol=1e-6)


def test_targets_carry_no_gradient():
    rewards, following, discounts = (
        jnp.array([0.0, 1.0, 0.5]),
        jax.random.normal(jax.random.key(0), (3, 4)),
        jnp.full(3, 0.9),
    )
    partner, codes = jnp.array([1, 2, 0]), jax.random.normal(jax.random.key(1), (3, 4))
    gradients = jax.jit(
        jax.grad(
            lambda *of: gcb.paired_loss(codes, gcb.bisimulation_target(*of, partner, 1.0), partner), argnums=(0, 1, 2)
        )
    )(rewards, following, discounts)
    gradients += jax.jit(jax.grad(gcb.difference_loss, argnums=(1, 2)))(codes, codes + 1.0, codes + 3.0)
    assert all(not gradient.any() for gradient in gradients)


def test_gradients_are_finite_where_codes_are_equal():
    equal, partner = jnp.ones((3, 4)), jnp.array([0, 2, 1])

    def loss(codes):
        return gcb.paired_loss(
            codes, gcb.bisimulation_target(jnp.arange(3.0), codes, jnp.full(3, 0.9), partner, 1.0), partner
        )

    assert np.isfinite(jax.jit(jax.grad(loss))(equal)).all()


RANDOM = np.random.default_rng(0)
INPUTS, FEATURES, GOAL_FEATURES = (
    jax.device_put(RANDOM.normal(size=shape).astype(np.float32)) for shape in ((2, 16), (6, 8), (2, 8))
)
"""Of goals, and features of states and of goals."""
FIRST, TWIN, BETTER, ELSEWHERE, WORSE_END, BETTER_END = range(6)
DISCOUNT = 0.9
STATES = np.array([FIRST, TWIN, BETTER, ELSEWHERE, WORSE_END, BETTER_END, FIRST, WORSE_END])
GOALS = np.array([0, 0, 0, 0, 0, 0, 1, 1])
REWARDS = np.float32([0, 0, 1, 0, 0, 1, 1, 0])
FOLLOWING = np.array([WORSE_END, WORSE_END, WORSE_END, BETTER_END, FIRST, FIRST, WORSE_END, FIRST])
DISCOUNTS = np.where((STATES == WORSE_END) | (STATES == BETTER_END), 0.0, DISCOUNT).astype(np.float32)
"""Eight transitions of six states: two of equal reward and successor, one of another reward, one of another successor,
two that end; and the first state and an end under another goal, where the first state earns more. All eight targets can
be met at once."""


@functools.cache
def learner_and_params(**changes):
    """The learner, its parameters, and its loss on the transitions above as a function of parameters, features, next
    features and rewards."""
    settings = {"hidden": (64, 64), "paired_hidden": (64, 64), "latent_size": 8, "reward_weight": 2.0}
    learner = gcb.make(gcb.GCBConfig(**(settings | changes)))
    params, state = hand_made.initial(
        learner, jax.random.key(2), hand_made.example(INPUTS, features=8), NoHyperparameters()
    )

    def loss(params, features, next_features, rewards, key):
        codes = learner.encode(params, INPUTS)
        seen = Steps(features, next_features, rewards, DISCOUNTS)
        batch = hand_made.learner_batch(
            codes.__getitem__, INPUTS, desired_goal=jnp.asarray(GOALS), transitions=seen, features=GOAL_FEATURES
        )
        value, metrics, after = learner.loss(params, state, batch, NoHyperparameters(), key)
        assert after == state
        return value, metrics

    return learner, params, jax.jit(loss)


def test_the_loss_trains_every_network_of_the_method_and_nothing_of_the_agent():
    _, params, loss = learner_and_params()
    arguments = (params, FEATURES[STATES], FEATURES[FOLLOWING], REWARDS, jax.random.key(3))
    of_params, *of_agent = jax.jit(jax.grad(lambda *given: loss(*given)[0], argnums=(0, 1, 2, 3)))(*arguments)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(of_params))
    assert all(not gradient.any() for gradient in of_agent)


@pytest.mark.long
def test_paired_codes_come_to_lie_as_far_apart_as_rewards_and_successors_do():
    """Trained from random codes; distances are 1-norms summed over the code, and a gap of 1 between rewards costs 2 *
    0.5."""
    learner, params, loss = learner_and_params()
    optimizer = optax.adam(optax.linear_schedule(2e-3, 1e-4, 600))

    def step(carry, key):
        params, optimizer_state = carry
        gradient, metrics = jax.grad(loss, has_aux=True)(params, FEATURES[STATES], FEATURES[FOLLOWING], REWARDS, key)
        change, optimizer_state = optimizer.update(gradient, optimizer_state)
        return (optax.apply_updates(params, change), optimizer_state), metrics

    run = jax.jit(
        lambda params: jax.lax.scan(step, (params, optimizer.init(params)), jax.random.split(jax.random.key(4), 600))
    )
    (trained, _), metrics = run(params)
    paired = gcb.PairedEncoder((64, 64), (64, 64), 8, False)
    before, codes = (
        np.asarray(paired.apply(given["paired"], FEATURES[STATES], INPUTS[GOALS])) for given in (params, trained)
    )

    def distance(codes, first, second):
        return np.abs(codes[first] - codes[second]).sum()

    ends, worse_end, better_end = (
        DISCOUNT * np.linalg.norm(code) for code in (codes[4] - codes[5], codes[4], codes[5])
    )
    assert distance(before, FIRST, TWIN) > 0.3 and min(ends, worse_end, better_end) > 0.2
    # What ended has no successor, so that its partner's stands alone.
    expected = {
        (FIRST, TWIN): 0.0,
        (FIRST, BETTER): 1.0,
        (FIRST, ELSEWHERE): ends,
        (BETTER, ELSEWHERE): 1.0 + ends,
        (WORSE_END, BETTER_END): 1.0,
        (FIRST, WORSE_END): worse_end,
        (FIRST, BETTER_END): 1.0 + worse_end,
        (ELSEWHERE, WORSE_END): better_end,
    }
    for pair, target in expected.items():
        assert distance(codes, *pair) == pytest.approx(target, abs=0.05), pair
    assert distance(codes, 6, FIRST) == pytest.approx(1.0, abs=0.05)  # One state under two goals.
    difference = learner.condition(trained, learner.encode(trained, INPUTS[GOALS]), FEATURES[STATES]).mean
    assert np.square(difference - codes).mean() < 0.1 * np.square(codes).mean()
    assert metrics["paired_loss"][-1] < 0.01 * metrics["paired_loss"][0] and metrics["code_spread"][-1] > 0.05
    assert metrics["reward_error"][-1] < 1e-2 < metrics["reward_error"][0]  # The reward can be read out of the codes.


def test_the_grounding_is_the_paired_code_of_a_goal_with_itself():
    """It changes the loss of psi alone: psi(g) - psi(s) is to be phi(s, g) - phi(g, g)."""
    arguments = (FEATURES[STATES], FEATURES[FOLLOWING], REWARDS, jax.random.key(3))
    learner, params, loss = learner_and_params(grounded=True)
    assert learner.needs_features_of_goals and not learner_and_params()[0].needs_features_of_goals
    _, metrics = loss(params, *arguments)
    _, without = learner_and_params()[2](params, *arguments)
    paired = gcb.PairedEncoder((64, 64), (64, 64), 8, False)
    codes, grounding = (
        jax.jit(paired.apply)(params["paired"], features, INPUTS[GOALS])
        for features in (FEATURES[STATES], GOAL_FEATURES[GOALS])
    )
    differing = jax.jit(
        lambda params: learner.condition(params, learner.encode(params, INPUTS[GOALS]), FEATURES[STATES])
    )
    difference = differing(params).mean
    np.testing.assert_allclose(
        metrics["psi_loss"], np.square(difference - (codes - grounding)).mean(), rtol=1e-5, atol=1e-7
    )
    np.testing.assert_allclose(without["psi_loss"], np.square(difference - codes).mean(), rtol=1e-5, atol=1e-7)
    for name in ("paired_loss", "target"):
        np.testing.assert_allclose(metrics[name], without[name], rtol=1e-5)


def test_a_grounding_needs_goals_that_are_observations():
    config = hand_made.config("gcb", learner=gcb.GCBConfig(grounded=True))
    with pytest.raises(UserError, match="learner.grounded = True: a goal of object_search is not shown as"):
        make_train(config, hand_made.environment())


@pytest.mark.long
def test_a_grounded_run_takes_the_features_of_goals_from_the_agent():
    """On the cube goals are observations; poses without joints are not."""
    config = hand_made_frames.manipulation_config("gcb", learner=gcb.GCBConfig(grounded=True))
    train = make_train(config, hand_made_frames.manipulation())
    result = jax.jit(train)(jax.random.key(0))
    assert all(np.isfinite(value).all() for value in result.epochs.values())
    privileged = hand_made_frames.privileged_config("gcb", learner=gcb.GCBConfig(grounded=True))
    with pytest.raises(UserError, match="learner.grounded = True: a goal of object_manipulation is not shown as"):
        make_train(privileged)


@pytest.mark.long
def test_without_a_decoder_nothing_of_it_is_left():
    _, params, loss = learner_and_params(reward_hidden=0)
    _, metrics = loss(params, FEATURES[STATES], FEATURES[FOLLOWING], REWARDS, jax.random.key(3))
    assert "reward_decoder" not in params and "reward_error" not in metrics


def test_the_policy_is_given_what_is_left_to_do():
    """psi(g) - psi(s): one vector for each goal less one for each state."""
    learner, params, _ = learner_and_params()
    codes = learner.encode(params, INPUTS)
    given = np.stack([conditioned(learner, params, codes, jnp.stack([state, state])).mean for state in FEATURES])
    np.testing.assert_allclose(given[:, 1] - given[:, 0], np.tile(codes.mean[1] - codes.mean[0], (6, 1)), atol=1e-5)
    assert all(np.abs(given[0] - other).max() > 1e-3 for other in given[1:])
    of_states = jax.jit(networks.MLP((64, 64), 8).apply)(params["state_head"], FEATURES)
    np.testing.assert_allclose(given[:, 0], codes.mean[0] - of_states, atol=1e-5)


def test_the_policy_can_be_given_the_goal_alone():
    learner, params, _ = learner_and_params(policy_input="goal")
    codes = GoalCode(jnp.arange(8.0)[None])
    assert conditioned(learner, params, codes, FEATURES[:1]) is codes


@pytest.mark.long
def test_trains_on_the_hand_made_rooms():
    train = make_train(hand_made.config("gcb", num_epochs=1, epochs_per_evaluation=1), hand_made.environment())
    result = jax.jit(train)(jax.random.key(0))
    assert {"gcb/paired_loss", "gcb/psi_loss", "gcb/code_spread"} <= set(result.epochs)
    for name, values in {**result.metrics, **result.epochs}.items():
        assert np.isfinite(values).all(), name
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result.params))
