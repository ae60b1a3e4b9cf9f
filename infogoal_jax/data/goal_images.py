"""Banks of goal images: pictures of a task's goals with the positions that they show (Sec. V-A.1), in one npz file.

A bank has a grid of goals that fills the goal space, so that every position reached has a picture near it, and goals
for training, validation and tests. The banks of three Fetch tasks are shipped; `infogoal reproduce goal-images` draws
others.
"""

import dataclasses
import json
import math
import os
import zipfile
from pathlib import Path

import numpy as np

from infogoal_jax.data import archives, members
from infogoal_jax.data.members import Member, check, fitting
from infogoal_jax.errors import UserError, require
from infogoal_jax.files import from_json
from infogoal_jax.goal_uses import MOST_GOALS

IMAGE_SHAPE = (64, 64, 3)
USES = ("grid", "train", "validation", "test")
"""What an image is for; `GoalImages.uses` holds indices into this."""
GRID, TRAIN, VALIDATION, TEST = range(4)
GRID_TOLERANCE = 1e-4
"""Positions of the grid may be off by this much, in m."""
SCHEMA = {
    "task": Member("text", ()),
    "about": Member("text", ()),
    "spacing": Member("number", ()),
    "grid_low": Member("number", (3,)),
    "grid_shape": Member("integer", (3,)),
    "images": Member("uint8", ("images", *IMAGE_SHAPE)),
    "uses": Member("integer", ("images",)),
    "positions": Member("number", ("images", 3)),
}
SHIPPED_FOLDER = Path(__file__).parent / "files" / "fetch"
REMEDY = "build a bank: infogoal reproduce goal-images"


@dataclasses.dataclass(frozen=True, eq=False)
class GoalImages:
    """N goal images of a task. The arrays are read-only.

    Raises `UserError` where the parts do not belong together.
    """

    task: str
    images: np.ndarray
    """uint8 [N, 64, 64, 3], RGB."""
    positions: np.ndarray
    """float32 [N, 3]: where the object is, or the gripper in a task without one (m)."""
    uses: np.ndarray
    """uint8 [N]: 0 grid, 1 training, 2 validation, 3 test. The grid's goals come first, in C order of `grid_shape`."""
    spacing: float
    """Between neighbours of the grid, in m."""
    grid_low: np.ndarray
    """float32 [3]: the first position of the grid (m)."""
    grid_shape: tuple[int, int, int]
    """Goals along x, y and z."""
    about: dict
    """Where the images come from, in words: camera, seed, versions."""

    def __post_init__(self):
        require(isinstance(self.about, dict), "about", type(self.about).__name__, "give a dict of words")
        given = {name: np.asarray(getattr(self, name)) for name in SCHEMA if name != "about"}
        check(fitting(given, SCHEMA)[2])
        count, positions, uses, low = len(given["images"]), given["positions"], given["uses"], given["grid_low"]
        require(count <= MOST_GOALS, "images", count, f"give at most {MOST_GOALS}; use a wider grid")
        strange = uses[(uses < 0) | (uses >= len(USES))]
        require(
            not len(strange),
            "uses",
            int(strange[0]) if len(strange) else 0,
            "give 0 (grid), 1 (train), 2 (validation) or 3 (test)",
        )
        require(bool((uses == TRAIN).any()), "uses", "no training goal", "give at least one image of use 1")
        spacing = float(self.spacing)
        require(spacing > 0, "spacing", spacing, "give a length greater than 0, in m")
        shape = tuple(int(length) for length in self.grid_shape)
        require(min(shape) >= 1, "grid_shape", shape, "give three whole numbers of at least 1")
        check_grid(positions, uses, low, spacing, shape)
        changes = {
            "images": read_only(self.images, np.uint8),
            "positions": read_only(positions, np.float32),
            "uses": read_only(uses, np.uint8),
            "grid_low": read_only(low, np.float32),
            "spacing": spacing,
            "grid_shape": shape,
        }
        for field, value in changes.items():
            object.__setattr__(self, field, value)

    def rows(self, use: int) -> np.ndarray:
        """Which images are of this use (GRID, TRAIN, VALIDATION or TEST), int [M]."""
        return np.flatnonzero(self.uses == use)

    def describe(self) -> str:
        """The bank in a few words: how many images of what use, the grid, and the seed if it is known."""
        counts = ", ".join(f"{len(self.rows(use))} {name}" for use, name in enumerate(USES))
        seed = f", seed {self.about['seed']}" if "seed" in self.about else ""
        return f"{counts} goals, grid of {100 * self.spacing:g} cm{seed}"


def grid_positions(low, spacing: float, shape: tuple[int, int, int]) -> np.ndarray:
    """Positions [nx * ny * nz, 3] of a grid in C order, in m."""
    steps = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    return np.asarray(low, float) + spacing * steps


def check_grid(
    positions: np.ndarray, uses: np.ndarray, low: np.ndarray, spacing: float, shape: tuple[int, int, int]
) -> None:
    """Raise `UserError` unless the goals of the grid come first, in C order, at its positions."""
    count = math.prod(shape)
    in_grid = int((uses == GRID).sum())
    require(in_grid == count, "grid_shape", shape, f"the bank has {in_grid} goals of the grid (use 0), not {count}")
    require(
        bool((uses[:count] == GRID).all()),
        "uses",
        "another goal before the last of the grid",
        "put the goals of the grid (use 0) first",
    )
    distance = np.abs(positions[:count] - grid_positions(low, spacing, shape)).max(1)
    worst = int(distance.argmax())
    require(
        distance[worst] <= GRID_TOLERANCE,
        "positions",
        np.round(positions[worst].astype(float), 4).tolist(),
        f"goal {worst} is off the grid; put goals at grid_low + spacing * (i, j, k), in C order of grid_shape {shape}",
    )


def read_only(values, dtype) -> np.ndarray:
    """A copy that nobody can write to."""
    array = np.array(values, dtype)
    array.flags.writeable = False
    return array


def shipped(task: str) -> Path:
    """Where the bank of a task that comes with the package is."""
    return SHIPPED_FOLDER / f"{task}.npz"


def load(path: str | os.PathLike, task: str) -> GoalImages:
    """Read the bank of a task. Raises `UserError` for a file that is missing, damaged, something else or of another
    task."""
    with archives.naming("goal images", path, REMEDY):
        fields = members.read_file(path, SCHEMA, REMEDY)
        found = str(fields["task"])
        remedy = f"the bank is of another task than {task!r}; give one of {task!r} or {REMEDY}"
        require(found == task, "task", found, remedy)
        try:
            about = from_json(str(fields["about"]))
        except ValueError as error:
            raise UserError(f"about = {str(fields['about'])[:40]!r}: is no JSON ({error}); {REMEDY}") from error
        return GoalImages(**fields | {"task": task, "about": about})


def save(path: str | os.PathLike, bank: GoalImages) -> None:
    """Write a bank. The file at `path` is always whole: the old one or the new one. The same bank gives the same bytes.

    Packed with LZMA: neighbouring goals share most of their pixels, and its window spans hundreds of images where that
    of deflate spans three.
    """
    fields = {name: json.dumps(bank.about) if name == "about" else getattr(bank, name) for name in SCHEMA}
    archives.save(path, fields, "goal images", zipfile.ZIP_LZMA)
