"""Episodes of a trained policy on a graph of images, and the intrinsic reward of every image: what Figs. 10 to 12 are
drawn of."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, Normalize
from matplotlib.patheffects import withStroke

from infogoal_jax.learners.encoding import GoalEncoding
from infogoal_jax.learners.learner import InputSpec, Visited
from infogoal_jax.report.canvas import NOTHING, Subject, in_words, room_colour
from infogoal_jax.runner.compilation import jit
from infogoal_jax.train.evaluation import EVALUATION_SEED, clean_view, draw_starts, run_side_by_side

PATH, STEP_COLOURS = "#30305C", "cool"
"""Of walks: the line, and the steps from first to last."""


def write_room(axes: Axes, positions: np.ndarray, region: int, name: str, zorder: float) -> None:
    """Write the name of a room in its colour, in the middle of these positions [M, 2]."""
    axes.text(
        *np.median(positions, axis=0),
        name,
        color=room_colour(region),
        fontsize=8,
        weight="bold",
        ha="center",
        va="center",
        zorder=zorder,
        path_effects=[withStroke(linewidth=3, foreground="white")],
    )


def reward_scale(rewards: Sequence[np.ndarray]) -> tuple[Normalize, Colormap]:
    """From the lowest of these intrinsic rewards to 0, and the colours for that; NaN is nothing."""
    lowest = min(np.nanmin(reward) for reward in rewards)
    return Normalize(lowest, 0), colormaps["viridis"].with_extremes(bad=NOTHING)


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
