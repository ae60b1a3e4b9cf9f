"""The contract of an explorer: it learns a representation of states beside the agent's, and pays a bonus for moves
whose outcome it does not know. And no explorer: the agent's loss alone trains the state encoder, and there is no bonus.

Shapes: B single steps, K observations, A actions, F features of a state.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax

from infogoal_jax.replay import Trajectories


@flax.struct.dataclass
class Moves:
    """B single steps."""

    features: jax.Array
    """float32 [B, F] of the state, by the state encoder that is trained."""
    action: jax.Array
    """int32 [B]."""
    next_features: jax.Array
    """float32 [B, F] of the next state, by the target encoder (the momentum encoder)."""


class Explorer(NamedTuple):
    """An explorer of K observations with A actions."""

    init: Callable[[jax.Array, jax.Array, int], tuple[Any, Any]]
    """(key, features [F], num_actions) -> (params, state). The gradient trains the parameters; the state is everything
    else."""
    compute_bonus: Callable[[Any, Any, jax.Array, Trajectories, jax.Array, jax.Array], tuple[jax.Array, Any]]
    """(params, state, features [K, F], rows: Trajectories, written bool [R], discount) -> (bonus float32 [K, A],
    state). Called once an epoch on the replay buffer, of which the rows `written` hold something. The bonus is looked
    up when a step is sampled, and not stored."""
    loss: Callable[[Any, Any, Moves, jax.Array], tuple[jax.Array, dict[str, jax.Array], Any]]
    """(params, state, moves: Moves, key) -> (loss, metrics, state)."""


@dataclasses.dataclass(frozen=True)
class NoneConfig:
    """No explorer, no settings."""


def make_none(config: NoneConfig) -> None:
    """No explorer: the program leaves it out."""
