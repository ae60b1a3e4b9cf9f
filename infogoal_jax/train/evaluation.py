"""Evaluation inside the program: every goal from several starts, the same starts for every seed and every evaluation."""

import jax
import jax.numpy as jnp

from infogoal_jax.train.rollout import Episodes, Policy, run_episodes

EVALUATION_SEED = 20_240_000  # Of the start states and of the noise in evaluation; the same for every run, so that runs can be compared.


def goal_starts(env, num_starts: int, seed: int = EVALUATION_SEED):
    """Start states for every evaluated goal: env states [M * num_starts], goal by goal."""
    goals = jnp.repeat(env.goals.evaluated, num_starts)
    return jax.vmap(env.reset_to)(jax.random.split(jax.random.key(seed), goals.shape[0]), goals)


def summarise(env, starts, episodes: Episodes, name: str) -> dict[str, jax.Array]:
    """Success rate, episode length and, where a shortest path is known, success weighted by path length, for each group of goals of the task.

    name: of the metrics, with `{group}` for train, validation or test. SPL is success * shortest / max(steps, shortest) (Anderson et al. 2018).
    """
    scores = {"success_rate": episodes.success, "episode_length": episodes.steps}
    if hasattr(env, "shortest_path"):
        shortest = jax.vmap(env.shortest_path)(starts)
        scores["spl"] = episodes.success * shortest / jnp.maximum(jnp.maximum(episodes.steps, shortest), 1)
    by_goal = jax.tree.map(lambda leaf: leaf.reshape(len(env.goals.evaluated), -1).mean(1), scores)
    metrics = {}
    for group in env.goals.groups:
        mask = getattr(env.goals, f"{group}_mask")[env.goals.evaluated]
        for score, value in by_goal.items():
            metrics[f"{name.format(group=group)}/{score}"] = (value * mask).sum() / mask.sum()
    return metrics


def evaluate(env, policies: dict[str, Policy], num_starts: int, seed: int = EVALUATION_SEED) -> dict[str, jax.Array]:
    """Metrics of each policy, and of the first policy when each goal was first reached. seed: of starts and noise.

    The name of a policy is that of its metrics, with `{group}` for the group of goals, such as `{group}_goal` or `corrupted_{group}_goal`. All of them
    run side by side, each from the same starts, so that the environment is compiled and stepped once.
    `first_reached`: int32 [M, num_starts] steps, episode_length + 1 where it never was; success within t steps is `first_reached <= t`.
    """
    starts = goal_starts(env, num_starts, seed)
    count, blocks = starts.goal.shape[0], len(policies)

    def act(observation, goal, key):
        parts = (jax.tree.map(lambda leaf: leaf.reshape(blocks, count, *leaf.shape[1:])[block], (observation, goal)) for block in range(blocks))
        return jnp.concatenate([policy(*part, key) for policy, part in zip(policies.values(), parts, strict=True)])

    tiled = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * blocks), starts)
    together = run_episodes(env, tiled, act, jax.random.key(seed + 1))
    metrics = {}
    for block, name in enumerate(policies):
        episodes = jax.tree.map(lambda leaf, block=block: leaf[block * count : (block + 1) * count], together)
        metrics |= summarise(env, starts, episodes, name)
        if not block:
            reached = jnp.where(episodes.success, episodes.steps, env.episode_length + 1)
            metrics["first_reached"] = reached.reshape(-1, num_starts)
    return metrics


def random_policy(env) -> Policy:
    """Uniform over the actions that lead somewhere."""

    def act(observation, goal, key):
        mask = env.action_mask(observation)
        return jnp.where(mask, jax.random.uniform(key, mask.shape), -1.0).argmax(-1).astype(jnp.int32)

    return act


def shortest_path_policy(env) -> Policy:
    """A shortest path to the goal, known only to the simulator."""
    return lambda observation, goal, key: env.distance[goal[:, None], env.next_node[observation]].argmin(-1).astype(jnp.int32)
