"""Relabelling in hindsight: goals are achieved later in the same episode, and rewards follow from them, whichever
method chooses them."""

import dataclasses
from collections import Counter
from types import SimpleNamespace

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made import GOALS, STEPS, context, episodes, later_goals, random_rows, rows_of

from infogoal_jax import make_train, pairs, replay
from infogoal_jax import relabelling as relabellings
from infogoal_jax.errors import UserError
from infogoal_jax.learners.gcb import GCBConfig
from infogoal_jax.relabelling.cher import CHERConfig
from infogoal_jax.relabelling.ghrl import GHRLConfig
from infogoal_jax.relabelling.her import HERConfig, any_known, soon
from infogoal_jax.relabelling.mixed import MixedConfig
from infogoal_jax.relabelling.relabelling import Relabelling, Waypoints
from infogoal_jax.replay import Trajectories
from infogoal_jax.train import costs, experience, parts, update
from infogoal_jax.train.relabelled import with_relabelled_goals

DRAWS = 4000
ONE_UPDATE = {"num_epochs": 1, "epochs_per_evaluation": 1, "updates_per_epoch": 1}
ALWAYS = [
    ("her", HERConfig(future_share=1.0)),
    pytest.param("her", HERConfig(future_share=1.0, strategy="prefix"), marks=pytest.mark.long),
    ("cher", CHERConfig(future_share=1.0)),
    pytest.param("ghrl", GHRLConfig(share=1.0), marks=pytest.mark.long),
    ("ghrl", GHRLConfig(share=1.0, choice="best")),
]


@pytest.fixture(scope="module")
def rows() -> Trajectories:
    return random_rows()


def relabelled(rows: Trajectories, config, known=None, name: str = "her"):
    """Draws of transitions and the goals that they are given."""
    relabelling = relabellings.registry.entry(name).make(config)

    @jax.jit
    def drawn(rows, known):
        row, step = replay.draw(jax.random.key(0), replay.running_count(rows.valid), DRAWS, STEPS)
        table = relabelling.prepare(context(rows, known=known))
        return row, step, relabelling.relabel(jax.random.key(1), table, row, step, rows.desired_goal[row, step])

    return [np.asarray(part) for part in drawn(rows, known)]


@jax.jit
def three_steps(rows, row, step, goal):
    """The transitions of three steps that start there, under these goals."""
    return replay.transitions_at(rows, row, step, 3, goal, lambda record, wanted: (record == wanted[..., None]).any(-1))


def test_goals_are_achieved_later_in_the_same_episode(rows):
    """With a share of 1 every goal was achieved later, every such goal comes up, and where there is none the goal
    stays."""
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
    # Before anything is known goals stay: the last of all, which could be one of the test, would come up instead.
    nothing, own = pairs.KnownGoals(jnp.zeros(GOALS, bool)), jnp.arange(5)
    np.testing.assert_array_equal(any_known(jax.random.key(0), nothing, own), own)


@pytest.mark.parametrize(("name", "config"), ALWAYS)
@pytest.mark.parametrize("several", [pytest.param(1, marks=pytest.mark.long), 3])
def test_relabelled_transitions_end_at_the_first_hit(name, config, several):
    """A relabelled transition ends, with reward 1, where its goal is first achieved; otherwise with its episode or
    after n steps."""
    rows = random_rows(several)
    row, step, goal = relabelled(rows, config, name=name)
    rows, batch = jax.tree.map(np.asarray, (rows, three_steps(rows, row, step, goal)))
    first = batch.observation
    for i in range(300):
        assert goal[i] == 0 or goal[i] in later_goals(rows, row[i], step[i])
        taken, hit = 0, False
        while taken < 3 and not hit and step[i] + taken < STEPS and rows.valid[row[i], step[i] + taken]:
            taken += 1
            hit = goal[i] in rows.record[row[i], step[i] + taken]
        assert int(batch.mask[i].sum()) == taken and bool(batch.terminated[i]) == hit
        assert (first[i] == rows.observation[row[i], step[i]]).all()
        assert (batch.next_observation[i] == rows.observation[row[i], step[i] + taken]).all()
    assert batch.terminated.any() and not batch.terminated.all() and (several > 1 or (goal == 0).any())


