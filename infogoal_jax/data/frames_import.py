"""A laboratory's folder of images and a CSV file of what each shows, as an image dataset (frames.py;
docs/reference/datasets.md has both kinds of CSV).

With the columns trajectory, time and action the CSV lists recorded moves. Without them it lists poses, joints on a
regular grid, and the moves are the steps between neighbours. Rows are numbered as a spreadsheet does: the header is row
1.
"""

import contextlib
import csv
import io
import itertools
import os
import shlex
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from infogoal_jax import checks
from infogoal_jax.data import frames, frames_check, pictures
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.data.members import MOST_FAULTS
from infogoal_jax.errors import UserError, nearest, require
from infogoal_jax.files import read_bytes, read_text

MOVES = ("trajectory", "time", "action")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("roll", "pitch", "yaw")
PLACE = ("x", "y", "z")
KNOWN = ("image", *MOVES, "state", *QUATERNION, *ANGLES, *PLACE, "objects")
ALLOWED = f"allowed are {', '.join(KNOWN)} and joint_NAME (degrees; metres if NAME ends in _m)"
UNIT_WITHIN = 1e-3
MOST_DIGITS = 9
"""Of the number of a step, which is kept as int32."""
MOST_BYTES = 4e9
"""Frames that take more are refused: they would not fit beside a policy on common GPUs, and policies see small
images."""
GRID_WITHIN = 0.01
"""Joints may be off the grid by this share of a step."""
SAME_WITHIN = 1e-6
"""Joints that differ by less, in degrees or metres, are the same."""


class Row(NamedTuple):
    """A row of the CSV.

    number: as a spreadsheet counts.
    cells: by column, stripped.
    faults: of all rows, in words.
    """

    table: Path
    number: int
    cells: dict[str, str]
    faults: list[str]

    def wants(self, condition: bool, column: str, problem: str) -> bool:
        """Whether the condition holds; otherwise what is wrong with a cell of this row, and what to do, is a fault."""
        if not condition:
            self.faults.append(f"{self.table}: row {self.number}: {column} = {self.cells[column]!r}: {problem}")
        return condition


def stop_at(faults: Sequence[str]) -> None:
    """Raise a `UserError` of these faults, if there are any, a line each."""
    if faults:
        more = [f"{len(faults) - MOST_FAULTS} more rows with faults"] if len(faults) > MOST_FAULTS else []
        raise UserError("\n".join([*faults[:MOST_FAULTS], *more]))


class Move(NamedTuple):
    """A move as in `FrameDataset`, but with the action's name. row: where the CSV names it."""

    frame: int
    name: str
    next_frame: int
    trajectory: int
    time: int
    terminal: bool
    row: Row


def import_folder(
    images: str | os.PathLike,
    table: str | os.PathLike,
    out: str | os.PathLike,
    size: tuple[int, int] | None = None,
    wrap: Sequence[str] = (),
    name: str = "",
    progress: Callable[[float], None] | None = None,
) -> FrameDataset:
    """Make an image dataset of a folder of images and a CSV, and write it to `out`.

    size: height and width in pixels to shrink the images to. wrap: joints of a grid of poses that go round a full turn.
    name: of the dataset, in words; by default that of the folder. progress: is told the share of the images that is
    read.

    Raises `UserError` for the mistakes in what is given, all those of the CSV at once, then all those of the images; it
    names the file, the row and the remedy.
    """
    images = Path(checks.path(images, "images", "give a folder of images"))
    table = Path(checks.path(table, "table", "give a CSV"))
    checks.path(out, "out", "give the file to write")
    wrap = checked_names(wrap)
    if size is not None:
        remedy = "give height and width, at least 1 pixel each, such as (64, 64)"
        pixels = np.asarray(checks.array(size, "size", "whole numbers", (2,), remedy))
        require((pixels >= 1).all(), "size", size, remedy)
        size = tuple(pixels.tolist())
    checks.text(name, "name", "give words, or leave it out")
    if progress is not None:
        checks.function(progress, "progress", 1, "give a function of a share, or leave it out")
    require(
        images.is_dir(),
        "images",
        str(images),
        "no such folder; give the folder that the CSV's column image is relative to",
    )
    rows = read_rows(table)
    columns = tuple(rows[0].cells)
    joints = tuple(column for column in columns if column.startswith("joint_"))
    moves = set(columns) & set(MOVES)
    check_columns(table, columns, joints, bool(moves))
    require(not (wrap and moves), "wrap", wrap, f"{table} lists recorded moves; wrap is for a grid of poses")
    faults = rows[0].faults
    frame_of, frame_rows = number_images(rows)
    state = np.arange(len(frame_rows))
    if "state" in columns:
        for row in frame_rows:
            row.wants(row.cells["state"] != "", "state", "name the state that the image shows")
        state = np.unique([row.cells["state"] for row in frame_rows], return_inverse=True)[1]
    recorded, actions = read_moves(rows, frame_of) if moves else [], []
    poses = read_poses(frame_rows, columns, joints, faults)
    if not moves:
        values = joint_numbers(frame_rows, joints)
        recorded, actions = grid_moves(table, frame_rows, joints, values, state, "state" in columns, wrap)
        stop_at(faults)
    fields = move_fields(recorded, actions)
    contradicting(recorded, fields, state)
    stop_at(faults)
    pixels, recorded_size = read_images(images, frame_rows, size, progress)
    command = f"infogoal data import {shlex.quote(str(images))} {shlex.quote(str(table))}"
    command += (f" --size {size[0]} {size[1]}" if size else "") + "".join(
        f" --wrap {shlex.quote(joint)}" for joint in wrap
    )
    about = {
        "name": name or images.resolve().name,
        "stand_in": False,
        "made_by": command,
        "recorded_size": recorded_size,
    }
    dataset = FrameDataset(frames=pixels, state=state.astype(np.int32), about=about, **fields, **poses)
    frames.save(out, dataset)
    return dataset


