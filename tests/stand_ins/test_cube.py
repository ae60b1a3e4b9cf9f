"""The generated arm with its cube: joints orient the cube as the paper says, moves undo one another, and the pictures
show what was set."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from infogoal_jax.angles import geodesic, orientation_classes
from infogoal_jax.stand_ins import cube, cube_render

SEED, LARGE = 3, 256
# Degrees of joints 1, 2 and 6: an arm of 3 x 3 x 24 settings, quickly drawn.
NARROW = ((-15, 15), (30, 60), (-360, 360))
# Pairs of settings, degrees of joints 1, 2 and 6, that orient the cube alike: turned over behind its back, and with two
# axes in line.
ALIASES = (((0, 30, 45), (-180, 150, -135)), ((-60, -45, 90), (120, -135, -90)), ((30, 90, 15), (60, 90, 45)))


def turned(degrees: np.ndarray) -> np.ndarray:
    """Rz(q1) Ry(q2) Rx(q6): degrees of joints 1, 2 and 6 [..., 3] to [..., 3, 3]."""
    return Rotation.from_euler("ZYX", degrees, degrees=True).as_matrix()


def joints_of(degrees) -> np.ndarray:
    """Radians of all six joints."""
    return cube.all_joints(np.radians(degrees))


def orientation(degrees) -> np.ndarray:
    """How the arm's joints orient the cube, [3, 3]."""
    return cube.cube_pose(cube.link_motions(joints_of(degrees)))[:3, :3]


