"""RAD, reinforcement learning with augmented data (Laskin et al. 2020), applied to goal inputs: a plain goal encoder
with data augmentation.

Images are shifted by a few pixels; text embeddings are multiplied by a random factor. RAD has no loss of its own. The
agent's updates see augmented goals; acting and evaluation see goals as they are.
"""

import dataclasses

import jax
import jax.numpy as jnp

from infogoal_jax.errors import require
from infogoal_jax.field_types import Count, Positive
from infogoal_jax.learners import none
from infogoal_jax.learners.goal_encoder import GoalEncoderConfig
from infogoal_jax.learners.learner import Learner


@dataclasses.dataclass(frozen=True)
class RADConfig(GoalEncoderConfig):
    """Sizes of the plain goal encoder, and the range of the augmentation."""

    shift: Count = 4
    """Largest shift of an image along each axis, in pixels, filled with zeros. 0 turns shifts off."""
    amplitude_low: Positive = 0.6
    """Smallest factor of a vector, as for some tasks of the paper on RAD. Greater than 0."""
    amplitude_high: float = 1.2
    """Largest factor of a vector."""

    def check(self, config) -> None:
        """Raise `UserError` for factors whose ends are the wrong way round."""
        require(
            self.amplitude_low <= self.amplitude_high,
            "learner.amplitude_high",
            self.amplitude_high,
            f"must not be below amplitude_low = {self.amplitude_low}",
        )


def shifted(key: jax.Array, images: jax.Array, shift: int) -> jax.Array:
    """Shift each image [..., H, W, C] over zeros by whole pixels, uniform in [-shift, shift] along both axes (random
    translate)."""
    *batch, height, width, channels = images.shape
    padded = jnp.pad(images, [(0, 0)] * len(batch) + [(shift, shift), (shift, shift), (0, 0)])
    corners = jax.random.randint(key, (*batch, 2), 0, 2 * shift + 1, jnp.int32)

    def cut(image, corner):
        first_channel = jnp.zeros((), jnp.int32)
        return jax.lax.dynamic_slice(image, (corner[0], corner[1], first_channel), (height, width, channels))

    return jax.vmap(cut)(padded.reshape(-1, *padded.shape[-3:]), corners.reshape(-1, 2)).reshape(images.shape)


def scaled(key: jax.Array, vectors: jax.Array, low: float, high: float) -> jax.Array:
    """Multiply each vector [..., D] by its own factor, uniform in [low, high) (random amplitude scaling). The direction
    stays."""
    return vectors * jax.random.uniform(key, (*vectors.shape[:-1], 1), vectors.dtype, low, high)


def make(config: RADConfig) -> Learner:
    """The learner without a loss that augments goal inputs in the agent's updates."""

    def augment(key, goal_inputs):
        if goal_inputs.dtype == jnp.uint8:
            side = min(goal_inputs.shape[-3:-1])
            require(config.shift < side, "learner.shift", config.shift, f"give fewer pixels than an image has, {side}")
            return shifted(key, goal_inputs, config.shift)
        return scaled(key, goal_inputs, config.amplitude_low, config.amplitude_high)

    return none.make(config)._replace(augment=augment)
