"""What an explorer is: a representation of states learned beside the agent's, and a bonus for moves that it does not know yet. Pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax

from infogoal_jax.replay import Trajectories


@flax.struct.dataclass
class Moves:
    """B single steps. features float32 [B, F] by the state encoder that is trained, action int32 [B], next_features [B, F] by the target encoder,
    which follows slowly (the momentum encoder)."""

    features: jax.Array
    action: jax.Array
    next_features: jax.Array


class Explorer(NamedTuple):
    """An explorer of a finite set of K observations with A actions.

    init(key, features [F], num_actions) -> (params, state): parameters are trained by gradient, state is everything else.
    compute_bonus(params, state, features [K, F], rows: Trajectories, written bool [R], discount) -> (bonus float32 [K, A], state): once an epoch,
    from what was collected. It is not stored with a move but looked up when the move is sampled.
    loss(params, state, moves: Moves, key) -> (loss, metrics, state).
    """

    init: Callable[[jax.Array, jax.Array, int], tuple[Any, Any]]
    compute_bonus: Callable[[Any, Any, jax.Array, Trajectories, jax.Array, jax.Array], tuple[jax.Array, Any]]
    loss: Callable[[Any, Any, Moves, jax.Array], tuple[jax.Array, dict[str, jax.Array], Any]]
