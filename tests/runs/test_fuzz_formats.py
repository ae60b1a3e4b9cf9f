"""Every file format: a file with another member, another value or bytes of nobody's is read, or refused by one
`UserError`, at once and without a change of any file. The files of runs are in test_fuzz.py."""

import contextlib
import importlib
import inspect
import io
import json
import pkgutil
import sys
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import hand_made_frames
import hand_made_points
import jax
import jax.numpy as jnp
import made_up_results
import numpy as np
import pytest
from fuzzing import REAL, damaged, digest, examples_of
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from infogoal_drone import figures as flights
from infogoal_drone import mission, records
from infogoal_jax import data, presets
from infogoal_jax.data import (
    active_vision,
    archives,
    backgrounds,
    check,
    episodes,
    frames,
    frames_import,
    goal_images,
    splits,
    text,
)
from infogoal_jax.errors import UserError
from infogoal_jax.report import export
from infogoal_jax.runner import jobs
from infogoal_jax.runs import checkpoint, configuration, folder, low_level, tables
from infogoal_paper import files, numbers

sys.path.insert(0, str(ROOT / "benchmarks" / "fidelity"))
import drone_faults


def deep(text: str) -> np.ndarray:
    return np.array("[" * 100_000 + text)


ARRAYS = st.sampled_from(
    [
        np.zeros(()), np.zeros(0), np.zeros((0, 3)), np.full((3, 3), np.nan), np.full(3, np.inf), np.ones((2, 2), bool),
        np.array(2**62), np.array([-1, 2**31]), np.array(-1.5), np.zeros(3, complex), np.array("text"),
        np.array(["a", "b" * 300]), np.array([""] * 3), np.array(b"bytes"), np.zeros(3, [("a", int), ("b", float)]),
        np.array(["2026-11-27"], "datetime64[D]"), np.zeros((1, 64, 64, 3), np.uint8), np.zeros((2, 4, 6, 3), np.uint8),
        np.array("{}"), np.array("[]"), np.array("null"), np.array("{" * 9), deep(""), np.array('"\\ud800"'),
        np.frombuffer(b"{}", np.uint8), np.array(1), np.array(2), np.array([object()], object),
    ]
)  # fmt: skip


def packed(members: dict[str, np.ndarray]) -> bytes:
    """The members as an npz, objects as pickles."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, value in members.items():
            with archive.open(f"{name}.npy", "w") as stream:
                np.lib.format.write_array(stream, np.asarray(value))
    return content.getvalue()


@st.composite
def damaged_npz(draw, members: dict[str, np.ndarray]) -> bytes:
    """An npz of these members, some of them with other values, types, shapes or texts, or not there; or with bytes of
    nobody's."""
    members = dict(members)
    for _ in range(draw(st.integers(1, 2))):
        name = draw(st.sampled_from(sorted(members)))
        value = np.asarray(members[name])
        is_text = value.dtype.kind == "U" and value.ndim == 0
        is_json = is_text or (value.dtype == np.uint8 and value.ndim == 1 and value.size > 1)
        how = draw(st.sampled_from(["other", "gone", "json", "value", "cast", "cut"]))
        if how == "json" and is_json:
            content = draw(damaged(str(value).encode() if is_text else value.tobytes()))
            members[name] = np.array(content.decode(errors="replace")) if is_text else np.frombuffer(content, np.uint8)
        elif how == "gone" and len(members) > 1:
            del members[name]
        elif how == "value" and value.size and value.dtype.kind in "iuf":
            changed = value.copy()
            number = draw(REAL if value.dtype.kind == "f" else st.sampled_from([-1, 0, 1, 7, 10**4, 2**31 - 1]))
            with np.errstate(all="ignore"):
                changed.flat[draw(st.integers(0, value.size - 1))] = np.asarray(number).astype(value.dtype)
            members[name] = changed
        elif how == "cast" and value.dtype.kind in "iufb":
            kind = draw(st.sampled_from([np.float64, np.int64, np.float32, bool, ">f4", "U5"]))
            with np.errstate(all="ignore"):  # NaN is no whole number.
                members[name] = value.astype(kind)
        elif how == "cut" and value.ndim:
            members[name] = value[: draw(st.integers(0, len(value)))]
        else:
            members[name] = draw(ARRAYS)
    if draw(st.integers(0, 9)) == 0:
        members[draw(st.sampled_from(["x" * 60_000, "../../x", "format_version", ""]))] = draw(ARRAYS)
    try:
        content = packed(members)
    except (ValueError, UnicodeError):  # Such a name or text cannot be written.
        content = b"PK\x03\x04"
    return draw(damaged(content)) if draw(st.integers(0, 4)) == 0 else content


