"""Value heads: Q(s, a, g) from features of states and codes of goals, for one goal a state or for all goals of a batch
in one pass.

    concatenated   Q = MLP([psi(s), z(g)])[a]: the universal value function; G goals take B * G passes
    product        Q = f(psi(s))[a] . h(z(g)): the all-goals head; G goals take one product [B * A, D] x [D, G]
    index          Q = MLP(psi(s))[a, g]: LEO, an output for each goal; a code is the number of its goal

Shapes: B states, F features, A actions, d numbers of a goal code, G goals, N goals of the task.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from infogoal_jax import networks

Kind = Literal["concatenated", "product", "index"]


class ValueHead(NamedTuple):
    """Action values as pure functions of parameters."""

    init: Callable[[jax.Array, jax.Array, jax.Array], Any]
    """(key, features [F], code [d]) -> params."""
    values: Callable[[Any, jax.Array, jax.Array], jax.Array]
    """(params, features [B, F], code [B, d]) -> float32 [B, A], each state under its own goal."""
    values_of_all: Callable[[Any, jax.Array, jax.Array], jax.Array]
    """(params, features [B, F], codes [G, d]) -> float32 [B, A, G], every state under every goal."""
    taken_of_all: Callable[[Any, jax.Array, jax.Array, jax.Array], jax.Array]
    """(params, features [B, F], actions int32 [B], codes [G, d]) -> float32 [B, G], of one action in each state."""


def make(kind: Kind, hidden: tuple[int, ...], size: int, bounded: bool, num_actions: int, num_goals: int) -> ValueHead:
    """The head of this kind. hidden: widths of its layers; size: D of the product; bounded: a sigmoid keeps values
    between 0 and 1."""
    inner = {
        "concatenated": lambda: concatenated(hidden, num_actions),
        "product": lambda: product(hidden, size, num_actions),
        "index": lambda: index(hidden, num_actions, num_goals),
    }[kind]()
    if not bounded:
        return inner
    return ValueHead(
        inner.init,
        *(
            lambda *arguments, logits=logits: jax.nn.sigmoid(logits(*arguments))
            for logits in (inner.values, inner.values_of_all, inner.taken_of_all)
        ),
    )


def of_actions(values: jax.Array, actions: jax.Array) -> jax.Array:
    """The values of these actions, float32 [B, ...]: values float32 [B, A, ...], actions int32 [B]."""
    return jnp.take_along_axis(values, jnp.expand_dims(actions, range(1, values.ndim)), axis=1)[:, 0]


def concatenated(hidden: tuple[int, ...], num_actions: int) -> ValueHead:
    """Features and code pass all layers together."""
    network = networks.MLP(hidden, num_actions)

    def values(params, features, code):
        return network.apply(params, jnp.concatenate([features, code], axis=-1))

    def values_of_all(params, features, codes):
        def under(code):
            return values(params, features, jnp.broadcast_to(code, (*features.shape[:-1], code.shape[-1])))

        return jax.vmap(under, out_axes=-1)(codes)

    return ValueHead(
        init=lambda key, features, code: network.init(key, jnp.concatenate([features, code], axis=-1)),
        values=values,
        values_of_all=values_of_all,
        taken_of_all=lambda params, features, actions, codes: of_actions(
            values_of_all(params, features, codes), actions
        ),
    )


def product(hidden: tuple[int, ...], size: int, num_actions: int) -> ValueHead:
    """Features and code pass layers of their own, which meet in a scalar product."""
    states, goals = networks.MLP(hidden, num_actions * size), networks.MLP(hidden[-1:], size)

    def init(key, features, code):
        state_key, goal_key = jax.random.split(key)
        return {"states": states.init(state_key, features), "goals": goals.init(goal_key, code)}

    def of_states(params, features):
        """f(psi(s)) [B, A, D], scaled so that a product of two such vectors is of the order of 1."""
        return states.apply(params["states"], features).reshape(*features.shape[:-1], num_actions, size) / size**0.5

    def of_goals(params, codes):
        """h(z(g)) [..., D]."""
        return goals.apply(params["goals"], codes)

    return ValueHead(
        init=init,
        values=lambda params, features, code: jnp.einsum(
            "bad,bd->ba", of_states(params, features), of_goals(params, code)
        ),
        values_of_all=lambda params, features, codes: jnp.einsum(
            "bad,gd->bag", of_states(params, features), of_goals(params, codes)
        ),
        taken_of_all=lambda params, features, actions, codes: (
            of_actions(of_states(params, features), actions) @ of_goals(params, codes).T
        ),
    )


def index(hidden: tuple[int, ...], num_actions: int, num_goals: int) -> ValueHead:
    """An output for each action and goal (LEO). A code [1] is the number of its goal."""
    layers = networks.MLP(hidden[:-1], hidden[-1])
    starting_weights = nn.initializers.lecun_normal()

    def init(key, features, code):
        layer_key, output_key = jax.random.split(key)
        weights = starting_weights(output_key, (hidden[-1], num_actions * num_goals))
        return {
            "layers": layers.init(layer_key, features),
            "weights": weights.reshape(hidden[-1], num_actions, num_goals),
            "biases": jnp.zeros((num_actions, num_goals)),
        }

    def outputs(params, codes):
        """The weights [H, A, G] and biases [A, G] of the outputs of these goals [G, 1]. As many goals as there are mean
        all of them, in order."""
        if len(codes) == num_goals:
            return params["weights"], params["biases"]
        goals = codes[:, 0].astype(jnp.int32)
        return params["weights"][..., goals], params["biases"][..., goals]

    def of_states(params, features):
        return nn.relu(layers.apply(params["layers"], features))

    def values(params, features, code):
        goals = code[:, 0].astype(jnp.int32)
        weights, biases = params["weights"][..., goals], params["biases"][..., goals]
        return jnp.einsum("bh,hab->ba", of_states(params, features), weights) + biases.T

    def values_of_all(params, features, codes):
        weights, biases = outputs(params, codes)
        return jnp.einsum("bh,hag->bag", of_states(params, features), weights) + biases

    def taken_of_all(params, features, actions, codes):
        return of_actions(values_of_all(params, features, codes), actions)

    return ValueHead(init, values, values_of_all, taken_of_all)
