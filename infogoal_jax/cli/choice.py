"""Which configuration a command starts from: the preset of a task and a method, with parts that are chosen by name, or
that of a run to resume. And the command for each task, whose flags are the fields of that configuration: how they are
shown, help from their docstrings, intervals from the declarations of the numbers."""

import dataclasses
import functools
import shlex
import typing
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

import docstring_parser
import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from infogoal_jax.cli.commands import Command, Group, TaskCommands, first_word, named
from infogoal_jax.cli.mistakes import parsed
from infogoal_jax.errors import UserError, nearest, require
from infogoal_jax.files import expanded

if TYPE_CHECKING:
    from infogoal_jax.config import TrainConfig


Name = Union[str, None]  # noqa: UP007 (of `str | None` tyro asks typeguard, whose import is a tenth of a help's time)
"""Of a part; None: not given."""
AUTO = "auto"
"""In place of a run's folder: the newest of the configuration."""


@dataclasses.dataclass(frozen=True)
class Parts:
    """Parts that are chosen by name. None: the task's or the method's own."""

    method: Name = None
    """Method, most of them a row of the paper's Table I."""
    learner: Name = None
    """Goal-representation learner."""
    agent: Name = None
    """Reinforcement-learning agent."""
    relabelling: Name = None
    """Relabelling of goals."""
    explorer: Name = None
    """Explorer."""

    def names(self) -> dict[str, str]:
        """The parts that were asked for, without the method."""
        return {
            name: getattr(self, name)
            for name in ("learner", "agent", "relabelling", "explorer")
            if getattr(self, name) is not None
        }


@dataclasses.dataclass(frozen=True)
class Where:
    """Where programs run: flags that `--help-all` shows."""

    engine: Literal["processes", "ray"] = "processes"
    """processes, which run here; ray, a Ray cluster: one program on each GPU, or on each machine."""
    processes: int = 0
    """How many work side by side; 0: one, or on a cluster as many as it has room for."""
    gpus: int = 0
    """GPUs over which the processes are spread; 0: each sees all devices."""
    ray_address: str = ""
    """The cluster: HOST:PORT of one that this machine belongs to, auto for the one that runs here, ray://HOST:10001
    from outside; empty: one of this machine alone, which ends with the command."""
    distributed: str = ""
    """This process is one of several, each of which trains its own seeds: HOST:PORT of the first one, or auto, where
    Slurm, Open MPI or Kubernetes says it."""
    num_processes: int = 0
    """How many there are; with HOST:PORT."""
    process: int = 0
    """Number of this one, from 0 on; the first writes the run."""
    quiet: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show nothing of what came of it at the end."""


@dataclasses.dataclass(frozen=True)
class Synonyms:
    """Flags of other libraries, which `--help-all` shows."""

    lr: Union[float, None] = None  # noqa: UP007 (as `Name`)
    """The same as --hyper.learning-rate."""
    total_steps: int = 0
    """Environment steps of a seed, rounded to whole evaluations, in place of --num-epochs; 0: as that says."""


@dataclasses.dataclass(frozen=True)
class Choice(Parts):
    """What is read before anything else is: a command's defaults, and so its help, depend on it."""

    resume: Name = None
    """Folder of a run to go on with."""
    small: bool = False
    """The task's preset for first trials."""
    help: Annotated[bool, tyro.conf.arg(aliases=["-h"])] = False
    """Show the help."""
    help_all: bool = False
    """Show the help with all flags."""


ENV = "--env"
"""The flag for an environment of another library, or recordings. Each library is a task, whose flag --env.id says which
one."""


def libraries() -> list[str]:
    """The libraries that --env can name. To know them takes the import of jax, which no help waits for."""
    from infogoal_jax.envs.named import LIBRARIES

    return list(LIBRARIES)


def with_environment(arguments: list[str]) -> list[str]:
    """The words with `--env LIBRARY:NAME` as the task of that library and its flag. Raises `UserError` for another
    library, and where no name follows."""
    rest, given, is_name = [], [], False
    for word in arguments:
        flag, sign, value = word.partition("=")
        follows, is_name = is_name, False
        if follows and not word.startswith("-"):
            given[-1] = word
        elif flag == ENV:
            given.append(value)
            is_name = not sign
        else:
            rest.append(word)
    if not given:
        return arguments
    library, _, name = given[0].partition(":")
    remedy = f"give {' or '.join(f'{known}:NAME' for known in libraries())}"
    if len(given) > 1 or library not in libraries() or not name:
        meant = "" if library in libraries() else nearest(library, libraries())
        raise UserError(f"env = {' '.join(given)!r}: {remedy}.{meant}".rstrip("."))
    if first_word(rest):
        raise UserError(f"env = {given[0]!r}: {first_word(rest)!r} is a task already; leave one of both out")
    is_file = library == "ogbench" and name.endswith(".npz")
    flag = "--env.dataset" if is_file else "--env.id"
    again = [word for word in rest if word.partition("=")[0] == flag]
    require(not again, "env", given[0], f"says what {flag} does, which is given too; leave one of both out")
    return [library, flag, str(expanded(name)) if is_file else name, *rest]


def read_choice(arguments: list[str], prog: str) -> tuple[str, Choice]:
    """The task, which is the first word or left out, and what the flags choose."""
    task = first_word(arguments)
    choice, _ = parsed(Choice, prog, arguments[bool(task) :], return_unknown_args=True, add_help=False)
    return task, choice


