"""Image datasets small enough to check by hand: six frames, as records and as a file with faults planted in it; an arm
with three joints that turn by 60 degrees; a shelf of 8 x 3 places with four objects. CIFAR-10 in its own format, with a
few records of noise, and the sizes of a house that is built in a moment."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

from infogoal_jax import presets
from infogoal_jax.config import StateEncoderConfig, TrainConfig
from infogoal_jax.data import backgrounds, frames
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.data.splits import Questions
from infogoal_jax.data.text import EMBEDDING_SIZE, TextEmbeddings
from infogoal_jax.envs import embodied_qa, object_manipulation
from infogoal_jax.envs.embodied_qa import EmbodiedQAConfig
from infogoal_jax.envs.object_manipulation import ObjectManipulationConfig

TINY_HOUSE = {"node_spacing": 1.2, "image_width": 64}
"""Images of 64 x 36 pixels, nodes 1.2 m apart."""
BATCHES = (*backgrounds.TRAIN_BATCHES, *backgrounds.TEST_BATCHES)
"""Of CIFAR-10."""


def small(**changes) -> FrameDataset:
    """Six frames of five states in a row; two trajectories: 0 1 2 3 to the right, 4 5 0 to the left."""
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 10, 3), np.uint8)
    turns = [cv2.Rodrigues(np.array([0.1, 0.2, 0.3]) * row)[0] for row in range(6)]
    fields = {
        "frames": pixels,
        "state": np.array([0, 1, 2, 3, 4, 4], np.int32),
        "actions": ("right", "left ←"),
        "frame": np.array([0, 1, 2, 4, 5], np.int32),
        "action": np.array([0, 0, 0, 1, 0], np.int32),
        "next_frame": np.array([1, 2, 3, 5, 0], np.int32),
        "trajectory": np.array([3, 3, 3, 7, 7], np.int32),
        "time": np.array([0, 1, 2, 0, 1], np.int32),
        "terminal": np.array([False, False, True, False, True]),
        "about": {"name": "a row of five", "stand_in": True, "made_by": "a test", "seed": 3},
        "rotation": np.array(turns, np.float32),
        "joints": np.arange(12, dtype=np.float32).reshape(6, 2),
        "joint_names": ("shoulder", "rail_m"),
        "position": np.arange(12, dtype=np.float32).reshape(6, 2) / 3,
        "detected": np.eye(6, 2, dtype=bool),
        "objects": ("a red mug", "una caña"),
    }
    return FrameDataset(**(fields | changes))


def changed(name: str, row, value) -> dict:
    """The member of `small` with another value in a row."""
    array = np.array(frames.members_of(small())[name])
    array[row] = value
    return {name: array}


MOVES = ("frame", "action", "next_frame", "trajectory", "time", "terminal")
OPTIONAL = {"rotation": None, "joints": None, "position": None, "detected": None, "objects": (), "joint_names": ()}


def planted(path, **changes) -> None:
    """A file of `small` with other members; None leaves one out."""
    members = frames.members_of(small()) | changes
    np.savez(path, **{name: value for name, value in members.items() if value is not None})


def write_cifar10(folder: Path, records: int = 3) -> np.ndarray:
    """Six batches in the format of the binary version; the images of the first, uint8 [records, 32, 32, 3]."""
    folder.mkdir(parents=True)
    generator = np.random.default_rng(0)
    for name in reversed(BATCHES):
        pictures = generator.integers(0, 256, (records, 32, 32, 3), np.uint8)
        labels = generator.integers(0, 10, (records, 1), np.uint8)
        planes = pictures.transpose(0, 3, 1, 2).reshape(records, -1)
        (folder / name).write_bytes(np.concatenate([labels, planes], 1).tobytes())
    return pictures


STEPS = 6
"""Settings of each joint."""
SIDE = 8
"""Of the images, in pixels."""
WIDTH, HEIGHT, OBJECTS = 8, 3, ("red mug", "blue book", "green ball", "old clock")
ABOUT = {"name": "hand-made", "stand_in": True, "made_by": "tests"}


def about(axis: int, angles: np.ndarray) -> np.ndarray:
    """Rotations [K, 3, 3] about x, y or z by angles [K]."""
    cosine, sine, turned = np.cos(angles), np.sin(angles), np.tile(np.eye(3), (len(angles), 1, 1))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turned[:, first, first], turned[:, first, second], turned[:, second, first], turned[:, second, second] = (
        cosine,
        -sine,
        sine,
        cosine,
    )
    return turned


def arm() -> FrameDataset:
    """Every setting of three joints, turning the object about z, y and x; six moves; each image random but fixed."""
    setting = np.stack(np.meshgrid(*[np.arange(STEPS)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    joints = -np.pi + 2 * np.pi / STEPS * setting
    rotation = about(2, joints[:, 0]) @ about(1, joints[:, 1]) @ about(0, joints[:, 2])
    frame, action = (part.ravel() for part in np.meshgrid(np.arange(len(setting)), np.arange(6), indexing="ij"))
    turned = (setting[frame] + np.eye(3, dtype=int)[action // 2] * np.where(action % 2, -1, 1)[:, None]) % STEPS
    count = len(frame)
    return FrameDataset(
        frames=np.random.default_rng(0).integers(0, 256, (len(setting), SIDE, SIDE, 3), dtype=np.uint8),
        state=np.arange(len(setting), dtype=np.int32),
        actions=tuple(f"joint {joint} {sign}" for joint in (1, 2, 6) for sign in "+-"),
        frame=frame.astype(np.int32),
        action=action.astype(np.int32),
        next_frame=(turned @ [STEPS**2, STEPS, 1]).astype(np.int32),
        trajectory=np.arange(count, dtype=np.int32),
        time=np.zeros(count, np.int32),
        terminal=np.ones(count, bool),
        about=ABOUT,
        rotation=rotation.astype(np.float32),
        joints=joints.astype(np.float32),
        joint_names=("joint 1", "joint 2", "joint 6"),
    )


def shelf(flights: int = 60, length: int = 12) -> FrameDataset:
    """Places in a row-by-row order, moves left, right, up and down, flights at random; an object is seen from the
    places around it."""
    random, places = np.random.default_rng(1), WIDTH * HEIGHT
    x, y = np.arange(places) % WIDTH, np.arange(places) // WIDTH
    step = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
    place = np.stack([x, y], axis=-1)[:, None] + step
    inside = ((place >= 0) & (place < [WIDTH, HEIGHT])).all(-1)
    table = np.where(inside, place @ [1, WIDTH], np.arange(places)[:, None])
    homes = np.array([[0, 0], [WIDTH - 1, 0], [0, HEIGHT - 1], [WIDTH - 1, HEIGHT - 1]])
    detected = np.abs(np.stack([x, y], -1)[:, None] - homes).max(-1) <= 1
    rows = []
    for flight in range(flights):
        here = random.integers(places)
        for time in range(length):
            move = random.choice(np.flatnonzero(inside[here]))
            rows.append((here, move, table[here, move], flight, time, time == length - 1))
            here = table[here, move]
    frame, action, next_frame, trajectory, time, terminal = (np.array(column) for column in zip(*rows, strict=True))
    whole = {"frame": frame, "action": action, "next_frame": next_frame, "trajectory": trajectory, "time": time}
    return FrameDataset(
        frames=random.integers(0, 256, (places, SIDE, SIDE, 3), dtype=np.uint8),
        state=np.arange(places, dtype=np.int32),
        actions=("left", "right", "up", "down"),
        **{name: part.astype(np.int32) for name, part in whole.items()},
        terminal=terminal.astype(bool),
        about=ABOUT,
        position=(0.2 * np.stack([x, y], -1)).astype(np.float32),
        detected=detected,
        objects=OBJECTS,
    )


def backgrounds() -> SimpleNamespace:
    """Noise of the images' size, other for training than for the test."""
    noise = np.random.default_rng(2).integers(0, 256, (2, 5, SIDE, SIDE, 3)).astype(np.uint8)
    return SimpleNamespace(train=noise[0], test=noise[1], source="noise")


