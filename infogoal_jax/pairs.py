"""Goal pairs within the time window and the dissimilarity matrix G_neg (Algorithm 1, lines 16 to 20).

A step achieves the goals `goals [..., K, *shape]`, padded with "no goal". Two goals are similar once they were achieved
within `window` steps of each other in one trajectory, and stay similar. Goals achieved in the same state are similar
too (lag 0).
"""

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import replay
from infogoal_jax.goals import is_goal

REJECTION_TRIES = (
    16  # Candidates for a negative. If half of the goals are dissimilar, all 16 are rejected once in 65,536 draws.
)


@flax.struct.dataclass
class GoalPairs:
    """Anchors, positives and K negatives for the contrastive bound, as goals."""

    anchor: jax.Array
    """[B, *shape]."""
    positive: jax.Array
    """[B, *shape], similar to the anchor: achieved within the window of it, or near it (`SampleSpec.radius`)."""
    contrast: jax.Array
    """[B, K, *shape], what each negative is compared with: the anchor, or another goal."""
    negative: jax.Array
    """[B, K, *shape]."""
    positive_weight: jax.Array
    """float32 [B], 0 where no pair was found."""
    negative_weight: jax.Array
    """float32 [B, K], 0 where no negative was found."""
    other: jax.Array | None = None
    """[B, *shape], any achieved goals, beside which a classifier of similar goals sees the positives; None without."""


def initial_dissimilarity(num_goals: int) -> jax.Array:
    """G_neg before any experience, bool [N, N]: every goal is dissimilar to every other goal, and not to itself."""
    return ~jnp.eye(num_goals, dtype=bool)


def dissimilarity_by_distance(positions: jax.Array, radius: float) -> jax.Array:
    """G_neg where goals at these positions [N, D] are dissimilar if they lie farther apart than the radius, bool
    [N, N]."""
    squared = sum((column[:, None] - column[None, :]) ** 2 for column in positions.T)
    return squared > radius**2


def remove_similar(dissimilarity: jax.Array, goals: jax.Array, episode: jax.Array, window: int) -> jax.Array:
    """Remove pairs achieved within `window` steps of each other from G_neg (line 19). The matrix stays symmetric and
    only loses entries.

    goals: int32 [R, T, K] achieved at each step. episode: int32 [R, T], number of the episode within its row; steps of
    one episode are adjacent.
    """
    num_goals, steps = dissimilarity.shape[0], goals.shape[1]
    goals = jnp.where(goals < 0, num_goals, goals)  # Outside the matrix: dropped by the scatter.

    def remove_at_lag(lag, matrix):
        later = jnp.roll(goals, -lag, axis=1)
        within_row = jnp.arange(steps, dtype=jnp.int32)[None] + lag < steps
        together = (jnp.roll(episode, -lag, axis=1) == episode) & within_row
        later = jnp.where(together[..., None], later, num_goals)
        first, second = jnp.broadcast_arrays(goals[..., :, None], later[..., None, :])
        return matrix.at[first, second].set(False, mode="drop")

    dissimilarity = jax.lax.fori_loop(0, window + 1, remove_at_lag, dissimilarity)
    return dissimilarity & dissimilarity.T


def choose_goal(key: jax.Array, goals: jax.Array) -> jax.Array:
    """Draw one of the goals [..., K, *shape], uniformly among those that there are; "no goal" where there is none."""
    there = is_goal(goals)
    preference = jnp.where(there, jax.random.uniform(key, there.shape, jnp.float32), -1.0)
    chosen = preference.argmax(-1)[..., None]
    if goals.ndim == there.ndim:
        return jnp.take_along_axis(goals, chosen, axis=-1)[..., 0]
    return jnp.take_along_axis(goals, chosen[..., None], axis=-2)[..., 0, :]


def choose_from_mask(key: jax.Array, mask: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draw indices uniformly among the true entries of mask [N], by inverting the running count. Meaningless if no
    entry is true."""
    count = jnp.cumsum(mask.astype(jnp.int32))
    rank = jax.random.randint(key, shape, 0, jnp.maximum(count[-1], 1), jnp.int32)
    return jnp.minimum(jnp.searchsorted(count, rank, side="right"), mask.shape[0] - 1).astype(jnp.int32)


@flax.struct.dataclass
class KnownGoals:
    """The goals of a finite set that may be drawn."""

    mask: jax.Array
    """bool [N]."""

    def any(self) -> jax.Array:
        """Whether there is one, bool []."""
        return self.mask.any()

    def draw(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Draw goals uniformly, int32 [*shape]. Meaningless if there is none."""
        return choose_from_mask(key, self.mask, shape)


@flax.struct.dataclass
class AchievedGoals:
    """The goals of a continuous space that may be drawn: all that the replay buffer achieved."""

    goals: jax.Array
    """float32 [R, T + 1, K, D], padded with NaN."""
    count: jax.Array
    """int32 [R * (T + 1)], running count of the steps that achieve one."""

    def any(self) -> jax.Array:
        """Whether there is one, bool []."""
        return self.count[-1] > 0

    def draw(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Draw goals, each of a step drawn uniformly, float32 [*shape, D]. Meaningless if there is none."""
        place_key, goal_key = jax.random.split(key)
        row, step = replay.draw(place_key, self.count, shape, self.goals.shape[1])
        return choose_goal(goal_key, self.goals[row, step])


def sample_negatives(
    key: jax.Array, dissimilarity: jax.Array, known: jax.Array, anchors: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Draw for each anchor a known goal that is dissimilar to it (line 20), by rejection. The weight is 0 where every
    candidate was rejected.

    known: bool [N]. anchors: int32 [...]. Returns goals int32 [...] and weights float32 [...].
    """
    candidates = choose_from_mask(key, known, (*anchors.shape, REJECTION_TRIES))
    accepted = dissimilarity[anchors[..., None], candidates] & known[candidates]
    first = accepted.argmax(-1)
    return jnp.take_along_axis(candidates, first[..., None], axis=-1)[..., 0], accepted.any(-1).astype(jnp.float32)
