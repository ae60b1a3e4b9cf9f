"""InfoGoal (paper, Sec. IV): a goal code that tells similar goals from dissimilar ones and forgets the rest.

Similar goals were achieved within a window of one trajectory. A contrastive bound on mutual information (Theorem 3)
pulls their codes together and pushes those of dissimilar goals away. The KL to N(0, I), weighted by beta, compresses
the codes. beta grows as long as the code tells similar from dissimilar goals (Eq. 15).
"""

import dataclasses
from typing import Annotated, Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.errors import require
from infogoal_jax.field_types import Positive, Size
from infogoal_jax.goals import is_goal, same, with_placeholders
from infogoal_jax.hyperparameters import Number, Search
from infogoal_jax.learners import goal_encoder
from infogoal_jax.learners.encoding import encode_each
from infogoal_jax.learners.goal_encoder import (
    GoalEncoderConfig,
    check_window,
    contrastive_bound,
    kl_to_standard_normal,
    weighted_mean,
)
from infogoal_jax.learners.learner import DissimilarBy, Encode, GoalCode, Learner, LearnerBatch, SampleSpec, Visited
from infogoal_jax.learners.similarity import SimilarityClassifier, classifier_loss, similar_by

SIGN_STEP = 1e-5  # The authors' step, for the sign rule and for the ramp of a fixed beta.
SCALE_RATE = 0.01  # Rate of the running mean that normalises the intrinsic reward.


@dataclasses.dataclass(frozen=True)
class InfoGoalConfig(GoalEncoderConfig):
    """Switches and sizes of InfoGoal. The scale of beta holds for codes of 32 numbers only."""

    window: int = 4
    """Steps within which two achieved goals count as similar [M]. The authors' 10 spans two rooms of a small house."""
    num_pairs: Size = 256
    """Positive pairs in an update."""
    num_negatives: Size = 1
    """Negatives for each positive pair [A]. More of them shift the scale of beta."""
    loss: Literal["nce", "ratio"] = "nce"
    """`nce`: Eq. 13 with the positive in the denominator; `ratio`: the authors' bounded exp(D+ - D-), with the KL in
    bits."""
    score: Literal["distance", "bilinear"] = "distance"
    """`distance`: f = exp(-mean absolute difference) [A]; `bilinear`: a learned f, the jointly optimised score of the
    paper."""
    dissimilar_by: DissimilarBy = "trajectory"
    """What tells that two goals of a continuous space are dissimilar. `trajectory`: they were not achieved within the
    window in one trajectory, and neither achieves the other; `cells`: no trajectory has been in their cells of a grid
    within the window; `classifier`: a network that learns it, as the paper proposes."""
    positives: Literal["trajectory", "distance", "listed"] = "trajectory"
    """Which goals of a finite set are similar. `trajectory`: achieved within the window (Algorithm 1); `distance`:
    known goals whose true positions lie at most `radius` apart; `listed`: likewise of all training, validation and test
    goals, achieved or not, and of no others [A]. The last two need a task that says where its goals lie."""
    radius: Positive = 0.15
    """Of similar goals with another `positives` than `trajectory`, in the unit of `env.goal_positions`. 0.15 m are
    three steps of a Fetch gripper; the authors' is the length of a step times the window."""
    negatives: Literal["anchored", "independent"] = "anchored"
    """`anchored`: compare a negative with the anchor of the pair (Algorithm 1); `independent`: with another goal, drawn
    for it [A]."""
    beta_rule: Literal["linear", "sign", "fixed", "relative"] = "linear"
    """`linear`: Eq. 15; `sign`: the authors' constant step; `fixed`: ramps to `--hyper.learner.fixed-beta` (ablation of
    Fig. 15); `relative`: Eq. 15 with a threshold that follows the accuracy of the mean codes (not in the paper)."""

    def check(self, config) -> None:
        """Raise `UserError` for what does not go together."""
        check_window(self, config)
        require(
            self.loss == "nce" or self.score == "distance",
            "learner.loss",
            self.loss,
            "the ratio form needs the bounded score: --learner.score distance",
        )


