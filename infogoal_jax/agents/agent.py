"""What an agent is: a record of pure functions over codes of states and goals. No agent knows which learner made the goal code."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax

from infogoal_jax.replay import Trajectories


@flax.struct.dataclass
class AgentBatch:
    """B transitions as codes; the agent's gradient flows back through `features` and `code` into the encoders.

    observation, next_observation: [B, ...] as stored.
    features [B, F] and code [B, d] of the state and the desired goal, by the encoders that are trained; action: int32 [B], or float32 [B, A].
    next_features, next_code: after the last step, by the encoders that are trained, without gradient.
    target_features, target_code: after the last step, by the target encoders; action_mask, next_action_mask: bool [B, A], what can be done.
    reward: float32 [B], discounted sum over the steps; discount: float32 [B] of what follows them, 0 after termination.
    """

    observation: jax.Array
    next_observation: jax.Array
    features: jax.Array
    code: jax.Array
    action: jax.Array
    next_features: jax.Array
    next_code: jax.Array
    target_features: jax.Array
    target_code: jax.Array
    reward: jax.Array
    discount: jax.Array
    action_mask: jax.Array
    next_action_mask: jax.Array


class Exploration(NamedTuple):
    """How actions are varied: share of random ones, in [0, 1], and standard deviation of the noise on the others, where actions are continuous."""

    epsilon: jax.Array | float
    noise: jax.Array | float


class Agent(NamedTuple):
    """A reinforcement-learning agent.

    init(key, features [F], code [d]) -> (params, state): parameters are trained by gradient, state is everything else.
    value(params, features [B, F], code [B, d], action_mask bool [B, A]) -> float32 [B]: of acting greedily from there.
    act(params, features [B, F], code [B, d], action_mask bool [B, A], key, exploration) -> action int32 [B] or float32 [B, A].
    loss(params, target_params, batch: AgentBatch, state, hyper, key) -> (loss, metrics).
    observe(state, rows: Trajectories) -> state: with the rows that were collected.
    num_steps: environment steps that a sampled transition spans at most.
    """

    init: Callable[[jax.Array, jax.Array, jax.Array], tuple[Any, Any]]
    act: Callable[..., jax.Array]
    value: Callable[..., jax.Array]
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]]
    observe: Callable[[Any, Trajectories], Any]
    num_steps: int
