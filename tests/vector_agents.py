"""What the tests of agents for vectors share: a random batch, networks in NumPy, and a point on a line that is told
where to go, which an agent learns through its contract alone."""

from types import SimpleNamespace

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import optax

from infogoal_jax.agents import registry
from infogoal_jax.agents.agent import ActorGoals, Agent, AgentBatch, Exploration

B, F, D, A = 16, 5, 3, 2
STEP, NEAR, LENGTH, DISCOUNT = 0.4, 0.1, 8, 0.9
"""Of the line from -1 to 1: how far a step leads, how near to the goal is at it, steps of an episode."""
UPDATES = 400
GREEDY = Exploration(0.0, 0.0)


def agent_of(name: str, action_size: int = A, **changes) -> Agent:
    """An agent of small networks."""
    entry = registry.entry(name)
    return entry.make(entry.config(**({"hidden": (8, 8)} | changes)), SimpleNamespace(action_size=action_size))


def random_batch(seed: int = 0, **changes) -> AgentBatch:
    """Transitions between random features under random codes."""
    generator = np.random.default_rng(seed)

    def normal(*shape):
        return jnp.asarray(generator.normal(size=shape), jnp.float32)

    batch = AgentBatch(
        observation=None,
        next_observation=None,
        features=normal(B, F),
        code=normal(B, D),
        action=jnp.tanh(normal(B, A)),
        next_features=normal(B, F),
        next_code=normal(B, D),
        target_features=normal(B, F),
        target_code=normal(B, D),
        reward=jnp.asarray(generator.integers(0, 2, B), jnp.float32),
        discount=jnp.asarray(generator.uniform(0, 1, B), jnp.float32),
        action_mask=jnp.ones((B, A), bool),
        next_action_mask=jnp.ones((B, A), bool),
    )
    return batch.replace(**changes)


def started(agent: Agent, seed: int = 0):
    """Parameters and state of an agent for such batches."""
    return hand_made.initial(agent, jax.random.key(seed), jnp.zeros(F), jnp.zeros(D))


def varied(params, seed: int):
    """Other parameters of the same shapes."""
    generator = np.random.default_rng(seed)
    return jax.tree.map(
        lambda leaf: np.asarray(leaf) + (0.3 * generator.normal(size=leaf.shape)).astype(np.float32), params
    )


def mlp(params, inputs: np.ndarray) -> np.ndarray:
    """`networks.MLP` in NumPy: params as flax names them, inputs [B, D] to [B, out] in 64 bits."""
    while "params" in params or len(params) == 1:
        (params,) = params.values()
    layers = sum(name.startswith("Dense") for name in params)
    values = np.asarray(inputs, np.float64)
    for layer in range(layers):
        dense = {name: np.asarray(leaf, np.float64) for name, leaf in params[f"Dense_{layer}"].items()}
        values = values @ dense["kernel"] + dense["bias"]
        if layer == layers - 1:
            return values
        if f"LayerNorm_{layer}" in params:
            norm = params[f"LayerNorm_{layer}"]
            values = (values - values.mean(-1, keepdims=True)) / np.sqrt(values.var(-1, keepdims=True) + 1e-6)
            values = values * np.asarray(norm["scale"]) + np.asarray(norm["bias"])
        values = np.maximum(values, 0.0)


def twin(params, features, code, action) -> np.ndarray:
    """`td3.TwinCritic` in NumPy: [2, B]."""
    inputs = np.concatenate([features, code, action], axis=-1)
    return np.stack(
        [mlp(jax.tree.map(lambda leaf, which=which: leaf[which], params), inputs)[:, 0] for which in (0, 1)]
    )


def joined(*parts) -> np.ndarray:
    """Arrays [B, ...] side by side."""
    return np.concatenate([np.asarray(part) for part in parts], axis=-1)


def moved(place: jax.Array, action: jax.Array) -> jax.Array:
    """The next places [..., 1] of points."""
    return jnp.clip(place + STEP * action, -1.0, 1.0)


