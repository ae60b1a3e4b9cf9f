"""What a relabelling is: a function that gives sampled transitions other goals, by indices, when a batch is drawn. Nothing is stored."""

from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax


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


class Hindsight(NamedTuple):
    """A relabelling.

    relabel(key, achievements, row int32 [B], step int32 [B], goal int32 [B]) -> goal int32 [B], for transitions that start at these rows and steps.
    """

    relabel: Callable[[jax.Array, Achievements, jax.Array, jax.Array, jax.Array], jax.Array]
