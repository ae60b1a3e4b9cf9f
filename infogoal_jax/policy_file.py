"""Read and run an exported policy with NumPy alone. `infogoal export RUN` writes the file; this module needs nothing
else of the package, so that it can be copied beside a policy onto a robot's computer.

The file is an npz. `program` (JSON) lists the operations of the policy's network in order, in the names of JAX's
primitives; `constant_I` are its parameters; `about` (JSON) says what the policy was trained for; `goals` are the inputs
of goals that are known by name. Observations and goals that are vectors are given in the units of the task.
"""

import io
import json
import math
import os
import stat
import zipfile

import numpy as np

FORMAT = 1
"""Version of the file's format."""
MOST = 2**30
"""Bytes that a file has and unpacks to at most, and elements of an array."""
KINDS = ("bool", "uint8", "int32", "uint32", "int64", "float32", "float64")
"""Types of inputs."""


def contract(library, left, right, dimension_numbers, preferred_element_type=None):
    """The product of two arrays over the dimensions that JAX's dot_general names, added up in the preferred type."""
    if preferred_element_type not in (None, left.dtype):
        left, right = left.astype(preferred_element_type), right.astype(preferred_element_type)
    (left_sum, right_sum), (left_batch, right_batch) = dimension_numbers
    if not left_batch:
        return library.tensordot(left, right, (left_sum, right_sum))
    names = iter("abcdefghijklmnopqrstuvwxyz")
    left_names = [next(names) for _ in left.shape]
    shared = dict(zip(right_sum + right_batch, left_sum + left_batch, strict=True))
    right_names = [left_names[shared[axis]] if axis in shared else next(names) for axis in range(right.ndim)]
    batch = [left_names[axis] for axis in left_batch]
    free = [name for name in left_names if name not in right_names] + [n for n in right_names if n not in left_names]
    return library.einsum(f"{''.join(left_names)},{''.join(right_names)}->{''.join(batch + free)}", left, right)


def broadcast(library, x, shape, broadcast_dimensions):
    """The array with the dimensions of `shape`, its own at the places `broadcast_dimensions`."""
    own = dict(zip(broadcast_dimensions, x.shape, strict=True))
    return library.broadcast_to(x.reshape([own.get(axis, 1) for axis in range(len(shape))]), shape)


def divide(library, x, y):
    """The quotient, of integers without its fraction."""
    return library.divide(x, y) if x.dtype.kind not in "iu" else (x - library.fmod(x, y)) // y


def pad(library, x, value, padding_config):
    """The array with as many of this value before and after it along each axis, or fewer elements of its own."""
    if any(between for _, _, between in padding_config):
        raise ValueError("values between elements are not known")
    x = library.pad(x, [(max(low, 0), max(high, 0)) for low, high, _ in padding_config], constant_values=value)
    ends = zip(x.shape, padding_config, strict=True)
    return x[tuple(slice(max(-low, 0), size - max(-high, 0)) for size, (low, high, _) in ends)]


def rounded(library, x, rounding_method):
    """The nearest whole number, as a float; of halves the even one where the method is 1, else the farther from 0."""
    even, whole = library.rint(x), library.trunc(x)
    return even if rounding_method == 1 else library.where(abs(x - whole) == 0.5, whole + library.sign(x), even)


def select(library, which, first, *cases):
    """For each element the case of its number, bool or int."""
    for number, case in enumerate(cases, 1):
        first = library.where(which if which.dtype == bool else which == number, case, first)
    return first


def gather(library, x, places, dimension_numbers, slice_sizes, mode=None, fill_value=None):
    """The slices of `x` of these sizes that begin at `places` [..., K], as JAX's gather lays them out. One that would
    go beyond `x` is moved inside, or filled where the mode says so."""
    offset, collapsed, mapped, batched, batches = dimension_numbers
    rest = [axis for axis in range(places.ndim - 1 + len(offset)) if axis not in offset]
    kept = [axis for axis in range(x.ndim) if axis not in (*collapsed, *batched)]
    sizes = dict(zip(rest, places.shape[:-1], strict=True))
    sizes |= dict(zip(offset, (slice_sizes[axis] for axis in kept), strict=True))
    shape = [sizes[axis] for axis in range(len(sizes))]
    index, inside = [0] * x.ndim, True
    for number, axis in enumerate(mapped):
        first, last = places[..., number], x.shape[axis] - slice_sizes[axis]
        index[axis] = broadcast(library, library.clip(first, 0, last), shape, rest)
        inside = inside & broadcast(library, (first >= 0) & (first <= last), shape, rest)
    for axis, batch in zip(batched, batches, strict=True):
        index[axis] = broadcast(library, library.arange(x.shape[axis]), shape, [rest[batch]])
    for axis, at in zip(kept, offset, strict=True):
        index[axis] = index[axis] + broadcast(library, library.arange(slice_sizes[axis]), shape, [at])
    found = x[tuple(index)]
    return found if mode != "FILL_OR_DROP" else library.where(inside, found, library.asarray(fill_value, x.dtype))