def checked_names(wrap: Any) -> tuple[str, ...]:
    """The names of joints. One name alone would be taken for its letters."""
    listed = isinstance(wrap, Sequence | set | frozenset) and not isinstance(wrap, str)
    names = tuple(wrap) if listed else ()
    require(listed and all(isinstance(name, str) for name in names), "wrap", wrap, 'give names in a list: ["wrist"]')
    return names


def read_images(
    folder: Path, rows: list[Row], size: tuple[int, int] | None, progress: Callable[[float], None] | None
) -> tuple[np.ndarray, list[int]]:
    """The images in the order of the rows, uint8 RGB [K, H, W, 3], and height and width of the first file."""
    first = read_image(folder, rows[0])
    if first is None:
        raise UserError(rows[0].faults[0])
    height, width = size or first.shape[:2]
    total = len(rows) * height * width * 3
    require(
        total <= MOST_BYTES,
        "size",
        (height, width),
        f"{len(rows)} images take {total / 1e9:.1f} GB; shrink them with --size, such as 64 64",
    )
    pixels = np.empty((len(rows), height, width, 3), np.uint8)

    def read_into(place: int) -> None:
        """Decoding and shrinking let other threads run."""
        row = rows[place]
        image = read_image(folder, row)
        if image is None:
            return
        here, expected = image.shape[:2], first.shape[:2]
        found = (
            f"is {here[0]} x {here[1]} pixels high and wide, but {rows[0].cells['image']!r} in row {rows[0].number} is "
            f"{expected[0]} x {expected[1]}"
        )
        if size is None:
            fits = row.wants(here == expected, "image", f"{found}; give --size HEIGHT WIDTH to bring all to one size")
        else:  # The same shape, but for what rounding to whole pixels costs.
            alike = abs(here[1] - here[0] * expected[1] / expected[0]) <= max(1, here[0] / expected[0])
            fits = row.wants(alike, "image", f"{found}, another shape; crop it, so that nothing is distorted")
            image = pictures.resized(image, *size)
        if fits:
            pixels[place] = image

    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as threads:
        for done, _ in enumerate(threads.map(read_into, range(len(rows))), 1):
            if progress is not None:
                progress(done / len(rows))
    stop_at(rows[0].faults)
    return pixels, list(first.shape[:2])


def read_image(folder: Path, row: Row) -> np.ndarray | None:
    """One image as OpenCV decodes it, uint8 RGB [H, W, 3]; None, and a fault of the row, where there is none."""
    name = row.cells["image"]
    problem = f"{folder / name} is damaged or no image that OpenCV reads; replace it or remove the row"
    try:
        image = pictures.decoded(read_bytes(folder / name))
    except FileNotFoundError:
        hint = nearest(name, [path.name for path in folder.iterdir()])
        image, problem = None, f"no such file in {folder}.{hint} Add it, or correct the row"
    except (OSError, ValueError) as error:  # A name with a zero byte is a ValueError.
        image, problem = None, f"cannot be read ({error}); correct the name, or the rights of the file"
    row.wants(image is not None, "image", problem)
    return image


