"""Neural networks (flax.linen): goal encoder, state encoders, heads; and the loss of what they predict.

All layers are matrix products. A convolution inside a scan runs 5 to 15 times slower on XLA:CPU, so images are cut into
patches instead.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.linen.dtypes import promote_dtype

from infogoal_jax.errors import require
from infogoal_jax.shapes import with_rank

MINIMUM_STD = 1e-3  # Added to softplus in the authors' encoder.
activations = jax.make_user_context(default_value=None)
"""`with activations("bfloat16")`: layers take and give bfloat16; parameters and what a network gives stay float32."""


def hidden_layer(features: int, **settings) -> nn.Dense:
    """A linear layer [..., D] to [..., features] that takes and gives `activations`."""
    return nn.Dense(features, dtype=activations.value, **settings)


def last_layer(features: int, **settings) -> nn.Dense:
    """A linear layer [..., D] to [..., features] that takes `activations` and gives float32."""
    product = functools.partial(jax.lax.dot_general, preferred_element_type=jnp.float32)

    def sides(inputs, kernel, bias, dtype):  # The bias is added to float32.
        return *promote_dtype(inputs, kernel, dtype=dtype), bias

    return nn.Dense(features, dtype=activations.value, promote_dtype=sides, dot_general=product, **settings)


def normalised(values: jax.Array) -> jax.Array:
    """Each vector of [..., D] to mean 0 and deviation 1, then weighted and shifted: float32."""
    return nn.LayerNorm()(values.astype(jnp.float32))


class MLP(nn.Module):
    """Multilayer perceptron [..., D] to [..., out]: ReLU layers of the given widths, then a linear layer."""

    hidden: tuple[int, ...]
    out: int
    layer_norm: bool = False
    """Normalise over the layer what each ReLU gets, so that few of its units die (docs/research/all_goals.md)."""

    @nn.compact
    def __call__(self, inputs):
        for width in self.hidden:
            inputs = hidden_layer(width)(inputs)
            inputs = nn.relu(normalised(inputs) if self.layer_norm else inputs)
        return last_layer(self.out)(inputs)


class GeluMLP(nn.Module):
    """Multilayer perceptron [..., D] to [..., out] as OGBench has it: GELU layers, each normalised after its GELU where
    `layer_norm` says so, then a linear layer whose weights are `last_scale` times as large at first."""

    hidden: tuple[int, ...]
    out: int
    layer_norm: bool = False
    last_scale: float = 1.0

    @nn.compact
    def __call__(self, inputs):
        for width in self.hidden:
            inputs = nn.gelu(hidden_layer(width, kernel_init=uniform_init(1.0))(inputs))
            inputs = normalised(inputs) if self.layer_norm else inputs
        return last_layer(self.out, kernel_init=uniform_init(self.last_scale))(inputs)


TwinGeluMLP = nn.vmap(GeluMLP, variable_axes={"params": 0}, split_rngs={"params": True}, in_axes=None, axis_size=2)
"""Two of them with the same inputs [..., D], their outputs stacked: [2, ..., out]."""


def uniform_init(scale: float) -> nn.initializers.Initializer:
    """Uniform weights with a variance of `scale` over the mean of inputs and outputs."""
    return nn.initializers.variance_scaling(scale, "fan_avg", "uniform")


def patches(images: jax.Array, side: int) -> jax.Array:
    """Cut images [..., H, W, C] into square patches, each a vector: [..., H / side, W / side, side * side * C]. `side`
    divides H and W."""
    *batch, height, width, channels = images.shape
    cut = images.reshape(*batch, height // side, side, width // side, side, channels)
    return jnp.moveaxis(cut, -4, -3).reshape(*batch, height // side, width // side, side * side * channels)


def unpatched(values: jax.Array, side: int) -> jax.Array:
    """Join patches [..., H / side, W / side, side * side * C] to images [..., H, W, C]: the inverse of `patches`."""
    *batch, rows, columns, size = values.shape
    squares = jnp.moveaxis(values.reshape(*batch, rows, columns, side, side, size // side**2), -3, -4)
    return squares.reshape(*batch, rows * side, columns * side, size // side**2)


def standardised(images: jax.Array) -> jax.Array:
    """Standardise each image [..., H, W, C] to mean 0 and standard deviation 1. A background takes away contrast
    first."""
    mean, deviation = contrast(images)
    return (images - mean) / deviation


def contrast(images: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation of each image [..., H, W, C]: [..., 1, 1, 1]. The latter is not 0."""
    axes = (-3, -2, -1)
    mean = images.mean(axes, keepdims=True)
    return mean, jnp.sqrt(jnp.square(images - mean).mean(axes, keepdims=True)) + 1e-3


