"""Relabelling by indices: a goal achieved later in the same episode, the right reward, nothing across an episode's end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import hindsight, replay
from infogoal_jax.errors import UserError
from infogoal_jax.hindsight.her import HERConfig
from infogoal_jax.hindsight.relabelling import Achievements
from infogoal_jax.replay import Rows

ROWS, STEPS, GOALS, DRAWS = 6, 12, 9, 4000


@pytest.fixture(scope="module")
def rows() -> Rows:
    """Rows of several episodes; the record of a step is the goal achieved there, -1 for none; the commanded goal is 0."""
    random = np.random.default_rng(0)
    valid = random.random((ROWS, STEPS)) < 0.85
    record = np.where(random.random((ROWS, STEPS + 1)) < 0.6, random.integers(1, GOALS, (ROWS, STEPS + 1)), -1)
    parts = {"observation": record, "record": record, "action": np.zeros((ROWS, STEPS), int), "goal": np.zeros((ROWS, STEPS), int)}
    nothing = np.zeros((ROWS, STEPS), bool)
    return Rows(**{name: jnp.asarray(part, jnp.int32) for name, part in parts.items()}, valid=jnp.asarray(valid), terminated=jnp.asarray(nothing),
                truncated=jnp.asarray(nothing), decided=jnp.asarray(valid))


def relabelled(rows: Rows, config: HERConfig, known=None):
    """Draws of transitions and the goals that they are given."""
    goals = rows.record[..., None]
    known = jnp.ones(GOALS, bool) if known is None else known
    achievements = Achievements(goals, replay.running_count(goals[..., 0] >= 0), replay.steps_left(rows.valid), known)
    row, step = replay.draw(jax.random.key(0), replay.running_count(rows.valid), DRAWS, STEPS)
    goal = hindsight.entry("her").make(config).relabel(jax.random.key(1), achievements, row, step, rows.goal[row, step])
    return np.asarray(row), np.asarray(step), np.asarray(goal)


def later_goals(rows: Rows, row: int, step: int) -> set[int]:
    """Goals achieved after this step in its episode, by hand."""
    found = set()
    while step < STEPS and rows.valid[row, step]:
        step += 1
        found.add(int(rows.record[row, step]))
    return found - {-1}


def test_goals_are_achieved_later_in_the_same_episode(rows):
    """With a share of 1 every goal was achieved later, every such goal comes up, and where there is none the goal stays."""
    row, step, goal = relabelled(rows, HERConfig(future_share=1.0))
    drawn: dict[tuple[int, int], set[int]] = {}
    for r, t, g in zip(row.tolist(), step.tolist(), goal.tolist(), strict=True):
        drawn.setdefault((r, t), set()).add(g)
    for (r, t), goals in drawn.items():
        assert goals == (later_goals(rows, r, t) or {0})
    assert any(goals == {0} for goals in drawn.values()) and any(len(goals) > 2 for goals in drawn.values())


def test_shares(rows):
    """Shares of the kinds of goals are those asked for; random goals are known ones."""
    known = jnp.zeros(GOALS, bool).at[8].set(True)
    goal = relabelled(rows, HERConfig(future_share=0.0, random_share=0.3), known)[2]
    np.testing.assert_allclose((goal == 8).mean(), 0.3, atol=0.03)
    assert set(goal.tolist()) == {0, 8}
    assert set(relabelled(rows, HERConfig(future_share=0.0))[2].tolist()) == {0}


def test_relabelled_transitions_end_at_the_first_hit(rows):
    """A relabelled transition ends, with reward 1, where its goal is first achieved; otherwise with its episode or after n steps."""
    row, step, goal = relabelled(rows, HERConfig(future_share=1.0))
    batch = replay.transitions_at(rows, row, step, 3, jnp.asarray(goal), lambda record, wanted: record == wanted)
    for i in range(300):
        taken = 0
        for offset in range(3):
            if step[i] + offset >= STEPS or not rows.valid[row[i], step[i] + offset]:
                break
            taken += 1
            if rows.record[row[i], step[i] + offset + 1] == goal[i]:
                break
        hit = bool(rows.record[row[i], step[i] + taken] == goal[i])
        assert int(batch.mask[i].sum()) == taken and bool(batch.terminated[i]) == hit
        assert int(batch.next_observation[i]) == int(rows.observation[row[i], step[i] + taken])
    assert batch.terminated.any() and not batch.terminated.all()


@pytest.mark.parametrize("fields", [{"future_share": 1.2}, {"random_share": -0.1}, {"future_share": 0.8, "random_share": 0.3}])
def test_shares_that_cannot_be(fields):
    """Shares beyond 1, or below 0, name their field."""
    with pytest.raises(UserError, match=r"hindsight\.(future|random)_share"):
        HERConfig(**fields).check(None)
