"""Evaluation: goals from several starts, and how often a policy reaches them.

`evaluate(policy, env, goals, starts)` takes any policy. A policy is given the desired goals of its episodes, or
whatever a `GoalView` shows in their place, such as the codes of corrupted goal images. Last come the settings in which
training evaluates its policy: clean or corrupted goals, the mean code or a sample.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks
from infogoal_jax.envs.environment import has_image_goals
from infogoal_jax.goals import GoalSpace, corrupt, draw_backgrounds
from infogoal_jax.keys import from_seed
from infogoal_jax.shapes import with_rank
from infogoal_jax.train.contracts import (
    check_is_environment,
    check_shown,
    check_simulated,
    check_starts,
    checked_policy,
)
from infogoal_jax.train.episodes import Episodes, run_episodes
from infogoal_jax.train.parts import Setup
from infogoal_jax.train.rollout import Policy, trained_policy

# Of the start states and of the noise in evaluation; the same for every run, so that runs can be compared.
EVALUATION_SEED = 20_240_000


@flax.struct.dataclass
class GoalView:
    """M desired goals, and what the policy is shown in place of each."""

    goals: jax.Array
    """[M, *shape], the desired goals, which decide what counts as success."""
    shown: Any
    """A pytree [M, S, ...], such as a `GoalCode`: what the policy is given in each of the S episodes of a goal. S is 1
    where it is the same for every start."""


@flax.struct.dataclass
class Scores:
    """How S episodes for each of M goals ended."""

    success: jax.Array
    """bool [M, S], whether the goal was reached; where reaching it ends no episode, whether it was at the end."""
    steps: jax.Array
    """int32 [M, S], steps until the end of the episode."""
    first: jax.Array
    """int32 [M, S], steps after which the goal was first reached, 1 more than an episode has where it never was."""
    spl: jax.Array | None
    """float32 [M, S], success * shortest path / max(steps, shortest path) (Anderson et al. 2018); None where shortest
    paths are unknown."""

    def by_name(self) -> dict[str, jax.Array]:
        """The scores [M, S] by the names that metrics have."""
        scores = {"success_rate": self.success, "episode_length": self.steps}
        return scores if self.spl is None else scores | {"spl": self.spl}


def seed_key(seed: int, number: int = 0) -> jax.Array:
    """The key of an evaluation's seed for the purpose of this number: 0 for starts, 1 for noise, 2 for backgrounds."""
    return from_seed(np.uint32((seed + number) % checks.MOST_SEEDS))


def draw_starts(env, goals: jax.Array, num_starts: int, seed: int = EVALUATION_SEED) -> Any:
    """Draw start states for each goal: goals [M, *shape] to states [M, num_starts]."""
    desired_goals = jnp.repeat(goals, num_starts, axis=0)
    states = jax.vmap(env.reset_to)(jax.random.split(seed_key(seed), desired_goals.shape[0]), desired_goals)
    return jax.tree.map(lambda leaf: leaf.reshape(len(goals), num_starts, *leaf.shape[1:]), states)


def evaluate(policy: Policy, env, goals: jax.Array | GoalView, starts: Any = 10, seed: int = EVALUATION_SEED) -> Scores:
    """Run the policy to the end of an episode for each goal and start, all side by side. Compile it with `jax.jit`.

    policy: (observations [E, ...], goals [E, *shape] or what the view shows [E, ...], key) -> actions [E, ...].
    goals: [M, *shape], or a view of them. starts: how many are drawn for each goal, or states [M, S] of `env.reset_to`
    for these goals, in their order. seed: of the starts that are drawn and of the policy's noise, a number that is
    known when it is compiled. Raises `UserError` for goals that the task does not have, for starts that are neither or
    for other goals, for a view of another shape, and for what is no policy.
    """
    check_is_environment(env, "give the policy first, and an environment after it")
    check_simulated(env, "env", type(env).__name__)
    policy = checked_policy(env, policy)
    seed, is_view = checks.seed(seed), isinstance(goals, GoalView)
    desired_goals = env.goals.checked(goals.goals if is_view else goals, "goals", axes=1)
    if hasattr(starts, "desired_goal"):
        check_starts(env, starts, desired_goals)
        states = starts
    else:
        count = checks.whole(
            starts, "starts", 1, checks.MOST_ENVS, "give a whole number from 1 on, or start states [M, S]"
        )
        states = draw_starts(env, desired_goals, count, seed)
    if is_view:
        check_shown(goals.shown, *states.time.shape, "goals")
    episodes = run_side_by_side(env, policy, [goals], states, seed_key(seed, 1))
    return score(env, states, jax.tree.map(lambda leaf: leaf[0], episodes))