class Format(NamedTuple):
    """name: of the file; whole: its content; strategy: of damaged ones; read: what a program does with it, given its
    path."""

    name: str
    whole: bytes
    strategy: st.SearchStrategy
    read: Any


def npz(name: str, members: dict[str, np.ndarray], read: Any) -> Format:
    return Format(name, packed(members), damaged_npz(members), read)


def of(name: str, content: bytes, read: Any) -> Format:
    return Format(name, content, damaged(content), read)


def policy_members() -> dict[str, np.ndarray]:
    """An exported policy that can fly, of a small network."""
    draw = np.random.default_rng(0)
    first, second = (jnp.asarray(draw.normal(size=size), jnp.float32) for size in ((9, 5), (5, 4)))

    def values(observation, goal, noise):
        seen = jnp.concatenate([observation[0, :2].astype(jnp.float32).ravel() / 255, goal[:2], noise])
        return (jnp.maximum(seen @ first, 0) @ second,)

    examples = [((4, 6, 3), jnp.uint8), ((384,), jnp.float32), ((1,), jnp.float32)]
    program, constants = export.trace(values, [jax.ShapeDtypeStruct(*each) for each in examples])
    with np.load(drone_faults.write_policy(Path("whole.npz"), objects=["mug"])) as whole:
        about, goals = whole["about"], whole["goals"]
    members = {f"constant_{number}": value for number, value in enumerate(constants)}
    return members | {"about": about, "program": np.array(json.dumps(program)), "goals": goals}


def walk_members(**others: np.ndarray) -> dict[str, np.ndarray]:
    """Recorded episodes of two and three steps."""
    draw = np.random.default_rng(0)
    members = {
        "observations": draw.normal(size=(7, 4)).astype(np.float32),
        "actions": draw.uniform(-1, 1, (7, 2)).astype(np.float32),
        "terminals": np.eye(7, dtype=np.float32)[[2, 6]].sum(0),
    }
    return members | others


def read_walks(path: Path) -> None:
    """What can be read has no fault, and what has one cannot be read."""
    faults = [finding for finding in episodes.check_episodes(path) if finding.severity == "error"]
    try:
        found = episodes.load(path)
    except UserError:
        assert faults
        raise
    assert not faults and found.lengths.sum() == len(found.observations) - len(found.lengths)
    assert np.isfinite(found.actions).all() and episodes.describe(found)


def read_policy(path: Path) -> None:
    policy = mission.read_policy(path, str(path))
    flown = mission.flown_policy(policy, mission.read_question(policy, policy.about["goal_names"][0]), 0)
    assert 0 <= flown.policy(np.zeros((*flown.size, 3), np.uint8), np.ones(4, bool)) < 4


def bank_members() -> dict[str, np.ndarray]:
    """Goal images on a grid of eight, and one of each other use."""
    positions = np.concatenate([goal_images.grid_positions((0, 0, 0), 0.1, (2, 2, 2)), np.full((3, 3), 0.05)])
    uses = np.array([goal_images.GRID] * 8 + [goal_images.TRAIN, goal_images.VALIDATION, goal_images.TEST], np.int8)
    values = {
        "task": "fetch_reach", "images": np.zeros((11, 64, 64, 3), np.uint8), "positions": positions.astype(np.float32),
        "uses": uses, "grid_low": np.zeros(3, np.float32), "spacing": 0.1, "grid_shape": np.array([2, 2, 2]),
        "about": json.dumps({"seed": 0}),
    }  # fmt: skip
    return {name: np.asarray(values[name]) for name in goal_images.SCHEMA}


def text_members() -> dict[str, np.ndarray]:
    found = hand_made_frames.embeddings()
    text.save("texts.npz", found)
    with np.load("texts.npz") as members:
        return dict(members)


def crop_members() -> dict[str, np.ndarray]:
    crops = np.zeros((3, 8, 8, 3), np.uint8)
    return {"train": crops, "test": crops, "train_photographs": np.array(["a"]), "test_photographs": np.array(["b"])}


def two_runs() -> dict:
    """The numbers of two runs."""
    found = made_up_results.results(tasks=("object_search",), methods=("infogoal",))
    return dict(list(found.items())[:2])


def run_members() -> dict[str, np.ndarray]:
    return files.packed(next(iter(two_runs().values())))


def number_members() -> dict[str, np.ndarray]:
    numbers.save(two_runs(), Path("numbers"))
    (path,) = Path("numbers").iterdir()
    archive = archives.read(path, "")
    return {name: archives.member(archive, name, "") for name in archive.sizes}


