"""GHRL gives an episode the goal that it reached better than other episodes did."""

import dataclasses
import functools

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import places
import pytest
from hand_made import GOALS, ROWS, STEPS, context, episodes, random_rows, rows_of

from infogoal_jax.errors import UserError
from infogoal_jax.relabelling import ghrl

RECORDED = places.recorded("ghrl")
A, B = 1, 2


def percentiles(returns: jax.Array) -> jax.Array:
    """The authors' ranks of N trajectories by their returns for each of G tasks, 0 for the lowest: [N, G]. Equal
    returns are ranked by their order."""
    return returns.argsort(axis=0, stable=True).argsort(axis=0)


def choose_task(ranks: jax.Array, preference: jax.Array) -> jax.Array:
    """The task in which each trajectory ranks highest, [N]; of equal ranks that of the largest preference (return or
    advantage), then the first."""
    return jnp.where(ranks == ranks.max(1, keepdims=True), preference, -jnp.inf).argmax(1)


def test_ranks_and_choices_are_those_of_the_public_code():
    """Returns without equals, and sparse ones ranked by a stable sort; equal ranks settled by return, and by
    advantage."""
    for case in ("dense", "sparse"):
        returns, baselines = (jnp.asarray(RECORDED[f"{case}_{name}"], jnp.float32) for name in ("returns", "baselines"))
        ranks = percentiles(returns)
        np.testing.assert_array_equal(ranks, RECORDED[f"{case}_ranks"])
        np.testing.assert_array_equal(choose_task(ranks, returns), RECORDED[f"{case}_chosen"])
        np.testing.assert_array_equal(choose_task(ranks, returns - baselines), RECORDED[f"{case}_chosen_by_advantage"])
    returns = jnp.asarray(RECORDED["cache_returns"], jnp.float32)
    np.testing.assert_array_equal(percentiles(returns), RECORDED["cache_ranks"])
    tasks = RECORDED["cache_candidates"]  # Tasks of the columns, some of them twice.
    np.testing.assert_array_equal(tasks[choose_task(percentiles(returns), returns)[:8]], RECORDED["cache_chosen"])


def achieved_at(*rows: dict[int, int], steps: int = 10):
    """Rows of one episode each that achieve these goals at these steps; several goals at once have places of their
    own."""
    achieved = np.full((len(rows), steps + 1, 4), -1)
    for row, hits in enumerate(rows):
        for step, goal in hits.items():
            achieved[row, step, goal] = goal
    return rows_of(np.ones((len(rows), steps)), achieved)


@functools.partial(jax.jit, static_argnames="reached")
def best_goals(rows, **changes):
    """The table of these rows, compiled whole, once for rows of one shape."""
    return ghrl.best_goals(context(rows, **changes))


def test_an_episode_is_given_the_goal_that_it_reached_better_than_others():
    """The first reaches A sooner than all others and B later than all others: it is given A, though it reached B
    first."""
    rows = achieved_at({3: B, 6: A}, {2: B, 8: A}, {1: B, 9: A})
    table = best_goals(rows)
    assert table.goal[:, 0].tolist() == [A, B, B]
    assert table.hit[:, 0].tolist() == [6, 2, 1]


def test_equal_ranks_go_to_the_sooner_goal_then_to_the_first():
    assert best_goals(achieved_at({4: A, 2: B}, {5: A, 3: B})).goal[0, 0] == B
    both = achieved_at({4: A}, {5: A})
    both = both.replace(record=both.record.at[0, 4, B].set(B).at[1, 5, B].set(B))
    assert best_goals(both).goal[0, 0] == A


def test_equal_returns_do_not_hang_on_the_order_of_rows():
    """Where the public code ranks equals by their order, one of two equal episodes would beat the other."""
    one, other = {3: A, 4: B}, {2: A, 7: B}
    for rows in ((one, one, other), (other, one, one), (one, other, one)):
        chosen = best_goals(achieved_at(*rows)).goal[:, 0].tolist()
        assert chosen == [B if row is one else A for row in rows]


