"""A generated stand-in for the paper's drone recordings (Sec. V-A.4): a camera flies in front of a shelf with 24
objects, in steps of 20 cm. First the dataset, then how it is drawn.

The shelf is long: from a random start a random policy finds an object in fewer than three of ten flights of 50 steps,
and a shortest path always can. An object counts as detected if its box lies in the image with all of its corners. The
camera is that of the drone's video stream: 960 x 720 pixels, 55.0 by 42.8 degrees, one metre away.
"""

from collections.abc import Callable

import cv2
import numpy as np

from infogoal_jax.data import splits
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.stand_ins.shelf_objects import DRAWINGS, draw

GENERATOR_VERSION = 1
ACTIONS = ("left", "right", "up", "down")
STEPS = np.array([[-1, 0], [1, 0], [0, 1], [0, -1]])
"""What each action adds to column and row."""
STEP = 0.2
"""Of the drone, m [P]."""
SIZE = np.array([8.0, 2.4])
"""Width and height of the shelf, m."""
COLUMNS, ROWS = 36, 9
"""Places of the camera: columns 0.5 m to 7.5 m from the left end, rows 0.4 m to 2.0 m from the floor."""
FIRST = np.array([0.5, 0.4])
"""Where the camera is at column 0 and row 0, m."""
BOARDS = (0.2, 0.7, 1.3, 1.8)
"""Heights of the boards, m; the lower two are the lower regions', the others the upper ones'."""
SLOTS = 3
"""Objects on a board of a region."""
APART, TOGETHER = SIZE[0] / 2 / SLOTS, 0.36
"""Width of a slot, m: all of the region's half of the shelf, or so narrow that a view shows several objects of it."""
FLIGHT_LENGTH, MIN_FLIGHTS = 50, 400
"""Moves in a recorded flight, and flights at least."""
VIEWS, DRIFT, ROLL, BLUR = 4, 0.03, 0.03, 14.0
"""Of a hovering drone: images of each place; standard deviations of its drift (m), its roll (radians) and its movement
(pixels of the stream)."""
STREAM = (720, 960)
"""Height and width of the video stream, pixels."""
DISTANCE = 1.0
"""From the camera to the shelf, m."""
VIEW = 2 * DISTANCE * np.tan(np.deg2rad(np.array([55.0, 42.8])) / 2)
"""Width and height of what is seen there, m: 1.04 x 0.78."""
PIXELS_PER_METRE = STREAM[1] / VIEW[0]
MARGIN = 0.8
"""Of wall beyond the shelf on every side, m: a camera at the edge sees it."""
COARSER = 3
"""Blurred images are reduced by this first."""
BOARD = 0.03
"""Thickness of boards and uprights, m."""


def build(
    seed: int = 0,
    hovering: bool = False,
    gathered: bool = False,
    size: tuple[int, int] = (48, 64),
    progress: Callable[[float], None] | None = None,
) -> FrameDataset:
    """The dataset of this seed: which object stands where, colours of walls and boards, and flights follow from it.

    hovering: several images of each place, from a drone that drifts, rolls and blurs them. gathered: the objects of a
    region stand together. size: height and width of the images.
    """
    random = np.random.default_rng([seed, GENERATOR_VERSION])
    wall, places = furnished_wall(random, gathered)
    count = VIEWS if hovering else 1
    column, row = np.arange(COLUMNS * ROWS) % COLUMNS, np.arange(COLUMNS * ROWS) // COLUMNS
    state = np.repeat(np.arange(COLUMNS * ROWS), count)
    centre = (FIRST + STEP * np.stack([column, row], axis=-1))[state]
    frames, detected = [], []
    for number, place in enumerate(centre):
        drift, roll, blur = (
            (random.normal(0, DRIFT, 2), random.normal(0, ROLL), random.normal(0, BLUR, 2))
            if hovering
            else (0.0, 0.0, None)
        )
        view = camera(place + drift, roll)
        frames.append(see(wall, view, size, blur))
        detected.append([in_view(view, box) for box in boxes(places)])
        if progress is not None:
            progress((number + 1) / len(centre))
    table = moves()
    flights = record_trajectories(table, random)
    images = np.array([np.flatnonzero(state == place) for place in range(COLUMNS * ROWS)])
    return FrameDataset(
        frames=np.stack(frames),
        state=state.astype(np.int32),
        actions=ACTIONS,
        **as_frames(flights, images, random),
        about={
            "name": f"a generated shelf of {SIZE[0]:g} x {SIZE[1]:g} m{', regions gathered' if gathered else ''}"
            f"{', seen by a hovering drone' if hovering else ''}",
            "stand_in": True,
            "made_by": f"infogoal data build shelf --seed {seed}{' --hovering' if hovering else ''}"
            f"{' --gathered' if gathered else ''}",
            "seed": seed,
            "hovering": hovering,
            "generator": GENERATOR_VERSION,
            "width_m": float(SIZE[0]),
            "height_m": float(SIZE[1]),
        },
        position=centre.astype(np.float32),
        detected=np.array(detected),
        objects=tuple(places),
    )


