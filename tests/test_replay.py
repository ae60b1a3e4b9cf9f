"""The replay buffer samples uniformly and never looks across an episode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from infogoal_jax import replay
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
    return jax.tree.map(
        jnp.asarray,
        Trajectories(
            observation, observation, np.zeros((6, 25), np.int32), goal, valid, terminated, truncated, decided
        ),
    )


def sampled(key, rows: Trajectories, starts, count: int, num_steps: int) -> replay.Transitions:
    """So many transitions that start at any of these steps, bool [R, T]."""
    places = replay.draw(key, replay.running_count(starts), count, rows.valid.shape[1])
    return replay.transitions_at(rows, *places, num_steps)


def test_transitions_stay_within_their_episode_and_step_by_one(rows):
    batch = sampled(jax.random.key(0), rows, rows.valid, 2000, 3)
    taken = batch.mask.sum(1).astype(int)
    assert (taken >= 1).all()
    # Same episode: only the step has grown.
    np.testing.assert_array_equal(batch.next_observation, batch.observation + taken)
    np.testing.assert_array_equal(batch.goal, batch.observation // 1000)
    for step in range(3):
        inside = batch.mask[:, step] > 0
        np.testing.assert_array_equal(batch.records[inside, step], batch.observation[inside] + step + 1)


def test_termination_is_that_of_the_last_step_taken(rows):
    batch = sampled(jax.random.key(0), rows, rows.valid, 2000, 3)
    ends = {int(rows.observation[r, t + 1]) for r, t in zip(*np.nonzero(np.asarray(rows.terminated)), strict=True)}
    np.testing.assert_array_equal(batch.terminated, [int(last) in ends for last in batch.next_observation])
    assert batch.terminated.any() and not batch.terminated.all()


def test_short_transitions_end_an_episode_or_a_row(rows):
    batch = sampled(jax.random.key(0), rows, rows.valid, 2000, 3)
    over = rows.terminated | rows.truncated
    over = over.at[:, -1].set(rows.valid[:, -1] | over[:, -1])
    ends = {int(rows.observation[r, t + 1]) for r, t in zip(*np.nonzero(np.asarray(over)), strict=True)}
    for last in np.asarray(batch.next_observation)[np.asarray(batch.mask.sum(1)) < 3]:
        assert int(last) in ends


def test_first_steps_are_uniform_over_all_valid_transitions(rows):
    batch = sampled(jax.random.key(2), rows, rows.valid, 20_000, 1)
    valid_starts = np.asarray(rows.observation[:, :-1])[np.asarray(rows.valid)]
    count = np.array([(np.asarray(batch.observation) == start).sum() for start in valid_starts])
    assert count.sum() == 20_000  # Nothing but valid transitions.
    assert scipy.stats.chisquare(count).pvalue > 1e-6


def test_transitions_of_an_agent_that_decides_now_and_then_start_at_its_decisions(rows):
    batch = sampled(jax.random.key(3), rows, rows.valid & rows.decided, 20_000, 3)
    decisions = np.asarray(rows.observation[:, :-1])[np.asarray(rows.valid & rows.decided)]
    count = np.array([(np.asarray(batch.observation) == start).sum() for start in decisions])
    assert count.sum() == 20_000 and (batch.observation % 1000 % 3 == 0).all()
    assert scipy.stats.chisquare(count).pvalue > 1e-6
    whole = batch.mask.sum(1) == 3
    assert (batch.next_observation[whole] % 1000 % 3 == 0).all()  # A whole interval leads to the next decision.
    assert (batch.mask.sum(1)[batch.terminated] < 3).any()  # Some episodes end within an interval.


@pytest.mark.parametrize("window", [0, 1, 5])
def test_pairs_lie_within_the_window_of_one_episode(rows, window):
    achieved = rows.observation % 3 != 0
    first, second = replay.sample_within_window(
        jax.random.key(0), rows, achieved, replay.running_count(achieved), 3000, window
    )
    np.testing.assert_array_equal(first // 1000, second // 1000)
    lag = np.asarray(second - first)
    assert abs(lag).max() <= window and (lag.min() < 0 < lag.max() or window == 0)
    assert (first % 3 != 0).all() and (second % 3 != 0).all()


def test_new_rows_replace_the_oldest(rows):
    buffer = replay.empty(rows, 2)
    assert not buffer.valid.any()
    for epoch in range(3):
        buffer = replay.add(buffer, rows.replace(goal=jnp.full_like(rows.goal, epoch)), epoch)
    np.testing.assert_array_equal(np.unique(buffer.goal[:6]), [2])
    np.testing.assert_array_equal(np.unique(buffer.goal[6:]), [1])