def dynamic_slice(library, x, starts, slice_sizes):
    """The slice of these sizes that begins at numbers `starts`, one for each axis, moved inside."""
    axes = list(range(x.ndim))
    return gather(library, x, library.stack(starts), [axes, [], axes, [], []], slice_sizes)


NUMPY = {
    "add": "add", "add_any": "add", "sub": "subtract", "mul": "multiply", "max": "maximum", "min": "minimum",
    "neg": "negative", "abs": "absolute", "sign": "sign", "exp": "exp", "exp2": "exp2", "log": "log", "log1p": "log1p",
    "expm1": "expm1", "sqrt": "sqrt", "cbrt": "cbrt", "square": "square", "is_finite": "isfinite",
    "and": "bitwise_and", "or": "bitwise_or", "xor": "bitwise_xor", "not": "invert", "eq": "equal", "ne": "not_equal",
    "lt": "less", "le": "less_equal", "gt": "greater", "ge": "greater_equal", "stop_gradient": "positive",
    "sin": "sin", "cos": "cos", "tan": "tan", "asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2",
    "sinh": "sinh", "cosh": "cosh", "tanh": "tanh", "asinh": "arcsinh", "acosh": "arccosh", "atanh": "arctanh",
    "floor": "floor", "ceil": "ceil", "rem": "fmod",
}  # fmt: skip


def operations(library):
    """JAX's primitives, those that networks of this package are made of, in a library with the functions of NumPy, as
    jax.numpy is one."""
    return {name: lambda *x, own=own, **_: getattr(library, own)(*x) for name, own in NUMPY.items()} | {
        "copy": lambda x, **_: x,
        "div": lambda x, y, **_: divide(library, x, y),
        "pow": lambda x, y, **_: library.power(x, y.astype(x.dtype)),
        "rsqrt": lambda x, **_: 1 / library.sqrt(x),
        "logistic": lambda x, **_: 1 / (1 + library.exp(-x)),
        "integer_pow": lambda x, y, **_: x**y,
        "select_n": lambda *x, **_: select(library, *x),
        "convert_element_type": lambda x, new_dtype, **_: x.astype(new_dtype),
        "reshape": lambda x, new_sizes, **_: x.reshape(new_sizes),
        "squeeze": lambda x, dimensions, **_: library.squeeze(x, tuple(dimensions)),
        "expand_dims": lambda x, dimensions, **_: library.expand_dims(x, tuple(dimensions)),
        "transpose": lambda x, permutation, **_: x.transpose(permutation),
        "broadcast_in_dim": lambda x, shape, broadcast_dimensions, **_: broadcast(
            library, x, shape, broadcast_dimensions
        ),
        "concatenate": lambda *x, dimension, **_: library.concatenate(x, dimension),
        "stack": lambda *x, axis, **_: library.stack(x, axis),
        "split": lambda x, sizes, axis, **_: library.split(x, np.cumsum(sizes)[:-1], axis),
        "unstack": lambda x, axis, **_: list(library.moveaxis(x, axis, 0)),
        "pad": lambda x, value, padding_config, **_: pad(library, x, value, padding_config),
        "slice": lambda x, start_indices, limit_indices, strides=None, **_: x[
            tuple(map(slice, start_indices, limit_indices, strides or [1] * x.ndim))
        ],
        "reduce_sum": lambda x, axes, **_: x.sum(tuple(axes), x.dtype),
        "reduce_max": lambda x, axes, **_: x.max(tuple(axes)),
        "cumsum": lambda x, axis, reverse, **_: (
            library.flip(library.flip(x, axis).cumsum(axis, x.dtype), axis) if reverse else x.cumsum(axis, x.dtype)
        ),
        "rev": lambda x, dimensions, **_: library.flip(x, tuple(dimensions)),
        "round": lambda x, rounding_method, **_: rounded(library, x, rounding_method),
        "clamp": lambda low, x, high, **_: library.clip(x, low, high),
        "reduce_min": lambda x, axes, **_: x.min(tuple(axes)),
        "reduce_prod": lambda x, axes, **_: x.prod(tuple(axes), x.dtype),
        "reduce_and": lambda x, axes, **_: library.bitwise_and.reduce(x, tuple(axes)),
        "reduce_or": lambda x, axes, **_: library.bitwise_or.reduce(x, tuple(axes)),
        "argmax": lambda x, axes, index_dtype, **_: x.argmax(*axes).astype(index_dtype),
        "argmin": lambda x, axes, index_dtype, **_: x.argmin(*axes).astype(index_dtype),
        "gather": lambda x, places, dimension_numbers, slice_sizes, mode=None, fill_value=None, **_: gather(
            library, x, places, dimension_numbers, slice_sizes, mode, fill_value
        ),
        "dynamic_slice": lambda x, *starts, slice_sizes, **_: dynamic_slice(library, x, starts, slice_sizes),
        "dot_general": lambda left, right, dimension_numbers, preferred_element_type=None, **_: contract(
            library, left, right, dimension_numbers, preferred_element_type
        ),
    }


