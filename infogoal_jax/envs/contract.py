"""Whether an environment keeps the contract of environment.py, found out by `jax.eval_shape`, which computes nothing:
what each function returns, alone and on stored arrays with more axes."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks
from infogoal_jax.checks import Spec
from infogoal_jax.envs.environment import Environment, draws_itself
from infogoal_jax.envs.goal_task import GoalTask, all_finite
from infogoal_jax.errors import UserError, require
from infogoal_jax.field_types import LARGEST_FLOAT, LARGEST_WHOLE
from infogoal_jax.goals import GoalBox, GoalSet, GoalSpace
from infogoal_jax.keys import from_seed
from infogoal_jax.replay import Trajectories

FLAGS = ("terminated", "truncated", "diverged")
LEAST_SQUARE = float(np.finfo(np.float32).tiny)
"""What is smaller is 0 on a device."""
SWITCHES = (
    "discrete",
    "has_target_states",
    "goals_are_observations",
    "has_shortest_path",
    "ends_at_goal",
    "can_fail",
    "simulated",
    "costly_reset",
)
STORED = (2, 3)
"""Axes of stored arrays, for the functions that take any."""
DRAWN = 256
"""Desired goals of training that are looked at."""


def check_contract(env: Environment) -> None:
    """Raise `UserError`, naming the member and what it has to be, for an environment that breaks the contract."""
    check_members(env)
    try:
        check_functions(env)
    except UserError:
        if all(getattr(type(env), name, None) is getattr(GoalTask, name) for name in KEPT):
            check_world(env)  # The same in the words of what its author wrote.
        raise


KEPT = ("reset", "reset_to", "step", "observe", "achieved", "render")
"""What a `GoalTask` does by the functions of a world, unless its author writes these too."""


def check_world(task: GoalTask) -> None:
    """Raise `UserError` for the first of the functions of a world that returns something else than it has to."""
    world = checks.traced("env.begin", task.begin, jax.eval_shape(lambda: jax.random.key(0)))
    action = Spec((), "int32") if task.discrete else Spec((task.action_size,), "float32")
    checks.same_shapes(checks.traced("env.move", task.move, world, action.struct), world, "env.move", "env.begin")
    seen = checks.traced("env.observation", task.observation, world)
    if not is_image_or_vector(seen):
        raise UserError(f"env.observation: returns {checks.described(seen)}; return float32 [D] or uint8 [H, W, C]")
    achieved = checks.traced("env.achieved_goal", task.achieved_goal, world)
    checks.returned(achieved, "env.achieved_goal", Spec(task.goals.shape, task.goals.dtype), "a goal of env.goals")


def is_image_or_vector(seen: Any) -> bool:
    """Whether this is what networks take of one observation."""
    if not checks.is_array(seen) or 0 in seen.shape:
        return False
    return (str(seen.dtype), seen.ndim) in (("uint8", 3), ("float32", 1))


def check_functions(env: Environment) -> None:
    """Raise `UserError` for functions of an environment that break the contract."""
    key = jax.eval_shape(lambda: jax.random.key(0))
    state = checks.traced("env.reset", env.reset, key)
    check_state(env, state)
    again = checks.traced("env.reset_to", env.reset_to, key, state.desired_goal)
    checks.same_shapes(again, state, "env.reset_to", "env.reset")
    action = Spec((), "int32") if env.discrete else Spec((env.action_size,), "float32")
    checks.same_shapes(
        checks.traced("env.step", env.step, state, action.struct), state, "the state of env.step", "that of env.reset"
    )
    check_flag(checks.traced("env.decides", env.decides, state), "env.decides")
    if env.can_fail:
        check_flag(checks.traced("env.failed", env.failed, state), "env.failed")
    if env.has_shortest_path:
        checks.returned(
            checks.traced("env.shortest_path", env.shortest_path, state), "env.shortest_path", Spec((), "int32")
        )
    check_stored(env, state)
    if env.recorded is not None:
        check_recorded(env, state)
    if draws_itself(env):
        checks.function(env.draw, "env.draw", 1, "give a function of a state")
        picture = checks.traced("env.draw", env.draw, state)
        checks.returned(picture, "env.draw", Spec(("H", "W", 3), "uint8"))
        require(0 not in picture.shape, "env.draw", checks.described(picture), "give a picture with pixels")


def check_members(env: Environment) -> None:
    """Raise `UserError` for members of other kinds than the contract has."""
    asked = ("goals", "action_size", "episode_length", "source")
    missing = [name for name in asked if not hasattr(env, name)]
    require(not missing, "env", type(env).__name__, f"has no {', '.join(missing)}, which the contract asks for")
    is_leaf = jax.tree_util.all_leaves([env])
    require(not is_leaf, "env", type(env).__name__, "is no pytree; write @flax.struct.dataclass above its class")
    check_kind(env)
    if isinstance(env, GoalTask):
        require(not env.goals.finite, "env.goals", type(env.goals).__name__, "a GoalTask has a GoalBox.of")
        remedy = "nothing calls it: a goal that is reached is the reward; leave it out, and write reached for another"
        require(not hasattr(type(env), "reward"), "env.reward", "a function", remedy)
        remedy = "give a distance above 0, whose square float32 holds"
        square = checks.number(env.radius, "env.radius", 0, remedy=remedy) ** 2
        require(LEAST_SQUARE <= square <= LARGEST_FLOAT, "env.radius", env.radius, remedy)
    for name in ("action_size", "episode_length", "num_cells"):
        checks.whole(checks.called(f"env.{name}", getattr, env, name), f"env.{name}", 1, LARGEST_WHOLE)
    if isinstance(env, GoalTask) and env.action_bounds is not None:
        field, given = "env.action_bounds", env.action_bounds
        require(not env.discrete, field, given, "is of actions that are vectors, and these are moves; leave it out")
        low, high = np.asarray(checks.array(given, field, "numbers", (2, env.action_size)))
        require((low < high).all(), field, given, "give the lowest actions, then the highest")
    if env.num_observations is not None:
        checks.whole(env.num_observations, "env.num_observations", 1)
    checks.text(env.source, "env.source", "say in words what the data is")
    recorded = type(env.recorded).__name__
    require(
        env.recorded is None or isinstance(env.recorded, Trajectories), "env.recorded", recorded, "give Trajectories"
    )
    learnable = env.simulated or env.recorded is not None
    require(learnable, "env.simulated", env.simulated, "give recordings in env.recorded, or a task to act in")
    num_goals = env.goals.num_goals
    arrays = {
        "train_backgrounds": ("uint8", ("B", "H", "W", "C")),
        "test_backgrounds": ("uint8", ("B", "H", "W", "C")),
        "goal_positions": ("float32", (num_goals or "N", "D")),
        "near_goals": ("bool", (num_goals or "N",)),
    }
    for name, (dtype, shape) in arrays.items():
        array, wanted = getattr(env, name), f"give {dtype} [{', '.join(map(str, shape))}], or None"
        if array is not None:
            require(checks.is_array(array), f"env.{name}", type(array).__name__, wanted)
            dtype_of = str(checks.called(f"env.{name}", jnp.result_type, array))
            found = checks.written(np.shape(array), dtype_of)
            fits = dtype_of == dtype and checks.has_shape(np.shape(array), shape)
            require(fits, f"env.{name}", found, wanted)
            known = num_goals is not None or name not in ("goal_positions", "near_goals")
            require(known, f"env.{name}", found, "the goals are no finite set, of which each has one; give None")
    check_backgrounds(env)


def check_backgrounds(env: Environment) -> None:
    """Raise `UserError` for backgrounds of goals that are not images, of other sizes than these, or for training or
    evaluation alone."""
    banks = {name: getattr(env, name) for name in ("train_backgrounds", "test_backgrounds")}
    if env.goals.by_index or not any(bank is not None for bank in banks.values()):
        return
    goal = Spec(env.goals.shape, env.goals.dtype).struct
    seen = checks.traced("env.goals.inputs_of", env.goals.inputs_of, goal)
    is_image = str(seen.dtype) == "uint8" and seen.ndim == 3
    for name, bank in banks.items():
        require(
            bank is not None, f"env.{name}", None, "give backgrounds both for training and for tests, or for neither"
        )
        remedy = f"give {checks.written(('B', *seen.shape), 'uint8')}, as goal images are" if is_image else "give None"
        found = checks.written(np.shape(bank), str(jnp.result_type(bank)))
        reason = remedy if is_image else f"goals are no images, but {checks.described(seen)}; {remedy}"
        require(is_image and np.shape(bank)[1:] == seen.shape, f"env.{name}", found, reason)


def check_kind(env: Environment) -> None:
    """Raise `UserError` for an environment whose goals are no goal space, or one of whose switches is none."""
    for name in SWITCHES:
        checks.flag(getattr(env, name), f"env.{name}")
    kind = type(getattr(env, "goals", None)).__name__
    require(
        isinstance(getattr(env, "goals", None), GoalSet | GoalBox), "env.goals", kind, "give GoalSet.of or GoalBox.of"
    )


def check_state(env: Environment, state: Any) -> None:
    """Raise `UserError` for a state without the fields that every state has, or with others under their names."""
    for name in ("desired_goal", "time", *FLAGS):
        require(hasattr(state, name), "the state of env.reset", type(state).__name__, f"has no field {name}")
    for name in FLAGS:
        check_flag(getattr(state, name), f"state.{name}")
    checks.returned(state.time, "state.time", Spec((), "int32"))
    checks.returned(state.desired_goal, "state.desired_goal", Spec(env.goals.shape, env.goals.dtype))


def check_starts(env: Environment) -> None:
    """Raise `UserError` for a task in which held-out goals are learned, or nothing can be: desired goals of training
    that are none of the space or held out, starts that are not finite. These few episodes are begun."""
    with jax.ensure_compile_time_eval():
        keys = jax.random.split(from_seed(np.uint32(0)), DRAWN)
        desired, cells, finite = jax.jit(jax.vmap(lambda key: started(env, env.reset(key))))(keys)
        remedy = "from env.goals.desired_goals" if env.goals.finite else "by env.goals.draw"
        check_desired(env.goals, desired, "the goal of env.reset", f"draw it {remedy}")
        if env.recorded is not None:
            recorded = np.asarray(env.recorded.desired_goal)[np.asarray(env.recorded.valid)]
            check_desired(env.goals, recorded, "env.recorded.desired_goal", "give recordings for training goals")
        names = ("env.begin", "env.observation", "env.begin") if isinstance(env, GoalTask) else ("env.observe",)
        for name, those in zip(names, finite, strict=True):
            check_all_finite(name, np.asarray(those), "return finite numbers")
        outside = np.asarray(cells)[(cells < 0) | (cells >= env.num_cells)][:1].tolist()
        require(not outside, "env.cell_of", outside, f"give cells from 0 to below env.num_cells = {env.num_cells}")


def check_all_finite(name: str, finite: np.ndarray, remedy: str) -> None:
    """Raise `UserError`, naming what gave the numbers, unless they are finite at all of these starts, bool [N]."""
    require(bool(finite.all()), name, f"not finite at {1 - finite.mean():.0%} of the starts", remedy)


def check_reached(env: Environment) -> None:
    """Raise `UserError` for a task whose evaluated goals do not count as reached where they are achieved, or whose
    goals always do: nothing can be learned in it."""
    if type(env).goals_of is not Environment.goals_of:
        return  # What achieves a goal is known to the task alone.
    with jax.ensure_compile_time_eval():
        goals = env.goals.evaluated
        reached = np.asarray(jax.jit(lambda goals: env.reached(goals[:, None], goals[None]))(goals))
    by_radius = getattr(type(env), "reached", None) is GoalTask.reached
    radius = f" (radius = {env.radius:g})" if by_radius else ""
    larger, smaller = ("give a larger radius", "give a smaller radius") if by_radius else ("mend it", "mend it")
    never, always = np.flatnonzero(~np.diagonal(reached)), reached.all()
    if len(never):
        goal = rounded(np.asarray(goals)[never[0]])
        raise UserError(f"env.reached: is False where the goal {goal} itself is achieved{radius}; {larger}")
    one = len(goals) > 1 and (np.asarray(goals) == np.asarray(goals)[0]).all()
    require(
        not one, "sampler", rounded(np.asarray(goals)[0]), "is the only goal that it draws; draw others from the key"
    )
    require(
        len(goals) < 2 or not always,
        "env.reached",
        "True for every two goals",
        f"there is nothing to learn{radius}; {smaller}",
    )


def check_desired(goals: GoalSpace, desired: Any, field: str, remedy: str) -> None:
    """Raise `UserError` for desired goals of training [M, *shape] that are none of the space, or held out."""
    desired = np.asarray(goals.checked(desired, field, axes=1))
    trained = np.asarray(jax.jit(goals.is_training_goal)(desired))
    held_out = desired[~trained][:1]
    shown = [goals.names[goal] for goal in held_out] if goals.finite else rounded(held_out)
    require(trained.all(), field, shown, f"is held out of training; {remedy}")


def started(env: Environment, state: Any) -> tuple[jax.Array, jax.Array, list[jax.Array]]:
    """The desired goal of an episode that begins, the cell of what it achieves then, and whether what is seen of it is
    finite; of a `GoalTask` before that its world alone, and behind it all that has to be."""
    seen, cell = jnp.isfinite(env.render(env.observe(state))).all(), env.cell_of(env.achieved(state))
    if not isinstance(env, GoalTask):
        return state.desired_goal, cell, [seen]
    # Numbers of a simulator may be infinite by design.
    world = all_finite(state.world) if type(env).is_finite is GoalTask.is_finite else jnp.asarray(True)
    return state.desired_goal, cell, [world, seen, env.is_finite(state.world)]


def rounded(goals: np.ndarray) -> list:
    """Goals as a message shows them."""
    return np.round(goals.astype(float), 4).tolist()


def check_recorded(env: Environment, state: Any) -> None:
    """Raise `UserError` for recordings that are not rows of T transitions of this task."""
    rows, action = env.recorded, Spec((), "int32") if env.discrete else Spec((env.action_size,), "float32")
    checks.returned(rows.valid, "env.recorded.valid", Spec(("R", "T"), "bool"))
    count, steps = rows.valid.shape
    flag = Spec((), "bool").struct
    wanted = {
        "observation": (steps + 1, checks.traced("env.observe", env.observe, state)),
        "record": (steps + 1, checks.traced("env.achieved", env.achieved, state)),
        "action": (steps, action.struct),
        "desired_goal": (steps, Spec(env.goals.shape, env.goals.dtype).struct),
        **dict.fromkeys(("terminated", "truncated", "decided"), (steps, flag)),
    }
    for name, (length, example) in wanted.items():
        stored = checks.with_axes(example, (count, length))
        checks.same_shapes(getattr(rows, name), stored, f"env.recorded.{name}", "what the task gives of each step")


def check_flag(found: Any, name: str) -> None:
    """Raise `UserError` for what is not one bool."""
    checks.returned(found, name, Spec((), "bool"))


def check_stored(env: Environment, state: Any) -> None:
    """Raise `UserError` for functions of stored observations and records that break the contract, with any axes."""
    observation = checks.traced("env.observe", env.observe, state)
    record = checks.traced("env.achieved", env.achieved, state)
    for name, tree in {"env.observe": observation, "env.achieved": record}.items():
        require(len(jax.tree.leaves(tree)) > 0, name, tree, "return an array, or a pytree of them")
    if env.num_observations is not None:
        checks.returned(observation, "env.observe", Spec((), "int32"), "for env.num_observations is given")
    goal = Spec(env.goals.shape, env.goals.dtype)
    seen = checks.traced("env.render", env.render, observation)
    found = checks.described(seen)
    if not is_image_or_vector(seen):
        raise UserError(f"env.render: returns {found} of one observation; return uint8 [H, W, C] or float32 [D]")
    checked: list[tuple[str, Callable, tuple, tuple, str]] = [
        ("env.render", env.render, (observation,), seen.shape, str(seen.dtype)),
        ("env.action_mask", env.action_mask, (observation,), (env.action_size,), "bool"),
        ("env.reached", env.reached, (record, goal.struct), (), "bool"),
        ("env.cell_of", env.cell_of, (record,), (), "int32"),
        ("env.goals_of", env.goals_of, (record,), ("K", *env.goals.shape), env.goals.dtype),
    ]
    for name, function, arguments, shape, dtype in checked:
        for axes in ((), STORED):
            given = checks.with_axes(arguments, axes)
            found = checks.traced(name, function, *given)
            checks.returned(found, name, Spec((*axes, *shape), dtype), f"for arguments with axes {list(axes)}")
