"""The contract for environments: what a task has to be, to be trained on. Derive from `Environment` and write what has
no default.

An environment is a pytree (`flax.struct.dataclass`): its arrays travel to compiled programs as arguments. Its functions
are pure, and take one state; `jax.vmap` batches them. Functions of *stored* observations and records take any leading
axes, because they are also applied to the replay buffer. docs/guides/own_task.md makes a task of one's own, from
nothing to a trained policy.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from infogoal_jax.goals import GoalSpace, axes_of
from infogoal_jax.replay import Trajectories


class Traits(NamedTuple):
    """What decides which parts a task can be combined with. `Entry.traits` of a task declares them, so that a
    combination is refused before anything is loaded."""

    finite_goals: bool = True
    """Whether goals are a finite set."""
    image_goals: bool = False
    """Whether goals are images, which can be corrupted."""
    moves: bool = True
    """Whether an action is a choice among a few; False: a vector."""
    finite_observations: bool = False
    """Whether there is a list of all observations."""
    recorded: bool = False
    """Whether the agent learns from recorded trajectories alone."""
    target_states: bool = False
    """Whether a low level can be sent to target states."""
    goals_are_observations: bool = False
    """Whether a goal is shown as the state encoder sees a state that achieves it."""
    ends_at_goal: bool = True
    """Whether reaching the goal ends the episode."""


class Environment:
    """A task. Members without a value must be given; the others have the value that most tasks need.

    A state is a pytree with at least `desired_goal` ([*shape]), `time` (int32, steps taken), `terminated` (bool, the
    goal is reached, where that ends the episode), `truncated` (bool, the episode is over without: time is up, it has
    failed or diverged; never together with terminated) and `diverged` (bool, the last step of a simulation was thrown
    away, and is no transition).
    """

    goals: GoalSpace
    """The goal space: a `GoalSet`, of at most `goal_uses.MOST_GOALS`, or a `GoalBox`. Goals are [..., *shape]."""
    action_size: int
    """Number of actions, or the size of an action vector."""
    episode_length: int
    """Steps after which an episode is truncated."""
    source: str
    """What the data is, in words, for reports; stand-in data is called so. With a checksum of what was read from files
    (`archives.checksum`), see `data_of`."""
    recorded_checksum = ""
    """Checksum of the recordings, where `source` does not have it."""
    space: Any
    """The target states that a low level can be sent to, where `has_target_states` (envs/fetch/targets.py,
    envs/target_states.py)."""

    discrete = True
    """Whether an action is a choice among a few, int32; False: a vector float32 [action_size] in [-1, 1]."""
    recorded: Trajectories | None = None
    """Recorded trajectories to learn from without acting; None: the agent acts."""
    num_observations: int | None = None
    """Number of different observations, where each is an index int32; None: observations are vectors, or too many to be
    listed."""
    train_backgrounds: jax.Array | None = None
    """Images uint8 [B, H, W, C] that goal images may be corrupted with in training; None where goals are not images."""
    test_backgrounds: jax.Array | None = None
    """The same for evaluation: other images."""
    goal_positions: jax.Array | None = None
    """Where goals lie, float32 [N, D]; None: unknown."""
    near_goals: jax.Array | None = None
    """bool [N], goals that count as reached from a training goal: of test goals these are reported apart from the
    others. None: they are not told apart."""
    ends_at_goal: bool = True
    """Whether reaching the goal ends the episode, which then is worth 1 once. False: an episode goes on to its length,
    every step at the goal is worth 1, and success is to be there at the end."""
    can_fail = False
    """Whether an episode may end in failure, such as a fall; then `failed` says which did."""
    simulated = True
    """Whether the task can be acted in. False: it has recordings alone (`recorded`), of an environment that is
    elsewhere; nothing is evaluated then."""
    costly_reset = False
    """Whether a reset costs about as much as a step, so that one is computed only where an episode has ended."""
    num_cells: int = 1
    """Number of cells that what can be achieved is divided into, for learners that count visits."""
    has_target_states = False
    """Whether a low level can be sent to target states (HRAC); then `space` says which."""
    goals_are_observations: bool = False
    """Whether a goal is shown as the state encoder sees a state that achieves it, as an image of the same kind."""
    has_shortest_path = False
    """Whether `shortest_path` is known."""

    def reset(self, key: jax.Array) -> Any:
        """The state of a new episode: a training goal and a start at which it is not reached, both drawn anew."""
        raise NotImplementedError

    def reset_to(self, key: jax.Array, goal: jax.Array) -> Any:
        """The state of a new episode for this desired goal [*shape]."""
        raise NotImplementedError

    def step(self, state: Any, action: jax.Array) -> Any:
        """The state after one action. The state of a finished episode is not used: the loop resets it."""
        raise NotImplementedError

    def observe(self, state: Any) -> Any:
        """What is stored of the observation: an index int32 where there is a dataset of images, else a vector or an
        image; or a pytree of these."""
        raise NotImplementedError

    def render(self, observation: Any) -> jax.Array:
        """What the state encoder sees of stored observations [...]: images uint8 [..., H, W, C] or vectors float32
        [..., D]."""
        raise NotImplementedError

    def achieved(self, state: Any) -> jax.Array:
        """The record of what was achieved in a state, to be stored: a node, or a position [D]."""
        raise NotImplementedError

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether records achieve goals, bool [...]: by true distance, never by the cell of a grid."""
        raise NotImplementedError

    def goals_of(self, record: jax.Array) -> jax.Array:
        """The goals that records [...] achieve, for relabelling and representation learning: [..., K, *shape], padded
        with "no goal". In a continuous space a record is by itself the goal that it achieves."""
        if self.goals.finite:
            raise NotImplementedError
        return record[..., None, :]

    def cell_of(self, record: jax.Array) -> jax.Array:
        """The cell that each record [...] lies in, int32 [...] below `num_cells`."""
        return jnp.zeros(axes_of(self.goals_of(record))[:-1], jnp.int32)

    def action_mask(self, observation: Any) -> jax.Array:
        """The actions that can be taken after stored observations [...], bool [..., A]."""
        leaf, of_one = jax.tree.leaves(observation)[0], jax.tree.leaves(one_observation(self))[0]
        return jnp.ones((*leaf.shape[: leaf.ndim - of_one.ndim], self.action_size), bool)

    def own_action(self, action: jax.Array) -> jax.Array:
        """A vector of [-1, 1] as what is simulated takes it, which an exported policy gives."""
        return action

    def failed(self, state: Any) -> jax.Array:
        """Whether the episode has failed, bool; where `can_fail`. Nothing is worth anything after it. Its state is
        `truncated`, since the goal was not reached."""
        raise NotImplementedError

    def decides(self, state: Any) -> jax.Array:
        """Whether the next step follows a new decision of the agent, bool."""
        return jnp.ones_like(state.terminated)

    def shortest_path(self, state: Any) -> jax.Array:
        """Steps to the desired goal on a shortest path, int32; where `has_shortest_path`."""
        raise NotImplementedError

    def draw(self, state: Any) -> jax.Array:
        """A picture of a state, uint8 [H, W, 3], for `infogoal video`; a task may do without."""
        raise NotImplementedError

    @property
    def unwrapped(self) -> "Environment":
        """The task itself, without what is wrapped around it."""
        return self

    def with_goals(self, goals: GoalSpace) -> "Environment":
        """The same task with another goal set, such as one of which fewer goals are evaluated."""
        return self.replace(goals=goals)


