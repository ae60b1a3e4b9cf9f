"""A shelf from the front: goal codes beside the trained policy's flights (paper, Fig. 11), and the intrinsic reward of
every place (Fig. 12)."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke

from infogoal_jax.envs.embodied_qa import EmbodiedQA
from infogoal_jax.report.canvas import FAILURE, NOTHING, SUCCESS, Subject, new_figure, room_colour, white_mark
from infogoal_jax.report.codes import code_legend, codes_of, draw_codes, finish_code_axes, principal_components
from infogoal_paper.walks import (
    PATH,
    STEP_COLOURS,
    Walk,
    from_farthest,
    one_goal_a_region,
    outcome_in_words,
    reward_scale,
    rewards_of_images,
    tells_images_apart,
    walks_of_policy,
    write_room,
)

MOST_PANELS, LONGEST_NAME = 8, 72
"""Goals that a figure shows at most, and letters of their names."""


@dataclasses.dataclass(frozen=True)
class Shelf:
    """The places from which a shelf was seen.

    places: float [P, 2], x and y in metres.
    place: int [K] of each image, -1 where unknown.
    side: metres of a typical move.
    """

    places: np.ndarray
    place: np.ndarray
    side: float


def make_shelf(env) -> Shelf | None:
    """The places of an embodied question answering task; None for other tasks, and where positions are unknown."""
    if not isinstance(env, EmbodiedQA):
        return None
    position, next_node = np.asarray(env.position), np.asarray(env.next_node)
    known = np.isfinite(position).all(1)
    if not known.any():
        return None
    length = np.linalg.norm(position[next_node] - position[:, None], axis=-1)
    moved = length[np.isfinite(length) & (length > 1e-3)]
    if not len(moved):
        return None
    places, of_known = np.unique(position[known].round(3), axis=0, return_inverse=True)
    place = np.full(len(position), -1)
    place[known] = of_known.ravel()
    return Shelf(places, place, float(np.median(moved)))


def draw_shelves(subject: Subject) -> dict[str, Figure | None]:
    """The figures of this file by name; none without parameters, for another task, or without positions."""
    shelf = make_shelf(subject.train.env)
    if shelf is None or subject.params is None:
        return {}
    walks = walks_of_policy(subject)
    return {draw.__name__: draw(subject, shelf, walks) for draw in (codes_and_trajectories, intrinsic_reward)}


def squares(shelf: Shelf, places: np.ndarray) -> list[Rectangle]:
    """A square around each of these places."""
    return [Rectangle(corner, shelf.side, shelf.side) for corner in shelf.places[places] - shelf.side / 2]


def outline(shelf: Shelf, places: np.ndarray) -> LineCollection:
    """The border of the squares of these places: their sides, but those between two of them."""
    half, inside = shelf.side / 2, shelf.places[places]
    sides = []
    for across in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        along = half * np.array(across)[::-1]
        beyond = inside + shelf.side * np.array(across)
        alone = ~(np.linalg.norm(beyond[:, None] - inside[None], axis=-1) < half / 2).any(1)
        middle = inside[alone] + half * np.array(across)
        sides += list(np.stack([middle - along, middle + along], axis=1))
    return LineCollection(sides, linewidths=1.8, capstyle="round", zorder=3)


def places_in_view(env, shelf: Shelf, goals) -> np.ndarray:
    """The places with an image in which one of these goals (an index or a mask) is in view, int."""
    seen = np.asarray(env.in_view)[:, goals]
    return np.unique(shelf.place[(seen if seen.ndim == 1 else seen.any(1)) & (shelf.place >= 0)])


def draw_shelf(axes: Axes, env, shelf: Shelf) -> None:
    """The frame of a plan, and the names of the regions where their goals are in view."""
    regions = np.asarray(env.goals.regions)
    for region, name in enumerate(env.goals.region_names):
        seeing = places_in_view(env, shelf, regions == region)
        if len(seeing):
            write_room(axes, shelf.places[seeing], region, name, zorder=5.5)
    low, high = shelf.places.min(0) - 0.75 * shelf.side, shelf.places.max(0) + 0.75 * shelf.side
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_ylabel("y (m)")


def draw_walk(axes: Axes, env, shelf: Shelf, walk: Walk, longest: int | None = None) -> None:
    """One flight under its outcome: start, path and end, and a dot at each step (coloured by time, from 0 to `longest`,
    if that is given)."""
    axes.set_title(outcome_in_words(env, walk, LONGEST_NAME), fontsize=9)
    place = shelf.place[walk.nodes]
    steps = np.flatnonzero(place >= 0)
    if not len(steps):
        return
    way = shelf.places[place[steps]]
    axes.plot(*way.T, color=PATH, linewidth=1.4, zorder=4, path_effects=[withStroke(linewidth=2.6, foreground="white")])
    if longest is not None:
        axes.scatter(*way.T, c=steps, cmap=STEP_COLOURS, norm=Normalize(0, longest), s=16, linewidths=0, zorder=5)
    axes.plot(*way[0], marker="o", markersize=8, markerfacecolor="white", markeredgecolor="black", zorder=6)
    axes.plot(
        *way[-1],
        marker="X",
        markersize=10,
        color=SUCCESS if walk.success else FAILURE,
        markeredgecolor="white",
        zorder=8,
    )


def legend_entries(*more) -> list:
    """Legend of a flight, and more."""
    ends = ((SUCCESS, "goal reached"), (FAILURE, "time is up"))
    cross = {"linestyle": "", "marker": "X", "markersize": 10, "markeredgecolor": "white"}
    return [
        white_mark("o", "start", 8),
        Line2D([], [], color=PATH, label="path"),
        *(Line2D([], [], color=colour, label=label, **cross) for colour, label in ends),
        *more,
    ]


def legend_row(figure: Figure, place, entries: list, columns: int) -> None:
    """A legend in a row of its own: outside of all axes it would lie on the title."""
    axes = figure.add_subplot(place)
    axes.axis("off")
    axes.legend(handles=entries, fontsize=9, loc="center", ncols=columns)


def height_of_panel(shelf: Shelf, width: float) -> float:
    """Inches that a shelf of this width and its title take."""
    extent = np.ptp(shelf.places, axis=0) + 1.5 * shelf.side
    return width * float(np.clip(extent[1] / extent[0], 0.15, 1.2)) + 0.8


def codes_and_trajectories(subject: Subject, shelf: Shelf, walks: dict[int, list[Walk]]) -> Figure | None:
    """Codes of the objects' names and of training and test questions, beside the policy's flights to a test question a
    region (paper, Fig. 11).

    None for a task without test goals.
    """
    env, goals = subject.train.env, subject.train.env.goals
    chosen = [from_farthest(walks[goal]) for goal in one_goal_a_region(env, goals.test_mask)[:MOST_PANELS]]
    if not chosen:
        return None
    shown = (
        f"seed {subject.params_seed}, last parameters; the first test question of each region, from the farthest of "
        f"{subject.run.config.evaluation_starts} evaluation starts; at most {env.episode_length} steps; principal axes "
        "of the means"
    )
    height = height_of_panel(shelf, 6.3)
    figure = new_figure(
        subject, "goal codes, and flights to test questions", (15, max(6.5, 1.7 + height * len(chosen))), shown=shown
    )
    grid = figure.add_gridspec(len(chosen) + 1, 2, height_ratios=[0.7, *[height] * len(chosen)], width_ratios=[1, 1.25])
    legend_row(figure, grid[0, 0], draw_all_codes(subject, figure.add_subplot(grid[1:, 0])), 3)
    legend_row(
        figure,
        grid[0, 1],
        legend_entries(Patch(facecolor="#CCCCCC", edgecolor="#666666", linewidth=1.8, label="the object is in view")),
        5,
    )
    longest = max(len(walk.nodes) - 1 for walk in chosen)
    panels = [figure.add_subplot(grid[1 + row, 1]) for row in range(len(chosen))]
    for axes, walk in zip(panels, chosen, strict=True):
        draw_shelf(axes, env, shelf)
        axes.scatter(*shelf.places.T, s=4, color="#AAAAAA", linewidths=0, zorder=2)
        colour, seeing = room_colour(goals.regions[walk.goal]), places_in_view(env, shelf, walk.goal)
        axes.add_collection(PatchCollection(squares(shelf, seeing), color=colour, alpha=0.25, linewidths=0, zorder=1))
        border = outline(shelf, seeing)
        border.set_color(colour)
        axes.add_collection(border)
        draw_walk(axes, env, shelf, walk, longest)
    panels[-1].set_xlabel("x (m)")
    figure.colorbar(ScalarMappable(Normalize(0, longest), STEP_COLOURS), ax=panels, label="step", shrink=0.6)
    return figure


def draw_all_codes(subject: Subject, axes: Axes) -> list:
    """Codes of the names of all objects, and of the questions of training and test, in the colours of their regions;
    what a legend says of them."""
    goals = subject.train.env.goals
    which = np.flatnonzero(~np.asarray(goals.validation_mask))
    code = codes_of(subject, which)
    centre, directions, shares = principal_components(code.mean)
    draw_codes(axes, code, goals, which, centre, directions, size=0.8)
    groups = tuple(
        group for group in ("train", "test", "other") if group != "other" or len(goals.evaluated) < goals.num_goals
    )
    titles = {"train": "training question", "test": "test question", "other": "name of an object"}
    finish_code_axes(axes, shares)
    return code_legend(goals, groups, code.std is not None, titles)


def intrinsic_reward(subject: Subject, shelf: Shelf, walks: dict[int, list[Walk]]) -> Figure | None:
    """The intrinsic reward (Eq. 16) of every place for each training goal, and a flight of the policy (paper, Fig. 12).

    None for methods without an intrinsic reward that tells images apart.
    """
    env = subject.train.env
    goals = np.asarray(env.goals.training_goals)[:MOST_PANELS].tolist()
    rewards = rewards_of_places(subject, shelf, goals)
    if not tells_images_apart(rewards):
        return None
    shown = (
        f"seed {subject.params_seed}, last parameters; flight from the farthest of "
        f"{subject.run.config.evaluation_starts} evaluation starts; "
        "a place's reward is that of its nearest known goal in view, the mean over its images"
    )
    rows, height = -(-len(goals) // 2), height_of_panel(shelf, 5.0)
    figure = new_figure(subject, "intrinsic reward for training goals", (14, 1.6 + height * rows), shown=shown)
    grid = figure.add_gridspec(rows + 1, 2, height_ratios=[0.3, *[height] * rows])
    in_view = Patch(facecolor="white", edgecolor="black", linewidth=1.8, label="the goal's object is in view")
    legend_row(figure, grid[0, :], legend_entries(in_view, Patch(color=NOTHING, label="no known goal in view")), 6)
    norm, colours = reward_scale(rewards)
    panels = [figure.add_subplot(grid[1 + index // 2, index % 2]) for index in range(len(goals))]
    for axes, goal, reward in zip(panels, goals, rewards, strict=True):
        draw_shelf(axes, env, shelf)
        tiles = PatchCollection(
            squares(shelf, np.arange(len(shelf.places))), cmap=colours, norm=norm, linewidths=0, zorder=1
        )
        tiles.set_array(np.ma.masked_invalid(reward))
        axes.add_collection(tiles)
        border = outline(shelf, places_in_view(env, shelf, goal))
        border.set_color("black")
        axes.add_collection(border)
        draw_walk(axes, env, shelf, from_farthest(walks[goal]))
        axes.set_xlabel("x (m)")
    figure.colorbar(tiles, ax=panels, label="intrinsic reward of a place\n(mean of all images: -1)", shrink=0.6)
    return figure


def rewards_of_places(subject: Subject, shelf: Shelf, goals: Sequence[int]) -> np.ndarray:
    """`rewards_of_images`, the mean over the images of each place in which a known goal is in view: float [R, P], NaN
    where there is none."""
    return np.stack([mean_of_places(reward, shelf) for reward in rewards_of_images(subject, goals)])


def mean_of_places(reward: np.ndarray, shelf: Shelf) -> np.ndarray:
    """The mean of rewards of images [S], NaN where there is none, over those of each place: [P]."""
    counts = np.isfinite(reward) & (shelf.place >= 0)
    total, number = (np.bincount(shelf.place[counts], weights, len(shelf.places)) for weights in (reward[counts], None))
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
