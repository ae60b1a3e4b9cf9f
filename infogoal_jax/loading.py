"""From a configuration to its program: which tasks, methods and agents go together, the environment that a
configuration names, with its files, and the training function of both. What is here reads files; the program in train/
reads none.

Every refusal of a combination stands here once, for training and for the table of `infogoal methods`. Rules look at the
parts of a configuration and at a few traits of its task, which are known before anything is loaded or compiled; of an
environment that was loaded, or made by hand, `traits_seen` reads them off.
"""

import dataclasses
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import agents, checks, envs, exploration, learners, relabelling
from infogoal_jax.agents import traits_of
from infogoal_jax.config import TrainConfig
from infogoal_jax.envs import target_states
from infogoal_jax.envs.contract import check_contract, check_kind, check_reached, check_starts
from infogoal_jax.envs.environment import Traits, has_image_goals
from infogoal_jax.errors import counted, require
from infogoal_jax.field_types import LARGEST_WHOLE
from infogoal_jax.goal_uses import MOST_GOALS
from infogoal_jax.learners.learner import has_reward, teaches_goals
from infogoal_jax.runs import low_level as low_levels
from infogoal_jax.train import program
from infogoal_jax.train.checked_parts import is_foreign
from infogoal_jax.train.contracts import check_is_environment
from infogoal_jax.train.parts import check_hyperparameters, make_learner
from infogoal_jax.train.program import Train


def make_train(config: TrainConfig, env: Any = None, callback: Any = None) -> Train:
    """The training function of this configuration: pure, (key, hyper=None, env=None) -> TrainResult. It can be jitted
    and vmapped, reads no file and keeps no state.

    env: an environment already loaded; None loads the one that the configuration names.
    callback: called with the epoch and the metrics of each evaluation while the compiled program runs; under `jax.vmap`
        for each seed, one after the other. None: there is nothing of it in the program.

    Raises `UserError` for what cannot be trained.
    """
    if callback is not None:
        checks.function(callback, "callback", 2, "give a function of an epoch and metrics, or None")
        callback = one_at_a_time(callback)
    train = program.make_train(config, load_environment(config, env), partial(check_environment, config))
    return dataclasses.replace(train, callback=callback)


def one_at_a_time(function: Callable) -> Callable:
    """The function, which a thread calls when no other thread is in it: JAX calls from several at once."""
    lock = threading.Lock()

    def call(*arguments):
        with lock:
            function(*arguments)

    return call


def traits_declared(config: TrainConfig) -> Traits | None:
    """The traits that the task of a configuration declares, before it is loaded. None: it declares none, and is judged
    once it is loaded."""
    entry = envs.registry.get(config.task)
    return None if entry is None or entry.traits is None else entry.traits(config.env)


def traits_seen(env) -> Traits:
    """The traits of an environment that was loaded or made by hand."""
    return Traits(
        finite_goals=env.goals.finite,
        image_goals=has_image_goals(env),
        moves=env.discrete,
        finite_observations=env.num_observations is not None,
        recorded=env.recorded is not None,
        target_states=env.has_target_states,
        goals_are_observations=env.goals_are_observations,
        ends_at_goal=env.ends_at_goal,
    )


class Refusal(NamedTuple):
    """Why a configuration makes no sense: the field that is to blame and its value, the reason in few words, and what
    to give instead."""

    field: str
    value: Any
    reason: str
    remedy: str


def steers(agent: Any) -> bool:
    """Whether the actions of the agent of this configuration are target states for a low level."""
    return traits_of(agent).actions == "target_states"


def can_act(actions: str, traits: Traits) -> bool:
    """Whether an agent that chooses such actions can act in a task with these traits."""
    return {"moves": traits.moves, "vectors": not traits.moves, "target_states": traits.target_states}[actions]


