"""What stands in the registries of tasks, learners, agents, relabellings and explorers."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from infogoal_jax.checked_dict import CheckedDict
from infogoal_jax.errors import UserError, a, require_known, shown
from infogoal_jax.hyperparameters import NoHyperparameters, check_declared

NAME = r"[^\W_][\w.-]*"
"""Of a part: it is a word of the command line and of a run's folder, and none of Python's own, such as `__dict__`."""


class Entry(NamedTuple):
    """A registered part: what its configuration is, how it is made, and what it declares."""

    config: type
    """The class of its configuration."""
    make: Callable[..., Any]
    """Makes the part of a configuration."""
    hyper: type = NoHyperparameters
    """The record of its float hyperparameters."""
    traits: Callable[[Any], Any] | None = None
    """(config) -> what decides which other parts it can be combined with, known before anything is made: `Traits` of a
    task, `AgentTraits` of an agent. None: not declared."""
    of_agent: Mapping[str, Any] = MappingProxyType({})
    """What a learner changes in the configuration of an agent that has such fields."""
    of_relabelling: Mapping[str, Any] | Callable[[Any], Mapping[str, Any]] = MappingProxyType({})
    """What an agent changes in the configuration of a relabelling that has such fields, or a function of the agent's
    configuration that says it."""
    relabelling: str = ""
    """The relabelling of an agent that needs it, where no other is asked for; empty: the method's or the task's."""
    is_method: bool = True
    """Whether a relabelling is a method by its own name."""


class Registry(CheckedDict):
    """The parts of one kind by name. kind: what they are, which is also the field of `TrainConfig` that holds the
    configuration of one."""

    def __init__(self, kind: str, entries: dict[str, Entry]):
        super().__init__()
        self.kind = kind
        for name, entry in entries.items():
            self[name] = entry

    def check(self, name: str, entry: Entry) -> None:
        """Raise `UserError` for what is no `Entry`, and for the configuration of another part: which part is meant
        follows from it. Tasks may share one, as a `TrainConfig` names its task."""
        if not isinstance(name, str) or not re.fullmatch(NAME, name):
            raise UserError(f"{self.kind} = {name!r}: give a name of letters, digits, _, - and ., not _ first")
        if not isinstance(entry, Entry):
            raise UserError(f"{self.kind} = {name!r}: give an Entry(Config, make, ...), not {type(entry).__name__}")
        self.check_entry(name, entry)
        others = [known for known, part in self.items() if part.config is entry.config and known != name]
        if others and self.kind != "task":
            config = entry.config.__name__
            raise UserError(
                f"{self.kind} = {name!r}: {config} is the configuration of {others[0]!r}; derive one of its own from "
                f"it: class My{config}({config})"
            )

    def check_entry(self, name: str, entry: Entry) -> None:
        """Raise `UserError` for an entry with something else in it than declared."""
        field = f"{self.kind} = {name!r}: Entry"
        if not (isinstance(entry.config, type) and dataclasses.is_dataclass(entry.config)):
            raise UserError(f"{field}.config = {shown(entry.config)}: give the class of its configuration, a dataclass")
        if not callable(entry.make):
            raise UserError(f"{field}.make = {shown(entry.make)}: give a function of the configuration")
        if not (isinstance(entry.hyper, type) and dataclasses.is_dataclass(entry.hyper)):
            raise UserError(f"{field}.hyper = {shown(entry.hyper)}: give the class of its floats, a dataclass")
        check_declared(entry.hyper, field)
        if entry.traits is not None and not callable(entry.traits):
            raise UserError(f"{field}.traits = {shown(entry.traits)}: give a function of the configuration, or None")
        for name, fields in (("of_agent", entry.of_agent), ("of_relabelling", entry.of_relabelling)):
            by_config = name == "of_relabelling" and callable(fields)
            if not by_config and not isinstance(fields, Mapping):
                raise UserError(f"{field}.{name} = {shown(fields)}: give fields by name")
        if not isinstance(entry.relabelling, str):
            raise UserError(f"{field}.relabelling = {shown(entry.relabelling)}: give the name of a relabelling")
        if not isinstance(entry.is_method, bool):
            raise UserError(f"{field}.is_method = {shown(entry.is_method)}: give True or False")

    def entry(self, name: str) -> Entry:
        """The part of this name, or a `UserError` with the nearest one."""
        if not isinstance(name, str):
            raise UserError(f"{self.kind} = {name!r}: give the name of {a(self.kind)}. Known: {', '.join(self)}")
        require_known(self.kind, name, self, f"no such {self.kind}")
        return self[name]

    def name_of(self, config: Any) -> str:
        """The name of the part that this configuration belongs to."""
        for name, entry in self.items():
            if type(config) is entry.config:
                return name
        raise UserError(
            f"{self.kind} = {type(config).__name__}: is not the configuration of a registered {self.kind}. Known: "
            f"{', '.join(entry.config.__name__ for entry in self.values())}"
        )

    def entry_of(self, config: Any) -> Entry:
        """The part that this configuration belongs to."""
        return self[self.name_of(config)]
