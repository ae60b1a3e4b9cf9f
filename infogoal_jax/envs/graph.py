"""The base of tasks on a graph of images: moves along edges, starts at which the goal is not reached, shortest paths.

A node is the index of an image. Object search, object manipulation and embodied question answering are such tasks. They
differ in what an image shows, and in when a goal is reached.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.data import archives, frames
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.envs.environment import Environment
from infogoal_jax.goals import GoalSet
from infogoal_jax.replay import Trajectories

UNREACHABLE = np.iinfo(np.int16).max


@flax.struct.dataclass
class GraphState:
    """One episode. `terminated` and `truncated` are never both set."""

    node: jax.Array
    """int32, index of the image."""
    desired_goal: jax.Array
    """int32."""
    time: jax.Array
    """int32, steps so far."""
    terminated: jax.Array
    """bool, the goal is reached."""
    truncated: jax.Array
    """bool, the time is up."""
    key: jax.Array | None = None
    """Key of random transitions; None where transitions are deterministic."""

    @property
    def diverged(self) -> jax.Array:
        """False: a graph cannot diverge as a simulation can."""
        return jnp.zeros_like(self.terminated)


@flax.struct.dataclass
class GraphWalk(Environment):
    """Static arrays and pure functions over them, for K images, A actions and N goals, of which M are evaluated. Tasks
    add `reached` and `goals_of`.

    A pytree: pass it to compiled programs as an argument.
    """

    next_node: jax.Array
    """int32 [K, A], the image that each action leads to; the image's own index where there is no edge."""
    goals: GoalSet
    """N goals."""
    place: jax.Array
    """int32 [N], row of each evaluated goal in the three arrays below."""
    distance: jax.Array
    """int16 [M, K], steps to the nearest node that reaches the goal."""
    starts: jax.Array
    """int32 [M, P], nodes from which an episode for the goal may start: they do not reach it, and it is within the
    episode's length."""
    num_starts: jax.Array
    """int32 [M], number of starts in each row of `starts`."""
    episode_length: int = flax.struct.field(pytree_node=False)
    """Steps after which an episode is truncated."""
    source: str = flax.struct.field(pytree_node=False)
    """The data in words."""

    has_shortest_path = True
    recorded: Trajectories | None = flax.struct.field(default=None, kw_only=True)
    train_backgrounds: jax.Array | None = flax.struct.field(default=None, kw_only=True)
    test_backgrounds: jax.Array | None = flax.struct.field(default=None, kw_only=True)
    views: jax.Array | None = flax.struct.field(default=None, kw_only=True)
    """int32 [K, V], images that show the same state as each image. On arrival one of them is drawn at random. None:
    every state has one image."""

    @property
    def action_size(self) -> int:
        return self.next_node.shape[1]

    def reset(self, key: jax.Array) -> GraphState:
        """A new episode: a goal that is desired in training and a start from which it is not reached, both
        uniform."""
        choose_goal, choose_start = jax.random.split(key)
        desired = self.goals.desired_goals
        goal = desired[jax.random.randint(choose_goal, (), 0, desired.shape[0], jnp.int32)]
        return self.reset_to(choose_start, goal)

    def reset_to(self, key: jax.Array, goal: jax.Array) -> GraphState:
        """A new episode for this evaluated goal (int32), from a start drawn uniformly from `starts`."""
        row = self.place[goal]
        node = self.starts[row, jax.random.randint(key, (), 0, self.num_starts[row], jnp.int32)]
        false, key = jnp.zeros((), bool), None if self.views is None else key
        return GraphState(
            node=node,
            desired_goal=jnp.asarray(goal, jnp.int32),
            time=jnp.zeros((), jnp.int32),
            terminated=false,
            truncated=false,
            key=key,
        )

    def step(self, state: GraphState, action: jax.Array) -> GraphState:
        """Follow the edge of this action (int32). An action without an edge stays in place."""
        node, time = self.next_node[state.node, action], state.time + 1
        if self.views is not None:
            node = jax.random.choice(jax.random.fold_in(state.key, time), self.views[node])
        terminated = self.reached(node, state.desired_goal)
        return state.replace(
            node=node, time=time, terminated=terminated, truncated=(time >= self.episode_length) & ~terminated
        )

    def observe(self, state: GraphState) -> jax.Array:
        """The stored observation: the index of the image, int32."""
        return state.node

    def achieved(self, state: GraphState) -> jax.Array:
        """The record of what was achieved: the index of the image, int32."""
        return state.node

    @property
    def num_cells(self) -> int:
        """Number of cells in which visits are counted: the images."""
        return self.next_node.shape[0]

    def cell_of(self, record: jax.Array) -> jax.Array:
        """The cell in which a visit counts, int32 [...]."""
        return record

    def node_of(self, observation: jax.Array) -> jax.Array:
        """The node of stored observations, int32 [...]."""
        return observation

    def action_mask(self, observation: jax.Array) -> jax.Array:
        """Legal actions, bool [..., A]: those with an edge; all actions where no action has one."""
        node = self.node_of(observation)
        mask = self.next_node[node] != node[..., None]
        return mask | ~mask.any(-1, keepdims=True)

    def shortest_path(self, state: GraphState) -> jax.Array:
        """Steps to the nearest node that reaches the goal, int32."""
        return self.distance[self.place[state.desired_goal], state.node].astype(jnp.int32)