def random_walks(key: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Places [count, LENGTH + 1, 1] of random walks, and their actions [count, LENGTH, 1]."""
    start_key, action_key = jax.random.split(key)
    actions = jax.random.uniform(action_key, (LENGTH, count, 1), minval=-1.0)
    start = jax.random.uniform(start_key, (count, 1), minval=-1.0)
    _, places = jax.lax.scan(lambda place, action: (moved(place, action),) * 2, start, actions)
    return jnp.concatenate([start[None], places]).swapaxes(0, 1), actions.swapaxes(0, 1)


def relabelled(
    key: jax.Array, places: jax.Array, actions: jax.Array, size: int, share: float, costs: bool
) -> AgentBatch:
    """Steps of the walks under a place that followed, a share of them, or under any place. costs: -1 for each step that
    does not start at the goal, in place of 1 for the one that reaches it."""
    keys = jax.random.split(key, 5)
    row = jax.random.randint(keys[0], (size,), 0, len(places))
    step = jax.random.randint(keys[1], (size,), 0, LENGTH)
    later = jax.random.randint(keys[2], (size,), step + 1, LENGTH + 1)
    anywhere = jax.random.uniform(keys[3], (size, 1), minval=-1.0)
    goal = jnp.where(jax.random.uniform(keys[4], (size, 1)) < share, places[row, later], anywhere)
    here, following = places[row, step], places[row, step + 1]
    reached = (jnp.abs((here if costs else following) - goal)[:, 0] < NEAR).astype(jnp.float32)
    reward = reached - 1.0 if costs else reached
    legal = jnp.ones((size, 1), bool)
    return AgentBatch(
        observation=here,
        next_observation=following,
        features=here,
        code=goal,
        action=actions[row, step],
        next_features=following,
        next_code=goal,
        target_features=following,
        target_code=goal,
        reward=reward,
        discount=DISCOUNT * (1.0 - reached),
        action_mask=legal,
        next_action_mask=legal,
        first_target_features=here,
        first_target_code=goal,
        at_goal=reached > 0,
        actor=ActorGoals(goal, goal),
    )


def success_on_the_line(
    agent: Agent, hyper, share: float, learning_rate: float = 3e-3, costs: bool = False, updates: int = UPDATES
) -> tuple[float, float]:
    """How often the greedy policy gets to its goal within an episode, before and after it learned from random walks."""
    keys = jax.random.split(jax.random.key(0), 5)
    places, actions = random_walks(keys[0], 500)
    params, state = hand_made.initial(agent, keys[1], jnp.zeros(1), jnp.zeros(1))
    optimizer = optax.adam(learning_rate)

    def update(carry, key):
        params, target_params, moments = carry
        batch_key, loss_key = jax.random.split(key)
        batch = relabelled(batch_key, places, actions, 128, share, costs)
        gradient = jax.grad(lambda own: agent.loss(own, target_params, batch, state, hyper, loss_key)[0])(params)
        change, moments = optimizer.update(gradient, moments)
        params = optax.apply_updates(params, change)
        return (params, optax.incremental_update(params, target_params, 0.05), moments), None

    def success(params):
        place, goal = jax.random.uniform(keys[3], (2, 200, 1), minval=-1.0)

        def step(carry, key):
            place, arrived = carry
            place = moved(place, agent.act(params, place, goal, jnp.ones((200, 1), bool), key, GREEDY))
            return (place, arrived | (jnp.abs(place - goal)[:, 0] < NEAR)), None

        (_, arrived), _ = jax.lax.scan(step, (place, jnp.zeros(200, bool)), jax.random.split(keys[4], LENGTH))
        return arrived.mean()

    @jax.jit
    def run(params):
        carry = (params, params, optimizer.init(params))
        (learned, *_), _ = jax.lax.scan(update, carry, jax.random.split(keys[2], updates))
        return jax.lax.map(success, jax.tree.map(lambda *each: jnp.stack(each), params, learned))

    before, after = run(params).tolist()
    return before, after
