"""The finite goal space of a task as arrays, and the corruption of goal images (Sec. V-A).

A goal is an int32 index into a `GoalSet` everywhere; -1 means "no goal".
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.errors import require
from infogoal_jax.goal_uses import NO_USE, USES


@flax.struct.dataclass
class GoalSet:
    """N goals, their inputs and their uses. Only training goals are desired goals while training."""

    inputs: jax.Array
    """[M, *input] what the goal encoder sees: vectors float32 [M, D], such as text embeddings, or images uint8
    [M, H, W, C]. `inputs_of` finds those of a goal."""
    regions: jax.Array
    """int32 [N], part of the world that a goal lies in, for example a room. For reports, and for the share of positives
    within regions."""
    train_mask: jax.Array
    """bool [N], training goals. The three masks are disjoint."""
    validation_mask: jax.Array
    """bool [N], validation goals."""
    test_mask: jax.Array
    """bool [N], test goals."""
    training_goals: jax.Array
    """int32, the training goals."""
    evaluated: jax.Array
    """int32, the goals of all three masks. The others can be achieved only."""
    names: tuple[str, ...] = flax.struct.field(pytree_node=False)
    """N names, for reports."""
    region_names: tuple[str, ...] = flax.struct.field(pytree_node=False)
    """Names of the regions, for reports."""
    groups: tuple[str, ...] = flax.struct.field(pytree_node=False)
    """Those of "train", "validation" and "test" that have goals."""
    rows: jax.Array | None = None
    """int32 [N], row of `inputs` for each goal, where a dataset has more images than goals; None: row n is goal n."""
    by_index: bool = flax.struct.field(pytree_node=False, default=False)
    """Whether goals are shown to the goal encoder as their numbers alone."""

    @classmethod
    def of(cls, inputs, regions, uses, names: tuple[str, ...], region_names: tuple[str, ...], rows=None) -> "GoalSet":
        """Make a goal set of inputs [M, ...], regions [N] and uses [N], each a position in `USES` or `NO_USE`. rows:
        int [N] into the inputs. Raises `UserError` for what does not fit together."""
        uses = np.asarray(uses)
        check_goals(inputs if rows is None else rows, regions, uses, names, region_names)
        # Put on the device as they are, here and in the tasks: `jnp.asarray` would compile a program for every shape.
        masks = [jax.device_put(uses == use) for use in range(len(USES))]
        return cls(
            jax.device_put(inputs),
            jax.device_put(np.asarray(regions, np.int32)),
            *masks,
            training_goals=jax.device_put(np.flatnonzero(uses == 0).astype(np.int32)),
            evaluated=jax.device_put(np.flatnonzero(uses != NO_USE).astype(np.int32)),
            names=tuple(names),
            region_names=tuple(region_names),
            groups=tuple(name for use, name in enumerate(USES) if (uses == use).any()),
            rows=None if rows is None else jax.device_put(np.asarray(rows, np.int32)),
        )

    def inputs_of(self, goals: jax.Array) -> jax.Array:
        """Inputs of the goal encoder [..., *input] for goals int32 [...]; their numbers [..., 1] if `by_index`."""
        if self.by_index:
            return jnp.asarray(goals)[..., None]
        return self.inputs[goals if self.rows is None else self.rows[goals]]

    @property
    def num_goals(self) -> int:
        """Number of goals N."""
        return len(self.names)


def check_goals(inputs, regions, uses: np.ndarray, names: tuple[str, ...], region_names: tuple[str, ...]) -> None:
    """Raise `UserError`, naming the field, for goals whose parts do not fit together."""
    count, lengths = len(uses), {"inputs": len(inputs), "regions": len(regions), "names": len(names)}
    for field, length in lengths.items():
        require(length == count, field, length, f"give one for each of the {count} goals in uses")
    whole = np.issubdtype(uses.dtype, np.integer)
    known = [*range(len(USES)), NO_USE]
    require(whole and np.isin(uses, known).all(), "uses", uses, f"give positions in {USES}, or {NO_USE} for none")
    places, most = np.asarray(regions), len(region_names) - 1
    require(((places >= 0) & (places <= most)).all(), "regions", places, f"region_names has the regions 0 to {most}")


def corrupt(inputs: jax.Array, backgrounds: jax.Array, weight: jax.Array | float) -> jax.Array:
    """Mix backgrounds into goal images, x_c = (1 - w) x + w x_bkg (Sec. V-A, where w is 0.1, 0.2, 0.4 or 0.8).

    inputs, backgrounds: uint8 [..., H, W, C]. weight: w from 0 (images alone) to 1 (backgrounds alone); may be traced.
    Returns uint8 [..., H, W, C], rounded to the nearest level.
    """
    mixed = (1.0 - weight) * inputs.astype(jnp.float32) + weight * backgrounds.astype(jnp.float32)
    return jnp.round(mixed).astype(jnp.uint8)


def draw_backgrounds(key: jax.Array, bank: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draw backgrounds uint8 [*shape, H, W, C] with replacement from a bank of M images, uint8 [M, H, W, C] (Sec.
    V-A)."""
    return bank[jax.random.randint(key, shape, 0, bank.shape[0], jnp.int32)]