@flax.struct.dataclass
class DetectionWalk(GraphWalk):
    """A walk on which a goal is reached where its object is detected. Tasks add `render`."""

    images: jax.Array
    """uint8 [K, H, W] or [K, H, W, C]."""
    in_view: jax.Array
    """bool [K, N], whether the image shows the object of the goal."""
    achieved_goals: jax.Array
    """int32 [K, G], goals in view that are known while training, padded with -1."""
    position: jax.Array
    """float32 [K, D] in metres (and a heading in radians), NaN where unknown."""

    @property
    def num_observations(self) -> int:
        """Number of different observations: the images."""
        return self.images.shape[0]

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether the goal's object is detected in the image, bool [...], for records and goals int32 [...]."""
        return self.in_view[record, goal]

    def goals_of(self, record: jax.Array) -> jax.Array:
        """The goals in view that are known while training, int32 [..., G], padded with -1."""
        return self.achieved_goals[record]

    def draw(self, state: GraphState) -> jax.Array:
        """The image that is seen, uint8 [H, W, 3]; a grey one has three equal colours."""
        image = self.render(self.observe(state))
        return jnp.broadcast_to(image, (*image.shape[:-1], 3))


def frame_edges(data: FrameDataset) -> tuple[np.ndarray, np.ndarray | None]:
    """Edges int32 [K, A] between the images of a dataset, as in `GraphWalk.next_node`, and `GraphWalk.views`.

    An edge leads to the first image of the next state. States with fewer images than others repeat theirs. Raises
    `UserError` for moves that contradict each other.
    """
    following = frames.next_state(data)
    order = np.argsort(data.state, kind="stable")
    images, counts = np.split(order, np.cumsum(np.bincount(data.state))[:-1]), np.bincount(data.state)
    first = np.array([each[0] for each in images], np.int32)
    moved = following != np.arange(len(following))[:, None]
    edges = np.where(moved[data.state], first[following][data.state], np.arange(len(data.frames))[:, None]).astype(
        np.int32
    )
    if counts.max() == 1:
        return edges, None
    return edges, np.stack([np.resize(each, counts.max()) for each in images]).astype(np.int32)[data.state]


def distances(next_node: np.ndarray, at_goal: np.ndarray) -> np.ndarray:
    """Steps from every node to the nearest node that reaches each goal, int16 [M, K], by breadth-first search.
    next_node: int32 [K, A]; at_goal: bool [K, M]."""
    distance = np.full((at_goal.shape[1], len(next_node)), UNREACHABLE, np.int16)
    distance[at_goal.T] = 0
    for step in range(1, len(next_node) + 1):
        arrives = (distance[:, next_node] == step - 1).any(-1) & (distance == UNREACHABLE)
        if not arrives.any():
            return distance
        distance[arrives] = step
    return distance


def pad_true(mask: np.ndarray) -> np.ndarray:
    """Columns of the true entries of each row, padded with -1: bool [R, C] to int32 [R, K], where K is the largest
    count (at least 1)."""
    columns = np.full((len(mask), max(1, mask.sum(1).max(initial=0))), -1, np.int32)
    for row, row_mask in enumerate(mask):
        columns[row, : row_mask.sum()] = np.flatnonzero(row_mask)
    return columns


def possible_starts(distance: np.ndarray, episode_length: int) -> np.ndarray:
    """Nodes from which an episode for each goal may start, bool [M, K]: from farther away no episode could succeed."""
    return (distance > 0) & (distance <= episode_length)


def walk_arrays(next_node: np.ndarray, goals: GoalSet, distance: np.ndarray, episode_length: int) -> dict:
    """The fields of `GraphWalk` that follow from edges, goals and the distances [M, K] to evaluated goals."""
    may_start = possible_starts(distance, episode_length)
    place = np.zeros(goals.num_goals, np.int32)
    place[np.asarray(goals.evaluated)] = np.arange(len(goals.evaluated))
    return {
        "next_node": jax.device_put(next_node),
        "goals": goals,
        "place": jax.device_put(place),
        "distance": jax.device_put(distance),
        "starts": jax.device_put(np.maximum(pad_true(may_start), 0)),
        "num_starts": jax.device_put(may_start.sum(1).astype(np.int32)),
        "episode_length": episode_length,
    }


def with_uses(walk: DetectionWalk) -> DetectionWalk:
    """The task whose words for its data tell the uses and regions of its goals, too: where a file of the user's has
    them."""
    goals = walk.goals
    uses = archives.checksum(goals.regions, goals.train_mask, goals.validation_mask, goals.test_mask)
    return walk.replace(source=f"{walk.source}, uses of goals {uses}")
