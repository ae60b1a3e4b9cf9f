"""What a goal-representation learner is: a record of pure functions, like an optax transformation. No learner knows an environment."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.goals import GoalSet
from infogoal_jax.pairs import GoalPairs


@flax.struct.dataclass
class GoalCode:
    """A batch of goal codes: mean and std [..., d] of the Gaussian; std is None for deterministic methods, which draw nothing."""

    mean: jax.Array
    std: jax.Array | None = None

    def sample(self, key: jax.Array) -> jax.Array:
        """z = mean + std * noise, [..., d], differentiable in both (reparameterisation)."""
        return self.mean if self.std is None else self.mean + self.std * jax.random.normal(key, self.mean.shape)

    def __getitem__(self, goals: jax.Array) -> "GoalCode":
        """The codes of these goals, out of a table of the codes of all goals."""
        return jax.tree.map(lambda leaf: leaf[goals], self)


Encode = Callable[[jax.Array], GoalCode]
"""Goal indices int32 [...] to their codes, for one set of parameters: a table for small goal sets, the network itself for large ones."""


class SampleSpec(NamedTuple):
    """What a learner wants sampled for each of its losses.

    num_pairs: of goals achieved within `window` steps of each other, each with `num_negatives`; anchored: whether a negative is compared with the
    pair's anchor, or with a goal of its own; dissimilar: whether negatives are taken from G_neg, or are any known goals. num_goals: known goals.
    relabelled_share: of the transitions, which are seen under a goal achieved later in their episode; the agent learns from them as they are.
    """

    num_pairs: int = 0
    window: int = 0
    num_negatives: int = 1
    anchored: bool = True
    dissimilar: bool = True
    num_goals: int = 0
    relabelled_share: float = 0.0


class InputSpec(NamedTuple):
    """What a learner's networks are made for: goal_inputs [M, ...] of training goals, features [F] of a state, and how many cells visits count in."""

    goal_inputs: jax.Array
    features: jax.Array
    num_cells: int


class Steps(NamedTuple):
    """B transitions of n steps, under the goals `LearnerBatch.desired`.

    features [B, F] of the states that they start from, with the state encoder's gradient, and next_features, without, of those that they lead to;
    reward: float32 [B], discounted sum of the environment's over the steps; discount: float32 [B] of what follows them, 0 after termination.
    """

    features: jax.Array
    next_features: jax.Array
    reward: jax.Array
    discount: jax.Array


class LearnerBatch(NamedTuple):
    """What a learner's loss may look at.

    encode: by the goal encoder that is trained; inputs_of: goals [...] to what the encoder sees of them; pairs: as asked for, or None;
    goals: int32 [num_goals], known goals; desired: int32 [B], the goals of the transitions, which are those of the agent's batch, but for the share
    of them that was asked for in hindsight.
    """

    encode: Encode
    inputs_of: Callable[[jax.Array], jax.Array]
    pairs: GoalPairs | None
    goals: jax.Array
    desired: jax.Array
    transitions: Steps


@flax.struct.dataclass
class Visited:
    """Where B transitions of n steps led, for an intrinsic reward.

    desired: int32 [B]; achieved: int32 [B, n, K], the known goals achieved after each step, padded with -1; cell: int32 [B, n], in which visits are
    counted; mask: float32 [B, n] of the steps that were taken.
    """

    desired: jax.Array
    achieved: jax.Array
    cell: jax.Array
    mask: jax.Array


def no_loss(params: Any, state: Any, batch: LearnerBatch, hyper: Any, key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array], Any]:
    """Nothing but the agent's loss trains the goal encoder."""
    return jnp.zeros(()), {}, state


def no_reward(state: Any, encode: Encode, visited: Visited) -> tuple[jax.Array, Any]:
    """No intrinsic reward."""
    return jnp.zeros(visited.mask.shape), state


def keep(state: Any, cell: jax.Array, valid: jax.Array) -> Any:
    """Nothing is learned from where the agent went."""
    return state