def stickers_in_view(scene: cube_render.Scene, rotation: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Middles int [N, 2] (column, row in an inset of `side` pixels) and colour numbers int [N] of the stickers on faces
    seen at a fair angle."""
    middles, colours = [], []
    for face in range(6):
        axis, sign = face // 2, 1 - 2 * (face % 2)
        normal = sign * np.eye(3)[axis]
        for row in range(3):
            for column in range(3):
                middle = normal / 2
                middle[(axis + 1) % 3], middle[(axis + 2) % 3] = (row - 1) / 3, (column - 1) / 3
                to_eye = np.array([0, 0, -cube_render.INSET_DISTANCE]) - scene.axes @ rotation @ middle
                if (scene.axes @ rotation @ normal) @ to_eye / np.linalg.norm(to_eye) > 0.3:
                    middles.append(cube_render.inset_pixels(scene, middle, rotation, side))
                    colours.append(scene.stickers[face, row, column])
    return np.floor(middles).astype(int), np.array(colours)


def nearest_sticker(pixels: np.ndarray) -> np.ndarray:
    """The sticker colour whose hue a pixel has, however bright it is: RGB [N, 3] to colour numbers [N]."""
    hues = cube_render.STICKER_COLOURS / np.linalg.norm(cube_render.STICKER_COLOURS, axis=-1, keepdims=True)
    return (pixels.astype(float) @ hues.T).argmax(-1)


def inset(frame: np.ndarray) -> np.ndarray:
    """The lower left quarter of a picture."""
    side = round(len(frame) * cube_render.INSET_SHARE)
    return frame[-side:, :side]


@pytest.fixture(scope="module")
def every_rotation() -> np.ndarray:
    """Orientation of the cube in each of the 13,824 settings, [K, 3, 3]."""
    return turned(cube.ANGLES[cube.settings(physical_limits=False)])


@pytest.fixture(scope="module")
def scene() -> cube_render.Scene:
    return cube_render.scene(SEED, LARGE)


@pytest.fixture
def narrow(monkeypatch):
    """Limits of the joints that leave few frames."""
    monkeypatch.setattr(cube, "LIMITS", NARROW)


def test_arm_reaches_where_its_data_sheet_says():
    """Stretched forwards at zero joints, the flange is 433 mm before the base's axis and 791.1 mm up, and the elbow 350
    mm over the shoulder."""
    frames = cube.link_frames(np.zeros(6))
    np.testing.assert_allclose(frames[6, :3, 3], (0.433, 0, 0.7911), atol=1e-9)
    np.testing.assert_allclose(frames[2, :3, 3] - frames[1, :3, 3], (0, 0, 0.350), atol=1e-9)


def test_joints_1_2_and_6_turn_the_cube_about_z_y_and_x():
    """The chain of all six joints comes to Rz(q1) Ry(q2) Rx(q6), between the settings too."""
    for degrees in np.random.default_rng(0).uniform(-180, 180, (50, 3)):
        np.testing.assert_allclose(orientation(degrees), turned(degrees), atol=1e-12)


@pytest.mark.long  # Fifty of them are above.
def test_every_setting_is_oriented_so(every_rotation):
    settings = cube.ANGLES[cube.settings(physical_limits=False)]
    np.testing.assert_allclose(every_rotation, [orientation(degrees) for degrees in settings], atol=1e-12)


def test_settings_show_6384_orientations(every_rotation):
    """As many as there are different matrices; classes are numbered as they appear, and hold what is less than a
    thousandth of a degree apart."""
    classes = orientation_classes(every_rotation)
    assert len(classes) == 24**3 and classes.max() + 1 == 6384 == len(
        np.unique(np.round(every_rotation, 6) + 0.0, axis=0)
    )
    values, first = np.unique(classes, return_index=True)
    assert (values == np.arange(6384)).all() and (np.diff(first) > 0).all()
    assert np.degrees(geodesic(every_rotation, every_rotation[first[classes]])).max() < 1e-3


def test_physical_limits_leave_what_the_arm_reaches():
    """Joint 1 reaches 23 of the 24 settings, joint 2 16, joint 6 all."""
    setting = cube.settings(physical_limits=True)
    assert [len(np.unique(column)) for column in setting.T] == [23, 16, 24] and len(setting) == 23 * 16 * 24
    degrees = cube.ANGLES[setting]
    assert np.abs(degrees[:, 0]).max() <= 170 and degrees[:, 1].min() >= -100 and degrees[:, 1].max() <= 135


@pytest.mark.parametrize("physical_limits", [pytest.param(False, marks=pytest.mark.long), True])
def test_a_move_turns_one_joint_by_one_step_and_its_opposite_turns_it_back(physical_limits):
    frame, action, next_frame = cube.moves(physical_limits)
    setting = cube.settings(physical_limits)
    step = (setting[next_frame] - setting[frame] + 12) % 24 - 12
    expected = np.zeros_like(step)
    expected[np.arange(len(action)), action // 2] = np.where(action % 2, -1, 1)
    np.testing.assert_array_equal(step, expected)
    there, back = set(zip(frame, action, next_frame, strict=True)), set(zip(next_frame, action ^ 1, frame, strict=True))
    assert there == back and len(there) == len(frame)


def test_joints_without_limits_go_round_and_round():
    """All six moves exist everywhere, and 24 equal ones come back to where they began after 24 different frames."""
    frame, action, next_frame = cube.moves(physical_limits=False)
    table = np.full((24**3, 6), -1)
    table[frame, action] = next_frame
    assert (table >= 0).all() and len(frame) == 6 * 24**3
    for move in range(6):
        way = [np.arange(24**3)]
        for _ in range(24):
            way.append(table[way[-1], move])
        assert (way[24] == way[0]).all() and not any((later == way[0]).any() for later in way[1:24])


def test_joints_with_limits_stop_there():
    """Joints 1 and 2 have no move beyond their last settings, and none across 180 degrees; joint 6 goes round."""
    frame, action, _ = cube.moves(physical_limits=True)
    np.testing.assert_array_equal(np.bincount(action // 2), [2 * 22 * 16 * 24, 2 * 23 * 15 * 24, 2 * 23 * 16 * 24])
    degrees = cube.ANGLES[cube.settings(physical_limits=True)][frame]
    for joint, last in ((0, 165), (1, 135)):
        assert not (degrees[action == 2 * joint, joint] == last).any()
    for joint, first in ((0, -165), (1, -90)):
        assert not (degrees[action == 2 * joint + 1, joint] == first).any()


@pytest.mark.parametrize("seed", range(4))
def test_stickers_are_those_of_a_cube_and_tell_its_faces_apart(seed):
    """Nine of each colour, all six in the middles; no face looks like another, however turned; pictures are neither
    mirrored nor upside down."""
    scene = cube_render.scene(seed, 64)
    assert (np.bincount(scene.stickers.ravel()) == 9).all() and len(set(scene.stickers[:, 1, 1])) == 6
    views = [
        np.rot90(face if number % 2 == 0 else face.T, turn)
        for number, face in enumerate(scene.stickers)
        for turn in range(4)
    ]
    agreeing = [(one == other).sum() for place, one in enumerate(views) for other in views[:place]]
    assert max(agreeing) <= 5
    assert np.linalg.det(scene.axes) == pytest.approx(1) and scene.axes[1, 2] < -0.8


@pytest.mark.long
def test_inset_shows_the_stickers_that_face_the_camera(narrow, scene):
    """In every frame of a built dataset, under its own light, each sticker in view has its colour where the frame's
    rotation puts it."""
    data = cube.build(SEED, physical_limits=True, size=LARGE)
    np.testing.assert_allclose(data.rotation, turned(np.degrees(data.joints)), atol=1e-6)
    shown = set()
    for frame, rotation in zip(data.frames, data.rotation.astype(float), strict=True):
        picture = inset(frame)
        middles, colours = stickers_in_view(scene, rotation, len(picture))
        assert len(colours) >= 9
        np.testing.assert_array_equal(nearest_sticker(picture[middles[:, 1], middles[:, 0]]), colours)
        shown |= set(colours.tolist())
    assert shown == set(range(6))


@pytest.mark.parametrize(("one", "other"), ALIASES)
def test_aliases_look_alike_in_the_inset_only(scene, one, other):
    """Two settings of one orientation show the same inset in the same light, and another posture of the arm."""
    light = cube_render.Light(-scene.axes[2], np.ones(3))
    pictures = []
    for degrees in (one, other):
        links = cube.link_motions(joints_of(degrees))
        pictures.append(
            cube_render.draw(scene, cube_render.draw_posture(scene, links), cube.cube_pose(links), light).astype(int)
        )
    assert geodesic(orientation(one), orientation(other)) < 1e-6
    different = np.abs(pictures[0] - pictures[1]).max(-1) > 8
    assert inset(different).mean() < 0.002 and different.mean() > 0.01


def test_same_seed_same_bytes(narrow, monkeypatch):
    """With any number of threads; another seed has other stickers, another room and other light in every frame."""
    first = cube.build(SEED, physical_limits=True, size=32)
    monkeypatch.setattr(cube.os, "cpu_count", lambda: 1)
    again, other = cube.build(SEED, physical_limits=True, size=32), cube.build(SEED + 1, physical_limits=True, size=32)
    for name in ("frames", "rotation", "joints", "frame", "action", "next_frame"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
    assert first.rotation.tobytes() == other.rotation.tobytes()
    assert (np.abs(first.frames.astype(int) - other.frames).mean((1, 2, 3)) > 1).all()


def test_a_setting_looks_the_same_within_wider_limits(narrow, monkeypatch):
    """Limits leave frames out; those that stay are the same pixels."""
    few = cube.build(SEED, physical_limits=True, size=16)
    monkeypatch.setattr(cube, "LIMITS", ((-30, 15), (30, 75), (-360, 360)))
    more = cube.build(SEED, physical_limits=True, size=16)
    where = {tuple(joints): frame for joints, frame in zip(more.joints.round(4), more.frames, strict=True)}
    assert len(more.frames) > len(few.frames)
    for joints, frame in zip(few.joints.round(4), few.frames, strict=True):
        np.testing.assert_array_equal(frame, where[tuple(joints)])