OPERATIONS = operations(np)


def run_program(program, constants, arguments, operations=OPERATIONS):
    """What a program gives for these arguments: a list of arrays."""
    known = dict(enumerate(constants)) | dict(zip(program["inputs"][0], arguments, strict=True))
    for name, inputs, outputs, settings in program["operations"]:
        results = operations[name](*(known[place] for place in inputs), **settings)
        known.update(zip(outputs, results if name in ("split", "unstack") else [results], strict=True))
    return [known[place] for place in program["outputs"]]


def members_of(path):
    """The arrays of an npz, by name. Raises `OSError` if it cannot be read, `ValueError` if it is none, or unpacks to
    more than a policy has."""
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise ValueError(f"{path}: is no regular file")
    with open(path, "rb") as file:
        content = io.BytesIO(file.read(MOST + 1))  # NumPy leaves a damaged file open.
    try:
        with zipfile.ZipFile(content) as packed:
            sizes = {info.filename: info.file_size for info in packed.infolist()}
        if max(len(content.getvalue()), sum(sizes.values())) > MOST:
            raise ValueError(f"it has, or unpacks to, more than {MOST:,} bytes")
        with np.load(content, allow_pickle=False) as file:
            members = {name: file[name] for name in file.files}
        for name, array in members.items():
            if not isinstance(array, np.ndarray) or array.size > MOST:
                raise ValueError(f"{name[:100]} is no array")
        return members
    except Exception as error:  # NumPy and zipfile raise a dozen types between them on a damaged file.
        raise ValueError(f"{path}: is no policy of `infogoal export` ({error})") from error


def check(about, program):
    """Raise `ValueError` unless these are what a policy says of itself, and a program that can be run: of a known
    format, and with operations that are known, on arrays that are there."""

    def wants(condition, name):
        if not condition:
            raise ValueError(name)

    def whole(value, most):
        return type(value) is int and 0 <= value <= most

    def wholes(values):
        return type(values) is list and all(whole(value, MOST) for value in values)

    wants(type(about) is dict and type(program) is dict, "about and program should be objects")
    version = about.get("format_version")
    wants(version == FORMAT, f"format_version = {str(version)[:100]}: this reader has that of version {FORMAT}")
    wants(whole(about.get("code_size"), 2**20), "code_size should be a whole number")
    wants(type(about.get("discrete", True)) is bool, "discrete should be true or false")
    corners = [about.get(name, []) for name in ("goal_low", "goal_high")]
    numbers = all(type(corner) is list and all(type(one) in (int, float) for one in corner) for corner in corners)
    wants(numbers and len(corners[0]) == len(corners[1]), "goal_low and goal_high should be as many numbers")
    wants(whole(about.get("interval", 1), MOST) and about.get("interval", 1) > 0, "interval should be 1 or more")
    wants(whole(program.get("constants"), 10**5), "constants should be a whole number")
    inputs, operations = program.get("inputs"), program.get("operations")
    two = type(inputs) is list and len(inputs) == 2 and wholes(inputs[0]) and type(inputs[1]) is list
    wants(two and len(inputs[0]) == len(inputs[1]) >= 3, "inputs should be places and as many kinds, three or more")
    for kind in inputs[1]:
        wants(type(kind) is list and len(kind) == 2 and wholes(kind[0]) and kind[1] in KINDS, "a kind of input")
        wants(math.prod(kind[0]) <= MOST, "an input's shape")
    known = {*range(program["constants"]), *inputs[0]}
    wants(type(operations) is list, "operations should be a list")
    for operation in operations:
        four = type(operation) is list and len(operation) == 4
        wants(four and type(operation[3]) is dict and wholes(operation[1]) and wholes(operation[2]), "an operation")
        name, given, results, settings = operation
        wants(type(name) is str and name in OPERATIONS, f"operation {str(name)[:100]!r} is not known")
        wants(known.issuperset(given), f"{name} has an argument that is not there")
        for setting in ("shape", "new_sizes", "slice_sizes"):
            wants(wholes(settings.get(setting, [])) and math.prod(settings.get(setting, [])) <= MOST, setting)
        known.update(results)
    outputs = program.get("outputs")
    wants(wholes(outputs) and outputs and known.issuperset(outputs), "outputs should be places of arrays")


