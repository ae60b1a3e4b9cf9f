"""The CSV file of an image folder: its rows, poses and moves, each mistake named with its row and column."""

import csv
import io
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from infogoal_jax.data import frames_check
from infogoal_jax.data.frames_grid import Move
from infogoal_jax.errors import UserError, nearest
from infogoal_jax.files import read_text

MOVES = ("trajectory", "time", "action")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("roll", "pitch", "yaw")
PLACE = ("x", "y", "z")
KNOWN = ("image", *MOVES, "state", *QUATERNION, *ANGLES, *PLACE, "objects")
ALLOWED = f"allowed are {', '.join(KNOWN)} and joint_NAME (degrees; metres if NAME ends in _m)"
UNIT_WITHIN = 1e-3
Rows = list[tuple[int, dict[str, str]]]
"""Each row of the CSV: its number and its cells by column, stripped."""


MOST_DIGITS = 9
"""Of the number of a step, which is kept as int32."""


def wants(condition: bool, table: Path, number: int, column: str, value: str, remedy: str) -> None:
    """Raise a `UserError` that names the CSV's row, unless the condition holds."""
    if not condition:
        raise UserError(f"{table}: row {number}: {column} = {value!r}: {remedy}")


def read_rows(table: Path) -> Rows:
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
    header, rows = lines[0], []
    for number, cells in enumerate(lines[1:], 2):
        if any(cells):
            if len(cells) != len(header):
                raise UserError(
                    f"{table}: row {number}: has {len(cells)} cells, but the header has {len(header)}; separate cells "
                    "with commas"
                )
            rows.append((number, dict(zip(header, cells, strict=True))))
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


def number_images(table: Path, rows: Rows) -> tuple[dict[str, int], Rows]:
    """The index of each image by its name, and the row that each is first named in. A row that names one again must say
    the same of it."""
    frame_of: dict[str, int] = {}
    frame_rows: Rows = []
    for number, cells in rows:
        wants(cells["image"] != "", table, number, "image", "", "name a file of the folder")
        if cells["image"] not in frame_of:
            frame_of[cells["image"]] = len(frame_rows)
            frame_rows.append((number, cells))
            continue
        first, said = frame_rows[frame_of[cells["image"]]]
        if "trajectory" not in cells:
            raise UserError(
                f"{table}: row {number}: image = {cells['image']!r}: is in row {first} already; give each pose an "
                "image of its own"
            )
        for column in set(cells) - set(MOVES):
            remedy = f"row {first} says {said[column]!r} of the same image; correct one"
            wants(cells[column] == said[column], table, number, column, cells[column], remedy)
    return frame_of, frame_rows


def numbers(table: Path, rows: Rows, columns: Sequence[str], unit: str) -> np.ndarray:
    """These columns as numbers, float64 [rows, columns]."""
    values = np.empty((len(rows), len(columns)))
    for row, (number, cells) in enumerate(rows):
        for column, name in enumerate(columns):
            try:
                values[row, column] = float(cells[name])
            except ValueError:
                values[row, column] = np.nan
            wants(
                bool(np.isfinite(values[row, column])),
                table,
                number,
                name,
                cells[name],
                f"give a number in {unit}, with a decimal point",
            )
    return values


def joint_numbers(table: Path, rows: Rows, joints: Sequence[str]) -> np.ndarray:
    """The joints as the CSV has them, degrees or metres, float64 [rows, J]."""
    return np.concatenate(
        [numbers(table, rows, [joint], "metres" if joint.endswith("_m") else "degrees") for joint in joints], 1
    )


