"""What plans of a house and of a shelf share: episodes of the trained policy on a graph of images, and the intrinsic
reward of every image."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.learners.learner import GoalEncoding, InputSpec, Visited
from infogoal_jax.report.canvas import Subject, in_words
from infogoal_jax.train.evaluation import EVALUATION_SEED, clean_view, draw_starts, run_side_by_side


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

    @jax.jit
    def episodes(params, env):
        view = clean_view(subject.train.parts, params, env, env.goals.evaluated)
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
        f"({env.goals.region_names[env.goals.regions[walk.goal]]})\n{outcome}"
    )


def reward_of_images(subject: Subject, goal: int) -> np.ndarray:
    """The intrinsic reward of a step that ends in each image, for this goal, in units of its mean size: float [S], NaN
    where no goal is in view.

    The learner divides by a running mean that belongs to training, so that the mean over the images with a goal in view
    takes its place.
    """
    env, learner = subject.train.env, subject.train.parts.learner
    example = InputSpec(
        env.goals.inputs_of(env.goals.training_goals),
        jnp.zeros(subject.run.config.state_encoder.features),
        env.num_cells,
    )
    state = learner.init(jax.random.key(0), example, subject.run.config.hyper.learner)[1]
    encode = GoalEncoding(learner, subject.params["goal"], env.goals, subject.train.config.batch_size).of_any()
    achieved = env.goals_of(jnp.arange(env.num_observations))
    every = jnp.arange(env.num_observations)[None]
    visited = Visited(jnp.asarray([goal]), achieved[None], env.cell_of(every), jnp.ones(every.shape))
    reward = np.asarray(learner.intrinsic_reward(state, encode, visited)[0][0], float)
    reward[~(np.asarray(achieved) >= 0).any(-1)] = np.nan
    return reward / max(np.abs(np.nanmean(reward)), 1e-12)
