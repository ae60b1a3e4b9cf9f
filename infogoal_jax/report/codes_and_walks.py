"""What figures of several tasks share (paper, Figs. 9 to 12). Goal codes as points of a plane: means of the Gaussians,
and samples of them, on the principal axes of the means. Episodes of the trained policy on a graph of images, and the
intrinsic reward of every image."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from infogoal_jax.goals import GoalSet
from infogoal_jax.learners.encoding import GoalEncoding
from infogoal_jax.learners.learner import GoalCode, InputSpec, Visited
from infogoal_jax.report.canvas import NOTHING, USE_MARKERS, USE_TITLES, Subject, in_words, new_figure, room_colour
from infogoal_jax.runner.compilation import jit
from infogoal_jax.train.evaluation import EVALUATION_SEED, clean_view, draw_starts, run_side_by_side

CODE_SAMPLES = 60  # Drawn from the Gaussian of each goal.
PATH, STEP_COLOURS = "#30305C", "cool"
"""Of walks: the line, and the steps from first to last."""


def principal_components(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre [d], the first two principal axes [2, d] and their shares of the variance [2] of points [n, d]."""
    centre = points.mean(0)
    _, scales, axes = np.linalg.svd(points - centre, full_matrices=False)
    shares = scales**2 / max((scales**2).sum(), np.finfo(float).tiny)
    return centre, axes[:2], shares[:2]


def finish_code_axes(axes: Axes, shares: np.ndarray) -> None:
    """Label a plane of codes with the axes' shares of the variance."""
    # One unit is as long on both axes: an axis of little variance shall look like one.
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"first principal axis ({shares[0]:.0%} of the variance of the means)")
    axes.set_ylabel(f"second principal axis ({shares[1]:.0%})")


def reward_scale(rewards: Sequence[np.ndarray]) -> tuple[Normalize, Colormap]:
    """From the lowest of these intrinsic rewards to 0, and the colours for that; NaN is nothing."""
    lowest = min(np.nanmin(reward) for reward in rewards)
    return Normalize(lowest, 0), colormaps["viridis"].with_extremes(bad=NOTHING)


def draw_codes(
    axes: Axes,
    code: GoalCode,
    goals: GoalSet,
    which: np.ndarray,
    centre: np.ndarray,
    directions: np.ndarray,
    size: float = 1.0,
    num_samples: int = CODE_SAMPLES,
) -> None:
    """Codes [n, d] of the goals `which` [n], coloured by region: faded samples, means over them. size: of the
    markers; num_samples: of each code."""
    regions = np.asarray(goals.regions)[which]
    if code.std is not None:
        noise = np.random.default_rng(0).normal(size=(num_samples, *code.mean.shape))
        samples = (code.mean + code.std * noise - centre) @ directions.T
        for goal, region in enumerate(regions):
            axes.scatter(
                *samples[:, goal].T, s=5 * size, color=room_colour(region), alpha=0.18, linewidths=0, rasterized=True
            )
    means = (code.mean - centre) @ directions.T
    masks = {group: np.asarray(getattr(goals, f"{group}_mask"))[which] for group in goals.groups}
    masks["other"] = ~np.any(list(masks.values()), axis=0)
    for group, mask in masks.items():
        marker, area = USE_MARKERS[group]
        colours = [room_colour(region) for region in regions[mask]]
        axes.scatter(
            *means[mask].T,
            marker=marker,
            s=area * size,
            c=colours,
            edgecolors="black",
            linewidths=0.8 * size**0.5,
            zorder=3,
        )
    axes.grid()


def code_legend(
    goals: GoalSet, groups: tuple[str, ...], random_code: bool, titles: dict[str, str] | None = None
) -> list[Line2D]:
    """What the marks of `draw_codes` mean. random_code: whether there are samples. titles: of a goal of each group, or
    those of the canvas."""
    titles = titles or {group: title.removesuffix("s") for group, title in USE_TITLES.items()}
    entries = [
        Line2D([], [], linestyle="", marker="s", color=room_colour(index), label=name)
        for index, name in enumerate(goals.region_names)
    ]
    for group in groups:
        marker, area = USE_MARKERS[group]
        outline = {"linestyle": "", "markersize": area**0.5, "markerfacecolor": "white", "markeredgecolor": "black"}
        entries.append(Line2D([], [], marker=marker, label=f"mean, {titles[group]}", **outline))
    if random_code:
        entries.append(Line2D([], [], linestyle="", marker=".", color="#888888", label="samples of a code"))
    return entries


def codes_of(subject: Subject, which: np.ndarray) -> GoalCode:
    """The codes [n, d] of the goals `which` int [n] by the goal encoder of one seed."""
    encode = jit(lambda params, goals: subject.train.parts.learner.encode(params, goals.inputs_of(which)))
    return jax.device_get(encode(subject.params["goal"], subject.train.env.goals))