class PixelLayer(nn.Module):
    """The first convolution of `ImageLayers`, images uint8 [..., H, W, C] to [..., H / 8, W / 8, 2, 2, 16]. Images are
    standardised behind the product, which takes bytes before it."""

    standardise: bool

    @nn.compact
    def __call__(self, images):
        height, width = images.shape[-3:-1]
        require(height % 8 == width % 8 == 0, "goal images", [height, width], "give sides that 8 divides")
        seen = scaled(squares_of_fours(images))
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (seen.shape[-1], 16), jnp.float32)
        bias = with_rank(self.param("bias", nn.initializers.zeros_init(), (16,), jnp.float32), seen.ndim)
        if not self.standardise:
            return seen @ kernel + bias
        mean, deviation = (values[..., None, None] for values in contrast(to_scale(images)))
        # Without the barrier a GPU sums up the large gradient for the images, and once more for the bias.
        offset = jax.lax.optimization_barrier(bias - mean / deviation * with_rank(kernel.sum(0), seen.ndim))
        return seen @ kernel / deviation + offset


class ImageLayers(nn.Module):
    """Two convolutions without overlap, images uint8 [..., H, W, C] to [..., D]: 16 channels of 4 x 4 pixels, then 32
    of 2 x 2 patches.

    The authors' convolutions overlap (8 channels, side 4, stride 2; 16, side 2, stride 1). At 64 x 64 pixels a gradient
    through them takes 2.5 times as long on a CPU, even with a second stride of 2 [M].
    """

    standardise: bool
    """Give every image the same mean and contrast first."""

    @nn.compact
    def __call__(self, images):
        pixels = PixelLayer(self.standardise, name="Dense_0")(images)
        values = nn.relu(pixels.astype(activations.value or pixels.dtype))
        values = nn.relu(hidden_layer(32, name="Dense_1")(values.reshape(*values.shape[:-3], -1)))
        return values.reshape(*values.shape[:-3], -1)


def squares_of_fours(images: jax.Array) -> jax.Array:
    """Cut images [..., H, W, C] into squares of 8 pixels and each of these into four patches, [..., H / 8, W / 8, 2, 2,
    4 * 4 * C]: what the second layer of `ImageLayers` joins lies together."""
    squares = patches(images, 8)
    return patches(squares.reshape(*squares.shape[:-1], 8, 8, images.shape[-1]), 4)


def scaled(pixels: jax.Array) -> jax.Array:
    """Levels of pixels, uint8, from -1 to 1, float32."""
    return jax.lax.platform_dependent(pixels, cuda=scaled_in_the_product, default=to_scale)


def to_scale(levels: jax.Array) -> jax.Array:
    """Levels from 0 to 255 to values from -1 to 1, float32."""
    return levels.astype(jnp.float32) / 127.5 - 1.0


def scaled_in_the_product(pixels: jax.Array) -> jax.Array:
    """`to_scale` for GPUs: the pixels stay bytes, behind a barrier, until a matrix product takes them.

    Most of what an update moves through the memory of a GPU are images, four times as many bytes where they are written
    out as floats. The kernel that XLA makes of a conversion and a product takes signed bytes alone.
    """
    signed = jax.lax.bitcast_convert_type(pixels ^ np.uint8(128), jnp.int8)
    return to_scale(jax.lax.optimization_barrier(signed).astype(jnp.float32) + 128.0)