def manipulation(**changes) -> object_manipulation.ObjectManipulation:
    """Object manipulation over the arm."""
    config = ObjectManipulationConfig(**({"num_goals": (3, 1, 4), "episode_length": 12} | changes))
    return object_manipulation.from_data(arm(), None if config.privileged else backgrounds(), config)


def manipulation_config(method: str = "infogoal", **changes) -> TrainConfig:
    """A configuration that trains on it in seconds; by DQN, since the shipped low level belongs to another arm."""
    small = {
        "env": ObjectManipulationConfig(num_goals=(3, 1, 4), episode_length=12),
        "agent": "dqn",
        "num_epochs": 2,
        "epochs_per_evaluation": 1,
        "num_envs": 8,
        "rollout_steps": 20,
        "updates_per_epoch": 5,
        "batch_size": 32,
        "buffer_steps": 2000,
        "evaluation_starts": 2,
        "state_encoder": StateEncoderConfig(features=32),
    }
    return presets.load("object_manipulation", method, **(small | changes))


def privileged_config(method: str = "infogoal", **changes) -> TrainConfig:
    """The same with poses in place of images, as `manipulation(privileged=True)` shows them."""
    config = manipulation_config(method, **changes)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, privileged=True))


def asked() -> Questions:
    """Five questions about each of the four objects, two of which are trained on; a room for each."""
    rooms = tuple(f"corner {number}" for number in range(4))
    questions = tuple(tuple(f"question {number} about the {name}" for number in range(5)) for name in OBJECTS)
    return Questions(
        room_names=rooms,
        objects=OBJECTS,
        rooms=(0, 1, 2, 3),
        uses=("train", "test", "train", "test"),
        questions=questions,
    )


def embeddings() -> TextEmbeddings:
    """Random unit vectors: those of an object's name and questions lie close together."""
    random, questions = np.random.default_rng(3), asked()
    texts, vectors = [], []
    for name, about_it in zip(questions.objects, questions.questions, strict=True):
        centre = random.normal(size=EMBEDDING_SIZE)
        for words in (name, *about_it):
            texts.append(words)
            vectors.append(centre + 0.5 * random.normal(size=EMBEDDING_SIZE))
    vectors = np.stack(vectors).astype(np.float32)
    return TextEmbeddings(tuple(texts), vectors / np.linalg.norm(vectors, axis=1, keepdims=True), "none", "random")


def qa(**changes) -> embodied_qa.EmbodiedQA:
    """Embodied question answering over the shelf."""
    return embodied_qa.from_data(shelf(), asked(), embeddings(), EmbodiedQAConfig(**({"episode_length": 15} | changes)))


def qa_config(method: str = "infogoal", **changes) -> TrainConfig:
    """A configuration that trains on it in seconds."""
    small = {
        "env": EmbodiedQAConfig(episode_length=15),
        "num_epochs": 2,
        "epochs_per_evaluation": 1,
        "updates_per_epoch": 20,
        "batch_size": 64,
        "evaluation_starts": 2,
        "state_encoder": StateEncoderConfig(features=32),
    }
    return presets.load("embodied_qa", method, **(small | changes))
