"""What claims say of the codes of goals and of the intrinsic reward, each as one number of a seed."""

import numpy as np
from scipy import stats

from infogoal_jax.goal_uses import TEST, TRAINING


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
