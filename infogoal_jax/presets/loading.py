"""Methods, and the configuration of a task and a method: what the presets say, put together with the parts' own
defaults. And the way back: the flags of the command line that give a configuration.

A method is a row of the paper's Table I: a combination of a learner, a relabelling and an explorer under one name; or
one whose agent learns from all goals at once.
"""

import dataclasses
import functools
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from infogoal_jax import agents, envs, exploration, learners, relabelling
from infogoal_jax.agents import all_goals
from infogoal_jax.config import Hyperparameters, StateEncoderConfig, TrainConfig
from infogoal_jax.envs import named
from infogoal_jax.errors import UserError, nearest, require, require_known, shown
from infogoal_jax.field_types import checked
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.presets import registry
from infogoal_jax.presets.libraries import of_library
from infogoal_jax.presets.preset import Preset

REGISTRIES = {
    "learner": learners.registry,
    "agent": agents.registry,
    "relabelling": relabelling.registry,
    "explorer": exploration.registry,
}
"""The parts of a configuration, by the field that holds them."""


class Method(NamedTuple):
    """The names of a learner, a relabelling (None: the task's own) and an explorer; and whether the agent learns from
    all goals at once."""

    learner: str
    relabelling: str | None = None
    explorer: str = "none"
    all_goals: bool = False


ALL_GOALS = "all_goals"
"""The method, and behind another one's name and a plus what is added to it: the agent learns from all goals at once."""
METHODS = (
    {name: Method(name) for name in learners.registry}
    | {name: Method("none", name) for name, entry in relabelling.registry.items() if name != "none" and entry.is_method}
    | {name: Method("none", None, name) for name in exploration.registry if name != "none"}
    | {ALL_GOALS: Method("none", all_goals=True)}
)
"""What can be asked for by one name. Learners, relabellings and explorers can be combined by their own names too."""


def method_named(name: str) -> Method:
    """The method of this name, such as `infogoal`, `infogoal+her` or `infogoal+all_goals`, or a `UserError` with the
    nearest one."""
    require(isinstance(name, str), "method", name, f"give the name of a method. Known: {', '.join(METHODS)}")
    first, *added = name.split("+")
    known = METHODS | {learner: Method(learner) for learner in learners.registry}  # One may be registered later.
    require_known("method", first, known, "no such method")
    method = known[first]
    for word in added:
        require_known("method", word, (ALL_GOALS, *relabelling.registry), "nothing that can be added to a method")
        method = method._replace(**({"all_goals": True} if word == ALL_GOALS else {"relabelling": word}))
    return method


def preset_of(task: str) -> Preset:
    """The preset of a task, or a `UserError`."""
    known = ", ".join(registry)  # Tasks that can be trained, as the help lists them.
    require(isinstance(task, str), "task", task, f"give the name of a task. Known: {known}")
    take_library(task)
    if task not in envs.registry:
        own = "one of your own is registered first: --import FILE, or presets.register"
        require_known("task", task, registry, "no such task", f"{own}; another library's: --env LIBRARY:NAME")
    envs.registry.entry(task)
    require(
        task in registry,
        "task",
        task,
        f"there is no preset for it yet; the environment alone is envs.load({task!r}). Known: {', '.join(registry)}",
    )
    preset = registry[task]
    for each in filter(None, (preset, preset.small)):
        check_names(each, task)
    return preset


def check_preset(task: str, preset: Preset) -> None:
    """Raise `UserError` for what is no preset, and for one with other types in it than declared."""
    require(isinstance(task, str) and bool(task), "task", task, "give a name")
    require(isinstance(preset, Preset), f"preset of {task}", preset, "register a presets.Preset")
    checked(preset, f"preset of {task}: ")
    for name, changes in preset.methods.items():
        checked(changes, f"preset of {task}: methods[{name!r}].")
    if preset.small is not None:
        require(isinstance(preset.small, Preset), f"preset of {task}: small", preset.small, "give a presets.Preset")
        check_preset(f"{task}, small", preset.small)


def check_names(preset: Preset, task: str) -> None:
    """Raise `UserError` for a name in a preset that nothing has: what stands there would be lost."""
    for place, names, known in names_in(preset, task):
        for name in names:
            if name not in known:  # The nearest is looked for then alone: that takes as long as all else here.
                remedy = f"no such method, part or field {place}.{nearest(name, known)}"
                raise UserError(f"preset of {task} = {shown(name)}: {remedy}")