class Learner(NamedTuple):
    """A goal-representation learner.

    init(key, example: InputSpec, hyper) -> (params, state): parameters are trained by gradient, state is everything else.
    encode(params, goal_inputs) -> GoalCode; inputs are vectors float32 [..., D] or images uint8 [..., H, W, C].
    loss(params, state, batch: LearnerBatch, hyper, key) -> (loss, metrics, state): the state is that of the next update (the Lagrange multiplier,
    running means).
    sample_spec: what the learner wants sampled for its loss.
    intrinsic_reward(state, encode, visited: Visited) -> (float32 [B, n], state).
    observe(state, cell int32 [R, T], valid bool [R, T]) -> state: with the transitions that were collected, by the cell that each led to.
    condition(params, code: GoalCode [B], features [B, F]) -> GoalCode: what the agent is given, where that depends on the state too; or None.
    augment(key, goal_inputs [B, ...]) -> goal_inputs: how inputs are varied in the agent's updates; or None.
    mean_at_test: whether a policy that is tested is given the mean of a code, not a draw.
    """

    init: Callable[[jax.Array, InputSpec, Any], tuple[Any, Any]]
    encode: Callable[[Any, jax.Array], GoalCode]
    loss: Callable[[Any, Any, LearnerBatch, Any, jax.Array], tuple[jax.Array, dict[str, jax.Array], Any]]
    sample_spec: SampleSpec = SampleSpec()
    intrinsic_reward: Callable[[Any, Encode, Visited], tuple[jax.Array, Any]] = no_reward
    observe: Callable[[Any, jax.Array, jax.Array], Any] = keep
    condition: Callable[[Any, GoalCode, jax.Array], GoalCode] | None = None
    augment: Callable[[jax.Array, jax.Array], jax.Array] | None = None
    mean_at_test: bool = False


def conditioned(learner: Learner, params: Any, code: GoalCode, features: jax.Array) -> GoalCode:
    """What the agent is given of these goals [B] in states of these features [B, F]."""
    return code if learner.condition is None else learner.condition(params, code, features)


View = Callable[[jax.Array, jax.Array], jax.Array]
"""How goal inputs look while training: a key and inputs [..., *input] to inputs of the same shape, each varied by itself."""

GOALS_AT_ONCE = 256  # Images that are encoded together: their patches take 13 MB.


def encode_goals(learner: Learner, params: Any, goals: GoalSet, batch_size: int, view: View | None = None, key: jax.Array | None = None) -> Encode:
    """How to encode any goals under these parameters: all of them once if they are fewer than `batch_size`, else only those asked for.

    With a view every goal is varied anew each time that this is called, by draws from `key`; within a scan each place in the batch keeps its draw.
    """
    if view is not None:
        calls = itertools.count()
        return lambda indices: learner.encode(params, view(jax.random.fold_in(key, next(calls)), goals.inputs_of(indices)))
    if goals.num_goals <= batch_size:
        return learner.encode(params, goals.inputs_of(jnp.arange(goals.num_goals))).__getitem__
    return lambda indices: learner.encode(params, goals.inputs_of(indices))


def encode_each(encode: Encode, *goals: jax.Array) -> list[GoalCode]:
    """The codes of several arrays of goals, in one pass of the encoder: matrix products of one array's rows leave most of a GPU idle."""
    codes, ends = encode(jnp.concatenate([array.ravel() for array in goals])), list(itertools.accumulate(array.size for array in goals))
    return [
        jax.tree.map(lambda leaf, array=array, end=end: leaf[end - array.size : end].reshape(*array.shape, -1), codes)
        for array, end in zip(goals, ends, strict=True)
    ]


def encode_all(learner: Learner, params: Any, goals: GoalSet) -> GoalCode:
    """The codes of all goals [N], a few hundred at a time: a large set of images does not fit into memory at once."""
    return jax.lax.map(lambda goal: learner.encode(params, goals.inputs_of(goal)), jnp.arange(goals.num_goals), batch_size=GOALS_AT_ONCE)


def lookup(codes: GoalCode, goals: GoalSet, which: jax.Array) -> Encode:
    """Codes of the goals `which`, in their order, looked up by goal."""
    place = jnp.zeros(goals.num_goals, jnp.int32).at[which].set(jnp.arange(len(which)))
    return lambda indices: codes[place[indices]]


def encode_commanded(learner: Learner, params: Any, goals: GoalSet, batch_size: int, view: View | None = None, key: jax.Array | None = None):
    """How to encode goals that are commanded while training: they are few, so each is encoded once however large the goal space is."""
    if view is not None or goals.num_goals <= batch_size:
        return encode_goals(learner, params, goals, batch_size, view, key)
    return lookup(learner.encode(params, goals.inputs_of(goals.commanded)), goals, goals.commanded)
