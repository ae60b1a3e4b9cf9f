"""Evaluation inside the program: every goal from several starts, the same starts for every seed and every
evaluation."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp

from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.train.rollout import Episodes, Policy, run_episodes

# Of the start states and of the noise in evaluation; the same for every run, so that runs can be compared.
EVALUATION_SEED = 20_240_000


def goal_starts(env, num_starts: int, seed: int = EVALUATION_SEED):
    """Start states for every evaluated goal: env states [M * num_starts], goal by goal."""
    goals = jnp.repeat(env.goals.evaluated, num_starts)
    return jax.vmap(env.reset_to)(jax.random.split(jax.random.key(seed), goals.shape[0]), goals)


def has_image_goals(env) -> bool:
    """Whether goals of this environment are images that can be corrupted."""
    return env.test_backgrounds is not None


def corrupted_images(env, num_starts: int, weight: jax.Array | float, seed: int = EVALUATION_SEED) -> jax.Array:
    """What is seen of the corrupted goals of the episodes of `goal_starts`, uint8 [M * num_starts, H, W, C]: each has a
    background of the test."""
    images = jnp.repeat(env.goals.inputs_of(env.goals.evaluated), num_starts, axis=0)
    return corrupt(images, draw_backgrounds(jax.random.key(seed + 2), env.test_backgrounds, images.shape[:1]), weight)


def summarise(env, starts, episodes: Episodes, name: str) -> dict[str, jax.Array]:
    """Success rate, episode length and, where a shortest path is known, success weighted by path length, for each group
    of goals of the task.

    name: of the metrics, with `{group}` for train, validation or test. SPL is success * shortest / max(steps, shortest)
    (Anderson et al. 2018).
    """
    scores = {"success_rate": episodes.success, "episode_length": episodes.steps}
    if env.has_shortest_path:
        shortest = jax.vmap(env.shortest_path)(starts)
        scores["spl"] = episodes.success * shortest / jnp.maximum(jnp.maximum(episodes.steps, shortest), 1)
    by_goal = jax.tree.map(lambda leaf: leaf.reshape(len(env.goals.evaluated), -1).mean(1), scores)
    metrics = {}
    for group in env.goals.groups:
        mask = getattr(env.goals, f"{group}_mask")[env.goals.evaluated]
        for score, value in by_goal.items():
            metrics[f"{name.format(group=group)}/{score}"] = (value * mask).sum() / mask.sum()
    return metrics


def run_side_by_side(env, policies: Iterable[Policy], starts, key: jax.Array) -> list[Episodes]:
    """Episodes [E] of each policy from the same E start states, all in one rollout: the environment is compiled and
    stepped once."""
    policies, count = list(policies), starts.goal.shape[0]

    def block_of(tree, block):
        return jax.tree.map(lambda leaf: leaf[block * count : (block + 1) * count], tree)

    def act(observation, goal, key):
        return jnp.concatenate(
            [policy(*block_of((observation, goal), block), key) for block, policy in enumerate(policies)]
        )

    together = run_episodes(env, jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(policies)), starts), act, key)
    return [block_of(together, block) for block in range(len(policies))]


def evaluate(env, policies: dict[str, Policy], num_starts: int, seed: int = EVALUATION_SEED) -> dict[str, jax.Array]:
    """Metrics of each policy, and of the first policy when each goal was first reached. seed: of starts and noise.

    The name of a policy is that of its metrics, with `{group}` for the group of goals, such as `{group}_goal` or
    `corrupted_{group}_goal`. All of them run side by side from the same starts.
    `first_reached`: int32 [M, num_starts] steps, episode_length + 1 where it never was; success within t steps is
    `first_reached <= t`.
    """
    starts = goal_starts(env, num_starts, seed)
    found = run_side_by_side(env, policies.values(), starts, jax.random.key(seed + 1))
    metrics = {}
    for name, episodes in zip(policies, found, strict=True):
        metrics |= summarise(env, starts, episodes, name)
    first = jnp.where(found[0].success, found[0].steps, env.episode_length + 1)
    return metrics | {"first_reached": first.reshape(-1, num_starts)}


def random_policy(env) -> Policy:
    """Uniform over the actions that lead somewhere."""

    def act(observation, goal, key):
        mask = env.action_mask(observation)
        return jnp.where(mask, jax.random.uniform(key, mask.shape), -1.0).argmax(-1).astype(jnp.int32)

    return act


def shortest_path_policy(env) -> Policy:
    """A shortest path to the goal, known only to the simulator."""
    return lambda observation, goal, key: (
        env.distance[env.place[goal][:, None], env.next_node[env.node_of(observation)]].argmin(-1).astype(jnp.int32)
    )
