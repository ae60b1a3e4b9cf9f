"""The figures that a task brings, besides those of every run.

A task of your own brings its figures by `task_figures.registry["my_task"] = draw`; those of an installed package are
entry points of the group `infogoal.figures`, by the names of the tasks.
"""

from collections.abc import Callable, Mapping

from matplotlib.figure import Figure

from infogoal_jax import checks
from infogoal_jax.checked_dict import CheckedDict
from infogoal_jax.imports import entry_points, load
from infogoal_jax.report.canvas import Subject

GROUP = "infogoal.figures"
Draw = Callable[[Subject], Mapping[str, Figure | None]]
"""(subject) -> figures by the name of their file; None, or no entry, for one that there are no numbers for."""


class Drawers(CheckedDict):
    """What draws the figures of each task, by its name."""

    def check(self, name: str, value: Draw) -> None:
        """Raise `UserError` for what is no function of a subject."""
        checks.text(name, "task", "give its name")
        checks.function(value, f"figures of {name}", 1, "give a function of a subject")


registry = Drawers()


def draw_of_task(subject: Subject) -> Mapping[str, Figure | None]:
    """The figures that the task of this run brings, by name; none for a task that nobody has figures of."""
    task, found = subject.run.config.task, {}
    for draw in [registry[task]] if task in registry else map(load, entry_points(GROUP).select(name=task)):
        found |= draw(subject)
    return found
