"""The contract of a goal-representation learner: a record of pure functions, like an optax transformation. No learner
knows an environment.

Shapes: B transitions or pairs, n steps of a transition, d numbers of a code, F features of a state. Arrays of goals are
[..., *shape], see goals.py.
"""

import itertools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.goals import GoalSet, GoalSpace, axes_of
from infogoal_jax.pairs import GoalPairs
from infogoal_jax.relabelling.relabelling import Relabelling


@flax.struct.dataclass
class GoalCode:
    """A batch of goal codes, each a Gaussian with a diagonal covariance."""

    mean: jax.Array
    """[..., d]."""
    std: jax.Array | None = None
    """[..., d] standard deviations; None for deterministic codes, which have no noise."""

    def sample(self, key: jax.Array) -> jax.Array:
        """z = mean + std * noise, [..., d], differentiable in both (reparameterisation)."""
        return (
            self.mean
            if self.std is None
            else self.mean + self.std * jax.random.normal(key, self.mean.shape, jnp.float32)
        )

    def __getitem__(self, goals: jax.Array) -> "GoalCode":
        """Look up the codes of these goals in a table of codes."""
        return jax.tree.map(lambda leaf: leaf[goals], self)


Encode = Callable[[jax.Array], GoalCode]
"""Goals [..., *shape] to their codes [...] under fixed parameters. A table for small goal sets, else the network."""


DissimilarBy = Literal["trajectory", "cells", "classifier"]


class SampleSpec(NamedTuple):
    """What is sampled for each evaluation of a learner's loss."""

    num_pairs: int = 0
    """Pairs of goals achieved within `window` steps of each other in one trajectory."""
    window: int = 0
    """Largest number of steps between the two goals of a pair."""
    num_negatives: int = 1
    """Negatives for each pair."""
    anchored: bool = True
    """Compare a negative with the anchor of its pair; False: with another goal, drawn for it."""
    dissimilar: bool = True
    """Draw dissimilar goals as negatives; False: any known goals."""
    dissimilar_by: DissimilarBy = "trajectory"
    """What tells that two goals of a continuous space are dissimilar."""
    radius: float | None = None
    """Goals of a finite set that lie at most this far apart are similar, whether they were achieved or not, in the unit
    of the environment's `goal_positions`; None: goals achieved within the window."""
    listed: bool = False
    """With a radius: pair training, validation and test goals, achieved or not; False: known goals."""
    num_goals: int = 0
    """Goals that are known or desired in training: `LearnerBatch.goals`."""
    first_seen: bool = False
    """How many known goals each step saw first in its episode: `Visited.first_seen`."""
    relabelling: Relabelling | None = None
    """Gives the transitions that the loss sees other desired goals. The agent sees them unchanged. None: the loss sees
    what the agent sees."""


class InputSpec(NamedTuple):
    """Examples of what a learner's networks take."""

    goal_inputs: jax.Array
    """[M, ...] inputs of the training goals."""
    features: jax.Array
    """float32 [F] features of one state."""
    num_cells: int
    """Number of cells of the environment."""


class Steps(NamedTuple):
    """B transitions of up to n steps, with the desired goals `LearnerBatch.desired`."""

    features: jax.Array
    """float32 [B, F] of the first state, with the gradient of the state encoder."""
    next_features: jax.Array
    """float32 [B, F] of the last state, without gradient."""
    reward: jax.Array
    """float32 [B], discounted sum of the environment's rewards."""
    discount: jax.Array
    """float32 [B], discount of what follows; 0 after termination."""


class LearnerBatch(NamedTuple):
    """What a learner's loss sees."""

    encode: Encode
    """Encodes goals with the parameters that are trained."""
    inputs_of: Callable[[jax.Array], jax.Array]
    """Goals [..., *shape] to the inputs of the goal encoder [..., *input]."""
    pairs: GoalPairs | None
    """Pairs as `SampleSpec` asks for; None without any."""
    goals: jax.Array | None
    """[num_goals, *shape], goals that are known or desired in training; None unless `SampleSpec` asks for them."""
    desired: jax.Array
    """[B, *shape], desired goals of the transitions: those of the agent's batch, or those that `SampleSpec.relabelling`
    gave them."""
    transitions: Steps
    """The transitions of the agent's batch, or the same steps under the goals that `SampleSpec.relabelling` gave."""
    features_of: Callable[[jax.Array], jax.Array] | None = None
    """Goals [..., *shape] to the features [..., F] of the observations that they are, without gradient; None unless
    `Learner.needs_features_of_goals`."""


