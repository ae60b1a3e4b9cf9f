"""What training draws: the replay buffer samples uniformly and never looks across an episode; goal pairs and the
dissimilarity matrix keep Algorithm 1's promises; keys with Threefry's rounds unrolled give jax's own numbers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from infogoal_jax import pairs, replay
from infogoal_jax.keys import unrolled
from infogoal_jax.replay import Trajectories


@pytest.fixture
def rows() -> Trajectories:
    """Six rows of 25 transitions; an observation is 1000 * episode + step, episodes numbered through all rows; some end
    by reaching the goal.

    Every third step of an episode is decided, also those that only a reset follows.
    """
    generator = np.random.default_rng(0)
    observation = np.zeros((6, 26), np.int32)
    valid, terminated, truncated = np.zeros((6, 25), bool), np.zeros((6, 25), bool), np.zeros((6, 25), bool)
    episode = 0
    for row in range(6):
        column = 0
        while column < 26:
            length, reached = int(generator.integers(1, 9)), bool(generator.random() < 0.5)
            episode += 1
            for step in range(min(length + 1, 26 - column)):
                observation[row, column + step] = 1000 * episode + step
                if step:
                    valid[row, column + step - 1] = True
                    terminated[row, column + step - 1] = reached and step == length
                    truncated[row, column + step - 1] = not reached and step == length
            column += length + 1
    goal, decided = observation[:, :-1] // 1000, observation[:, :-1] % 1000 % 3 == 0
    cell = np.zeros((6, 25), np.int32)
    return Trajectories(observation, observation, cell, goal, valid, terminated, truncated, decided)


def sampled(seed: int, rows: Trajectories, starts, count: int, num_steps: int) -> replay.Transitions:
    """So many transitions that start at any of these steps, bool [R, T]."""

    @jax.jit
    def draw(key, rows, starts):
        places = replay.draw(key, replay.running_count(starts), count, rows.valid.shape[1])
        return replay.transitions_at(rows, *places, num_steps)

    return jax.device_get(draw(jax.random.key(seed), rows, starts))


def test_transitions_stay_within_their_episode_and_step_by_one(rows):
    batch = sampled(0, rows, rows.valid, 2000, 3)
    taken = batch.mask.sum(1).astype(int)
    assert (taken >= 1).all()
    # Same episode: only the step has grown.
    np.testing.assert_array_equal(batch.next_observation, batch.observation + taken)
    np.testing.assert_array_equal(batch.desired_goal, batch.observation // 1000)
    for step in range(3):
        inside = batch.mask[:, step] > 0
        np.testing.assert_array_equal(batch.records[inside, step], batch.observation[inside] + step + 1)


def test_termination_is_that_of_the_last_step_taken(rows):
    batch = sampled(0, rows, rows.valid, 2000, 3)
    ends = {int(rows.observation[r, t + 1]) for r, t in zip(*np.nonzero(rows.terminated), strict=True)}
    np.testing.assert_array_equal(batch.terminated, [int(last) in ends for last in batch.next_observation])
    assert batch.terminated.any() and not batch.terminated.all()


def test_short_transitions_end_an_episode_or_a_row(rows):
    batch = sampled(0, rows, rows.valid, 2000, 3)
    over = rows.terminated | rows.truncated
    over[:, -1] |= rows.valid[:, -1]
    ends = {int(rows.observation[r, t + 1]) for r, t in zip(*np.nonzero(over), strict=True)}
    for last in batch.next_observation[batch.mask.sum(1) < 3]:
        assert int(last) in ends


def test_steps_left_counts_to_the_end_of_the_episode(rows):
    valid = np.asarray(rows.valid)
    expected = np.zeros(valid.shape, int)
    for row, column in np.ndindex(*valid.shape):
        while column + expected[row, column] < valid.shape[1] and valid[row, column + expected[row, column]]:
            expected[row, column] += 1
    np.testing.assert_array_equal(replay.steps_left(rows.valid), expected)


def test_first_steps_are_uniform_over_all_valid_transitions(rows):
    batch = sampled(2, rows, rows.valid, 20_000, 1)
    count = np.array([(batch.observation == start).sum() for start in rows.observation[:, :-1][rows.valid]])
    assert count.sum() == 20_000  # Nothing but valid transitions.
    assert scipy.stats.chisquare(count).pvalue > 1e-6


def test_transitions_of_an_agent_that_decides_now_and_then_start_at_its_decisions(rows):
    batch = sampled(3, rows, rows.valid & rows.decided, 20_000, 3)
    decisions = rows.observation[:, :-1][rows.valid & rows.decided]
    count = np.array([(batch.observation == start).sum() for start in decisions])
    assert count.sum() == 20_000 and (batch.observation % 1000 % 3 == 0).all()
    assert scipy.stats.chisquare(count).pvalue > 1e-6
    whole = batch.mask.sum(1) == 3
    assert (batch.next_observation[whole] % 1000 % 3 == 0).all()  # A whole interval leads to the next decision.
    assert (batch.mask.sum(1)[batch.terminated] < 3).any()  # Some episodes end within an interval.


@pytest.mark.parametrize("window", [0, pytest.param(1, marks=pytest.mark.long), 5])
def test_pairs_lie_within_the_window_of_one_episode(rows, window):
    achieved = rows.observation % 3 != 0

    @jax.jit
    def draw(key, rows, achieved):
        row, *steps = replay.sample_within_window(key, rows, achieved, replay.running_count(achieved), 3000, window)
        return [rows.observation[row, step] for step in steps]

    first, second = jax.device_get(draw(jax.random.key(0), rows, achieved))
    np.testing.assert_array_equal(first // 1000, second // 1000)
    lag = second - first
    assert abs(lag).max() <= window and (lag.min() < 0 < lag.max() or window == 0)
    assert (first % 3 != 0).all() and (second % 3 != 0).all()


def test_new_rows_replace_the_oldest(rows):
    buffer, add = replay.empty(rows, 2), jax.jit(replay.add)
    assert not np.asarray(buffer.valid).any()
    for epoch in range(3):
        buffer = add(buffer, rows.replace(desired_goal=np.full_like(rows.desired_goal, epoch)), epoch)
    np.testing.assert_array_equal(np.unique(buffer.desired_goal[:6]), [2])
    np.testing.assert_array_equal(np.unique(buffer.desired_goal[6:]), [1])


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


@functools.partial(jax.jit, static_argnums=3)
def without_similar(matrix, goals, episode, window: int):
    """`pairs.remove_similar`; window: in steps."""
    return pairs.remove_similar(matrix, goals, episode, window)


def test_matrix_loses_exactly_the_pairs_seen_within_the_window():
    for seed, window in [(0, 0), (1, 2), (2, 7)]:
        goals, episode = random_rows(seed)
        matrix = without_similar(pairs.initial_dissimilarity(12), goals, episode, window)
        expected = ~similar_by_hand(goals, episode, window) & ~np.eye(12, dtype=bool)
        np.testing.assert_array_equal(matrix, expected)


def test_matrix_is_symmetric_and_only_ever_loses_entries():
    matrix = np.asarray(pairs.initial_dissimilarity(12))
    for seed in range(5):
        smaller = np.asarray(without_similar(matrix, *random_rows(seed, rows=1, steps=6), 2))
        assert not (smaller & ~matrix).any()
        np.testing.assert_array_equal(smaller, smaller.T)
        assert not np.diagonal(smaller).any()
        matrix = smaller


def test_negatives_are_known_and_dissimilar_or_carry_no_weight():
    matrix = np.asarray(without_similar(pairs.initial_dissimilarity(12), *random_rows(3), 1))
    known, anchors = np.arange(12) % 3 != 0, np.tile(np.arange(12), 200)[:, None]
    negative, weight = jax.device_get(jax.jit(pairs.sample_negatives)(jax.random.key(0), matrix, known, anchors))
    for anchor in range(12):
        allowed = set(np.flatnonzero(matrix[anchor] & known))
        chosen = negative[(anchors == anchor) & (weight > 0)]
        assert set(chosen.tolist()) == allowed  # All that are allowed come up in 200 draws, and no other.


def test_anchor_without_dissimilar_goals_carries_no_weight():
    draw, anchors = jax.jit(pairs.sample_negatives), np.arange(5)[:, None]
    for dissimilar, known in ((np.zeros((5, 5), bool), np.ones(5, bool)), (~np.eye(5, dtype=bool), np.zeros(5, bool))):
        _, weight = draw(jax.random.key(0), dissimilar, known, anchors)
        assert not np.asarray(weight).any()


def test_choosing_from_a_mask_is_uniform_over_its_true_entries():
    mask = jnp.asarray([False, True, False, True, True, False])
    count = np.bincount(pairs.choose_from_mask(jax.random.key(1), mask, (3000,)), minlength=6)
    assert count[~np.asarray(mask)].sum() == 0
    assert (abs(count[np.asarray(mask)] - 1000) < 150).all()  # 150 is nearly six standard deviations.


def test_choosing_among_achieved_goals_never_invents_one():
    goals, choose = np.asarray([[3, -1, 5], [-1, -1, -1], [2, -1, -1]]), jax.jit(pairs.choose_goal)
    for seed in range(20):
        chosen = np.asarray(choose(jax.random.key(seed), goals))
        assert int(chosen[0]) in (3, 5) and int(chosen[1]) == -1 and int(chosen[2]) == 2


DRAWS = {
    "bits of 8": lambda key: jax.random.bits(key, (7, 3), jnp.uint8),
    "bits of 16": lambda key: jax.random.bits(key, (7, 3), jnp.uint16),
    "bits of 32": lambda key: jax.random.bits(key, (7, 3)),
    "uniform": lambda key: jax.random.uniform(key, (5, 4), minval=-1.0),
    "normal": lambda key: jax.random.normal(key, (301,)),
    "a number": lambda key: jax.random.normal(key),
    "integers": lambda key: jax.random.randint(key, (9,), 0, 17),
    "permutation": lambda key: jax.random.permutation(key, 50),
    "choice": lambda key: jax.random.choice(key, jnp.arange(10), (4,)),
    "keys": lambda key: jax.random.key_data(jax.random.split(key, (3, 2))),
    "a folded key": lambda key: jax.random.key_data(jax.random.fold_in(key, 2**32 - 1)),
}


@pytest.fixture(scope="module")
def drawn() -> list[dict[str, np.ndarray]]:
    """What unrolled keys draw, and what jax's own draw, by the names of `DRAWS`."""

    @jax.jit
    def both(keys):
        return [{name: jax.vmap(draw)(same) for name, draw in DRAWS.items()} for same in (unrolled(keys), keys)]

    return jax.device_get(both(jax.random.split(jax.random.key(3), 4)))


@pytest.mark.parametrize("name", DRAWS)
def test_whatever_is_drawn_is_what_jax_draws(name, drawn):
    one, other = drawn
    np.testing.assert_array_equal(one[name], other[name])


def test_keys_of_other_generators_are_left_alone():
    key = jax.random.key(0, impl="rbg")
    assert unrolled(key) is key
    once = unrolled(jax.random.key(0))
    assert unrolled(once) is once