def by_hand(rows) -> tuple[np.ndarray, np.ndarray]:
    """Goal and hit of each step by going through the episodes: as `best_goals` says, written as loops."""
    found = episodes(rows)
    delays = [{} for _ in found]
    for (row, first, last), delay in zip(found, delays, strict=True):
        for step in range(last, first, -1):
            delay |= {
                int(goal): step - first
                for goal in rows.record[row, step]
                if goal >= 0 and goal not in rows.record[row, first]
            }
    goals, hits = np.full((ROWS, STEPS + 1), -1), np.full((ROWS, STEPS + 1), -1)
    for (row, first, last), delay in zip(found, delays, strict=True):
        if delay:
            rank = {goal: sum(other.get(goal, np.inf) > delay[goal] for other in delays) for goal in delay}
            goal = max(delay, key=lambda goal: (rank[goal], -delay[goal], -goal))
            goals[row, first : last + 1], hits[row, first : last + 1] = goal, first + delay[goal]
    return goals, hits


@pytest.mark.parametrize("several", [1, 3])
def test_rows_of_several_episodes_by_hand(several):
    rows = random_rows(several)
    table, (goals, hits) = best_goals(rows), by_hand(rows)
    np.testing.assert_array_equal(table.goal, goals)
    np.testing.assert_array_equal(table.hit, hits)
    assert (goals < 0).any() and len(set(goals.ravel().tolist())) > 3


def test_a_goal_that_held_at_the_start_was_not_reached():
    """Kept from the start it would be the fastest of all, and would teach nothing."""
    table = best_goals(rows_of(np.ones((2, 3)), [[[4], [4], [5], [4]], [[4], [4], [4], [4]]]))
    np.testing.assert_array_equal(table.goal, [[5] * 4, [-1] * 4])
    np.testing.assert_array_equal(table.hit, [[2] * 4, [-1] * 4])


def test_the_environment_says_when_a_goal_was_reached():
    """It may do so before the record is nearest to the goal: here a goal counts as reached from the one before it
    on."""
    rows = rows_of(np.ones((1, 4)), [[[1], [2], [3], [4], [5]]])
    table = best_goals(
        rows, reached=lambda record, goal: ((record == goal[..., None]) | (record == goal[..., None] - 1)).any(-1)
    )
    assert table.goal[0, 0] == 3 and (table.hit == 1).all()  # 2 held at the start by this judgement.


def test_agrees_with_the_public_rule_where_no_two_returns_are_equal():
    """Of the goals that were reached, that which `percentiles` and `choose_task` choose from the whole matrix of
    returns."""
    random, count, discount = np.random.default_rng(3), 10, 0.9
    # [episodes, goals], different for each goal.
    delay = np.stack([random.permutation(count) + 1 for _ in range(GOALS)], axis=1)
    delay[random.random(delay.shape) < 0.4] = 0  # Never reached.
    achieved = np.full((count, count + 1, GOALS), -1)
    for row, goal in zip(*np.nonzero(delay), strict=True):
        again = random.random(count + 1) < 0.5
        achieved[
            row, (np.arange(count + 1) == delay[row, goal]) | (again & (np.arange(count + 1) > delay[row, goal])), goal
        ] = goal
    returns = jnp.asarray(np.where(delay > 0, discount ** (delay - 1.0), 0.0), jnp.float32)
    ranks = jnp.where(delay > 0, percentiles(returns), -1)
    table = best_goals(rows_of(np.ones((count, count)), achieved))
    np.testing.assert_array_equal(table.goal[:, 0], choose_task(ranks, returns))


def test_what_was_achieved_at_the_start_or_was_not_written_does_not_count():
    """No transition led to a start; and rows not written yet hold no episodes, or A would be nothing special in the
    first row."""
    rows = achieved_at({0: B}, {3: B, 6: A}, {2: B, 5: A}, {1: A})
    assert best_goals(rows).goal[:, 0].tolist() == [-1, B, B, A]
    table = best_goals(rows, written=jnp.asarray([True, True, False, False]))
    assert table.goal[:, 0].tolist() == [-1, B, -1, -1]


def relabelled(config, rows, row, step, **changes):
    """Goals that 1,000 transitions at this place are given, under the desired goal 0."""
    relabelling, places = ghrl.make(config), (jnp.full(1000, row), jnp.full(1000, step), jnp.zeros(1000, jnp.int32))
    return np.asarray(
        jax.jit(
            lambda: relabelling.relabel(jax.random.key(0), relabelling.prepare(context(rows, **changes)), *places)
        )()
    )