def read_rows(table: Path) -> list[Row]:
    """The rows of the CSV below its header; blank lines are left out, but counted."""
    try:
        content = io.StringIO(read_text(table, encoding="utf-8-sig"), newline="")
        lines = [[cell.strip() for cell in line] for line in csv.reader(content, strict=True)]
    except FileNotFoundError:
        raise UserError(f"{table}: no such file; give a CSV with a row for each image") from None
    except OSError as error:
        raise UserError(f"{table}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{table}: is not UTF-8 (byte {error.start}); save it as CSV in UTF-8") from error
    except csv.Error as error:
        raise UserError(f"{table}: is no CSV ({error}); look for a quotation mark that is not closed") from error
    if not lines or not any(lines[0]):
        raise UserError(f"{table}: has no header; begin with a row of names of columns: {ALLOWED}")
    header, rows, faults = lines[0], [], []
    for number, cells in enumerate(lines[1:], 2):
        if any(cells):
            if len(cells) != len(header):
                raise UserError(
                    f"{table}: row {number}: has {len(cells)} cells, but the header has {len(header)}; separate cells "
                    "with commas"
                )
            rows.append(Row(table, number, dict(zip(header, cells, strict=True)), faults))
    repeated = [column for place, column in enumerate(header) if column in header[:place]]
    if repeated:
        raise UserError(f"{table}: row 1: has the column {repeated[0]!r} twice; remove one")
    if not rows:
        raise UserError(f"{table}: has a header only; give a row for each image")
    return rows


def check_columns(table: Path, columns: tuple[str, ...], joints: tuple[str, ...], moves: bool) -> None:
    """Raise a `UserError` for columns that are unknown, missing or exclude each other."""
    for column in columns:
        if column not in KNOWN and (column not in joints or column == "joint_"):
            hint = " Separate columns with commas, not semicolons." if ";" in column else nearest(column, list(KNOWN))
            raise UserError(f"{table}: row 1: has an unknown column {column!r}.{hint} Rename or remove it; {ALLOWED}")
    groups = [("image",)]
    groups += [MOVES] if moves else []
    groups += [
        group for group in (QUATERNION, ANGLES, PLACE[:2]) if set(columns) & set(group if group[0] != "x" else PLACE)
    ]
    for group in groups:
        missing = [column for column in group if column not in columns]
        if missing:
            raise UserError(
                f"{table}: row 1: lacks the column {', '.join(missing)}; it has {', '.join(columns)}; {ALLOWED}"
            )
    if "qw" in columns and "roll" in columns:
        raise UserError(f"{table}: row 1: has both qw,qx,qy,qz and roll,pitch,yaw; give one of them")
    if not moves and not joints:
        raise UserError(
            f"{table}: row 1: says nothing of moves; give the columns trajectory, time and action (recorded moves), or "
            "joint_NAME (poses on a grid)"
        )


def number_images(rows: list[Row]) -> tuple[dict[str, int], list[Row]]:
    """The index of each image by its name, and the row that each is first named in. A row that names one again must say
    the same of it."""
    frame_of: dict[str, int] = {}
    frame_rows: list[Row] = []
    for row in rows:
        name = row.cells["image"]
        if not row.wants(name != "", "image", "name a file of the folder"):
            continue
        if name not in frame_of:
            frame_of[name] = len(frame_rows)
            frame_rows.append(row)
            continue
        first = frame_rows[frame_of[name]]
        moves = "trajectory" in row.cells
        if not row.wants(moves, "image", f"is in row {first.number} already; give each pose an image of its own"):
            continue
        for column in set(row.cells) - set(MOVES):
            said = first.cells[column]
            remedy = f"row {first.number} says {said!r} of the same image; correct one"
            row.wants(row.cells[column] == said, column, remedy)
    return frame_of, frame_rows


def numbers(rows: list[Row], columns: Sequence[str], unit: str) -> np.ndarray:
    """These columns as numbers, float64 [rows, columns]."""
    values = np.full((len(rows), len(columns)), np.nan)
    for index, row in enumerate(rows):
        for column, name in enumerate(columns):
            with contextlib.suppress(ValueError):
                values[index, column] = float(row.cells[name])
            finite = bool(np.isfinite(values[index, column]))
            row.wants(finite, name, f"give a number in {unit}, with a decimal point")
    return values


def joint_numbers(rows: list[Row], joints: Sequence[str]) -> np.ndarray:
    """The joints as the CSV has them, degrees or metres, float64 [rows, J]."""
    units = ("metres" if joint.endswith(frames.SLIDES) else "degrees" for joint in joints)
    return np.concatenate([numbers(rows, [joint], unit) for joint, unit in zip(joints, units, strict=True)], 1)