def refusals(config: TrainConfig, traits: Traits) -> Iterator[Refusal]:
    """Everything that speaks against this configuration of a task with these traits."""
    agent = agents.registry.name_of(config.agent)
    dissimilar_by = getattr(config.learner, "dissimilar_by", "trajectory")
    if not traits.finite_goals:
        yield from refusals_of_continuous_goals(config)
    elif dissimilar_by != "trajectory":
        reason = f"goals of {config.task} are a finite set, of which all dissimilar pairs are known"
        yield Refusal("learner.dissimilar_by", dissimilar_by, reason, "give trajectory")
    if not can_act(traits_of(config.agent).actions, traits):
        reason = {
            "moves": f"this agent chooses among a few moves, and an action of {config.task} is a vector",
            "vectors": f"an action of this agent is a vector, and {config.task} has a few moves to choose from",
            "target_states": "there are no target states that a low level could be sent to",
        }[traits_of(config.agent).actions]
        fitting = [
            name for name, entry in agents.registry.items() if can_act(traits_of(entry.config()).actions, traits)
        ]
        remedy = f"give {' or '.join(fitting)}" if fitting else "no registered agent can act there"
        yield Refusal("agent", agent, reason, remedy)
    yield from refusals_of_all_goals(config)
    if not traits.ends_at_goal:
        yield from refusals_of_episodes_that_go_on(config)
    relabelled = relabelling.registry.name_of(config.relabelling)
    if traits_of(config.agent).costs != (relabelled == "mixed"):
        yield from refusals_of_costs(agent, relabelled, config)
    if traits_of(config.agent).achieved_goals:
        yield from refusals_of_achieved_goals(agent, config)
    if not traits.recorded:
        yield from refusals_of_buffer(config)
        collected = config.num_envs * config.rollout_steps
        if config.num_epochs * collected > LARGEST_WHOLE:
            reason = f"num_envs x rollout_steps = {collected:,} each are more steps of a seed than programs count"
            yield Refusal("num_epochs", config.num_epochs, reason, f"give {LARGEST_WHOLE:,} steps at most")
    explorer = exploration.registry.name_of(config.explorer)
    if explorer != "none":
        yield from refusals_of_explorer(explorer, config.agent, traits)
    if config.desired_goals != "training" and (traits.recorded or not traits.finite_goals):
        reason = "what is recorded has its goals" if traits.recorded else "the goals of the task are no finite set"
        yield Refusal("desired_goals", config.desired_goals, reason, "give training")
    if config.training_corruption and not traits.image_goals:
        yield Refusal(
            "training_corruption",
            config.training_corruption,
            f"goals of {config.task} are not images as it is configured, which alone can be corrupted",
            "give 0",
        )
    if make_learner(config).needs_features_of_goals and not traits.goals_are_observations:
        yield Refusal(
            "learner.grounded",
            True,
            f"a goal of {config.task} is not shown as the agent sees a state, so that there is no phi(g, g)",
            "give False",
        )
    if config.stop_encoder_gradient and not teaches_goals(make_learner(config)):
        yield Refusal(
            "stop_encoder_gradient",
            True,
            f"nothing else than the agent's loss teaches what goals are to the goal encoder of learner "
            f"{learners.registry.name_of(config.learner)!r}",
            "give False, or another learner",
        )


def refusals_of_continuous_goals(config: TrainConfig) -> Iterator[Refusal]:
    """Parts that make sense for a finite set of goals alone."""
    relabelled = relabelling.registry.name_of(config.relabelling)
    learner, spec = learners.registry.name_of(config.learner), make_learner(config).sample_spec
    finite = {
        "relabelling": (relabelled, relabelled in ("cher", "ghrl"), "her or none"),
        "agent.all_goals": (True, traits_of(config.agent).all_goals, "False"),
        "relabelling.strategy": (getattr(config.relabelling, "strategy", None), "prefix", "future or soon"),
        "learner": (learner, make_learner(config).by_index, "another learner"),
        "learner.reward": (getattr(config.learner, "reward", None), spec.first_seen, "rarity"),
        "learner.positives": (getattr(config.learner, "positives", None), spec.radius is not None, "trajectory"),
    }
    for field, (value, refused, remedy) in finite.items():
        if refused is True or refused == value:
            yield Refusal(field, value, "the goals of the task are no finite set", f"give {remedy}")


def refusals_of_all_goals(config: TrainConfig) -> Iterator[Refusal]:
    """What speaks against learning from all goals at once, and against goals that are numbers."""
    name, learner = learners.registry.name_of(config.learner), make_learner(config)
    head = getattr(config.agent, "head", None)
    if learner.by_index != (head == "index"):
        yield Refusal(
            "learner" if learner.by_index else "agent.head",
            name if learner.by_index else head,
            "values with an output for each goal, and codes that are numbers of goals, go together only",
            "give agent dqn or cql" if learner.by_index else "give product, or learner leo",
        )
    if not traits_of(config.agent).all_goals:
        return
    if learner.condition is not None:
        yield Refusal(
            "learner",
            name,
            "its code of a goal depends on the state, so that there is no code for all states at once",
            f"{of_goal_alone(config)}, or --agent.no-all-goals",
        )
    if exploration.registry.name_of(config.explorer) != "none":
        yield Refusal(
            "explorer",
            exploration.registry.name_of(config.explorer),
            "its bonus does not reward reaching one goal rather than another",
            "give none, or --agent.no-all-goals",
        )


def of_goal_alone(config: TrainConfig) -> str:
    """How a learner whose code of a goal depends on the state is told to do without."""
    flags = {"policy_input": "policy-input goal", "state_conditioned": "no-state-conditioned"}
    told = [f" (--learner.{flag})" for field, flag in flags.items() if hasattr(config.learner, field)]
    return "give a code of the goal alone" + "".join(told)


