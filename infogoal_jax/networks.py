"""Neural networks (flax.linen): goal encoder, state encoder, heads. Layers are matrix products throughout: a convolution inside a scan runs 5 to 15
times slower on XLA:CPU, so images are cut into patches instead."""

import flax.linen as nn
import jax
import jax.numpy as jnp

MINIMUM_STD = 1e-3  # Added to softplus in the authors' encoder.


class MLP(nn.Module):
    """ReLU layers of the given widths, then a linear output of size `out`. Maps [..., D] to [..., out]."""

    hidden: tuple[int, ...]
    out: int

    @nn.compact
    def __call__(self, inputs):
        for width in self.hidden:
            inputs = nn.relu(nn.Dense(width)(inputs))
        return nn.Dense(self.out)(inputs)


class GaussianEncoder(nn.Module):
    """phi(g) = N(mean, diag std^2), std = softplus + 1e-3: vectors [..., D] to mean and std [..., latent_size]."""

    hidden: tuple[int, ...]
    latent_size: int

    @nn.compact
    def __call__(self, inputs):
        mean, raw = jnp.split(MLP(self.hidden, 2 * self.latent_size)(inputs), 2, axis=-1)
        return mean, jax.nn.softplus(raw) + MINIMUM_STD


class VectorEncoder(nn.Module):
    """A deterministic code: vectors [..., D] to [..., latent_size]."""

    hidden: tuple[int, ...]
    latent_size: int

    @nn.compact
    def __call__(self, inputs):
        return MLP(self.hidden, self.latent_size)(inputs)


class PatchEncoder(nn.Module):
    """psi(s): grey images uint8 [..., H, W], H and W multiples of `patch`, to [..., features]. One matrix for every patch, one for all of them."""

    patch: int
    channels: int
    features: int

    @nn.compact
    def __call__(self, images):
        *batch, height, width = images.shape
        rows, columns = height // self.patch, width // self.patch
        patches = images.reshape(*batch, rows, self.patch, columns, self.patch)
        patches = jnp.moveaxis(patches, -3, -2).reshape(*batch, rows * columns, self.patch * self.patch)
        patches = patches.astype(jnp.float32) / 127.5 - 1.0
        patches = nn.relu(nn.Dense(self.channels)(patches))
        return nn.relu(nn.LayerNorm()(nn.Dense(self.features)(patches.reshape(*batch, rows * columns * self.channels))))