def read_numbers(path: Path) -> None:
    for run, result in numbers.load(path.parent).items():
        assert run.name and result.kept is not None and isinstance(result.has_former_settings, bool)
        result.missing()


def read_run(path: Path) -> None:
    found = files.read(path)
    assert found.run.name and ".." not in Path(found.run.name).parts and found.command
    found.missing()


FLIGHT = b"".join(
    json.dumps(event).encode() + b"\n"
    for event in [
        {"time": 0.0, "event": "start", "date": "today"},
        {"time": 0.1, "event": "settings", "target": "mug", "host": "h", "simulated": True,
         "envelope": {"left": 1, "right": 2, "up": 1, "down": 0}},
        {"time": 0.2, "event": "image"}, {"time": 0.3, "event": "state"},
        {"time": 0.5, "event": "step", "outcome": "made", "low": [0, 0], "high": [1, 0], "latency": 0.1},
        {"time": 0.7, "event": "step", "outcome": "unanswered", "low": [0, 0], "high": [1, 1], "latency": 0.2},
        {"time": 0.8, "event": "landing", "reason": "found"},
        {"time": 0.9, "event": "end", "reason": "found", "found": True, "landed": True},
    ]
)  # fmt: skip


def read_flight(path: Path) -> None:
    events = records.read(path)
    assert flights.summary(events) and flights.flight(events)


TABLE = b"image,trajectory,time,action,state,x,y,objects\r\n" + b"".join(
    f"a/{row}.png,a,{row},{'right' if row < 3 else ''},{row} 0,{row},0,mug;cup\r\n".encode() for row in range(4)
)


def write_images(place: Path) -> None:
    (place / "a").mkdir(parents=True)
    for row in range(4):
        cv2.imwrite(str(place / "a" / f"{row}.png"), np.full((8, 8, 3), row, np.uint8))


def read_scenes(path: Path) -> None:
    root = path.parent.parent if path.name == "annotations.json" else path.parent
    assert isinstance(check.check_active_vision(root), list)
    seen = (root / "Home_101_1" / "present_instance_names.txt").read_text().split()[:1]
    active_vision.load(root, objects=seen, min_box_size=0.01, max_difficulty=5, cache_dir=root.parent / "cache")


def low_level_members() -> dict[str, np.ndarray]:
    """The shipped low level of FetchReach."""
    with np.load(low_level.shipped("fetch_reach")) as whole:
        return dict(whole)


def read_low_level(path: Path) -> None:
    low_level.read(str(path), hand_made_points.points())


SPLIT = json.dumps(
    {
        "objects": {
            f"{use}_{number}": {"room": room, "use": use}
            for use in ("train", "validation", "test")
            for number, room in enumerate(("kitchen", "hall"))
        }
    }
).encode()


def packed_run(path: Path) -> bytes:
    """A run of one seed, as `infogoal pack` writes it."""
    import hand_made
    from fuzzing import TREE

    path.mkdir()
    about = configuration.Description(hand_made.config(), [3], "rooms", {"jax": "1"}, "cpu")
    configuration.write(path, about)
    checkpoint.save(path / "policy", {"epoch": 1, **about.values()}, jax.tree.map(lambda leaf: leaf[None], TREE))
    row = {"seed": 3, "epoch": 1, "loss": 0.5, "agent/loss": 1.0, "agent/gradient_norm": 1.0}
    for table in tables.TABLES:
        tables.append_rows(path, table, [row])
    folder.pack(path, path.parent / "run.zip", 3)
    return (path.parent / "run.zip").read_bytes()


def plan_of_sweep(path: Path) -> bytes:
    """What is to be run by a sweep."""
    jobs.start(presets.load("point_maze"), jobs.Plan([{"discount": 0.9}, {"discount": 0.5}], [0, 1, 2], 2), path)
    return (path / jobs.NAME).read_bytes()


@st.composite
def damaged_zip(draw, content: bytes) -> bytes:
    """The zip of a packed run, of which a file is damaged, gone, or packed in another way."""
    if draw(st.booleans()):
        return draw(damaged(content))
    with zipfile.ZipFile(io.BytesIO(content)) as whole:
        members = {name: whole.read(name) for name in whole.namelist()}
    name = draw(st.sampled_from(sorted(members)))
    members[name] = draw(damaged(members[name]))
    if draw(st.integers(0, 3)) == 0:
        members[draw(st.sampled_from(["../x", "x" * 9000, "/x", "checkpoint"]))] = members.pop(name)
    found = io.BytesIO()
    with zipfile.ZipFile(found, "w", draw(st.sampled_from([zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA]))) as other:
        for each, own in members.items():
            other.writestr(each, own)
    return found.getvalue()


