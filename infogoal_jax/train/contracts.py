"""What is checked of policies and states that come from outside, before anything is compiled: their shapes and types,
which `jax.eval_shape` finds out without computing anything."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks
from infogoal_jax.envs.environment import Environment
from infogoal_jax.errors import UserError, require, shown
from infogoal_jax.learners.learner import GoalCode


def check_is_environment(env: Any, remedy: str = "give an environment, such as envs.load makes") -> None:
    """Raise `UserError` for what is no environment."""
    require(isinstance(env, Environment), "env", env, remedy)


RECORDINGS_ALONE = (
    "there are recordings alone, and no environment to act in; play the policy of infogoal export where they were made"
)
"""Why a task that is not `simulated` is not evaluated, and what to do."""


def check_simulated(env: Environment, field: str, value: Any) -> None:
    """Raise `UserError`, naming what was asked for, where nobody can act in the task."""
    require(env.simulated, field, value, RECORDINGS_ALONE)


def checked_policy(env: Environment, policy: Any) -> Callable:
    """The policy, which raises `UserError` when it is traced and returns anything but an action for each episode. And
    at once for what cannot be called as a policy."""
    checks.function(policy, "policy", 3, "give a function of (observations, goals, key)")

    def checked(observation, goal, key):
        actions = checks.called("policy", policy, observation, goal, key)
        check_actions(env, actions, jax.tree.leaves(observation)[0].shape[0])
        return actions

    return checked


def with_checked_inputs(policy: Callable, env: Environment, seen: Any) -> Callable:
    """The policy, which raises `UserError` for observations of other shapes than these, for goals that the task does
    not have, and for what is not finite; of arrays that are traced the shapes alone are known. seen: of one
    observation."""

    def check(place, wanted, given):
        is_whole = jnp.issubdtype(wanted.dtype, jnp.integer)
        shape = ("E", *wanted.shape)
        remedy = f"give observations of the task, {checks.written(shape, str(wanted.dtype))}"
        name = f"observation{jax.tree_util.keystr(place)}"
        checks.array(given, name, "whole numbers" if is_whole else "numbers", shape, remedy)

    def checked(observation, goal, key):
        mine, wanted = jax.tree.structure(observation), jax.tree.structure(seen)
        fits = mine == wanted or jax.tree_util.treedef_is_leaf(wanted)  # One array may be given as nested lists.
        require(fits, "observation", mine, f"give observations of the task, {wanted}")
        jax.tree_util.tree_map_with_path(check, seen, observation)
        if not isinstance(goal, GoalCode):
            env.goals.checked(goal, "goal", axes=1)
        return policy(observation, goal, key)

    return checked


def check_actions(env: Environment, actions: Any, num_episodes: int) -> None:
    """Raise `UserError` for what a policy returned, by its shapes, if it is not one action for each of the episodes."""
    shape, kind = ((num_episodes,), "int32") if env.discrete else ((num_episodes, env.action_size), "float32")
    wanted = checks.written(shape, kind)
    leaves = jax.tree.leaves(actions)
    one = len(leaves) == 1 and leaves[0] is actions and hasattr(actions, "shape")
    require(one, "policy", "a function that returns " + type(actions).__name__, f"return actions {wanted}")
    of_kind = jnp.issubdtype(actions.dtype, jnp.integer if env.discrete else jnp.floating)
    found = checks.written(actions.shape, str(actions.dtype))
    require(of_kind and actions.shape == shape, "policy", f"a function that returns {found}", f"return {wanted}")


def check_starts(env: Environment, starts: Any, desired_goals: jax.Array) -> None:
    """Raise `UserError` unless `starts` are states [M, S] of the environment for the M desired goals, in their
    order."""
    one = jax.eval_shape(env.reset_to, jax.random.key(0), jax.ShapeDtypeStruct(env.goals.shape, env.goals.dtype))
    shape, goals = np.shape(starts.desired_goal), jnp.shape(desired_goals)
    axes = shape[: len(shape) - len(env.goals.shape)]
    remedy = f"give states [M, S] of env.reset_to for the {goals[0]} goals, goals first"
    require(len(axes) == 2, "starts", f"states {list(axes)}", remedy)
    if axes[0] != goals[0]:
        raise UserError(f"starts = states {list(axes)}, goals = {list(goals)}: {remedy}")
    require(axes[1] > 0, "starts", f"states {list(axes)}", "give at least one start for each goal")
    several = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*axes, *leaf.shape), leaf.dtype), one)
    require(jax.tree.structure(starts) == jax.tree.structure(one), "starts", type(starts).__name__, remedy)
    checks.same_shapes(starts, several, "starts", "the states of this environment")
    if checks.is_traced((starts.desired_goal, desired_goals)):
        return
    own, asked = np.asarray(starts.desired_goal), np.asarray(desired_goals)
    different = np.flatnonzero((own != asked[:, None]).reshape(len(asked), -1).any(1))
    if different.size:
        row = different[0]
        raise UserError(
            f"starts[{row}] = states for goal {shown(own[row].tolist())}, goals[{row}] = {asked[row].tolist()}: the "
            "states are for other goals; give both in one order, or the number of starts"
        )


def check_shown(shown_goals: Any, num_goals: int, num_starts: int, field: str) -> None:
    """Raise `UserError` unless every leaf of what a policy is shown has a place for each goal and start: [M, S, ...] or
    [M, 1, ...]."""
    leaves = jax.tree_util.tree_leaves_with_path(shown_goals)
    require(len(leaves) > 0, f"{field}.shown", shown_goals, "give arrays [M, S, ...]")
    for path, leaf in leaves:
        name, shape = f"{field}.shown{jax.tree_util.keystr(path)}", np.shape(leaf)
        fits = len(shape) >= 2 and shape[0] == num_goals and shape[1] in (1, num_starts)
        require(
            fits, name, list(shape), f"give [{num_goals}, {num_starts}, ...] or [{num_goals}, 1, ...]: goals and starts"
        )
