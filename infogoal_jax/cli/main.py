"""The command `infogoal`: the table of its subcommands, and what becomes of mistakes."""

import functools
import inspect
import itertools
import re
import shutil
import signal
import sys
import textwrap

import tyro

import infogoal_jax
from infogoal_jax.cli import training, tuning
from infogoal_jax.cli.choice import with_environment
from infogoal_jax.cli.commands import Group, check_names, first_word, help_of, mistake_of, type_of
from infogoal_jax.cli.data import DATA
from infogoal_jax.cli.export import export
from infogoal_jax.cli.mistakes import parsed
from infogoal_jax.cli.runs import compare, evaluate, pack, report, video
from infogoal_jax.cli.training import methods, pretrain, train
from infogoal_jax.cli.tuning import final, tune
from infogoal_jax.errors import UserError, require
from infogoal_jax.files import expanded
from infogoal_jax.imports import entry_points, import_installed, load, take_imports
from infogoal_jax.stopping import NOTHING, STATUS, at_words

HELP = """Goal-conditioned reinforcement learning with InfoGoal, in JAX. Begin with
`infogoal train object_search --small`; `infogoal COMMAND --help` shows a command's flags, and `infogoal --version` the
version. With `--import my_task.py` every command knows the tasks and parts that this file registers."""


GROUPS = {
    "to begin with": {
        "train": train,
        "evaluate": evaluate,
        "report": report,
        "compare": compare,
        "video": video,
        "export": export,
    },
    "to choose a method and its settings": {"methods": methods, "tune": tune, "final": final},
    "data, files, low levels": {"data": DATA, "pack": pack, "pretrain": pretrain},
}
"""The library's commands, as the help shows them."""
ADDED = "beside the library"
"""The help's title of commands that other packages bring."""
COMMANDS = Group(HELP, {name: command for group in GROUPS.values() for name, command in group.items()})
CHECKS = {"final": tuning.check_final}
"""What is looked at in all words of a command before it is taken apart."""
BY_TASK = {"train": training.tasks, "tune": tuning.tasks, "pretrain": training.pretraining_tasks}
"""Commands with a subcommand for each task. They are known only after an import that takes long, so it is made where
one of these is called."""


def commands(first: str = "") -> Group:
    """All commands, with those that other packages bring: entry points of the group `infogoal.commands`. They are
    imported unless the first word names one of the library's own."""
    if first in COMMANDS.commands:
        return COMMANDS
    added = {point.name: load(point) for point in entry_points("infogoal.commands")}
    return Group(HELP, COMMANDS.commands | added)


def help_width() -> int:
    """Letters of a line of help."""
    return min(shutil.get_terminal_size().columns, 100)


def wrapped(text: str, indent: str = "") -> str:
    """The paragraphs of a text above the lists of a docstring, in lines of the terminal's width. indent: of all but the
    first line; tyro joins lines that have none."""
    paragraphs = re.split(r"^\s*(?:Args|Returns):", text, maxsplit=1, flags=re.MULTILINE)[0].strip().split("\n\n")
    fill = functools.partial(textwrap.fill, width=help_width(), subsequent_indent=indent)
    return "\n\n".join(fill(" ".join(words.split())) for words in paragraphs)


def overview(group: Group, words: list[str]) -> str:
    """The help of a group: what each of its commands does, and of `infogoal` itself by groups. words: that lead to
    it."""
    known, by_task = group.commands, words[-1] in BY_TASK
    lines = [f"usage: {' '.join(words)} {'TASK' if by_task else 'COMMAND'} ...", "", wrapped(group.help)]
    column = max(map(len, known)) + 4
    column = min(column, 24) if by_task else column
    titles = {"tasks" if by_task else "commands": known}
    if known.keys() >= COMMANDS.commands.keys():
        titles = GROUPS | {ADDED: known.keys() - COMMANDS.commands.keys()}
    for title, names in titles.items():
        lines += ["", f"{title}:"] if names else []
        for name in sorted(names, key=list(known).index):
            said = (help_of(known[name]) or known[name].__doc__ or "").split("\n\n")[0]
            first, *rest = textwrap.wrap(" ".join(said.split()), max(help_width() - column, 20)) or [""]
            if len(name) + 4 > column:
                lines.append(f"  {name}")
                rest = [first, *rest]
            else:
                lines.append(f"  {name:<{column - 2}}{first}".rstrip())
            lines += [" " * column + line for line in rest]
    return "\n".join(lines)