def run_side_by_side(
    env, policy: Policy, views: Sequence[jax.Array | GoalView], starts: Any, key: jax.Array
) -> Episodes:
    """Episodes [V, M, S] of the policy for each of V views of the goals, from the same start states [M, S] and with
    the same noise; all in one rollout, so that policy and environment are compiled once. What the views show has one
    structure."""
    shape = starts.time.shape
    starts, blocks = jax.tree.map(flat, starts), (len(views), shape[0] * shape[1])

    def shown_to_all(goals):
        if not isinstance(goals, GoalView):
            return starts.desired_goal
        return jax.tree.map(lambda leaf: flat(jnp.broadcast_to(leaf, (*shape, *leaf.shape[2:]))), goals.shown)

    def act(observation, goal, key):
        by_view = jax.tree.map(lambda leaf: leaf.reshape(*blocks, *leaf.shape[1:]), observation)
        return flat(jax.vmap(policy, in_axes=(0, 0, None))(by_view, shown, key))

    shown = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(shown_to_all(goals) for goals in views))
    together = run_episodes(env, jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(views)), starts), act, key)
    return jax.tree.map(lambda leaf: leaf.reshape(len(views), *shape, *leaf.shape[1:]), together)


def flat(leaf: jax.Array) -> jax.Array:
    """The array [M, S, ...] as [M * S, ...]."""
    return leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])  # Not -1: the array may be empty.


def score(env, starts: Any, episodes: Episodes) -> Scores:
    """The scores of episodes [..., M, S] from these start states [M, S]."""
    if not env.has_shortest_path:
        return Scores(episodes.success, episodes.steps, episodes.first_reached, spl=None)
    shortest = jax.vmap(jax.vmap(env.shortest_path))(starts)
    shortest = with_rank(shortest, episodes.steps.ndim)
    longer = jnp.maximum(jnp.maximum(episodes.steps, shortest), 1)
    spl = (episodes.success.astype(jnp.int32) * shortest).astype(jnp.float32) / longer.astype(jnp.float32)
    return Scores(episodes.success, episodes.steps, episodes.first_reached, spl)


def group_means(scores: Scores, goals: GoalSpace) -> dict[str, dict[str, jax.Array]]:
    """The mean of each score over the goals of each group, {"train", "validation" or "test": {score: [...]}}, of scores
    [..., M, S] of all evaluated goals."""
    masks = goals.in_groups()
    counts = masks.sum(-1, dtype=jnp.int32).astype(jnp.float32)

    def mean_of_groups(value):
        of_goals = value.mean(-1, dtype=jnp.float32)[..., None, :]
        weights = with_rank(masks.astype(jnp.float32), of_goals.ndim)
        sums = (of_goals * weights).sum(-1)
        return sums / with_rank(counts, sums.ndim)

    means = {name: mean_of_groups(value) for name, value in scores.by_name().items()}
    return {group: {name: mean[..., place] for name, mean in means.items()} for place, group in enumerate(goals.groups)}


def near_and_far(env, first_reached: np.ndarray) -> dict[str, np.ndarray]:
    """Success on the test goals that are near a training goal (`Environment.near_goals`) and on the far ones, [...]
    under `near_test_goal/success_rate` and `far_test_goal/success_rate`: the episodes of `test_goal/success_rate`,
    split by goal. Nothing where a task does not tell them apart, and no part without goals.

    first_reached: int [..., M, S] of all evaluated goals, as in `evaluate_settings`.
    """
    if env.near_goals is None:
        return {}
    near, test = (np.asarray(mask)[np.asarray(env.goals.evaluated)] for mask in (env.near_goals, env.goals.test_mask))
    reached = np.asarray(first_reached) <= env.episode_length
    parts = {"near": test & near, "far": test & ~near}
    return {
        f"{name}_test_goal/success_rate": reached[..., part, :].mean((-2, -1))
        for name, part in parts.items()
        if part.any()
    }


def random_policy(env) -> Policy:
    """Uniform over the actions that lead somewhere, or over vectors in [-1, 1]."""

    def act(observation, goal, key):
        if not env.discrete:
            return jax.random.uniform(key, env.action_mask(observation).shape, jnp.float32, -1.0, 1.0)
        mask = env.action_mask(observation)
        return jnp.where(mask, jax.random.uniform(key, mask.shape, jnp.float32), -1.0).argmax(-1).astype(jnp.int32)

    return act


