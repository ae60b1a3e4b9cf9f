"""Comparison of our Fetch tasks with recorded episodes of the reference: the same actions from the same start, and the
positions of grip and object.

It measures without a threshold: where contacts are chaotic, two runs of the reference that start a tenth of a
millimetre apart diverge too (benchmarks/fidelity/fetch_chaos.py).
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import numpy as np

from infogoal_jax.envs.fetch.environment import Fetch
from infogoal_jax.envs.fetch.recordings import Recording
from infogoal_jax.errors import UserError

OFF_TABLE = 0.3
"""An object that ends lower than this (m) has fallen off the table, whose top is at 0.4."""
LIFTED = 0.45
"""An object that ends higher than this (m) has been lifted: on the table its centre is at 0.425."""
ALL = "all"
"""The kind that every episode belongs to."""


@dataclasses.dataclass(frozen=True, eq=False)
class Replayed:
    """The outcome of the recorded actions in our task: grip and thing (the object; zeros without one) [E, T + 1, 3] in
    m, reward [E, T], diverged bool [E]."""

    grip: np.ndarray
    thing: np.ndarray
    reward: np.ndarray
    diverged: np.ndarray


def replay(env: Fetch, recording: Recording) -> Replayed:
    """Step through all episodes of a recording, side by side. Episodes continue to their last step, also after the goal
    was reached."""
    grip, thing, reward, diverged = jax.device_get(
        replay_program(env, recording.observation[:, 0], recording.goal, recording.action)
    )
    return Replayed(grip, thing, reward, diverged)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
def replay_program(env: Fetch, first, goal, actions):
    """Grip and object [T + 1, 3], reward [T] and whether it diverged, for one episode: first observation [10 or 25],
    goal [3] and actions [T, 4]."""
    has_object = env.task.object_height is not None
    motion = env.physics.start()
    if has_object:
        # The reference's puck lies 6.5 mm deep in the table, where ours would be thrown out of it: it stands at its own
        # height.
        motion = env.physics.place_object(motion, first[3:5] if env.task.puck else first[3:6])

    def positions(state):
        observation = state.observation
        return observation[:3], observation[3:6] if has_object else jax.numpy.zeros(3)

    def step(state, action):
        state = env.step(state, action)
        return state, (*positions(state), env.reward(env.achieved(state), goal), state.diverged)

    start = env.begin(motion, goal)
    _, (grip, thing, reward, diverged) = jax.lax.scan(step, start, actions)
    grip, thing = (
        jax.numpy.concatenate([here[None], later]) for here, later in zip(positions(start), (grip, thing), strict=True)
    )
    return grip, thing, reward, diverged.any()


@dataclasses.dataclass(frozen=True)
class Distance:
    """Distance between a position and the recorded one in mm, over all steps of some episodes; at the start and the
    end: means over the episodes."""

    mean: float
    median: float
    largest: float
    start: float
    end: float


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The number of episodes for which something holds: in the recording, here, and in both."""

    recorded: int
    here: int
    both: int


@dataclasses.dataclass(frozen=True)
class Parity:
    """Episodes of one kind compared. thing, fallen and lifted: None without an object; equal_rewards: share of the
    steps."""

    kind: str
    episodes: int
    grip: Distance
    thing: Distance | None
    equal_rewards: float
    fallen: Outcome | None
    lifted: Outcome | None
    diverged: int


def distances(here: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """Distances [E, T + 1] in mm between positions [E, T + 1, 3] in m."""
    return 1000 * np.linalg.norm(np.asarray(here, float) - np.asarray(recorded, float), axis=-1)


def measure(error: np.ndarray) -> Distance:
    """Summarise errors [E, T + 1] in mm by five numbers. The start is given, so that only later steps count."""
    moved = error[:, 1:]
    return Distance(
        float(moved.mean()),
        float(np.median(moved)),
        float(moved.max()),
        float(error[:, 0].mean()),
        float(error[:, -1].mean()),
    )


def count(recorded: np.ndarray, here: np.ndarray) -> Outcome:
    """Count the episodes of two masks, bool [E]."""
    return Outcome(int(recorded.sum()), int(here.sum()), int((recorded & here).sum()))


def read_kinds(pattern: str) -> tuple[str, ...]:
    """Kinds of the first, second, ... episode, from `random,held,scripted`; none from "". Raises `UserError` for an
    empty kind, or one named all."""
    kinds = tuple(kind.strip() for kind in pattern.split(",")) if pattern else ()
    if "" in kinds or ALL in kinds:
        raise UserError(
            f"kinds = {pattern!r}: give names separated by commas, none of them empty or {ALL!r}, such as "
            "random,held,scripted"
        )
    return kinds


def kind_masks(kinds: Sequence[str], episodes: int) -> dict[str, np.ndarray]:
    """Which episodes are of each kind, {kind: bool [E]}, if their kinds repeat in this order; the first is `ALL`."""
    order = np.array([kinds[episode % len(kinds)] if kinds else ALL for episode in range(episodes)])
    masks = {kind: order == kind for kind in dict.fromkeys(kinds)}
    return {ALL: np.ones(episodes, bool)} | {kind: mask for kind, mask in masks.items() if mask.any()}


def compare(recording: Recording, replayed: Replayed, kinds: Sequence[str] = ()) -> list[Parity]:
    """Compare a recording with its replay: over all episodes, then over those of each kind."""
    grip, has_object = distances(replayed.grip, recording.grip), recording.has_object
    thing = distances(replayed.thing, recording.thing) if has_object else None
    ends = recording.thing[:, -1, 2], replayed.thing[:, -1, 2]
    rows = []
    for kind, mask in kind_masks(kinds, recording.episodes).items():
        heights = [end[mask] for end in ends]
        rows.append(
            Parity(
                kind=kind,
                episodes=int(mask.sum()),
                grip=measure(grip[mask]),
                thing=measure(thing[mask]) if has_object else None,
                equal_rewards=float((replayed.reward == recording.reward)[mask].mean()),
                fallen=count(*(height < OFF_TABLE for height in heights)) if has_object else None,
                lifted=count(*(height > LIFTED for height in heights)) if has_object else None,
                diverged=int(replayed.diverged[mask].sum()),
            )
        )
    return rows