def run(arguments: list[str]) -> int:
    """Run a command. Returns its exit status. Raises `UserError` for a mistake, and `SystemExit` after a help and for
    an unknown flag."""
    if arguments == ["--version"]:
        print(infogoal_jax.__version__)
        return 0
    arguments, registry = arguments or ["--help"], None
    command = commands(arguments[0])
    check_names(command, arguments)
    if arguments[0] not in ("-h", "--help"):
        import_installed()
    words, task = ["infogoal"], ""
    if arguments[0] in CHECKS:
        CHECKS[arguments[0]](arguments)
    if arguments[0] in BY_TASK:
        words.append(arguments[0])
        arguments = with_environment(arguments[1:])
        task = first_word(arguments)
        command, arguments, registry = BY_TASK[words[-1]](arguments)
        check_names(command, arguments, f"{words[-1]} ")
    while isinstance(command, Group) and first_word(arguments) in command.commands:
        word, *arguments = arguments
        words.append(task or word)
        command = command.commands[word]
    if isinstance(command, Group) and arguments[:1] in (["-h"], ["--help"]):
        print(overview(command, words))
        raise SystemExit(0)
    return parsed(
        type_of(command) if isinstance(command, Group) else command,
        " ".join(words),  # All of them, so that what is said about a mistake names this command's help.
        arguments,
        description=wrapped(help_of(command) or inspect.getdoc(command) or "", " "),
        registry=registry,
        config=(tyro.conf.PositionalMetavarFromFieldName,),
    )


def at_home(word: str) -> str:
    """A word of the command line with the folder of the user in place of `~/`, also behind `--flag=`, where a shell
    leaves it."""
    flag, sign, value = word.partition("=") if word.startswith("--") else ("", "", word)
    return flag + sign + (str(expanded(value)) if value.startswith("~/") else value)


def refused_devices() -> str:
    """Why jax starts no device here, with what helps; empty if it does, or was not asked to."""
    if "jax" not in sys.modules:
        return ""
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # The second for a platform whose plugin is not installed.
        asked = jax.config.jax_platforms or ""
        missing = "cuda" in asked or "gpu" in asked
        install = "pip install 'infogoal-jax[cuda]' for NVIDIA's GPUs, or " if missing else ""
        reason = next(iter(str(error).splitlines()), "") or "there are none"
        return f"JAX_PLATFORMS = {asked!r}: jax starts no such device ({reason}); {install}unset it, or set it to cpu"
    return ""


def said_by_simulator(error: BaseException) -> str:
    """What a `UserError` says that a live simulator (`envs/live.py`) raised inside of a compiled program, from which
    its text alone comes; empty for another error."""
    found = re.search(r"^(?:\w+\.)*UserError: (.*)", str(error), re.MULTILINE)
    return found[1] if found else ""


def check_given(arguments: list[str]) -> None:
    """Raise `UserError` for an empty word, as an unset variable of a shell leaves it: it would count as not given, and
    another folder would be written to, or stand-in data learned from."""
    for before, word in itertools.pairwise(["", *arguments]):
        flag, sign, value = word.partition("=") if word.startswith("--") else (before, "=", word)
        field = flag.removeprefix("--").replace("-", "_") if flag.startswith("--") else "arguments"
        require(value or not sign, field, "", "is empty; give a value, or leave it out")


def main(arguments: list[str] | None = None) -> int:
    """Entry point. A `UserError` is printed without a traceback, and so is what the system says of a path that was
    given; the exit status is then 2."""
    arguments = [at_home(word) for word in (sys.argv[1:] if arguments is None else arguments)]
    try:
        check_given(arguments)
        return run(take_imports(arguments))
    except UserError as error:
        print(at_words(f"infogoal: {error}"), file=sys.stderr)
        return 2
    except KeyboardInterrupt as stopped:
        print(f"infogoal: stopped; {stopped or NOTHING}", file=sys.stderr)
        return STATUS
    except BrokenPipeError:  # Nobody reads what is printed any more, as after `| head`.
        return 128 + signal.SIGPIPE
    except (RuntimeError, ValueError, AssertionError) as error:  # The second of a simulator in what `jax.jit` made.
        mistake = refused_devices() or said_by_simulator(error)
        if not mistake:
            raise
        print(at_words(f"infogoal: {mistake}"), file=sys.stderr)
        return 2
    except OSError as error:
        mistake = mistake_of(error, arguments)
        if mistake is None:
            raise
        print(at_words(f"infogoal: {mistake}"), file=sys.stderr)
        return 2