@flax.struct.dataclass
class Visited:
    """Where B transitions of n steps led, for an intrinsic reward."""

    desired: jax.Array
    """[B, *shape], desired goals."""
    achieved: jax.Array
    """[B, n, K, *shape], known goals achieved after each step, padded with "no goal"."""
    cell: jax.Array
    """int32 [B, n], the environment's cell that each step led to."""
    mask: jax.Array
    """float32 [B, n], 1 for steps that were taken."""
    first_seen: jax.Array | None = None
    """float32 [B, n], known goals that each step was the first of its episode to achieve; None unless the learner asks
    for them."""


class NewSteps(NamedTuple):
    """The steps that an epoch collected, R rows of T steps, for a learner whose state depends on all of them."""

    desired: jax.Array
    """[R, T, *shape], desired goals."""
    achieved: jax.Array
    """[R, T, K, *shape], goals achieved after each step, padded with "no goal"."""
    cell: jax.Array
    """int32 [R, T], the environment's cell that each step led to."""
    valid: jax.Array
    """bool [R, T], whether the step is a transition of an episode."""


def no_loss(
    params: Any, state: Any, batch: LearnerBatch, hyper: Any, key: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array], Any]:
    """Loss of 0: the agent's loss alone trains the goal encoder."""
    return jnp.zeros((), jnp.float32), {}, state


def no_reward(state: Any, encode: Encode, visited: Visited) -> tuple[jax.Array, Any]:
    """No intrinsic reward."""
    return jnp.zeros(visited.mask.shape, jnp.float32), state


def keep(state: Any, new: NewSteps) -> Any:
    """Return the state unchanged."""
    return state


class Learner(NamedTuple):
    """A goal-representation learner. Only `init`, `encode` and `loss` must be given."""

    init: Callable[[jax.Array, InputSpec, Any], tuple[Any, Any]]
    """(key, example: InputSpec, hyper) -> (params, state). The gradient trains the parameters; the state is everything
    else."""
    encode: Callable[[Any, jax.Array], GoalCode]
    """(params, goal_inputs) -> GoalCode, of vectors float32 [..., D] or images uint8 [..., H, W, C]."""
    loss: Callable[[Any, Any, LearnerBatch, Any, jax.Array], tuple[jax.Array, dict[str, jax.Array], Any]]
    """(params, state, batch: LearnerBatch, hyper, key) -> (loss, metrics, state). The state returned is that of the
    next update, for example a Lagrange multiplier or running means."""
    sample_spec: SampleSpec = SampleSpec()
    """What is sampled for the loss."""
    intrinsic_reward: Callable[[Any, Encode, Visited], tuple[jax.Array, Any]] = no_reward
    """(state, encode, visited: Visited) -> (float32 [B, n], state)."""
    observe: Callable[[Any, NewSteps], Any] = keep
    """(state, new: NewSteps) -> state. Called once an epoch, with the steps that it collected."""
    condition: Callable[[Any, GoalCode, jax.Array], GoalCode] | None = None
    """(params, code: GoalCode [B], features [B, F]) -> GoalCode: the code that the agent gets, where it depends on the
    state too."""
    augment: Callable[[jax.Array, jax.Array], jax.Array] | None = None
    """(key, goal_inputs [B, ...]) -> goal_inputs: augmentation of goal inputs in updates."""
    mean_at_test: bool = False
    """Use the mean of a code in evaluation instead of a sample."""
    by_index: bool = False
    """`encode` takes the numbers of goals, int32 [..., 1], in place of what they look like."""
    similar: Callable[[Any, jax.Array, jax.Array], jax.Array] | None = None
    """(params, goal_inputs [..., *input], goal_inputs [..., *input]) -> bool [...], whether two goals are similar, for
    `SampleSpec.dissimilar_by` = "classifier"."""
    needs_features_of_goals: bool = False
    """The loss asks for `LearnerBatch.features_of`: goals have to be observations."""


