"""Checks of what a user gives to a public function: type, range, shape, and whether numbers are finite. Each raises
`UserError` with the field, the value and what to give instead, and returns the value as the function needs it.

All look at values before anything is traced or compiled. Of what is traced, inside of a jitted function, there is no
value: shape and type alone are looked at.
"""

import inspect
import math
import numbers
import os
import sys
import traceback
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import xla_bridge  # No public function says whether JAX has started without starting it.

from infogoal_jax.errors import UserError, reason, require, shown
from infogoal_jax.keys import is_key

MOST_ENVS = 2**20
"""Of environments side by side: more than any device steps."""
MOST_SEEDS = 2**32
"""Seeds are words of 32 bits."""
Kind = Literal["whole numbers", "numbers", "flags"]
KINDS = {"whole numbers": "iu", "numbers": "iuf", "flags": "b"}
"""The kinds of array that are told apart, by NumPy's letters for their types."""


def whole(value: Any, field: str, low: int | None = None, high: int | None = None, remedy: str = "") -> int:
    """A whole number of Python or NumPy, from `low` to `high`, as one of Python."""
    remedy = remedy or f"give a whole number{span(low, high)}"
    fits = isinstance(value, numbers.Integral) and not isinstance(value, bool | np.bool_)
    require(fits and (low is None or value >= low) and (high is None or value <= high), field, value, remedy)
    return int(value)


def number(value: Any, field: str, low: float | None = None, high: float | None = None, remedy: str = "") -> float:
    """A finite number of Python or NumPy, from `low` to `high`, as one of Python."""
    remedy = remedy or f"give a number{span(low, high)}"
    fits = isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)
    require(fits and is_finite(value), field, value, remedy)
    require((low is None or value >= low) and (high is None or value <= high), field, value, remedy)
    return float(value)


def is_finite(value: numbers.Real) -> bool:
    """Whether the number is finite as a float."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def span(low: float | None, high: float | None) -> str:
    """The end of a remedy: ` from 0 to 1`."""
    ends = "" if low is None else f" from {low}"
    return ends + (" on" if low is not None and high is None else "" if high is None else f" to {high}")


def flag(value: Any, field: str) -> bool:
    """True or False."""
    require(isinstance(value, bool | np.bool_), field, value, "give True or False")
    return bool(value)


def text(value: Any, field: str, remedy: str) -> str:
    """Text."""
    require(isinstance(value, str), field, value, remedy)
    return value


def path(value: Any, field: str, remedy: str = "give a path") -> Any:
    """A path, as text or as an object of a path; not an empty one, which would name the folder that one is in."""
    is_path = isinstance(value, str | os.PathLike) and isinstance(os.fspath(value), str)
    require(is_path and os.fspath(value) != "" and "\0" not in os.fspath(value), field, value, remedy)
    try:
        os.fsencode(value)
    except UnicodeEncodeError as error:
        raise UserError(f"{field} = {shown(value)}: has half of a character in it; {remedy}") from error
    return value


def seed(value: Any) -> int:
    """A seed from 0 to below 2^32."""
    return whole(value, "seed", 0, MOST_SEEDS - 1, "give a whole number from 0 to below 2^32")


def function(value: Any, field: str, arguments: int, remedy: str) -> Callable:
    """A function that can be called with this many arguments by position."""
    require(callable(value), field, value, remedy)
    try:
        inspect.signature(value).bind(*[None] * arguments)
    except TypeError as error:
        cannot = f"cannot be called with {arguments} arguments ({error})"
        raise UserError(f"{field} = {shown(value)}: {cannot}; {remedy}") from error
    except ValueError:  # A function of C tells nothing of its arguments.
        pass
    return value


def is_traced(value: Any) -> bool:
    """Whether any leaf is traced, and has no value to look at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))


