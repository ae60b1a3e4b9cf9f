"""All goals at once: in place of one hindsight goal, each transition is learned from under every known goal, or under a
subset drawn for each update (docs/research/all_goals.md)."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp

from infogoal_jax.errors import require
from infogoal_jax.field_types import Count, Share
from infogoal_jax.keys import draw_chance
from infogoal_jax.relabelling import her
from infogoal_jax.relabelling.relabelling import AllGoalsSpec, Relabelling

OF_AGENT = {"head": "product", "critic": "product", "bounded": True, "layer_norm": True, "num_steps": 1}
"""What learning from all goals at once changes in the configuration of an agent."""


@dataclasses.dataclass(frozen=True)
class AllGoalsConfig:
    """Which goals an update learns from."""

    num_goals: Count = 0
    """Goals drawn for an update; 0: all that are known. For 256 transitions, 6 actions and 6,384 goals each set of
    values takes 39 MB."""
    achieved_share: Share = 0.5
    """Share of those drawn that the transitions of the batch achieve: under other goals a transition is a failure."""
    desired_share: Share = 0.0
    """Share of those drawn that were desired where the transitions of the batch were collected, so that what was missed
    enters the loss too. The rest is any known goal."""
    code: Literal["sampled", "mean"] = "sampled"
    """`sampled`: a goal's code is drawn once an update; `mean`: its mean, on which the policy then acts too."""

    def check(self, config) -> None:
        """Raise `UserError` for shares that are more than all."""
        together = self.achieved_share + self.desired_share
        require(
            together <= 1 + 1e-6,
            "relabelling.desired_share",
            self.desired_share,
            f"with relabelling.achieved_share it makes {together:g}; give shares of at most 1 together",
        )


def make(config: AllGoalsConfig) -> Relabelling:
    """The relabelling. What looks at one goal a transition, as a learner's loss and HRAC's actor do, sees the desired
    goal, or as often any known one."""

    def relabel(key, known, row, step, goal):
        known_key, choose_key = jax.random.split(key)
        anything = her.any_known(known_key, known, goal)
        return jnp.where(draw_chance(choose_key, 0.5, goal.shape), anything, goal)

    return Relabelling(
        prepare=lambda context: context.achievements.known,
        relabel=relabel,
        all_goals=AllGoalsSpec(
            num_goals=config.num_goals,
            achieved_share=config.achieved_share,
            desired_share=config.desired_share,
            mean_code=config.code == "mean",
        ),
    )
