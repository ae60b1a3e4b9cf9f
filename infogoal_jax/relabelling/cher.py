"""CHER, curriculum-guided hindsight experience replay (Fang et al. 2019): HER proposes twice as many transitions as an
update learns from.

Half of them are chosen greedily for F(A) = F_div(A) + lambda F_prox(A). F_div (facility location) is high if the chosen
goals cover those of all candidates; F_prox is high if they lie near the goals that were achieved. lambda grows with the
updates, epoch by epoch: first diverse goals, later goals nearly reached.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.field_types import Weight
from infogoal_jax.relabelling import her
from infogoal_jax.relabelling.relabelling import Relabelling
from infogoal_jax.rows import add_rows

CANDIDATES = 2  # Candidates for each transition that is learned from (the authors' code).
TRIES = 3  # Candidates compared at each pick (the authors' code).
PRECISION = 1e-6  # Relative precision of a difference of products in float32.
TINY = 1e-12  # Avoids a division by 0 where all goals are equal.


@dataclasses.dataclass(frozen=True)
class CHERConfig(her.HERConfig):
    """How candidates are relabelled (fields of HER) and chosen."""

    similarity: Literal["nearest", "dense"] = "nearest"
    """Which goals cover each other. `nearest`: each its nearest neighbour alone (the authors' code); `dense`: all goals
    (their paper)."""
    proximity_weight: Weight = 1.0
    """lambda_0, the weight of proximity before the first update. 0 or more."""
    proximity_growth: Weight = 1e-4
    """eta, the relative growth of lambda in an update. 0 or more."""
    proximity_unit: Literal["mean", "world"] = "mean"
    """Unit of the distances to what was achieved. `mean`: their mean over the candidates; `world`: the positions' own
    (the authors' code)."""


@flax.struct.dataclass
class Table:
    """What the choices of an epoch need."""

    proposals: Any
    """HER's table."""
    achieved: jax.Array
    """int32 [R, T + 1, K], goals achieved at each step, padded with -1."""
    positions: jax.Array
    """float32 [N, D], where the goals lie, or their codes where that is unknown."""
    weight: jax.Array
    """float32 [], lambda before the first update of the epoch."""


MOST_GROWTH = 60.0
"""Of the logarithm of lambda: by then proximity alone chooses, and float32 holds it."""


def proximity_weight(config: CHERConfig, updates: jax.Array) -> jax.Array:
    """lambda_t = lambda_0 (1 + eta)^t after t updates."""
    # A power of 1.0001 in float32 would drift, and one that is infinite leaves no choice.
    growth = jnp.asarray(updates, jnp.float32) * math.log1p(config.proximity_growth)
    return config.proximity_weight * jnp.exp(jnp.minimum(growth, MOST_GROWTH))


def squared_distances(positions: jax.Array) -> jax.Array:
    """Squared distances [n, n] between positions [n, D], exactly 0 between equal ones.

    Computed as |a|^2 + |b|^2 - 2 a b, which is ten times faster than differences. What float32 cannot tell from 0 this
    way is set to 0.
    """
    centred = positions - positions.mean(0, keepdims=True)
    products = jnp.matmul(centred, centred.T, precision="highest")
    norms = jnp.diagonal(products)
    largest = norms[:, None] + norms[None]
    squared = largest - 2.0 * products
    # Otherwise XLA computes it again at each use.
    return jax.lax.optimization_barrier(jnp.where(squared > PRECISION * largest, squared, 0.0))


def neighbour_weights(positions: jax.Array) -> jax.Array:
    """w_k = sum of exp(-d_i^2 / m^2) over all i with nearest neighbour k, d_i the distance from i to k, m the mean of
    all d: [n, D] to [n].

    If only the nearest neighbour is similar, F_div is the sum of w over the chosen candidates (as in the authors'
    code).
    """
    count = positions.shape[0]
    squared = jnp.where(jnp.eye(count, dtype=bool), jnp.inf, squared_distances(positions))
    least = squared.min(0)
    # The first of equals; argmin is slow.
    rows = jnp.arange(count, dtype=jnp.float32)[:, None]
    nearest = jnp.where(squared == least[None], rows, count).min(0).astype(jnp.int32)
    similarity = jnp.exp(-least / (jnp.sqrt(least).mean() ** 2 + TINY))
    return add_rows(similarity[:, None], nearest, count)[:, 0]


def dense_similarity(positions: jax.Array) -> jax.Array:
    """exp(-d_ij^2 / m^2) of all pairs, where m is the mean distance of two candidates: [n, D] to [n, n] (as in the
    paper)."""
    squared, count = squared_distances(positions), positions.shape[0]
    mean = jnp.sqrt(squared).sum() / (count * (count - 1))
    return jnp.exp(-squared / (mean**2 + TINY))


def pick(places: jax.Array, count: int, gain: Callable, cover: jax.Array, take: Callable) -> jax.Array:
    """Choose p of `count` candidates one after another, int32 [p].

    Each choice compares c candidates and takes the one with the largest gain, the first among equals. places: int32 [p,
    c], their places in the ascending list of candidates not chosen yet. gain(cover, candidates [c]) -> [c]. take(cover,
    candidate) -> cover; `cover` is its first value.
    """

    def step(carry, place):
        left, cover = carry
        candidates = left[place]
        best = gain(cover, candidates).argmax()
        # Those behind move up; the last place is not read again.
        left = jnp.where(jnp.arange(count, dtype=jnp.int32) < place[best], left, jnp.roll(left, -1))
        return (left, take(cover, candidates[best])), candidates[best]

    return jax.lax.scan(step, (jnp.arange(count, dtype=jnp.int32), cover), places)[1]


def pick_nearest(weights: jax.Array, cost: jax.Array, places: jax.Array) -> jax.Array:
    """Candidates int32 [p] for F(A) = sum over A of w - cost, both [n]. places: int32 [p, c] of `draw_places`."""
    score = weights - cost
    return pick(
        places,
        score.shape[0],
        lambda _, candidates: score[candidates],
        jnp.zeros((), jnp.float32),
        lambda cover, _: cover,
    )


def pick_dense(similarity: jax.Array, cost: jax.Array, places: jax.Array) -> jax.Array:
    """Candidates int32 [p] for F(A) = sum over i of max over j in A of similarity [n, n] - sum over A of cost [n].
    places: int32 [p, c]."""

    def gain(cover, candidates):
        return jnp.maximum(similarity[candidates] - cover, 0.0).sum(-1) - cost[candidates]

    return pick(
        places,
        cost.shape[0],
        gain,
        jnp.zeros(cost.shape[0], jnp.float32),
        lambda cover, chosen: jnp.maximum(cover, similarity[chosen]),
    )


def draw_places(key: jax.Array, count: int, picks: int) -> jax.Array:
    """Draw for each pick different places in the list of candidates not chosen yet ("lazier than lazy" greedy): int32
    [picks, TRIES]."""
    left = count - jnp.arange(picks, dtype=jnp.int32)
    places = []
    for drawn, try_key in enumerate(jax.random.split(key, TRIES)):
        place = jax.random.randint(try_key, (picks,), 0, jnp.maximum(left - drawn, 1), jnp.int32)
        for earlier in jnp.sort(jnp.array(places), axis=0) if places else ():
            place = place + (place >= earlier).astype(
                jnp.int32
            )  # The place among those not drawn yet, counted among all.
        places.append(jnp.minimum(place, left - 1))
    return jnp.stack(places, axis=1)


def proximity_distances(position: jax.Array, achieved: jax.Array, positions: jax.Array) -> jax.Array:
    """Distance float32 [n] from each candidate's goal, at `position` [n, D], to the nearest goal achieved, int32 [n, K]
    padded with -1.

    Where nothing was achieved, it is the largest distance of the other candidates.
    """
    distance = jnp.sqrt(((position[:, None] - positions[achieved]) ** 2).sum(-1))
    distance = jnp.where(achieved >= 0, distance, jnp.inf).min(1)
    return jnp.where(jnp.isfinite(distance), distance, jnp.where(jnp.isfinite(distance), distance, 0.0).max())


def make(config: CHERConfig) -> Relabelling:
    """CHER for goals that are indices.

    Distances are divided by their mean unless the configuration asks for the world's unit. The authors' distances are
    metres on a table top, a few tenths each, beside covers of about 1. Codes of goals have no unit and grow while they
    are learned, so that lambda would have another meaning in every task.
    """
    proposing = her.make(config)

    def prepare(context):
        known = context.goal_positions
        return Table(
            proposals=proposing.prepare(context),
            achieved=context.achievements.goals,
            positions=context.goal_codes() if known is None else known,
            weight=proximity_weight(config, context.updates),
        )

    def choose(key, table, row, step, desired_goal):
        count, position = desired_goal.shape[0], table.positions[desired_goal]
        distance = proximity_distances(position, table.achieved[row, step + 1], table.positions)
        if config.proximity_unit == "mean":
            distance = distance / (distance.mean() + TINY)
        places = draw_places(key, count, count // CANDIDATES)
        if config.similarity == "nearest":
            return pick_nearest(neighbour_weights(position), table.weight * distance, places)
        return pick_dense(dense_similarity(position), table.weight * distance, places)

    def relabel(key, table, row, step, desired_goal):
        return proposing.relabel(key, table.proposals, row, step, desired_goal)

    return Relabelling(prepare, relabel, choose, CANDIDATES, skip_reached=config.skip_reached)