def read_poses(rows: list[Row], columns: Sequence[str], joints: tuple[str, ...], faults: Sequence[str]) -> dict:
    """The fields rotation, joints, position and detected of the dataset, with their names, as far as the CSV has
    them. Stops at the faults so far."""
    fields = {}
    if joints:
        values = joint_numbers(rows, joints)
        fields["joints"] = np.where([joint.endswith(frames.SLIDES) for joint in joints], values, np.radians(values))
    if "x" in columns:
        fields["position"] = numbers(rows, [axis for axis in PLACE if axis in columns], "metres")
    quaternion = numbers(rows, QUATERNION if "qw" in columns else (), "parts of a quaternion")
    angles = numbers(rows, ANGLES if "roll" in columns else (), "degrees")
    length = np.linalg.norm(quaternion, axis=1)
    for row in np.flatnonzero(np.abs(length - 1) > UNIT_WITHIN) if "qw" in columns else ():
        words = ", ".join(rows[row].cells[column] for column in QUATERNION)
        given = f"{rows[row].table}: row {rows[row].number}: qw, qx, qy, qz = {words}"
        rows[row].faults.append(f"{given}: has the length {length[row]:.4f}, not 1; divide by it")
    stop_at(faults)
    if "qw" in columns:
        fields["rotation"] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    if "roll" in columns:  # R = Rz(yaw) Ry(pitch) Rx(roll): capital letters are turns about the axes that turned along.
        fields["rotation"] = Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True).as_matrix()
    fields = {field: values.astype(np.float32) for field, values in fields.items()}
    if joints:
        fields["joint_names"] = tuple(joint.removeprefix("joint_") for joint in joints)
    if "objects" in columns:
        seen = [{name.strip() for name in row.cells["objects"].split(";")} - {""} for row in rows]
        if names := tuple(sorted(set().union(*seen))):  # A column that names none says no more than no column.
            fields |= {"objects": names, "detected": np.array([[name in found for name in names] for found in seen])}
    return fields


def read_moves(rows: list[Row], frame_of: dict[str, int]) -> list[Move]:
    """The recorded moves: from each row of a trajectory to the next in time."""
    trajectories: dict[str, list[tuple[int, Row]]] = {}
    for row in rows:
        name, time = row.cells["trajectory"], row.cells["time"]
        row.wants(name != "", "trajectory", "name the trajectory that the image belongs to")
        whole = time.isascii() and time.isdecimal() and len(time) <= MOST_DIGITS
        row.wants(whole, "time", "give the number of the step, a whole number: 0, 1, 2, ...")
        trajectories.setdefault(name, []).append((int(time) if whole else -1, row))
    moves = []
    for index, (name, steps) in enumerate(trajectories.items()):
        steps.sort(key=lambda step: (step[0], step[1].number))
        if not name or steps[0][0] < 0:  # Their order is not known: what else is wrong would follow from it.
            continue
        where = f"of trajectory {name!r}"
        alone = "has one row only, so no move; add the image after it, or remove the row"
        steps[0][1].wants(len(steps) > 1, "trajectory", alone)
        for position, ((time, row), (later, after)) in enumerate(itertools.pairwise(steps)):
            same = f"row {row.number} {where} has the same time; give each step its own"
            after.wants(later != time, "time", same)
            gap = f"a gap {where}, after time {time} in row {row.number}"
            after.wants(later <= time + 1, "time", f"{gap}; add what is missing, or give the rest another trajectory")
            action = row.cells["action"]
            row.wants(action != "", "action", f"is not the last row {where}; name the action taken after this image")
            ends = (frame_of.get(each.cells["image"], -1) for each in (row, after))
            moves.append(Move(next(ends), action, next(ends), index, position, position == len(steps) - 2, row))
        last = steps[-1][1]
        remedy = f"is the last row {where}, and no image shows where it led; leave it empty"
        last.wants(last.cells["action"] == "", "action", remedy)
    return moves


def contradicting(moves: list[Move], fields: dict, state: np.ndarray) -> None:
    """Find rows whose state and action are those of another row, but not the state that follows."""
    for one, other in frames_check.contradictions(state, fields["frame"], fields["action"], fields["next_frame"]):
        row, name = moves[other].row, moves[other].name
        row.faults.append(
            f"{row.table}: row {row.number}: action = {name!r}: leads from the same state as in row "
            f"{moves[one].row.number} to another; correct one, or tell the states apart in the column state"
        )


def move_fields(moves: Sequence[Move], actions: Sequence[str] = ()) -> dict:
    """The fields of a dataset that are about moves. actions: the order of the names; empty: that of the alphabet."""
    actions = tuple(actions) or tuple(sorted({move.name for move in moves}))
    number = {name: index for index, name in enumerate(actions)}
    frame, name, next_frame, trajectory, time, terminal, _ = zip(*moves, strict=True)
    whole = {
        "frame": frame,
        "next_frame": next_frame,
        "trajectory": trajectory,
        "time": time,
        "action": [number[word] for word in name],
    }
    return {field: np.array(values, np.int32) for field, values in whole.items()} | {
        "terminal": np.array(terminal, bool),
        "actions": actions,
    }