def names_in(preset: Preset, task: str) -> Iterator[tuple[str, Iterable[str], list[str]]]:
    """The names in a preset: where they stand, themselves, and those that are known there."""
    methods = [*METHODS, *learners.registry]
    own = {kind: {name: fields_in(entry.config) for name, entry in parts.items()} for kind, parts in REGISTRIES.items()}
    floats = fields_in(Hyperparameters) + [
        f"{kind}.{field}"
        for kind in ("learner", "agent")
        for entry in REGISTRIES[kind].values()
        for field in fields_in(entry.hyper)
    ]
    yield "in env", preset.env, fields_in(envs.registry.entry(task).config)
    yield "in state_encoder", preset.state_encoder, fields_in(StateEncoderConfig)
    yield "in learner", preset.learner, [field for fields in own["learner"].values() for field in fields]
    for kind, parts in (("agent", preset.agents), ("relabelling", preset.relabellings)):
        yield f"in {kind}s", parts, [*own[kind]]
        for name, fields in parts.items():
            yield f"in {kind}s[{name!r}]", fields, own[kind].get(name, [])
    for name, changes in {"": preset, **preset.methods}.items():
        place = f"in methods[{name!r}]" if name else "in it"
        yield place, changes.all_goals, fields_in(all_goals.OfAllGoals)
        yield place, changes.training, fields_in(TrainConfig)
        yield place, changes.hyper, floats
        if name:
            first, plus, second = name.partition("+")
            yield "in methods", [first], methods
            yield "in methods", [second] if plus else [], [*relabelling.registry, ALL_GOALS]
            named = METHODS.get(first, Method(first))
            yield place, changes.learner, own["learner"].get(named.learner, [])


@functools.cache
def fields_in(record: type) -> list[str]:
    """The names of a record's fields."""
    return [field.name for field in dataclasses.fields(record)]


def part(registered, asked: Any, fields: dict[str, Any]) -> Any:
    """The configuration of a part: the one that was given, or that of the part of this name with these fields."""
    return registered.entry(asked).config(**fields) if isinstance(asked, str) else asked


def load(
    task: str,
    method: str = "infogoal",
    *,
    learner: Any = None,
    agent: Any = None,
    relabelling: Any = None,
    explorer: Any = None,
    small: bool = False,
    **changes: Any,
) -> TrainConfig:
    """The configuration for a task and a method. Raises `UserError` for an unknown name.

    method: its name, `infogoal`; with another relabelling `infogoal+her`; with an agent that learns from all goals at
        once `infogoal+all_goals`.
    learner, agent, relabelling, explorer: another part than the method's and the task's own, by its name or as its
    configuration.
    small: the task's preset for first trials.
    changes: fields of `TrainConfig`.
    """
    preset, named = preset_of(task), method_named(method)
    preset = small_one(preset, task, small) if small is not False else preset
    for name in changes.keys() - {field.name for field in dataclasses.fields(TrainConfig)}:
        known = dataclasses.asdict(load(task, method, learner=learner, agent=agent))
        raise UserError(f"{name} = {shown(changes[name])}: no such field of TrainConfig.{whereabouts(name, known)}")
    asked = {
        "learner": named.learner if learner is None else learner,
        "agent": preset.agent if agent is None else agent,
        "relabelling": relabelling,
        "explorer": named.explorer if explorer is None else explorer,
    }
    learns_all = named.all_goals or means_all_goals(name_in("learner", asked["learner"]))
    if relabelling is None:
        agent_name = name_in("agent", asked["agent"])
        asked["relabelling"] = named.relabelling or own_relabelling(task, agent_name, learns_all)
    require(
        relabelling != ALL_GOALS,
        "relabelling",
        ALL_GOALS,
        f"is a way in which the agent values goals: give --method {method}+{ALL_GOALS}",
    )
    names = {kind: name_in(kind, value) for kind, value in asked.items()}
    changed = preset.changes_of(method_of(task, names, named.all_goals))
    of_learner, of_agent = preset.changes_of(names["learner"]).learner, {}
    if learns_all:
        check_learns_all_goals(names["agent"])
        of_agent = all_goals.CHANGES | preset.all_goals | changed.all_goals
    of_agent |= REGISTRIES["learner"].entry(names["learner"]).of_agent
    fields = {
        "learner": fields_of("learner", names, preset.learner) | of_learner,
        "agent": preset.agents.get(names["agent"], {}) | fields_of("agent", names, of_agent),
        "explorer": {},
    }
    parts = {kind: part(REGISTRIES[kind], asked[kind], own) for kind, own in fields.items()}
    of_relabelling = REGISTRIES["agent"].entry(names["agent"]).of_relabelling
    if callable(of_relabelling):
        of_relabelling = of_relabelling(parts["agent"])
    own = preset.relabellings.get(names["relabelling"], {}) | fields_of("relabelling", names, of_relabelling)
    parts["relabelling"] = part(REGISTRIES["relabelling"], asked["relabelling"], own)
    remedy = f"method {method} learns from all goals at once: give True, or the agent by its name"
    require(not named.all_goals or parts["agent"].all_goals, "agent.all_goals", False, remedy)
    hyper = default_hyperparameters(parts["learner"], parts["agent"])
    floats = {name: value for name, value in (preset.hyper | changed.hyper).items() if belongs(name, hyper)}
    env = envs.registry.entry(task).config(**preset.env)
    settings = {
        "task": task,
        "env": env,
        **parts,
        "state_encoder": StateEncoderConfig(**preset.state_encoder),
        "hyper": with_values(hyper, floats),
        **preset.training,
        **changed.training,
    }
    return TrainConfig(**(settings | changes))