@pytest.mark.long
def test_share_of_the_transitions_before_the_hit():
    """Half of them by default; what comes after the goal was reached, and an episode that reached nothing, keep their
    goals."""
    rows = achieved_at({4: A, 8: A}, {})
    np.testing.assert_allclose((relabelled(ghrl.GHRLConfig(choice="best"), rows, 0, 3) == A).mean(), 0.5, atol=0.06)
    assert (relabelled(ghrl.GHRLConfig(share=1.0, choice="best"), rows, 0, 3) == A).all()
    assert (relabelled(ghrl.GHRLConfig(share=1.0, choice="best"), rows, 0, 4) == 0).all()
    assert (relabelled(ghrl.GHRLConfig(share=1.0, choice="best"), rows, 1, 0) == 0).all()
    known = jnp.zeros(GOALS, bool).at[8].set(True)
    goals = relabelled(ghrl.GHRLConfig(share=0.5, random_share=0.2, choice="best"), rows, 0, 3, known=known)
    np.testing.assert_allclose([(goals == goal).mean() for goal in (A, 8, 0)], [0.5, 0.2, 0.3], atol=0.06)


@pytest.mark.parametrize("several", [pytest.param(1, marks=pytest.mark.long), 3])
def test_first_occurrences_are_given_to_what_lies_before_them(several):
    """`first_occurrence`: each goal of the episode is equally likely, and a transition that comes after its first
    occurrence keeps its own, even if the goal is achieved again."""
    rows, times = random_rows(several), 2000
    relabelling = ghrl.make(ghrl.GHRLConfig(share=1.0, choice="first_occurrence"))
    places = [(row, step, first, last) for row, first, last in episodes(rows) for step in range(first, last)]
    row, step = (np.repeat(column, times).astype(np.int32) for column in list(zip(*places, strict=True))[:2])

    @jax.jit
    def relabel(rows, row, step):
        table = relabelling.prepare(context(rows))
        return relabelling.relabel(jax.random.key(2), table, row, step, jnp.zeros_like(row))

    drawn = np.asarray(relabel(rows, row, step))
    rows = jax.tree.map(np.asarray, rows)
    for (r, t, first, last), goals in zip(places, drawn.reshape(-1, times), strict=True):
        begin, expected = {}, np.zeros(GOALS)
        for when in range(first, last + 1):
            for goal in rows.record[r, when][rows.record[r, when] >= 0]:
                begin.setdefault(int(goal), when)
        for goal, when in begin.items():
            expected[goal if when > t else 0] += 1 / len(begin)
        expected[0] += not begin
        np.testing.assert_allclose(np.bincount(goals, minlength=GOALS) / times, expected, atol=0.06)


@pytest.mark.parametrize(("value", "passes"), [(0.9**3 - 0.01, True), (0.9**3 + 0.01, False)])
def test_filter_accepts_what_is_no_worse_than_the_policy(value, passes):
    """A goal reached by the fourth transition is worth discount^3; the value asked for is that of the episode's start
    and goal alone."""
    rows = achieved_at({4: A})
    rows = rows.replace(observation=jnp.arange(11)[None])

    def of_start(observation, goal):
        return jnp.where((observation == 0) & (goal == A), value, 7.0 * (-1.0 if passes is False else 1.0))

    goals = relabelled(ghrl.GHRLConfig(share=1.0, choice="best", filter="advantage"), rows, 0, 2, value=of_start)
    assert (goals == (A if passes else 0)).all()


@pytest.mark.long
def test_filter_goes_through_all_episodes(monkeypatch):
    """A few at a time, in rows of several: each is with_rewards by its own value."""
    monkeypatch.setattr(ghrl, "VALUES_AT_ONCE", 4)
    rows = random_rows(2)
    rows = rows.replace(observation=jnp.arange(ROWS * (STEPS + 1)).reshape(ROWS, STEPS + 1))
    threshold = np.random.default_rng(5).uniform(0.8, 1.1, (rows.observation.size, GOALS)).astype(np.float32)
    seen = context(rows, value=lambda observation, goal: jnp.asarray(threshold)[observation, goal])
    table = ghrl.best_goals(seen)
    passed, with_rewards = np.asarray(jax.jit(lambda: ghrl.accepted(seen, table))()), []
    for row, first, _ in episodes(rows):
        goal, hit = int(table.goal[row, first]), int(table.hit[row, first])
        expected = goal >= 0 and 0.9 ** (hit - first - 1) >= threshold[rows.observation[row, first], goal]
        assert passed[row, first] == expected
        with_rewards.append(expected)
    assert any(with_rewards) and not all(with_rewards) and len(with_rewards) > 8


def test_a_filter_goes_with_the_best_choice_alone():
    with pytest.raises(UserError, match="relabelling.filter = 'advantage'"):
        dataclasses.replace(hand_made.config(), relabelling=ghrl.GHRLConfig(filter="advantage"))
