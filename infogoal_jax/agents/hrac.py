"""HRAC (Zhang et al. 2020): a high level, TD3 that chooses a subgoal every k steps, over a low level, trained
beforehand and frozen, that drives the robot to the target state of the subgoal (Sec. V-C of the paper).

A subgoal in [-1, 1] means a target state near the present one. The adjacency network learns a distance that tells
states within k steps of each other; the actor pays a penalty for subgoals beyond. The low level is an actor that drives
the robot, or a DQN that drives an arm by discrete moves of its joints.
"""

import dataclasses
from typing import Annotated, Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks, pairs
from infogoal_jax.agents import td3
from infogoal_jax.agents.agent import Agent, AgentBatch, AgentTraits
from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.errors import require
from infogoal_jax.field_types import Size, Sizes, Within
from infogoal_jax.hyperparameters import Number, Search

ADJACENT, APART, PENALTY_STARTS = 1.0, 1.2, 1.1
"""Distances of the adjacency network: adjacent states lie below the first, others above the second, and the penalty
starts at the third (HRAC's own code)."""
MOST_CELLS = 8192
"""The adjacency matrix grows with the square of the number of cells."""


@dataclasses.dataclass(frozen=True)
class HRACConfig(OfAllGoals):
    """Sizes and switches of HRAC's high level."""

    interval: int = 5
    """Steps k between two subgoals."""
    subgoal_scale: Annotated[float, Within("(0, 1]", "give metres or radians, for example 0.15")] = 0.15
    """Largest displacement of a subgoal along an axis, in m; of a joint, in radians."""
    hidden: Sizes = (256, 256)
    """Widths of the layers of actor and critics."""
    num_decisions: Size = 1
    """Subgoals that a return spans before it is bootstrapped."""
    adjacency_hidden: Sizes = (128, 128)
    """Widths of the adjacency network's layers."""
    adjacency_size: Size = 32
    """Size of the adjacency network's code."""
    cell: Annotated[float, Within("[0.02, inf)", "give at least 0.02 m or radians: half takes 64 times the memory")] = (
        0.05
    )
    """Side of the cells of the adjacency matrix, in m or radians."""
    critic: Literal["concatenated", "product"] = "concatenated"
    """How values depend on the goal: `concatenated`: one network of features, code and action; `product`: the all-goals
    head (docs/research/all_goals.md)."""
    critic_size: Size = 128
    """Size of the vectors whose product is a value, for `product` alone."""
    layer_norm: bool = False
    """Normalise what each ReLU of the critics gets, as LEO's authors do (docs/research/all_goals.md)."""
    bounded: bool = False
    """Keep values between 0 and 1 by a sigmoid, for `product` alone. Not for rewards other than 1 at the goal."""
    low_level: str = ""
    """File or run of a low level, of `infogoal pretrain`; empty: the one that the project ships."""

    def check(self, config) -> None:
        """Raise `UserError` for an interval that is longer than an episode, for shares of goals that are more than all,
        and for critics that value one goal at a time."""
        self.check_all_goals()
        td3.check_critic(self)
        require(
            0 < self.interval <= config.env.episode_length,
            "agent.interval",
            self.interval,
            f"must lie between 1 and the episode length, {config.env.episode_length}",
        )


@flax.struct.dataclass
class HRACHyperparameters:
    """Float hyperparameters of HRAC's high level."""

    target_noise: Annotated[float, Number("[0, inf)", Search(0.05, 0.5, "linear", always=False))] = 0.2
    """Standard deviation of TD3's target policy smoothing."""
    adjacency_weight: Annotated[float, Number("[0, inf)", Search(1.0, 100.0, "log", always=False))] = 20.0
    """Weight of the penalty for subgoals that cannot be reached within k steps."""


def adjacency_loss(distance: jax.Array, adjacent: jax.Array, weight: jax.Array) -> jax.Array:
    """Contrastive loss of the adjacency network (HRAC, Eq. 12), for distances, labels and weights of one shape."""
    error = jnp.where(adjacent, jnp.maximum(distance - ADJACENT, 0.0), jnp.maximum(APART - distance, 0.0))
    return (error * weight).sum() / jnp.maximum(weight.sum(), 1.0)


def adjacency_penalty(distance: jax.Array) -> jax.Array:
    """The penalty for a subgoal (HRAC, Eq. 14): how far it lies beyond k steps."""
    return jnp.maximum(distance - PENALTY_STARTS, 0.0)


