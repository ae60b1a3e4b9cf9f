"""Agents that value moves. Conservative Q-learning: its term by hand, and what it is there for, values of moves that
nobody recorded kept below those that were.

Learning from every transition under all goals: the authors' numbers for LEO, ends that hold for one goal alone, masks,
and heads that value all goals as they value one.
"""

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import places
import pytest

from infogoal_jax import agents
from infogoal_jax.agents import td3, value_heads
from infogoal_jax.agents.agent import AgentBatch, AllGoals, Exploration
from infogoal_jax.agents.cql import CQLConfig, CQLHyperparameters, conservative_gap

BATCH, ACTIONS = 64, 4
B, F, A, D, G = 5, 6, 3, 4, 7


class FourActions:
    """As much of an environment as an agent of discrete actions reads."""

    action_size = ACTIONS


@jax.jit
def batch(mask) -> AgentBatch:
    """Random codes; only actions 0 and 1 were recorded, and every reward is 0."""
    keys = jax.random.split(jax.random.key(0), 4)
    features, code = jax.random.normal(keys[0], (BATCH, 6)), jax.random.normal(keys[1], (BATCH, 3))
    action = jax.random.randint(keys[2], (BATCH,), 0, 2)
    every = jnp.broadcast_to(mask, (BATCH, ACTIONS))
    return AgentBatch(
        observation=None,
        next_observation=None,
        features=features,
        code=code,
        action=action,
        next_features=features,
        next_code=code,
        target_features=features,
        target_code=code,
        reward=jnp.zeros(BATCH),
        discount=jnp.full(BATCH, 0.9),
        action_mask=every,
        next_action_mask=every,
    )


def test_gap_by_hand():
    """log sum exp over the moves that exist, less the value of the recorded one; 0 where only one move exists."""
    values = jnp.array([[1.0, 2.0, 50.0], [0.5, 7.0, 7.0]])
    mask = jnp.array([[True, True, False], [True, False, False]])
    gap = jax.jit(conservative_gap)(values, mask, jnp.array([0, 0]))
    np.testing.assert_allclose(gap, [np.log(np.exp(1.0) + np.exp(2.0)) - 1.0, 0.0], rtol=1e-6)


def test_gap_is_never_negative():
    """The recorded move exists, so the sum is at least its own term."""
    generator = np.random.default_rng(1)
    values = 5 * generator.normal(size=(500, ACTIONS)).astype(np.float32)
    mask = generator.random(values.shape) < 0.5
    mask[:, 0] = True
    gap = np.asarray(jax.jit(conservative_gap)(values, mask, np.zeros(500, np.int32)))
    assert (gap >= 0).all()


@pytest.mark.parametrize("weight", [pytest.param(0.0, marks=pytest.mark.long), 1.0])
def test_values_of_unrecorded_moves_are_held_down(weight):
    """After training, the greedy move is a recorded one under the penalty; without it nothing keeps the others
    below."""
    agent = agents.registry.entry("cql").make(CQLConfig(hidden=(32,)), FourActions())
    data = batch(jnp.ones(ACTIONS, bool))
    params, state = hand_made.initial(agent, jax.random.key(3), data.features[0], data.code[0])
    hyper = CQLHyperparameters(conservative_weight=weight)

    def step(params, _):
        gradient, metrics = jax.grad(
            lambda own: agent.loss(own, params, data, state, hyper, jax.random.key(0)), has_aux=True
        )(params)
        return jax.tree.map(lambda leaf, slope: leaf - 0.1 * slope, params, gradient), metrics["conservative_gap"]

    @jax.jit
    def trained(params):
        params, gaps = jax.lax.scan(step, params, None, length=300)
        key = jax.random.key(1)
        return gaps, agent.act(params, data.features, data.code, data.action_mask, key, Exploration(0.0, 0.0))

    gaps, action = jax.device_get(trained(params))
    recorded = float((action < 2).mean())
    if weight:
        assert recorded == 1.0 and gaps[-1] < 0.5 * gaps[0]
    else:
        assert recorded < 0.9


def batch_of(features, following, actions, goals: AllGoals, mask) -> AgentBatch:
    """A batch of which only the transitions under all goals are learned from."""
    return AgentBatch(
        observation=None,
        next_observation=None,
        features=features,
        code=None,
        action=actions,
        next_features=following,
        next_code=None,
        target_features=following,
        target_code=None,
        reward=None,
        discount=None,
        action_mask=mask,
        next_action_mask=mask,
        all_goals=goals,
    )


