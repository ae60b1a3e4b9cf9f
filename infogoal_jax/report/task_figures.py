"""The figures that a task brings, besides those of every run: a line here for each task that has some.

A task of your own brings its figures in the same way: `task_figures.registry["my_task"] = draw`.
"""

from collections.abc import Callable, Mapping

from matplotlib.figure import Figure

from infogoal_jax import checks
from infogoal_jax.checked_dict import CheckedDict
from infogoal_jax.envs.fetch.tasks import TASKS as FETCH_TASKS
from infogoal_jax.report.canvas import Subject
from infogoal_jax.report.house_figures import draw_plans
from infogoal_jax.report.image_goals import draw_image_goals
from infogoal_jax.report.shelf_figures import draw_shelves

Draw = Callable[[Subject], Mapping[str, Figure | None]]
"""(subject) -> figures by the name of their file; None, or no entry, for one that there are no numbers for."""


class Drawers(CheckedDict):
    """What draws the figures of each task, by its name."""

    def check(self, name: str, value: Draw) -> None:
        """Raise `UserError` for what is no function of a subject."""
        checks.text(name, "task", "give its name")
        checks.function(value, f"figures of {name}", 1, "give a function of a subject")


registry = Drawers(
    {
        "object_search": draw_plans,
        "object_manipulation": draw_image_goals,
        "embodied_qa": draw_shelves,
        **dict.fromkeys(FETCH_TASKS, draw_image_goals),
    }
)


def draw_of_task(subject: Subject) -> Mapping[str, Figure | None]:
    """The figures that the task of this run brings, by name; none for a task that is not in the registry."""
    draw = registry.get(subject.run.config.task)
    return {} if draw is None else draw(subject)
