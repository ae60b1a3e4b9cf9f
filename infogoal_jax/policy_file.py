"""Read and run an exported policy with NumPy alone. `infogoal export RUN` writes the file; this module needs nothing
else of the package, so that it can be copied beside a policy onto a robot's computer.

The file is an npz. `program` (JSON) lists the operations of the policy's network in order, in the names of JAX's
primitives; `constant_I` are its parameters; `about` (JSON) says what the policy was trained for; `goals` are the inputs
of goals that are known by name.
"""

import io
import json

import numpy as np


def contract(left, right, dimension_numbers, **_):
    """The product of two arrays over the dimensions that JAX's dot_general names."""
    (left_sum, right_sum), (left_batch, right_batch) = dimension_numbers
    if not left_batch:
        return np.tensordot(left, right, (left_sum, right_sum))
    names = iter("abcdefghijklmnopqrstuvwxyz")
    left_names = [next(names) for _ in left.shape]
    shared = dict(zip(right_sum + right_batch, left_sum + left_batch, strict=True))
    right_names = [left_names[shared[axis]] if axis in shared else next(names) for axis in range(right.ndim)]
    batch = [left_names[axis] for axis in left_batch]
    free = [name for name in left_names if name not in right_names] + [n for n in right_names if n not in left_names]
    return np.einsum(f"{''.join(left_names)},{''.join(right_names)}->{''.join(batch + free)}", left, right)


def broadcast(x, shape, broadcast_dimensions, **_):
    """The array with the dimensions of `shape`, its own at the places `broadcast_dimensions`."""
    own = dict(zip(broadcast_dimensions, x.shape, strict=True))
    return np.broadcast_to(x.reshape([own.get(axis, 1) for axis in range(len(shape))]), shape)


NUMPY = {
    "add": "add", "add_any": "add", "sub": "subtract", "mul": "multiply", "div": "divide", "max": "maximum",
    "min": "minimum", "neg": "negative", "abs": "absolute", "sign": "sign", "exp": "exp", "log": "log",
    "log1p": "log1p", "expm1": "expm1", "tanh": "tanh", "sqrt": "sqrt", "square": "square", "pow": "power",
    "is_finite": "isfinite", "and": "logical_and", "or": "logical_or", "not": "logical_not", "eq": "equal",
    "ne": "not_equal", "lt": "less", "le": "less_equal", "gt": "greater", "ge": "greater_equal",
    "stop_gradient": "positive", "sin": "sin", "cos": "cos", "floor": "floor", "rem": "fmod",
}  # fmt: skip
OPERATIONS = {name: lambda *x, as_in=as_in, **_: getattr(np, as_in)(*x) for name, as_in in NUMPY.items()} | {
    "copy": lambda x, **_: x,
    "rsqrt": lambda x, **_: 1 / np.sqrt(x),
    "logistic": lambda x, **_: 1 / (1 + np.exp(-x)),
    "integer_pow": lambda x, y, **_: x**y,
    "select_n": lambda which, *cases, **_: np.choose(which.astype(int), cases),
    "convert_element_type": lambda x, new_dtype, **_: x.astype(new_dtype),
    "reshape": lambda x, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, dimensions, **_: np.squeeze(x, tuple(dimensions)),
    "expand_dims": lambda x, dimensions, **_: np.expand_dims(x, tuple(dimensions)),
    "transpose": lambda x, permutation, **_: x.transpose(permutation),
    "broadcast_in_dim": broadcast,
    "concatenate": lambda *x, dimension, **_: np.concatenate(x, dimension),
    "split": lambda x, sizes, axis, **_: np.split(x, np.cumsum(sizes)[:-1], axis),
    "unstack": lambda x, axis, **_: list(np.moveaxis(x, axis, 0)),
    "slice": lambda x, start_indices, limit_indices, strides=None, **_: x[
        tuple(map(slice, start_indices, limit_indices, strides or [1] * x.ndim))
    ],
    "reduce_sum": lambda x, axes, **_: x.sum(tuple(axes)),
    "reduce_max": lambda x, axes, **_: x.max(tuple(axes)),
    "clamp": lambda low, x, high, **_: np.clip(x, low, high),
    "argmax": lambda x, axes, index_dtype, **_: x.argmax(*axes).astype(index_dtype),
    "reduce_min": lambda x, axes, **_: x.min(tuple(axes)),
    "dot_general": contract,
}
"""JAX's primitives in NumPy: those that networks of this package are made of."""


class ExportedPolicy:
    """A policy: `values` and `act` where actions are discrete, else `drive`. about: dict; goals: float32 or uint8 [N,
    ...], or None."""

    def __init__(self, path):
        with open(path, "rb") as file:
            content = io.BytesIO(file.read())  # NumPy leaves a damaged file open.
        with np.load(content, allow_pickle=False) as file:
            if not {"about", "program"} <= {*file}:
                raise ValueError(f"{path}: is no policy of `infogoal export`")
            self.about, self.program = json.loads(str(file["about"])), json.loads(str(file["program"]))
            self.goals = file.get("goals")
            self.constants = [file[f"constant_{index}"] for index in range(self.program["constants"])]

    def run(self, *arguments):
        """What the program gives for these arguments: a list of arrays."""
        known = dict(enumerate(self.constants))
        for place, kind, value in zip(*self.program["inputs"], arguments, strict=True):
            shape, dtype = kind
            value = np.asarray(value)
            if value.dtype.kind == np.dtype(dtype).kind == "f":
                value = value.astype(dtype)
            if list(value.shape) != shape or value.dtype != dtype:
                raise ValueError(f"an array of shape {value.shape} and type {value.dtype}; wants {shape}, {dtype}")
            known[place] = value
        for name, inputs, outputs, settings in self.program["operations"]:
            results = OPERATIONS[name](*(known[place] for place in inputs), **settings)
            known.update(zip(outputs, results if name in ("split", "unstack") else [results], strict=True))
        return [np.asarray(known[place]) for place in self.program["outputs"]]

    def mean(self):
        """No noise: the code of a goal is its mean."""
        return np.zeros(self.about["code_size"], np.float32)

    def check_actions(self, discrete):
        """Raise ValueError if the policy's actions are of the other kind."""
        if self.about.get("discrete", discrete) != discrete:
            raise ValueError(f"actions are {'vectors: call drive' if discrete else 'choices: call act'}")

    def values(self, observation, goal, noise=None):
        """The value of every action, float32 [A]: an observation as the network sees it, the input of a goal and
        standard normal numbers [d] for a sample of its code; None for the code's mean."""
        return self.run(observation, goal, self.mean() if noise is None else noise)[0]

    def act(self, observation, goal, action_mask=None, noise=None):
        """The legal action with the highest value, int. action_mask: bool [A]; None: all are legal."""
        self.check_actions(discrete=True)
        values = self.values(observation, goal, noise)
        return int(np.where(True if action_mask is None else action_mask, values, -np.inf).argmax())

    def drive(self, observation, goal, step, target=None, noise=None, body=None):
        """The action at this step of an episode, and the target to give with the next one. body: where the robot is,
        where the observation does not say it, as an image does not: the angles of its joints."""
        self.check_actions(discrete=False)
        decides = np.bool_(step % self.about["interval"] == 0)
        target = np.zeros(self.program["inputs"][1][4][0], np.float32) if target is None else target
        body = observation if body is None else body
        return tuple(self.run(observation, goal, self.mean() if noise is None else noise, body, target, decides))
