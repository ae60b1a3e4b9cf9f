"""Figures 8 to 15 of the paper, each drawn from the compact numbers by a function of its own."""

from collections.abc import Callable

from matplotlib.figure import Figure

from infogoal_jax.reproduce.figures.codes import fig9, fig10, fig11, fig12, fig14
from infogoal_jax.reproduce.figures.curves import fig8, fig13, fig15
from infogoal_jax.reproduce.numbers import Results

FIGURES: dict[str, Callable[[Results], Figure | None]] = {
    "fig8": fig8,
    "fig9": fig9,
    "fig10": fig10,
    "fig11": fig11,
    "fig12": fig12,
    "fig13": fig13,
    "fig14": fig14,
    "fig15": fig15,
}
"""(results) -> the figure, or None where there are no numbers for it."""