@flax.struct.dataclass
class InfoGoalHyperparameters:
    """Float hyperparameters of InfoGoal: how the Lagrange multiplier beta is set."""

    beta_start: Annotated[float, Number("[0, 1]")] = 0.0
    """First value of beta; with `--learner.beta-rule fixed` it is 0."""
    beta_step: Annotated[float, Number("[0, inf)", Search(1e-5, 1e-2, "log", always=False))] = 2.5e-4
    """rho of Eq. 15, for the rules linear and relative; 0 keeps beta constant. The other rules step by 1e-5."""
    beta_threshold: Annotated[float, Number("(0, 1)", Search(0.8, 0.999, "log of 1 - x", always=False))] = 0.96
    """alpha of Eq. 15: the accuracy above which beta grows [A]."""
    beta_margin: Annotated[float, Number("(0, 1)", Search(1e-3, 0.1, "log", always=False))] = 0.005
    """With `--learner.beta-rule relative`: the accuracy that the noise of the codes may cost, in place of alpha."""
    beta_floor: Annotated[float, Number("[0, 1]")] = 0.0
    """Least value of beta; 0: none, as in the paper. Where the accuracy never reaches alpha, beta falls to it."""
    fixed_beta: Annotated[float, Number("[0, 1]")] = 0.01
    """Final value of beta with `--learner.beta-rule fixed`; it grows by 1e-5 an update [A]."""


@flax.struct.dataclass
class InfoGoalState:
    """What is not trained by the gradient."""

    beta: jax.Array
    """float32 [], the Lagrange multiplier."""
    scale: jax.Array
    """float32 [], running mean of the distance between codes, which normalises the intrinsic reward."""


def log_score(params: dict, first: jax.Array, second: jax.Array) -> jax.Array:
    """log f(z, z') [...] of codes [..., d]: minus the mean absolute difference, or the learned bilinear form z W z' /
    sqrt(d)."""
    if "score" in params:
        return jnp.einsum("...i,ij,...j->...", first, params["score"], second) / jnp.sqrt(first.shape[-1])
    return goal_encoder.log_score(first, second)


def next_beta(config: InfoGoalConfig, beta: jax.Array, accuracy: jax.Array, threshold, hyper) -> jax.Array:
    """beta after an update (Eq. 15), clipped to [beta_floor, 1]: a negative beta would reward a growing KL.

    threshold: alpha, or with the relative rule what the mean codes get right less `beta_margin`. How well goals can be
    told apart differs from task to task: a threshold that one task never reaches costs another half of its code.
    """
    surplus = accuracy - threshold
    if config.beta_rule in ("linear", "relative"):
        beta = beta + hyper.beta_step * surplus
    elif config.beta_rule == "sign":
        beta = beta + SIGN_STEP * jnp.sign(surplus)
    else:
        beta = jnp.minimum(beta + SIGN_STEP, hyper.fixed_beta)
    return jnp.clip(beta, hyper.beta_floor, 1.0)


