"""What a relabelling is: functions that give sampled transitions other goals, by indices, when a batch is drawn. Nothing is stored."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax

from infogoal_jax.replay import Trajectories


@flax.struct.dataclass
class Achievements:
    """What was achieved in the rows of a replay buffer; fixed while an epoch's updates run.

    goals: int32 [R, T + 1, K] achieved at each step and known, padded with -1; count: int32 [R * (T + 1)], running count of the steps at which there
    are some; steps_left: int32 [R, T] of `replay.steps_left`; known: bool [N], goals that may be drawn at random.
    """

    goals: jax.Array
    count: jax.Array
    steps_left: jax.Array
    known: jax.Array


class Context(NamedTuple):
    """What a relabelling may look at, once an epoch.

    rows: all that updates may be drawn from; written: bool [R], which of them hold something; positions() -> float32 [N, D]: where goals lie, in the
    world's units where the task knows them, else in the space of goal codes; value(observation [B, ...], goal int32 [B]) -> float32 [B]: of the
    agent's policy, by the epoch's first parameters; reached(record [...], goal int32 [...]) -> bool [...]: the environment's own judgement;
    discount: of a step; updates: int32, how many were made before this epoch.
    """

    rows: Trajectories
    written: jax.Array
    achievements: Achievements
    positions: Callable[[], jax.Array]
    value: Callable[[Any, jax.Array], jax.Array]
    reached: Callable[[Any, jax.Array], jax.Array]
    discount: jax.Array
    updates: jax.Array


class Relabelling(NamedTuple):
    """A relabelling.

    prepare(context: Context) -> table: what the epoch's draws need, a pytree.
    relabel(key, table, row int32 [B], step int32 [B], goal int32 [B]) -> goal int32 [B], for transitions that start at these rows and steps.
    choose(key, table, row, step, goal) -> int32 [B / candidates]: which of the relabelled transitions are learned from; None: all.
    candidates: transitions that are drawn for each that is learned from.
    """

    prepare: Callable[[Context], Any]
    relabel: Callable[[jax.Array, Any, jax.Array, jax.Array, jax.Array], jax.Array]
    choose: Callable[[jax.Array, Any, jax.Array, jax.Array, jax.Array], jax.Array] | None = None
    candidates: int = 1
