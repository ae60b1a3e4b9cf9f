"""Our Fetch tasks follow the reference, Gymnasium-Robotics on C MuJoCo 3.3.7: its recorded episodes are replayed here,
and our resets are drawn from its distributions.

Episodes of the recording are in turn random actions, random actions held for five steps, and a script that reaches,
pushes or grasps and lifts. The faithful setting is as near as the robot's simpler shapes allow; the default is faster,
and near enough for the same behaviour.

Of resets there are 1,000 a task beside 4,000 of ours. Two-sample tests at a level of 0.001 for all coordinates of a
test together (Bonferroni): Kolmogorov and Smirnov's for the shape, and for the range, where it is blind, how many draws
of one sample lie beyond all of the other. They can fail: the last test shows what they notice. The puck of Slide is
compared in x and y alone: the reference's sinks 6.5 mm into the table and lies tilted there, ours stands on it.
"""

import functools
import json
import sys

import jax
import numpy as np
import pytest
from places import FIXTURES, ROOT
from scipy.stats import binom, ks_2samp

from infogoal_jax.envs import load
from infogoal_jax.envs.fetch.environment import NEAREST_START
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig

sys.path.insert(0, str(ROOT / "benchmarks" / "fidelity"))
import fetch_parity
from fetch_parity import ALL, Recording, Replayed, compare, distances, load_recordings, replay

RECORDINGS = FIXTURES / "fetch_gymnasium_v4.npz"
KINDS = ("random", "held", "scripted")
FAITHFUL, DEFAULT = "faithful", "default"
QUICK = (("fetch_reach", DEFAULT),)
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
FIXTURE = FIXTURES / "fetch_resets.npz"
LEVEL = 1e-3
OURS = 4000
START_TOLERANCE = 1e-4
"""Of the first observation, in its own units: m, rad, and these per step of 40 ms."""
STILL_TORSO = 2e-4
"""Of the default setting's velocities (m per step): the reference still lifts its torso at 3.3 mm/s when an episode
starts, and ours stands still."""
TASKS_WITH_OBJECT = [task.name for task in TASKS.values() if task.object_height is not None]
OBJECT, RELATIVE, FINGERS, ROTATION, VELOCITIES, OBJECT_VELOCITY, FINGER_VELOCITY = (
    slice(3, 6),
    slice(6, 9),
    slice(9, 11),
    slice(11, 14),
    slice(14, 25),
    slice(14, 20),
    slice(23, 25),
)
"""Parts of an observation of 25; of 10, the fingers are 3 to 4, and the velocities 5 to 9, the fingers' last."""

QUICK_RESETS = ("fetch_reach", "fetch_pick_and_place")
"""Without an object, and with all that the others' resets have."""
every_task, every_object = (
    pytest.mark.parametrize(
        "task", [pytest.param(task, marks=[] if task in QUICK_RESETS else pytest.mark.long) for task in tasks]
    )
    for tasks in (list(TASKS), TASKS_WITH_OBJECT)
)


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
    recordings, _ = load_recordings(RECORDINGS)

    @functools.cache
    def made(task, setting):
        env = load(task, FetchConfig(faithful=setting == FAITHFUL, ends_at_goal=False))
        return recordings[task], replay(env, recordings[task])

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


@pytest.fixture(scope="session")
def resets():
    """Goal [N, 3] and first observation [N, 10 or 25] of resets of ours (in a setting) and of the reference's, made
    when first asked for."""
    recorded = np.load(FIXTURE)

    @functools.cache
    def made(task, faithful=False):
        env = load(task, FetchConfig(faithful=faithful))
        states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(11), OURS))
        ours = np.asarray(states.desired_goal), np.asarray(states.observation)
        return ours, (recorded[f"{task}/desired_goal"], recorded[f"{task}/observation"])

    return made


def beyond(sample: np.ndarray, other: np.ndarray) -> float:
    """P-value of as many draws [N] of one sample lying above all of the other [M], if both are of one distribution
    (Rosenbaum's test, 1954).

    The k largest of N + M equal draws are all of the first sample with probability C(N, k) / C(N + M, k).
    """
    count = int((sample > other.max()).sum())
    return float(np.prod((len(sample) - np.arange(count)) / (len(sample) + len(other) - np.arange(count))))


