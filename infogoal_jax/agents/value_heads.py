"""Value heads: Q(s, a, g) from features of states and codes of goals, for one goal a state or for all goals of a batch
in one pass. And learning from every transition under all goals at once (LEO: Matthews et al. 2026, arXiv 2605.23551;
before it Kaelbling 1993).

    concatenated   Q = MLP([psi(s), z(g)])[a]: the universal value function; G goals take B * G passes
    product        Q = f(psi(s))[a] . h(z(g)): the all-goals head; G goals take one product [B * A, D] x [D, G]
    index          Q = MLP(psi(s))[a, g]: LEO, an output for each goal; a code is the number of its goal

Under all goals each goal g has a reward of its own, 1 where the transition achieves g, and ends for g alone. One
network values all goals in one pass, so that a transition costs hardly more than under the desired goal.

Shapes: B states, F features, A actions, d numbers of a goal code, G goals, N goals of the task.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents.agent import AgentBatch
from infogoal_jax.shapes import with_rank

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


def make(
    kind: Kind, hidden: tuple[int, ...], size: int, layer_norm: bool, bounded: bool, num_actions: int, num_goals: int
) -> ValueHead:
    """The head of this kind. hidden: widths of its layers, which are normalised with `layer_norm`; size: D of the
    product; bounded: a sigmoid keeps values between 0 and 1."""
    inner = {
        "concatenated": lambda: concatenated(hidden, layer_norm, num_actions),
        "product": lambda: product(hidden, size, layer_norm, num_actions),
        "index": lambda: index(hidden, layer_norm, num_actions, num_goals),
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
    # One of each row: a GPU that knows it adds up no gradients.
    return values.at[jnp.arange(len(actions), dtype=jnp.int32), actions].get(unique_indices=True)


def concatenated(hidden: tuple[int, ...], layer_norm: bool, num_actions: int) -> ValueHead:
    """Features and code pass all layers together."""
    network = networks.MLP(hidden, num_actions, layer_norm)

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


def product(hidden: tuple[int, ...], size: int, layer_norm: bool, num_actions: int) -> ValueHead:
    """Features and code pass layers of their own, which meet in a scalar product."""
    states = networks.MLP(hidden, num_actions * size, layer_norm)
    goals = networks.MLP(hidden[-1:], size, layer_norm)

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


def index(hidden: tuple[int, ...], layer_norm: bool, num_actions: int, num_goals: int) -> ValueHead:
    """An output for each action and goal (LEO). A code [1] is the number of its goal."""
    layers = networks.MLP(hidden[:-1], hidden[-1], layer_norm)
    norm = nn.LayerNorm(use_bias=False, use_scale=False)  # The weights and biases of the outputs follow it.
    starting_weights = nn.initializers.lecun_normal()

    def init(key, features, code):
        layer_key, output_key = jax.random.split(key)
        weights = starting_weights(output_key, (hidden[-1], num_actions * num_goals), jnp.float32)
        return {
            "layers": layers.init(layer_key, features),
            "weights": weights.reshape(hidden[-1], num_actions, num_goals),
            "biases": jnp.zeros((num_actions, num_goals), jnp.float32),
        }

    def outputs(params, codes):
        """The weights [H, A, G] and biases [A, G] of the outputs of these goals [G, 1]. As many goals as there are mean
        all of them, in order."""
        if len(codes) == num_goals:
            return params["weights"], params["biases"]
        goals = codes[:, 0].astype(jnp.int32)
        return params["weights"][..., goals], params["biases"][..., goals]

    def of_states(params, features):
        outputs = layers.apply(params["layers"], features)
        return nn.relu(norm.apply({}, outputs) if layer_norm else outputs)

    def values(params, features, code):
        goals = code[:, 0].astype(jnp.int32)
        weights, biases = params["weights"][..., goals], params["biases"][..., goals]
        return jnp.einsum("bh,hab->ba", of_states(params, features), weights) + biases.T

    def values_of_all(params, features, codes):
        weights, biases = outputs(params, codes)
        return jnp.einsum("bh,hag->bag", of_states(params, features), weights) + biases[None]

    def taken_of_all(params, features, actions, codes):
        return of_actions(values_of_all(params, features, codes), actions)

    return ValueHead(init, values, values_of_all, taken_of_all)


def returns_of_all(hit: jax.Array, mask: jax.Array, discount: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Discounted reward of each transition under each goal, and the discount of what follows it: float32 [B, G] each.

    hit: bool [B, n, G], goals achieved after each step; mask: float32 [B, n], 1 for a step that was taken. The first
    hit of a goal is worth 1 and ends the transition for that goal.
    """
    hit = hit & (mask > 0)[..., None]
    first = hit & (jnp.cumsum(hit, axis=1, dtype=jnp.int32) == 1)
    powers = discount ** jnp.arange(mask.shape[1], dtype=jnp.int32).astype(jnp.float32)
    reward = jnp.einsum("bng,n->bg", first.astype(jnp.float32), powers)
    return reward, (discount ** mask.sum(1))[:, None] * (~hit.any(1)).astype(jnp.float32)


def target_of_all(
    reward: jax.Array, discount: jax.Array, next_values: jax.Array, next_action_mask: jax.Array
) -> jax.Array:
    """r_g + discount_g max_a' Q(s', a', g), float32 [B, G], without gradient.

    reward, discount: float32 [B, G]; next_values: float32 [B, A, G]; next_action_mask: bool [B, A].
    """
    best = jnp.where(next_action_mask[..., None], next_values, -jnp.inf).max(1)
    return jax.lax.stop_gradient(reward + discount * best)


def mean_over_goals(values: jax.Array, weight: jax.Array) -> jax.Array:
    """The mean of values [..., G] over all axes; goals count by their weight [G]."""
    return (values * with_rank(weight, values.ndim)).sum(-1).mean()


def td_loss_of_all(
    predicted: jax.Array, target: jax.Array, weight: jax.Array, huber: bool
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Temporal-difference error of values [B, G] against their targets [B, G], over goals with a weight alone:
    (loss, metrics). Without `huber` it is LEO's half of the mean square."""
    error = networks.squared_or_huber(predicted, target, huber)
    metrics = {
        "td_error": mean_over_goals(jnp.abs(predicted - target), weight),
        "value": mean_over_goals(predicted, weight),
    }
    return mean_over_goals(error, weight), metrics


def value_loss(
    head: ValueHead, huber: bool, regulariser: Callable | None, params, target_params, batch: AgentBatch, hyper
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The loss of action values under the goals `batch.all_goals`: (loss, metrics). The target network chooses and
    values what follows, as one product [B, A, G].

    regulariser(values float32 [B, A], batch, hyper) -> (loss, metrics) of one goal, or None; it counts for each goal.
    """
    goals = batch.all_goals
    following = head.values_of_all(target_params, batch.target_features, goals.target_code)
    target = target_of_all(goals.reward, goals.discount, following, batch.next_action_mask)
    if regulariser is None:
        predicted = head.taken_of_all(params, batch.features, batch.action, goals.code)
        return td_loss_of_all(predicted, target, goals.weight, huber)
    values = head.values_of_all(params, batch.features, goals.code)
    predicted = of_actions(values, batch.action)
    error, metrics = td_loss_of_all(predicted, target, goals.weight, huber)
    extra, own_metrics = jax.vmap(lambda under_one: regulariser(under_one, batch, hyper), in_axes=-1)(values)
    own_metrics = {name: mean_over_goals(value, goals.weight) for name, value in own_metrics.items()}
    return error + mean_over_goals(extra, goals.weight), metrics | own_metrics