def test_targets_loss_and_gradient_are_those_of_leos_authors():
    """Their code on random inputs: linear action values through a sigmoid, the collecting network as target network."""
    recorded = places.recorded("leo")
    steps, width, goals = recorded["achieved"].shape
    inputs = recorded["observations"].shape[-1]

    def values_of_all(weights, features, codes):
        return jax.nn.sigmoid((features @ weights).reshape(-1, goals, 4)).swapaxes(1, 2)

    def taken_of_all(weights, features, actions, codes):
        return value_heads.of_actions(values_of_all(weights, features, codes), actions)

    head = value_heads.ValueHead(None, None, values_of_all, taken_of_all)
    first, following = (recorded["observations"][place].reshape(-1, inputs) for place in (slice(-1), slice(1, None)))
    achieved = jnp.asarray(recorded["achieved"].reshape(-1, 1, goals))
    reward, discount = value_heads.returns_of_all(achieved, jnp.ones(achieved.shape[:2]), recorded["discount"])
    discount = discount * ~recorded["ended"].reshape(-1, 1)
    mask = jnp.ones((steps * width, 4), bool)
    target = value_heads.target_of_all(reward, discount, values_of_all(recorded["weights"], following, None), mask)
    np.testing.assert_allclose(target, recorded["targets"].reshape(-1, goals), atol=1e-5)
    under = AllGoals(jnp.full(goals, 1 / goals), None, None, reward, discount)
    batch = batch_of(first, following, recorded["actions"].reshape(-1), under, mask)

    def loss(weights):
        return value_heads.value_loss(head, False, None, weights, recorded["weights"], batch, None)[0]

    found, gradient = jax.jit(jax.value_and_grad(loss))(jnp.asarray(recorded["trained_weights"]))
    np.testing.assert_allclose(found, recorded["loss"], atol=1e-5)
    np.testing.assert_allclose(gradient, recorded["gradient"], atol=1e-5)


