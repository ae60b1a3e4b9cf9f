"""Goal spaces: which goals a task has, which of them are desired in training and asked for in evaluation, and what the
goal encoder sees of them. And the corruption of goal images (Sec. V-A).

A goal is a value: an int32 index [] into a `GoalSet`, or a vector float32 [D] of a `GoalBox`. An image of a goal, or
anything else that the encoder sees of it, is what `inputs_of` makes of that value. Arrays of goals are [..., *shape],
where `shape` is () or (D,). "No goal" is the index -1, or a vector of NaN.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks
from infogoal_jax.errors import LONGEST, UserError, require
from infogoal_jax.goal_uses import NO_USE, USES
from infogoal_jax.keys import from_seed
from infogoal_jax.shapes import aligned, with_rank

MOST_CHANNELS = 4
"""Of an image; more of them last, and fewer first, are an image with its channels first."""


def is_goal(goals: jax.Array) -> jax.Array:
    """Where an array of goals [..., *shape] holds one, bool [...]."""
    return goals >= 0 if jnp.issubdtype(goals.dtype, jnp.integer) else ~jnp.isnan(goals).any(-1)


def select(mask: jax.Array, goals: jax.Array, others: jax.Array) -> jax.Array:
    """These goals [..., *shape] where the mask [...] holds, else the others [..., *shape]."""
    return jnp.where(mask.reshape(*mask.shape, *(1,) * (goals.ndim - mask.ndim)), goals, others)


def no_goals_like(goals: jax.Array) -> jax.Array:
    """Goals [..., *shape] of which none is one."""
    return jnp.full_like(goals, -1 if jnp.issubdtype(goals.dtype, jnp.integer) else jnp.nan)


def with_placeholders(goals: jax.Array) -> jax.Array:
    """The goals [..., *shape], with one that can be encoded, 0, in every place that holds none."""
    return jnp.maximum(goals, 0) if jnp.issubdtype(goals.dtype, jnp.integer) else jnp.nan_to_num(goals)


def same(goals: jax.Array, others: jax.Array) -> jax.Array:
    """Whether goals [..., *shape] are the very same values as the others, bool [...]."""
    equal = goals == others
    return equal if jnp.issubdtype(goals.dtype, jnp.integer) else equal.all(-1)


def axes_of(goals: jax.Array) -> tuple[int, ...]:
    """The leading axes [...] of an array of goals [..., *shape]."""
    return goals.shape if jnp.issubdtype(goals.dtype, jnp.integer) else goals.shape[:-1]


@flax.struct.dataclass
class GoalSet:
    """A finite goal space: N goals, their inputs and their uses. Only training goals are desired goals while
    training, unless `desired` says otherwise."""

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
    desired: jax.Array | None = None
    """int32, the goals that are desired in training; None: the training goals."""

    finite = True
    shape = ()
    dtype = "int32"

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
        return len(self.names)

    @property
    def examples(self) -> jax.Array:
        """Training goals, int32 [M]: here all of them."""
        return self.training_goals

    @property
    def desired_goals(self) -> jax.Array:
        """Goals that are desired in training, int32."""
        return self.training_goals if self.desired is None else self.desired

    @property
    def desired_mask(self) -> jax.Array:
        """Whether a goal is desired in training, bool [N]."""
        if self.desired is None:
            return self.train_mask
        return jnp.zeros_like(self.train_mask).at[self.desired].set(True)

    def is_training_goal(self, goals: jax.Array) -> jax.Array:
        """Whether these goals [...] are desired in training, bool [...]."""
        return self.desired_mask[goals]

    @property
    def listed_mask(self) -> jax.Array:
        """Whether a goal is a training, validation or test goal, bool [N]."""
        return self.train_mask | self.validation_mask | self.test_mask

    def usable_mask(self, known_goals: str) -> jax.Array:
        """Goals that may enter relabelling and representation learning once they are achieved, bool [N], under this
        protocol (`TrainConfig.known_goals`)."""
        if known_goals == "train":
            return self.train_mask
        return ~(self.validation_mask | self.test_mask) if known_goals == "held_out" else jnp.ones_like(self.train_mask)

    def usable(self, goals: jax.Array, known_goals: str) -> jax.Array:
        """Whether these goals [...] are among those of `usable_mask`, bool [...]."""
        return self.usable_mask(known_goals)[goals]

    def in_groups(self) -> jax.Array:
        """Which of the evaluated goals [M] belong to each of `groups`, bool [G, M]."""
        return jnp.stack([getattr(self, f"{group}_mask") for group in self.groups])[:, self.evaluated]

    def only(self, group: str) -> "GoalSet":
        """The same goals, of which those of one of `groups` alone are evaluated. Raises `UserError` for another."""
        require(group in self.groups, "group", group, f"give one of {self.groups}")
        scored = np.flatnonzero(getattr(self, f"{group}_mask"))
        return self.replace(evaluated=jnp.asarray(scored, jnp.int32), groups=(group,))

    def checked(self, goals: Any, field: str, axes: int) -> jax.Array:
        """Goals with so many axes, given by number or by name. Raises `UserError` for what are no numbers of goals, as
        a mask of them; of values that are traced the type alone is known."""
        named = [goals] if isinstance(goals, str) else goals if isinstance(goals, list | tuple) else []
        if {*map(type, named)} == {str}:
            unknown = [name for name in named if name not in self.names]
            require(
                not unknown, field, goals, f"the task has no goal {', '.join(unknown)[:LONGEST]}; see env.goals.names"
            )
            numbers = [self.names.index(name) for name in named]
            goals = numbers[0] if isinstance(goals, str) else numbers
        remedy = (
            "give whole numbers of goals, such as np.flatnonzero(mask)" if axes else "give the whole number of a goal"
        )
        given = checks.array(goals, field, "whole numbers", (None,) * axes, remedy)
        require(axes == 0 or given.shape[0] > 0, field, goals, "give at least one goal")
        if checks.is_traced(given):
            return given.astype(jnp.int32)
        known, most = np.asarray(given), self.num_goals - 1
        require(((known >= 0) & (known <= most)).all(), field, goals, f"the task has the goals 0 to {most}")
        return np.asarray(given, np.int32)


EVALUATED_GOALS = 32
"""Goals that an evaluation asks for, of each use."""
DRAWN = 4096
"""Goals that are drawn to find those, and to check the sampler by."""
TRIED = 128
"""Candidates for a training goal. If an eighth of the drawn goals are training goals, all 128 are others once in 10^7
draws."""
LEAST_SHARE = 1 / 8
MOST_CELLS = 4096
"""Cells that a continuous goal space is divided into, for learners that count visits or keep pairs of cells."""
LONGEST_GOAL = 4096
"""Numbers of a goal: a picture is what `seen` makes of one."""


@flax.struct.dataclass
class GoalBox:
    """A continuous goal space: vectors between two corners, of which some regions may be held out of training.

    Desired goals of training are drawn anew in every episode. The goals that an evaluation asks for are drawn once.
    """

    low: jax.Array
    """float32 [D], lowest corner."""
    high: jax.Array
    """float32 [D], highest corner."""
    evaluated: jax.Array
    """float32 [M, D], the goals that an evaluation asks for."""
    uses: jax.Array
    """int32 [M], use of each evaluated goal, a position in `USES`."""
    groups: tuple[str, ...] = flax.struct.field(pytree_node=False)
    """Those of "train", "validation" and "test" that have goals."""
    sampler: Callable[[jax.Array], jax.Array] | None = flax.struct.field(pytree_node=False)
    """(key) -> goal float32 [D]; None: uniform between the corners."""
    use_of: Callable[[jax.Array], jax.Array] | None = flax.struct.field(pytree_node=False)
    """(goal float32 [D]) -> a position in `USES`, or bool, True for a test goal; None: every goal is a training
    goal."""
    seen: Callable[[jax.Array], jax.Array] | None = flax.struct.field(pytree_node=False)
    """(goals float32 [..., D]) -> what the goal encoder sees of them [..., *input]; None: their place between the
    corners, from -1 to 1 along each axis."""

    finite = False
    dtype = "float32"
    by_index = False
    num_goals = None

    @classmethod
    def of(
        cls, low, high, *, sampler=None, use_of=None, seen=None, num_evaluated: int = EVALUATED_GOALS, seed: int = 0
    ) -> "GoalBox":
        """Make a goal space between two corners [D].

        sampler: draws a goal from a key; None: uniform. use_of: says of a goal whether it is held out: True or 2 for a
        test goal, 1 for a validation goal, False or 0 for a training goal. seen: what the goal encoder sees of goals.
        num_evaluated: goals of each use that an evaluation asks for, if that many of the 4,096 that are drawn have this
        use; seed: of these.

        Raises `UserError`, naming the field, for corners that are none, for a function that returns something else than
        it should or draws outside of the corners, and where fewer than an eighth of what is drawn are training goals.
        """
        with jax.ensure_compile_time_eval():  # A task may be made where something is traced.
            return cls._of(low, high, sampler, use_of, seen, num_evaluated, seed)

    @classmethod
    def _of(cls, low, high, sampler, use_of, seen, num_evaluated: int, seed: int) -> "GoalBox":
        remedy = "give the corners as numbers [D], such as [0.0, 0.0]"
        low, high = (checked_corner(corner, name, remedy) for corner, name in ((low, "low"), (high, "high")))
        require(low.shape == high.shape, "high", high.tolist(), f"give as many numbers as low has, {len(low)}")
        require((low < high).all(), "high", high.tolist(), f"has to lie above low = {low.tolist()}")
        with np.errstate(over="ignore"):
            half = np.float32(0.5) * (high - low)  # What goals are divided by; on a device the smallest numbers are 0.
        fits = (half >= np.finfo(np.float32).tiny) & np.isfinite(2 * half)
        require(fits.all(), "high", high.tolist(), f"lies too near to low = {low.tolist()} or too far from it")
        checks.whole(num_evaluated, "num_evaluated", 1, DRAWN)
        for function, name in ((sampler, "sampler"), (use_of, "use_of"), (seen, "seen")):
            if function is not None:
                checks.function(function, name, 1, f"see GoalBox.{name}")
        corners = jax.device_put(low), jax.device_put(high)
        space = cls(*corners, jnp.zeros((0, len(low)), jnp.float32), jnp.zeros(0, jnp.int32), (), sampler, use_of, seen)
        key = from_seed(np.uint32(checks.seed(seed)))
        keys = jax.random.split(key, DRAWN)
        goal = checks.traced("sampler", space.draw_any, keys[0])
        checks.returned(goal, "sampler", checks.Spec((len(low),), "float32"))
        checked_use(use_of, goal)
        checked_seen(space, goal)
        drawn, uses = (np.asarray(each) for each in draw_several(space, keys))
        broken = ~np.isfinite(drawn).all(1)
        require(not broken.any(), "sampler", drawn[broken][:1].tolist(), "draw finite goals")
        outside = (drawn < low - 1e-6).any(1) | (drawn > high + 1e-6).any(1)
        require(not outside.any(), "sampler", drawn[outside][:1].tolist(), "draws goals outside of low and high")
        others = uses[~np.isin(uses, range(len(USES)))][:1].tolist()
        require(not others, "use_of", others, f"give positions in {USES}, or bool")
        share = (uses == 0).mean()
        require(
            share >= LEAST_SHARE,
            "use_of",
            f"{share:.0%} training goals",
            f"leave at least {LEAST_SHARE:.0%} of what is drawn for training, or give a sampler that draws there",
        )
        chosen = [np.flatnonzero(uses == use)[:num_evaluated] for use in range(len(USES))]
        which = np.concatenate(chosen)
        space = space.replace(
            evaluated=jax.device_put(drawn[which]),
            uses=jax.device_put(uses[which]),
            groups=tuple(name for name, places in zip(USES, chosen, strict=True) if len(places)),
        )
        if seen is not None:
            finite = np.isfinite(np.asarray(jax.jit(space.inputs_of)(space.evaluated)))
            broken = drawn[which][~finite.reshape(len(which), -1).all(1)][:1].tolist()
            require(not broken, "seen", broken, "return finite numbers for every goal")
        return space

    @property
    def shape(self) -> tuple[int]:
        return self.low.shape[-1:]

    @property
    def examples(self) -> jax.Array:
        """Training goals, float32 [M, D]: some of them."""
        return jax.vmap(self.draw)(jax.random.split(from_seed(np.uint32(0)), EVALUATED_GOALS))

    def draw_any(self, key: jax.Array) -> jax.Array:
        """A goal float32 [D], of any use."""
        if self.sampler is not None:
            return self.sampler(key)
        return self.low + (self.high - self.low) * jax.random.uniform(key, self.shape, jnp.float32)

    def use(self, goal: jax.Array) -> jax.Array:
        """The use of a goal [D], an int32 position in `USES`."""
        if self.use_of is None:
            return jnp.zeros((), jnp.int32)
        use = jnp.asarray(self.use_of(goal))
        return jnp.where(use, 2, 0).astype(jnp.int32) if use.dtype == bool else use.astype(jnp.int32)

    def draw_with_use(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A goal float32 [D] and its use."""
        goal = self.draw_any(key)
        return goal, self.use(goal)

    def draw(self, key: jax.Array) -> jax.Array:
        """A training goal float32 [D]: the first of several draws that is one."""
        if self.use_of is None:
            return self.draw_any(key)
        goals, uses = jax.vmap(self.draw_with_use)(jax.random.split(key, TRIED))
        return goals[(uses == 0).argmax()]

    def is_training_goal(self, goals: jax.Array) -> jax.Array:
        """Whether goals [..., D] are training goals, bool [...]."""
        if self.use_of is None:
            return jnp.ones(goals.shape[:-1], bool)
        uses = jax.vmap(self.use)(goals.reshape(-1, goals.shape[-1]))
        return (uses == 0).reshape(goals.shape[:-1])

    def usable(self, goals: jax.Array, known_goals: str) -> jax.Array:
        """Whether goals [..., D] may enter relabelling and representation learning once they are achieved, bool [...],
        under this protocol (`TrainConfig.known_goals`)."""
        if self.use_of is None or known_goals in ("visited", "all"):
            return jnp.ones(goals.shape[:-1], bool)
        return self.is_training_goal(goals)

    def inputs_of(self, goals: jax.Array) -> jax.Array:
        """Inputs of the goal encoder [..., *input] for goals float32 [..., D]."""
        goals = jnp.asarray(goals)
        if self.seen is not None:
            return self.seen(goals)
        centre, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        return (goals - with_rank(centre, goals.ndim)) / with_rank(half, goals.ndim)

    @property
    def cells_per_axis(self) -> int:
        """Cells along each axis."""
        return max(1, int(MOST_CELLS ** (1 / self.shape[0]) + 1e-6))

    @property
    def num_cells(self) -> int:
        return self.cells_per_axis ** self.shape[0]

    def cell_of(self, goals: jax.Array) -> jax.Array:
        """The cell of each goal [..., D], int32 [...]; one outside of the corners lies in the nearest, and "no goal" in
        -1."""
        count = self.cells_per_axis
        goals, low, high = aligned(goals, self.low, self.high)
        place = jnp.clip(((goals - low) / (high - low) * count).astype(jnp.int32), 0, count - 1)
        steps = (count ** np.arange(self.shape[0], dtype=np.int32)[::-1]).astype(np.int32)
        cell = (place * steps.reshape((1,) * (place.ndim - 1) + (-1,))).sum(-1, dtype=jnp.int32)
        return jnp.where(is_goal(goals), cell, -1)

    def in_groups(self) -> jax.Array:
        """Which of the evaluated goals [M] belong to each of `groups`, bool [G, M]."""
        return jnp.stack([self.uses == USES.index(group) for group in self.groups])

    def only(self, group: str) -> "GoalBox":
        """The same goals, of which those of one of `groups` alone are evaluated. Raises `UserError` for another."""
        require(group in self.groups, "group", group, f"give one of {self.groups}")
        scored = np.flatnonzero(np.asarray(self.uses) == USES.index(group))
        return self.replace(evaluated=self.evaluated[scored], uses=self.uses[scored], groups=(group,))

    def checked(self, goals: Any, field: str, axes: int) -> jax.Array:
        """Goals [..., D] with so many axes before that of a goal. Raises `UserError` for other shapes, for what is not
        finite, and for goals outside of the corners; where goals or corners are traced the type alone is known."""
        size = self.shape[0]
        remedy = f"give {'goals' if axes else 'a goal'} as numbers [{'M, ' * axes}{size}]"
        given = checks.array(goals, field, "numbers", (None,) * axes + (size,), remedy)
        require(axes == 0 or given.shape[0] > 0, field, goals, "give at least one goal")
        if checks.is_traced((given, self.low, self.high)):
            return jnp.asarray(given, jnp.float32)
        with np.errstate(over="ignore"):
            values, low, high = (np.asarray(array, np.float32) for array in (given, self.low, self.high))
        inside = (np.isfinite(values) & (values >= low - 1e-6) & (values <= high + 1e-6)).all(-1)
        if not inside.all():
            first = values.reshape(-1, size)[np.flatnonzero(~inside.reshape(-1))[0]]
            spans = ", ".join(f"{a:.4g} to {b:.4g}" for a, b in zip(low.tolist(), high.tolist(), strict=True))
            raise UserError(f"{field} = {np.round(first.astype(float), 4).tolist()}: lies outside; give {spans}")
        return values


