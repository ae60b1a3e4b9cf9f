"""Object manipulation (paper, Sec. V-A.3): an arm turns a Rubik's cube, a joint by 15 degrees at a time, to the pose
that an image shows.

The world is a dataset of photographs, and a step leads from one to the next. Several joint settings show the cube in
the same orientation. Goals are therefore the different orientations. A goal is reached within 10 degrees of it.
"""

import dataclasses
import warnings
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.angles import geodesic, on_circles, orientation_classes, quaternions, rotation_matrices, wrapped
from infogoal_jax.data import backgrounds, frames, pictures
from infogoal_jax.envs.environment import Environment, Traits
from infogoal_jax.envs.graph import GraphState, GraphWalk, distances, frame_edges, possible_starts, walk_arrays
from infogoal_jax.envs.target_states import JointSpace
from infogoal_jax.errors import require
from infogoal_jax.field_types import Count, Size, Within
from infogoal_jax.goal_uses import MOST_GOALS, NO_USE, USES
from infogoal_jax.goals import GoalSet
from infogoal_jax.shapes import aligned

REACHED = np.deg2rad(10.0)
"""Largest angle between the pose and the goal at which the goal is reached, in radians [P]."""
FARTHEST_TEST = np.deg2rad(90.0)
"""Largest angle between a test pose and the nearest training pose, in radians [P]."""

LUMINANCE = np.array([0.299, 0.587, 0.114])
"""Of red, green and blue in a grey image (ITU-R BT.601), as image libraries have it."""
WHOLE_TURN = 180.0
"""Degrees within which every angle lies."""
OF_IMAGES = ("frames", "state", "rotation", "joints", "position", "detected")
OF_MOVES = ("frame", "action", "next_frame", "trajectory", "time", "terminal")
"""Fields of a `FrameDataset` that have a row for each image, and for each move."""