def test_a_transition_ends_for_the_goal_that_it_achieves_alone():
    """Two steps: the first achieves goal 0, the second goals 0 and 1; goal 2 goes on. A step not taken achieves
    nothing."""
    hit = jnp.array([[[True, False, False], [True, True, False]]] * 2)
    reward, discount = value_heads.returns_of_all(hit, jnp.array([[1.0, 1.0], [1.0, 0.0]]), 0.5)
    np.testing.assert_allclose(reward, [[1.0, 0.5, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(discount, [[0.0, 0.0, 0.25], [0.0, 0.5, 0.5]])


def test_targets_look_at_legal_actions_only():
    values = jnp.zeros((1, 3, 2)).at[0, 1].set(9.0).at[0, 2].set(jnp.array([0.25, 0.5]))
    target = value_heads.target_of_all(jnp.zeros((1, 2)), jnp.ones((1, 2)), values, jnp.array([[True, False, True]]))
    np.testing.assert_allclose(target, [[0.25, 0.5]])


def inputs_of(kind: str):
    """A head with random parameters, features [B, F], and codes [G, d] of all goals."""
    head = value_heads.make(kind, (8, 8), 5, layer_norm=True, bounded=kind == "index", num_actions=A, num_goals=G)
    keys = jax.random.split(jax.random.key(0), 4)
    features = jax.random.normal(keys[0], (B, F))
    codes = jnp.arange(G, dtype=jnp.float32)[:, None] if kind == "index" else jax.random.normal(keys[1], (G, D))
    return head, jax.jit(head.init)(keys[2], features[0], codes[0]), features, codes


@pytest.mark.parametrize(
    "kind",
    [pytest.param("concatenated", marks=pytest.mark.long), "product", pytest.param("index", marks=pytest.mark.long)],
)
def test_all_goals_at_once_have_the_values_of_each_alone(kind):
    head, params, features, codes = inputs_of(kind)
    values, of_all, codes = jax.jit(head.values), jax.jit(head.values_of_all), np.asarray(codes)
    alone = np.stack([values(params, features, np.tile(code, (B, 1))) for code in codes], axis=-1)
    np.testing.assert_allclose(of_all(params, features, codes), alone, atol=1e-6)
    some = np.array([4, 1, 1])
    np.testing.assert_allclose(of_all(params, features, codes[some]), alone[..., some], atol=1e-6)
    actions = np.arange(B) % A
    taken = alone[np.arange(B), actions]
    np.testing.assert_allclose(jax.jit(head.taken_of_all)(params, features, actions, codes), taken, atol=1e-6)


def test_bounded_values_lie_between_0_and_1():
    head, params, features, codes = inputs_of("index")
    wide = jax.tree.map(lambda leaf: 50 * np.asarray(leaf), params)
    values = np.asarray(jax.jit(head.values_of_all)(wide, features, codes))
    assert values.min() >= 0 and values.max() <= 1 and values.std() > 0.3


def test_goals_without_a_share_teach_nothing():
    """The loss does not depend on their values, and the mean is over the others."""
    predicted, target = jnp.zeros((B, 3)), jnp.array([[0.5, 0.5, 1.0]] * B)
    loss, _ = value_heads.td_loss_of_all(predicted, target, jnp.array([0.5, 0.5, 0.0]), huber=False)
    np.testing.assert_allclose(loss, 0.125)
    gradient = jax.jit(
        jax.grad(lambda values: value_heads.td_loss_of_all(values, target, jnp.array([0.5, 0.5, 0.0]), True)[0])
    )(predicted)
    assert (gradient[:, 2] == 0).all() and (gradient[:, :2] != 0).all()


def critic_of_vectors():
    """TD3's product critics and actor with random parameters, features [B, F], actions [B, A] and codes [G, D]."""
    critic, actor = td3.TwinProductCritic((8,), 5, layer_norm=True, bounded=True), td3.Actor((8,), A)
    keys = jax.random.split(jax.random.key(1), 5)
    features, actions = jax.random.normal(keys[0], (B, F)), jax.random.normal(keys[1], (B, A))
    codes = jax.random.normal(keys[2], (G, D))
    params = {
        "critic": critic.init(keys[3], features[0], actions[0], codes[0]),
        "actor": actor.init(keys[4], jnp.concatenate([features[0], codes[0]])),
    }
    return critic, actor, params, features, actions, codes


@pytest.mark.long
def test_product_critics_value_all_goals_as_each_alone():
    critic, _, params, features, actions, codes = critic_of_vectors()
    alone = jnp.stack([critic.apply(params["critic"], features, actions, jnp.tile(code, (B, 1))) for code in codes], -1)
    every = critic.apply(params["critic"], features, actions, codes, method="of_all")
    np.testing.assert_allclose(every, alone, atol=1e-6)
    repeated = jnp.repeat(actions[:, None], G, axis=1)
    each = critic.apply(params["critic"], features, repeated, codes, method="of_each")
    np.testing.assert_allclose(each, alone, atol=1e-6)


@pytest.mark.long
def test_td3_under_all_goals_is_td3_under_each():
    """Without noise, the loss is the mean over goals of TD3's own critic loss; a goal without a share is left out."""
    critic, actor, params, features, actions, codes = critic_of_vectors()
    keys = jax.random.split(jax.random.key(2), 2)
    reward = jax.random.bernoulli(keys[0], 0.3, (B, G)).astype(jnp.float32)
    under = AllGoals(jnp.full(G, 1 / 6).at[2].set(0.0), codes, codes, reward, 0.9 * (1 - reward))
    batch = batch_of(features, features + 1.0, actions, under, None)
    found, _ = td3.loss_of_all(actor, critic, params, params, batch, 0.0, keys[1], huber=True)
    joined, losses = td3.OfInputs(critic, F), []
    for goal in (0, 1, 3, 4, 5, 6):
        code = jnp.tile(codes[goal], (B, 1))
        arrived = jnp.concatenate([features + 1.0, code], axis=-1)
        following = td3.next_value(keys[1], actor, joined, params, arrived, 0.0)
        target = reward[:, goal] + under.discount[:, goal] * following
        inputs = jnp.concatenate([features, code], axis=-1)
        losses.append(td3.losses(actor, joined, params, inputs, actions, target, huber=True).critic)
    np.testing.assert_allclose(found, np.mean(losses), rtol=1e-5)