@pytest.fixture(scope="module")
def formats(tmp_path_factory, tiny_house) -> dict[str, Format]:
    """Every format, with files that are whole to begin with."""
    place = tmp_path_factory.mktemp("formats")
    with contextlib.chdir(place):
        frames.save("frames.npz", hand_made_frames.small())
        with np.load("frames.npz") as found:
            dataset = dict(found)
        write_images(place / "images")
        annotations = (tiny_house / "Home_101_1" / "annotations.json").read_bytes()
        instances = (tiny_house / "all_instance_id_map.txt").read_bytes()
        found = [
            npz("policy.npz", policy_members(), read_policy),
            npz("frames.npz", dataset, frames.load),
            npz("bank.npz", bank_members(), lambda path: goal_images.load(path, "fetch_reach")),
            npz("texts.npz", text_members(), text.load),
            npz(backgrounds.CROPS_FILE, crop_members(), lambda path: backgrounds.load(path.parent, 2)),
            npz("run.npz", run_members(), read_run),
            npz("paper.npz", number_members(), read_numbers),
            of("flight.jsonl", FLIGHT, read_flight),
            of(
                "moves.csv",
                TABLE,
                lambda path: frames_import.import_folder(place / "images", path, place / "imported.npz"),
            ),
            of("split.json", SPLIT, splits.load_split),
            of("questions.json", splits.SHIPPED_QUESTIONS.read_bytes(), splits.load_questions),
            of("Home_101_1/annotations.json", annotations, read_scenes),
            of("all_instance_id_map.txt", instances, read_scenes),
            npz("low_level.npz", low_level_members(), read_low_level),
            npz("walks.npz", walk_members(achieved_goals=np.zeros((7, 2), np.float32)), read_walks),
            npz(
                "transitions.npz",
                walk_members(next_observations=np.zeros((7, 4), np.float32), terminals=np.ones(7)),
                read_walks,
            ),
            npz("compact.npz", walk_members(valids=np.eye(7)[[2, 6]].sum(0) == 0), read_walks),
            of("sweep.json", plan_of_sweep(place / "sweep"), lambda path: jobs.read_plan(path.parent)),
            Format("run.zip", zipped := packed_run(place / "run"), damaged_zip(zipped), folder.find_run),
        ]
        return {format.name: format for format in found}


NAMES = [
    "policy.npz", "frames.npz", "bank.npz", "texts.npz", backgrounds.CROPS_FILE, "run.npz", "paper.npz",
    "flight.jsonl", "moves.csv", "split.json", "questions.json", "Home_101_1/annotations.json",
    "all_instance_id_map.txt", "low_level.npz", "walks.npz",
    "transitions.npz", "compact.npz", "sweep.json", "run.zip",
]  # fmt: skip
READERS = {
    "active_vision": "all_instance_id_map.txt", "backgrounds": backgrounds.CROPS_FILE, "episodes": "walks.npz",
    "frames": "frames.npz", "goal_images": "bank.npz", "splits": "split.json", "text": "texts.npz",
}  # fmt: skip
"""A file of each module of data that reads any."""


def test_every_reader_of_data_is_fuzzed(formats):
    found = set()
    for module in pkgutil.iter_modules(data.__path__):
        names = vars(importlib.import_module(f"{data.__name__}.{module.name}"))
        if any(name.split("_")[0] == "load" and inspect.isfunction(names[name]) for name in names):
            found.add(module.name)
    found.remove("sentence_encoder")  # It reads the folder of another library.
    assert found == {*READERS} and {*READERS.values()} <= {*NAMES} == {*formats}


@pytest.mark.filterwarnings("ignore:Generating overly large repr")
@pytest.mark.parametrize("count", [4, pytest.param(300, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_any_format_is_read_or_refused(name, count, formats, tmp_path, tiny_house, monkeypatch):
    what = formats[name]
    place = tmp_path / "place"
    monkeypatch.setattr(archives, "user_cache", lambda: tmp_path / "cache")
    if what.read is read_scenes:
        (place / "Home_101_1").mkdir(parents=True)
        for file in tiny_house.iterdir():
            if file.is_file():
                (place / file.name).write_bytes(file.read_bytes())
        for file in (tiny_house / "Home_101_1").iterdir():
            (place / "Home_101_1" / file.name).symlink_to(file)
        (place / what.name).unlink()
    place.mkdir(exist_ok=True)
    (place / what.name).write_bytes(what.whole)
    what.read(place / what.name)

    @examples_of(count, short=4)
    @given(what.strategy)
    def check_one(content):
        path = place / what.name
        path.write_bytes(content)
        before = digest(place)
        with contextlib.suppress(UserError):
            what.read(path)
        assert digest(place) == before

    check_one()
