"""A task with continuous goals of a user's own gets a name, a configuration and a preset in one line."""

import dataclasses

from infogoal_jax import checks, envs
from infogoal_jax.agents.dqn import DQNConfig
from infogoal_jax.envs.contract import check_contract
from infogoal_jax.envs.environment import Traits
from infogoal_jax.envs.goal_task import GoalTask, GoalTaskConfig
from infogoal_jax.envs.recordings import recorded_in
from infogoal_jax.errors import require
from infogoal_jax.field_types import LARGEST_WHOLE, checked
from infogoal_jax.presets import plane, registry
from infogoal_jax.presets.loading import check_preset
from infogoal_jax.presets.preset import Preset
from infogoal_jax.registry import Entry

EPOCHS = 40


class Configurations:
    """The configurations of registered tasks as attributes, by the tasks' names: a worker of a cluster that has
    registered the same task finds the class of what it is sent."""


def register(name: str, env: GoalTask, preset: Preset | None = None) -> None:
    """Give a task of one's own a name, by which `load` and every command know it in this process.

    preset: its agent, sizes and floats; None: those of the tasks in the plane, TD3 with HER, or DQN where actions are
    discrete. The fields of `GoalTaskConfig` are its configuration, with the values that `env` has.
    Raises `UserError` for what is no `GoalTask`, for the name of a task that was registered otherwise, and for one that
    breaks the contract of environments or has values out of range.
    """
    checks.text(name, "name", "give the task a name, such as my_maze")
    require(isinstance(env, GoalTask), "env", type(env).__name__, "give a GoalTask; see docs/guides/own_task.md")
    taken = name in envs.registry and not hasattr(Configurations, name)
    require(not taken, "name", name, "is a task already; give yours another name")
    is_preset = preset is None or isinstance(preset, Preset)
    require(is_preset, "preset", preset, "give a presets.Preset, or None")
    values = {
        "episode_length": checks.whole(env.episode_length, "env.episode_length", 1, LARGEST_WHOLE),
        "radius": checks.number(env.radius, "env.radius", remedy="give a distance above 0"),
        "ends_at_goal": checks.flag(env.ends_at_goal, "env.ends_at_goal"),
    }
    types = {field.name: field.type for field in dataclasses.fields(GoalTaskConfig)}
    config = dataclasses.make_dataclass(
        f"{type(env).__name__}Config",
        [(name, types[name], value) for name, value in values.items()],
        bases=(GoalTaskConfig,),
        namespace={"__doc__": GoalTaskConfig.__doc__, "__module__": __name__},
        frozen=True,
    )
    config.__qualname__ = f"{Configurations.__name__}.{name}"
    checked(config(), "env.")
    check_contract(env)

    def make(config: GoalTaskConfig) -> GoalTask:
        return recorded_in(env.replace(**{field: getattr(config, field) for field in values}), config.dataset)

    def traits(config: GoalTaskConfig) -> Traits:
        recorded = bool(config.dataset) or env.recorded is not None
        return Traits(finite_goals=False, moves=env.discrete, recorded=recorded, ends_at_goal=config.ends_at_goal)

    if preset is None:
        words = (own_docstring(type(env)) or "A task of one's own.").split("\n")[0]
        preset = within_episodes(plane.preset(words, EPOCHS), env.episode_length)
        preset = dataclasses.replace(preset, agent="dqn" if env.discrete else "td3")
    check_preset(name, preset)  # Before anything is registered: a task without its preset would stay.
    envs.registry[name] = Entry(config, make, traits=traits)
    setattr(Configurations, name, config)
    registry[name] = preset


def own_docstring(record: type) -> str:
    """What the author of a record said of it: one without a docstring has its signature in its place."""
    said = record.__doc__ or ""
    return "" if said.startswith(f"{record.__name__}(") else said


def within_episodes(preset: Preset, episode_length: int) -> Preset:
    """The preset with windows and returns that span no more steps than an episode has."""
    methods = {
        name: dataclasses.replace(
            changes, learner=changes.learner | {"window": min(changes.learner["window"], episode_length)}
        )
        for name, changes in preset.methods.items()
    }
    agents = {"dqn": {"num_steps": episode_length}} if episode_length < DQNConfig.num_steps else {}
    return dataclasses.replace(preset, methods=methods, agents=preset.agents | agents)
