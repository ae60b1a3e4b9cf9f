"""Parts that a user registered, each function with a check of what it returns: when it is traced, and so before
anything is compiled. The package's own parts are not wrapped; tests hold them to the same checks."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import jax.numpy as jnp

from infogoal_jax import checks
from infogoal_jax.agents.agent import Agent
from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.checks import Spec
from infogoal_jax.errors import UserError, a, require
from infogoal_jax.exploration.explorer import Explorer
from infogoal_jax.learners.learner import GoalCode, Learner, SampleSpec, keep, no_loss, no_reward
from infogoal_jax.registry import Entry
from infogoal_jax.relabelling.relabelling import Relabelling

DEFAULTS = (no_loss, no_reward, keep)
"""Told apart by their identity: whether a learner has a loss of its own."""


def is_foreign(made_by: Any) -> bool:
    """Whether a class or function comes from outside of the package."""
    module = getattr(getattr(made_by, "func", made_by), "__module__", None) or ""
    return module.split(".")[0] not in ("infogoal_jax", "infogoal_paper")


def checked_part(kind: str, entry: Entry, config: Any, env: Any) -> Any:
    """The part that a configuration names, with checks if it comes from outside. Raises `UserError` for anything
    else."""
    arguments = (getattr(config, kind), env) if kind == "agent" else (getattr(config, kind),)
    if not is_foreign(entry.make):
        return entry.make(*arguments)
    part = checks.called(f"the make of the {kind}", entry.make, *arguments)
    return {
        "learner": with_learner_checks,
        "agent": lambda part: with_agent_checks(part, env),
        "relabelling": with_relabelling_checks,
        "explorer": lambda part: with_explorer_checks(part, env),
    }[kind](part)


def check_record(part: Any, kind: str, record: type, functions: dict[str, int]) -> None:
    """Raise `UserError` for what is not this record, or has something else where a function of so many arguments
    belongs."""
    require(isinstance(part, record), kind, type(part).__name__, f"its make has to return {a(record.__name__)}")
    for name, arguments in functions.items():
        if getattr(part, name) is not None:
            checks.function(getattr(part, name), f"{kind}.{name}", arguments, f"see {record.__name__}.{name}")


def with_check(name: str, function: Callable | None, check: Callable) -> Callable | None:
    """The function, whose result is given with its arguments to `check(result, *arguments)` when it is traced."""
    if function is None or function in DEFAULTS:
        return function

    @wraps(function)
    def checked(*arguments):
        result = checks.called(name, function, *arguments)
        check(result, *arguments)
        return result

    return checked


def check_tuple(result: Any, name: str, parts: tuple[str, ...]) -> None:
    """Raise `UserError` for what is not a tuple of these parts."""
    wanted = f"return ({', '.join(parts)})"
    require(isinstance(result, tuple) and len(result) == len(parts), name, checks.described(result), wanted)


def check_number(found: Any, name: str) -> None:
    """Raise `UserError` for what is not one number of floats."""
    fits = (isinstance(found, float) or checks.is_array(found)) and jnp.shape(found) == ()
    if not (fits and jnp.issubdtype(jnp.result_type(found), jnp.floating)):
        raise UserError(f"{name}: is {checks.described(found)}; give float32 []")


def check_metrics(metrics: Any, name: str) -> None:
    """Raise `UserError` for what are not numbers by name."""
    named = isinstance(metrics, dict) and all(isinstance(key, str) for key in metrics)
    require(named, name, checks.described(metrics), "give a dict of numbers by their names")
    for key, value in metrics.items():
        fits = (isinstance(value, int | float) or checks.is_array(value)) and jnp.shape(value) == ()
        require(fits, f"{name}[{key!r}]", checks.described(value), "give one number")


def check_loss(result: Any, name: str, state: Any, has_state: bool) -> None:
    """Raise `UserError` for what is not (loss, metrics), with the next state behind where there is one."""
    check_tuple(result, name, ("loss", "metrics", "state")[: 2 + has_state])
    check_number(result[0], f"the loss of {name}")
    check_metrics(result[1], f"the metrics of {name}")
    if has_state:
        checks.same_shapes(result[2], state, f"the state of {name}", "the state that it was given")


def check_code(code: Any, name: str, axes: tuple[int, ...]) -> None:
    """Raise `UserError` for what are not codes with these axes."""
    require(isinstance(code, GoalCode), name, checks.described(code), "return a GoalCode")
    checks.returned(code.mean, f"the mean of {name}", Spec((*axes, "d"), "float32"))
    if code.std is not None:
        checks.returned(code.std, f"the std of {name}", Spec(code.mean.shape, "float32"))


def with_learner_checks(learner: Learner) -> Learner:
    """The learner with checks. Raises `UserError` for what is none."""
    functions = {
        "init": 3,
        "encode": 2,
        "loss": 5,
        "intrinsic_reward": 3,
        "observe": 2,
        "condition": 3,
        "augment": 2,
        "similar": 3,
    }
    check_record(learner, "learner", Learner, functions)
    spec = learner.sample_spec
    require(isinstance(spec, SampleSpec), "learner.sample_spec", type(spec).__name__, "give a SampleSpec")
    for name in ("num_pairs", "window", "num_goals"):
        checks.whole(getattr(spec, name), f"learner.sample_spec.{name}", 0)
    checks.whole(spec.num_negatives, "learner.sample_spec.num_negatives", 1)
    for name in ("anchored", "dissimilar", "first_seen"):
        checks.flag(getattr(spec, name), f"learner.sample_spec.{name}")
    relabels = spec.relabelling is None or isinstance(spec.relabelling, Relabelling)
    require(relabels, "learner.sample_spec.relabelling", type(spec.relabelling).__name__, "give a Relabelling")
    for name in ("mean_at_test", "by_index", "needs_features_of_goals"):
        checks.flag(getattr(learner, name), f"learner.{name}")
    rank: list[int] = []  # Axes of one goal's input, of which `init` is given a batch.

    def check_init(result, key, example, hyper):
        check_tuple(result, "learner.init", ("params", "state"))
        rank[:] = [1 if learner.by_index else example.goal_inputs.ndim - 1]

    def check_encode(code, params, goal_inputs):
        axes = goal_inputs.shape[: goal_inputs.ndim - rank[0]] if rank else ("...",)
        check_code(code, "learner.encode", axes)

    def check_reward(result, state, encode, visited):
        check_tuple(result, "learner.intrinsic_reward", ("reward", "state"))
        checks.returned(result[0], "the reward of learner.intrinsic_reward", Spec(visited.mask.shape, "float32"))
        checks.same_shapes(result[1], state, "the state of learner.intrinsic_reward", "the state that it was given")

    def check_augment(result, key, goal_inputs):
        checks.returned(result, "learner.augment", Spec(goal_inputs.shape, str(goal_inputs.dtype)))

    each = {
        "init": check_init,
        "encode": check_encode,
        "loss": lambda result, params, state, batch, hyper, key: check_loss(result, "learner.loss", state, True),
        "intrinsic_reward": check_reward,
        "observe": lambda result, state, new: checks.same_shapes(
            result, state, "the state of learner.observe", "the state that it was given"
        ),
        "condition": lambda result, params, code, features: check_code(
            result, "learner.condition", features.shape[:-1]
        ),
        "augment": check_augment,
    }
    return with_checks(learner, "learner", each)


def with_checks(part: Any, kind: str, each: dict[str, Callable]) -> Any:
    """The record with each of these functions checked."""
    return part._replace(
        **{name: with_check(f"{kind}.{name}", getattr(part, name), check) for name, check in each.items()}
    )


def with_agent_checks(agent: Agent, env: Any) -> Agent:
    """The agent with checks. Raises `UserError` for what is none."""
    check_record(agent, "agent", Agent, {"init": 3, "act": 6, "value": 4, "loss": 6, "observe": 2})
    checks.whole(agent.num_steps, "agent.num_steps", 1)
    goals = agent.all_goals
    fits = goals is None or isinstance(goals, OfAllGoals)
    require(fits, "agent.all_goals", type(goals).__name__, "give an OfAllGoals, or None")

    def check_act(actions, params, features, code, action_mask, key, exploration):
        axes = features.shape[:-1]
        wanted = Spec(axes, "int32") if env.discrete else Spec((*axes, env.action_size), "float32")
        checks.returned(actions, "agent.act", wanted)

    each = {
        "init": lambda result, key, features, code: check_tuple(result, "agent.init", ("params", "state")),
        "act": check_act,
        "value": lambda result, params, features, code, action_mask: checks.returned(
            result, "agent.value", Spec(features.shape[:-1], "float32")
        ),
        "loss": lambda result, *arguments: check_loss(result, "agent.loss", None, False),
        "observe": lambda result, state, rows: checks.same_shapes(
            result, state, "the state of agent.observe", "the state that it was given"
        ),
    }
    return with_checks(agent, "agent", each)


def with_relabelling_checks(relabelling: Relabelling | None) -> Relabelling | None:
    """The relabelling with checks; None where there is none. Raises `UserError` for anything else."""
    if relabelling is None:
        return None
    check_record(relabelling, "relabelling", Relabelling, {"prepare": 1, "relabel": 5, "choose": 5})
    candidates = checks.whole(relabelling.candidates, "relabelling.candidates", 1)
    require(
        (relabelling.choose is None) == (candidates == 1),
        "relabelling.candidates",
        candidates,
        "give more than 1 with choose, and 1 without",
    )
    each = {
        "relabel": lambda result, key, table, row, step, desired_goal: checks.returned(
            result, "relabelling.relabel", Spec(row.shape, "int32")
        ),
        "choose": lambda result, key, table, row, step, desired_goal: checks.returned(
            result, "relabelling.choose", Spec((row.shape[0] // candidates,), "int32")
        ),
    }
    return with_checks(relabelling, "relabelling", each)


def with_explorer_checks(explorer: Explorer | None, env: Any) -> Explorer | None:
    """The explorer with checks; None where there is none. Raises `UserError` for anything else."""
    if explorer is None:
        return None
    check_record(explorer, "explorer", Explorer, {"init": 3, "compute_bonus": 6, "loss": 4})

    def check_bonus(result, params, state, features, rows, written, discount):
        check_tuple(result, "explorer.compute_bonus", ("bonus", "state"))
        wanted = Spec((features.shape[0], env.action_size), "float32")
        checks.returned(result[0], "the bonus of explorer.compute_bonus", wanted)
        checks.same_shapes(result[1], state, "the state of explorer.compute_bonus", "the state that it was given")

    each = {
        "init": lambda result, *arguments: check_tuple(result, "explorer.init", ("params", "state")),
        "compute_bonus": check_bonus,
        "loss": lambda result, params, state, moves, key: check_loss(result, "explorer.loss", state, True),
    }
    return with_checks(explorer, "explorer", each)
