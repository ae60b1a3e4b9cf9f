"""The contract of a goal-representation learner: a record of pure functions, like an optax transformation. No learner
knows an environment.

Shapes: B transitions or pairs, n steps of a transition, d numbers of a code, F features of a state. Arrays of goals are
[..., *shape], see goals.py.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.pairs import GoalPairs
from infogoal_jax.relabelling.relabelling import Relabelling
from infogoal_jax.rows import take_rows


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
        return jax.tree.map(lambda leaf: take_rows(leaf, goals), self)


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
    """B transitions of up to n steps, with the desired goals `LearnerBatch.desired_goal`."""

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
    desired_goal: jax.Array
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

    desired_goal: jax.Array
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

    desired_goal: jax.Array
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
    only_compresses: bool = False
    """Whether `loss` only makes the code tell less: the agent's loss alone then teaches it what goals are."""
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


def has_own_loss(learner: Learner) -> bool:
    """Whether the goal encoder is trained by anything but the agent's loss."""
    return learner.loss is not no_loss


def teaches_goals(learner: Learner) -> bool:
    """Whether anything but the agent's loss teaches the goal encoder what goals are."""
    return has_own_loss(learner) and not learner.only_compresses


def has_reward(learner: Learner) -> bool:
    """Whether there is an intrinsic reward."""
    return learner.intrinsic_reward is not no_reward