@pytest.mark.parametrize("several", [pytest.param(1, marks=pytest.mark.long), 2])
def test_prefixes_come_up_as_often_as_they_should(several):
    """Each goal of an episode is equally likely, then each of its occurrences; only what lies before that occurrence is
    given the goal."""
    rows, times = random_rows(several), 3000
    relabelling = relabellings.registry.entry("her").make(HERConfig(future_share=1.0, strategy="prefix"))
    places = [(row, step, first, last) for row, first, last in episodes(rows) for step in range(first, last)]
    row, step = (jnp.repeat(jnp.asarray(column), times) for column in list(zip(*places, strict=True))[:2])
    relabel = jax.jit(
        lambda rows: relabelling.relabel(
            jax.random.key(2), relabelling.prepare(context(rows)), row, step, jnp.zeros_like(row)
        )
    )
    drawn = np.asarray(relabel(rows)).reshape(-1, times)
    rows = jax.tree.map(np.asarray, rows)
    for (r, t, first, last), goals in zip(places, drawn, strict=True):
        found = [(when, int(goal)) for when in range(first, last + 1) for goal in rows.record[r, when] if goal >= 0]
        counts, expected = Counter(goal for _, goal in found), np.zeros(GOALS)
        for when, goal in found:
            expected[goal if when > t else 0] += 1 / len(counts) / counts[goal]
        expected[0] += not found
        np.testing.assert_allclose(np.bincount(goals, minlength=GOALS) / times, expected, atol=0.05)


def test_a_goal_that_stays_in_view_is_no_likelier_than_one_seen_once():
    """What sets `prefix` apart: goal 1 is achieved at nine steps, goal 2 at the last; from the first step `future`
    draws goal 2 once in ten times."""
    rows = rows_of(np.ones((1, 10)), np.array([[-1, *[1] * 9, 2]])[..., None])
    shares, start = {}, jnp.zeros(2000, jnp.int32)
    for strategy in ("future", "prefix"):
        relabelling = relabellings.registry.entry("her").make(HERConfig(future_share=1.0, strategy=strategy))
        relabel = jax.jit(
            lambda rows, made=relabelling: made.relabel(
                jax.random.key(0), made.prepare(context(rows)), start, start, start
            )
        )
        shares[strategy] = float((np.asarray(relabel(rows)) == 2).mean())
    np.testing.assert_allclose([shares["future"], shares["prefix"]], [0.1, 0.5], atol=0.05)


def test_rows_too_long_for_the_prefixes_name_the_remedy():
    """Steps, episodes and goals are sorted by one number of 31 bits; more do not fit, and nothing is sorted wrongly in
    silence."""
    rows = rows_of(np.ones((1, 600)), np.full((1, 601, 1), -1))
    relabelling = relabellings.registry.entry("her").make(HERConfig(strategy="prefix"))
    jax.eval_shape(lambda rows: relabelling.prepare(context(rows, num_goals=5000)), rows)
    with pytest.raises(UserError, match=r"rollout_steps = 600"):
        relabelling.prepare(context(rows, num_goals=6000))


@pytest.mark.parametrize("config", [HERConfig(future_share=0.8, random_share=0.3), GHRLConfig(random_share=0.6)])
def test_shares_of_more_than_all_are_named(config):
    with pytest.raises(UserError, match="relabelling.random_share"):
        dataclasses.replace(hand_made.config(), relabelling=config)


