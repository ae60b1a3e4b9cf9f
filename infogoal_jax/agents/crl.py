"""Contrastive RL (Eysenbach et al. 2022, arXiv 2206.07568) in the batched form of JaxGCRL (Bortkiewicz et al. 2025,
arXiv 2408.11052): which goal of the batch was reached after which state and action.

A transition carries a goal that its trajectory achieved later; the goals of the others are its negatives. The critic
f(s, a, g) compares phi(s, a) with psi(g), and comes to log p(g | s, a) - log p(g) but for a constant. Rewards, target
networks and bootstrapping are not needed. The actor is SAC's, with f in the place of the value.

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action, D of a representation.
"""

import dataclasses
from functools import partial
from typing import Annotated, Any, Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import sac, td3
from infogoal_jax.agents.agent import Agent, AgentBatch, AgentTraits
from infogoal_jax.errors import require
from infogoal_jax.field_types import Size, Sizes
from infogoal_jax.hyperparameters import Number, Search

Energy = Literal["norm", "dot"]
OF_RELABELLING = {"current_share": 0.0, "future_share": 1.0, "strategy": "soon", "skip_reached": False}
"""Every transition carries a goal that was achieved."""


@dataclasses.dataclass(frozen=True)
class CRLConfig:
    """Sizes and switches of contrastive RL."""

    hidden: Sizes = (256, 256)
    """Widths of the layers of phi, psi and the actor."""
    size: Size = 64
    """Size D of the representations."""
    energy: Energy = "norm"
    """How representations are compared: `norm`: minus their distance; `dot`: their scalar product."""
    layer_norm: bool = True
    """Normalise what each ReLU of phi and psi gets."""

    @property
    def num_steps(self) -> int:
        """Steps of a transition: the representation is of a state and the action there."""
        return 1

    def check(self, config) -> None:
        """Raise `UserError` for batches of one transition."""
        check_batch(config)


def check_batch(config: Any) -> None:
    """Raise `UserError` for batches without a goal of another transition."""
    remedy = "goals of the other transitions are the contrast; give 2 or more"
    require(config.batch_size > 1, "batch_size", config.batch_size, remedy)


@flax.struct.dataclass
class CRLHyperparameters:
    """Float hyperparameters of contrastive RL."""

    logsumexp_weight: Annotated[float, Number("[0, inf)", Search(0.01, 1.0, "log", always=False))] = 0.1
    """Weight of the squared log-sum-exp of the energies: it fixes their level, which the contrast leaves open."""
    target_entropy: Annotated[float, sac.TARGET_ENTROPY] = -0.5
    """Entropy of each number of an action, in nats, that the temperature is led to."""
    initial_temperature: Annotated[float, sac.TEMPERATURE] = 1.0
    """Temperature at the start, beside energies that are logarithms of probabilities."""


def energy(kind: Energy, first: jax.Array, second: jax.Array) -> jax.Array:
    """How well representations [..., D] fit, float32 [...]."""
    if kind == "dot":
        return (first * second).sum(-1)
    return -length(first - second)


def length(vectors: jax.Array) -> jax.Array:
    """The length of each vector of [..., D], float32 [...], which has a gradient at 0 too."""
    return jnp.sqrt(jnp.square(vectors).sum(-1) + 1e-6)


def energies(kind: Energy, first: jax.Array, second: jax.Array) -> jax.Array:
    """How well each of the first representations [B, D] fits each of the second [G, D], float32 [B, G]."""
    return first @ second.T if kind == "dot" else -distances(first, second)


@jax.custom_vjp
def distances(first: jax.Array, second: jax.Array) -> jax.Array:
    """The distance of each of the first vectors [B, D] from each of the second [G, D], float32 [B, G].

    Its gradient is two products of matrices, and holds no differences [B, G, D]: sum_j w_ij (a_i - b_j) is
    a_i sum_j w_ij - (W b)_i. All are taken from the centre of the second, so that close vectors lose no digits.
    """
    return length(first[:, None] - second[None])


