"""Evaluation inside the program: every goal from several starts, the same starts for every seed and every evaluation."""

import jax
import jax.numpy as jnp

from infogoal_jax.train.rollout import Episodes, Policy, run_episodes

EVALUATION_SEED = 20_240_000  # Of the start states and of the noise in evaluation; the same for every run, so that runs can be compared.


def goal_starts(env, num_starts: int, seed: int = EVALUATION_SEED):
    """Start states for every goal: env states [N * num_starts], goal by goal."""
    goals = jnp.repeat(jnp.arange(env.goals.num_goals), num_starts)
    return jax.vmap(env.reset_to)(jax.random.split(jax.random.key(seed), goals.shape[0]), goals)


def summarise(env, episodes: Episodes, suffix: str = "") -> dict[str, jax.Array]:
    """Success rate, success weighted by path length (SPL) and episode length, for each group of goals that the task has.

    Names are `train_goal{suffix}/success_rate` and so on. SPL is success * shortest / max(steps, shortest) (Anderson et al. 2018).
    """
    by_goal = jax.tree.map(lambda leaf: leaf.reshape(env.goals.num_goals, -1), (episodes.success, episodes.steps, episodes.shortest))
    success, steps, shortest = by_goal
    weighted = success * shortest / jnp.maximum(jnp.maximum(steps, shortest), 1)
    metrics = {}
    for group in env.goals.groups:
        mask = getattr(env.goals, f"{group}_mask")
        for name, value in (("success_rate", success), ("spl", weighted), ("episode_length", steps)):
            metrics[f"{group}_goal{suffix}/{name}"] = (value.mean(1) * mask).sum() / mask.sum()
    return metrics


def evaluate(env, policies: dict[str, Policy], num_starts: int, seed: int = EVALUATION_SEED) -> dict[str, jax.Array]:
    """Metrics of each policy (its name is the suffix), and of the first policy when each goal was first reached. seed: of starts and noise.

    `first_reached`: int32 [N, num_starts] steps, episode_length + 1 where it never was; success within t steps is `first_reached <= t`.
    """
    starts = goal_starts(env, num_starts, seed)
    metrics = {}
    for suffix, policy in policies.items():
        episodes = run_episodes(env, starts, policy, jax.random.key(seed + 1))
        metrics |= summarise(env, episodes, suffix)
        if "first_reached" not in metrics:
            reached = jnp.where(episodes.success, episodes.steps, env.episode_length + 1)
            metrics["first_reached"] = reached.reshape(env.goals.num_goals, num_starts)
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
