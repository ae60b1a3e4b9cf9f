"""Our Fetch tasks follow the reference: recorded episodes of Gymnasium-Robotics on C MuJoCo 3.3.7, replayed here.

Episodes of the recording are in turn random actions, random actions held for five steps, and a script that reaches,
pushes or grasps and lifts. The faithful setting is as near as the robot's simpler shapes allow; the default is faster,
and near enough for the same behaviour.
"""

import functools

import numpy as np
import pytest
from places import FIXTURES

from infogoal_jax.envs import load
from infogoal_jax.envs.fetch.parity import ALL, compare, distances, replay
from infogoal_jax.envs.fetch.recordings import load_recordings
from infogoal_jax.envs.fetch.tasks import FetchConfig

RECORDINGS = FIXTURES / "fetch_gymnasium_v4.npz"
KINDS = ("random", "held", "scripted")
FAITHFUL, DEFAULT = "faithful", "default"
QUICK = (("fetch_reach", DEFAULT), ("fetch_reach", FAITHFUL))
"""Each replay compiles for 20 to 50 seconds; the others are long tests."""
GRIP_LIMITS = {
    ("fetch_reach", FAITHFUL): {"random": 1.0, "held": 4.0, "scripted": 1.0},
    ("fetch_push", FAITHFUL): {"random": 2.0, "held": 4.0, "scripted": 2.0},
    ("fetch_pick_and_place", FAITHFUL): {"random": 1.0, "held": 4.0, "scripted": 1.0},
    ("fetch_reach", DEFAULT): {"random": 5.0, "scripted": 5.0},
    ("fetch_push", DEFAULT): {"random": 5.0, "scripted": 5.0},
    ("fetch_pick_and_place", DEFAULT): {"random": 5.0, "scripted": 5.0},
}
"""Mean distance of the grip from where it was recorded, at most, in mm."""
LIFTED_LIMIT, PUSHED_LIMITS = 5.0, {FAITHFUL: 20.0, DEFAULT: 30.0}
"""How far an object may end from where it was recorded, in mm: after being lifted, and after being pushed over the
table."""


def cases(*tasks: str):
    """Every setting of the tasks, as parameters of a test."""
    pairs = [pair for pair in GRIP_LIMITS if pair[0] in tasks]
    marked = [
        pytest.param(*pair, marks=[] if pair in QUICK else pytest.mark.long, id=f"{pair[0]}-{pair[1]}")
        for pair in pairs
    ]
    return pytest.mark.parametrize(("task", "setting"), marked)


@pytest.fixture(scope="session")
def replayed():
    """The recording of a task and its replay in a setting, made when first asked for."""
    recordings = load_recordings(RECORDINGS)

    @functools.cache
    def made(task, setting):
        env = load(task, FetchConfig(faithful=setting == FAITHFUL, ends_at_goal=False))
        return recordings.tasks[task], replay(env, recordings.tasks[task])

    return made


def by_kind(pair):
    """The comparison of each kind of episode."""
    return {row.kind: row for row in compare(*pair, KINDS)}


@cases("fetch_reach", "fetch_push", "fetch_pick_and_place")
def test_the_grip_follows_the_recording(replayed, task, setting):
    rows = by_kind(replayed(task, setting))
    limits = GRIP_LIMITS[task, setting]
    too_far = {
        kind: (round(rows[kind].grip.mean, 2), limit) for kind, limit in limits.items() if rows[kind].grip.mean > limit
    }
    assert not too_far, f"mean error and limit in mm: {too_far}"
    assert rows[ALL].grip.start < 0.1
    assert rows[ALL].diverged == 0


@cases("fetch_reach", "fetch_push", "fetch_pick_and_place")
def test_rewards_are_those_recorded(replayed, task, setting):
    recording, here = replayed(task, setting)
    if (
        task != "fetch_push"
    ):  # Its script pushes past the goal: nothing is reached in the recording, and nothing may be here.
        assert {*np.unique(recording.reward).tolist()} == {-1.0, 0.0}
    assert by_kind((recording, here))[ALL].equal_rewards >= 0.99


@cases("fetch_push")
def test_objects_pushed_over_the_edge_fall_and_no_others(replayed, task, setting):
    rows = by_kind(replayed(task, setting))
    assert rows["scripted"].fallen.recorded > 0
    for row in rows.values():
        assert row.fallen.recorded == row.fallen.here == row.fallen.both


@cases("fetch_pick_and_place")
def test_scripted_lifts_succeed_and_end_where_they_were_recorded(replayed, task, setting):
    recording, here = replayed(task, setting)
    lifted = by_kind((recording, here))["scripted"].lifted
    assert lifted.recorded == lifted.here == lifted.both == len(recording.action[2::3])
    assert distances(here.thing, recording.thing)[2::3, -1].max() <= LIFTED_LIMIT


@cases("fetch_push")
def test_scripted_pushes_end_near_where_they_were_recorded(replayed, task, setting):
    """Those that stay on the table, or are just tipping over its edge; what has fallen lands anywhere
    (benchmarks/fidelity/fetch_chaos.py)."""
    recording, here = replayed(task, setting)
    stays = recording.thing[2::3, -1, 2] > 0.3
    assert stays.any()
    assert distances(here.thing, recording.thing)[2::3, -1][stays].max() <= PUSHED_LIMITS[setting]
