"""Object search (paper, Sec. V-A.2): a robot moves along the edges of a graph of photographs until the object named by
the goal is in view.

An observation is the index of an image, and so is the record of what was achieved. Both are small in the replay buffer;
arrays hold the rest.
"""

import dataclasses
from typing import Annotated

import flax.struct
import jax
import numpy as np

from infogoal_jax.data import active_vision, archives, splits, text
from infogoal_jax.envs.environment import Traits
from infogoal_jax.envs.graph import DetectionWalk, distances, pad_true, possible_starts, walk_arrays
from infogoal_jax.errors import require
from infogoal_jax.field_types import Size, Within
from infogoal_jax.goals import GoalSet


@dataclasses.dataclass(frozen=True)
class ObjectSearchConfig:
    """Source of the images, and length of an episode."""

    dataset: str = ""
    """Folder in the format of the Active Vision Dataset; empty: a synthetic house (a stand-in), built once and kept in
    the user's cache."""
    scenes: tuple[str, ...] = ()
    """Scenes to use, such as Home_001_1; empty: all that the folder holds."""
    split: str = ""
    """JSON file that names the objects, their rooms and their use (docs/reference/object_search.md); empty: the
    authors' split."""
    text_embeddings: str = ""
    """Sentence embeddings of the object names, an npz of `infogoal data embed`; empty: those that the project ships."""
    image_size: int = 32
    """Side of the grey images that the agent sees, in pixels."""
    min_box_size: Annotated[float, Within("[0, 1)", "give a share of the image's height, from 0 to below 1")] = (
        active_vision.DEFAULT_MIN_BOX_SIZE
    )
    """Shortest side of a box that counts as detected, as a share of the image's height (a clear view)."""
    max_difficulty: int = 4
    """Highest difficulty of a box that counts as detected (the dataset's authors use 4)."""
    episode_length: Size = 100
    """Steps after which an episode is truncated [A]."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        require(
            active_vision.SMALLEST_IMAGE <= self.image_size <= active_vision.LARGEST_IMAGE,
            "env.image_size",
            self.image_size,
            f"give at least {active_vision.SMALLEST_IMAGE} and at most {active_vision.LARGEST_IMAGE} pixels",
        )
        if config is not None:  # None: the task alone, without what sees it.
            patch = config.state_encoder.patch
            require(
                self.image_size % patch == 0,
                "env.image_size",
                self.image_size,
                f"must be a multiple of state_encoder.patch = {patch}",
            )


@flax.struct.dataclass
class ObjectSearch(DetectionWalk):
    """The environment: a walk on a graph of grey photographs. All goals are known. position: x and y on the plan (m),
    heading (radians)."""

    action_names = active_vision.ACTIONS

    def render(self, observation: jax.Array) -> jax.Array:
        """What the network sees: grey images uint8 [..., H, W, 1] for stored observations int32 [...]."""
        return self.images[observation][..., None]


def traits(config: ObjectSearchConfig) -> Traits:
    """What the task can be combined with follows from these."""
    return Traits(finite_observations=True)


def make(config: ObjectSearchConfig) -> ObjectSearch:
    """Make the task of this configuration. Raises `UserError` for values and files that cannot be used."""
    config.check(None)
    split = splits.load_split(config.split) if config.split else splits.AUTHORS_SPLIT
    names = split.objects
    embeddings = text.load(config.text_embeddings) if config.text_embeddings else text.load_shipped()
    inputs = text.embed_known([name.replace("_", " ") for name in names], embeddings)
    reading = {
        "objects": names,
        "scenes": config.scenes or None,
        "image_size": config.image_size,
        "min_box_size": config.min_box_size,
        "max_difficulty": config.max_difficulty,
    }
    if config.dataset:
        scenes = active_vision.load(config.dataset, **reading)
    else:
        from infogoal_jax.stand_ins import house

        scenes = house.load(**reading)
    return lay_out(scenes, split, inputs, config.episode_length)


def lay_out(
    scenes: active_vision.SearchScenes, split: splits.Split, inputs: np.ndarray, episode_length: int
) -> ObjectSearch:
    """Make the environment from scenes whose object names are the split's training, validation and test objects in this
    order.

    inputs: float32 [N, D], goal input of each object. Raises `UserError` for an object that no episode can reach.
    """
    names = split.objects
    require(bool(split.train), "env.split", "", 'names no training object; mark at least one with "use": "train"')
    distance = distances(scenes.next_state, scenes.visible)
    reachable = possible_starts(distance, episode_length).any(1)
    unreachable = [name for name, possible in zip(names, reachable, strict=True) if not possible]
    require(
        not unreachable,
        "env.split",
        ", ".join(unreachable),
        f"can be reached within {episode_length} steps from nowhere in {scenes.source}: take it out of the split, "
        "lower env.min_box_size, or run `infogoal data check` on the dataset",
    )
    content = archives.content_of(scenes.images, scenes.next_state, scenes.visible, inputs)
    uses = np.repeat(np.arange(3), [len(split.train), len(split.validation), len(split.test)])
    goals = GoalSet.of(inputs, [split.rooms[name] for name in names], uses, names, split.room_names)
    return ObjectSearch(
        images=jax.device_put(scenes.images),
        achieved_goals=jax.device_put(pad_true(scenes.visible)),
        in_view=jax.device_put(scenes.visible),
        position=jax.device_put(scenes.position),
        source=f"{scenes.source}, content {content}",
        **walk_arrays(scenes.next_state, goals, distance, episode_length),
    )