def corrupted_images(
    env, goals: jax.Array, num_starts: int, weight: jax.Array | float, seed: int = EVALUATION_SEED
) -> jax.Array:
    """Images of the goals [M, *shape] under test backgrounds, uint8 [M, num_starts, H, W, C]: each start has a
    background of its own. Validation goals have training backgrounds, so that what is chosen by them has seen none of
    the tests'."""
    images = jnp.repeat(env.goals.inputs_of(goals)[:, None], num_starts, axis=1)

    def drawn(bank):
        return draw_backgrounds(seed_key(seed, 2), bank, (len(goals) * num_starts,)).reshape(images.shape)

    backgrounds = drawn(env.test_backgrounds)
    if env.goals.finite:
        chosen_by = env.goals.validation_mask[goals][:, None, None, None, None]
        backgrounds = jnp.where(chosen_by, drawn(env.train_backgrounds), backgrounds)
    return corrupt(images, backgrounds, weight)


def clean_view(setup: Setup, params: dict, goals: jax.Array) -> GoalView:
    """The codes of goals [M, *shape], the same for every start."""
    codes = setup.parts.learner.encode(params["goal"], setup.env.goals.inputs_of(goals))
    return GoalView(goals, jax.tree.map(lambda leaf: leaf[:, None], codes))


def corrupted_view(
    setup: Setup,
    params: dict,
    goals: jax.Array,
    num_starts: int,
    weight: jax.Array | float,
    seed: int = EVALUATION_SEED,
) -> GoalView:
    """The codes of goals [M, *shape] as `corrupted_images` shows them, which stay the same for the length of an
    episode."""
    images = corrupted_images(setup.env, goals, num_starts, weight, seed)
    codes = setup.parts.learner.encode(params["goal"], images.reshape(-1, *images.shape[2:]))
    return GoalView(goals, jax.tree.map(lambda leaf: leaf.reshape(len(goals), num_starts, *leaf.shape[1:]), codes))


class Setting(NamedTuple):
    """One of the settings in which a policy is evaluated."""

    corrupted: bool
    """Goal images under backgrounds (`corrupted_images`)."""
    mean_code: bool
    """The mean of a goal's code instead of a sample at every step."""

    def metric(self, group: str, score: str) -> str:
        """The name of the metric, such as `corrupted_test_goal_mean_code/success_rate`."""
        prefix, suffix = "corrupted_" if self.corrupted else "", "_mean_code" if self.mean_code else ""
        return f"{prefix}{group}_goal{suffix}/{score}"


def evaluate_settings(
    setup: Setup, params: dict, num_starts: int, corruption: float | None = None, seed: int = EVALUATION_SEED
) -> dict[str, jax.Array]:
    """Metrics of the trained policy on every evaluated goal in each `Setting`, from the same starts.

    corruption: weight of the backgrounds, None for the configuration's. seed: of starts, backgrounds and noise.
    `first_reached`: int32 [M, num_starts] of clean goals and sampled codes, episode_length + 1 where a goal was not
    reached; success within t steps is `first_reached <= t`, at whatever time it was.
    """
    parts, _, env = setup
    goals = env.goals.evaluated
    views = {False: clean_view(setup, params, goals)}
    if has_image_goals(env):
        weight = parts.config.test_corruption if corruption is None else corruption
        views[True] = corrupted_view(setup, params, goals, num_starts, weight, seed)
    settings = [Setting(corrupted, mean_code) for mean_code in (False, True) for corrupted in views]
    starts = draw_starts(env, goals, num_starts, seed)

    def shown_in(setting: Setting) -> GoalView:
        view = views[setting.corrupted]
        return view.replace(shown=(view.shown, jnp.full((1, 1), setting.mean_code)))

    def policy(observation, shown, key):
        codes, use_mean = shown
        return trained_policy(setup, params, use_mean)(observation, codes, key)

    key = seed_key(seed, 1)
    shown = [shown_in(setting) for setting in settings]
    scores = score(env, starts, run_side_by_side(env, policy, shown, starts, key))
    metrics = {"first_reached": scores.first[0]}
    for group, means in group_means(scores, env.goals).items():
        for name, values in means.items():
            metrics |= {setting.metric(group, name): value for setting, value in zip(settings, values, strict=True)}
    return metrics