class ExportedPolicy:
    """A policy: `values` and `act` where actions are discrete, else `drive`. about: dict; goals: float32 or uint8 [N,
    ...], or None."""

    def __init__(self, path):
        """Read the policy in this file. Raises `OSError` if it cannot be read, `ValueError` if it is none of this
        format."""
        members = members_of(path)
        try:
            if not {"about", "program"} <= members.keys():
                raise ValueError("about or program is missing")
            self.about, self.program = (json.loads(str(members[name])) for name in ("about", "program"))
            check(self.about, self.program)
            self.goals = members.get("goals")
            self.constants = [members[f"constant_{index}"] for index in range(self.program["constants"])]
        except (KeyError, RecursionError, ValueError) as error:
            raise ValueError(f"{path}: is no policy of `infogoal export` ({error})") from error

    def run(self, *arguments):
        """What the program gives for these arguments: a list of arrays."""
        given = []
        for kind, value in zip(self.program["inputs"][1], arguments, strict=True):
            shape, dtype = kind
            value = np.asarray(value)
            if value.dtype.kind == np.dtype(dtype).kind == "f":
                value = value.astype(dtype)
            if list(value.shape) != shape or value.dtype != dtype:
                raise ValueError(f"an array of shape {value.shape} and type {value.dtype}; wants {shape}, {dtype}")
            if value.dtype.kind == "f" and not np.isfinite(value).all():
                raise ValueError(f"{value.tolist()}: not finite, of which no action follows")
            given.append(value)
        return [np.asarray(array) for array in run_program(self.program, self.constants, given)]

    def mean(self):
        """No noise: the code of a goal is its mean."""
        return np.zeros(self.about["code_size"], np.float32)

    def goal(self, goal):
        """The goal as the program takes it. Raises `ValueError` for a vector that is no goal of the task."""
        low = self.about.get("goal_low")
        if low is None:
            return goal
        goal, low, high = (np.asarray(each, np.float32) for each in (goal, low, self.about["goal_high"]))
        if goal.shape != low.shape or not ((goal >= low - 1e-6) & (goal <= high + 1e-6)).all():
            raise ValueError(f"goal = {goal.tolist()}: give {len(low)} numbers from {low.tolist()} to {high.tolist()}")
        return goal

    def check_actions(self, discrete):
        """Raise ValueError if the policy's actions are of the other kind."""
        if self.about.get("discrete", discrete) != discrete:
            raise ValueError(f"actions are {'vectors: call drive' if discrete else 'choices: call act'}")

    def values(self, observation, goal, noise=None):
        """The value of every action, float32 [A]: an observation, the input of a goal or the vector that it is, and
        standard normal numbers [d] for a sample of its code; None for the code's mean."""
        self.check_actions(discrete=True)
        return self.run(observation, self.goal(goal), self.mean() if noise is None else noise)[0]

    def act(self, observation, goal, action_mask=None, noise=None):
        """The legal action with the highest value, int. action_mask: bool [A]; None: all are legal."""
        values = self.values(observation, goal, noise)
        return int(np.where(True if action_mask is None else action_mask, values, -np.inf).argmax())

    def drive(self, observation, goal, step, target=None, noise=None, body=None):
        """The action at this step of an episode, and the target to give with the next one; without a target one is
        chosen. body: where the robot is,
        where the observation does not say it, as an image does not: the angles of its joints."""
        self.check_actions(discrete=False)
        decides = np.bool_(target is None or step % self.about.get("interval", 1) == 0)
        target = np.zeros(self.program["inputs"][1][4][0], np.float32) if target is None else target
        body = observation if body is None else body
        return tuple(
            self.run(observation, self.goal(goal), self.mean() if noise is None else noise, body, target, decides)
        )
