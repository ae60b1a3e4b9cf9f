"""The list of `infogoal methods`: what each name stands for, and which tasks it goes together with. Nothing is loaded
and no device is started."""

import inspect

from rich.console import Console
from rich.table import Table

from infogoal_jax import agents, exploration, learners, presets, relabelling
from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.errors import UserError
from infogoal_jax.loading import Refusal, reasons_against, remarks
from infogoal_jax.runner.progress import say

WIDEST = 100
"""Columns of the list: longer lines are hard to read."""


def parts_in_words(name: str) -> str:
    """What a method is made of: its learner, relabelling and explorer, of which a task's own is not named."""
    method = presets.METHODS[name]
    parts = [f"learner {method.learner}"]
    parts += [f"relabelling {method.relabelling}"] if method.relabelling else []
    parts += [f"explorer {method.explorer}"] if method.explorer != "none" else []
    parts += ["agent of all goals"] if method.all_goals else []
    return ", ".join(parts)


def description(name: str) -> str:
    """What a method is: the first paragraph of the docstring of its file, in one line."""
    method = presets.METHODS[name]
    if method.explorer != "none":
        described = exploration.registry.entry(method.explorer).config
    elif method.relabelling:
        described = relabelling.registry.entry(method.relabelling).config
    elif method.all_goals:
        described = OfAllGoals
    else:
        described = learners.registry.entry(method.learner).config
    return " ".join((inspect.getmodule(described).__doc__ or "").strip().partition("\n\n")[0].split())


def against(task: str, method: str, **parts: str | None) -> list[Refusal]:
    """What speaks against a method on a task; parts: names of other parts than its own."""
    try:
        return reasons_against(presets.load(task, method, **parts))
    except UserError as error:  # A part's own check refuses the task.
        return [Refusal("method", method, str(error), "give another")]


def agents_of(task: str) -> list[str]:
    """The agents that a task takes, under its own relabelling or another, its own first."""

    def is_taken(agent):
        return any(not against(task, "none", agent=agent, relabelling=given) for given in (None, *relabelling.registry))

    own = presets.registry[task].agent
    return [own, *(name for name in agents.registry if name != own and is_taken(name))]


def where(name: str, tasks: tuple[str, ...]) -> dict[str, list[str]]:
    """These tasks, each with its own agent, by why the method does not go together with them; under the empty reason
    those that it does."""
    found: dict[str, list[str]] = {}
    for task in tasks:
        found.setdefault("; ".join(dict.fromkeys(refusal.reason for refusal in against(task, name))), []).append(task)
    return found


def where_in_words(name: str, tasks: tuple[str, ...]) -> list[str]:
    """Which of these tasks a method goes together with, and why not with the others, in lines."""
    reasons = where(name, tasks)
    good = reasons.pop("", [])
    lines = [f"with {'every task' if len(good) == len(tasks) > 1 else ', '.join(good)}"] if good else []
    return lines + [f"not with {', '.join(refused)}: {reason}" for reason, refused in reasons.items()]


def make_console() -> Console:
    """As wide as the terminal, but not wider than `WIDEST`."""
    return Console(width=min(Console().width, WIDEST))


def print_methods(tasks: tuple[str, ...] = presets.TASKS) -> None:
    """A row for each method: its name; what it is, what it is made of, and which tasks it goes together with. And what
    else can be combined."""
    console, table = make_console(), Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True, style="bold")
    for name in presets.METHODS:
        table.add_row(name, "\n".join([description(name), parts_in_words(name), *where_in_words(name, tasks), ""]))
    console.print(table, highlight=False)
    choices = {task: f"--agent {' | '.join(agents_of(task))}" for task in tasks}
    choices["every task"] = f"--relabelling {' | '.join(relabelling.registry)}"
    choices["where listed above"] = f"--explorer {' | '.join(exploration.registry)}"
    flags = Table.grid(padding=(0, 2, 0, 0))
    for name, words in choices.items():
        flags.add_row(name, words)
    console.print(flags, highlight=False, markup=False)


def print_combination(task: str, method: str, **parts: str | None) -> bool:
    """Whether one combination works, in words, and why not. Raises `UserError` for a name that does not exist."""
    config = presets.load(task, method, **parts)
    console, found = make_console(), reasons_against(config)
    named = f"{task} with {', '.join(f'{kind} {name}' for kind, name in presets.names_of(config).items())}"
    named += ", all goals at once" if presets.learns_all_goals(config) else ""
    lines = [f"{named}: {'does not work' if found else 'works'}"]
    lines += [f"{refusal.field} = {refusal.value!r}: {refusal.reason}: {refusal.remedy}" for refusal in found]
    for line in lines + ([] if found else remarks(config)):
        say(console, line)
    return not found
