"""Plan views of a search task: trajectories of the trained policy (paper, Fig. 10) and the intrinsic reward over the
house (Fig. 12).

Rooms have no outlines in the data: what is drawn are the places where images were taken and the moves between them.
"""

import dataclasses

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from infogoal_jax.data.active_vision import ACTIONS
from infogoal_jax.envs.object_search import ObjectSearch
from infogoal_jax.report.canvas import FAILURE, NOTHING, SUCCESS, Subject, new_figure, white_mark
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

ROTATIONS = [ACTIONS.index("rotate_ccw"), ACTIONS.index("rotate_cw")]
SIGHT = "#F0E442"


@dataclasses.dataclass(frozen=True)
class Plan:
    """A house from above.

    position: [S, 3] x and y in metres and heading in radians.
    known: bool [S], where they are.
    place: int [S], shared by images of one spot.
    part: int [S], shared by images that moves lead between.
    moves: int [M, 2] from image to image.
    spacing: metres of a typical move.
    """

    position: np.ndarray
    known: np.ndarray
    place: np.ndarray
    part: np.ndarray
    moves: np.ndarray
    spacing: float


def linked(next_node: np.ndarray) -> np.ndarray:
    """Which images can be walked between by these actions, int [S] numbers of the groups: next_node [S, A]."""
    number = len(next_node)
    source = np.repeat(np.arange(number), next_node.shape[1])
    return connected_components(
        coo_array((np.ones(len(source)), (source, next_node.ravel())), shape=(number, number)), directed=False
    )[1]


def make_plan(env) -> Plan | None:
    """The plan of a search task; None for other tasks, and where no position is known."""
    if not isinstance(env, ObjectSearch):
        return None
    position = np.asarray(env.position)
    known = np.isfinite(position).all(1)
    if not known.any():
        return None
    next_node = np.asarray(env.next_node)
    moves = np.stack([np.repeat(np.arange(len(next_node)), len(ACTIONS)), next_node.ravel()], 1)
    moves = moves[known[moves].all(1) & (moves[:, 0] < moves[:, 1])]
    length = np.linalg.norm(position[moves[:, 0], :2] - position[moves[:, 1], :2], axis=1)
    if not (length > 1e-3).any():
        return None
    return Plan(
        position,
        known,
        linked(next_node[:, ROTATIONS]),
        linked(next_node),
        moves,
        float(np.median(length[length > 1e-3])),
    )


def draw_plan(axes: Axes, env, plan: Plan, part: int) -> None:
    """Places as dots, moves as lines and rooms by name, for one part of the house."""
    shown = plan.known & (plan.part == part)
    moves = plan.moves[shown[plan.moves[:, 0]]]
    axes.add_collection(LineCollection(plan.position[moves, :2], colors=NOTHING, linewidths=0.7, zorder=0))
    axes.scatter(*plan.position[shown, :2].T, s=3, color="#BBBBBB", zorder=1)
    in_view, regions = np.asarray(env.in_view), np.asarray(env.goals.regions)
    for region, name in enumerate(env.goals.region_names):
        seeing = shown & in_view[:, regions == region].any(1)
        if seeing.any():
            write_room(axes, plan.position[seeing, :2], region, name, zorder=7)
    low, high = plan.position[shown, :2].min(0) - plan.spacing, plan.position[shown, :2].max(0) + plan.spacing
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")


def draw_arrows(
    axes: Axes, plan: Plan, nodes: np.ndarray, length: float, colour_by: np.ndarray | None = None, **style
) -> None:
    """An arrow in the direction of view at each of these images, whose positions are known; length in typical moves."""
    x, y, heading = plan.position[nodes].T
    reach = length * plan.spacing
    style = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": 1,
        "width": 0.005,
        "headwidth": 4,
        "headlength": 4,
        "headaxislength": 3.6,
    } | style
    axes.quiver(
        x, y, reach * np.cos(heading), reach * np.sin(heading), *(() if colour_by is None else (colour_by,)), **style
    )


