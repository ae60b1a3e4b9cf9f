"""Goal pairs within the time window and the dissimilarity matrix G_neg (Algorithm 1, lines 16 to 20).

A goal is achieved at a step if it is among `goals [..., K]` there, padded with -1. Two goals are similar for good once they were achieved
within `window` steps of each other in one trajectory; goals achieved in the same state are similar too (lag 0).
"""

import flax.struct
import jax
import jax.numpy as jnp

REJECTION_TRIES = 16  # Candidates drawn for a negative; with half of the goals dissimilar, all are rejected once in 65,536 draws.


@flax.struct.dataclass
class GoalPairs:
    """Anchors, positives and negatives for the contrastive bound, as goal indices.

    anchor, positive: int32 [B]; negative: int32 [B, K]; contrast: int32 [B, K], what the negative is compared with (the anchor, or another goal).
    positive_weight: float32 [B] and negative_weight: float32 [B, K], 0 where no such pair exists.
    """

    anchor: jax.Array
    positive: jax.Array
    contrast: jax.Array
    negative: jax.Array
    positive_weight: jax.Array
    negative_weight: jax.Array


def initial_dissimilarity(num_goals: int) -> jax.Array:
    """G_neg before any experience: bool [N, N], every goal dissimilar to every other, never to itself."""
    return ~jnp.eye(num_goals, dtype=bool)


def remove_similar(dissimilarity: jax.Array, goals: jax.Array, episode: jax.Array, window: int) -> jax.Array:
    """G_neg without the pairs achieved within `window` steps of each other (line 19): symmetric, and only ever losing entries.

    goals: int32 [R, T, K] achieved at each step; episode: int32 [R, T] number of the episode within its row, steps of one episode adjacent.
    """
    num_goals, steps = dissimilarity.shape[0], goals.shape[1]
    goals = jnp.where(goals < 0, num_goals, goals)  # Outside the matrix: dropped by the scatter.

    def remove_at_lag(lag, matrix):
        later = jnp.roll(goals, -lag, axis=1)
        together = (jnp.roll(episode, -lag, axis=1) == episode) & (jnp.arange(steps) + lag < steps)
        later = jnp.where(together[..., None], later, num_goals)
        first, second = jnp.broadcast_arrays(goals[..., :, None], later[..., None, :])
        return matrix.at[first, second].set(False, mode="drop")

    dissimilarity = jax.lax.fori_loop(0, window + 1, remove_at_lag, dissimilarity)
    return dissimilarity & dissimilarity.T


def count_dissimilar_regions(dissimilarity: jax.Array, regions: jax.Array, seen: jax.Array) -> dict[str, jax.Array]:
    """How many dissimilar pairs of seen goals are left within and between regions: tells whether the window fits the geometry."""
    same_region = regions[:, None] == regions[None, :]
    upper = jnp.triu(dissimilarity & seen[:, None] & seen[None, :])
    return {"dissimilar_within": (upper & same_region).sum(), "dissimilar_between": (upper & ~same_region).sum()}


def choose_goal(key: jax.Array, goals: jax.Array) -> jax.Array:
    """One of the goals [..., K] that are not -1, uniformly; -1 where there is none."""
    preference = jnp.where(goals >= 0, jax.random.uniform(key, goals.shape), -1.0)
    return jnp.take_along_axis(goals, preference.argmax(-1)[..., None], axis=-1)[..., 0]


def choose_from_mask(key: jax.Array, mask: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Indices drawn uniformly among the true entries of mask [N], by inverting the running count; meaningless if there is none."""
    count = jnp.cumsum(mask.astype(jnp.int32))
    rank = jax.random.randint(key, shape, 0, jnp.maximum(count[-1], 1))
    return jnp.minimum(jnp.searchsorted(count, rank, side="right"), mask.shape[0] - 1).astype(jnp.int32)


def sample_negatives(key: jax.Array, dissimilarity: jax.Array, known: jax.Array, anchors: jax.Array) -> tuple[jax.Array, jax.Array]:
    """For each anchor a known goal dissimilar to it (line 20), by rejection, with weight 0 where every try was rejected.

    known: bool [N]; anchors: int32 [...]. Returns goals int32 [...] and weights float32 [...].
    """
    candidates = choose_from_mask(key, known, (*anchors.shape, REJECTION_TRIES))
    accepted = dissimilarity[anchors[..., None], candidates] & known[candidates]
    first = accepted.argmax(-1)
    return jnp.take_along_axis(candidates, first[..., None], axis=-1)[..., 0], accepted.any(-1).astype(jnp.float32)
