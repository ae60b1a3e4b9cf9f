"""The table of `infogoal methods`: what each name stands for, and which tasks it goes together with. Nothing is loaded
and no device is started."""

import inspect

from rich.console import Console
from rich.table import Table

from infogoal_jax import agents, exploration, learners, presets, relabelling
from infogoal_jax.errors import UserError
from infogoal_jax.train.combinations import Refusal, reasons_against, remarks

WIDTH = 200
"""Columns of the table where it does not go to a terminal."""


def parts_in_words(name: str) -> str:
    """What a method is made of: its learner, relabelling and explorer, of which a task's own is not named."""
    method = presets.METHODS[name]
    parts = [f"learner {method.learner}"]
    parts += [f"relabelling {method.relabelling}"] if method.relabelling else []
    parts += [f"explorer {method.explorer}"] if method.explorer != "none" else []
    return ", ".join(parts)


def description(name: str) -> str:
    """What a method is: the first paragraph of the docstring of its file, in one line."""
    method = presets.METHODS[name]
    if method.explorer != "none":
        entry = exploration.registry.entry(method.explorer)
    else:
        entry = (
            relabelling.registry.entry(method.relabelling)
            if method.relabelling
            else learners.registry.entry(method.learner)
        )
    return " ".join((inspect.getmodule(entry.config).__doc__ or "").strip().partition("\n\n")[0].split())


def against(task: str, method: str, **parts: str | None) -> list[Refusal]:
    """What speaks against a method on a task; parts: names of other parts than its own."""
    try:
        return reasons_against(presets.load(task, method, **parts))
    except UserError as error:  # A part's own check refuses the task.
        return [Refusal("method", method, str(error), "give another")]


def agents_of(task: str) -> list[str]:
    """The agents that a task takes, its own first."""
    own = presets.registry[task].agent
    return [own] + [name for name in agents.registry if name != own and not against(task, "none", agent=name)]


def combination_table(tasks: tuple[str, ...]) -> Table:
    """A row for each method, a column for each task with its own agent: a tick, or why not."""
    table = Table(show_lines=True)
    for title in ("method", "made of", "what it is"):
        table.add_column(title, no_wrap=title == "method")
    for task in tasks:
        table.add_column(f"{task}\n{presets.registry[task].agent}", justify="center")
    for name in presets.METHODS:
        found = [against(task, name) for task in tasks]
        table.add_row(
            name,
            parts_in_words(name),
            description(name),
            *("; ".join(refusal.reason for refusal in refused) or "✓" for refused in found),
        )
    return table


def make_console() -> Console:
    """As wide as the terminal, or as `WIDTH` where there is none."""
    console = Console()
    return console if console.is_terminal else Console(width=WIDTH)


def print_methods(tasks: tuple[str, ...] = presets.TASKS) -> None:
    """The table, and what else can be combined."""
    console = make_console()
    console.print(combination_table(tasks))
    for task in tasks:
        console.print(f"{task}: --agent {' | '.join(agents_of(task))}", highlight=False, markup=False)
    console.print(
        f"with any learner: --relabelling {' | '.join(relabelling.registry)}, and on tasks with a tick of its own "
        f"--explorer {' | '.join(exploration.registry)}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


def print_combination(task: str, method: str, **parts: str | None) -> bool:
    """Whether one combination works, in words, and why not. Raises `UserError` for a name that does not exist."""
    config = presets.load(task, method, **parts)
    console, found = make_console(), reasons_against(config)
    named = f"{task} with {', '.join(f'{kind} {name}' for kind, name in presets.names_of(config).items())}"
    lines = [f"{named}: {'does not work' if found else 'works'}"]
    lines += [f"{refusal.field} = {refusal.value!r}: {refusal.reason}: {refusal.remedy}" for refusal in found]
    for line in lines + ([] if found else remarks(config)):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    return not found