def conditioned(learner: Learner, params: Any, code: GoalCode, features: jax.Array) -> GoalCode:
    """The codes [B] that the agent gets in states of these features [B, F]."""
    return code if learner.condition is None else learner.condition(params, code, features)


View = Callable[[jax.Array, jax.Array], jax.Array]
"""Corruption and augmentation while training: a key and goal inputs [..., *input] to inputs of the same shape, each
varied independently."""

GOALS_AT_ONCE = 256  # Images that are encoded together: their patches take 13 MB.


class GoalEncoding(NamedTuple):
    """Encodes goals with these parameters of a learner: all goals of a set once where they are at most `batch_size`,
    else those that are asked for.

    With a view, each call varies every goal anew, with draws from `key`. Within a scan each place in the batch keeps
    its draw.
    """

    learner: Learner
    params: Any
    goals: GoalSpace
    batch_size: int
    view: View | None = None
    key: jax.Array | None = None

    @property
    def has_table(self) -> bool:
        """Whether there are so few goals that all of them are encoded at once."""
        return self.goals.finite and self.goals.num_goals <= self.batch_size

    def of_any(self) -> Encode:
        """Codes of any goals."""
        learner, params, goals = self.learner, self.params, self.goals
        if self.view is not None:
            calls = itertools.count()
            return lambda indices: learner.encode(
                params, self.view(jax.random.fold_in(self.key, next(calls)), goals.inputs_of(indices))
            )
        if self.has_table:
            return learner.encode(params, goals.inputs_of(jnp.arange(goals.num_goals, dtype=jnp.int32))).__getitem__
        return lambda indices: learner.encode(params, goals.inputs_of(indices))

    def of_desired_goals(self) -> Encode:
        """Codes of goals that are desired in training. Those of a set are few, so each is encoded once, however large
        the set is."""
        if self.view is not None or not self.goals.finite or self.has_table:
            return self.of_any()
        goals, desired = self.goals, self.goals.desired_goals
        return lookup(self.learner.encode(self.params, goals.inputs_of(desired)), goals, desired)


def encode_each(encode: Encode, *goals: jax.Array) -> list[GoalCode]:
    """Encode several arrays of goals in one pass: separate passes are so narrow that most of a GPU stays idle."""
    axes = [axes_of(array) for array in goals]
    flat = [array.reshape(-1, *array.shape[len(shape) :]) for array, shape in zip(goals, axes, strict=True)]
    codes, ends = encode(jnp.concatenate(flat)), itertools.accumulate(map(len, flat))
    return [
        jax.tree.map(lambda leaf, shape=shape, begin=begin, end=end: leaf[begin:end].reshape(*shape, -1), codes)
        for shape, (begin, end) in zip(axes, itertools.pairwise([0, *ends]), strict=True)
    ]


def encode_all(learner: Learner, params: Any, goals: GoalSet) -> GoalCode:
    """The codes of all goals [N]. A few hundred are encoded at a time, because a large set of images does not fit into
    memory."""
    return jax.lax.map(
        lambda goal: learner.encode(params, goals.inputs_of(goal)),
        jnp.arange(goals.num_goals, dtype=jnp.int32),
        batch_size=GOALS_AT_ONCE,
    )


def lookup(codes: GoalCode, goals: GoalSet, which: jax.Array) -> Encode:
    """Look up codes by goal, where `codes` are those of the goals `which`, in this order."""
    place = jnp.zeros(goals.num_goals, jnp.int32).at[which].set(jnp.arange(len(which), dtype=jnp.int32))
    return lambda indices: codes[place[indices]]


def has_own_loss(learner: Learner) -> bool:
    """Whether the goal encoder is trained by anything but the agent's loss."""
    return learner.loss is not no_loss


def has_reward(learner: Learner) -> bool:
    """Whether there is an intrinsic reward."""
    return learner.intrinsic_reward is not no_reward
