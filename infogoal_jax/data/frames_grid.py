"""Moves between images: a record of one while they are collected, and those that follow from poses on a regular grid,
one step in one joint each."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from infogoal_jax.errors import UserError, nearest, require

GRID_WITHIN = 0.01
"""Joints may be off the grid by this share of a step."""
SAME_WITHIN = 1e-6
"""Joints that differ by less, in degrees or metres, are the same."""


class Move(NamedTuple):
    """A move as in `FrameDataset`, but with the action's name. row: of the CSV, for messages."""

    frame: int
    name: str
    next_frame: int
    trajectory: int
    time: int
    terminal: bool
    row: int


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
    rows: list[tuple[int, dict[str, str]]],
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
        require(not name.endswith("_m"), "wrap", name, "slides, in metres, and cannot go round")
    places, turns = zip(
        *(
            axis_of(table, rows, joint, values[:, column], joint.removeprefix("joint_") in wrap)
            for column, joint in enumerate(joints)
        ),
        strict=True,
    )
    points = [tuple(point) for point in np.stack(places, 1).tolist()]
    image_at: dict[tuple[int, ...], int] = {}
    for frame, point in enumerate(points):
        first = image_at.setdefault(point, frame)
        if first != frame and not (states_given and state[first] == state[frame]):
            raise UserError(
                f"{table}: row {rows[frame][0]}: image = {rows[frame][1]['image']!r}: has the joints of row "
                f"{rows[first][0]}; "
                f"remove one, or give both the same value in a column state"
            )
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
                    moves.append(
                        Move(frame, f"{names[column]} {sign}", image_at[after], len(moves), 0, True, rows[frame][0])
                    )
    unused = sorted(set(actions) - {move.name for move in moves})
    require(
        not unused,
        f"{table}: action",
        unused[0] if unused else "",
        "no two images are one grid step apart in this joint alone; add the poses between",
    )
    return moves, actions


def axis_of(
    table: Path, rows: list[tuple[int, dict[str, str]]], joint: str, values: np.ndarray, wraps: bool
) -> tuple[np.ndarray, int]:
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
    for place in np.flatnonzero(np.abs(gaps / step - apart) > GRID_WITHIN)[:1]:
        number, cells = rows[int(np.flatnonzero(which == place + 1)[0])]
        raise UserError(
            f"{table}: row {number}: {joint} = {cells[joint]!r}: is off the grid: the value below is "
            f"{settings[place]:g}, others are {step:g} apart; "
            f"correct it, and give joints as they were commanded, not as they were measured"
        )
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