def refusals_of_episodes_that_go_on(config: TrainConfig) -> Iterator[Refusal]:
    """Parts that rely on an episode's end at its goal, and so on values between 0 and 1: a sigmoid, but no clipping."""
    reason = f"an episode of {config.task} goes on at its goal, where every step is worth 1"
    if traits_of(config.agent).sigmoid:
        yield Refusal("agent.bounded", True, reason, "give False, or env.ends_at_goal True")
    if traits_of(config.agent).all_goals:
        yield Refusal("agent.all_goals", True, reason, "give False, or env.ends_at_goal True")


def refusals_of_achieved_goals(agent: str, config: TrainConfig) -> Iterator[Refusal]:
    """What speaks against an agent that learns which goals were achieved. `OfflineCRLConfig.check` has the shares of
    relabelling `mixed`."""
    own, relabelled = traits_of(config.agent), relabelling.registry.name_of(config.relabelling)
    reason = f"agent {agent} learns from goals that were achieved later alone"
    if relabelled == "her":
        her = config.relabelling
        for field, fits, remedy in (
            ("future_share", her.future_share == 1.0, "give --relabelling her with --relabelling.future-share 1"),
            ("strategy", her.strategy != "prefix", "give soon or future"),
            ("skip_reached", not her.skip_reached, "give False"),
        ):
            if not fits:
                yield Refusal(f"relabelling.{field}", getattr(her, field), reason, remedy)
    elif not own.costs:
        yield Refusal("relabelling", relabelled, reason, "give --relabelling her with --relabelling.future-share 1")
    if make_learner(config).condition is not None:
        declared = {name: traits_of(entry.config()) for name, entry in agents.registry.items()}
        others = [name for name, other in declared.items() if own._replace(achieved_goals=False) == other]
        yield Refusal(
            "learner",
            learners.registry.name_of(config.learner),
            f"agent {agent} compares a state with every goal of the batch, and its code of a goal depends on the state",
            f"{of_goal_alone(config)}, or agent {' or '.join(others)}",
        )


def refusals_of_costs(agent: str, relabelled: str, config: TrainConfig) -> Iterator[Refusal]:
    """What speaks against an agent that learns from costs without them, and against costs for another."""
    if traits_of(config.agent).costs:
        reason, remedy = f"agent {agent} learns from costs and from goals of the actor's own", "give mixed"
    else:
        fitting = [name for name, entry in agents.registry.items() if traits_of(entry.config()).costs]
        reason, remedy = f"agent {agent} learns from rewards at the goal", f"give her, or agent {' or '.join(fitting)}"
    yield Refusal("relabelling", relabelled, reason, remedy)