def representations(subject: Subject) -> Figure | None:
    """Codes of the evaluated goals of one seed on the principal axes of their means, coloured by room or region (paper,
    Fig. 10)."""
    goals = subject.train.env.goals
    which = np.asarray(goals.evaluated)
    if subject.params is None or len(which) < 3:
        return None
    code = codes_of(subject, which)
    centre, directions, shares = principal_components(code.mean)
    figure = new_figure(subject, "goal representations", (9.5, 6), shown=f"seed {subject.params_seed}, last parameters")
    axes = figure.subplots()
    draw_codes(axes, code, goals, which, centre, directions)
    axes.legend(
        handles=code_legend(goals, goals.groups, code.std is not None), loc="center left", bbox_to_anchor=(1.0, 0.5)
    )
    finish_code_axes(axes, shares)
    return figure


@dataclasses.dataclass(frozen=True)
class Walk:
    """One episode of the policy. nodes: int [steps + 1] images that it went through; shortest: steps of a shortest
    path."""

    goal: int
    nodes: np.ndarray
    success: bool
    shortest: int


def walks_of_policy(subject: Subject) -> dict[int, list[Walk]]:
    """The episodes of the last evaluation of one seed: for each evaluated goal, one walk from each start."""
    env, run = subject.train.env, subject.run
    num_starts = run.config.evaluation_starts

    @jit
    def episodes(params, env):
        view = clean_view(subject.train.setup(env=env), params, env.goals.evaluated)
        policy = subject.train.policy(params, run.config.hyper, env)
        starts, key = draw_starts(env, env.goals.evaluated, num_starts), jax.random.key(EVALUATION_SEED + 1)
        found = run_side_by_side(env, policy, [view], starts, key)
        return jax.tree.map(lambda leaf: leaf[0], found), jax.vmap(jax.vmap(env.shortest_path))(starts)

    found, shortest = jax.device_get(episodes(subject.params, env))
    return {
        goal: [
            Walk(
                goal,
                found.observations[row, start, : steps + 1],
                bool(found.success[row, start]),
                int(shortest[row, start]),
            )
            for start, steps in enumerate(found.steps[row])
        ]
        for row, goal in enumerate(np.asarray(env.goals.evaluated).tolist())
    }


def from_farthest(walks: list[Walk]) -> Walk:
    """The walk whose start lies farthest from the goal."""
    return max(walks, key=lambda walk: walk.shortest)


def one_goal_a_region(env, mask) -> list[int]:
    """The first goal of each room or region among those of the mask: a rule that looks at no result."""
    regions, mask = np.asarray(env.goals.regions), np.asarray(mask)
    return [int(np.flatnonzero(mask & (regions == region))[0]) for region in np.unique(regions[mask])]


def outcome_in_words(env, walk: Walk, longest: int = 44) -> str:
    """A title: goal (cut where its name has more than so many letters), its region, and in how many steps it was
    reached."""
    outcome = (
        f"{'reached' if walk.success else 'not reached'} in {len(walk.nodes) - 1} steps, shortest path {walk.shortest}"
    )
    return (
        f"{in_words(env.goals.names[walk.goal], longest)} "
        f"({env.goals.region_names[np.asarray(env.goals.regions)[walk.goal]]})\n{outcome}"
    )


def rewards_of_images(subject: Subject, goals: Sequence[int]) -> np.ndarray:
    """The intrinsic reward of a step that ends in each image, for each of these goals, in units of its mean size: float
    [R, S], NaN where no goal is in view.

    The learner divides by a running mean that belongs to training, so that the mean over the images with a goal in view
    takes its place.
    """
    learner, config = subject.train.parts.learner, subject.train.config

    @jit
    def reward_and_achieved(params, env, goal):
        seen = InputSpec(
            env.goals.inputs_of(env.goals.training_goals), jnp.zeros(config.state_encoder.features), env.num_cells
        )
        state = learner.init(jax.random.key(0), seen, config.hyper.learner)[1]
        encode = GoalEncoding(learner, params["goal"], env.goals, config.batch_size).of_any()
        every = jnp.arange(env.num_observations)
        achieved, alone = env.goals_of(every), every[None]
        taken, first_seen = jnp.ones(alone.shape), jnp.zeros(alone.shape)  # An image alone is no episode.
        visited = Visited(goal[None], achieved[None], env.cell_of(alone), taken, first_seen)
        return learner.intrinsic_reward(state, encode, visited)[0][0], achieved

    rewards = []
    for goal in goals:
        reward, achieved = jax.device_get(reward_and_achieved(subject.params, subject.train.env, np.int32(goal)))
        rewards.append(np.where((achieved >= 0).any(-1), reward.astype(float), np.nan))
    return np.stack([reward / max(np.abs(np.nanmean(reward)), 1e-12) for reward in rewards])


def tells_images_apart(rewards: np.ndarray) -> bool:
    """Whether any of these rewards [R, S] differs from image to image. InfoBot's does not: the visits that it goes by
    are no part of the parameters."""
    return any(np.nanmax(reward) - np.nanmin(reward) > 1e-6 for reward in rewards)