def small_one(preset: Preset, task: str, small: Any) -> Preset:
    """The preset of a task's first trials, or a `UserError`."""
    require(isinstance(small, bool), "small", small, "give True or False")
    known = ", ".join(name for name, each in registry.items() if each.small)
    require(preset.small is not None, "small", small, f"{task} has no small preset; give fewer epochs. Known: {known}")
    return preset.small


def name_in(kind: str, asked: Any) -> str:
    """The name of a part that was asked for by its name or as its configuration."""
    return asked if isinstance(asked, str) else REGISTRIES[kind].name_of(asked)


def take_library(task: str) -> None:
    """Register the task of another library's environments (`envs/named.py`) where it is asked for: lists of tasks do
    not have it before."""
    if task in named.LIBRARIES and task not in envs.registry:
        envs.registry[task] = named.LIBRARIES[task]
        registry[task] = of_library(task)


def own_relabelling(task: str, agent: str, learns_all: bool) -> str:
    """The relabelling that an agent has on a task where no other is asked for: its own, that of learning from all goals
    at once, or the task's."""
    own = registry[task].relabelling if task in registry else "none"
    return REGISTRIES["agent"].entry(agent).relabelling or (all_goals.RELABELLING if learns_all else own)


def means_all_goals(learner: str) -> bool:
    """Whether the agent learns from all goals at once over this learner without being asked to."""
    return REGISTRIES["learner"].entry(learner).of_agent.get("all_goals", False)


def check_learns_all_goals(agent: str) -> None:
    """Raise `UserError` for an agent that cannot learn from all goals at once."""
    known = agents.registry.items()
    fitting = ", ".join(name for name, entry in known if issubclass(entry.config, all_goals.OfAllGoals))
    remedy = f"values one goal at a time: give one of {fitting}, or another method"
    require(issubclass(agents.registry.entry(agent).config, all_goals.OfAllGoals), "agent", agent, remedy)


def whereabouts(name: str, fields: dict[str, Any]) -> str:
    """Which of these nested fields is meant by a name that is none of the outer ones, as a sentence."""
    parts = [(("config", part), inner) for part, inner in fields.items()]
    for path, inner in parts:  # It grows: parts of parts come after.
        if isinstance(inner, dict):
            if name in inner:
                return f" It is one of {'.'.join(path)}: change it there by dataclasses.replace"
            parts += [((*path, part), value) for part, value in inner.items()]
    return nearest(name, list(fields))


def fields_of(kind: str, names: dict[str, str], wanted: dict[str, Any]) -> dict[str, Any]:
    """Those of the wanted fields that the part of this kind has."""
    config = REGISTRIES[kind].entry(names[kind]).config
    return {name: value for name, value in wanted.items() if name in config.__dataclass_fields__}


