"""Goals, as vectors and as images, for learners that reconstruct them, and a loop that trains such a learner."""

import functools

import hand_made
import jax
import jax.numpy as jnp
import optax

from infogoal_jax import networks
from infogoal_jax.hyperparameters import NoHyperparameters

VECTORS = jax.random.normal(jax.random.key(10), (8, 16)) / 4.0  # Of length 1, about, as sentence embeddings are.
# 16 x 16, of squares.
IMAGES = jnp.kron(jax.random.randint(jax.random.key(11), (6, 4, 4, 3), 0, 256), jnp.ones((1, 4, 4, 1), int)).astype(
    jnp.uint8
)
SMALL = {"hidden": (32, 32), "latent_size": 8, "num_goals": 16}


def begun(learner, inputs):
    """Parameters and state of the learner for these inputs as they begin."""
    return jax.jit(lambda key: learner.init(key, hand_made.example(inputs), NoHyperparameters()))(jax.random.key(0))


@functools.partial(jax.jit, static_argnums=0)
def loss_of(learner, inputs, params, state, key, goals=None):
    """The learner's loss on goals of these inputs, all of them or those asked for: (loss, (metrics, state))."""
    goals = jnp.arange(len(inputs)) if goals is None else goals
    batch = hand_made.learner_batch(lambda goals: learner.encode(params, inputs[goals]), inputs=inputs, goals=goals)
    loss, metrics, state = learner.loss(params, state, batch, NoHyperparameters(), key)
    return loss, (metrics, state)


def trained(learner, inputs, updates, params=None, rate=3e-3, part=None):
    """Parameters, state, and metrics {name: [updates]} after updates on goals drawn at random. params: to begin with;
    part: all that changes."""
    start, state = begun(learner, inputs)
    params, optimizer = start if params is None else params, optax.adam(rate)

    def step(carry, key):
        params, state, optimizer_state = carry
        goals = jax.random.randint(key, (learner.sample_spec.num_goals,), 0, len(inputs))
        gradient, (metrics, state) = jax.grad(
            lambda params: loss_of(learner, inputs, params, state, key, goals), has_aux=True
        )(params)
        gradient = {
            name: leaf if part in (None, name) else jax.tree.map(jnp.zeros_like, leaf)
            for name, leaf in gradient.items()
        }
        change, optimizer_state = optimizer.update(gradient, optimizer_state)
        return (optax.apply_updates(params, change), state, optimizer_state), metrics

    carry = params, state, optimizer.init(params)
    (params, state, _), metrics = jax.jit(
        lambda carry: jax.lax.scan(step, carry, jax.random.split(jax.random.key(1), updates))
    )(carry)
    return params, state, metrics


def constant_error(inputs, standardise=False):
    """Mean squared error of the best constant, for each input number."""
    seen = networks.as_encoded(inputs, standardise)
    return ((seen - seen.mean(0)) ** 2).mean()
