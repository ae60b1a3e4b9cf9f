"""No goal-representation learning: a plain encoder trained by the agent's loss alone (the paper's bare DQN, HRAC and
CQL)."""

import dataclasses

from infogoal_jax import networks
from infogoal_jax.learners.goal_encoder import GoalEncoderConfig
from infogoal_jax.learners.learner import GoalCode, Learner, no_loss


@dataclasses.dataclass(frozen=True)
class NoneConfig(GoalEncoderConfig):
    """Sizes of the plain goal encoder."""


def make(config: GoalEncoderConfig) -> Learner:
    """The learner without a loss of its own."""
    encoder = networks.GoalLayers(config.hidden, config.latent_size, config.standardise_images)

    def encode(params, goal_inputs):
        return GoalCode(encoder.apply(params, goal_inputs))

    return Learner(
        init=lambda key, example, hyper: (encoder.init(key, example.goal_inputs[:1]), ()), encode=encode, loss=no_loss
    )
