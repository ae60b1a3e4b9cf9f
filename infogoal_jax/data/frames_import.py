"""A laboratory's folder of images and a CSV file of what each shows, as an image dataset (frames.py;
docs/reference/datasets.md has both kinds of CSV).

With the columns trajectory, time and action the CSV lists recorded moves. Without them it lists poses, joints on a
regular grid, and the moves are the steps between neighbours. Rows are numbered as a spreadsheet does: the header is row
1.
"""

import os
import shlex
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from infogoal_jax.data import frames, frames_grid, pictures
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.data.frames_table import (
    MOVES,
    Rows,
    check_columns,
    contradicting,
    joint_numbers,
    number_images,
    read_moves,
    read_poses,
    read_rows,
    wants,
)
from infogoal_jax.errors import UserError, nearest, require
from infogoal_jax.files import read_bytes

MOST_BYTES = 4e9
"""Frames that take more are refused: they would not fit beside a policy on common GPUs, and policies see small
images."""


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

    Raises `UserError` for every mistake in what is given; it names the file, the row and the remedy.
    """
    images, table = Path(images), Path(table)
    require(
        images.is_dir(),
        "images",
        str(images),
        "no such folder; give the folder that the CSV's column image is relative to",
    )
    rows = read_rows(table)
    columns = tuple(rows[0][1])
    joints = tuple(column for column in columns if column.startswith("joint_"))
    moves = set(columns) & set(MOVES)
    check_columns(table, columns, joints, bool(moves))
    require(not (wrap and moves), "wrap", tuple(wrap), f"{table} lists recorded moves; wrap is for a grid of poses")
    frame_of, frame_rows = number_images(table, rows)
    poses = read_poses(table, frame_rows, joints)
    states = [cells.get("state", "") for _, cells in frame_rows]
    if "state" in columns:
        for number, cells in frame_rows:
            wants(cells["state"] != "", table, number, "state", "", "name the state that the image shows")
        state = np.unique(states, return_inverse=True)[1]
    else:
        state = np.arange(len(frame_rows))
    if moves:
        recorded, actions = read_moves(table, rows, frame_of), []
    else:
        values = joint_numbers(table, frame_rows, joints)
        recorded, actions = frames_grid.grid_moves(table, frame_rows, joints, values, state, "state" in columns, wrap)
    fields = frames_grid.move_fields(recorded, actions)
    contradicting(table, recorded, fields, state)
    pixels, recorded_size = read_images(images, table, frame_rows, size, progress)
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


def read_images(
    folder: Path, table: Path, rows: Rows, size: tuple[int, int] | None, progress: Callable[[float], None] | None
) -> tuple[np.ndarray, list[int]]:
    """The images in the order of the rows, uint8 RGB [K, H, W, 3], and height and width of the first file."""
    if size is not None:
        require(min(size) >= 1, "size", tuple(size), "give height and width, at least 1 pixel each")
    first = read_image(folder, table, *rows[0])
    height, width = size or first.shape[:2]
    total = len(rows) * height * width * 3
    require(
        total <= MOST_BYTES,
        "size",
        (height, width),
        f"{len(rows)} images take {total / 1e9:.1f} GB; shrink them with --size, such as 64 64",
    )
    pixels = np.empty((len(rows), height, width, 3), np.uint8)

    def read_into(row: int) -> None:
        """Decoding and shrinking let other threads run."""
        number, cells = rows[row]
        image = read_image(folder, table, number, cells)
        here, expected = image.shape[:2], first.shape[:2]
        found = (
            f"is {here[0]} x {here[1]} pixels high and wide, but {rows[0][1]['image']!r} in row {rows[0][0]} is "
            f"{expected[0]} x {expected[1]}"
        )
        if size is None:
            wants(
                here == expected,
                table,
                number,
                "image",
                cells["image"],
                f"{found}; give --size HEIGHT WIDTH to bring all to one size",
            )
        else:  # The same shape, but for what rounding to whole pixels costs.
            alike = abs(here[1] - here[0] * expected[1] / expected[0]) <= max(1, here[0] / expected[0])
            wants(
                alike,
                table,
                number,
                "image",
                cells["image"],
                f"{found}, another shape; crop it, so that nothing is distorted",
            )
            image = pictures.resized(image, *size)
        pixels[row] = image

    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as threads:
        for done, _ in enumerate(threads.map(read_into, range(len(rows))), 1):
            if progress is not None:
                progress(done / len(rows))
    return pixels, list(first.shape[:2])


def read_image(folder: Path, table: Path, number: int, cells: dict[str, str]) -> np.ndarray:
    """One image as OpenCV decodes it, uint8 RGB [H, W, 3]."""
    name = cells["image"]
    try:
        content = read_bytes(folder / name)
    except FileNotFoundError:
        hint = nearest(name, [path.name for path in folder.iterdir()])
        raise UserError(
            f"{table}: row {number}: image = {name!r}: no such file in {folder}.{hint} Add it, or correct the row"
        ) from None
    except (OSError, ValueError) as error:  # A name with a zero byte is a ValueError.
        raise UserError(
            f"{table}: row {number}: image = {name!r}: cannot be read ({error}); correct the name, or the rights of "
            "the file"
        ) from error
    image = pictures.decoded(content)
    wants(
        image is not None,
        table,
        number,
        "image",
        name,
        f"{folder / name} is damaged or no image that OpenCV reads; replace it or remove the row",
    )
    return image
