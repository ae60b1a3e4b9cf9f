"""Methods, and the configuration of a task and a method: what the presets say, put together with the parts' own
defaults. And the way back: the flags of the command line that give a configuration.

A method is a row of the paper's Table I: a combination of a learner, a relabelling and an explorer under one name.
"""

import dataclasses
import functools
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from infogoal_jax import agents, envs, exploration, learners, relabelling
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
    """The names of a learner, a relabelling (None: the task's own) and an explorer."""

    learner: str
    relabelling: str | None = None
    explorer: str = "none"


METHODS = (
    {name: Method(name) for name, entry in learners.registry.items() if not entry.method}
    | {
        name: Method("none", name)
        for name, entry in relabelling.registry.items()
        if name != "none" and not entry.method
    }
    | {name: Method("none", None, name) for name in exploration.registry if name != "none"}
    | {"leo": Method("index", "all_goals")}
)
"""What can be asked for by one name. Learners, relabellings and explorers can be combined by their own names too."""


def method_named(name: str) -> Method:
    """The method of this name, or a `UserError` with the nearest one."""
    require(isinstance(name, str), "method", name, f"give the name of a method. Known: {', '.join(METHODS)}")
    if name in learners.registry:
        whole = learners.registry[name].method
        remedy = f"is a learner alone; give {whole}, or --learner {name} with another relabelling"
        require(not whole, "method", name, remedy)
        return Method(name)  # One that was registered after this module was imported, too.
    require_known("method", name, METHODS, "no such method")
    return METHODS[name]


def preset_of(task: str) -> Preset:
    """The preset of a task, or a `UserError`."""
    known = ", ".join(registry)  # Tasks that can be trained, as the help lists them.
    require(isinstance(task, str), "task", task, f"give the name of a task. Known: {known}")
    take_library(task)
    if task not in envs.registry:
        own = "one of your own is registered first: --import FILE, or presets.register"
        require_known("task", task, registry, "no such task", own)
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
        yield place, changes.training, fields_in(TrainConfig)
        yield place, changes.hyper, floats
        if name:
            first, plus, second = name.partition("+")
            yield "in methods", [first], methods
            yield "in methods", [second] if plus else [], [*relabelling.registry]
            named = METHODS.get(first, Method(first))
            yield place, changes.learner, own["learner"].get(named.learner, [])
            relabelled = second or named.relabelling or preset.relabelling
            yield place, changes.relabelling, own["relabelling"].get(relabelled, [])


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
    if relabelling is None:
        asked["relabelling"] = named.relabelling or own_relabelling(task, name_in("agent", asked["agent"]))
    names = {kind: name_in(kind, value) for kind, value in asked.items()}
    changed, of_learner = preset.changes_of(method_of(task, names)), preset.changes_of(names["learner"]).learner
    of_agent = {}
    for kind in ("relabelling", "learner"):
        of_agent |= REGISTRIES[kind].entry(names[kind]).of_agent
    fields = {
        "learner": fields_of("learner", names, preset.learner) | of_learner,
        "agent": preset.agents.get(names["agent"], {}) | fields_of("agent", names, of_agent),
        "relabelling": preset.relabellings.get(names["relabelling"], {})
        | changed.relabelling
        | fields_of("relabelling", names, REGISTRIES["agent"].entry(names["agent"]).of_relabelling),
        "explorer": {},
    }
    parts = {kind: part(REGISTRIES[kind], value, fields[kind]) for kind, value in asked.items()}
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


def own_relabelling(task: str, agent: str) -> str:
    """The relabelling that an agent has on a task where no other is asked for: its own, or the task's."""
    own = registry[task].relabelling if task in registry else "none"
    return REGISTRIES["agent"].entry(agent).relabelling or own


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


def method_of(task: str, names: dict[str, str]) -> str:
    """The name of the method that parts of these names make on a task; of a combination without one, `infobot+her`
    where the preset has changes for it, else that of its learner."""
    preset, combined = preset_of(task), f"{names['learner']}+{names['relabelling']}"
    if combined in preset.methods:
        return combined
    own = names["relabelling"] == own_relabelling(task, names["agent"])
    parts = Method(names["learner"], None if own else names["relabelling"], names["explorer"])
    return next((name for name, known in METHODS.items() if known == parts), names["learner"])


def names_of(config: TrainConfig) -> dict[str, str]:
    """The name of each part of a configuration."""
    return {kind: registered.name_of(getattr(config, kind)) for kind, registered in REGISTRIES.items()}


def name_of(config: TrainConfig) -> str:
    """The name of the method that a configuration is made of; a combination without one is named by its parts."""
    require(isinstance(config, TrainConfig), "config", config, "give a TrainConfig, such as load makes")
    names = names_of(config)
    own = own_relabelling(config.task, names["agent"])
    whole = learners.registry[names["learner"]].method
    if whole and Method(names["learner"], names["relabelling"], names["explorer"]) == METHODS.get(whole):
        return whole
    name = names["relabelling"]
    relabelled = "none" if name == own else "unrelabelled" if name == "none" else name
    return "+".join(name for name in (names["learner"], relabelled, names["explorer"]) if name != "none") or "none"


def method_title(config: TrainConfig) -> str:
    """The method for people: `none with her`. A relabelling that every method has on the task is no part of a method's
    name, and is said here."""
    name, names = name_of(config), names_of(config)
    own = own_relabelling(config.task, names["agent"])
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
    alone = learners.registry[names["learner"]].method or names["learner"]
    method = name if name in METHODS else alone
    default, flags = names_of(load(config.task, method)), ["--method", method]
    for kind, own in names.items():
        flags += [f"--{kind}", own] if own != default[kind] else []
    return flags + changed_flags(config, load(config.task, method, **names))
