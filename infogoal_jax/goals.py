"""The finite goal space of a task as arrays, and the corruption of goal images (Sec. V-A).

A goal is an int32 index into a `GoalSet` everywhere; -1 stands for "no goal".
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

USES = ("train", "validation", "test")
NO_USE = -1  # Of a goal that is never commanded nor evaluated.


@flax.struct.dataclass
class GoalSet:
    """N goals, their inputs and their uses.

    inputs: [M, ...] what the goal encoder sees (float32 text embeddings [N, 384], or uint8 images); ask `inputs_of` for those of a goal.
    rows: int32 [N] of the inputs that the goals are seen as, where a dataset holds more images than those of goals; None: they are their own.
    regions: int32 [N] the part of the world a goal lies in (a room); for reports and for the share of positives within and between.
    train_mask, validation_mask, test_mask: bool [N], disjoint. Only training goals are ever commanded while training.
    commanded: int32, the training goals; evaluated: int32 [M], the goals of all three masks. Others fill the goal space, and can be achieved only.
    names, region_names: for reports. groups: which of "train", "validation" and "test" have goals.
    """

    inputs: jax.Array
    regions: jax.Array
    train_mask: jax.Array
    validation_mask: jax.Array
    test_mask: jax.Array
    commanded: jax.Array
    evaluated: jax.Array
    names: tuple[str, ...] = flax.struct.field(pytree_node=False)
    region_names: tuple[str, ...] = flax.struct.field(pytree_node=False)
    groups: tuple[str, ...] = flax.struct.field(pytree_node=False)
    rows: jax.Array | None = None

    @classmethod
    def of(cls, inputs, regions, uses, names: tuple[str, ...], region_names: tuple[str, ...], rows=None) -> "GoalSet":
        """The goal set of these inputs [N, ...], regions [N] and uses, [N] of `NO_USE` or a position in `USES`. rows: int [N] into the inputs."""
        uses = np.asarray(uses)
        masks = [jnp.asarray(uses == use) for use in range(len(USES))]
        return cls(
            jnp.asarray(inputs), jnp.asarray(regions, jnp.int32), *masks, commanded=jnp.asarray(np.flatnonzero(uses == 0), jnp.int32),
            evaluated=jnp.asarray(np.flatnonzero(uses != NO_USE), jnp.int32), names=tuple(names), region_names=tuple(region_names),
            groups=tuple(name for use, name in enumerate(USES) if (uses == use).any()), rows=None if rows is None else jnp.asarray(rows, jnp.int32),
        )

    def inputs_of(self, goals: jax.Array) -> jax.Array:
        """What the goal encoder sees of these goals int32 [...]: [..., *input]."""
        return self.inputs[goals if self.rows is None else self.rows[goals]]

    @property
    def num_goals(self) -> int:
        """N, the number of goals."""
        return len(self.names)


def corrupt(inputs: jax.Array, backgrounds: jax.Array, weight: jax.Array | float) -> jax.Array:
    """Goal images with backgrounds laid over them, x_c = (1 - w) x + w x_bkg (Sec. V-A, where w is 0.1, 0.2, 0.4 or 0.8).

    inputs, backgrounds: uint8 [..., H, W, C]. weight: from 0, the images, to 1, the backgrounds; may be traced.
    Returns uint8 [..., H, W, C], rounded to the nearest level.
    """
    mixed = (1.0 - weight) * inputs.astype(jnp.float32) + weight * backgrounds.astype(jnp.float32)
    return jnp.round(mixed).astype(jnp.uint8)


def draw_backgrounds(key: jax.Array, bank: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Backgrounds drawn at random with replacement from a bank of M images, uint8 [M, H, W, C]; uint8 [*shape, H, W, C] (Sec. V-A)."""
    return bank[jax.random.randint(key, shape, 0, bank.shape[0])]