def read_poses(table: Path, rows: Rows, joints: tuple[str, ...]) -> dict:
    """The fields rotation, joints, position and detected of the dataset, with their names, as far as the CSV has
    them."""
    columns, fields = set(rows[0][1]), {}
    if "qw" in columns:
        quaternion = numbers(table, rows, QUATERNION, "parts of a quaternion")
        length = np.linalg.norm(quaternion, axis=1)
        for row in np.flatnonzero(np.abs(length - 1) > UNIT_WITHIN):
            words = ", ".join(rows[row][1][column] for column in QUATERNION)
            raise UserError(
                f"{table}: row {rows[row][0]}: qw, qx, qy, qz = {words}: has the length {length[row]:.4f}, not 1; "
                "divide by it"
            )
        fields["rotation"] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    if "roll" in columns:  # R = Rz(yaw) Ry(pitch) Rx(roll): capital letters are turns about the axes that turned along.
        fields["rotation"] = Rotation.from_euler(
            "ZYX", numbers(table, rows, ANGLES, "degrees")[:, ::-1], degrees=True
        ).as_matrix()
    if joints:
        values = joint_numbers(table, rows, joints)
        fields["joints"] = np.where([joint.endswith("_m") for joint in joints], values, np.radians(values))
    if "x" in columns:
        fields["position"] = numbers(table, rows, [axis for axis in PLACE if axis in columns], "metres")
    fields = {field: values.astype(np.float32) for field, values in fields.items()}
    if joints:
        fields["joint_names"] = tuple(joint.removeprefix("joint_") for joint in joints)
    if "objects" in columns:
        seen = [{name.strip() for name in cells["objects"].split(";")} - {""} for _, cells in rows]
        if names := tuple(sorted(set().union(*seen))):  # A column that names none says no more than no column.
            fields |= {"objects": names, "detected": np.array([[name in found for name in names] for found in seen])}
    return fields


def read_moves(table: Path, rows: Rows, frame_of: dict[str, int]) -> list[Move]:
    """The recorded moves: from each row of a trajectory to the next in time."""
    trajectories: dict[str, list[tuple[int, int, dict[str, str]]]] = {}
    for number, cells in rows:
        wants(
            cells["trajectory"] != "", table, number, "trajectory", "", "name the trajectory that the image belongs to"
        )
        whole = cells["time"].isascii() and cells["time"].isdecimal() and len(cells["time"]) <= MOST_DIGITS
        wants(whole, table, number, "time", cells["time"], "give the number of the step, a whole number: 0, 1, 2, ...")
        trajectories.setdefault(cells["trajectory"], []).append((int(cells["time"]), number, cells))
    moves = []
    for index, (name, steps) in enumerate(trajectories.items()):
        steps.sort(key=lambda step: step[:2])
        where = f"of trajectory {name!r}"
        wants(
            len(steps) > 1,
            table,
            steps[0][1],
            "trajectory",
            name,
            "has one row only, so no move; add the image after it, or remove the row",
        )
        for position, ((time, number, cells), (later, next_number, after)) in enumerate(itertools.pairwise(steps)):
            wants(
                later != time,
                table,
                next_number,
                "time",
                after["time"],
                f"row {number} {where} has the same time; give each step its own",
            )
            remedy = (
                f"a gap {where}, after time {time} in row {number}; add what is missing, or give the rest another "
                "trajectory"
            )
            wants(later == time + 1, table, next_number, "time", after["time"], remedy)
            wants(
                cells["action"] != "",
                table,
                number,
                "action",
                "",
                f"is not the last row {where}; name the action taken after this image",
            )
            ends = frame_of[cells["image"]], frame_of[after["image"]]
            moves.append(Move(ends[0], cells["action"], ends[1], index, position, position == len(steps) - 2, number))
        _, number, cells = steps[-1]
        remedy = f"is the last row {where}, and no image shows where it led; leave it empty"
        wants(cells["action"] == "", table, number, "action", cells["action"], remedy)
    return moves


def contradicting(table: Path, moves: list[Move], fields: dict, state: np.ndarray) -> None:
    """Raise a `UserError` for two rows whose state and action are the same, but not the state that follows."""
    for one, other in frames_check.contradictions(state, fields["frame"], fields["action"], fields["next_frame"]):
        raise UserError(
            f"{table}: row {moves[other].row}: action = {moves[other].name!r}: leads from the same state as in row "
            f"{moves[one].row} to another; "
            f"correct one, or tell the states apart in the column state"
        )
