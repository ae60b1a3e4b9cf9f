"""CHER, curriculum-guided hindsight experience replay (Fang et al. 2019): HER proposes twice the transitions, half of which are learned from.

The half is chosen greedily for F(A) = F_div(A) + lambda F_prox(A): its goals cover those of all candidates (facility location), and lie near what
was achieved instead. lambda grows with every update: diverse goals at first, goals nearly reached in the end.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.errors import require
from infogoal_jax.relabelling import her
from infogoal_jax.relabelling.relabelling import Relabelling

CANDIDATES = 2  # For each transition that is learned from [C].
TRIES = 3  # Candidates compared at each pick [C].
PRECISION = 1e-6  # Of a difference of products in float32.
TINY = 1e-12  # Keeps a mean distance of 0, between equal goals, from being divided by.


@dataclasses.dataclass(frozen=True)
class CHERConfig(her.HERConfig):
    """How candidates are relabelled (fields of HER), and which of them are chosen."""

    similarity: Literal["nearest", "dense"] = "nearest"
    """Which goals cover each other: each its nearest neighbour alone (the authors' code), or all of them (their paper)."""
    proximity_weight: float = 1.0
    """lambda_0, the weight of proximity before the first update. 0 or more."""
    proximity_growth: float = 1e-4
    """eta: by which share lambda grows with an update. 0 or more."""
    proximity_unit: Literal["mean", "world"] = "mean"
    """Unit of the distances to what was achieved: their mean over the candidates, or that of the task's positions (the authors' code)."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        super().check(config)
        require(self.similarity in ("nearest", "dense"), "relabelling.similarity", self.similarity, "give nearest or dense")
        require(self.proximity_unit in ("mean", "world"), "relabelling.proximity_unit", self.proximity_unit, "give mean or world")
        for name in ("proximity_weight", "proximity_growth"):
            require(getattr(self, name) >= 0, f"relabelling.{name}", getattr(self, name), "give 0 or more")


@flax.struct.dataclass
class Table:
    """What an epoch's choices need.

    proposals: HER's table; achieved: int32 [R, T + 1, K]; positions: float32 [N, D]; weight: lambda before the epoch's first update.
    """

    proposals: Any
    achieved: jax.Array
    positions: jax.Array
    weight: jax.Array


def proximity_weight(config: CHERConfig, updates: jax.Array) -> jax.Array:
    """lambda_t = lambda_0 (1 + eta)^t after so many updates."""
    return config.proximity_weight * jnp.exp(updates * math.log1p(config.proximity_growth))  # A power of 1.0001 in float32 would drift.


def squared_distances(positions: jax.Array) -> jax.Array:
    """Between all pairs of positions [n, D]: [n, n], exactly 0 between equal ones.

    As |a|^2 + |b|^2 - 2 a b, which is ten times faster than differences; what float32 cannot tell from 0 that way is 0.
    """
    centred = positions - positions.mean(0)
    products = jnp.matmul(centred, centred.T, precision="highest")
    norms = jnp.diagonal(products)
    largest = norms[:, None] + norms
    squared = largest - 2.0 * products
    return jax.lax.optimization_barrier(jnp.where(squared > PRECISION * largest, squared, 0.0))  # Else worked out again wherever it is read.


def neighbour_weights(positions: jax.Array) -> jax.Array:
    """w_k = sum over the i whose nearest neighbour is k of exp(-d_i^2 / m^2), where d_i is their distance and m the mean of all d: [n, D] to [n].

    F_div with a similarity to the nearest neighbour alone is the sum of the chosen candidates' w (as in the authors' code).
    """
    count = positions.shape[0]
    squared = jnp.where(jnp.eye(count, dtype=bool), jnp.inf, squared_distances(positions))
    least = squared.min(0)
    nearest = jnp.where(squared == least, jnp.arange(float(count))[:, None], count).min(0).astype(jnp.int32)  # The first of equals; argmin is slow.
    similarity = jnp.exp(-least / (jnp.sqrt(least).mean() ** 2 + TINY))
    return jnp.zeros(count).at[nearest].add(similarity)


def dense_similarity(positions: jax.Array) -> jax.Array:
    """exp(-d_ij^2 / m^2) of all pairs, m the mean distance between two candidates: [n, D] to [n, n] (as in the paper)."""
    squared, count = squared_distances(positions), positions.shape[0]
    mean = jnp.sqrt(squared).sum() / (count * (count - 1))
    return jnp.exp(-squared / (mean**2 + TINY))


def pick(places: jax.Array, count: int, gain: Callable, cover: jax.Array, take: Callable) -> jax.Array:
    """Candidates int32 [p] picked one after another out of `count`, each the one of greatest gain (the first of equals) among those at the places
    [p, c] drawn for it, counted among those left in ascending order.

    gain(cover, candidates [c]) -> [c]; take(cover, candidate) -> cover, which begins as given.
    """
    def step(carry, place):
        left, cover = carry
        candidates = left[place]
        best = gain(cover, candidates).argmax()
        left = jnp.where(jnp.arange(count) < place[best], left, jnp.roll(left, -1))  # Those behind move up; the end is never read again.
        return (left, take(cover, candidates[best])), candidates[best]

    return jax.lax.scan(step, (jnp.arange(count), cover), places)[1]


def pick_nearest(weights: jax.Array, cost: jax.Array, places: jax.Array) -> jax.Array:
    """Candidates int32 [p] for F(A) = sum over A of w - cost, both [n]. places: int32 [p, c] of `draw_places`."""
    score = weights - cost
    return pick(places, score.shape[0], lambda _, candidates: score[candidates], jnp.zeros(()), lambda cover, _: cover)


def pick_dense(similarity: jax.Array, cost: jax.Array, places: jax.Array) -> jax.Array:
    """Candidates int32 [p] for F(A) = sum over i of max over j in A of similarity [n, n] - sum over A of cost [n]. places: int32 [p, c]."""
    def gain(cover, candidates):
        return jnp.maximum(similarity[candidates] - cover, 0.0).sum(-1) - cost[candidates]

    return pick(places, cost.shape[0], gain, jnp.zeros(cost.shape[0]), lambda cover, chosen: jnp.maximum(cover, similarity[chosen]))


def draw_places(key: jax.Array, count: int, picks: int) -> jax.Array:
    """For each pick, different places in the list of those left ("lazier than lazy" greedy): int32 [picks, TRIES]."""
    left = count - jnp.arange(picks)
    places = []
    for drawn, try_key in enumerate(jax.random.split(key, TRIES)):
        place = jax.random.randint(try_key, (picks,), 0, jnp.maximum(left - drawn, 1))
        for earlier in jnp.sort(jnp.array(places), axis=0) if places else ():
            place = place + (place >= earlier)  # The place among those not drawn yet, counted among all.
        places.append(jnp.minimum(place, left - 1))
    return jnp.stack(places, axis=1)


def proximity_distances(position: jax.Array, achieved: jax.Array, positions: jax.Array) -> jax.Array:
    """From each candidate's goal at `position` [n, D] to the nearest of the goals achieved int32 [n, K] instead, padded with -1: float32 [n].

    Where nothing was achieved, the farthest of the others'.
    """
    distance = jnp.sqrt(((position[:, None] - positions[achieved]) ** 2).sum(-1))
    distance = jnp.where(achieved >= 0, distance, jnp.inf).min(1)
    return jnp.where(jnp.isfinite(distance), distance, jnp.where(jnp.isfinite(distance), distance, 0.0).max())


def make(config: CHERConfig) -> Relabelling:
    """CHER for goals that are indices.

    Distances are divided by their mean unless the configuration asks for the world's unit. The authors' are metres on a table top, a few tenths each,
    against covers of about 1; codes of goals have no unit, and grow while they are learned, so that lambda would mean another thing in every task.
    """
    proposing = her.make(config)

    def prepare(context):
        weight = proximity_weight(config, context.updates)
        return Table(proposing.prepare(context), context.achievements.goals, context.positions(), weight)

    def choose(key, table, row, step, goal):
        count, position = goal.shape[0], table.positions[goal]
        distance = proximity_distances(position, table.achieved[row, step + 1], table.positions)
        if config.proximity_unit == "mean":
            distance = distance / (distance.mean() + TINY)
        places = draw_places(key, count, count // CANDIDATES)
        if config.similarity == "nearest":
            return pick_nearest(neighbour_weights(position), table.weight * distance, places)
        return pick_dense(dense_similarity(position), table.weight * distance, places)

    def relabel(key, table, row, step, goal):
        return proposing.relabel(key, table.proposals, row, step, goal)

    return Relabelling(prepare, relabel, choose, CANDIDATES)
