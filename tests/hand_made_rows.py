"""Rows of replay small enough to go through by hand, for relabellings in hindsight."""

import jax.numpy as jnp
import numpy as np

from infogoal_jax import replay
from infogoal_jax.relabelling.relabelling import Achievements, Context
from infogoal_jax.replay import Trajectories

ROWS, STEPS, GOALS = 6, 12, 9


def rows_of(valid, achieved) -> Trajectories:
    """Rows of these valid transitions [R, T] and goals achieved [R, T + 1, K], padded with -1, which are observed too;
    goal 0 is desired."""
    valid, achieved = jnp.asarray(valid, bool), jnp.asarray(achieved, jnp.int32)
    zero, nothing = jnp.zeros(valid.shape, jnp.int32), jnp.zeros(valid.shape, bool)
    return Trajectories(achieved, achieved, zero, zero, valid, nothing, nothing, valid)


def random_rows(several: int = 1) -> Trajectories:
    """Rows of several episodes, with up to `several` different goals achieved at each step, never goal 0."""
    random = np.random.default_rng(0)
    valid = random.random((ROWS, STEPS)) < 0.85
    goals = 1 + random.random((ROWS, STEPS + 1, GOALS - 1)).argsort(-1)[..., :several]
    return rows_of(valid, np.where(random.random(goals.shape) < 0.6, goals, -1))


def context(rows: Trajectories, num_goals: int = GOALS, known=None, **changes) -> Context:
    """What a relabelling may look at of these rows, all of them written, before the first update."""
    known = jnp.ones(num_goals, bool) if known is None else known
    achieved = Achievements(
        rows.record, replay.running_count((rows.record >= 0).any(-1)), replay.steps_left(rows.valid), known
    )
    plain = {
        "rows": rows,
        "written": jnp.ones(rows.valid.shape[0], bool),
        "achievements": achieved,
        "discount": 0.9,
        "updates": 0,
        "goal_positions": jnp.arange(float(num_goals))[:, None],
        "goal_codes": None,
        "value": lambda observation, goal: jnp.zeros(goal.shape),
        "reached": lambda record, goal: (record == goal[..., None]).any(-1),
    }
    return Context(**(plain | changes))


def episodes(rows: Trajectories) -> list[tuple[int, int, int]]:
    """Row, first and last observation of each episode that has transitions."""
    found = []
    for row, valid in enumerate(np.asarray(rows.valid)):
        first = 0
        for step, going_on in enumerate([*valid, False]):
            if not going_on:
                found += [(row, first, step)] if step > first else []
                first = step + 1
    return found


def later_goals(rows: Trajectories, row: int, step: int) -> set[int]:
    """Goals achieved after this step in its episode."""
    found = set()
    while step < rows.valid.shape[1] and rows.valid[row, step]:
        step += 1
        found |= set(rows.record[row, step].tolist())
    return found - {-1}