def make(config: InfoGoalConfig) -> Learner:
    encoder = networks.GaussianEncoder(config.hidden, config.latent_size, config.standardise_images)
    classifier = None
    if config.dissimilar_by == "classifier":
        classifier = SimilarityClassifier(config.hidden, config.latent_size)

    def init(key, example, hyper):
        params = {"encoder": encoder.init(key, example.goal_inputs[:1])}
        if config.score == "bilinear":
            params["score"] = jnp.eye(config.latent_size, dtype=jnp.float32)
        if classifier is not None:
            params["classifier"] = classifier.init(jax.random.fold_in(key, 1), *[example.goal_inputs[:1]] * 2)
        start = 0.0 if config.beta_rule == "fixed" else hyper.beta_start
        return params, InfoGoalState(beta=jnp.asarray(start, jnp.float32), scale=jnp.ones((), jnp.float32))

    def encode(params, goal_inputs):
        return GoalCode(*encoder.apply(params["encoder"], goal_inputs))

    def loss(params, state, batch: LearnerBatch, hyper, key):
        """Information bottleneck loss, Eq. 13: minus the contrastive bound, plus beta times the mean KL of all codes in
        it."""
        pairs = batch.pairs
        independent = (pairs.contrast,) if config.negatives == "independent" else ()
        codes = encode_each(batch.encode, pairs.anchor, pairs.positive, pairs.negative, *independent)
        anchor_key, positive_key, contrast_key, negative_key = jax.random.split(key, 4)
        anchor, positive, negative = (
            code.sample(k) for code, k in zip(codes[:3], (anchor_key, positive_key, negative_key), strict=True)
        )
        contrast = codes[3].sample(contrast_key) if independent else jnp.broadcast_to(anchor[:, None], negative.shape)
        log_positive, log_negative = log_score(params, anchor, positive), log_score(params, contrast, negative)
        weights = pairs.positive_weight[:, None] * pairs.negative_weight
        any_negative = pairs.positive_weight * (pairs.negative_weight.sum(1) > 0).astype(jnp.float32)
        took_part = list(zip(codes, (pairs.positive_weight, pairs.positive_weight, weights, weights), strict=False))
        kl = sum(weighted_mean(kl_to_standard_normal(code), weight) for code, weight in took_part) / len(took_part)
        if config.loss == "nce":
            infomax = -weighted_mean(
                contrastive_bound(log_positive, jnp.where(weights > 0, log_negative, -jnp.inf)), any_negative
            )
            infomin = kl
        else:
            infomax = weighted_mean(jnp.exp(log_negative - log_positive[:, None]), weights)
            infomin = kl / jnp.log(2.0)
        # Eq. 14, on the noisy codes; ties count as wrong.
        accuracy = weighted_mean(log_positive[:, None] > log_negative, weights)
        metrics = {
            "accuracy": accuracy,
            "beta": state.beta,
            "kl": kl,
            "infomax": infomax,
            "self_pairs": weighted_mean(same(pairs.anchor, pairs.positive), pairs.positive_weight),
            "no_negative": 1.0 - weighted_mean(pairs.negative_weight.max(1), pairs.positive_weight),
        }
        threshold = hyper.beta_threshold
        if config.beta_rule == "relative":
            anchor, positive, negative = (code.mean for code in codes[:3])
            contrast = codes[3].mean if independent else anchor[:, None]
            right = log_score(params, anchor, positive)[:, None] > log_score(params, contrast, negative)
            metrics["mean_code_accuracy"] = weighted_mean(right, weights)
            threshold = metrics["mean_code_accuracy"] - hyper.beta_margin
        beta = next_beta(config, state.beta, accuracy, threshold, hyper)
        if config.beta_rule != "fixed":
            beta = jnp.where(weights.sum() > 0, beta, state.beta)  # Without a pair there is no accuracy.
        state = state.replace(beta=beta)
        total = infomax + jax.lax.stop_gradient(metrics["beta"]) * infomin
        if classifier is not None:
            metrics["classifier_loss"] = classifier_loss(classifier, params, batch)
            total += metrics["classifier_loss"]
        return total, metrics, state

    def intrinsic_reward(state, encode: Encode, visited: Visited):
        """Eq. 16 with a minus sign: minus the distance from the mean code of the desired goal to that of the nearest
        achieved goal, divided by its running mean. A step that achieves nothing gets the largest distance of the
        batch."""
        achieved, mask = visited.achieved, visited.mask
        target = encode(visited.desired_goal).mean[:, None, None]
        distance = jnp.linalg.norm(encode(with_placeholders(achieved)).mean - target, axis=-1)
        nearest = jnp.where(is_goal(achieved), distance, jnp.inf).min(-1)
        found = jnp.isfinite(nearest)
        farthest = jnp.where(found & (mask > 0), nearest, 0.0).max()
        distance = jax.lax.stop_gradient(jnp.where(found, nearest, farthest))
        moved = state.scale + SCALE_RATE * (weighted_mean(distance, mask) - state.scale)
        scale = jnp.where((found & (mask > 0)).any(), moved, state.scale)
        return -distance / jnp.maximum(scale, 1e-6), state.replace(scale=scale)

    sample_spec = SampleSpec(
        config.num_pairs,
        config.window,
        config.num_negatives,
        anchored=config.negatives == "anchored",
        dissimilar_by=config.dissimilar_by,
        radius=None if config.positives == "trajectory" else config.radius,
        listed=config.positives == "listed",
    )
    return Learner(init, encode, loss, sample_spec, intrinsic_reward, similar=similar_by(classifier))
