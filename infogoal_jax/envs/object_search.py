"""Object search (paper, Sec. V-A.2): a robot moves along the edges of a graph of photographs until the object named by the goal is in view.

An observation is the index of an image, and so is the record of what was achieved: both stay small in the replay buffer, and arrays say the rest.
"""

import dataclasses
import hashlib

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.data import active_vision, splits, text
from infogoal_jax.errors import require
from infogoal_jax.goals import GoalSet

UNREACHABLE = np.iinfo(np.int16).max


@dataclasses.dataclass(frozen=True)
class ObjectSearchConfig:
    """Where the images come from and how an episode runs."""

    dataset: str = ""
    """Folder in the format of the Active Vision Dataset; empty: the synthetic house that the project ships (a stand-in)."""
    scenes: tuple[str, ...] = ()
    """Scenes to use, such as Home_001_1; empty: all that the folder holds."""
    split: str = ""
    """JSON file that names the objects, their rooms and their use (docs/object_search.md); empty: the authors' split."""
    text_embeddings: str = ""
    """Sentence embeddings of the object names, an npz of `infogoal data embed`; empty: those that the project ships."""
    image_size: int = 32
    """Side of the grey images that the agent sees, in pixels."""
    min_box_size: float = active_vision.DEFAULT_MIN_BOX_SIZE
    """Shortest side of a detected box as a share of the image's height: the robot must have a clear view."""
    max_difficulty: int = 4
    """Boxes of a higher difficulty do not count as detected (the dataset's authors use 4)."""
    episode_length: int = 100
    """Steps after which an episode is truncated [A]."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        for name in ("image_size", "episode_length"):
            require(getattr(self, name) > 0, f"env.{name}", getattr(self, name), "give a whole number greater than 0")
        require(0 <= self.min_box_size < 1, "env.min_box_size", self.min_box_size, "give a share of the image's height, from 0 to below 1")
        require(self.image_size % config.state_encoder.patch == 0, "env.image_size", self.image_size,
                f"must be a multiple of state_encoder.patch = {config.state_encoder.patch}")


@flax.struct.dataclass
class SearchState:
    """One episode: node and goal are indices (int32), time counts steps; terminated (goal in view) and truncated (time is up) are never both set."""

    node: jax.Array
    goal: jax.Array
    time: jax.Array
    terminated: jax.Array
    truncated: jax.Array

    @property
    def diverged(self) -> jax.Array:
        """Never set: a graph cannot diverge as a simulation can."""
        return jnp.zeros_like(self.terminated)


@flax.struct.dataclass
class ObjectSearch:
    """The environment: static arrays and pure functions over them. It is a pytree, to be passed to compiled programs as an argument.

    images: uint8 [S, H, W]; next_node: int32 [S, 6] (its own index where there is no edge); goals: N goals.
    achieved_goals: int32 [S, K] the goals in view of each image, padded with -1; in_view: bool [S, N].
    distance: int16 [N, S] steps to the nearest image with the goal in view. starts: int32 [N, M] images from which an episode for the goal may start
    (the goal out of view, but within reach), the first num_starts [N] of each row.
    position: float32 [S, 3] plan x and y (metres) and heading (radians), NaN where unknown.
    """

    images: jax.Array
    next_node: jax.Array
    achieved_goals: jax.Array
    in_view: jax.Array
    distance: jax.Array
    starts: jax.Array
    num_starts: jax.Array
    position: jax.Array
    goals: GoalSet
    episode_length: int = flax.struct.field(pytree_node=False)
    source: str = flax.struct.field(pytree_node=False)

    train_backgrounds = test_backgrounds = None
    """Its goals are texts: there is no image to corrupt."""
    action_size = len(active_vision.ACTIONS)
    """Number of actions."""

    @property
    def num_observations(self) -> int:
        """Number of different observations: each is the index of an image."""
        return self.images.shape[0]

    def reset(self, key: jax.Array) -> SearchState:
        """A new episode: a training goal, and a start from which it is out of view, both uniform."""
        choose_goal, choose_start = jax.random.split(key)
        goal = jax.random.categorical(choose_goal, jnp.where(self.goals.train_mask, 0.0, -jnp.inf))
        return self.reset_to(choose_start, goal)

    def reset_to(self, key: jax.Array, goal: jax.Array) -> SearchState:
        """A new episode for this goal (int32), from a start that is uniform among those from which the goal is out of view."""
        node = self.starts[goal, jax.random.randint(key, (), 0, self.num_starts[goal])]
        false = jnp.zeros((), bool)
        return SearchState(node=node, goal=goal.astype(jnp.int32), time=jnp.zeros((), jnp.int32), terminated=false, truncated=false)

    def step(self, state: SearchState, action: jax.Array) -> SearchState:
        """Follow the edge of this action (int32, order of `active_vision.ACTIONS`); a step that has no edge stays in place."""
        node = self.next_node[state.node, action]
        time = state.time + 1
        terminated = self.reached(node, state.goal)
        return state.replace(node=node, time=time, terminated=terminated, truncated=(time >= self.episode_length) & ~terminated)

    def observe(self, state: SearchState) -> jax.Array:
        """What is stored of the observation: the index of the image, int32."""
        return state.node

    def render(self, observation: jax.Array) -> jax.Array:
        """What the network sees: images uint8 [..., H, W] for stored observations int32 [...]."""
        return self.images[observation]

    def achieved(self, state: SearchState) -> jax.Array:
        """The record of what was achieved: the index of the image, int32."""
        return state.node

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether the goal's object is detected in the image, bool [...], for records and goals int32 [...]."""
        return self.in_view[record, goal]

    def goals_of(self, record: jax.Array) -> jax.Array:
        """The goals in view, int32 [..., K], padded with -1."""
        return self.achieved_goals[record]

    def action_mask(self, observation: jax.Array) -> jax.Array:
        """The actions that lead somewhere, bool [..., 6]; all of them where none does."""
        mask = self.next_node[observation] != observation[..., None]
        return mask | ~mask.any(-1, keepdims=True)

    def decides(self, state: SearchState) -> jax.Array:
        """Whether the next step follows a decision of the agent: always, bool."""
        return jnp.ones_like(state.terminated)

    def shortest_path(self, state: SearchState) -> jax.Array:
        """Steps to the nearest image with the goal in view, int32."""
        return self.distance[state.goal, state.node].astype(jnp.int32)


