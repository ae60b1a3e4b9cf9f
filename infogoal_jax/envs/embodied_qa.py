"""Embodied question answering (paper, Sec. V-A.4): a drone in front of a shelf flies to where it sees the object that a
question asks about.

Learning is offline, from recorded flights. The evaluation flies in the simulated shelf. Goals are texts: the names of
all objects, which are known while training and serve for relabelling; a training question for some objects; and
validation and test questions, which training never sees.
"""

import dataclasses

import flax.struct
import jax
import numpy as np

from infogoal_jax.data import frames, splits, text
from infogoal_jax.envs.environment import Traits
from infogoal_jax.envs.graph import (
    DetectionWalk,
    distances,
    frame_edges,
    pad_true,
    possible_starts,
    walk_arrays,
    with_uses,
)
from infogoal_jax.errors import require
from infogoal_jax.field_types import Count, Size
from infogoal_jax.goal_uses import NO_USE
from infogoal_jax.goals import GoalSet
from infogoal_jax.replay import Trajectories


@dataclasses.dataclass(frozen=True)
class EmbodiedQAConfig:
    """Source of images and questions, and length of an episode."""

    dataset: str = ""
    """File of an image dataset with detections and trajectories (docs/reference/datasets.md); empty: a generated shelf
    (a stand-in), built once and kept in the user's cache."""
    generator_seed: Count = 0
    """Seed of the generated dataset."""
    hovering: bool = False
    """Generate a drone that drifts and blurs its images, with several images for every position."""
    gathered: bool = False
    """Generate a shelf on which the objects of a region stand together, so that an image shows several."""
    questions: str = ""
    """JSON file of objects, their use and the questions about them (docs/reference/embodied_qa.md); empty: those of the
    generated shelf."""
    text_embeddings: str = ""
    """Sentence embeddings of names and questions, an npz of `infogoal data embed`; empty: those that the project
    ships."""
    episode_length: Size = 50
    """Steps after which an episode is truncated [P]."""


@flax.struct.dataclass
class EmbodiedQA(DetectionWalk):
    """The environment: a walk on a graph of images, with recorded flights. Known goals are names and training
    questions."""

    action_names: tuple[str, ...] = flax.struct.field(pytree_node=False, default=(), kw_only=True)
    """A names of the actions, as the dataset has them."""
    goal_objects: tuple[str, ...] = flax.struct.field(pytree_node=False, default=(), kw_only=True)
    """N names of the object that each goal asks about."""

    def render(self, observation: jax.Array) -> jax.Array:
        """What the network sees: images uint8 [..., H, W, C] for stored observations int32 [...]."""
        return self.images[observation]


def recorded_rows(data: frames.FrameDataset, training: np.ndarray) -> Trajectories:
    """The trajectories of a dataset as rows, each with a random training goal as desired goal: recordings have no
    desired goal of their own.

    Trajectories shorter than the longest are padded with invalid transitions, between places that are empty.
    """
    starts = np.flatnonzero(data.time == 0)
    lengths = np.diff(np.append(starts, len(data.time)))
    row = np.repeat(np.arange(len(starts)), lengths)
    shape = (len(starts), int(lengths.max()))
    observation = np.zeros((shape[0], shape[1] + 1), np.int32)
    observation[row, data.time] = data.frame
    observation[row, data.time + 1] = data.next_frame
    action, valid, truncated = np.zeros(shape, np.int32), np.zeros(shape, bool), np.zeros(shape, bool)
    action[row, data.time], valid[row, data.time] = data.action, True
    truncated[np.arange(len(starts)), lengths - 1] = True
    there = np.arange(shape[1] + 1) <= lengths[:, None]
    goal = np.random.default_rng(0).choice(training, len(starts))
    parts = {
        "observation": observation,
        "record": observation,
        "action": action,
        "desired_goal": np.broadcast_to(goal[:, None], shape).astype(np.int32),
        "valid": valid,
        "terminated": np.zeros(shape, bool),
        "truncated": truncated,
        "decided": valid,
        "there": None if there.all() else there,
    }
    return Trajectories(**{name: jax.device_put(part) for name, part in parts.items()})