@pytest.mark.long
def test_a_learner_sees_in_hindsight_what_the_agent_learns_from_as_it_is():
    """The learner's loss is given the same steps under goals achieved later, with the environment's rewards for them;
    the agent's draws stay."""
    env, drawn = hand_made.environment(), {}
    plain, train = (
        make_train(hand_made.config("gcb", **ONE_UPDATE, learner=GCBConfig(relabelled_share=share)), env)
        for share in (0.0, 1.0)
    )
    hyper = train.config.hyper
    state = jax.jit(lambda key: train.chunk(train.initial(key, hyper, env), jnp.arange(1), hyper, env)[0])(
        jax.random.key(0)
    )
    for share, made in ((0.0, plain), (1.0, train)):
        draw = jax.jit(
            lambda state, made=made: update.sample(
                made.setup(), experience.make_experience(made.setup(), state, 0)[0], jax.random.key(1)
            )
        )
        drawn[share] = draw(state)
    plain, told = drawn[0.0], drawn[1.0].relabelled
    assert plain.relabelled is None
    jax.tree.map(np.testing.assert_array_equal, plain.transitions, drawn[1.0].transitions)
    changed = np.asarray(told.desired_goal != plain.transitions.desired_goal)
    assert changed.mean() > 0.3 and told.terminated.sum() > plain.transitions.terminated.sum()
    np.testing.assert_array_equal(told.terminated, (told.external * told.mask).any(1))

    features = jnp.ones((len(told.desired_goal), 4))
    codes = SimpleNamespace(features=features, next_features=2 * features, reward=None, discount=None)
    learned = jax.jit(lambda params, drawn: update.steps_to_learn_from(train.setup(), params, drawn, codes))
    goal, steps = learned(state.params, drawn[1.0])
    np.testing.assert_array_equal(goal, told.desired_goal)
    taken = np.asarray(told.mask.sum(1))
    reward = np.where(told.terminated, 0.98 ** (taken - 1), 0.0)  # 1 at the last step, which reached the goal.
    np.testing.assert_allclose(steps.reward, reward, rtol=1e-5)
    np.testing.assert_allclose(steps.discount, np.where(told.terminated, 0.0, 0.98**taken), rtol=1e-5)
    seen = jax.jit(lambda params: parts.encode_states(train.setup(), params, 1)(told.next_observation))(state.params)
    np.testing.assert_allclose(steps.next_features, seen, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(steps.features, features)


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("cher", {}),
        ("ghrl", {}),
        ("ghrl", {"relabelling": GHRLConfig(choice="best", filter="advantage")}),
        ("infogoal", {"relabelling": "her"}),
    ],
)
def test_training_goes_through(method, changes):
    """One epoch under each relabelling, from names of the presets: everything stays finite, and relabelled goals are
    reached."""
    train = make_train(
        hand_made.config(method, num_epochs=1, epochs_per_evaluation=1, **changes), hand_made.environment()
    )
    result = jax.jit(train)(jax.random.key(0))
    for name, values in {**result.metrics, **result.epochs}.items():
        assert np.isfinite(values).all(), name
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result.params))
    assert result.epochs["agent/external_reward"] > 0


def test_soon_is_geometric_and_cut_off():
    before, until = jnp.zeros(20_000, jnp.int32), jnp.full(20_000, 5, jnp.int32)
    drawn = np.asarray(soon(jnp.float32(0.5))(jax.random.key(1), before, until))
    shares = np.bincount(drawn, minlength=5) / len(drawn)
    np.testing.assert_allclose(shares, 0.5 ** np.arange(5) / (0.5 ** np.arange(5)).sum(), atol=0.02)


def test_goals_reached_before_a_transition_can_be_left_out():
    """A cube that lies at 0 for two steps is moved to 1: the goal 0 says nothing about the first steps, 1 does."""
    record = jnp.array([[[0.0], [0.0], [1.0]]])
    drawn, desired = jnp.array([[0.0], [1.0], [0.0]]), jnp.full((1, 2, 1), 5.0)
    env = SimpleNamespace(reached=lambda record, goal: jnp.abs(record - goal)[..., 0] < 0.1)
    experience = SimpleNamespace(buffer=SimpleNamespace(record=record, desired_goal=desired), relabelling=None)
    row, step = jnp.zeros(3, jnp.int32), jnp.array([0, 0, 1], jnp.int32)
    for skip, expected in ((False, [0.0, 1.0, 0.0]), (True, [5.0, 1.0, 5.0])):
        relabelling = Relabelling(None, lambda *_: drawn, skip_reached=skip)
        setup = parts.Setup(SimpleNamespace(relabelling=relabelling), None, env)
        given = with_relabelled_goals(setup, experience, jax.random.key(0), row, step)
        np.testing.assert_array_equal(given[2][:, 0], expected)


def test_mixed_goals_are_current_later_and_any():
    """By their shares; the actor's are later and any alone. Beyond the end of an episode counts as its last step."""
    rows = rows_of(np.ones((1, 6)), np.arange(1, 8).reshape(1, 7, 1))
    config = MixedConfig(current_share=0.25, future_share=0.5, actor_future_share=0.5)
    made, start = relabellings.registry.entry("mixed").make(config), jnp.full(DRAWS, 2, jnp.int32)
    known = pairs.KnownGoals(jnp.zeros(GOALS, bool).at[0].set(True))

    @jax.jit
    def drawn(rows):
        table = made.prepare(context(rows, known=known.mask))
        given = (jax.random.key(0), table, jnp.zeros_like(start), start, jnp.full(DRAWS, 9, jnp.int32))
        return made.relabel(*given), made.costs(*given)[0]

    values, actors = (np.bincount(goals, minlength=10) / DRAWS for goals in drawn(rows))
    discount = float(context(rows).discount)
    later = np.array([(1 - discount) * discount**ahead for ahead in range(3)] + [discount**3])
    expected = np.zeros(10)
    expected[0], expected[3], expected[4:8] = 0.25, 0.25, 0.5 * later
    np.testing.assert_allclose(values, expected, atol=0.03)
    np.testing.assert_allclose(actors, [0.5, 0, 0, 0, *[0.125] * 4, 0, 0], atol=0.03)