def furnished_wall(random: np.random.Generator, gathered: bool = False) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The picture of the wall with its shelf and objects, uint8 RGB [H, W, 3], and where each object stands."""
    places = furnish(random, gathered)
    uprights = np.concatenate([[0.0], np.sort(random.uniform(1.0, SIZE[0] - 1.0, 6)), [SIZE[0]]])
    return draw_wall(uprights, places, random), places


def furnish(random: np.random.Generator, gathered: bool = False) -> dict[str, np.ndarray]:
    """Where each object stands: its left end and its foot (m). Each stands in its own region, on a board and in a slot
    drawn at random. gathered: the slots of a region lie side by side, somewhere in its half of the shelf."""
    width, margin = (TOGETHER, 0.01) if gathered else (APART, 0.1)
    asked, places = splits.load_questions(splits.SHIPPED_QUESTIONS), {}
    for region, room in enumerate(asked.room_names):
        names = [name for name, its in zip(asked.objects, asked.rooms, strict=True) if its == region]
        boards = BOARDS[2:] if "upper" in room else BOARDS[:2]
        start = 0.0 if "left" in room else SIZE[0] / 2
        if gathered:
            start += random.uniform(0, SIZE[0] / 2 - SLOTS * width)
        for slot, name in enumerate(random.permutation(names)):
            room_left = width - DRAWINGS[str(name)][0] / 100 - 2 * margin
            left = start + (slot % SLOTS) * width + margin + random.uniform(0, room_left)
            places[str(name)] = np.array([left, boards[slot // SLOTS]])
    return {name: places[name] for name in asked.objects}


def boxes(places: dict[str, np.ndarray]) -> list[np.ndarray]:
    """The corners [4, 2] of the box around each object, m."""
    found = []
    for name, (left, foot) in places.items():
        width, height = DRAWINGS[name][0] / 100, DRAWINGS[name][1] / 100
        found.append(
            np.array([[left, foot], [left + width, foot], [left + width, foot + height], [left, foot + height]])
        )
    return found


def in_view(view: np.ndarray, box: np.ndarray) -> bool:
    """Whether all corners of a box [4, 2] (m) lie in the image of this camera."""
    corners = pixel_of(box) @ view[:, :2].T + view[:, 2]
    return bool(((corners >= 0) & (corners <= STREAM[::-1])).all())


def moves() -> np.ndarray:
    """Where each action leads from each place, int [S, A]; its own index at the edge."""
    place = (
        np.stack([np.arange(COLUMNS * ROWS) % COLUMNS, np.arange(COLUMNS * ROWS) // COLUMNS], axis=-1)[:, None] + STEPS
    )
    inside = ((place >= 0) & (place < [COLUMNS, ROWS])).all(-1)
    return np.where(inside, place @ [1, COLUMNS], np.arange(COLUMNS * ROWS)[:, None])


def record_trajectories(
    table: np.ndarray, random: np.random.Generator, length: int = FLIGHT_LENGTH, at_least: int = MIN_FLIGHTS
) -> list[np.ndarray]:
    """Flights [length, 3] of place, action and next place, as if flown by hand: mostly straight on, until every move
    that exists was made.

    table: int [S, A], its own index where there is no move. A flight begins with a move that was made least often.
    """
    exists = table != np.arange(len(table))[:, None]
    made, flights = np.where(exists, 0, np.iinfo(np.int32).max), []
    while len(flights) < at_least or (made == 0).any():
        place, action = (int(index) for index in random.choice(np.argwhere(made == made.min())))
        flight = []
        for _ in range(length):
            flight.append((place, action, table[place, action]))
            made[place, action] += 1
            place = int(table[place, action])
            if not exists[place, action] or random.random() < 0.25:
                action = int(random.choice(np.flatnonzero(exists[place])))
        flights.append(np.array(flight))
    return flights


def as_frames(flights: list[np.ndarray], images: np.ndarray, random: np.random.Generator) -> dict[str, np.ndarray]:
    """The moves of a dataset for flights between places; each place that is passed is seen in one of its images [S, V],
    drawn at random."""
    columns: dict[str, list] = {
        name: [] for name in ("frame", "action", "next_frame", "trajectory", "time", "terminal")
    }
    for number, flight in enumerate(flights):
        passed = np.append(flight[:, 0], flight[-1, 2])
        seen = images[passed, random.integers(images.shape[1], size=len(passed))]
        length = len(flight)
        rows = (
            seen[:-1],
            flight[:, 1],
            seen[1:],
            np.full(length, number),
            np.arange(length),
            np.arange(length) == length - 1,
        )
        for column, values in zip(columns.values(), rows, strict=True):
            column.append(values)
    moved = {name: np.concatenate(parts).astype(np.int32) for name, parts in columns.items()}
    return moved | {"terminal": moved["terminal"].astype(bool)}


def draw_wall(uprights: np.ndarray, places: dict[str, np.ndarray], random: np.random.Generator) -> np.ndarray:
    """The whole wall with its shelf and objects, uint8 RGB [H, W, 3]; row 0 is the top. uprights: x of each, m; places:
    left end and foot of each object."""
    width, height = np.round((SIZE + 2 * MARGIN) * PIXELS_PER_METRE).astype(int)
    wall = wallpaper(height, width, random)
    wood = random.uniform(70, 190) * np.array([1.0, random.uniform(0.65, 0.85), random.uniform(0.4, 0.65)])
    for x in uprights:
        fill(wall, (x - BOARD / 2, 0.0), (x + BOARD / 2, SIZE[1]), wood * random.uniform(0.75, 1.1))
    for board in BOARDS:
        fill(wall, (0.0, board - BOARD), (SIZE[0], board), wood)
        fill(wall, (0.0, board - BOARD - 0.012), (SIZE[0], board - BOARD), wood * 0.45)  # The board's shadow.
    for name, place in places.items():
        paste(wall, draw(*DRAWINGS[name], PIXELS_PER_METRE), place)
    return wall


def wallpaper(height: int, width: int, random: np.random.Generator) -> np.ndarray:
    """A painted wall, uint8 [height, width, 3]: colours that change slowly, and spots by which one place is told from
    another."""
    coarse = random.uniform(0, 1, (5, 14, 3)) * 70 + random.uniform(60, 150, 3)
    wall = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    wall = np.clip(wall, 0, 255).astype(np.uint8)
    for _ in range(int(width * height / (0.35 * PIXELS_PER_METRE) ** 2)):
        centre = (int(random.integers(width)), int(random.integers(height)))
        radius = int(random.uniform(0.03, 0.09) * PIXELS_PER_METRE)
        colour = np.clip(wall[centre[1], centre[0]] + random.uniform(-60, 60, 3), 0, 255).tolist()
        if random.random() < 0.5:
            cv2.circle(wall, centre, radius, colour, cv2.FILLED, cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((centre, (2 * radius, radius), random.uniform(0, 180)))
            cv2.fillPoly(wall, [np.int32(corners)], colour, cv2.LINE_AA)
    return wall


def pixel_of(point) -> np.ndarray:
    """The pixel (column, row) of points [..., 2] on the shelf, m from its lower left corner; not rounded."""
    point = np.asarray(point, float)
    return np.stack([point[..., 0] + MARGIN, SIZE[1] + MARGIN - point[..., 1]], axis=-1) * PIXELS_PER_METRE


def fill(wall: np.ndarray, low, high, colour: np.ndarray) -> None:
    """Paint the rectangle between two corners (m)."""
    (left, bottom), (right, top) = np.round(pixel_of([low, high])).astype(int)
    wall[top:bottom, left:right] = np.clip(colour, 0, 255)


def paste(wall: np.ndarray, picture: np.ndarray, place: np.ndarray) -> None:
    """Lay a picture [h, w, 4] (RGB times opacity, and opacity) on the wall, its lower left corner at `place` (m)."""
    left, bottom = np.round(pixel_of(place)).astype(int)
    region = wall[bottom - picture.shape[0] : bottom, left : left + picture.shape[1]]
    region[:] = np.clip(picture[..., :3] + region * (1 - picture[..., 3:] / 255.0), 0, 255).astype(np.uint8)


def camera(centre: np.ndarray, roll: float) -> np.ndarray:
    """The affine map [2, 3] from pixels of the wall to those of the video stream, for a camera before `centre` (m),
    turned by `roll` (radians)."""
    column, row = pixel_of(centre)
    turn = cv2.getRotationMatrix2D((float(column), float(row)), np.rad2deg(roll), 1.0)
    turn[:, 2] += np.array([STREAM[1] / 2 - column, STREAM[0] / 2 - row])
    return turn


def see(wall: np.ndarray, view: np.ndarray, size: tuple[int, int], blur: np.ndarray | None = None) -> np.ndarray:
    """What the camera sees, uint8 [height, width, 3] of this size. blur: movement while the shutter is open, pixels of
    the stream [2]; None: none."""
    image = cv2.warpAffine(wall, view, STREAM[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if blur is not None:
        # Blurring 720 rows takes ten times as long.
        image = cv2.resize(image, None, fx=1 / COARSER, fy=1 / COARSER, interpolation=cv2.INTER_AREA)
        blur = blur / COARSER
        length = int(np.ceil(np.abs(blur).max())) | 1
        kernel = np.zeros((length, length), np.float32)
        middle = length // 2
        end = np.round(blur / 2).astype(int)
        cv2.line(kernel, (middle - end[0], middle - end[1]), (middle + end[0], middle + end[1]), 1.0)
        image = cv2.filter2D(image, -1, kernel / kernel.sum())
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
