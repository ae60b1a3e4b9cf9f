"""Discrete goal codes (DGRL: Islam et al. 2022, "Discrete Factorial Representations as an Abstraction for Goal
Conditioned RL").

A code that reconstructs the goal is cut into segments, and each segment is replaced by the nearest vector of one
codebook (van den Oord et al. 2017). Goals therefore share parts. The gradient passes the replacement unchanged
(straight-through).
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.errors import require
from infogoal_jax.field_types import Positive, Size, Weight
from infogoal_jax.learners import vae
from infogoal_jax.learners.goal_encoder import GoalEncoderConfig
from infogoal_jax.learners.learner import GoalCode, Learner, LearnerBatch, SampleSpec
from infogoal_jax.rows import take_rows
from infogoal_jax.shapes import with_rank

USAGE_RATE = 0.01  # Rate of the running share of segments that use each code vector.
PATIENCE = 100  # Updates after which an unused code vector is revived.
INITIAL_GOALS = 256  # Goals whose segments initialise the codebook: a large set of images cannot be encoded at once.
INITIAL_NOISE = (
    0.01  # Noise on the first code vectors, in standard deviations of the segments, so that no two are equal.
)


@dataclasses.dataclass(frozen=True)
class DGRLConfig(GoalEncoderConfig):
    """Sizes of encoder, decoder and codebook."""

    num_goals: Size = 64
    """Known goals, desired or achieved, that an update reconstructs."""
    factors: Size = 8
    """Segments of a code."""
    codes: Size = 64
    """Vectors in the codebook that all segments share."""
    commitment: Weight = 0.25
    """Weight of the commitment loss, which pulls a segment to its code vector (van den Oord et al.)."""
    revival: Weight = 1.0
    """Weight of the loss that pulls unused code vectors back to the segments; 0: they stay unused."""
    vector_std: Positive = 0.05
    """Standard deviation of the decoder for goals that are vectors, as in the VAE. It sets the weight of their
    reconstruction."""

    def check(self, config) -> None:
        """Raise `UserError` for a code that cannot be cut into its factors."""
        require(
            self.latent_size % self.factors == 0,
            "learner.factors",
            self.factors,
            f"must divide learner.latent_size, {self.latent_size}",
        )


@flax.struct.dataclass
class DGRLState:
    """What is not trained by the gradient."""

    usage: jax.Array
    """float32 [codes], running share of the segments that use each code vector."""
    idle: jax.Array
    """int32 [codes], updates since the code vector was last used."""
    home: jax.Array
    """float32 [codes, d / factors], where a code vector is revived: in standard deviations of the segments, from their
    mean."""


def squared_distance(first: jax.Array, second: jax.Array) -> jax.Array:
    """Squared distances [..., N, M] of vectors [..., N, D] to vectors [M, D]."""
    apart = first[..., :, None, :]
    return ((apart - with_rank(second, apart.ndim)) ** 2).sum(-1)


def nearest(segments: jax.Array, codebook: jax.Array) -> jax.Array:
    """Index int32 [...] of the code vector [codes, D] nearest to each segment [..., D]."""
    return squared_distance(segments, codebook).argmin(-1)


def straight_through(segments: jax.Array, vectors: jax.Array) -> jax.Array:
    """The code vectors, with the gradient of the segments that they replace. No gradient reaches the codebook."""
    return jax.lax.stop_gradient(vectors) + (segments - jax.lax.stop_gradient(segments))


def distances_to_codes(segments: jax.Array, vectors: jax.Array) -> tuple[jax.Array, jax.Array]:
    """|sg[y] - e|^2 and |y - sg[e]|^2, means over segments [..., D] (van den Oord et al., Eq. 3): for the codebook, and
    for segments."""
    codebook_loss = ((jax.lax.stop_gradient(segments) - vectors) ** 2).sum(-1).mean()
    commitment_loss = ((segments - jax.lax.stop_gradient(vectors)) ** 2).sum(-1).mean()
    return codebook_loss, commitment_loss


def revival_loss(codebook: jax.Array, segments: jax.Array, indices: jax.Array, state: DGRLState) -> jax.Array:
    """Pull each code vector that was unused for `PATIENCE` updates to a segment. No other code vector and no segment
    gets a gradient.

    The segment, of [N, D], lies near the code vector's home; segments far from their own code vector are preferred.
    Homes are spread like the segments and fixed, so that revived vectors neither meet in one place nor follow the draws
    of a batch.
    """
    segments = jax.lax.stop_gradient(segments)
    error = ((segments - jax.lax.stop_gradient(codebook)[indices]) ** 2).sum(-1)
    home = segments.mean(0, keepdims=True) + segments.std(0, keepdims=True) * state.home
    distance = squared_distance(home, segments) / (error + error.mean() + 1e-12)[None]
    pull = ((codebook - segments[distance.argmin(1)]) ** 2).sum(-1)
    return ((state.idle >= PATIENCE).astype(jnp.float32) * pull).mean()


def after_use(state: DGRLState, indices: jax.Array) -> DGRLState:
    """The state after segments used these code vectors, int32 [N]."""
    count = jnp.zeros(state.usage.shape, jnp.int32).at[indices].add(1)
    usage = state.usage + USAGE_RATE * (count.astype(jnp.float32) / indices.size - state.usage)
    return state.replace(usage=usage, idle=jnp.where(count > 0, 0, state.idle + 1))


def perplexity(usage: jax.Array) -> jax.Array:
    """Effective number of code vectors in use: exp of the entropy of the usage [codes], which need not sum to 1."""
    share = usage / usage.sum()
    return jnp.exp(-jax.scipy.special.xlogy(share, share).sum())


def encoder_of(config: DGRLConfig) -> networks.GoalLayers:
    """The network before quantisation."""
    return networks.GoalLayers(config.hidden, config.latent_size, config.standardise_images)


def segments_of(config: DGRLConfig, encoder_params, goal_inputs: jax.Array) -> jax.Array:
    """Segments [..., factors, d / factors] of the codes of goal inputs [..., *input], before quantisation."""
    codes = encoder_of(config).apply(encoder_params, goal_inputs)
    return codes.reshape(*codes.shape[:-1], config.factors, -1)


def make(config: DGRLConfig) -> Learner:
    """The learner of discrete codes that reconstruct the goal."""

    def init(key, example, hyper):
        """Initialise the codebook with segments of goals, so that no code vector is far from all segments."""
        keys = jax.random.split(key, 6)
        inputs = example.goal_inputs
        encoder_params = encoder_of(config).init(keys[0], inputs[:1])
        if len(inputs) > INITIAL_GOALS:
            inputs = inputs[jax.random.choice(keys[1], len(inputs), (INITIAL_GOALS,), replace=False)]
        segments = segments_of(config, encoder_params, inputs).reshape(-1, config.latent_size // config.factors)
        chosen = segments[
            jax.random.choice(keys[2], len(segments), (config.codes,), replace=len(segments) < config.codes)
        ]
        noise = INITIAL_NOISE * segments.std(0, keepdims=True) * jax.random.normal(keys[3], chosen.shape, jnp.float32)
        decoder_params = vae.init_decoder(keys[4], config.hidden, config.latent_size, inputs)
        params = {"encoder": encoder_params, "decoder": decoder_params, "codebook": chosen + noise}
        state = DGRLState(
            jnp.zeros(config.codes, jnp.float32),
            jnp.zeros(config.codes, jnp.int32),
            jax.random.normal(keys[5], chosen.shape, jnp.float32),
        )
        return params, state

    def encode(params, goal_inputs):
        segments = segments_of(config, params["encoder"], goal_inputs)
        vectors = take_rows(params["codebook"], nearest(segments, params["codebook"]))
        return GoalCode(straight_through(segments, vectors).reshape(*segments.shape[:-2], config.latent_size))

    def loss(params, state, batch: LearnerBatch, hyper, key):
        """Reconstruction from the discrete code in the VAE's scale, plus the distances between segments and code
        vectors (Islam et al.), plus the revival loss. The revival loss replaces the usual reset of unused code vectors,
        because only gradients change parameters here."""
        inputs = batch.inputs_of(batch.goals)
        segments = segments_of(config, params["encoder"], inputs)
        indices = nearest(segments, params["codebook"])
        vectors = take_rows(params["codebook"], indices)
        code = straight_through(segments, vectors).reshape(len(inputs), -1)
        error = vae.squared_error(params["decoder"], config.hidden, code, inputs, config.standardise_images)
        size = inputs[0].size
        reconstruction = vae.negative_log_likelihood(error, inputs, config.vector_std).mean() / size
        codebook_loss, commitment_loss = distances_to_codes(segments, vectors)
        revival = revival_loss(params["codebook"], segments.reshape(indices.size, -1), indices.reshape(-1), state)
        state = after_use(state, indices.reshape(-1))
        metrics = {
            "reconstruction_error": error.mean() / size,
            "codebook_loss": codebook_loss,
            "commitment_loss": commitment_loss,
            "codes_used": (state.idle < PATIENCE).sum().astype(jnp.float32),
            "perplexity": perplexity(state.usage),
        }
        return (
            reconstruction + codebook_loss + config.commitment * commitment_loss + config.revival * revival,
            metrics,
            state,
        )

    return Learner(init, encode, loss, SampleSpec(num_goals=config.num_goals))