def test_a_step_that_achieves_nothing_keeps_its_goal_for_its_share_of_current_ones():
    """Not one that is achieved later, of which there are no more than their own share."""
    rows = rows_of(np.ones((1, 3)), np.array([-1, 1, 1, 1]).reshape(1, 4, 1))
    made, start = relabellings.registry.entry("mixed").make(MixedConfig(0.25, 0.5)), jnp.zeros(DRAWS, jnp.int32)

    @jax.jit
    def drawn(rows):
        table = made.prepare(context(rows, known=jnp.zeros(GOALS, bool).at[0].set(True)))
        return made.relabel(jax.random.key(0), table, start, start, jnp.full(DRAWS, 2, jnp.int32))

    np.testing.assert_allclose(np.bincount(drawn(rows)) / DRAWS, [0.25, 0.5, 0.25], atol=0.03)


def test_waypoints_lie_so_many_steps_ahead_and_not_beyond_the_goal_or_the_end():
    rows = rows_of(np.ones((1, 6)), np.arange(1, 8).reshape(1, 7, 1))
    made = relabellings.registry.entry("mixed").make(MixedConfig(subgoal_steps=2))

    @jax.jit
    def drawn(rows, start):
        row = jnp.zeros_like(start)
        return made.costs(jax.random.key(0), made.prepare(context(rows)), row, start, row)

    for first, low in ((0, 3), (5, 7)):
        goal, way = jax.tree.map(np.asarray, drawn(rows, jnp.full(300, first, jnp.int32)))
        assert set(goal.tolist()) == set(range(first + 2, 8)) and (way.low_goal == low).all()
        np.testing.assert_array_equal(way.goal, np.minimum(goal, low))
        np.testing.assert_array_equal(way.step, way.goal - 1)
    unknown = rows_of(np.ones((1, 6)), np.array([1, 2, -1, -1, 5, 6, 7]).reshape(1, 7, 1))
    goal, way = jax.tree.map(np.asarray, drawn(unknown, jnp.zeros(300, jnp.int32)))
    assert set(goal.tolist()) == {2, 5, 6, 7} and (way.low_goal == -1).all()
    np.testing.assert_array_equal(way.goal, np.where(goal == 2, 2, -1))  # Not the goal of the episode.


def test_waypoints_are_steps_of_their_own_row():
    rows = rows_of(np.ones((2, 3)), np.arange(1, 9).reshape(2, 4, 1))
    made = relabellings.registry.entry("mixed").make(MixedConfig(subgoal_steps=1))
    row, start = jnp.ones(300, jnp.int32), jnp.zeros(300, jnp.int32)
    goal, way = jax.jit(lambda rows: made.costs(jax.random.key(0), made.prepare(context(rows)), row, start, start))(
        rows
    )
    assert set(goal.tolist()) == {6, 7, 8} and (way.step == 1).all() and (way.goal == 6).all()


def test_a_step_costs_1_until_the_goal_and_a_failure_for_ever():
    """Of steps on a line: one that reaches its goal, one that begins at it, one that fails."""
    places = jnp.array([[[0.0], [1.0], [2.0], [3.0]]])
    given = SimpleNamespace(record=places, observation=places, desired_goal=jnp.full((1, 3, 1), 9.0))
    way = Waypoints(jnp.zeros((3, 1)), jnp.array([2, 2, 3]), jnp.zeros((3, 1)))
    drawn = Relabelling(None, None, costs=lambda key, table, row, step, goal: (goal, way))
    env = SimpleNamespace(reached=lambda record, goal: jnp.abs(record - goal)[..., 0] < 0.1)
    setup = parts.Setup(SimpleNamespace(relabelling=drawn), SimpleNamespace(discount=0.75), env)
    row, step = jnp.zeros(3, jnp.int32), jnp.arange(3)
    batch = replay.Transitions(
        None, None, None, jnp.array([[1.0], [1.0], [9.0]]), None, jnp.ones((3, 1)), jnp.zeros(3, bool), step == 2
    )
    memory = SimpleNamespace(buffer=given, relabelling=None)
    found = costs.sample_costs(setup, memory, jax.random.key(0), batch, row, step)
    np.testing.assert_allclose(found["external"][:, 0], [-1.0, 0.0, -1.0 / (1.0 - 0.75)])
    assert found["transitions"].terminated.tolist() == [False, True, True]
    assert found["waypoints"][2][:, 0].tolist() == [2.0, 2.0, 3.0]
