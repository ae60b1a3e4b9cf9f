"""A network that learns which goals are similar, where nothing else tells it (`--learner.dissimilar-by classifier`, the
paper's proposal for continuous spaces)."""

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.learners.goal_encoder import weighted_mean
from infogoal_jax.learners.learner import LearnerBatch


class SimilarityClassifier(nn.Module):
    """Two inputs of goals [..., *input] to the logit [...] that the goals are similar; symmetric in both."""

    hidden: tuple[int, ...]
    size: int

    @nn.compact
    def __call__(self, first, second):
        embed = networks.GoalLayers(self.hidden, self.size)
        first, second = embed(first), embed(second)
        together = jnp.concatenate([jnp.abs(first - second), first * second], axis=-1)
        return networks.MLP(self.hidden[-1:], 1)(together)[..., 0]


def classifier_loss(classifier: SimilarityClassifier, params: dict, batch: LearnerBatch) -> jax.Array:
    """Cross entropy of telling positives from any achieved goals, each beside its anchor."""
    pairs = batch.pairs
    anchor, positive, other = (batch.inputs_of(goal) for goal in (pairs.anchor, pairs.positive, pairs.other))
    losses = jax.nn.softplus(-classifier.apply(params["classifier"], anchor, positive))
    losses += jax.nn.softplus(classifier.apply(params["classifier"], anchor, other))
    return weighted_mean(losses, pairs.positive_weight)


def similar_by(classifier: SimilarityClassifier | None) -> Callable[[dict, jax.Array, jax.Array], jax.Array] | None:
    """`Learner.similar`: more often achieved within the window than by chance; None without a classifier."""
    if classifier is None:
        return None
    return lambda params, first, second: classifier.apply(params["classifier"], first, second) > 0