def preset_of(task: str, choice: Choice) -> "TrainConfig":
    """The preset of a task with the chosen method and parts. Raises `UserError` for an unknown name."""
    from infogoal_jax import presets

    return presets.load(task, choice.method or "infogoal", small=choice.small, **choice.names())


def check_same_parts(config: "TrainConfig", task: str, choice: Parts) -> None:
    """Raise `UserError` if the configuration of a run to resume is of another task or made of other parts than those
    that are named."""
    from infogoal_jax import presets

    if task not in ("", config.task):
        raise UserError(f"task = {task!r}: the run to resume is of task {config.task!r}")
    if choice.method is not None and not is_of_method(config, choice.method):
        raise UserError(
            f"method = {choice.method!r}: the run to resume is of method {presets.name_of(config)!r}; leave the flag "
            "out"
        )
    for kind, name in choice.names().items():
        if name != presets.names_of(config)[kind]:
            raise UserError(
                f"{kind} = {name!r}: the run to resume has {presets.names_of(config)[kind]!r}; leave the flag out"
            )


def is_of_method(config: "TrainConfig", method: str) -> bool:
    """Whether a configuration is made of the parts that this method names; a relabelling, an explorer or all goals at
    once may have been added to it."""
    from infogoal_jax import presets

    asked = presets.method_named(method)
    names = presets.names_of(config)
    parts = ((asked.learner, names["learner"]), (asked.relabelling, names["relabelling"]))
    learns = presets.learns_all_goals(config) or not asked.all_goals
    return learns and all(name in (None, own) for name, own in parts) and asked.explorer in ("none", names["explorer"])


def parts_of(config: "TrainConfig") -> Parts:
    """The names of a configuration's parts: what help shows as their defaults."""
    from infogoal_jax import presets

    return Parts(presets.name_of(config), **presets.names_of(config))


def known_names() -> dict[str, list[str]]:
    """The names that each field of `Parts` can have, those that were registered later among them."""
    from infogoal_jax import presets

    names = {kind: list(registry) for kind, registry in presets.REGISTRIES.items()}
    return {"method": list(dict.fromkeys([*presets.METHODS, *names["learner"]])), **names}


def all_tasks(command: Command, help: str, arguments: list[str], choice: Choice) -> TaskCommands:
    """The command for every task that has a preset, for the list of them: without configurations, which would need JAX.
    help: stands above it. Raises `UserError` if there are flags, but no task before them."""
    from infogoal_jax import presets

    asked = choice.help or choice.help_all
    if arguments and not asked:
        task = next((word for word in arguments if word in presets.registry), "TASK")
        flags = [word for word in arguments if word != task]
        raise UserError(
            f"task = '': name the task first: {shlex.join(['infogoal', command.__name__, task, *flags])}"
            + (f". Known: {', '.join(presets.registry)}" if task == "TASK" else "")
        )
    commands = {task: named(command, preset.description) for task, preset in presets.registry.items()}
    return TaskCommands(Group(help, commands), ["--help"] if asked else arguments)


def check_left_out(arguments: list[str], flags: tuple[str, ...], kind: str) -> None:
    """Raise `UserError` for one of these flags beside --resume: what they say is settled.

    kind: what goes on, in a word.
    """
    for word in arguments:
        name = word.partition("=")[0].replace("_", "-")
        if name in flags:
            raise UserError(f"{name}: a {kind} that goes on has its own; leave the flag out, or start a new {kind}")


def of_task(command: Command, config: Any, choice: Choice, arguments: list[str], **values: Any) -> TaskCommands:
    """The command for one task, with this configuration, the names of its parts and these values as defaults."""
    from infogoal_jax import presets

    parts = parts_of(config)
    help = presets.registry[config.task].description if config.task in presets.registry else ""
    group = Group("", {config.task: named(command, help, config=config, parts=parts, **values)})
    asked = choice.help or choice.help_all
    return TaskCommands(group, [config.task, "--help"] if asked else arguments, configuration_flags(brief=choice.help))


def configuration_flags(brief: bool) -> ConstructorRegistry:
    """Rules of tyro for a command's configuration, whose task is no flag: it is the name of the subcommand.

    brief: for a help of one screen. The records of the configuration's parts are left out, and of a field's docstring
    all but the first sentence.
    """
    from infogoal_jax.hyperparameters import numbers_of

    registry = ConstructorRegistry()

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        record, default = info.type, info.default
        if not dataclasses.is_dataclass(record) or type(default) is not record:
            return None
        if record in (Where, Synonyms) and brief:
            return StructConstructorSpec(record, ())
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
            helps = {name: first_sentence(words, hints[name]) for name, words in helps.items()}
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
    """What the docstrings of a record's fields say, in one line each; of inherited fields, what its bases say."""
    bases = [base for base in reversed(record.__mro__) if dataclasses.is_dataclass(base)]
    found = [field for base in bases for field in docstring_parser.parse_from_object(base).params]
    return {field.arg_name: " ".join((field.description or "").split()) for field in found}


def first_sentence(words: str, hint: Any) -> str:
    """The first sentence of a field's docstring, up to a semicolon; of a choice, what stands before its list."""
    sentence = words.partition(";")[0].partition(". ")[0].removesuffix(".")
    return (sentence.partition(":")[0] if typing.get_origin(hint) is typing.Literal else sentence) + "."


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
