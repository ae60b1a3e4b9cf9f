"""Tasks whose goals are images: episodes of a trained policy on clean or corrupted goals, figures of the goals (paper,
Fig. 6), and of their codes with the policy's ways under corruption (Fig. 9)."""

from collections.abc import Iterable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from infogoal_jax.envs.environment import has_image_goals
from infogoal_jax.envs.fetch.image_goals import ImageGoals
from infogoal_jax.envs.target_states import SubgoalState
from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.report.canvas import Subject, empty_figure, new_figure
from infogoal_jax.report.codes import code_legend, draw_codes, principal_components
from infogoal_jax.runner.compilation import jit
from infogoal_jax.train.episodes import Episodes
from infogoal_jax.train.evaluation import (
    EVALUATION_SEED,
    corrupted_images,
    corrupted_view,
    draw_starts,
    run_side_by_side,
)
from infogoal_jax.train.rollout import Policy
from infogoal_paper.trajectory_figures import drawing_of, has_poses, poses_on_the_way

WEIGHTS = (0.1, 0.2, 0.4, 0.8)
"""Of the backgrounds, in the paper's figures [P]."""
EXAMPLES, EXAMPLE_SEED = 2, 0
"""Goals of each kind in the figure of examples, and the seed of their backgrounds."""
SHOWN_GOALS = 4
"""Test goals whose trajectories are drawn [P]."""


@flax.struct.dataclass
class Watched:
    """A simulated environment whose observation is the robot's whole state, so that a rollout keeps it."""

    env: Any

    def __getattr__(self, name: str) -> Any:
        """All but the observation is the environment's own."""
        return getattr(self.env, name)

    def observe(self, state):
        """The robot's state, `FetchState`."""
        return (state.inner if isinstance(state, SubgoalState) else state).robot

    def policy(self, policy: Policy) -> Policy:
        """The policy on these observations."""
        return lambda robot, goal, key: policy(robot.observation, goal, key)


def is_fetch(env: Any) -> bool:
    """Whether a robot can be drawn."""
    return isinstance(env.unwrapped, ImageGoals)


def seen_images(env: Any, goals: np.ndarray, weight: float, seed: int) -> np.ndarray:
    """The corrupted images uint8 [M, H, W, 3] of these goals [M] that the policy of `policy_episodes` looks at."""
    corrupted = jit(corrupted_images, static_argnames=("num_starts", "seed"))
    return np.asarray(corrupted(env, goals.astype(np.int32), num_starts=1, weight=weight, seed=seed))[:, 0]


def policy_episodes(subject: Subject, which: np.ndarray, weights: Sequence[float], seed: int) -> list[Episodes]:
    """For each weight of the backgrounds (0: clean images) an episode to each of the goals `which` [E], all in one
    rollout.

    Their observations are states of the robot [E, T + 1], or the observations of a task that is a walk among frames.
    Starts, noise and backgrounds follow from the seed and are the same for every weight.
    """

    @jit
    def run(params, env):
        goals, policy = jnp.asarray(which, jnp.int32), subject.train.policy(params, subject.run.config.hyper, env)
        views = [corrupted_view(subject.train.setup(env=env), params, goals, 1, weight, seed) for weight in weights]
        starts, key = draw_starts(env, goals, 1, seed), jax.random.key(seed + 1)
        watched = Watched(env) if is_fetch(env) else env
        acting = watched.policy(policy) if is_fetch(env) else policy
        found = run_side_by_side(watched, acting, views, starts, key)
        return [jax.tree.map(lambda leaf, view=view: leaf[view, :, 0], found) for view in range(len(views))]

    return jax.device_get(run(subject.params, subject.train.env))


def test_goal_episodes(subject: Subject) -> tuple[np.ndarray, list[Episodes]]:
    """Numbers of the test goals that are shown, and for each of `WEIGHTS` an episode to each."""
    env = subject.train.env
    chosen = spread_goals(env.goals, env.goals.test_mask, SHOWN_GOALS, drawing_of(env).apart(env))
    return chosen, policy_episodes(subject, chosen, WEIGHTS, EVALUATION_SEED)


def draw_image_goals(subject: Subject) -> dict[str, Figure | None]:
    """The figures of this file by name; none for a task with other goals. Those of the policy need parameters and test
    goals."""
    env = subject.train.env
    if not has_image_goals(env):
        return {}
    figures = {"goal_images": goal_images(env, subject.run.config.task)}
    if subject.params is None or "test" not in env.goals.groups:
        return figures
    chosen, episodes = test_goal_episodes(subject)
    figures["codes_and_trajectories"] = codes_and_trajectories(subject, chosen, episodes)
    if has_poses(env):
        seen = {weight: seen_images(env, chosen, weight, EVALUATION_SEED) for weight in WEIGHTS}
        figures["poses_on_the_way"] = poses_on_the_way(subject, chosen, seen, episodes)
    return figures


