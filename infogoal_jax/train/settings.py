"""The settings in which training evaluates its policy: clean or corrupted goals, the mean code or a sample."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.threefry import written_out
from infogoal_jax.train.evaluation import EVALUATION_SEED, GoalView, draw_starts, group_means, run_side_by_side, score
from infogoal_jax.train.rollout import trained_policy


def has_image_goals(env) -> bool:
    """Whether goals of this environment are images that can be corrupted."""
    return env.test_backgrounds is not None and not env.goals.by_index


def corrupted_images(
    env, goals: jax.Array, num_starts: int, weight: jax.Array | float, seed: int = EVALUATION_SEED
) -> jax.Array:
    """Images of the goals [M] under test backgrounds, uint8 [M, num_starts, H, W, C]: each start has a background of
    its own."""
    images = jnp.repeat(env.goals.inputs_of(goals)[:, None], num_starts, axis=1)
    backgrounds = draw_backgrounds(
        written_out(jax.random.key(seed + 2)), env.test_backgrounds, (len(goals) * num_starts,)
    )
    return corrupt(images, backgrounds.reshape(images.shape), weight)


def clean_view(parts, params, env, goals: jax.Array) -> GoalView:
    """The codes of goals int32 [M], the same for every start."""
    codes = parts.learner.encode(params["goal"], env.goals.inputs_of(goals))
    return GoalView(goals, jax.tree.map(lambda leaf: leaf[:, None], codes))


def corrupted_view(
    parts, params, env, goals: jax.Array, num_starts: int, weight: jax.Array | float, seed: int = EVALUATION_SEED
) -> GoalView:
    """The codes of goals int32 [M] as `corrupted_images` shows them, which stay the same for the length of an
    episode."""
    images = corrupted_images(env, goals, num_starts, weight, seed)
    codes = parts.learner.encode(params["goal"], images.reshape(-1, *images.shape[2:]))
    return GoalView(goals, jax.tree.map(lambda leaf: leaf.reshape(len(goals), num_starts, *leaf.shape[1:]), codes))


class Setting(NamedTuple):
    """One of the settings in which a policy is evaluated."""

    corrupted: bool
    """Goal images under test backgrounds."""
    mean_code: bool
    """The mean of a goal's code instead of a sample at every step."""

    def metric(self, group: str, score: str) -> str:
        """The name of the metric, such as `corrupted_test_goal_mean_code/success_rate`."""
        prefix, suffix = "corrupted_" if self.corrupted else "", "_mean_code" if self.mean_code else ""
        return f"{prefix}{group}_goal{suffix}/{score}"


def evaluate_settings(
    parts, params, hyper, env, num_starts: int, corruption: float | None = None, seed: int = EVALUATION_SEED
) -> dict[str, jax.Array]:
    """Metrics of the trained policy on every evaluated goal in each `Setting`, from the same starts.

    corruption: weight of the backgrounds, None for the configuration's. seed: of starts, backgrounds and noise.
    `first_reached`: int32 [M, num_starts] of clean goals and sampled codes, episode_length + 1 where a goal was not
    reached; success within t steps is `first_reached <= t`.
    """
    goals = env.goals.evaluated
    views = {False: clean_view(parts, params, env, goals)}
    if has_image_goals(env):
        weight = parts.config.test_corruption if corruption is None else corruption
        views[True] = corrupted_view(parts, params, env, goals, num_starts, weight, seed)
    settings = [Setting(corrupted, mean_code) for mean_code in (False, True) for corrupted in views]
    starts = draw_starts(env, goals, num_starts, seed)

    def shown_in(setting: Setting) -> GoalView:
        view = views[setting.corrupted]
        return view.replace(shown=(view.shown, jnp.full((1, 1), setting.mean_code)))

    def policy(observation, shown, key):
        codes, use_mean = shown
        return trained_policy(parts, params, hyper, env, use_mean)(observation, codes, key)

    key = written_out(jax.random.key(seed + 1))
    shown = [shown_in(setting) for setting in settings]
    scores = score(env, starts, run_side_by_side(env, policy, shown, starts, key))
    metrics = {"first_reached": scores.first_reached(env.episode_length)[0]}
    for group, means in group_means(scores, env.goals).items():
        for name, values in means.items():
            metrics |= {setting.metric(group, name): value for setting, value in zip(settings, values, strict=True)}
    return metrics