@dataclasses.dataclass(frozen=True)
class ObjectManipulationConfig:
    """Source of the images, choice of the goals, and length of an episode."""

    dataset: str = ""
    """File of an image dataset with poses (docs/reference/datasets.md); empty: a generated arm with a cube (a
    stand-in), built once and kept in the user's cache."""
    generator_seed: Count = 0
    """Seed of the generated dataset."""
    physical_limits: bool = False
    """Generate only what the joints of the real arm can reach; otherwise all three turn freely, as in the paper."""
    joint_range: Annotated[float, Within("(0, 180]", "give degrees, more than 0 and at most 180")] = 180.0
    """Largest angle of a joint that turns, in degrees: images in which one is turned farther are left out. A smaller
    world is an easier task."""
    goal_seed: Count = 0
    """Seed by which training, validation and test poses are chosen."""
    num_goals: tuple[int, int, int] = (8, 8, 32)
    """Numbers of training [P], validation and test poses [P]."""
    backgrounds: str = ""
    """Images that corrupt goals: cifar10, a folder, or empty for the shipped crops (docs/reference/goal_inputs.md)."""
    privileged: bool = False
    """Show poses in place of images, which is what perfect perception could tell (docs/research/trials.md): a goal as
    its rotation matrix, a state as that of the object and the cosines and sines of the joints."""
    episode_length: Size = 30
    """Steps after which an episode is truncated."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        require(
            not (self.privileged and self.backgrounds),
            "env.backgrounds",
            self.backgrounds,
            "goals are not images with env.privileged, and are not corrupted: leave one of them out",
        )
        require(
            min(self.num_goals) >= 0 and self.num_goals[0] > 0,
            "env.num_goals",
            self.num_goals,
            "give at least 1 for training, 0 or more otherwise",
        )


@flax.struct.dataclass
class Posed:
    """An observation: an image, and the joints of the arm in it."""

    frame: jax.Array
    """int32 [...], index of the image."""
    joints: jax.Array
    """float32 [..., J] angles in radians, which an arm always knows of itself; J may be 0."""


@flax.struct.dataclass
class ObjectManipulation(GraphWalk):
    """The environment: a walk on a graph of photographs, which are held once, in `goals.inputs`."""

    joints: jax.Array
    """float32 [K, J] angles of each image, in radians."""
    quaternion: jax.Array
    """float32 [K, 4] orientation of the object in each image, w first."""
    orientation: jax.Array
    """int32 [K], the goal that each image shows."""
    goal_quaternion: jax.Array
    """float32 [N, 4] orientation of each goal, w first."""
    action_names: tuple[str, ...] = flax.struct.field(pytree_node=False, default=(), kw_only=True)
    """A names of the moves, as the dataset has them."""

    has_target_states = True

    goals_are_observations = True

    @property
    def space(self) -> JointSpace:
        """The target states of the arm, for a low level."""
        require(
            self.joints.shape[1] > 0,
            "agent",
            "hrac",
            f"{self.source} has no joint angles for a low level to reach: give dqn",
        )
        return JointSpace(self.joints.shape[1])

    def observe(self, state: GraphState) -> Posed:
        return self.observe_frame(state.node)

    def observe_frame(self, frame: jax.Array) -> Posed:
        """The observation of images int32 [...]."""
        return Posed(frame, self.joints[frame])

    def node_of(self, observation: Posed) -> jax.Array:
        """The image of stored observations, int32 [...]."""
        return observation.frame

    def draw(self, state: GraphState) -> jax.Array:
        """The image of the pose, uint8 [H, W, 3]; grey in three equal colours."""
        image = self.goals.inputs[state.node]
        return jnp.broadcast_to(image, (*image.shape[:-1], 3))

    def render(self, observation: Posed) -> jax.Array:
        """What the network sees: images uint8 [..., H, W, C]."""
        return self.goals.inputs[observation.frame]

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether the image shows the object within 10 degrees of the goal, bool [...], for records and goals int32
        [...]."""
        shown, desired = self.quaternion[record], self.goal_quaternion[goal]
        shown, desired = aligned(shown, desired)
        return jnp.abs((shown * desired).sum(-1)) > float(np.cos(REACHED / 2))

    @property
    def goal_positions(self) -> jax.Array:
        """Rotation matrices of the goals, float32 [N, 9]. Their distance grows with the angle between two poses."""
        return rotation_matrices(self.goal_quaternion)

    @property
    def num_cells(self) -> int:
        """Number of cells in which visits are counted: the orientations."""
        return self.goals.num_goals

    def cell_of(self, record: jax.Array) -> jax.Array:
        """The orientation that the image shows, int32 [...]."""
        return self.orientation[record]

    def goals_of(self, record: jax.Array) -> jax.Array:
        """The orientation that the image shows, int32 [..., 1]."""
        return self.orientation[record][..., None]


@flax.struct.dataclass
class PrivilegedManipulation(ObjectManipulation):
    """The environment without pictures: `goals.inputs` are rotation matrices, float32 [K, 9], and goals are without the
    joints."""

    goals_are_observations = False
    draw = Environment.draw

    def render(self, observation: Posed) -> jax.Array:
        """What the network sees: the rotation matrix, and cosines and sines of the joints, float32 [..., 9 + 2 J]."""
        seen = self.goals.inputs[observation.frame]
        return jnp.concatenate([seen, on_circles(observation.joints)], axis=-1)


def choose_goals(rotation: np.ndarray, reachable: np.ndarray, counts: tuple[int, int, int], seed: int) -> np.ndarray:
    """Choose uses of N orientations [N, 3, 3], int [N], positions in `goals.USES` or `NO_USE`, `counts` of each (Sec.
    V-B.1).

    Training poses are uniform among those that can be reached (bool [N]). Validation and test poses are uniform among
    those within 90 degrees of a training pose. No image reaches two of the chosen poses. Raises `UserError` where the
    dataset is too small.
    """
    uses, random = np.full(len(rotation), NO_USE), np.random.default_rng([seed, len(rotation)])
    free = reachable.copy()
    for use, count in enumerate(counts):
        near = (
            geodesic(rotation[:, None], rotation[uses == 0][None]).min(1) <= FARTHEST_TEST
            if use > 0
            else np.ones(len(rotation), bool)
        )
        for _ in range(count):
            possible = np.flatnonzero(free & near)
            require(
                len(possible) > 0,
                "env.num_goals",
                counts,
                f"the dataset shows too few poses for so many that lie 20 degrees apart ({reachable.sum()} can be "
                "reached): give fewer",
            )
            chosen = random.choice(possible)
            uses[chosen] = use
            free &= geodesic(rotation, rotation[chosen]) > 2 * REACHED  # No turn is near both.
    return uses