@jax.jit
def draw_several(space: GoalBox, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Goals float32 [M, D] and their uses; compiled once for all spaces of one sampler."""
    return jax.vmap(space.draw_with_use)(keys)


GoalSpace = GoalSet | GoalBox


def checked_corner(corner: Any, field: str, remedy: str) -> np.ndarray:
    """A corner of a goal space, float32 [D]. Raises `UserError` for anything else, also for numbers that are traced."""
    corner = checks.array(corner, field, "numbers", ("D",), remedy)
    require(not checks.is_traced(corner), field, "a traced array", "a goal space is made of numbers that are known")
    require(0 < len(corner) <= LONGEST_GOAL, field, f"{len(corner)} numbers", f"give 1 to {LONGEST_GOAL}")
    return checks.as_float32(corner, field)


def checked_use(use_of: Callable | None, goal: jax.ShapeDtypeStruct) -> None:
    """Raise `UserError` for a function that says something else of a goal than bool or a whole number."""
    if use_of is None:
        return
    use = checks.traced("use_of", lambda goal: jnp.asarray(use_of(goal)), goal)
    is_use = use.ndim == 0 and (use.dtype == bool or jnp.issubdtype(use.dtype, jnp.integer))
    require(is_use, "use_of", checks.described(use), f"return bool [], or int32 []: a position in {USES}")


def checked_seen(space: "GoalBox", goal: jax.ShapeDtypeStruct) -> None:
    """Raise `UserError` unless the goal encoder sees one vector float32 [F] or image uint8 [H, W, C] of each goal."""
    one = checks.traced("seen", space.inputs_of, goal)
    kind = (str(one.dtype), one.ndim) if checks.is_array(one) else None
    fits = kind in (("float32", 1), ("uint8", 3)) and 0 not in one.shape
    require(fits, "seen", checks.described(one), "return float32 [..., F], or images uint8 [..., H, W, C]")
    is_image = one.ndim == 3
    require(
        not (is_image and one.shape[0] <= MOST_CHANNELS < one.shape[2]),
        "seen",
        checks.described(one),
        "give images with their channels last",
    )
    for axes in ((2,), (2, 3)):
        several = checks.traced("seen", space.inputs_of, checks.with_axes(goal, axes))
        checks.returned(several, "seen", checks.Spec((*axes, *one.shape), str(one.dtype)), f"for goals {[*axes, 'D']}")


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
    repeated = next((name for name, times in Counter(names).items() if times > 1), None)
    require(repeated is None, field, repeated, "is there twice; give each a name of its own")
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