def distances_and_what_their_gradient_needs(first, second):
    apart = distances(first, second)
    return apart, (first, second, apart)


def gradient_of_distances(kept, cotangent):
    first, second, apart = kept
    weight, centre = cotangent / apart, second.mean(0)
    first, second = first - centre, second - centre
    product = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
    return (
        weight.sum(1)[:, None] * first - product(weight, second),
        weight.sum(0)[:, None] * second - product(weight.T, first),
    )


distances.defvjp(distances_and_what_their_gradient_needs, gradient_of_distances)


def contrastive_loss(logits: jax.Array, logsumexp_weight: jax.Array) -> jax.Array:
    """Symmetric InfoNCE, and the penalty on the log-sum-exp over goals.

    logits: float32 [B, B], energies of state and action i with goal j, which belong together on the diagonal.
    """
    over_goals, over_states = (jax.nn.logsumexp(logits, axis=axis) for axis in (1, 0))
    infonce = (over_goals + over_states - 2.0 * jnp.diagonal(logits)).mean()
    return infonce + logsumexp_weight * jnp.square(over_goals).mean()


def logit_metrics(logits: jax.Array) -> dict[str, jax.Array]:
    """accuracy: fraction of states and actions whose own goal fits best; the mean energies of pairs that belong
    together, and of others."""
    size, own = logits.shape[0], jnp.diagonal(logits)
    others = (logits.sum() - own.sum()) / max(size * (size - 1), 1)
    accuracy = (logits.argmax(1) == jnp.arange(size)).mean(dtype=jnp.float32)
    return {"accuracy": accuracy, "energy_of_positives": own.mean(), "energy_of_negatives": others}


def traits(config: CRLConfig) -> AgentTraits:
    """Its actions are vectors; it learns from goals that were achieved."""
    return AgentTraits("vectors", achieved_goals=True)


def make(config: CRLConfig, env) -> Agent:
    actor = sac.Actor(config.hidden, env.action_size)
    phi, psi = (networks.MLP(config.hidden, config.size, config.layer_norm) for _ in range(2))

    def of_actions(params, features, action):
        """phi(s, a) [B, D]."""
        return phi.apply(params["phi"], jnp.concatenate([features, action], axis=-1))

    def fit(params, features, action, code):
        """f(s, a, g), each state and action with its own goal, float32 [B]."""
        return energy(config.energy, of_actions(params, features, action), psi.apply(params["psi"], code))

    def init(key, features, code):
        keys = jax.random.split(key, 3)
        state_and_action = jnp.concatenate([features, jnp.zeros(env.action_size, jnp.float32)])
        params = {
            "actor": actor.init(keys[0], td3.joined(features, code)),
            "phi": phi.init(keys[1], state_and_action),
            "psi": psi.init(keys[2], code),
            "log_temperature": jnp.zeros((), jnp.float32),
        }
        return params, ()

    def act(params, features, code, action_mask, key, exploration):
        """An action that the policy draws; the greedy one is tanh(mean)."""
        return sac.choose(actor, params, td3.joined(features, code), key, exploration)

    def value(params, features, code, action_mask):
        """f of tanh(mean)."""
        mean, _ = actor.apply(params["actor"], td3.joined(features, code))
        return fit(params, features, jnp.tanh(mean), code)

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """The contrastive loss, and those of the actor and the temperature."""
        first, second = of_actions(params, batch.features, batch.action), psi.apply(params["psi"], batch.code)
        logits = energies(config.energy, first, second)
        critic_loss = contrastive_loss(logits, hyper.logsumexp_weight)
        frozen, features, code = jax.lax.stop_gradient((params, batch.features, batch.code))
        learned = sac.actor_losses(
            actor, params, td3.joined(features, code), lambda action: fit(frozen, features, action, code), hyper, key
        )
        metrics = {"critic_loss": critic_loss} | logit_metrics(logits) | learned.metrics
        return critic_loss + learned.loss, metrics

    return Agent(init, act, value, loss, config.num_steps)