def traits(config: EmbodiedQAConfig) -> Traits:
    return Traits(finite_observations=True, recorded=True)


def make(config: EmbodiedQAConfig) -> EmbodiedQA:
    """Make the task of this configuration. Raises `UserError` for values and files that cannot be used."""
    asked = splits.load_questions(config.questions or splits.SHIPPED_QUESTIONS)
    embeddings = text.load(config.text_embeddings or splits.SHIPPED_EMBEDDINGS)
    if config.dataset:
        data = frames.load(config.dataset)
    else:
        from infogoal_jax.stand_ins import shelf

        kind = f"{'-hovering' if config.hovering else ''}{'-gathered' if config.gathered else ''}"
        name = f"shelf-{config.generator_seed}{kind}-{shelf.GENERATOR_VERSION}"
        data = frames.cached(name, lambda: shelf.build(config.generator_seed, config.hovering, config.gathered))
    env = from_data(data, asked, embeddings, config)
    return with_uses(env) if config.questions else env


def from_data(
    data: frames.FrameDataset, asked: splits.Questions, embeddings: text.TextEmbeddings, config: EmbodiedQAConfig
) -> EmbodiedQA:
    """Make the task from a dataset and questions about its objects. Raises `UserError` for a question about an object
    that cannot be found."""
    given = config.dataset or data.about["name"]
    require(
        data.detected is not None,
        "env.dataset",
        given,
        "tells no detections: import it with a column `objects` that names what is in view",
    )
    require(len(data.time) > 0, "env.dataset", given, "holds no recorded moves to learn from")
    goals_asked = asked.goals()
    unknown = sorted({goal.object for goal in goals_asked} - set(data.objects))
    require(
        not unknown,
        "env.questions",
        ", ".join(unknown),
        f"these objects of the questions are detected nowhere in {given}; give questions about others with "
        f"--env.questions FILE. It knows {', '.join(data.objects)}",
    )
    column = np.array([data.objects.index(goal.object) for goal in goals_asked])
    uses = np.array([goal.use for goal in goals_asked])
    in_view = data.detected[:, column]
    next_node, views = frame_edges(data)
    evaluated = np.flatnonzero(uses != NO_USE)
    distance = distances(next_node, in_view[:, evaluated])
    alone = evaluated[~possible_starts(distance, config.episode_length).any(1)]
    require(
        not len(alone),
        "env.questions",
        goals_asked[alone[0]].object if len(alone) else "",
        f"can be found from nowhere within {config.episode_length} steps in {given}: record moves that lead there, or "
        "take the object out",
    )
    flown = np.unique(np.concatenate([data.frame, data.next_frame]))
    unseen = [goals_asked[goal].object for goal in np.flatnonzero(uses == 0) if not in_view[flown, goal].any()]
    require(
        not unseen,
        "env.dataset",
        given,
        f"no trajectory ever reaches the training goal {', '.join(unseen)}: record one that does",
    )
    embedded = text.embed_known([goal.text for goal in goals_asked], embeddings)
    inputs = text.as_goal_inputs(embedded)
    known = in_view & np.isin(uses, (NO_USE, 0))
    goals = GoalSet.of(
        inputs, [goal.room for goal in goals_asked], uses, tuple(goal.text for goal in goals_asked), asked.room_names
    )
    position = np.full((len(data.frames), 2), np.nan, np.float32) if data.position is None else data.position[:, :2]
    return EmbodiedQA(
        images=jax.device_put(data.frames),
        in_view=jax.device_put(in_view),
        achieved_goals=jax.device_put(pad_true(known)),
        position=jax.device_put(position),
        recorded=recorded_rows(data, np.flatnonzero(uses == 0)),
        views=None if views is None else jax.device_put(views),
        source=data.describe(data.frames, data.detected, next_node, data.frame, inputs),
        action_names=data.actions,
        goal_objects=tuple(goal.object for goal in goals_asked),
        **walk_arrays(next_node, goals, distance, config.episode_length),
    )
