"""InfoBot (Goyal et al. 2019): a goal code that limits how many bits of the goal the policy uses.

The loss is beta times the KL of the Gaussian code to N(0, I). beta is constant after a warm-up. The intrinsic reward is
large in states that were rarely visited, and for goals whose code has a large KL. As in the comparisons of InfoGoal's
paper, the encoder sees the goal alone. `state_conditioned` is the original form p(z | s, g).
"""

import dataclasses
from typing import Annotated, Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.field_types import Count
from infogoal_jax.hyperparameters import Number, Search
from infogoal_jax.learners.goal_encoder import GoalEncoderConfig, kl_to_standard_normal, warmed_up
from infogoal_jax.learners.learner import Encode, GoalCode, Learner, LearnerBatch, NewSteps, SampleSpec, Visited

SCALE_RATE = 0.01  # Rate of the running mean that normalises the intrinsic reward, as InfoGoal's.


@dataclasses.dataclass(frozen=True)
class InfoBotConfig(GoalEncoderConfig):
    """Sizes and switches of InfoBot."""

    state_conditioned: bool = False
    """Condition the code on the state too, p(z | s, g), as in the original. The comparisons of InfoGoal's paper encode
    the goal alone."""
    warm_up: Count = 2000
    """Updates over which beta rises from 0 [M]. Before the first reward nothing opposes the KL, and the code would
    collapse for good."""
    reward: Literal["rarity", "first_seen"] = "rarity"
    """Intrinsic reward. `rarity`: for goals whose code says much, in cells that were rarely visited; `first_seen`: 1
    for each known goal that the episode sees for the first time, as in the maze of InfoGoal's authors [A]. The latter
    does not fade with training, and does not depend on the code."""


@flax.struct.dataclass
class InfoBotHyperparameters:
    """Float hyperparameters of InfoBot."""

    beta: Annotated[float, Number("[0, 1]", Search(1e-5, 1e-2, "log", is_term=True))] = 0.01
    """Weight of the KL in bits, after the warm-up [A]; searched from where it acts (docs/research/tuning.md)."""


@flax.struct.dataclass
class InfoBotState:
    """What is not trained by the gradient."""

    counts: jax.Array
    """float32 [num_cells], visits to each cell."""
    scale: jax.Array
    """float32 [], running mean of the KL of desired goals in nats, which normalises the intrinsic reward."""
    updates: jax.Array
    """int32 [], updates so far."""


def make(config: InfoBotConfig) -> Learner:
    kind = networks.GoalLayers if config.state_conditioned else networks.GaussianEncoder
    encoder = kind(config.hidden, config.latent_size, config.standardise_images)
    joint_encoder = networks.GaussianEncoder(config.hidden[-1:], config.latent_size)

    def init(key, example, hyper):
        goal_key, joint_key = jax.random.split(key)
        first, scale = example.goal_inputs[:1], jnp.ones((), jnp.float32)
        params = {"encoder": encoder.init(goal_key, first)}
        if config.state_conditioned:
            params["joint"] = joint_encoder.init(
                joint_key, jnp.zeros((1, example.features.shape[-1] + config.latent_size), jnp.float32)
            )
        else:
            scale = kl_to_standard_normal(
                encode(params, first)
            ).mean()  # Close to that of any goal, so that the running mean starts right.
        return params, InfoBotState(jnp.zeros(example.num_cells, jnp.float32), scale, jnp.zeros((), jnp.int32))

    def encode(params, goal_inputs):
        """phi(g). In the state-conditioned form, the part that sees the goal, without noise."""
        encoded = encoder.apply(params["encoder"], goal_inputs)
        return GoalCode(encoded) if config.state_conditioned else GoalCode(*encoded)

    def condition(params, code: GoalCode, features):
        """p(z | s, g). The gradients of the KL and of the agent's loss train the state encoder and the goal encoder."""
        return GoalCode(*joint_encoder.apply(params["joint"], jnp.concatenate([features, code.mean], axis=-1)))

    def loss(params, state, batch: LearnerBatch, hyper, key):
        """beta KL(p(z | s, g) || N(0, I)) of the desired goals in bits (InfoBot's bound on I(A; G | S)); the authors'
        0.01 has this scale."""
        code = batch.encode(batch.desired_goal)
        if config.state_conditioned:
            code = condition(params, code, batch.transitions.features)
        kl = kl_to_standard_normal(code).mean()
        beta = hyper.beta * warmed_up(state.updates, config.warm_up)
        # The KL in nats, as InfoGoal reports it.
        metrics = {"kl": kl, "beta": beta, "visited_cells": (state.counts > 0).sum(dtype=jnp.int32)}
        return beta * kl / jnp.log(2.0), metrics, state.replace(updates=state.updates + 1)

    def intrinsic_reward(state, encode: Encode, visited: Visited):
        """KL(phi(g) || N(0, I)) / (its running mean * sqrt(c(s))), where c(s) is 1 + the visits so far to the cell that
        the step led to.

        The reward is of the order of 1 in a new cell. Its weight kappa is `intrinsic_weight / episode_length`: 0.01 for
        weight 1 and 100 steps. The KL of the state-conditioned form would need the features of every state. Its mean is
        taken instead, so that only visits count.

        With `reward = "first_seen"` it is the number of goals first seen instead.
        """
        if config.reward == "first_seen":
            return visited.first_seen, state
        rarity = jax.lax.rsqrt(state.counts[visited.cell] + 1.0)
        if config.state_conditioned:
            return rarity, state
        kl = jax.lax.stop_gradient(kl_to_standard_normal(encode(visited.desired_goal)))
        state = state.replace(scale=state.scale + SCALE_RATE * (kl.mean() - state.scale))
        return kl[:, None] / jnp.maximum(state.scale, 1e-6) * rarity, state

    def observe(state, new: NewSteps):
        return state.replace(counts=state.counts.at[new.cell].add(new.valid.astype(state.counts.dtype)))

    return Learner(
        init,
        encode,
        loss,
        sample_spec=SampleSpec(first_seen=config.reward == "first_seen"),
        only_compresses=True,
        intrinsic_reward=intrinsic_reward,
        observe=observe,
        condition=condition if config.state_conditioned else None,
    )