def p_value(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Of two samples [N] and [M] being of one distribution: the least of five tests (shape, and both samples beyond
    both ends), times five."""
    ends = (
        beyond(side * first, side * second) for side in (1, -1) for first, second in ((ours, theirs), (theirs, ours))
    )
    return 5 * min(ks_2samp(ours, theirs).pvalue, *ends)


def differing(ours: np.ndarray, theirs: np.ndarray) -> dict[int, float]:
    """Columns of [N, C] and [M, C] that do not come from one distribution, with the p-value; a constant column counts
    with its distance instead."""
    # Heights on the table are equal but for rounding.
    ours, theirs = (np.round(sample.astype(float), 5) for sample in (ours, theirs))
    varying = np.flatnonzero(np.ptp(theirs, axis=0) > 0)
    apart = np.abs(ours - theirs[0]).max(axis=0)
    constant = {
        column: apart[column]
        for column in range(theirs.shape[1])
        if column not in varying and apart[column] > START_TOLERANCE
    }
    values = {column: p_value(ours[:, column], theirs[:, column]) for column in varying.tolist()}
    return constant | {column: value for column, value in values.items() if value < LEVEL / len(varying)}


@every_task
def test_goals_are_drawn_as_in_the_reference(resets, task):
    (goals, _), (their_goals, _) = resets(task)
    assert not differing(goals, their_goals)


@every_object
def test_objects_start_as_in_the_reference(resets, task):
    """x and y; and the radius around the grip, which knows of the disc where no object starts."""
    (_, first), (_, their_first) = resets(task)
    ours, theirs = first[:, OBJECT][:, :2], their_first[:, OBJECT][:, :2]
    assert not differing(ours, theirs)
    radius, their_radius = (np.linalg.norm(sample[:, RELATIVE][:, :2], axis=1) for sample in (first, their_first))
    assert min(radius.min(), their_radius.min()) >= NEAREST_START - START_TOLERANCE
    assert not differing(radius[:, None], their_radius[:, None])


@every_object
def test_objects_cover_the_square_without_the_disc_evenly_along_every_direction(resets, task):
    """x and y together: along the diagonals, and the angle around the grip."""
    (_, first), (_, their_first) = resets(task)

    def views(sample):
        x, y = sample[:, RELATIVE][:, 0], sample[:, RELATIVE][:, 1]
        return np.stack([x + y, x - y, np.arctan2(y, x), np.maximum(np.abs(x), np.abs(y))], axis=1)

    assert not differing(views(first), views(their_first))


@every_object
def test_goal_and_object_are_drawn_independently(resets, task):
    (goals, first), _ = resets(task)
    correlation = np.corrcoef(goals[:, :2].T, first[:, OBJECT][:, :2].T)
    assert np.abs(correlation - np.eye(4)).max() < 0.07  # Over four standard errors of 4,000 draws.


def test_half_of_the_goals_of_pick_and_place_are_in_the_air(resets):
    """As many as in the reference, and never below the object's height."""
    (goals, _), (their_goals, _) = resets("fetch_pick_and_place")
    height = TASKS["fetch_pick_and_place"].object_height
    for sample in (goals, their_goals):
        in_air = int((sample[:, 2] > height + 1e-4).sum())
        assert min(binom.cdf(in_air, len(sample), 0.5), binom.sf(in_air - 1, len(sample), 0.5)) > LEVEL
        assert sample[:, 2].min() > height - 1e-4
    above = [sample[sample[:, 2] > height + 1e-4, 2:] for sample in (goals, their_goals)]
    assert not differing(*above)


@pytest.mark.parametrize("faithful", [False, pytest.param(True, marks=pytest.mark.long)], ids=["default", "faithful"])
@every_task
def test_the_first_observation_is_that_of_the_reference(resets, task, faithful):
    """All that no draw decides; the fingers of the default setting are one block in tasks that keep them closed, so
    theirs read zero."""
    (_, first), (_, their_first) = resets(task, faithful)
    has_object = task in TASKS_WITH_OBJECT
    velocities, fingers, finger_velocity = (
        (VELOCITIES, FINGERS, FINGER_VELOCITY) if has_object else (slice(5, 10), slice(3, 5), slice(8, 10))
    )
    tolerance = np.full(first.shape[1], START_TOLERANCE)
    if not faithful:
        tolerance[velocities] = STILL_TORSO
    if TASKS[task].blocks_fingers and not faithful:
        tolerance[fingers] = tolerance[finger_velocity] = 2e-3
    drawn = np.ptp(their_first, axis=0) > 1e-6
    tolerance[drawn] = np.inf
    if TASKS[task].puck:
        for part in (5, 8, ROTATION, OBJECT_VELOCITY):
            tolerance[part] = np.inf
    apart = np.abs(first - their_first[0]).max(axis=0)
    assert {*np.flatnonzero(drawn).tolist()} == ({3, 4, 6, 7} if has_object else set())
    assert (apart < tolerance).all(), {int(part): float(apart[part]) for part in np.flatnonzero(apart >= tolerance)}


@every_task
def test_a_range_five_per_cent_too_small_or_too_large_would_be_noticed(resets, task):
    """The power of the tests above: our own draws, drawn together or apart by 5 % around the middle of their range, are
    told from the reference's."""
    (goals, first), (their_goals, their_first) = resets(task)
    columns = [(goals[:, :2], their_goals[:, :2])]
    if task in TASKS_WITH_OBJECT:
        columns.append((first[:, OBJECT][:, :2], their_first[:, OBJECT][:, :2]))
    for ours, theirs in columns:
        middle = (ours.min(axis=0) + ours.max(axis=0)) / 2
        for scale in (0.95, 1.05):
            assert len(differing(middle + scale * (ours - middle), theirs)) == 2


def test_errors_are_measured_in_millimetres_and_outcomes_counted():
    """Three pushes of two steps. The second is 3 mm off at the end; the third falls off here and stays on the table in
    the recording."""
    observation = np.zeros((3, 3, 25), np.float32)
    observation[..., 2], observation[..., 5] = 0.5, 0.425
    observation[1, -1, 5] = 0.5
    thing = observation[..., 3:6].copy()
    thing[1, -1] += (0.003, 0, 0)
    thing[2, -1, 2] = 0.025
    reward = np.full((3, 2), -1, np.float32)
    recording = Recording(
        "fetch_push", observation, np.zeros((3, 3), np.float32), np.zeros((3, 2, 4), np.float32), reward
    )
    replayed = Replayed(
        observation[..., :3] + np.float32([0.001, 0, 0]),
        thing,
        np.array([[-1, -1], [-1, 0], [-1, -1.0]]),
        np.zeros(3, bool),
    )
    everything, first, second = compare(recording, replayed, ("first", "second"))
    assert (everything.episodes, first.episodes, second.episodes) == (3, 2, 1)
    assert everything.grip.mean == pytest.approx(1, abs=1e-3) and everything.grip.end == pytest.approx(1, abs=1e-3)
    assert (second.thing.mean, second.thing.largest, second.thing.end) == pytest.approx((1.5, 3, 3), abs=1e-3)
    assert first.thing.end == pytest.approx(200, abs=1e-3) and first.thing.median == pytest.approx(0, abs=1e-3)
    assert (everything.fallen.recorded, everything.fallen.here, everything.fallen.both) == (0, 1, 0)
    assert (second.lifted.recorded, second.lifted.here, second.lifted.both) == (1, 1, 1)
    assert everything.equal_rewards == pytest.approx(5 / 6)


@pytest.mark.long
def test_the_command_prints_and_writes_the_distances_of_each_kind(tmp_path, monkeypatch, capsys):
    with np.load(RECORDINGS) as arrays:
        short = {name: value[:2] for name, value in arrays.items() if name.startswith("fetch_reach/")}
    np.savez(tmp_path / "short.npz", **short, source="Gymnasium-Robotics")
    arguments = [str(tmp_path / "short.npz"), "--kinds", *KINDS[:2], "--out", str(tmp_path / "out.json")]
    monkeypatch.setattr(sys, "argv", ["fetch_parity.py", *arguments])
    fetch_parity.main()
    printed = capsys.readouterr().out
    assert "recorded by Gymnasium-Robotics" in printed and "1 random" in printed and "100.0%" in printed
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["setting"] == "default"
    found = written["tasks"]["fetch_reach"]
    assert [row["episodes"] for row in found["kinds"]] == [2, 1, 1] and found["kinds"][0]["thing"] is None
    assert [row["kind"] for row in found["episodes"]] == ["random", "held"]
