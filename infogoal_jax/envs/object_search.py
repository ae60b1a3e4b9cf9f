"""Object search (paper, Sec. V-A.2): a robot moves along the edges of a graph of photographs until the object named by
the goal is in view.

An observation is the index of an image, and so is the record of what was achieved. Both are small in the replay buffer;
arrays hold the rest. With a memory, an observation has a plan of where the robot was beside it.
"""

import dataclasses
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.data import active_vision, archives, splits, text
from infogoal_jax.envs.environment import Traits
from infogoal_jax.envs.graph import (
    DetectionWalk,
    GraphState,
    distances,
    pad_true,
    possible_starts,
    walk_arrays,
    with_uses,
)
from infogoal_jax.errors import require
from infogoal_jax.field_types import Size, Within
from infogoal_jax.goals import GoalSet

PLAN = 16
"""Cells along a side of the plan that a memory is."""
HERE = 255
"""Level of the cell in which the robot is."""
IMAGE_SIDES = Within("[4, 512]", "give at least 4 and at most 512 pixels")
"""Sides of the images that can be read, in pixels."""


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
    image_size: Annotated[int, IMAGE_SIDES] = 32
    """Side of the grey images that the agent sees, in pixels."""
    min_box_size: Annotated[float, Within("[0, 1)", "give a share of the image's height, from 0 to below 1")] = (
        active_vision.DEFAULT_MIN_BOX_SIZE
    )
    """Shortest side of a box that counts as detected, as a share of the image's height (a clear view)."""
    max_difficulty: int = 4
    """Highest difficulty of a box that counts as detected (the dataset's authors use 4)."""
    episode_length: Size = 100
    """Steps after which an episode is truncated [A]."""
    memory: bool = False
    """Show where the robot was in this episode: a plan of the scene, beside the image."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        patch = config.state_encoder.patch
        remedy = f"must be a multiple of state_encoder.patch = {patch}"
        require(self.image_size % patch == 0, "env.image_size", self.image_size, remedy)


@flax.struct.dataclass
class ObjectSearch(DetectionWalk):
    """The environment: a walk on a graph of grey photographs. All goals are known. position: x and y on the plan (m),
    heading (radians)."""

    action_names = active_vision.ACTIONS

    def render(self, observation: jax.Array) -> jax.Array:
        """What the network sees: grey images uint8 [..., H, W, 1] for stored observations int32 [...]."""
        return self.images[observation][..., None]


@flax.struct.dataclass
class Remembered:
    """An observation with a memory."""

    image: jax.Array
    """int32 [...], index of the image."""
    visited: jax.Array
    """uint8 [..., PLAN * PLAN], the cells of the plan by rows: `HERE` where the robot is, less where it was longer ago
    in this episode, 0 where it was not."""


@flax.struct.dataclass
class RememberingState(GraphState):
    """One episode, and `Remembered.visited` of it."""

    visited: jax.Array | None = None


@flax.struct.dataclass
class RememberingSearch(ObjectSearch):
    """Object search in which the robot remembers where it was. The plan is a second channel of what it sees."""

    cell: jax.Array = flax.struct.field(kw_only=True)
    """int32 [K], the cell of the plan in which each image was taken."""

    num_observations = None

    def reset_to(self, key: jax.Array, goal: jax.Array) -> RememberingState:
        """A new episode, of which the start alone is remembered."""
        state = super().reset_to(key, goal)
        return RememberingState(**vars(state), visited=self.visit(jnp.zeros(PLAN**2, jnp.uint8), state.node))

    def step(self, state: RememberingState, action: jax.Array) -> RememberingState:
        """Follow the edge of this action (int32), and remember where it leads."""
        state = super().step(state, action)
        return state.replace(visited=self.visit(state.visited, state.node))

    def visit(self, visited: jax.Array, node: jax.Array) -> jax.Array:
        """The memory after a step to this image. No cell that was visited fades to 0."""
        fade = np.uint8(max(1, (HERE - 1) // self.episode_length))
        faded = jnp.where(visited > 0, jnp.maximum(visited, fade + 1) - fade, visited)
        return faded.at[self.cell[node]].set(HERE)

    def observe(self, state: RememberingState) -> Remembered:
        return Remembered(state.node, state.visited)

    def node_of(self, observation: Remembered) -> jax.Array:
        """The image of stored observations, int32 [...]."""
        return observation.image

    def render(self, observation: Remembered) -> jax.Array:
        """What the network sees: the grey image and the plan in its size, uint8 [..., H, W, 2]."""
        image = self.images[observation.image]
        row, column = (np.arange(side) * PLAN // side for side in image.shape[-2:])
        plan = observation.visited[..., row[:, None] * PLAN + column]
        return jnp.stack([image, plan], -1)

    def draw(self, state: RememberingState) -> jax.Array:
        """The image that is seen, uint8 [H, W, 3], in three equal colours."""
        return jnp.repeat(self.images[state.node][..., None], 3, -1)


def cells_of(position: np.ndarray, scene: np.ndarray) -> np.ndarray:
    """The cell of a plan in which each image was taken, int32 [K]: every scene has a plan, a square that it fills.
    position: float32 [K, D], x and y (m) first; scene: int32 [K]."""
    cells = np.zeros(len(position), np.int32)
    for number in np.unique(scene):
        own = scene == number
        away = position[own, :2] - position[own, :2].min(0)
        row_column = np.minimum(away / max(away.max(), 1e-3) * PLAN, PLAN - 1).astype(np.int32)
        cells[own] = row_column @ np.array([PLAN, 1], np.int32)
    return cells


def traits(config: ObjectSearchConfig) -> Traits:
    return Traits(finite_observations=not config.memory)


def make(config: ObjectSearchConfig) -> ObjectSearch:
    """Make the task of this configuration. Raises `UserError` for values and files that cannot be used."""
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
    env = from_data(scenes, split, inputs, config.episode_length, config.memory)
    return with_uses(env) if config.split else env


def from_data(
    scenes: active_vision.SearchScenes,
    split: splits.Split,
    inputs: np.ndarray,
    episode_length: int,
    memory: bool = False,
) -> ObjectSearch:
    """Make the environment from scenes whose object names are the split's training, validation and test objects in this
    order.

    inputs: float32 [N, D], goal input of each object. memory: whether the robot remembers where it was. Raises
    `UserError` for an object that no episode can reach, and for a memory where images do not say where they were taken.
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
    content = archives.checksum(scenes.images, scenes.next_state, scenes.visible, inputs)
    uses = np.repeat(np.arange(3), [len(split.train), len(split.validation), len(split.test)])
    goals = GoalSet.of(inputs, [split.rooms[name] for name in names], uses, names, split.room_names)
    kind, remembering = ObjectSearch, {}
    if memory:
        unknown = np.isnan(scenes.position[:, :2]).any(1)
        where = f"{unknown.sum()} of {len(unknown)} images of {scenes.source} do not say where they were taken"
        require(not unknown.any(), "env.memory", memory, f"{where}: give False")
        kind, remembering = RememberingSearch, {"cell": jax.device_put(cells_of(scenes.position, scenes.scene))}
    return kind(
        images=jax.device_put(scenes.images),
        achieved_goals=jax.device_put(pad_true(scenes.visible)),
        in_view=jax.device_put(scenes.visible),
        position=jax.device_put(scenes.position),
        source=f"{scenes.source}, content {content}",
        **walk_arrays(scenes.next_state, goals, distance, episode_length),
        **remembering,
    )
