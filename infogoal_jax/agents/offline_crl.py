"""Contrastive RL for recorded episodes, in OGBench's definition (Eysenbach et al. 2022, arXiv 2206.07568; Park et al.
2025, arXiv 2410.20092): two critics f(s, a, g) = phi(s, a) . psi(g) / sqrt(D) tell the goals that were reached from
those of the other transitions, each pair by itself. The actor climbs f near the recorded actions. `crl.py` is the one
that acts.

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action, D of a representation.
"""

import dataclasses
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import crl, offline, td3
from infogoal_jax.agents.agent import Agent, AgentBatch, AgentTraits
from infogoal_jax.errors import require
from infogoal_jax.field_types import Size

OF_RELABELLING = {"current_share": 0.0, "future_share": 1.0}
"""Goals that were achieved later, the sooner the likelier."""


@dataclasses.dataclass(frozen=True)
class OfflineCRLConfig(offline.OfflineConfig):
    """Sizes of contrastive RL for recorded episodes."""

    size: Size = 512
    """Size D of the representations."""

    def check(self, config) -> None:
        """Raise `UserError` for goals that were not all achieved later, and for batches of one transition."""
        crl.check_batch(config)
        share = getattr(config.relabelling, "current_share", 0.0), getattr(config.relabelling, "future_share", 1.0)
        remedy = "agent offline_crl learns from goals that were achieved later alone; give future_share 1"
        require(share == (0.0, 1.0), "relabelling.future_share", share[1], remedy)


@flax.struct.dataclass
class OfflineCRLHyperparameters:
    """Float hyperparameters of contrastive RL for recorded episodes."""

    alpha: Annotated[float, offline.ALPHA] = 0.1
    """Weight of the recorded actions."""


def binary_loss(logits: jax.Array) -> jax.Array:
    """Mean binary cross-entropy of logits [2, B, B]: pairs on the diagonal belong together (NCE; Eysenbach et al.,
    Eq. 4)."""
    own = jnp.eye(logits.shape[-1], dtype=jnp.float32)
    return (jax.nn.softplus(logits) - own * logits).mean()


def traits(config: OfflineCRLConfig) -> AgentTraits:
    """As of the other offline agents; it learns from goals that were achieved."""
    return offline.traits(config)._replace(achieved_goals=True)


def make(config: OfflineCRLConfig, env) -> Agent:
    actor = offline.make_actor(config, env.action_size)
    phi, psi = (networks.TwinGeluMLP(config.hidden, config.size, config.layer_norm) for _ in range(2))

    def init(key, features, code):
        keys, action = jax.random.split(key, 3), jnp.zeros(env.action_size, jnp.float32)
        return {
            "actor": actor.init(keys[0], td3.joined(features, code)),
            "phi": phi.init(keys[1], td3.joined(features, action)),
            "psi": psi.init(keys[2], code),
        }, ()

    def of_actions(params, features, action):
        """phi(s, a) / sqrt(D), [2, B, D]."""
        return phi.apply(params["phi"], td3.joined(features, action)) / config.size**0.5

    def fit(params, features, action, code):
        """The lower f(s, a, g) of both critics, each with its own goal, float32 [B]."""
        return (of_actions(params, features, action) * psi.apply(params["psi"], code)).sum(-1).min(0)

    def value(params, features, code, action_mask):
        """f of the actor's action."""
        action = jnp.clip(actor.apply(params["actor"], td3.joined(features, code)), -1.0, 1.0)
        return fit(params, features, action, code)

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """The contrastive loss, and the actor's."""
        first, second = of_actions(params, batch.features, batch.action), psi.apply(params["psi"], batch.code)
        logits = jnp.einsum("nid,njd->nij", first, second)
        contrastive = binary_loss(logits)
        (inputs, _), frozen = offline.actor_inputs(batch), jax.lax.stop_gradient(params)
        features, code = jax.lax.stop_gradient((batch.features, batch.actor.code))
        mean = actor.apply(params["actor"], inputs)
        log_pi = offline.log_density(mean, batch.action)
        actor_loss = offline.near_data(fit(frozen, features, jnp.clip(mean, -1.0, 1.0), code), log_pi, hyper.alpha)
        metrics = {"contrastive_loss": contrastive, "actor_loss": actor_loss, "log_density": log_pi.mean()}
        return contrastive + actor_loss, metrics | crl.logit_metrics(logits.mean(0))

    return offline.agent(init, offline.make_act(actor), value, loss)
