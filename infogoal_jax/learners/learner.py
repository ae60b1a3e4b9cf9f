"""What a goal-representation learner is: a record of pure functions, like an optax transformation. No learner knows an environment."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.goals import GoalSet, corrupt, draw_backgrounds
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


class PairRequest(NamedTuple):
    """How many pairs a learner wants in each update (0: none), the width of the window, and how negatives are drawn."""

    num_pairs: int
    window: int
    num_negatives: int
    anchored: bool


class Learner(NamedTuple):
    """A goal-representation learner.

    init(key, goal_inputs, hyper) -> (params, state): parameters are trained by gradient, state is everything else.
    encode(params, goal_inputs) -> GoalCode; inputs are vectors float32 [..., D] or images uint8 [..., H, W, C].
    pairs: what the learner wants sampled for its loss.
    loss(params, state, encode, pairs: GoalPairs, key) -> (loss, metrics); called with the goal encoder's gradient on.
    update(state, metrics, hyper) -> state: after the gradient (the Lagrange multiplier, running means).
    intrinsic_reward(state, encode, desired int32 [B], achieved int32 [B, n, K] padded with -1, mask float32 [B, n] of the steps that were taken) ->
    (float32 [B, n], state).
    """

    init: Callable[[jax.Array, jax.Array, Any], tuple[Any, Any]]
    encode: Callable[[Any, jax.Array], GoalCode]
    pairs: PairRequest
    loss: Callable[[Any, Any, Encode, GoalPairs, jax.Array], tuple[jax.Array, dict[str, jax.Array]]]
    update: Callable[[Any, dict[str, jax.Array], Any], Any]
    intrinsic_reward: Callable[[Any, Encode, jax.Array, jax.Array, jax.Array], tuple[jax.Array, Any]]


GOALS_AT_ONCE = 256  # Images that are encoded together: their patches take 13 MB.


class Corruption(NamedTuple):
    """How the images of goals are corrupted while training: key of the draws, backgrounds uint8 [M, H, W, C], and their weight."""

    key: jax.Array
    backgrounds: jax.Array
    weight: float


def encode_goals(learner: Learner, params: Any, goals: GoalSet, batch_size: int, corruption: Corruption | None = None) -> Encode:
    """How to encode any goals under these parameters: all of them once if they are fewer than `batch_size`, else only those asked for.

    With a corruption every goal gets a background of its own each time that this is called; within a scan each place
    in the batch keeps its background.
    """
    if corruption is not None:
        calls = itertools.count()

        def encode(indices):
            key = jax.random.fold_in(corruption.key, next(calls))
            backgrounds = draw_backgrounds(key, corruption.backgrounds, indices.shape)
            return learner.encode(params, corrupt(goals.inputs_of(indices), backgrounds, corruption.weight))

        return encode
    if goals.num_goals <= batch_size:
        return learner.encode(params, goals.inputs_of(jnp.arange(goals.num_goals))).__getitem__
    return lambda indices: learner.encode(params, goals.inputs_of(indices))


def encode_all(learner: Learner, params: Any, goals: GoalSet) -> GoalCode:
    """The codes of all goals [N], a few hundred at a time: a large set of images does not fit into memory at once."""
    return jax.lax.map(lambda goal: learner.encode(params, goals.inputs_of(goal)), jnp.arange(goals.num_goals), batch_size=GOALS_AT_ONCE)


def in_place(codes: GoalCode, goals: GoalSet, which: jax.Array) -> Encode:
    """Codes of the goals `which`, in their order, looked up by goal."""
    place = jnp.zeros(goals.num_goals, jnp.int32).at[which].set(jnp.arange(len(which)))
    return lambda indices: codes[place[indices]]


def encode_commanded(learner: Learner, params: Any, goals: GoalSet, batch_size: int, corruption: Corruption | None = None) -> Encode:
    """How to encode goals that are commanded while training: they are few, so each is encoded once however large the goal space is."""
    if corruption is not None or goals.num_goals <= batch_size:
        return encode_goals(learner, params, goals, batch_size, corruption)
    return in_place(learner.encode(params, goals.inputs_of(goals.commanded)), goals, goals.commanded)
