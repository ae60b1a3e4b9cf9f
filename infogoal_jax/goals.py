"""The finite goal space of a task as arrays, and the corruption of goal images (Sec. V-A).

A goal is an int32 index into a `GoalSet` everywhere; -1 means "no goal".
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks
from infogoal_jax.errors import UserError, require
from infogoal_jax.goal_uses import NO_USE, USES

MOST_CHANNELS = 4
"""Of an image; more of them last, and fewer first, are an image with its channels first."""


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
        int [N] into the inputs.

        Raises `UserError`, naming the field, for what does not fit together, for numbers that are not finite, for names
        that are not unique, and for inputs that are neither vectors float32 [M, D] nor images uint8 [M, H, W, C].
        """
        uses, inputs = checked_uses(uses), checked_inputs(inputs)
        count = len(uses)
        if rows is None:
            require(len(inputs) == count, "inputs", len(inputs), f"give one for each of the {count} goals in uses")
        else:
            rows = checked_places(rows, "rows", count, len(inputs), f"there are {len(inputs)} inputs")
        region_names = checked_names(region_names, "region_names", None)
        known = f"region_names has the regions 0 to {len(region_names) - 1}"
        regions = checked_places(regions, "regions", count, len(region_names), known)
        names = checked_names(names, "names", count)
        # Put on the device as they are, here and in the tasks: `jnp.asarray` would compile a program for every shape.
        masks = [jax.device_put(uses == use) for use in range(len(USES))]
        return cls(
            jax.device_put(inputs),
            jax.device_put(regions),
            *masks,
            training_goals=jax.device_put(np.flatnonzero(uses == 0).astype(np.int32)),
            evaluated=jax.device_put(np.flatnonzero(uses != NO_USE).astype(np.int32)),
            names=names,
            region_names=region_names,
            groups=tuple(name for use, name in enumerate(USES) if (uses == use).any()),
            rows=None if rows is None else jax.device_put(rows),
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


def checked_inputs(inputs: Any) -> Any:
    """What the goal encoder sees, vectors float32 [M, D] or images uint8 [M, H, W, C], as arrays. Raises `UserError`
    for anything else; vectors of another type of floats are rounded."""
    remedy = "give vectors float32 [M, D], or images uint8 [M, H, W, C]"
    inputs = checks.array(inputs, "inputs", "numbers", remedy=remedy)
    shape, found = inputs.shape, checks.written(inputs.shape, str(inputs.dtype))
    if len(shape) == 1:
        remedy = f"give vectors float32 [{shape[0]}, 1]: one number is a vector of length 1"
    elif len(shape) in (3, 4) and inputs.dtype != np.uint8:
        remedy = "give images as uint8 from 0 to 255, [M, H, W, C]"
    elif len(shape) == 3:
        remedy = f"give images uint8 [M, H, W, C]: here {[*shape, 1]} for one channel"
    elif len(shape) == 4 and shape[1] <= MOST_CHANNELS < shape[3]:
        remedy = f"give images with their channels last, uint8 {[shape[0], *shape[2:], shape[1]]}"
    elif len(shape) == 2 and not jnp.issubdtype(inputs.dtype, jnp.floating):
        remedy = f"give vectors as float32 {list(shape)}"
    elif len(shape) in (2, 4):
        remedy = ""
    if remedy:
        raise UserError(f"inputs = {found}: {remedy}")
    require(0 not in shape, "inputs", found, "give at least one goal, and no empty axis")
    if inputs.dtype == np.uint8:
        return inputs
    with np.errstate(over="ignore"):
        vectors = inputs.astype(np.float32)
    require(checks.is_traced(vectors) or bool(np.isfinite(vectors).all()), "inputs", found, "float32 cannot hold them")
    return vectors


def checked_names(names: Any, field: str, count: int | None) -> tuple[str, ...]:
    """Different names, so many of them."""
    several = isinstance(names, list | tuple) or (isinstance(names, np.ndarray) and names.ndim == 1)
    require(several and all(isinstance(name, str) for name in names), field, names, "give a tuple of names")
    require(count is None or len(names) == count, field, len(names), f"give one for each of the {count} goals in uses")
    repeated = next((name for place, name in enumerate(names) if name in names[:place]), None)
    require(len({*names}) == len(names), field, repeated, "is there twice; give each a name of its own")
    return tuple(map(str, names))


def checked_uses(uses: Any) -> np.ndarray:
    """Positions in `USES`, or `NO_USE`, int32 [N]."""
    remedy = f"give positions in {USES}, or {NO_USE} for none, [N]"
    uses = np.asarray(checks.array(uses, "uses", "whole numbers", ("N",), remedy))
    require(uses.size > 0, "uses", uses, remedy)
    require(np.isin(uses, [*range(len(USES)), NO_USE]).all(), "uses", uses, remedy)
    return uses


def checked_places(places: Any, field: str, count: int, num_places: int, of: str) -> np.ndarray:
    """A place below `num_places` for each of `count` goals, int32 [N]."""
    remedy = f"give one for each of the {count} goals in uses, whole numbers from 0 to {num_places - 1}: {of}"
    places = np.asarray(checks.array(places, field, "whole numbers", ("N",), remedy))
    require(len(places) == count, field, len(places), f"give one for each of the {count} goals in uses")
    require(((places >= 0) & (places < num_places)).all(), field, places, remedy)
    return places.astype(np.int32)


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
