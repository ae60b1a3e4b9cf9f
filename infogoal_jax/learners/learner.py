"""What a goal-representation learner is: a record of pure functions, like an optax transformation. No learner knows an environment."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax

from infogoal_jax.goals import GoalSet
from infogoal_jax.pairs import GoalPairs


@flax.struct.dataclass
class GoalCode:
    """A batch of goal codes: mean and std [..., d] of the Gaussian (std is 0 for deterministic methods)."""

    mean: jax.Array
    std: jax.Array

    def sample(self, key: jax.Array) -> jax.Array:
        """z = mean + std * noise, [..., d], differentiable in both (reparameterisation)."""
        return self.mean + self.std * jax.random.normal(key, self.mean.shape)

    def __getitem__(self, goals: jax.Array) -> "GoalCode":
        """The codes of these goals, out of a table of the codes of all goals."""
        return GoalCode(self.mean[goals], self.std[goals])


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
    encode(params, goal_inputs [..., D]) -> GoalCode.
    pairs: what the learner wants sampled for its loss.
    loss(params, state, encode, pairs: GoalPairs, key) -> (loss, metrics); called with the goal encoder's gradient on.
    update(state, metrics, hyper) -> state: after the gradient (the Lagrange multiplier, running means).
    intrinsic_reward(state, encode, desired int32 [B], achieved int32 [B, n, K] padded with -1) -> (float32 [B, n], state).
    """

    init: Callable[[jax.Array, jax.Array, Any], tuple[Any, Any]]
    encode: Callable[[Any, jax.Array], GoalCode]
    pairs: PairRequest
    loss: Callable[[Any, Any, Encode, GoalPairs, jax.Array], tuple[jax.Array, dict[str, jax.Array]]]
    update: Callable[[Any, dict[str, jax.Array], Any], Any]
    intrinsic_reward: Callable[[Any, Encode, jax.Array, jax.Array], tuple[jax.Array, Any]]


def encode_goals(learner: Learner, params: Any, goals: GoalSet, batch_size: int) -> Encode:
    """How to encode goals under these parameters: all of them once if they are fewer than `batch_size`, else only those asked for."""
    if goals.num_goals <= batch_size:
        return learner.encode(params, goals.inputs).__getitem__
    return lambda indices: learner.encode(params, goals.inputs[indices])