def length(vectors: jax.Array) -> jax.Array:
    """Euclidean length over the last axis, with a gradient at 0 too."""
    return jnp.sqrt((vectors**2).sum(-1) + 1e-12)


def traits(config: HRACConfig) -> AgentTraits:
    """Its actions are target states."""
    sigmoid = config.critic == "product" and config.bounded
    return AgentTraits("target_states", all_goals=config.all_goals, sigmoid=sigmoid)


def make(config: HRACConfig, env) -> Agent:
    """HRAC's high level over the target states of this environment (`envs.target_states.SubgoalEnv`)."""
    space = env.space
    actor, critic = td3.Actor(config.hidden, space.size), td3.make_critic(config)
    adjacency = networks.MLP(config.adjacency_hidden, config.adjacency_size)
    cells = space.cells(config.cell)
    require(
        cells.count <= MOST_CELLS,
        "agent.cell",
        config.cell,
        f"makes {cells.count} cells, whose pairs do not fit into memory: give larger ones",
    )

    def embed(params, states):
        """psi_adj of the components of target states [..., S] (grip and object), each with its own network:
        [components, ..., size]."""
        seen = space.network_input(space.parts(states), config.subgoal_scale)
        return jnp.stack([adjacency.apply(own, part) for own, part in zip(params["adjacency"], seen, strict=True)])

    def init(key, features, code):
        keys = jax.random.split(key, 2 + space.components)
        seen = space.network_input(space.parts(jnp.zeros(space.size, jnp.float32)), config.subgoal_scale)
        params = td3.init_networks(keys[:2], actor, critic, features, code) | {
            "adjacency": [adjacency.init(own, part) for own, part in zip(keys[2:], seen, strict=True)]
        }
        return params, jnp.stack([pairs.initial_dissimilarity(cells.count)] * space.components)

    def act(params, features, code, action_mask, key, exploration):
        """The actor's subgoal with noise, or a random subgoal."""
        best = actor.apply(params["actor"], td3.joined(features, code))
        return td3.explore(key, best, exploration.noise, exploration.epsilon)

    def value(params, features, code, action_mask):
        """The lower of both critics' values of the actor's subgoal."""
        return td3.lower_value(actor, critic, params, features, code)

    def observe(apart, rows):
        """Remove pairs of cells visited within k steps of each other from the matrix bool [components, C, C]."""
        places = cells.of(space.parts(space.of(rows.observation)))[..., None]
        episode = rows.episode()
        return jnp.stack(
            [
                pairs.remove_similar(matrix, place, episode, config.interval)
                for matrix, place in zip(apart, places, strict=True)
            ]
        )

    def learn_adjacency(params, batch: AgentBatch, apart):
        """The adjacency loss of the first state of each transition with its last one, and with the first of another
        transition."""
        state, following = space.of(batch.observation), space.of(batch.next_observation)
        first = jnp.concatenate([state, state])
        second = jnp.concatenate([following, jnp.roll(state, 1, axis=0)])
        here, there = cells.of(space.parts(first)), cells.of(space.parts(second))
        component = jnp.arange(space.components, dtype=jnp.int32)[:, None]
        adjacent = ~apart[component, here, there]
        weight = ((here >= 0) & (there >= 0)).astype(jnp.float32)
        return adjacency_loss(length(embed(params, first) - embed(params, second)), adjacent, weight)

    def loss(params, target_params, batch: AgentBatch, apart, hyper, key):
        """TD3 over k steps (with the discounts of the batch), the adjacency loss, and the actor's penalty for subgoals
        out of reach. Under all goals the critics learn from all of them, the actor from the batch's own."""
        frozen = jax.lax.stop_gradient(params)
        learned = td3.learn(
            actor, critic, params, target_params, batch, hyper.target_noise, key, huber=True, bounded=False
        )
        asked = space.from_subgoal(batch.observation, learned.actions, config.subgoal_scale)
        distance = length(embed(frozen, space.of(batch.observation)) - embed(frozen, asked))
        penalty = adjacency_penalty(distance).mean()
        adjacency_error = learn_adjacency(params, batch, apart)
        metrics = learned.metrics | {
            "adjacency_loss": adjacency_error,
            "adjacency_penalty": penalty,
            "subgoal_size": jnp.abs(learned.actions).mean(),
        }
        return learned.critic + learned.actor + hyper.adjacency_weight * penalty + adjacency_error, metrics

    num_steps = config.interval * config.num_decisions
    return Agent(init, act, value, loss, num_steps, config.goals_at_once(), observe)
