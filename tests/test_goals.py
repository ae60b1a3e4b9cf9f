"""A goal set is one, or the field that is wrong is named with the shape that is right."""

import numpy as np
import pytest

from infogoal_jax import UserError
from infogoal_jax.goals import GoalSet

VECTORS = np.arange(12, dtype=np.float32).reshape(3, 4)
IMAGES = np.zeros((3, 8, 6, 3), np.uint8)
FIT = {"inputs": VECTORS, "regions": [0, 0, 1], "uses": [0, 0, 2], "names": ("a", "b", "c"), "region_names": ("x", "y")}


def with_one(array, value):
    """The array with one number replaced."""
    changed = np.array(array)
    changed[1, 2] = value
    return changed


@pytest.mark.parametrize(
    "inputs",
    [VECTORS, VECTORS.tolist(), VECTORS.astype(np.float64), VECTORS.astype(np.float16), IMAGES, IMAGES[..., :1]],
)
def test_vectors_and_images_are_inputs(inputs):
    """Whatever they were given as, they are arrays of one of two types."""
    goals = GoalSet.of(**FIT | {"inputs": inputs})
    assert goals.inputs.dtype == (np.uint8 if np.ndim(inputs) == 4 else np.float32)
    assert goals.inputs.shape == np.shape(inputs) and isinstance(goals.regions.shape, tuple)
    np.testing.assert_array_equal(goals.inputs, inputs)
    np.testing.assert_array_equal(goals.training_goals, [0, 1])


def test_goals_may_share_inputs():
    goals = GoalSet.of(**FIT | {"rows": [2, 2, 0]})
    np.testing.assert_array_equal(goals.inputs_of(np.arange(3)), VECTORS[[2, 2, 0]])


REFUSED = [
    ("inputs", with_one(VECTORS, np.nan), r"inputs\[1, 2\] = nan: give finite numbers"),
    ("inputs", with_one(VECTORS, -np.inf), r"inputs\[1, 2\] = -inf: give finite numbers"),
    ("inputs", VECTORS.astype(np.float64) * 1e300, "float32 cannot hold them"),
    ("inputs", IMAGES.astype(np.float32), r"inputs = float32 \[3, 8, 6, 3\]: give images as uint8 from 0 to 255"),
    ("inputs", IMAGES.transpose(0, 3, 1, 2), r"channels last, uint8 \[3, 8, 6, 3\]"),
    ("inputs", IMAGES[..., 0], r"give images uint8 \[M, H, W, C\]: here \[3, 8, 6, 1\]"),
    ("inputs", [0.1, 0.2, 0.3], r"give vectors float32 \[3, 1\]"),
    ("inputs", 1.0, "give vectors float32"),
    ("inputs", [[1.0, 2.0], [3.0]], "inputs: give vectors float32"),
    ("inputs", VECTORS.astype(int), r"give vectors as float32 \[3, 4\]"),
    ("inputs", VECTORS > 1, "give vectors float32"),
    ("inputs", VECTORS + 1j, "give vectors float32"),
    ("inputs", [["a"], ["b"], ["c"]], "give vectors float32"),
    ("inputs", None, "give vectors float32"),
    ("inputs", VECTORS[:, :0], "no empty axis"),
    ("inputs", np.ma.masked_less(VECTORS, 2), "without a mask"),
    ("inputs", VECTORS[:2], "inputs = 2: give one for each of the 3 goals"),
    ("inputs", np.zeros((3, 2, 2, 2, 3), np.uint8), "give vectors float32"),
    ("names", ("a", "b", "a"), "names = 'a': is there twice"),
    ("names", ("a", "b"), "names = 2: give one for each"),
    ("names", "abc", "names = 'abc': give a tuple of names"),
    ("names", (1, 2, 3), "names = .*give a tuple of names"),
    ("names", None, "names = None: give a tuple of names"),
    ("region_names", ("x", "x"), "region_names = 'x': is there twice"),
    ("regions", [0, 0, 2], "region_names has the regions 0 to 1"),
    ("regions", [0, 0, -1], "region_names has the regions 0 to 1"),
    ("regions", [0.0, 0.0, 1.0], "regions = an array of float64"),
    ("regions", [0, 1], "regions = 2: give one for each"),
    ("regions", [[0], [0], [1]], r"regions = an array of int64 \[3, 1\]"),
    ("regions", 0, "regions = an array of int64"),
    ("uses", [0, 0, 3], "uses = .*give positions in"),
    ("uses", ["train", "train", "test"], "uses = .*give positions in"),
    ("uses", [True, False, True], "uses = an array of bool"),
    ("uses", [], "uses = .*give positions in"),
    ("uses", 0, "uses = .*give positions in"),
    ("rows", [0, 1, 3], "rows = .*there are 3 inputs"),
    ("rows", [0, 1], "rows = 2: give one for each"),
    ("rows", [0.0, 1.0, 2.0], "rows = an array of float64"),
]


@pytest.mark.parametrize(("field", "value", "message"), REFUSED)
def test_what_does_not_fit_is_named(field, value, message):
    with pytest.raises(UserError, match=message):
        GoalSet.of(**FIT | {field: value})
