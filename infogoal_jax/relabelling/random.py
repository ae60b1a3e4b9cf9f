"""Any known goal in place of the desired one, in half of the transitions: what looks at one goal a transition, where an
agent learns from all goals at once (`agents/all_goals.py`)."""

import dataclasses

import jax

from infogoal_jax.goals import axes_of, select
from infogoal_jax.keys import draw_chance
from infogoal_jax.relabelling import her
from infogoal_jax.relabelling.relabelling import Relabelling


@dataclasses.dataclass(frozen=True)
class RandomConfig:
    """No settings."""


def make(config: RandomConfig) -> Relabelling:
    """The relabelling."""

    def relabel(key, known, row, step, desired_goal):
        known_key, choose_key = jax.random.split(key)
        anything = her.any_known(known_key, known, desired_goal)
        return select(draw_chance(choose_key, 0.5, axes_of(desired_goal)), anything, desired_goal)

    return Relabelling(prepare=lambda context: context.achievements.known, relabel=relabel)