def default_hyperparameters(learner: Any, agent: Any) -> Hyperparameters:
    """The defaults of the float hyperparameters, with those of the parts of these configurations."""
    return Hyperparameters(
        learner=learners.registry.entry_of(learner).hyper(), agent=agents.registry.entry_of(agent).hyper()
    )


def belongs(name: str, hyper: Hyperparameters) -> bool:
    """Whether a float of a preset is one of these: a preset may hold one of the task's own agent, where another agent
    was asked for."""
    kind, _, field = name.partition(".")
    return not field or hasattr(getattr(hyper, kind), field)


def method_of(task: str, names: dict[str, str], asks_all: bool) -> str:
    """The name of the method that parts of these names make on a task; of a combination without one, `infobot+her`
    where the preset has changes for it, else that of its learner. asks_all: whether the agent is asked to learn from
    all goals at once."""
    preset, combined = preset_of(task), f"{names['learner']}+{ALL_GOALS if asks_all else names['relabelling']}"
    if combined in preset.methods:
        return combined
    learns_all = asks_all or means_all_goals(names["learner"])
    own = names["relabelling"] == own_relabelling(task, names["agent"], learns_all)
    parts = Method(names["learner"], None if own else names["relabelling"], names["explorer"], asks_all)
    return next((name for name, known in METHODS.items() if known == parts), names["learner"])


def names_of(config: TrainConfig) -> dict[str, str]:
    """The name of each part of a configuration."""
    return {kind: registered.name_of(getattr(config, kind)) for kind, registered in REGISTRIES.items()}


def name_of(config: TrainConfig) -> str:
    """The name of the method that a configuration is made of; a combination without one is named by its parts."""
    require(isinstance(config, TrainConfig), "config", config, "give a TrainConfig, such as load makes")
    names = names_of(config)
    name, own = names["relabelling"], own_relabelling(config.task, names["agent"], learns_all_goals(config))
    relabelled = "none" if name == own else "unrelabelled" if name == "none" else name
    parts = names["learner"], ALL_GOALS if asks_all_goals(config) else "none", relabelled, names["explorer"]
    return "+".join(name for name in parts if name != "none") or "none"


def learns_all_goals(config: TrainConfig) -> bool:
    """Whether the agent of a configuration learns from all goals at once."""
    return getattr(config.agent, "all_goals", False)


def asks_all_goals(config: TrainConfig) -> bool:
    """Whether it does so though its learner does not mean it."""
    return learns_all_goals(config) and not means_all_goals(names_of(config)["learner"])


def method_title(config: TrainConfig) -> str:
    """The method for people: `none with her`. A relabelling that every method has on the task is no part of a method's
    name, and is said here."""
    name, names = name_of(config), names_of(config)
    own = own_relabelling(config.task, names["agent"], learns_all=False)
    said = f" with {own}" if own == names["relabelling"] != "none" and own != name else ""
    return f"{name}{said}"


def run_title(config: TrainConfig) -> str:
    """Task and method for people: `point_maze, none with her`."""
    return f"{config.task}, {method_title(config)}"


def words_of(value: Any) -> list[str]:
    """A value as the words that follow its flag."""
    return (
        [str(item) for item in value]
        if isinstance(value, tuple)
        else [repr(value) if isinstance(value, float) else str(value)]
    )


def changed_flags(config: Any, default: Any, prefix: str = "") -> list[str]:
    """The flags that make one configuration record of another."""
    flags = []
    for field in dataclasses.fields(config):
        value, before, name = (
            getattr(config, field.name),
            getattr(default, field.name),
            f"{prefix}{field.name.replace('_', '-')}",
        )
        if dataclasses.is_dataclass(value):
            flags += changed_flags(value, before, f"{name}.")
        elif value != before and isinstance(value, bool):
            flags.append(f"--{name}" if value else f"--{prefix}no-{name.removeprefix(prefix)}")
        elif value != before:
            flags += [f"--{name}", *words_of(value)]
    return flags


def train_flags(config: TrainConfig) -> list[str]:
    """What follows `infogoal train TASK` for this configuration: the inverse of `load`."""
    names, name = names_of(config), name_of(config)
    method = name if name in METHODS else names["learner"] + f"+{ALL_GOALS}" * asks_all_goals(config)
    default, flags = names_of(load(config.task, method)), ["--method", method]
    for kind, own in names.items():
        flags += [f"--{kind}", own] if own != default[kind] else []
    return flags + changed_flags(config, load(config.task, method, **names))
