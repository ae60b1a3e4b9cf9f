"""No goal-representation learning: a plain encoder trained by the agent's loss alone (the paper's bare DQN, HRAC and CQL)."""

import dataclasses

from infogoal_jax import networks
from infogoal_jax.errors import require
from infogoal_jax.learners.learner import GoalCode, Learner, no_loss


@dataclasses.dataclass(frozen=True)
class NoneConfig:
    """Sizes of the plain goal encoder; the same as InfoGoal's, so that the two differ in the loss alone."""

    latent_size: int = 32
    """Size of the goal code."""
    hidden: tuple[int, ...] = (128, 128, 128)
    """Widths of the goal encoder's layers."""
    standardise_images: bool = False
    """Give every goal image the same mean and contrast before it is encoded: makes codes sturdier against corruption (docs/hrac.md)."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        require(self.latent_size > 0, "learner.latent_size", self.latent_size, "give a whole number greater than 0")
        require(all(width > 0 for width in self.hidden), "learner.hidden", self.hidden, "give widths greater than 0, for example 128 128 128")


def make(config: NoneConfig) -> Learner:
    """The learner that learns nothing by itself."""
    encoder = networks.GoalLayers(config.hidden, config.latent_size, config.standardise_images)

    def encode(params, goal_inputs):
        return GoalCode(encoder.apply(params, goal_inputs))

    return Learner(init=lambda key, example, hyper: (encoder.init(key, example.goal_inputs[:1]), ()), encode=encode, loss=no_loss)
