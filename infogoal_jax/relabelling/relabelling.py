"""The contract of a relabelling: functions that give sampled transitions other desired goals when a batch is drawn.
Nothing is stored. And no relabelling: a transition keeps its desired goal.

Shapes: R rows of T transitions, B transitions, N goals of a finite set, K goals achieved at one step, D coordinates.
Arrays of goals are [..., *shape], see goals.py.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax

from infogoal_jax.errors import require
from infogoal_jax.pairs import AchievedGoals, KnownGoals
from infogoal_jax.replay import Trajectories


def check_room(field: str, share: float, other: str, taken: float) -> None:
    """Raise `UserError` for a share of the transitions that, together with another one, is more than all."""
    require(
        share + taken <= 1, f"relabelling.{field}", share, f"must leave room for {other} = {taken}: together at most 1"
    )


@flax.struct.dataclass
class Achievements:
    """What the rows of a replay buffer achieved. Fixed during the updates of an epoch."""

    goals: jax.Array
    """[R, T + 1, K, *shape], known goals achieved at each step, padded with "no goal"."""
    count: jax.Array
    """int32 [R * (T + 1)], running count of the steps that achieve a goal."""
    steps_left: jax.Array
    """int32 [R, T] of `replay.steps_left`."""
    known: KnownGoals | AchievedGoals
    """Goals that may be drawn at random."""


class Context(NamedTuple):
    """What a relabelling sees, once an epoch."""

    rows: Trajectories
    """The replay buffer, or the recorded trajectories."""
    written: jax.Array
    """bool [R], rows that hold something."""
    achievements: Achievements
    """What the rows achieved."""
    goal_positions: jax.Array | None
    """float32 [N, D], where the goals of a finite set lie, in the environment's units; None: unknown."""
    goal_codes: Callable[[], jax.Array]
    """() -> float32 [N, d], mean codes of the goals of a finite set with the epoch's first parameters."""
    value: Callable[[Any, jax.Array], jax.Array]
    """(observation [B, ...], desired_goal [B, *shape]) -> float32 [B], value of the agent's policy with the epoch's
    first parameters."""
    reached: Callable[[Any, jax.Array], jax.Array]
    """(record [...], goal [..., *shape]) -> bool [...], as the environment decides."""
    discount: jax.Array
    """float32 [], discount of one step."""
    updates: jax.Array
    """int32 [], updates before this epoch."""


@flax.struct.dataclass
class Waypoints:
    """Which states episodes reach some steps after transitions."""

    low_goal: jax.Array
    """[B, *shape], achieved so many steps later, or at the end of the episode; "no goal" where no known one is."""
    step: jax.Array
    """int32 [B], the step so many later, but not after the one that achieves the actor's goal."""
    goal: jax.Array
    """[B, *shape], achieved there; "no goal" where no known one is."""


class Relabelling(NamedTuple):
    """A relabelling: pure functions over the table of an epoch."""

    prepare: Callable[[Context], Any]
    """(context: Context) -> table: what the draws of an epoch need, a pytree."""
    relabel: Callable[[jax.Array, Any, jax.Array, jax.Array, jax.Array], jax.Array]
    """(key, table, row int32 [B], step int32 [B], desired_goal [B, *shape]) -> desired_goal [B, *shape], for
    transitions that start at these rows and steps."""
    choose: Callable[[jax.Array, Any, jax.Array, jax.Array, jax.Array], jax.Array] | None = None
    """(key, table, row, step, desired_goal) -> int32 [B / candidates]: which of the relabelled transitions to learn
    from; None: all."""
    candidates: int = 1
    """Transitions drawn for each that is learned from."""
    skip_reached: bool = False
    """Whether transitions keep their goals where the other one is reached before them."""
    costs: Callable[[jax.Array, Any, jax.Array, jax.Array, jax.Array], tuple[jax.Array, Waypoints | None]] | None = None
    """As `relabel`: the goals that the actor learns for, and states on the way to them or None. With it, rewards are
    -1 for each step from a state that does not achieve the goal, after which nothing follows, in place of 1 for the
    step that reaches it. Of returns of one step."""


@dataclasses.dataclass(frozen=True)
class NoneConfig:
    """No relabelling, no settings."""


def make_none(config: NoneConfig) -> None:
    """No relabelling: the program leaves it out."""
