"""A laboratory's folder of images and a CSV become an image dataset; every mistake in them is named with file, row and
remedy."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from infogoal_jax.cli.main import main
from infogoal_jax.data import frames, frames_check
from infogoal_jax.data.frames_import import import_folder
from infogoal_jax.errors import UserError

MOVES = """image,trajectory,time,action,state,qw,qx,qy,qz,x,y,joint_lift,objects
a.png,second,0,right,left end,1,0,0,0,0.5,1,90,red mug; book
b.png,second,1,right,middle,0.7071068,0,0,0.7071068,1.5,1,45,

d.png,first,8,,right end,0,1,0,0,2.5,1,0,book
c.bmp,first,7,right,middle,0.7071068,0,0,0.7071068,1.5,1,45,book
b.png,first,6,left,middle,0.7071068,0,0,0.7071068,1.5,1,45,
d.png,second,2,,right end,0,1,0,0,2.5,1,0,book
"""


def draw(path, number: int, size=(24, 32)) -> np.ndarray:
    """A file with a red spot on blue, elsewhere for each number; its pixels as RGB."""
    image = np.full((*size, 3), (200, 40, 10), np.uint8)
    cv2.circle(image, (3 + 5 * number % size[1], size[0] // 2), 4, (0, 0, 200 + number % 50), -1)
    cv2.imwrite(str(path), image)
    return image[..., ::-1]


@pytest.fixture
def laboratory(tmp_path):
    """A folder with images, and the function that writes the CSV and imports it."""
    folder = tmp_path / "images"
    folder.mkdir()
    for number, name in enumerate(("a.png", "b.png", "c.bmp", "d.png")):
        draw(folder / name, number)

    def import_table(text: str, encoding="utf-8", **options):
        (tmp_path / "table.csv").write_text(text, encoding=encoding)
        return import_folder(folder, tmp_path / "table.csv", tmp_path / "out.npz", **options)

    import_table.folder = folder
    return import_table


def test_recorded_moves_become_a_dataset(laboratory, tmp_path):
    dataset = laboratory(
        MOVES.replace("left end", "linkes Ende, ä").replace(",linkes Ende, ä,", ',"linkes Ende, ä",'), "utf-8-sig"
    )
    assert [name for name in dataset.actions] == ["left", "right"]
    # As they are first named.
    np.testing.assert_array_equal(dataset.frames, [draw(tmp_path / "again.png", number) for number in (0, 1, 3, 2)])
    assert [len(set(dataset.state[rows])) for rows in ([0, 1, 2], [1, 3])] == [3, 1]
    moves = list(
        zip(
            dataset.frame,
            dataset.action,
            dataset.next_frame,
            dataset.trajectory,
            dataset.time,
            dataset.terminal,
            strict=True,
        )
    )
    assert moves == [(0, 1, 1, 0, 0, False), (1, 1, 2, 0, 1, True), (1, 0, 3, 1, 0, False), (3, 1, 2, 1, 1, True)]
    assert dataset.objects == ("book", "red mug")
    np.testing.assert_array_equal(dataset.detected, [[True, True], [False, False], [True, False], [True, False]])
    np.testing.assert_allclose(dataset.joints[:, 0], np.radians([90, 45, 0, 45]), atol=1e-6)
    np.testing.assert_allclose(dataset.rotation[1] @ [1, 0, 0], [0, 1, 0], atol=1e-6)  # A quarter turn about z.
    np.testing.assert_array_equal(dataset.position[:, 0], [0.5, 1.5, 2.5, 1.5])
    assert dataset.about["stand_in"] is False and dataset.about["name"] == "images"
    assert not [finding for finding in frames_check.check_frames(tmp_path / "out.npz") if finding.severity == "error"]
    np.testing.assert_array_equal(frames.load(tmp_path / "out.npz").frames, dataset.frames)


def test_a_column_of_objects_that_names_none_is_as_no_column(laboratory, tmp_path, capsys):
    """As `infogoal record` leaves it without a detector: there are images and moves, and no detections."""
    dataset = laboratory(MOVES.replace("red mug; book", "").replace(",book", ","))
    assert dataset.detected is None and dataset.objects == () and frames.load(tmp_path / "out.npz").detected is None
    (tmp_path / "out.npz").unlink()
    command = [
        "data",
        "import",
        str(laboratory.folder),
        str(tmp_path / "table.csv"),
        "--out",
        str(tmp_path / "out.npz"),
    ]
    assert main(command) == 0 and "No row names an object" in capsys.readouterr().out


def test_roll_pitch_and_yaw_turn_about_z_after_y_after_x(laboratory):
    rows = "image,trajectory,time,action,roll,pitch,yaw\na.png,1,0,up,10,20,30\nb.png,1,1,,0,0,-90\n"
    about = [
        Rotation.from_euler(axis, angle, degrees=True).as_matrix() for axis, angle in (("z", 30), ("y", 20), ("x", 10))
    ]
    dataset = laboratory(rows)
    assert dataset.joints is None and dataset.detected is None and dataset.num_states == 2
    np.testing.assert_allclose(dataset.rotation[0], about[0] @ about[1] @ about[2], atol=1e-6)


def grid(values=((0, 120, 240), (0.1, 0.2)), skip=(), extra="") -> str:
    """A CSV of poses: joint_turn in degrees, joint_rail_m in metres, an image each."""
    rows = [(turn, rail) for turn in values[0] for rail in values[1] if (turn, rail) not in skip]
    return (
        "image,joint_turn,joint_rail_m\n"
        + "".join(f"{number}.png,{turn},{rail}\n" for number, (turn, rail) in enumerate(rows))
        + extra
    )


@pytest.fixture
def poses(laboratory):
    """The same for a grid of poses, images 0.png to 7.png."""
    for number in range(8):
        draw(laboratory.folder / f"{number}.png", number)
    return laboratory


def test_neighbours_of_a_grid_are_joined_and_a_full_turn_only_where_asked(poses):
    dataset = poses(grid())  # Frames 0 to 5: turn 0, rail 0.1; turn 0, rail 0.2; turn 120, rail 0.1; ...
    assert dataset.actions == ("turn +", "turn -", "rail_m +", "rail_m -")
    np.testing.assert_array_equal(
        frames.next_state(dataset), [[2, 0, 1, 0], [3, 1, 1, 0], [4, 0, 3, 2], [5, 1, 3, 2], [4, 2, 5, 4], [5, 3, 5, 4]]
    )
    np.testing.assert_allclose(dataset.joints[3], [np.radians(120), 0.2], atol=1e-6)
    assert dataset.terminal.all() and len(set(dataset.trajectory)) == len(dataset.trajectory) == 14
    wrapped = frames.next_state(poses(grid(), wrap=("turn",)))
    np.testing.assert_array_equal(wrapped[:, :2], [[2, 4], [3, 5], [4, 0], [5, 1], [0, 2], [1, 3]])


def test_a_grid_point_without_an_image_has_no_moves(poses):
    dataset = poses(grid(skip=[(120, 0.2)]), wrap=("turn",))  # Frames: 0/.1, 0/.2, 120/.1, 240/.1, 240/.2.
    np.testing.assert_array_equal(
        frames.next_state(dataset), [[2, 3, 1, 0], [1, 4, 1, 0], [3, 0, 2, 2], [0, 2, 4, 3], [1, 4, 4, 3]]
    )


def test_several_images_of_a_pose_share_a_state(poses):
    table = "image,joint_turn,state\n0.png,0,zero\n1.png,10,ten\n2.png,0,zero\n"
    dataset = poses(table)
    assert dataset.state.tolist() == [1, 0, 1] and sorted(dataset.frame.tolist()) == [0, 1, 2]
    np.testing.assert_array_equal(frames.next_state(dataset), [[0, 1], [0, 1]])


def test_poses_of_one_state_that_lead_elsewhere_are_named(poses):
    with pytest.raises(UserError, match=r"row 4: action = 'turn \+': leads from the same state as in row 2 to another"):
        poses("image,joint_turn,joint_b,state\n0.png,0,0,one\n1.png,10,0,two\n2.png,0,5,one\n3.png,10,5,three\n")


def test_rounded_steps_are_on_the_grid(poses):
    assert len(poses(grid(values=((0, 0.333, 0.667, 1), (0, 1)))).frame) == 2 * (3 * 2 + 4)


def test_images_of_several_sizes_are_brought_to_one(laboratory):
    draw(laboratory.folder / "a.png", 0, (48, 64))
    with pytest.raises(
        UserError, match=r"row 3: image = 'b\.png': is 24 x 32 pixels.* but 'a\.png' in row 2 is 48 x 64; give --size"
    ):
        laboratory(MOVES)
    dataset = laboratory(MOVES, size=(12, 16))
    assert dataset.frames.shape == (4, 12, 16, 3) and dataset.about["recorded_size"] == [48, 64]
    draw(laboratory.folder / "b.png", 0, (24, 24))
    with pytest.raises(UserError, match=r"row 3: image = 'b\.png': is 24 x 24.*another shape; crop it"):
        laboratory(MOVES, size=(12, 16))


HEADER = MOVES.splitlines()[0]
MISTAKES = {  # What is replaced in the CSV of moves, and what the message must say.
    "empty": (MOVES, "", ["has no header", "allowed are image"]),
    "header only": (MOVES, HEADER, ["has a header only"]),
    "no image": (HEADER, HEADER.replace("image", "qw2"), ["row 1", "unknown column 'qw2'", "Did you mean 'qw'?"]),
    "no action": (HEADER, HEADER.replace("action,state", "state,joint_a"), ["row 1", "lacks the column action"]),
    "semicolons": (MOVES, MOVES.replace(",", ";"), ["row 1", "commas, not semicolons"]),
    "a column twice": (HEADER, HEADER.replace("time", "image"), ["row 1", "the column 'image' twice"]),
    "half a quaternion": (HEADER, HEADER.replace("qw", "z"), ["row 1", "lacks the column qw"]),
    "half a position": (HEADER, HEADER.replace(",y,", ",z,"), ["row 1", "lacks the column y"]),
    "both orientations": (
        MOVES,
        HEADER.replace("state", "roll,pitch,yaw") + "\na.png" + 14 * ",",
        ["row 1", "give one of them"],
    ),
    "no moves": (MOVES, "image,state\na.png,x\n", ["row 1", "says nothing of moves", "joint_NAME"]),
    "a cell too many": ("red mug; book", "red mug, book", ["row 2", "has 14 cells, but the header has 13"]),
    "an open quotation mark": ("red mug", '"red mug', ["no CSV", "quotation mark"]),
    "no image named": ("c.bmp", "", ["row 6", "image = ''", "name a file"]),
    "no such image": ("c.bmp", "c.png", ["row 6", "image = 'c.png'", "no such file", "Did you mean"]),
    "time is no number": ("first,7", "first,7.5", ["row 6", "time = '7.5'", "a whole number"]),
    "a gap in time": (
        "first,8",
        "first,9",
        ["row 5", "time = '9'", "a gap of trajectory 'first', after time 7 in row 6"],
    ),
    "a time twice": ("first,8", "first,7", ["time = '7'", "row 5 of trajectory 'first' has the same time"]),
    "no trajectory": ("second,0", ",0", ["row 2", "trajectory = ''"]),
    "one row": ("second,0", "third,0", ["row 2", "trajectory = 'third'", "one row only"]),
    "no action in the middle": ("6,left", "6,", ["row 7", "action = ''", "not the last row of trajectory 'first'"]),
    "an action at the end": (
        "2,,right",
        "2,right,right",
        ["row 8", "action = 'right'", "is the last row of trajectory 'second'", "leave it empty"],
    ),
    "a state that is empty": ("left end", "", ["row 2", "state = ''"]),
    "another word of one image": (
        "d.png,second,2,,right end",
        "d.png,second,2,,left end",
        ["row 8", "state = 'left end'", "row 5 says"],
    ),
    "a contradiction": ("6,left", "6,right", ["row 7", "action = 'right'", "as in row 3", "column state"]),
    "no number": ("0.5", "half", ["row 2", "x = 'half'", "a number in metres"]),
    "a decimal comma": ("0.5", '"0,5"', ["row 2", "x = '0,5'", "a decimal point"]),
    "not finite": (",90,", ",nan,", ["row 2", "joint_lift = 'nan'", "a number in degrees"]),
    "a long quaternion": (
        "end,1,0",
        "end,2,0",
        ["row 2", "qw, qx, qy, qz = 2, 0, 0, 0", "length 2.0000, not 1", "divide"],
    ),
    "another object of one image": (
        "d.png,second,2,,right end,0,1,0,0,2.5,1,0,book",
        "d.png,second,2,,right end,0,1,0,0,2.5,1,0,",
        ["row 8", "row 5 says", "book"],
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_named_with_file_row_and_remedy(case, laboratory, tmp_path):
    old, new, expected = MISTAKES[case]
    assert old in MOVES
    with pytest.raises(UserError) as caught:
        laboratory(MOVES.replace(old, new, 1))
    message = str(caught.value)
    assert all(part in message for part in ["table.csv", *expected]), message
    assert not (tmp_path / "out.npz").exists()


def test_every_row_that_is_wrong_is_named_in_one_pass(laboratory):
    together = ("time is no number", "an action at the end", "a state that is empty", "no number", "not finite")
    table = MOVES
    for case in together:
        old, new, _ = MISTAKES[case]
        assert old in table
        table = table.replace(old, new, 1)
    with pytest.raises(UserError) as caught:
        laboratory(table)
    for case in together:
        found = [line for line in str(caught.value).splitlines() if all(part in line for part in MISTAKES[case][2])]
        assert len(found) == 1, (case, str(caught.value))
    for name in ("b.png", "d.png"):
        (laboratory.folder / name).write_bytes(b"no image")
    with pytest.raises(UserError) as caught:
        laboratory(MOVES)
    assert ["b.png" in line or "d.png" in line for line in str(caught.value).splitlines()] == [True, True]


def test_an_image_that_cannot_be_decoded_is_named(laboratory):
    for content in (b"", b"no image", (laboratory.folder / "b.png").read_bytes()[:30]):
        (laboratory.folder / "b.png").write_bytes(content)
        with pytest.raises(
            UserError,
            match=r"table\.csv: row 3: image = 'b\.png': .*b\.png is damaged or no image that OpenCV reads; replace it",
        ):
            laboratory(MOVES)


def test_a_table_that_is_not_utf8_is_named(laboratory, tmp_path):
    with pytest.raises(UserError, match=r"table\.csv: is not UTF-8"):
        laboratory(MOVES.replace("left end", "façade"), "latin-1")
    with pytest.raises(UserError, match="no such file"):
        import_folder(laboratory.folder, tmp_path / "nothing.csv", tmp_path / "out.npz")
    with pytest.raises(UserError, match="no such folder"):
        import_folder(tmp_path / "nothing", tmp_path / "table.csv", tmp_path / "out.npz")


@pytest.mark.parametrize(
    "wrong",
    [
        {"size": 8},
        {"size": (8, 8, 8)},
        {"size": (8, 8.5)},
        {"size": (0, 8)},
        {"wrap": "turn"},
        {"wrap": (1,)},
        {"wrap": None},
        {"name": 3},
        {"progress": 3},
        {"images": 3},
        {"table": None},
        {"out": ""},
    ],
    ids=str,
)
def test_arguments_of_other_kinds_are_named(wrong, laboratory, tmp_path):
    """Before anything is read."""
    (field,) = wrong
    given = {"images": laboratory.folder, "table": tmp_path / "gone.csv", "out": tmp_path / "out.npz"}
    with pytest.raises(UserError, match=f"^{field} = .*: give ") as caught:
        import_folder(**(given | wrong))
    assert "\n" not in str(caught.value)


GRID_MISTAKES = {  # CSV, joints that wrap, and what the message must say.
    "a pose twice": (grid(extra="6.png,120,0.2\n"), (), ["row 8", "'6.png'", "has the joints of row 5"]),
    "an image twice": (grid(extra="0.png,360,0.1\n"), (), ["row 8", "'0.png'", "in row 2 already"]),
    "a full turn is no turn": (grid(extra="6.png,360,0.1\n"), ("turn",), ["row 8", "has the joints of row 2"]),
    "off the grid": (
        grid(extra="6.png,250,0.1\n"),
        (),
        ["row 8", "joint_turn = '250'", "off the grid", "others are 120 apart"],
    ),
    "no joint moves": (grid(values=((5,), (0.1,))), (), ["table.csv: joints = ('joint_turn', ", "no joint ever moves"]),
    "no neighbours": ("image,joint_a,joint_b\n0.png,0,0\n1.png,1,1\n", (), ["action = 'a +'", "no two images"]),
    "an unknown joint wraps": (grid(), ("trun",), ["wrap = 'trun'", "Did you mean 'turn'?"]),
    "a rail wraps": (grid(), ("rail_m",), ["wrap = 'rail_m'", "slides"]),
    "no full turn": (
        grid(values=((0, 100, 200), (0.1, 0.2))),
        ("turn",),
        ["wrap = 'turn'", "steps of 100 degrees", "360"],
    ),
    "wrap of moves": (MOVES, ("lift",), ["wrap = ('lift',)", "recorded moves"]),
}


@pytest.mark.parametrize("case", GRID_MISTAKES)
def test_a_mistake_in_a_grid_is_named(case, poses):
    table, wrap, expected = GRID_MISTAKES[case]
    with pytest.raises(UserError) as caught:
        poses(table, wrap=wrap)
    message = str(caught.value)
    assert all(part in message for part in expected), message


def test_the_command_imports_and_says_what_it_made(poses, tmp_path, capsys):
    (tmp_path / "grid.csv").write_text(grid())
    out = tmp_path / "grid.npz"
    flags = ["--size", "6", "8", "--wrap", "turn", "--name", "a grid"]
    words = ["data", "import", str(poses.folder), str(tmp_path / "grid.csv"), "--out", str(out), *flags]
    assert main(words) == 0
    assert "a grid; 6 frames of 6 x 8 x 3, 6 states, 18 moves of 4 actions" in capsys.readouterr().out
    assert "--size 6 8 --wrap turn" in frames.load(out).about["made_by"]
    assert main(words) == 2 and "is there already" in capsys.readouterr().err
