"""Angles, as environments and networks need them: closed over a full turn."""

import jax
import jax.numpy as jnp


def wrapped(angles: jax.Array) -> jax.Array:
    """Angles [...] in [-pi, pi), radians."""
    return (angles + jnp.pi) % (2 * jnp.pi) - jnp.pi


def on_circles(angles: jax.Array) -> jax.Array:
    """Cosines and sines of angles [..., J], for networks: [..., 2 J]."""
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], axis=-1)
