"""The tests that decide what the paper says of codes and of the intrinsic reward, of the pictures of one seed."""

import numpy as np
from scipy import stats

from infogoal_jax.reproduce.evidence import Finding, bounds_of
from infogoal_jax.reproduce.figures.codes import picture_of
from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.scores import TITLES


def closeness(result: Result) -> np.ndarray:
    """How much nearer the clean codes of each goal are to those of its region than to the others, [M]: the silhouette
    by region, of training and test goals."""
    use = result.arrays["picture/code_use"]
    kept = (use == 0) | (use == 2)
    mean, region = result.arrays["picture/code_mean"][0][kept].astype(float), result.arrays["picture/code_region"][kept]
    apart = np.linalg.norm(mean[:, None] - mean, axis=-1)
    same = region[:, None] == region
    alone = same.sum(1) < 2
    own = (apart * same).sum(1) / np.maximum(same.sum(1) - 1, 1)
    others = np.stack([(apart * (region == each)).sum(1) / (region == each).sum() for each in np.unique(region)], 1)
    others[region[:, None] == np.unique(region)] = np.inf
    nearest = others.min(1)
    return np.where(alone, np.nan, (nearest - own) / np.maximum(np.maximum(nearest, own), 1e-12))


def grouped(results: Results) -> Finding:
    """The silhouette of InfoGoal's codes by region minus that of the bare agent's, goal by goal, over tasks."""
    differences, on = [], []
    for task in ("object_search", "embodied_qa", "fetch_pick_and_place", "object_manipulation"):
        pictures = [picture_of(results, task, method) for method in ("infogoal", "none")]
        if None not in pictures:
            difference = closeness(pictures[0]) - closeness(pictures[1])
            differences.append(difference[np.isfinite(difference)])
            on.append(TITLES[task])
    if not differences:
        return Finding(None, "no runs")
    return Finding(bounds_of(differences), f"silhouette by region, interval over goals, one seed; {', '.join(on)}")


def reward_near_goal(results: Results) -> Finding:
    """Minus the rank correlation of the intrinsic reward with the distance to where the goal is in view, mean over
    training goals."""
    values = []
    for task in ("object_search", "embodied_qa"):
        found = picture_of(results, task, "infogoal")
        if found is None or "picture/reward" not in found.arrays:
            continue
        place = found.arrays["picture/place"]
        for reward, goal in zip(found.arrays["picture/reward"], found.arrays["picture/reward_way_goal"], strict=True):
            distance, seen = np.linalg.norm(place - goal, axis=1), np.isfinite(reward.astype(float))
            values.append(-stats.spearmanr(reward[seen].astype(float), distance[seen]).statistic)
    if not values:
        return Finding(None, "no runs")
    words = f"minus Spearman's correlation with the distance, interval over {len(values)} training goals, one seed"
    return Finding(bounds_of([np.array(values)]), words)
