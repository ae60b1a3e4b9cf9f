"""How the codes of many goals are made at once: each goal of a small set a single time, images of a large one a few
hundred at a time."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from infogoal_jax.goals import GoalSet, GoalSpace, axes_of
from infogoal_jax.learners.learner import Encode, GoalCode, Learner

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
