"""All goals at once: in place of one goal, an agent learns each transition under every known goal, or under a subset
drawn for each update (docs/reference/all_goals.md)."""

import dataclasses
from typing import Literal

from infogoal_jax.errors import require
from infogoal_jax.field_types import Count, Share

CHANGES = {
    "all_goals": True,
    "head": "product",
    "critic": "product",
    "bounded": True,
    "layer_norm": True,
    "num_steps": 1,
}
"""What learning from all goals at once changes in the configuration of an agent that has such fields."""
RELABELLING = "random"
"""The relabelling where no other is asked for: what the learner, or an actor, learns of one goal a transition."""


@dataclasses.dataclass(frozen=True)
class OfAllGoals:
    """A configuration of an agent that can learn from all goals at once: whether it does, and from which goals."""

    all_goals: bool = False
    """Learn each transition under all goals at once (docs/reference/all_goals.md)."""
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

    def check_all_goals(self) -> None:
        """Raise `UserError` for shares that are more than all."""
        together = self.achieved_share + self.desired_share
        require(
            together <= 1 + 1e-6,
            "agent.desired_share",
            self.desired_share,
            f"with agent.achieved_share it makes {together:g}; give shares of at most 1 together",
        )

    def goals_at_once(self) -> "OfAllGoals | None":
        """Which goals the agent learns from at once; None: it learns from one."""
        return self if self.all_goals else None
