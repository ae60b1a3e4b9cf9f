"""Variational autoencoder as goal representation (RIG: Nair et al. 2018; Kingma & Welling 2014).

The code of a goal is a Gaussian from which a decoder reconstructs the goal's input, kept close to N(0, I). Unlike
InfoGoal, the VAE does not know which goals are similar: what fills many pixels fills the code. As in the paper's
comparison there is no intrinsic reward.
"""

import dataclasses

import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.field_types import Count, Positive, Size, Weight
from infogoal_jax.learners.goal_encoder import GoalEncoderConfig, kl_to_standard_normal, warmed_up
from infogoal_jax.learners.learner import GoalCode, Learner, LearnerBatch, SampleSpec


@dataclasses.dataclass(frozen=True)
class VAEConfig(GoalEncoderConfig):
    """Sizes of encoder and decoder, and weights of the bound."""

    num_goals: Size = 64
    """Known goals, desired or achieved, that an update reconstructs."""
    vae_beta: Weight = 1.0
    """Weight of the KL. 1 is the evidence lower bound. RIG uses 20 to 30 with smaller codes."""
    warm_up: Count = 2000
    """Updates over which the weight of the KL rises from 0 [M]. At full weight from the start the KL can outweigh what
    an untrained decoder gains, and codes of text goals stay at N(0, I) for good."""
    vector_std: Positive = 0.05
    """Standard deviation of the decoder for goals that are vectors [M]: about 1 / sqrt(384), the size of the numbers of
    a sentence embedding of length 1. With 1, the value for images in the scale -1 to 1, no code of a text goal is worth
    its KL, and every posterior collapses to N(0, I)."""


def init_decoder(key: jax.Array, hidden: tuple[int, ...], latent_size: int, goal_inputs: jax.Array):
    """Parameters of a decoder for such goal inputs [M, ...]."""
    return networks.GoalDecoder(hidden, goal_inputs.shape[1:]).init(key, jnp.zeros((1, latent_size), jnp.float32))


def squared_error(params, hidden: tuple[int, ...], codes: jax.Array, inputs: jax.Array, standardise: bool) -> jax.Array:
    """Squared error [B] of the reconstruction from codes [B, d], summed over the numbers of each input [B, ...], in the
    encoder's scale."""
    decoded = networks.GoalDecoder(hidden, inputs.shape[1:]).apply(params, codes)
    return ((decoded - networks.as_encoded(inputs, standardise)) ** 2).reshape(len(inputs), -1).sum(1)


def negative_log_likelihood(error: jax.Array, inputs: jax.Array, vector_std: float) -> jax.Array:
    """-log p(g | z) [B] in nats of a Gaussian decoder without its constant, of squared errors: variance 1 for images,
    vector_std^2 for vectors."""
    return 0.5 * error / (1.0 if inputs.dtype == jnp.uint8 else vector_std**2)


def make(config: VAEConfig) -> Learner:
    """The learner whose codes reconstruct the goal."""
    encoder = networks.GaussianEncoder(config.hidden, config.latent_size, config.standardise_images)

    def init(key, example, hyper):
        encoder_key, decoder_key = jax.random.split(key)
        return {
            "encoder": encoder.init(encoder_key, example.goal_inputs[:1]),
            "decoder": init_decoder(decoder_key, config.hidden, config.latent_size, example.goal_inputs),
        }, jnp.zeros((), jnp.int32)  # Updates so far.

    def encode(params, goal_inputs):
        return GoalCode(*encoder.apply(params["encoder"], goal_inputs))

    def loss(params, state, batch: LearnerBatch, hyper, key):
        """Minus the evidence lower bound (Kingma & Welling, Eq. 3), divided by the number of numbers of an input.

        The division makes its size comparable with that of the agent's loss, and keeps `vae_beta` = 1 the bound itself.
        The metrics `elbo` and `kl` are in nats for a whole goal, without the decoder's constant.
        """
        inputs = batch.inputs_of(batch.goals)
        code = encode(params, inputs)  # Not `batch.encode`, which may augment: the target is the input that is encoded.
        error = squared_error(params["decoder"], config.hidden, code.sample(key), inputs, config.standardise_images)
        surprise, kl = (
            negative_log_likelihood(error, inputs, config.vector_std).mean(),
            kl_to_standard_normal(code).mean(),
        )
        size, weight = inputs[0].size, config.vae_beta * warmed_up(state, config.warm_up)
        metrics = {"elbo": -(surprise + kl), "reconstruction_error": error.mean() / size, "kl": kl}
        return (surprise + weight * kl) / size, metrics, state + 1

    return Learner(init, encode, loss, SampleSpec(num_goals=config.num_goals), mean_at_test=True)