def array(
    value: Any, field: str, kind: Kind, shape: tuple[Any, ...] | None = None, remedy: str = "", finite: bool = True
) -> Any:
    """An array of NumPy or JAX, or nested lists of numbers, of this kind and, where one is asked for, this shape.

    shape: a length for each axis, or a name where any length is right; `...` stands for any axes. finite: whether
    numbers have to be.
    Returns an array of the value, of JAX where it was one.
    """
    axes = "" if shape is None else f" [{', '.join('...' if axis is Ellipsis else str(axis) for axis in shape)}]"
    wanted = remedy or f"give {kind}{axes}"
    if not isinstance(value, np.ndarray | jax.Array):
        try:
            value = np.asarray(value)
        except (TypeError, ValueError) as error:
            raise UserError(f"{field}: {wanted}, not {type(value).__name__} of several shapes") from error
    described = f"an array of {value.dtype} {list(value.shape)}"
    letter = "f" if value.dtype == jnp.bfloat16 else getattr(value.dtype, "kind", "O")
    require(not isinstance(value, np.ma.MaskedArray), field, "a masked array", f"{wanted}, without a mask")
    if letter not in KINDS[kind] or (shape is not None and not has_shape(value.shape, shape)):
        raise UserError(f"{field} = {described}: {wanted}")
    if finite and letter == "f" and not is_traced(value):
        found = np.asarray(value, np.float64 if value.dtype != np.longdouble else np.longdouble)
        if not np.isfinite(found).all():
            place = tuple(int(index) for index in np.argwhere(~np.isfinite(found))[0])
            raise UserError(f"{field}{list(place) if place else ''} = {found[place]}: give finite numbers")
    return value


def as_float32(value: Any, field: str) -> np.ndarray:
    """An array of finite numbers, which `array` has looked at, as float32. Raises `UserError` for one that becomes
    infinite."""
    with np.errstate(over="ignore"):
        found = np.asarray(value, np.float32)
    require(bool(np.isfinite(found).all()), field, value, "give finite numbers that float32 holds")
    return found


def has_shape(found: tuple[int, ...], asked: tuple[int | str | None, ...]) -> bool:
    """Whether the shape is the one that is asked for, see `array`."""
    if Ellipsis in asked or "..." in asked:
        place = next(axis for axis, length in enumerate(asked) if length in (Ellipsis, "..."))
        before, after = asked[:place], asked[place + 1 :]
        if len(found) < len(before) + len(after):
            return False
        return has_shape(found[: len(before)], before) and has_shape(found[len(found) - len(after) :], after)
    return len(found) == len(asked) and all(
        not isinstance(length, int) or length == own for own, length in zip(found, asked, strict=True)
    )


def key(value: Any) -> jax.Array:
    """One key of `jax.random`, typed or raw."""
    one = isinstance(value, jax.Array) and (
        value.shape == () if is_key(value) else value.dtype == jnp.uint32 and value.ndim == 1
    )
    require(one, "key", value, "give one key, such as jax.random.key(0); for several see jax.vmap")
    return value


