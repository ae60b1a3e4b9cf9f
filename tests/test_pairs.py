"""Goal pairs and the dissimilarity matrix keep Algorithm 1's promises."""

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import pairs


def random_rows(seed: int, rows: int = 4, steps: int = 30, per_step: int = 3, num_goals: int = 12):
    """Goals achieved at each step (some steps none) and episode numbers that grow along each row."""
    generator = np.random.default_rng(seed)
    goals = generator.integers(0, num_goals, (rows, steps, per_step)).astype(np.int32)
    goals[generator.random(goals.shape) < 0.7] = -1
    episode = np.cumsum(generator.random((rows, steps)) < 0.15, axis=1).astype(np.int32)
    return goals, episode


def similar_by_hand(goals, episode, window: int, num_goals: int = 12):
    """Goal pairs seen within the window of one trajectory, by looking at every two steps."""
    similar = np.zeros((num_goals, num_goals), bool)
    for row in range(goals.shape[0]):
        for first in range(goals.shape[1]):
            for second in range(first, min(first + window + 1, goals.shape[1])):
                if episode[row, first] == episode[row, second]:
                    for one in goals[row, first][goals[row, first] >= 0]:
                        for other in goals[row, second][goals[row, second] >= 0]:
                            similar[one, other] = similar[other, one] = True
    return similar


def test_matrix_loses_exactly_the_pairs_seen_within_the_window():
    for seed, window in [(0, 0), (1, 2), (2, 7)]:
        goals, episode = random_rows(seed)
        matrix = pairs.remove_similar(pairs.initial_dissimilarity(12), jnp.asarray(goals), jnp.asarray(episode), window)
        expected = ~similar_by_hand(goals, episode, window) & ~np.eye(12, dtype=bool)
        np.testing.assert_array_equal(matrix, expected)


def test_matrix_is_symmetric_and_only_ever_loses_entries():
    matrix = pairs.initial_dissimilarity(12)
    for seed in range(5):
        goals, episode = random_rows(seed, rows=1, steps=6)
        smaller = pairs.remove_similar(matrix, jnp.asarray(goals), jnp.asarray(episode), 2)
        assert not (smaller & ~matrix).any()
        np.testing.assert_array_equal(smaller, smaller.T)
        assert not jnp.diagonal(smaller).any()
        matrix = smaller


def test_negatives_are_known_and_dissimilar_or_carry_no_weight():
    goals, episode = random_rows(3)
    matrix = pairs.remove_similar(pairs.initial_dissimilarity(12), jnp.asarray(goals), jnp.asarray(episode), 1)
    known = jnp.arange(12) % 3 != 0
    anchors = jnp.tile(jnp.arange(12), 200)[:, None]
    negative, weight = pairs.sample_negatives(jax.random.key(0), matrix, known, anchors)
    for anchor in range(12):
        allowed = set(np.flatnonzero(np.asarray(matrix[anchor] & known)))
        chosen = negative[anchors == anchor][np.asarray(weight[anchors == anchor]) > 0]
        assert set(np.asarray(chosen).tolist()) == allowed  # All that are allowed come up in 200 draws, and no other.


def test_anchor_without_dissimilar_goals_carries_no_weight():
    _, weight = pairs.sample_negatives(
        jax.random.key(0), jnp.zeros((5, 5), bool), jnp.ones(5, bool), jnp.arange(5)[:, None]
    )
    assert not weight.any()
    _, weight = pairs.sample_negatives(
        jax.random.key(0), pairs.initial_dissimilarity(5), jnp.zeros(5, bool), jnp.arange(5)[:, None]
    )
    assert not weight.any()


def test_choosing_from_a_mask_is_uniform_over_its_true_entries():
    mask = jnp.asarray([False, True, False, True, True, False])
    count = np.bincount(pairs.choose_from_mask(jax.random.key(1), mask, (3000,)), minlength=6)
    assert count[~np.asarray(mask)].sum() == 0
    assert (abs(count[np.asarray(mask)] - 1000) < 150).all()  # 150 is nearly six standard deviations.


def test_choosing_among_achieved_goals_never_invents_one():
    goals = jnp.asarray([[3, -1, 5], [-1, -1, -1], [2, -1, -1]])
    for seed in range(20):
        chosen = pairs.choose_goal(jax.random.key(seed), goals)
        assert int(chosen[0]) in (3, 5) and int(chosen[1]) == -1 and int(chosen[2]) == 2