def refusals_of_buffer(config: TrainConfig) -> Iterator[Refusal]:
    """What speaks against a replay buffer that may be without a decision: the step that resets an environment is no
    transition, and a subgoal holds for an interval."""
    kept, asked = config.buffer_epochs * config.rollout_steps, 1 + getattr(config.agent, "interval", 1)
    if kept < asked:
        epochs = -(-asked // config.rollout_steps)
        reason = f"holds {counted(kept, 'step')} of each environment, which may pass without a decision of the agent"
        yield Refusal(
            "buffer_steps", config.buffer_steps, reason, f"give {epochs * config.num_envs * config.rollout_steps}"
        )


def refusals_of_explorer(explorer: str, agent: Any, traits: Traits) -> Iterator[Refusal]:
    """What speaks against a bonus, which is kept for every observation and move."""
    if traits.recorded:
        yield Refusal("explorer", explorer, "a bonus cannot explore what is recorded", "give none")
    elif traits_of(agent).actions != "moves":
        yield Refusal("explorer", explorer, "actions are continuous", "its bonus is kept for each move; give none")
    if not traits.finite_observations:
        yield Refusal(
            "explorer", explorer, "observations do not form a finite set", "its bonus is kept for each; give none"
        )


def reasons_against(config: TrainConfig, env: Any = None) -> list[Refusal]:
    """Everything that speaks against training this configuration, from its parts alone, or as the environment `env`
    shows it; empty: nothing does."""
    if env is not None:
        return list(refusals(config, traits_seen(env)))
    declared = traits_declared(config)
    return [] if declared is None else list(refusals(config, declared))


def check_combination(config: TrainConfig, env: Any = None) -> None:
    """Raise `UserError` for the first of `reasons_against`."""
    for refusal in reasons_against(config, env):
        require(False, refusal.field, refusal.value, f"{refusal.reason}: {refusal.remedy}")


def check_same_task(config: TrainConfig, env: Any) -> None:
    """Raise `UserError` for an environment that is plainly of another task than the configuration."""
    should_be, own = traits_declared(config), env.unwrapped
    if should_be is None:
        return
    if own.goals.by_index:  # One that was loaded for goals by their number is still the task's.
        own = own.with_goals(own.goals.replace(by_index=False))
    seen = traits_seen(own)
    for trait in ("finite_goals", "image_goals", "moves", "finite_observations", "recorded"):
        wanted, found = getattr(should_be, trait), getattr(seen, trait)
        require(
            wanted == found,
            "env",
            type(env.unwrapped).__name__,
            f"is an environment of another task than {config.task} ({trait} is {found}, should be {wanted}); leave it "
            "out, or give one of the task",
        )


def remarks(config: TrainConfig) -> list[str]:
    """What is allowed but unusual about a configuration."""
    declared = traits_declared(config)
    recorded = declared is not None and declared.recorded
    agent, found = agents.registry.name_of(config.agent), []
    if agent == "cql" and declared is not None and not recorded:
        found.append("cql is meant for recorded moves: acting, it holds down the values of what it has not tried")
    if agent == "dqn" and recorded:
        found.append("dqn is meant for acting: nothing holds down the values of moves that were not recorded")
    if traits_of(config.agent).achieved_goals and has_reward(make_learner(config)):
        found.append(f"{agent} learns from no reward: the intrinsic reward of the learner is without effect")
    return found


def load_environment(config: TrainConfig, env: Any = None):
    """The environment that the configuration names, or `env`; under HRAC with the low level in it, so that its actions
    are subgoals.

    Raises `UserError` for files that cannot be used, and for an environment that the agent, or this way of training, is
    not made for.
    """
    require(isinstance(config, TrainConfig), "config", config, "give a TrainConfig, such as presets.load makes")
    if config.task in envs.registry:
        kind = envs.registry[config.task].config
        require(isinstance(config.env, kind), "env", type(config.env).__name__, f"{config.task} needs {kind.__name__}")
    if env is None:
        check_combination(config)
        env = envs.load(config.task, config.env)
    check_environment(config, env)
    foreign = is_foreign(type(env.unwrapped))
    if foreign:
        check_contract(env)
    if make_learner(config).by_index and env.goals.finite:
        env = env.with_goals(env.goals.replace(by_index=True))
    if config.desired_goals == "all" and env.goals.finite:
        listed = np.flatnonzero(env.goals.listed_mask).astype(np.int32)  # A search evaluates some of them alone.
        env = env.with_goals(env.goals.replace(desired=jax.device_put(listed)))
    if foreign:
        check_starts(env)
    if foreign or not env.goals.finite:  # Robots of a user's, under the package's own classes.
        check_reached(env)
    check_combination(config, env)
    if not env.simulated and not env.goals.finite and env.goals.use_of is not None:
        remedy = "the recordings would teach the goals that are held out of training; give held_out"
        require(config.known_goals not in ("visited", "all"), "known_goals", config.known_goals, remedy)
    check_hyperparameters(config, config.hyper)
    require(
        make_learner(config).sample_spec.radius is None or env.goal_positions is not None,
        "learner.positives",
        getattr(config.learner, "positives", None),
        f"{config.task} does not say where its goals lie: give trajectory",
    )
    if getattr(config.learner, "latent_size", 1) == 0:
        kind = jax.eval_shape(env.goals.inputs_of, env.goals.examples[:1]).dtype
        remedy = "goals are no vectors that could be their own codes; give a size greater than 0"
        require(kind == jnp.float32, "learner.latent_size", 0, remedy)
    if steers(config.agent) and not isinstance(env, target_states.SubgoalEnv):
        return steer(env, config.agent)
    return env


def check_environment(config: TrainConfig, env: Any) -> None:
    """Raise `UserError` for what is no environment, one of another task than the configuration, or one without training
    goals or of too many goals."""
    check_is_environment(env)
    check_kind(env)
    count = env.goals.num_goals or 0
    require(
        count <= MOST_GOALS,
        "env.goals",
        count,
        f"give at most {MOST_GOALS}: the dissimilarity matrix takes as many bytes a seed as there are pairs of goals",
    )
    trained = not env.goals.finite or len(env.goals.training_goals) > 0
    require(trained, "env.goals", env.goals.groups, "give one or more training goals, of use 0")
    check_same_task(config, env)
    by_cells = getattr(config.learner, "dissimilar_by", None) == "cells"
    remedy = "goals of so many numbers lie in one cell, in which all are similar; give trajectory"
    require(not by_cells or env.goals.num_cells > 1, "learner.dissimilar_by", "cells", remedy)


def steer(env, config) -> target_states.SubgoalEnv:
    """The environment under the low level that HRAC's configuration names. Raises `UserError` for one that cannot be
    used."""
    require(env.has_target_states, "agent", "hrac", "this task has no target states that a low level could be sent to")
    about, low_level = low_levels.read(config.low_level, env)
    name = f"low level, content {about['content']}"
    return target_states.SubgoalEnv(env, low_level, env.space, config.interval, config.subgoal_scale, name)