def plainest(joints: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """For each orientation the image int [N] that shows it with the smallest joint angles [K, J], as a person would
    pose the arm."""
    turned = np.abs((joints + np.pi) % (2 * np.pi) - np.pi).sum(1)
    order = np.lexsort((turned, orientation))
    return order[np.unique(orientation[order], return_index=True)[1]]


def goal_names(rotation: np.ndarray, uses: np.ndarray) -> tuple[str, ...]:
    """The names of the orientations: their angles about z, y and x, in degrees."""
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():
        # If the middle angle is 90 degrees, the other two are not unique and scipy warns.
        warnings.simplefilter("ignore")
        angles = Rotation.from_matrix(rotation.astype(np.float64)).as_euler("ZYX", degrees=True).round().astype(int)
    kinds = ("pose", *(f"{use} pose" for use in USES))
    return tuple(
        f"{kinds[use + 1]} yaw {yaw} pitch {pitch} roll {roll}"
        for use, (yaw, pitch, roll) in zip(uses, angles, strict=True)
    )


def like_frames(images: np.ndarray, data: frames.FrameDataset) -> np.ndarray:
    """Images [B, H, W, 3] at the size of the dataset's frames, grey where these are."""
    if images.shape[1:3] != data.frames.shape[1:3]:
        images = np.stack([pictures.resized(image, *data.frames.shape[1:3]) for image in images])
    if data.frames.shape[-1] == 1:
        images = (images @ LUMINANCE).round().astype(np.uint8)[..., None]
    return images


def traits(config: ObjectManipulationConfig) -> Traits:
    images = not config.privileged
    return Traits(image_goals=images, target_states=True, goals_are_observations=images)


def load_frames(dataset: str, generator_seed: int, physical_limits: bool) -> frames.FrameDataset:
    """The image dataset in this file, or the one that is generated where none is named. Raises `UserError` for a file
    that cannot be used."""
    if dataset:
        return frames.load(dataset)
    from infogoal_jax.stand_ins import cube

    name = f"cube-{generator_seed}{'-limits' if physical_limits else ''}-{cube.GENERATOR_VERSION}"
    return frames.cached(name, lambda: cube.build(generator_seed, physical_limits))


def make(config: ObjectManipulationConfig) -> ObjectManipulation:
    """Make the task of this configuration. Raises `UserError` for values and files that cannot be used."""
    config.check(None)
    data = load_frames(config.dataset, config.generator_seed, config.physical_limits)
    if config.joint_range < WHOLE_TURN:
        data = turned_within(data, config)
    return from_data(data, None if config.privileged else backgrounds.load(config.backgrounds), config)


def turned_within(data: frames.FrameDataset, config: ObjectManipulationConfig) -> frames.FrameDataset:
    """The dataset without images in which a joint is turned beyond `joint_range`, and without moves to or from one.
    Raises `UserError` where joints are not known, or no image is left."""
    given, turning = config.joint_range, [not name.endswith(frames.SLIDES) for name in data.joint_names]
    known = data.joints is not None and any(turning)
    require(known, "env.joint_range", given, "env.dataset tells no joint angles: leave it at 180")
    angles = np.abs(wrapped(data.joints[:, turning]))
    kept = (angles <= np.radians(given) + 1e-6).all(1)
    moved = kept[data.frame] & kept[data.next_frame]
    nearest = np.degrees(angles.max(1).min())
    require(moved.any(), "env.joint_range", given, f"leaves no move: give more than {nearest:.0f} degrees, at most 180")
    number = np.cumsum(kept, dtype=np.int32) - 1
    images, moves = (
        {name: getattr(data, name)[rows] for name in names if getattr(data, name) is not None}
        for rows, names in ((kept, OF_IMAGES), (moved, OF_MOVES))
    )
    images["state"] = np.unique(images["state"], return_inverse=True)[1].astype(np.int32)
    moves |= {name: number[moves[name]] for name in ("frame", "next_frame")}
    about = data.about | {"name": f"{data.about['name']}, joints within {given:g} degrees"}
    return dataclasses.replace(data, about=about, **images, **moves)


def from_data(
    data: frames.FrameDataset, behind: backgrounds.Backgrounds | None, config: ObjectManipulationConfig
) -> ObjectManipulation:
    """Make the task from a dataset. behind: what goal images are corrupted with; None: poses are shown in their place.
    Raises `UserError` for a dataset without poses, or in which no goals can be chosen."""
    given = config.dataset or data.about["name"]
    require(
        data.rotation is not None,
        "env.dataset",
        given,
        "tells no poses: import it with columns qw, qx, qy, qz or roll, pitch, yaw",
    )
    orientation = orientation_classes(data.rotation)
    names, first = np.unique(orientation, return_index=True)
    require(
        len(names) <= MOST_GOALS,
        "env.dataset",
        given,
        f"shows {len(names)} different orientations: give at most {MOST_GOALS}",
    )
    shown = first if data.joints is None else plainest(data.joints, orientation)
    rotation = data.rotation[shown]
    next_node, views = frame_edges(data)
    arrives = np.zeros(len(data.frames), bool)
    arrives[next_node[next_node != np.arange(len(next_node))[:, None]]] = True
    reachable = np.zeros(len(names), bool)
    reachable[orientation[arrives]] = True
    uses = choose_goals(rotation, reachable, config.num_goals, config.goal_seed)
    evaluated = np.flatnonzero(uses != NO_USE)
    distance = distances(next_node, geodesic(data.rotation[:, None], rotation[evaluated][None]) < REACHED)
    alone = evaluated[~possible_starts(distance, config.episode_length).any(1)]
    require(
        not len(alone),
        "env.dataset",
        given,
        f"the pose of image {shown[alone[:1]]} can be reached from nowhere within {config.episode_length} steps: "
        "record moves that lead there, or give a longer episode_length or another goal_seed",
    )
    training = np.flatnonzero(uses == 0)
    region = geodesic(rotation[:, None], rotation[training][None]).argmin(1)
    regions = tuple(f"near training pose {number}" for number in range(len(training)))
    inputs = data.rotation.reshape(-1, 9).astype(np.float32) if behind is None else data.frames
    goals = GoalSet.of(inputs, region, uses, goal_names(rotation, uses), regions, rows=shown)
    joints = np.zeros((len(data.frames), 0), np.float32) if data.joints is None else data.joints
    seen = "poses are seen in place of images" if behind is None else f"backgrounds: {behind.source}"
    kinds = () if behind is None else ("train", "test")
    behind_goals = {f"{kind}_backgrounds": jax.device_put(like_frames(getattr(behind, kind), data)) for kind in kinds}
    kind = PrivilegedManipulation if behind is None else ObjectManipulation
    return kind(
        joints=jax.device_put(joints),
        quaternion=jax.device_put(quaternions(data.rotation)),
        orientation=jax.device_put(np.asarray(orientation, np.int32)),
        goal_quaternion=jax.device_put(quaternions(rotation)),
        views=None if views is None else jax.device_put(views),
        source=f"{data.describe(data.frames, data.rotation, next_node, shown)}; {seen}",
        action_names=data.actions,
        **behind_goals,
        **walk_arrays(next_node, goals, distance, config.episode_length),
    )
