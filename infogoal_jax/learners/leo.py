"""LEO (Matthews et al. 2026): no goal encoder at all, the code of a goal is its number. What the goal looks like is
never seen, so a goal that training did not achieve, or a corrupted picture of one, means nothing."""

import dataclasses

import jax.numpy as jnp

from infogoal_jax.learners.learner import GoalCode, Learner, no_loss


@dataclasses.dataclass(frozen=True)
class LEOConfig:
    """No settings."""


def make(config: LEOConfig) -> Learner:
    """The learner of goals that are shown as their numbers, int32 [..., 1] (`GoalSet.by_index`)."""
    return Learner(
        init=lambda key, example, hyper: ({}, ()),
        encode=lambda params, goal_inputs: GoalCode(goal_inputs.astype(jnp.float32)),
        loss=no_loss,
        by_index=True,
    )