def goal_images(env: Any, task: str) -> Figure:
    """Goal images clean and corrupted, a row a goal (paper, Fig. 6): training goals while training and in the test,
    then test goals.

    task: for the title.
    """
    goals, rows = env.goals, []
    columns = {"clean": 0.0, **{f"weight {weight:g}": weight for weight in WEIGHTS}, "background": 1.0}

    @jit
    def examples(goals, chosen, backgrounds, number):
        key = jax.random.fold_in(jax.random.key(EXAMPLE_SEED), number)
        images, behind = goals.inputs_of(chosen), draw_backgrounds(key, backgrounds, chosen.shape)
        return jnp.stack([corrupt(images, behind, weight) for weight in columns.values()], 1)

    for title, mask, backgrounds in (
        ("training goal,\ntraining background", goals.train_mask, env.train_backgrounds),
        ("training goal,\ntest background", goals.train_mask, env.test_backgrounds),
        ("test goal,\ntest background", goals.test_mask, env.test_backgrounds),
    ):
        chosen = np.flatnonzero(np.asarray(mask))[:EXAMPLES]
        rows += [(title, images) for images in np.asarray(examples(goals, chosen, backgrounds, len(rows)))]
    title = f"{task.replace('_', ' ')}: goal images and the weight of their background"
    below = (f"the first goals of each kind; backgrounds drawn from seed {EXAMPLE_SEED}", f"data: {env.source}")
    figure = empty_figure(title, below, (9.6, 1.56 * len(rows) + 0.9))
    for (title, images), line in zip(rows, figure.subplots(len(rows), len(columns), squeeze=False), strict=True):
        line[0].set_ylabel(title, fontsize=8)
        for axes, name, image in zip(line, columns, images, strict=True):
            axes.imshow(image)
            axes.set_xticks([])
            axes.set_yticks([])
            if axes.get_subplotspec().is_first_row():
                axes.set_title(name, fontsize=10)
    return figure


def spread_goals(goals: Any, mask: np.ndarray, count: int, apart: np.ndarray) -> np.ndarray:
    """The first goal of the mask in each of `count` regions, int [C]: a rule that looks at no result. apart: [R, R]
    distances of training goals.

    The first region, then again and again the one whose training goal lies farthest from those of all that were taken.
    """
    regions, which = np.asarray(goals.regions), np.flatnonzero(np.asarray(mask))
    left = np.unique(regions[which])
    taken = [left[0]]
    while len(taken) < min(count, len(left)):
        taken.append(left[apart[left][:, taken].min(1).argmax()])
    return np.array([which[regions[which] == region][0] for region in taken])


def codes_and_trajectories(subject: Subject, chosen: np.ndarray, episodes: list[Episodes]) -> Figure:
    """Codes of corrupted goals, and beneath them the policy's way to the corrupted test goals `chosen`, a column a
    weight (paper, Fig. 9)."""
    env, goals = subject.train.env, subject.train.env.goals
    below = drawing_of(env)
    shown = (
        f"seed {subject.params_seed}, last parameters; test backgrounds; principal axes of the clean goals' means; "
        f"{below.shown}; "
        f"at most {env.episode_length} steps"
    )
    figure = new_figure(
        subject, "codes of corrupted goals, and paths to corrupted test goals", (14.5, 7.4), shown=shown
    )
    panels = figure.subplots(2, len(WEIGHTS))
    groups = tuple(group for group in ("train", "test") if group in goals.groups)
    which = np.flatnonzero(np.any([np.asarray(getattr(goals, f"{group}_mask")) for group in groups], axis=0))
    encode = jit(subject.train.parts.learner.encode)
    clean, *codes = (
        jax.device_get(encode(subject.params["goal"], seen_images(env, which, weight, EVALUATION_SEED)))
        for weight in (0.0, *WEIGHTS)
    )
    centre, directions, _ = principal_components(clean.mean)
    for (code_axes, way_axes), weight, code, found in zip(panels.T, WEIGHTS, codes, episodes, strict=True):
        code_axes.set_title(f"background of weight {weight:g}", fontsize=10)
        draw_codes(code_axes, code, goals, which, centre, directions, size=0.55)
        code_axes.set_xlabel("first principal axis")
        below.draw(way_axes, env, chosen, found)
    share_limits(panels[0])
    panels[0, 0].set_ylabel("second principal axis")
    panels[1, 0].set_ylabel(below.vertical_label)
    random_code = any(code.std is not None for code in codes)
    legends = code_legend(goals, groups, random_code), below.legend(env, chosen)
    for axes, entries in zip(panels[:, -1], legends, strict=True):
        axes.legend(handles=entries, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def share_limits(panels: Iterable[Axes]) -> None:
    """Give panels that are to be compared the same limits, those of all that is drawn in them, with one unit as long on
    both axes."""
    limits = np.array([[axes.get_xlim(), axes.get_ylim()] for axes in panels])
    low, high = limits[..., 0].min(0), limits[..., 1].max(0)
    middle, half = (low + high) / 2, (high - low).max() / 2
    low, high = middle - half, middle + half
    for axes in panels:
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set_aspect("equal", adjustable="box")