def distances(next_node: np.ndarray, in_view: np.ndarray) -> np.ndarray:
    """Steps from every image to the nearest with the goal in view: int32 [S, 6] and bool [S, N] to int16 [N, S], by breadth-first search."""
    distance = np.full((in_view.shape[1], len(next_node)), UNREACHABLE, np.int16)
    distance[in_view.T] = 0
    for step in range(1, len(next_node) + 1):
        arrives = (distance[:, next_node] == step - 1).any(-1) & (distance == UNREACHABLE)
        if not arrives.any():
            return distance
        distance[arrives] = step
    return distance


def make(config: ObjectSearchConfig) -> ObjectSearch:
    """Load the images, goals and embeddings that the configuration names. Raises `UserError` for what cannot be used."""
    split = splits.load_split(config.split) if config.split else splits.AUTHORS_SPLIT
    names = split.objects
    embeddings = text.load(config.text_embeddings) if config.text_embeddings else text.load_shipped()
    inputs = text.embed_known([name.replace("_", " ") for name in names], embeddings)
    scenes = active_vision.load(
        config.dataset or active_vision.SHIPPED_HOUSE, objects=names, scenes=config.scenes or None,
        image_size=config.image_size, min_box_size=config.min_box_size, max_difficulty=config.max_difficulty,
    )
    return lay_out(scenes, split, inputs, config.episode_length)


def lay_out(scenes: active_vision.SearchScenes, split: splits.Split, inputs: np.ndarray, episode_length: int) -> ObjectSearch:
    """The environment over these scenes, whose object names are the split's training, validation and test objects in this order.

    inputs: float32 [N, D], what the goal encoder sees of each object. Raises `UserError` for an object that no episode can reach.
    """
    names = split.objects
    require(bool(split.train), "env.split", "", "names no training object; mark at least one with \"use\": \"train\"")
    distance = distances(scenes.next_state, scenes.visible)
    may_start = (distance > 0) & (distance <= episode_length)  # Farther away, or unreachable, no episode could succeed.
    unreachable = [name for name, possible in zip(names, may_start, strict=True) if not possible.any()]
    require(not unreachable, "env.split", ", ".join(unreachable),
            f"can be reached within {episode_length} steps from nowhere in {scenes.source}: take it out of the split, "
            "lower env.min_box_size, or run `infogoal data check` on the dataset")
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in (scenes.images, scenes.next_state, scenes.visible, inputs)))
    uses = np.repeat(np.arange(3), [len(split.train), len(split.validation), len(split.test)])
    goals = GoalSet.of(inputs, [split.rooms[name] for name in names], uses, names, split.room_names)
    return ObjectSearch(
        images=jnp.asarray(scenes.images), next_node=jnp.asarray(scenes.next_state), achieved_goals=jnp.asarray(pad_true(scenes.visible)),
        in_view=jnp.asarray(scenes.visible), distance=jnp.asarray(distance), starts=jnp.asarray(np.maximum(pad_true(may_start), 0)),
        num_starts=jnp.asarray(may_start.sum(1), jnp.int32), position=jnp.asarray(scenes.position), goals=goals,
        episode_length=episode_length, source=f"{scenes.source}, content {digest.hexdigest()[:8]}",
    )


def pad_true(mask: np.ndarray) -> np.ndarray:
    """The columns of the true entries of each row, padded with -1: bool [R, C] to int32 [R, K] with K the largest count (at least 1)."""
    columns = np.full((len(mask), max(1, mask.sum(1).max(initial=0))), -1, np.int32)
    for row, row_mask in enumerate(mask):
        columns[row, : row_mask.sum()] = np.flatnonzero(row_mask)
    return columns
