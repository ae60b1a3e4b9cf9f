"""COGOAL (Zou & Suzuki, ICONIP 2021): a deterministic goal code in which goals that are achieved close together in time
lie close together.

The loss pulls together codes of goals achieved within a window of one trajectory, and pushes away codes of random
goals. It is InfoGoal's contrastive bound without noise, without compression and without a dissimilarity matrix
(docs/reference/infogoal.md explains the bound). It follows the description in the later paper, because the full text
was not available.
"""

import dataclasses

import jax.numpy as jnp

from infogoal_jax.field_types import Size, Weight
from infogoal_jax.goals import same
from infogoal_jax.learners import none
from infogoal_jax.learners.encoding import encode_each
from infogoal_jax.learners.goal_encoder import (
    GoalEncoderConfig,
    check_window,
    contrastive_bound,
    log_score,
    weighted_mean,
)
from infogoal_jax.learners.learner import Learner, LearnerBatch, SampleSpec


@dataclasses.dataclass(frozen=True)
class CoGoalConfig(GoalEncoderConfig):
    """Sizes of the plain goal encoder and of the contrastive loss."""

    window: int = 4
    """Steps within which two achieved goals count as similar, as InfoGoal's."""
    num_pairs: Size = 256
    """Positive pairs in an update, as InfoGoal's."""
    num_negatives: Size = 1
    """Negatives for each positive pair, drawn at random among the known goals."""
    norm_penalty: Weight = 1e-5
    """Weight of the mean squared norm of the codes. Without noise nothing else bounds the distances. 0 turns it off."""

    def check(self, config) -> None:
        """Raise `UserError` for a window that is longer than an episode."""
        check_window(self, config)


def make(config: CoGoalConfig) -> Learner:
    def loss(params, state, batch: LearnerBatch, hyper, key):
        """Minus the contrastive bound (Eq. 13 of InfoGoal with std = 0 and beta = 0), plus the penalty on the codes'
        norms."""
        pairs = batch.pairs
        anchor, positive, negative = (
            code.mean for code in encode_each(batch.encode, pairs.anchor, pairs.positive, pairs.negative)
        )
        log_positive, log_negative = log_score(anchor, positive), log_score(anchor[:, None], negative)
        weights = pairs.positive_weight[:, None] * pairs.negative_weight
        bound = contrastive_bound(log_positive, jnp.where(weights > 0, log_negative, -jnp.inf))
        contrastive = -weighted_mean(bound, weights.max(1))
        took_part = ((anchor, pairs.positive_weight), (positive, pairs.positive_weight), (negative, weights))
        squared_norm = sum(weighted_mean((code**2).sum(-1), weight) for code, weight in took_part) / len(took_part)
        metrics = {
            "contrastive": contrastive,
            # As InfoGoal's Eq. 14: ties count as wrong.
            "accuracy": weighted_mean(log_positive[:, None] > log_negative, weights),
            "code_norm": jnp.sqrt(squared_norm),
            # Always correct: codes have no noise.
            "self_pairs": weighted_mean(same(pairs.anchor, pairs.positive), pairs.positive_weight),
        }
        return contrastive + config.norm_penalty * squared_norm, metrics, state

    sample_spec = SampleSpec(config.num_pairs, config.window, config.num_negatives, dissimilar=False)
    return none.make(config)._replace(loss=loss, sample_spec=sample_spec)