def panels(
    subject: Subject, plan: Plan, title: str, count: int, shown: str, entries: list
) -> tuple[Figure, list[Axes]]:
    """A figure with a plan for each of `count` goals, two in a row, under a legend of these entries."""
    rows, extent = -(-count // 2), np.ptp(plan.position[plan.known, :2], axis=0) + 2 * plan.spacing
    height = 4.2 * float(np.clip(extent[1] / extent[0], 0.4, 1.6)) + 0.8
    figure = new_figure(subject, title, (11, 1.4 + height * rows), shown=shown)
    grid = figure.add_gridspec(rows + 1, 2, height_ratios=[0.3, *[height] * rows])
    # A row of its own: a legend outside of all axes would lie on the title.
    legend_axes = figure.add_subplot(grid[0, :])
    legend_axes.axis("off")
    legend_axes.legend(handles=entries, fontsize=9, loc="center", ncols=len(entries))
    return figure, [figure.add_subplot(grid[1 + index // 2, index % 2]) for index in range(count)]


def legend_entries(*more) -> list:
    """Legend of a walk, and more."""
    arrows = ((SUCCESS, "goal reached"), (FAILURE, "time is up"))
    return [
        white_mark("o", "start", 9),
        Line2D([], [], color=PATH, label="path"),
        *(
            Line2D([], [], linestyle="", marker=r"$\rightarrow$", markersize=13, color=colour, label=label)
            for colour, label in arrows
        ),
        *more,
    ]


def draw_walk(axes: Axes, env, plan: Plan, walk: Walk, longest: int | None = None) -> None:
    """One walk under its outcome: path, an arrow at each step (coloured by time, from 0 to `longest`, if that is
    given), and the pose at its end."""
    axes.set_title(outcome_in_words(env, walk), fontsize=9)
    steps = np.flatnonzero(plan.known[walk.nodes])
    if not len(steps):
        return
    nodes = walk.nodes[steps]
    axes.plot(
        *plan.position[nodes, :2].T,
        color=PATH,
        linewidth=1.4,
        zorder=4,
        path_effects=[withStroke(linewidth=2.6, foreground="white")],
    )
    axes.plot(
        *plan.position[nodes[0], :2],
        marker="o",
        markersize=9,
        markerfacecolor="white",
        markeredgecolor="black",
        zorder=5,
    )
    if longest is not None:
        draw_arrows(
            axes, plan, nodes[:-1], 0.5, colour_by=steps[:-1], cmap=STEP_COLOURS, norm=Normalize(0, longest), zorder=6
        )
    draw_arrows(axes, plan, nodes[-1:], 0.95, color=SUCCESS if walk.success else FAILURE, width=0.011, zorder=8)


def view_slices(plan: Plan, images: np.ndarray) -> np.ndarray:
    """The corners [images, corners, (x, y)] of a slice in the direction of view for each of these images, whose
    positions are known: those of one place make a pie."""
    position, heading = plan.position[images, None, :2], plan.position[images, 2:]
    views = np.bincount(plan.place[plan.known])[plan.place[images], None]
    angles = heading + np.linspace(-np.pi, np.pi, 25) / views
    rim = position + 0.46 * plan.spacing * np.stack([np.cos(angles), np.sin(angles)], -1)
    return np.concatenate([position, rim], 1)


def draw_plans(subject: Subject) -> dict[str, Figure | None]:
    """The figures of this file by name; none without parameters, for a task that is no search, or without positions."""
    plan = make_plan(subject.train.env)
    if plan is None or subject.params is None:
        return {}
    walks = walks_of_policy(subject)
    return {draw.__name__: draw(subject, plan, walks) for draw in (trajectories, intrinsic_reward)}


def trajectories(subject: Subject, plan: Plan, walks: dict[int, list[Walk]]) -> Figure | None:
    """The trained policy on one test goal a room, from the farthest start (paper, Fig. 10). None for a task without
    test goals."""
    env = subject.train.env
    goals = one_goal_a_region(env, env.goals.test_mask)
    if not goals:
        return None
    chosen = [from_farthest(walks[goal]) for goal in goals]
    shown = (
        f"seed {subject.params_seed}, last parameters; the first test goal of each room, from the farthest of "
        f"{len(walks[goals[0]])} "
        f"evaluation starts; at most {env.episode_length} steps"
    )
    longest = max(len(walk.nodes) for walk in chosen)
    entries = legend_entries(Patch(color=SIGHT, label="view of the goal"))
    figure, grid = panels(subject, plan, "trajectories to test goals", len(chosen), shown, entries)
    for axes, walk in zip(grid, chosen, strict=True):
        part = plan.part[walk.nodes[0]]
        draw_plan(axes, env, plan, part)
        seeing = np.asarray(env.in_view)[:, walk.goal] & plan.known & (plan.part == part)
        axes.add_collection(
            PolyCollection(view_slices(plan, np.flatnonzero(seeing)), color=SIGHT, linewidths=0, zorder=2)
        )
        draw_walk(axes, env, plan, walk, longest)
        for spine in axes.spines.values():
            spine.set(color=SUCCESS if walk.success else FAILURE, linewidth=2.5)
    figure.colorbar(
        ScalarMappable(Normalize(0, longest), STEP_COLOURS),
        ax=grid,
        label="step (an arrow shows the direction of view)",
        shrink=0.6,
    )
    return figure


def intrinsic_reward(subject: Subject, plan: Plan, walks: dict[int, list[Walk]]) -> Figure | None:
    """The intrinsic reward (Eq. 16) of every image for one training goal a room, and a trajectory of the policy (paper,
    Fig. 12).

    None for methods without an intrinsic reward that tells images apart.
    """
    env = subject.train.env
    goals = one_goal_a_region(env, env.goals.train_mask)
    rewards = rewards_of_images(subject, goals)
    if not tells_images_apart(rewards):
        return None
    shown = (
        f"seed {subject.params_seed}, last parameters; the first training goal of each room, trajectory from the "
        "farthest of "
        f"{len(walks[goals[0]])} evaluation starts; each slice is a view"
    )
    entries = legend_entries(Patch(color=NOTHING, label="no goal in view"))
    figure, grid = panels(subject, plan, "intrinsic reward for training goals", len(goals), shown, entries)
    norm, colours = reward_scale(rewards)
    for axes, goal, reward in zip(grid, goals, rewards, strict=True):
        walk = from_farthest(walks[goal])
        part = plan.part[walk.nodes[0]]
        draw_plan(axes, env, plan, part)
        images = np.flatnonzero(plan.known & (plan.part == part))
        pies = PolyCollection(view_slices(plan, images), cmap=colours, norm=norm, linewidths=0, zorder=1)
        pies.set_array(np.ma.masked_invalid(reward[images]))
        axes.add_collection(pies)
        draw_walk(axes, env, plan, walk)
    figure.colorbar(pies, ax=grid, label="intrinsic reward of a view (mean -1)", shrink=0.6)
    return figure
