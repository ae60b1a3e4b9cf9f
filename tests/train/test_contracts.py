"""What a policy, start states and views have to be is said before anything is compiled, in a `UserError` that names
what does not fit."""

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import GoalView, UserError, evaluate, rollout
from infogoal_jax.train.evaluation import draw_starts, random_policy

ENV = hand_made.environment()
GOALS = np.array([0, 2, 5])
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def states():
    return jax.jit(draw_starts, static_argnums=2)(ENV, jnp.asarray(GOALS), 2)


def stay(observation, goal, key):
    """The first action, for every episode."""
    return jnp.zeros(observation.shape[:1], jnp.int32)


def scored(*arguments, **named):
    """The shapes of an evaluation: whatever is refused is refused before it runs."""
    return jax.eval_shape(lambda: evaluate(*arguments, **named))


def test_states_and_goals_that_agree_are_evaluated(states):
    assert scored(stay, ENV, GOALS, states).success.shape == (3, 2)
    assert scored(stay, ENV, jnp.asarray(GOALS), np.int64(4)).success.shape == (3, 4)
    assert scored(stay, ENV, ["train_0", "train_2"], 1, seed=2**32 - 1).success.shape == (2, 1)

    def policy(observation, shown, key):
        return jnp.zeros(shown["code"].shape[0], jnp.int32)

    for width in (1, 2):
        view = GoalView(GOALS, {"code": jnp.zeros((3, width, 4))})
        assert scored(policy, ENV, view, states).success.shape == (3, 2)


REFUSED_STATES = {
    "other goals": (lambda states: (GOALS[::-1], states), "starts[0] = states for goal [0, 0], goals[0] = 5"),
    "fewer goals": (lambda states: (GOALS[:2], states), "starts = states [3, 2], goals = [2]"),
    "one start": (lambda states: (GOALS, jax.tree.map(lambda leaf: leaf[:, 0], states)), "starts = 'states [3]'"),
    "one state": (lambda states: (GOALS[:1], jax.tree.map(lambda leaf: leaf[0, 0], states)), "starts = 'states []'"),
    "no start": (lambda states: (GOALS, jax.tree.map(lambda leaf: leaf[:, :0], states)), "at least one start"),
    "one leaf": (lambda states: (GOALS, states.replace(time=states.time[:, 0])), "leaf .time is int32 [3]"),
    "another type": (lambda states: (GOALS, states.replace(time=states.time * 1.0)), "leaf .time is float32 [3, 2]"),
}


@pytest.mark.parametrize("case", REFUSED_STATES)
def test_states_for_other_goals_are_refused(states, case):
    make, message = REFUSED_STATES[case]
    goals, starts = make(states)
    with pytest.raises(UserError) as refused:
        scored(stay, ENV, goals, starts)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    "shown",
    [jnp.zeros((2, 1)), jnp.zeros((3, 3)), jnp.zeros(3), {"a": jnp.zeros((3, 1)), "b": jnp.zeros(())}, (), None],
)
def test_views_of_other_goals_or_starts_are_refused(states, shown):
    with pytest.raises(UserError, match="goals.shown"):
        scored(stay, ENV, GoalView(GOALS, shown), states)


NO_GOALS = [True, [True], 1, 1.0, [1.0], [[1]], [], "nobody", ["train_0", "nobody"], [8], [-1], [2**32 + 1], [2**70]]
NO_GOALS += [None, [None], {0}, {"a": 1}, np.ones(8, bool), np.ma.masked_array([1, 2], [True, False]), object(), b"1"]
NO_GOALS += [np.array(["1"]), [[1], [2, 3]], np.array([1, 2], object), np.datetime64("2020-01-01"), ["train_0", 1]]
NO_GOAL = [True, np.True_, 1.0, 2**32 + 1, 2**70, -1, 8, None, [1], np.array([1]), "nobody", b"train_0", object(), {1}]
NO_ENV = [None, "object_search", random_policy(ENV), object()]
ODD = {
    "goals": NO_GOALS,
    "seed": [-1, 2**32, 1.0, True, None, "1", np.array([1])],
    "starts": [0, -1, 1.0, True, None, "2", np.array([2])],
    "env": NO_ENV,
}
ODD_OF_ROLLOUT = {
    "goal": NO_GOAL,
    "key": [0, None, jax.random.split(KEY), jnp.zeros(2), "key", np.zeros(2, np.uint32)],
    "env": NO_ENV,
}


def each(odd: dict[str, list]):
    """A test for each of these values."""
    cases = [(name, value) for name, values in odd.items() for value in values]
    return pytest.mark.parametrize(("name", "value"), cases, ids=lambda value: type(value).__name__)


@each(ODD)
def test_what_cannot_be_evaluated_is_named(name, value):
    with pytest.raises(UserError, match=name):
        scored(**{"policy": stay, "env": ENV, "goals": GOALS, "starts": 2} | {name: value})


@each(ODD_OF_ROLLOUT)
def test_what_is_no_episode_is_named(name, value):
    with pytest.raises(UserError, match=name):
        rollout(**{"env": ENV, "policy": stay, "goal": 0, "key": KEY} | {name: value})


NO_POLICY = {
    "nothing": None,
    "an environment": ENV,
    "one argument": lambda observation: jnp.zeros(observation.shape[:1], jnp.int32),
    "floats": lambda observation, goal, key: jnp.zeros(observation.shape[:1]),
    "flags": lambda observation, goal, key: jnp.zeros(observation.shape[:1], bool),
    "one for all": lambda observation, goal, key: jnp.zeros((), jnp.int32),
    "an axis more": lambda observation, goal, key: jnp.zeros((*observation.shape[:1], 1), jnp.int32),
    "fewer": lambda observation, goal, key: jnp.zeros(observation.shape[0] - 1, jnp.int32),
    "two": lambda observation, goal, key: (stay(observation, goal, key), key),
    "none": lambda observation, goal, key: None,
    "a number": lambda observation, goal, key: 0,
}


@pytest.mark.parametrize("name", NO_POLICY)
def test_what_is_no_policy_is_refused(name):
    with pytest.raises(UserError, match="policy"):
        scored(NO_POLICY[name], ENV, GOALS)
    with pytest.raises(UserError, match="policy"):
        jax.eval_shape(lambda: rollout(ENV, NO_POLICY[name], 0, KEY))