class GoalLayers(nn.Module):
    """The body of every goal encoder, to [..., out]: vectors [..., D] pass all layers of `hidden`; images uint8 [...,
    H, W, C] pass two convolutions and the last layer of `hidden` [A]."""

    hidden: tuple[int, ...]
    out: int
    standardise: bool = False

    @nn.compact
    def __call__(self, inputs):
        if inputs.dtype == jnp.uint8:
            return MLP(self.hidden[-1:], self.out)(ImageLayers(self.standardise)(inputs))
        return MLP(self.hidden, self.out)(inputs)


class GaussianEncoder(nn.Module):
    """phi(g) = N(mean, diag std^2), std = softplus + 1e-3: vectors or images to mean and std [..., latent_size]."""

    hidden: tuple[int, ...]
    latent_size: int
    standardise: bool = False

    @nn.compact
    def __call__(self, inputs):
        mean, raw = jnp.split(GoalLayers(self.hidden, 2 * self.latent_size, self.standardise)(inputs), 2, axis=-1)
        return mean, jax.nn.softplus(raw) + MINIMUM_STD


def as_encoded(inputs: jax.Array, standardise: bool) -> jax.Array:
    """Goal inputs in the scale of the first layer of `GoalLayers`, float32. A decoder reconstructs this."""
    if inputs.dtype != jnp.uint8:
        return inputs
    values = to_scale(inputs)
    return standardised(values) if standardise else values


class GoalDecoder(nn.Module):
    """The layers of `GoalLayers` in reverse: codes [..., d] to goal inputs [..., *shape] in the scale of `as_encoded`.

    Vectors are decoded by all layers of `hidden`. Images (H and W multiples of 8) are decoded by the last layer of
    `hidden` and two transposed convolutions without overlap: 32 channels for every 8 x 8 pixels, 16 for every 4 x 4,
    then the pixels.
    """

    hidden: tuple[int, ...]
    """Widths of the encoder's layers."""
    shape: tuple[int, ...]
    """[D] or [H, W, C] of one input."""

    @nn.compact
    def __call__(self, codes):
        if len(self.shape) == 1:
            return MLP(self.hidden[::-1], self.shape[0])(codes)
        height, width, channels = self.shape
        values = nn.relu(MLP(self.hidden[-1:], height // 8 * (width // 8) * 32)(codes))
        values = values.reshape(*values.shape[:-1], height // 8, width // 8, 32)
        values = nn.relu(unpatched(hidden_layer(2 * 2 * 16)(values), 2))
        return unpatched(last_layer(4 * 4 * channels)(values), 4)


class PatchEncoder(nn.Module):
    """psi(s) of images uint8 [..., H, W, C] to [..., features]: one matrix for each patch, one for all patches. `patch`
    divides H and W."""

    patch: int
    channels: int
    features: int

    @nn.compact
    def __call__(self, images):
        values = nn.relu(hidden_layer(self.channels)(scaled(patches(images, self.patch))))
        return nn.relu(normalised(hidden_layer(self.features)(values.reshape(*values.shape[:-3], -1))))


class VectorEncoder(nn.Module):
    """psi(s) of vectors float32 [..., D] to [..., features], with one hidden layer of the same size."""

    features: int

    @nn.compact
    def __call__(self, observation):
        return nn.relu(MLP((self.features,), self.features)(observation))


class AsItIs(nn.Module):
    """No network: a vector float32 [..., D] goes through as it is."""

    def __call__(self, vector):
        return vector


def squared_or_huber(values: jax.Array, target: jax.Array, huber: bool) -> jax.Array:
    """Half the squared error of values against their targets, or the Huber loss: of their shape."""
    import optax  # Here, since the help of a command needs no optimiser: a tenth of its time.

    return optax.huber_loss(values, target) if huber else optax.l2_loss(values, target)
