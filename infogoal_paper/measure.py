"""What is measured of a run when its training has ended: how much of the goal encoder's gradient its method's own loss
makes, what claims say of its codes, and what its pictures are drawn from."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from scipy import stats

from infogoal_jax.config import TrainConfig
from infogoal_jax.envs.environment import data_of, has_image_goals
from infogoal_jax.goal_uses import TEST, TRAINING, USES
from infogoal_jax.goals import GoalSet
from infogoal_jax.learners.learner import has_own_loss, has_reward
from infogoal_jax.report.canvas import Subject
from infogoal_jax.report.runs import Run as RunInFolder
from infogoal_jax.runner.compilation import jit
from infogoal_jax.train.evaluation import EVALUATION_SEED
from infogoal_jax.train.experience import make_experience
from infogoal_jax.train.parts import Setup
from infogoal_jax.train.program import Train
from infogoal_jax.train.update import sample, update
from infogoal_paper.image_goal_figures import WEIGHTS, is_fetch, seen_images, test_goal_episodes
from infogoal_paper.trajectory_figures import angles_to_goals
from infogoal_paper.walks import Walk, from_farthest, one_goal_a_region, rewards_of_images, walks_of_policy

BATCHES = 8
"""Over which the share of the gradient is a mean."""
STEP = 1e4
"""Of the parameters along the gradient that is to be measured: so long that float32 keeps the difference."""


def learner_share(train: Train) -> Any:
    """The program (state, number, hyper, env) -> share in [0, 1] of the learner's weighted loss in the gradient of the
    goal encoder: its norm beside the sum of its own and the agent's. None for a learner without a loss.

    An update with plain gradient steps is made with and without the learner's loss: parameters show the gradients.
    """
    if not has_own_loss(train.parts.learner):
        return None
    parts = train.parts._replace(optimizer=optax.identity())

    def share(state, number, hyper, env):
        setup = Setup(parts, hyper, env)
        experience, state = make_experience(setup, state, number)
        plain = state.replace(optimizer_state=parts.optimizer.init(state.params))

        def of_batch(key):
            sample_key, update_key = jax.random.split(key)
            drawn = sample(setup, experience, sample_key)

            def step(weight):
                asked = hyper.replace(learner_weight=weight, learning_rate=STEP, max_gradient_norm=1e30)
                after, _ = update(setup._replace(hyper=asked), experience, plain, drawn, update_key)
                moved = jax.tree.map(lambda old, new: (old - new) / STEP, plain.params["goal"], after.params["goal"])
                return ravel_pytree(moved)[0]

            both, agent = jax.vmap(step)(jnp.stack([hyper.learner_weight, jnp.zeros_like(hyper.learner_weight)]))
            own, others = jnp.linalg.norm(both - agent), jnp.linalg.norm(agent)
            return own / jnp.maximum(own + others, 1e-20)

        return jax.lax.map(of_batch, jax.random.split(jax.random.key(EVALUATION_SEED), BATCHES)).mean()

    return share


def on(train: Train, config: TrainConfig, env: Any) -> Train:
    """The training of a batch, as that of one of its runs."""
    return dataclasses.replace(train, env=env, config=config)


def subject_of(train: Train, params: Any, seed: int) -> Subject:
    """One seed of a run, as the figures of a run take it."""
    run = RunInFolder(train.config, [seed], data_of(train.env), {}, device="", folder=Path(), name="")
    return Subject(run, train, None, None, {}, params, seed)


def pictures(subject: Subject) -> dict[str, np.ndarray]:
    """Arrays of codes, ways and intrinsic rewards, by name; see `codes_of`, `ways_of_images` and `ways_on_graph`."""
    env = subject.train.env
    found = codes_of(subject.train, jax.tree.map(lambda leaf: leaf[None], subject.params["goal"]))
    found = {name: value[0] if name in ("code_mean", "code_std") else value for name, value in found.items()}
    found |= ways_of_images(subject) if has_image_goals(env) else ways_on_graph(subject)
    return {f"picture/{name}": value for name, value in found.items()}


def shown_goals(env: Any) -> np.ndarray:
    """The goals whose codes are shown: all but validation goals, of more than 1000 training and test goals alone."""
    goals = env.goals
    few = goals.num_goals <= 1000
    return np.flatnonzero(~np.asarray(goals.validation_mask) if few else np.asarray(goals.train_mask | goals.test_mask))


def codes_of(train: Train, params: Any) -> dict[str, np.ndarray]:
    """Codes of the shown goals [M] by the goal encoders of seeds [seeds, ...], clean and under each weight of the
    backgrounds. code_mean, code_std (of a random code): float16 [seeds, 1 + weights, M, d]; code_region int [M];
    code_use int [M]: 0 training, 1 validation, 2 test, 3 other."""
    env, which = train.env, shown_goals(train.env)
    encode = jit(jax.vmap(train.parts.learner.encode, in_axes=(0, None)))
    if has_image_goals(env):
        images = [seen_images(env, which, weight, EVALUATION_SEED) for weight in (0.0, *WEIGHTS)]
    else:
        images = [env.goals.inputs_of(which)]
    encoded = [jax.device_get(encode(params, image)) for image in images]
    found = {
        "code_mean": np.stack([code.mean for code in encoded], 1).astype(np.float16),
        "code_region": np.asarray(env.goals.regions)[which].astype(np.int16),
        "code_use": uses_of(env.goals, which),
    }
    if encoded[0].std is not None:
        found["code_std"] = np.stack([code.std for code in encoded], 1).astype(np.float16)
    return found


def uses_of(goals: GoalSet, which: np.ndarray) -> np.ndarray:
    """What these goals [M] are used for, int8 [M], as in `goal_uses`; 3 for none of it."""
    masks = (np.asarray(getattr(goals, f"{use}_mask"))[which] for use in USES)
    return np.select(list(masks), list(range(len(USES))), len(USES)).astype(np.int8)


def judged_codes(train: Train, params: Any, seeds: tuple[int, ...]) -> dict[str, np.ndarray]:
    """What claims say of the codes of each seed, params [seeds, ...]. codes/closeness: float32 [seeds, 1 + weights],
    `closeness` of clean goals and under each weight of the backgrounds; where the learner has an intrinsic reward
    on a graph, codes/reward: float32 [seeds], `reward_by_distance`, mean over a training goal a region."""
    env, found = train.env, codes_of(train, params["goal"])
    by_view = [
        [closeness(view, found["code_region"], found["code_use"]) for view in seed] for seed in found["code_mean"]
    ]
    judged = {"codes/closeness": np.array(by_view, np.float32)}
    if has_image_goals(env) or not has_reward(train.parts.learner):
        return judged
    place, in_view = np.asarray(env.position)[:, :2], np.asarray(env.in_view)
    goals = {goal: np.nanmean(place[in_view[:, goal]], axis=0) for goal in one_goal_a_region(env, env.goals.train_mask)}
    rewards = []
    for number, seed in enumerate(seeds):
        subject = subject_of(train, jax.tree.map(lambda leaf, own=number: leaf[own], params), seed)
        by_goal = zip(rewards_of_images(subject, list(goals)), goals.values(), strict=True)
        rewards.append([reward_by_distance(reward, place, middle) for reward, middle in by_goal])
    return judged | {"codes/reward": np.mean(rewards, axis=1).astype(np.float32)}


def ways_of_images(subject: Subject) -> dict[str, np.ndarray]:
    """Ways to corrupted test goals. way: float32 [weights, G, T + 1, 2], x and y of what is moved (m), on the cube the
    step and the angle to the goal (degrees), NaN behind the end; way_success bool [weights, G]; way_region int [G];
    way_goal float32 [G, 2]."""
    env = subject.train.env
    fetch = is_fetch(env)
    chosen, episodes = test_goal_episodes(subject)
    way = np.full((len(WEIGHTS), len(chosen), env.episode_length + 1, 2), np.nan, np.float32)
    for view, found in enumerate(episodes):
        if fetch:
            paths = np.asarray(env.unwrapped.robot.achieved(found.observations))[..., :2]
            paths = [path[: steps + 1] for path, steps in zip(paths, found.steps, strict=True)]
        else:
            angles = angles_to_goals(env, chosen, found)
            paths = [np.stack([np.arange(len(angle)), angle], -1) for angle in angles]
        for goal, path in enumerate(paths):
            way[view, goal, : len(path)] = path
    goals = np.asarray(env.unwrapped.positions)[chosen, :2] if fetch else np.zeros((len(chosen), 2))
    return {
        "way": way,
        "way_success": np.stack([np.asarray(found.success) for found in episodes]),
        "way_region": np.asarray(env.goals.regions)[chosen].astype(np.int16),
        "way_goal": goals.astype(np.float32),
    }


def ways_on_graph(subject: Subject) -> dict[str, np.ndarray]:
    """Ways to a test goal a region from the farthest start, as `ways_of_images` has them (one view), the places of all
    images `place` float32 [K, 2] (m); and where the learner has an intrinsic reward, reward float32 [R, K] of every
    image for a training goal a region, NaN where no goal is in view, and the way to it."""
    env, walks = subject.train.env, walks_of_policy(subject)
    place = np.asarray(env.position)[:, :2].astype(np.float32)
    chosen = one_goal_a_region(env, env.goals.test_mask)
    found = {"place": place} | ways_of([from_farthest(walks[goal]) for goal in chosen], env, place, "way")
    trained = one_goal_a_region(env, env.goals.train_mask)
    rewards = rewards_of_images(subject, trained)
    if np.nanmax(np.abs(rewards)) > 0:
        found["reward"] = rewards.astype(np.float16)
        found |= ways_of([from_farthest(walks[goal]) for goal in trained], env, place, "reward_way")
    return found


def ways_of(walks: list[Walk], env: Any, place: np.ndarray, name: str) -> dict[str, np.ndarray]:
    """Walks as arrays [1, G, T + 1, 2] by name, see `ways_of_images`."""
    way = np.full((1, len(walks), env.episode_length + 1, 2), np.nan, np.float32)
    for number, walk in enumerate(walks):
        way[0, number, : len(walk.nodes)] = place[walk.nodes]
    goals = [walk.goal for walk in walks]
    in_view = np.asarray(env.in_view)
    middle = np.stack([np.nanmean(place[in_view[:, goal]], axis=0) for goal in goals])
    return {
        name: way,
        f"{name}_success": np.array([[walk.success for walk in walks]]),
        f"{name}_region": np.asarray(env.goals.regions)[goals].astype(np.int16),
        f"{name}_goal": middle.astype(np.float32),
    }


def closeness(mean: np.ndarray, region: np.ndarray, use: np.ndarray) -> float:
    """How much nearer the codes of goals are to those of their region than to those of the nearest other region: the
    silhouette by region, in [-1, 1], mean over training and test goals that are not alone in theirs; NaN without such.
    mean [M, d], region int [M], use int [M] as in `measure.codes_of`."""
    kept = (use == TRAINING) | (use == TEST)
    mean, region = mean[kept].astype(float), region[kept]
    names = np.unique(region)
    apart = np.linalg.norm(mean[:, None] - mean, axis=-1)
    same = region[:, None] == region
    together = same.sum(1) > 1
    if len(names) < 2 or not together.any():
        return float("nan")
    own = (apart * same).sum(1) / np.maximum(same.sum(1) - 1, 1)
    others = np.stack([(apart * (region == each)).sum(1) / (region == each).sum() for each in names], 1)
    others[region[:, None] == names] = np.inf
    nearest = others.min(1)
    return float(((nearest - own) / np.maximum(np.maximum(nearest, own), 1e-12))[together].mean())


def reward_by_distance(reward: np.ndarray, place: np.ndarray, goal: np.ndarray) -> float:
    """Minus Spearman's correlation of the intrinsic reward of images [K], NaN where no goal is in view, with the
    distance of their places [K, 2] from the goal [2] (m)."""
    seen = np.isfinite(reward)
    distance = np.linalg.norm(place - goal, axis=1)
    return float(-stats.spearmanr(reward[seen], distance[seen]).statistic)