def grid_moves(
    table: Path,
    rows: list[Row],
    joints: Sequence[str],
    values: np.ndarray,
    state: np.ndarray,
    states_given: bool,
    wrap: Sequence[str],
) -> tuple[list[Move], list[str]]:
    """The steps between neighbours of a grid of poses, each a trajectory of its own, and the actions.

    Where a neighbour has no image there is no move.

    joints: J names of columns. values: float [K, J], degrees or metres. state: int [K]; images of one pose must share
    it.
    wrap: names, without joint_, of joints that go round.
    """
    names = [joint.removeprefix("joint_") for joint in joints]
    for name in wrap:
        require(
            name in names,
            "wrap",
            name,
            f"{table} has no column joint_{name}.{nearest(name, names)} It has {', '.join(names)}",
        )
        require(not name.endswith(frames.SLIDES), "wrap", name, "slides, in metres, and cannot go round")
    places, turns = zip(
        *(
            grid_places(table, rows, joint, values[:, column], joint.removeprefix("joint_") in wrap)
            for column, joint in enumerate(joints)
        ),
        strict=True,
    )
    points = [tuple(point) for point in np.stack(places, 1).tolist()]
    image_at: dict[tuple[int, ...], int] = {}
    for frame, point in enumerate(points):
        first = image_at.setdefault(point, frame)
        alike = first == frame or (states_given and state[first] == state[frame])
        same = f"has the joints of row {rows[first].number}"
        rows[frame].wants(alike, "image", f"{same}; remove one, or give both the same value in a column state")
    moving = [column for column in range(len(joints)) if np.ptp(places[column])]
    require(bool(moving), f"{table}: joints", joints, "no joint ever moves; give at least two values of one joint")
    actions = [f"{names[column]} {sign}" for column in moving for sign in "+-"]
    moves: list[Move] = []
    for frame, point in enumerate(points):
        for column in moving:
            for sign, step in (("+", 1), ("-", -1)):
                place = point[column] + step
                after = (*point[:column], place % turns[column] if turns[column] else place, *point[column + 1 :])
                if after in image_at:
                    action = f"{names[column]} {sign}"
                    moves.append(Move(frame, action, image_at[after], len(moves), 0, True, rows[frame]))
    unused = sorted(set(actions) - {move.name for move in moves})
    require(
        not unused,
        f"{table}: action",
        unused[0] if unused else "",
        "no two images are one grid step apart in this joint alone; add the poses between",
    )
    return moves, actions


def grid_places(table: Path, rows: list[Row], joint: str, values: np.ndarray, wraps: bool) -> tuple[np.ndarray, int]:
    """The place of each value on its joint's grid, int [K], and the number of places of a full turn, 0 where the joint
    does not go round."""
    settings, which = np.unique(values, return_inverse=True)
    gaps = np.diff(settings)
    steps = np.sort(gaps[gaps > SAME_WITHIN])
    if not len(steps):
        require(not wraps, "wrap", joint.removeprefix("joint_"), f"has one value only in {table}")
        return np.zeros(len(values), int), 0
    # The commonest gap, and of those that are as common the smallest: one stray pose must not make a finer grid on
    # which nothing has a neighbour.
    low, high = (
        np.searchsorted(steps, steps * (1 - GRID_WITHIN)),
        np.searchsorted(steps, steps * (1 + GRID_WITHIN), "right"),
    )
    commonest = int((high - low).argmax())
    step = steps[low[commonest] : high[commonest]].mean()
    apart = np.rint(gaps / step).astype(int)
    for place in np.flatnonzero(np.abs(gaps / step - apart) > GRID_WITHIN):
        off = f"is off the grid: the value below is {settings[place]:g}, others are {step:g} apart"
        row = rows[int(np.flatnonzero(which == place + 1)[0])]
        row.wants(False, joint, f"{off}; correct it, and give joints as they were commanded, not as they were measured")
    places = np.append(0, np.cumsum(apart))[which]
    if not wraps:
        return places, 0
    turn = round(360 / step)
    require(
        abs(360 / step - turn) <= GRID_WITHIN,
        "wrap",
        joint.removeprefix("joint_"),
        f"steps of {step:g} degrees in {table} do not divide a full turn of 360; leave it out, or record a step that "
        "does",
    )
    return places % turn, turn
