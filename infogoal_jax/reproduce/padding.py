"""Goal sets on graphs of different sizes as environments of one shape, so that one program trains on all of them.

What is added is never met: images that no move leads to and no episode starts at, starts behind the number of starts,
and places for goals in view that hold none.
"""

from typing import Any

import jax
import jax.numpy as jnp

from infogoal_jax.envs.graph import UNREACHABLE, DetectionWalk, GraphWalk


def with_one_shape(envs: list[Any]) -> list[Any]:
    """The environments, those on graphs padded to the largest of them; others as they are."""
    walks = [env.unwrapped for env in envs]
    if len(envs) == 1 or not all(isinstance(walk, GraphWalk) for walk in walks):
        return envs
    starts = max(walk.starts.shape[1] for walk in walks)
    padded = [walk.replace(starts=widened(walk.starts, 1, starts, 0)) for walk in walks]
    if all(isinstance(walk, DetectionWalk) for walk in walks):
        in_view = max(walk.achieved_goals.shape[1] for walk in walks)
        padded = [walk.replace(achieved_goals=widened(walk.achieved_goals, 1, in_view, -1)) for walk in padded]
        if all(walk.recorded is None and walk.views is None for walk in walks):
            images = max(walk.num_observations for walk in walks)
            padded = [with_images(walk, images) for walk in padded]
    return [walk if env is env.unwrapped else env.replace(env=walk) for env, walk in zip(envs, padded, strict=True)]


def with_images(walk: DetectionWalk, images: int) -> DetectionWalk:
    """The walk with so many images. One that was added leads to itself, and shows nothing."""
    count = walk.num_observations
    own = jnp.broadcast_to(jnp.arange(count, images, dtype=walk.next_node.dtype)[:, None], (images - count, 1))
    added = jnp.repeat(own, walk.action_size, axis=1)
    return walk.replace(
        next_node=jnp.concatenate([walk.next_node, added]),
        images=widened(walk.images, 0, images, 0),
        in_view=widened(walk.in_view, 0, images, False),
        achieved_goals=widened(walk.achieved_goals, 0, images, -1),
        position=widened(walk.position, 0, images, jnp.nan),
        distance=widened(walk.distance, 1, images, UNREACHABLE),
    )


def widened(array: jax.Array, axis: int, size: int, value: Any) -> jax.Array:
    """The array, filled up with a value to this size along an axis."""
    width = [(0, 0)] * array.ndim
    width[axis] = 0, size - array.shape[axis]
    return jnp.pad(array, width, constant_values=value)
