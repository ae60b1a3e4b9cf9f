"""How the fields of a configuration are shown as flags: help from their docstrings, intervals from the declarations of
the numbers."""

import dataclasses
import functools
import typing
from typing import Annotated, Any

import docstring_parser
import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from infogoal_jax.cli.choice import Parts, known_names
from infogoal_jax.hyperparameters import numbers_of


def configuration_flags(brief: bool) -> ConstructorRegistry:
    """Rules of tyro for a command's configuration, whose task is no flag: it is the name of the subcommand.

    brief: for a help of one screen. The records of the configuration's parts are left out, and of a field's docstring
    all but the first sentence.
    """
    registry = ConstructorRegistry()

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        record, default = info.type, info.default
        if not dataclasses.is_dataclass(record) or type(default) is not record:
            return None
        hints = typing.get_type_hints(record, include_extras=True)
        of_command = {"task", "hyper"} <= hints.keys()
        if not (of_command or record is Parts or numbers_of(record)):
            return None  # Tyro's own rule does.
        helps = docstrings_of(record)
        if record is Parts:
            helps = {
                name: f"{words.removesuffix('.')}: {', '.join(known_names()[name])}." for name, words in helps.items()
            }
        if of_command and brief:
            helps = {
                name: words.partition(";")[0].partition(". ")[0].removesuffix(".") + "."
                for name, words in helps.items()
            }
        fields = []
        for name in (field.name for field in dataclasses.fields(record)):
            value, number = getattr(default, name), numbers_of(record).get(name)
            if record is Parts:
                hint = Annotated[str, tyro.conf.arg(metavar="NAME")]
            elif number is not None:
                hint = Annotated[
                    float,
                    tyro.conf.arg(
                        help_behavior_hint=lambda shown, number=number: f"(in {number.interval}, default: {shown})"
                    ),
                ]
            elif of_command and name == "task":  # The name of the subcommand, and no flag.
                hint = tyro.conf.Suppress[tyro.conf.Fixed[str]]
            elif of_command and brief and dataclasses.is_dataclass(value):
                continue  # Nothing is made of what a help is of.
            else:
                hint = short(hints[name]) if of_command and brief else hints[name]
            fields.append(StructFieldSpec(name, hint, value, helps.get(name)))
        return StructConstructorSpec(record, tuple(fields))

    return registry


@functools.cache
def docstrings_of(record: type) -> dict[str, str]:
    """What the docstrings of a record's fields say, in one line each."""
    found = docstring_parser.parse_from_object(record).params
    return {field.arg_name: " ".join((field.description or "").split()) for field in found}


def short(hint: Any) -> Any:
    """The type of a field whose flag is to fit the left column: without the kind of its value, which the default
    shows."""
    if hint is bool:
        return tyro.conf.FlagCreatePairsOff[hint]
    if typing.get_origin(hint) is typing.Literal:
        choices = " | ".join(typing.get_args(hint))
        return Annotated[
            hint, tyro.conf.arg(metavar="", help_behavior_hint=lambda shown: f"({choices}, default: {shown})")
        ]
    return Annotated[hint, tyro.conf.arg(metavar="")]