def shapes(tree: Any) -> dict[str, tuple[tuple[int, ...], str]]:
    """The shape and type of every leaf, by its path."""
    return {
        jax.tree_util.keystr(path) or "itself": (tuple(np.shape(leaf)), str(jnp.result_type(leaf)))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def same_shapes(found: Any, expected: Any, name: str, other: str) -> None:
    """Raise `UserError` naming both, and the first leaf that differs, unless two trees have the same leaves of the same
    shapes and types."""
    mine, wanted = shapes(found), shapes(expected)
    for leaf in [*wanted, *mine]:
        if mine.get(leaf) != wanted.get(leaf):
            first, second = (written(*have[leaf]) if leaf in have else "not there" for have in (mine, wanted))
            raise UserError(f"{name}: leaf {leaf} is {first}, and {second} in {other}; give both the same")


def written(shape: tuple[Any, ...], dtype: str) -> str:
    """A shape and a type as docstrings write them: `float32 [3, 2]`."""
    return f"{dtype} [{', '.join(map(str, shape))}]"


class Spec(NamedTuple):
    """What an array has to be. shape: a length for each axis, or a name where any length is right."""

    shape: tuple[Any, ...]
    dtype: str

    @property
    def struct(self) -> jax.ShapeDtypeStruct:
        """For `jax.eval_shape`."""
        return jax.ShapeDtypeStruct(self.shape, self.dtype)


def is_array(value: Any) -> bool:
    """Whether it is one array, or the shape of one. Goals have a shape and a type as well."""
    return all(hasattr(value, name) for name in ("shape", "dtype", "ndim")) and not isinstance(value, np.generic)


def described(value: Any) -> str:
    """A value by shape and type, or by its class."""
    return written(value.shape, str(value.dtype)) if is_array(value) else f"{type(value).__name__}"


def returned(found: Any, name: str, wanted: Spec, reason: str = "") -> None:
    """Raise `UserError`, naming the function that returned it, unless what was found is an array as is wanted."""
    fits = is_array(found) and str(found.dtype) == wanted.dtype and has_shape(found.shape, wanted.shape)
    if not fits:
        why = f" ({reason})" if reason else ""
        raise UserError(f"{name}: is {described(found)}; give {written(*wanted)}{why}")


def with_axes(tree: Any, axes: tuple[int, ...]) -> Any:
    """Shapes with these axes in front."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*axes, *leaf.shape), leaf.dtype), tree)


def called(name: str, function: Callable, *arguments: Any) -> Any:
    """What a user's function returns. Raises `UserError`, naming it, where it raises anything else, which stands as the
    cause."""
    try:
        return function(*arguments)
    except UserError:
        raise
    except NotImplementedError as error:
        missing = f"{error} is" if str(error) else "is"
        raise UserError(f"{name}: {missing} not written, and the contract asks for it") from error
    except (Exception, SystemExit) as error:
        kind, colon, words = reason(error).partition(": ")
        raise UserError(f"{name}: raised {kind} when it was traced{colon}{words}{line_of(error)}") from error


def line_of(error: BaseException) -> str:
    """` (my_task.py, line 12)`: where somebody else's code raised an error, the last line of a file that is neither of
    this package, nor of an installed one, nor Python's own; empty without such a line."""
    own = {__name__.partition(".")[0], *sys.stdlib_module_names}
    theirs = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        file, module = frame.f_code.co_filename, frame.f_globals.get("__name__", "")
        if module.partition(".")[0] not in own and "-packages" not in file:
            theirs = f" ({file.rpartition('/')[2]}, line {line})"
    return theirs


def traced(name: str, function: Callable, *arguments: Any) -> Any:
    """The shapes of what a user's function returns for arguments of these shapes; raises as `called`."""
    return called(name, jax.eval_shape, function, *arguments)


class Fork:
    """Whether this process was forked from one in which JAX had started. Its threads are not there: whatever it
    computes would wait for them without end."""

    jax_had_started = False

    @classmethod
    def happens(cls) -> None:
        """Remember, in the process that is forked, what its child cannot ask later."""
        cls.jax_had_started = xla_bridge.backends_are_initialized()

    @classmethod
    def happened(cls) -> None:
        """In the parent a fork changes nothing."""
        cls.jax_had_started = False


os.register_at_fork(before=Fork.happens, after_in_parent=Fork.happened)


def not_forked() -> None:
    """Raise `UserError` in a process that was forked from one in which JAX had started."""
    if Fork.jax_had_started:
        raise UserError(
            "fork: this process is a copy of one in which JAX has started, whose threads it lacks: it would wait for "
            'them without end; give context="spawn" (AsyncVectorEnv(..., context="spawn")), or step a batch as one '
            "program: infogoal_jax.bridges.gymnasium.TaskVector, which gymnasium.make_vec makes"
        )
