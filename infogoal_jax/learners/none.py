"""No goal-representation learning: a plain encoder trained by the agent's loss alone (the paper's bare DQN, HRAC and
CQL)."""

import dataclasses

from infogoal_jax import networks
from infogoal_jax.field_types import Count
from infogoal_jax.learners.goal_encoder import GoalEncoderConfig
from infogoal_jax.learners.learner import GoalCode, Learner, no_loss


@dataclasses.dataclass(frozen=True)
class NoneConfig(GoalEncoderConfig):
    """Sizes of the plain goal encoder."""

    latent_size: Count = 32
    """Size d of the goal code [A]; 0: a goal that is a vector is its own code."""


def make(config: NoneConfig) -> Learner:
    """The learner without a loss of its own."""
    layers = networks.GoalLayers(config.hidden, config.latent_size, config.standardise_images)
    encoder = layers if config.latent_size else networks.AsItIs()

    def encode(params, goal_inputs):
        return GoalCode(encoder.apply(params, goal_inputs))

    return Learner(
        init=lambda key, example, hyper: (encoder.init(key, example.goal_inputs[:1]), ()), encode=encode, loss=no_loss
    )