def data_of(env: Environment) -> str:
    """What the data of a task is, in words, by which a run that goes on knows it again: its source, and the recordings
    that it learns from."""
    return f"{env.source}; learned from recordings {env.recorded_checksum}" if env.recorded_checksum else env.source


def failed_in(env: Environment, state: Any) -> jax.Array:
    """Whether the episode has failed in this state, or diverged, bool; of states [E], bool [E]. Of a task whose
    episodes never fail, too."""
    return env.failed(state) | state.diverged if env.can_fail else state.diverged


def draws_itself(env: Environment) -> bool:
    """Whether the task makes pictures of its states."""
    return type(env).draw is not Environment.draw


def has_image_goals(env: Environment) -> bool:
    """Whether goals of this environment are images that can be corrupted, and are shown as these."""
    return env.train_backgrounds is not None and not env.goals.by_index


def one_observation(env: Environment) -> Any:
    """Shape and type of what is stored of one observation. A reset is traced for it once, since that of a simulator
    takes seconds; always for an environment that is no pytree, or has a static field without a hash."""
    leaves, tree = jax.tree.flatten(env)
    try:
        return traced_observation(tree, *(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves))
    except (AttributeError, TypeError):
        return jax.eval_shape(lambda key: env.observe(env.reset(key)), jax.random.key(0))


@functools.lru_cache(maxsize=64)
def traced_observation(tree: Any, *leaves: jax.ShapeDtypeStruct) -> Any:
    """`one_observation` of the environment with this structure and arrays like these."""

    def observed(key: jax.Array, leaves: tuple[jax.Array, ...]) -> Any:
        env = jax.tree.unflatten(tree, leaves)
        return env.observe(env.reset(key))

    return jax.eval_shape(observed, jax.random.key(0), leaves)
