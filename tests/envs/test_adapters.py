"""Environments of other libraries as tasks: every episode has a goal and a start of its own, what the agent sees does
not tell the goal, and ends of an episode are told apart."""

import dataclasses
import functools
import importlib
import math
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError, envs, make_train, presets, replay
from infogoal_jax.agents.dqn import DQNConfig
from infogoal_jax.bridges.brax import Env, State
from infogoal_jax.data.episodes import Episodes
from infogoal_jax.envs import adapters, named
from infogoal_jax.envs.adapters import import_jaxgcrl
from infogoal_jax.envs.contract import check_contract
from infogoal_jax.envs.recordings import with_recordings
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.rollout import collect

wrappers = importlib.import_module("brax.envs.wrappers.training")  # After the bridge, which keeps brax's import quiet.
EPISODE = 6
EDGE = 3.0
KEYS = jax.random.split(jax.random.key(0), 5)


class Line(Env):
    """A point on a line goes where it is pushed; beyond the edges it is lost. Its goal is among its observations, and
    in `info`; as in many environments, types change with the first step, and what is given is written into."""

    def reset(self, rng):
        goal_key, place_key = jax.random.split(rng)
        goal = jax.random.uniform(goal_key, (1,), minval=-2.0, maxval=2.0)
        place = jax.random.uniform(place_key, (1,), minval=-0.5, maxval=0.5)
        info = {"goal": goal, "pushes": 0}
        return State(place, self.seen(place, goal), 0.0, jnp.zeros(()), {"push": 0.0}, info)

    def step(self, state, action):
        assert action.dtype == jnp.float32
        place, goal = state.pipeline_state + action, state.info["goal"]
        state.info["pushes"] += 1
        state.metrics["push"] = jnp.abs(action).sum()
        done = (jnp.abs(place) > EDGE).astype(jnp.float32).sum()
        return state.replace(pipeline_state=place, obs=self.seen(place, goal), done=done)

    def seen(self, place, goal):
        return {"way": goal - place, "place": place, "goal": goal, "pair": jnp.stack([place, place**2])}

    observation_size = 5
    action_size = 1
    backend = "none"


ARGUMENTS = {"goal": "goal", "achieved": "place", "hidden": "way", "radius": 0.2, "episode_length": EPISODE}


@functools.cache
def line_task():
    """The task, made by those that need it: dozens of small programs."""
    return envs.from_brax(Line(), **ARGUMENTS)


def walk(task, policy, steps: int, key=KEYS[0], num_envs: int = 4) -> Trajectories:
    """Rows of episodes under a policy."""
    states = jax.jit(jax.vmap(task.reset))(jax.random.split(key, num_envs))
    return jax.jit(lambda states, key: collect(task, states, policy, key, steps)[1])(states, key)


def stay(observation, goal, key):
    """No push."""
    return jnp.zeros((goal.shape[0], 1), jnp.float32)


def test_it_keeps_the_contract():
    check_contract(line_task())
    assert not line_task().discrete and line_task().goals.shape == (1,) and line_task().can_fail


def test_every_episode_has_a_goal_and_a_start_of_its_own():
    rows = walk(line_task(), stay, 4 * (EPISODE + 1))
    first = np.asarray(jnp.arange(rows.valid.shape[1]) % (EPISODE + 1) == 0)
    goals, places = np.asarray(rows.desired_goal)[:, first, 0], np.asarray(rows.record)[:, :-1, 0][:, first]
    assert np.unique(goals).size == goals.size == np.unique(places).size == 16


def line_of_brax():
    """The line, brax's training wrappers, and the task."""
    return Line(), wrappers.wrap, line_task()


def reacher_of_playground():
    """Playground's reacher, its training wrappers, and the task."""
    skip_without("mujoco_playground")
    env = adapters.playground_environment("ReacherEasy", {})
    own = named.PLAYGROUND["ReacherEasy"](env) | {"episode_length": EPISODE, "ends_at_goal": False, "goals_drawn": 2}
    wrap = importlib.import_module("mujoco_playground").wrapper.wrap_for_brax_training
    return env, wrap, envs.from_playground(env, **own)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # Of packages that ask for others' older versions.
@pytest.mark.parametrize("library", [line_of_brax, reacher_of_playground])
def test_their_wrappers_cache_one_goal_and_start_and_ours_are_drawn_in_every_episode(library):
    """Where each of five episodes begins, in four environments."""
    env, wrap, task = library()
    wrapped, action = wrap(env, episode_length=EPISODE), jnp.zeros((4, task.action_size))
    states, step = [jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 4))], jax.jit(wrapped.step)
    for _ in range(4 * EPISODE):
        states.append(step(states[-1], action))
    begun = [states[0], *(state for state in states if state.done.all())]
    read = jax.jit(jax.vmap(lambda state: (task.read_goal(state), task.observation(state))))
    for theirs in zip(*map(read, begun), strict=True):
        assert len(theirs) == 5 and all(np.array_equal(each, theirs[0]) for each in theirs)
    rows = walk(task, lambda *given: action, 5 * (EPISODE + 1))
    for ours in (rows.desired_goal, rows.observation):
        first = np.asarray(ours)[:, : 5 * (EPISODE + 1) : EPISODE + 1].reshape(20, -1)
        assert len(np.unique(first, axis=0)) == 20


def test_the_agent_sees_what_is_left_of_the_observation_in_the_order_of_its_leaves():
    task = line_task()
    state = jax.jit(task.reset)(KEYS[1])
    place = np.asarray(state.world.pipeline_state)
    seen = jax.jit(task.observe)(state)  # Of goal, pair, place, way.
    assert np.allclose(seen, [place[0], place[0] ** 2, place[0]]) and seen.dtype == jnp.float32
    assert np.array_equal(state.desired_goal, state.world.info["goal"])
    of_goal = jax.jit(lambda goal: task.observe(task.reset_to(KEYS[1], goal)))
    told = [of_goal(np.array([goal], np.float32)) for goal in (-1.0, 1.0)]
    assert np.array_equal(*told)


PAIR = {"goal": "goal", "achieved": [1], "hidden": "way", "radius": 0.2, "episode_length": EPISODE}


def recorded(columns: list[int], **others) -> Episodes:
    """Three observations of the line, of which these columns were kept."""
    whole = np.arange(15, dtype=np.float32).reshape(3, 5) / 10
    return Episodes(whole[:, columns], np.zeros((3, 1), np.float32), np.array([False, False, True]), **others)


@pytest.mark.parametrize("columns", [[0, 1, 2, 3, 4], [1, 2, 3]], ids=["whole", "what the agent sees"])
def test_recordings_are_of_whole_observations_or_of_what_the_agent_sees(columns):
    """The goal that is achieved is read from the same number of both."""
    rows = with_recordings(envs.from_brax(Line(), **PAIR), recorded(columns)).recorded
    np.testing.assert_allclose(rows.observation[0], recorded([1, 2, 3]).observations)
    np.testing.assert_allclose(rows.record[0], recorded([1]).observations)


@pytest.mark.parametrize("columns", [[0, 1], [0, 1, 2, 3], [0, 1, 2, 3, 4, 4]])
def test_recordings_of_other_numbers_are_refused(columns):
    with pytest.raises(UserError, match="^observations = .*: give whole observations of 5 numbers, or the 3 that"):
        with_recordings(line_task(), recorded(columns))


def test_recordings_of_wider_actions_are_refused():
    """A task that tells no bounds has -1 and 1."""
    wide = recorded([0, 1, 2, 3, 4], action_bounds=np.array([[-2.0], [2.0]], np.float32))
    with pytest.raises(
        UserError, match=r"^action_bounds = .*: give recordings of the task, whose actions have \[\[-1.0"
    ):
        with_recordings(envs.from_brax(Line(), **PAIR), wide)


def test_a_goal_that_recordings_do_not_show_is_asked_for():
    task = envs.from_brax(Line(), **PAIR | {"hidden": [1, 4]})
    with pytest.raises(UserError, match="^achieved_goals: is missing"):
        with_recordings(task, recorded([2, 3]))
    told = recorded([2, 3], achieved_goals=np.ones((3, 1), np.float32))
    np.testing.assert_array_equal(with_recordings(task, told).recorded.record[0], np.ones((3, 1)))


@pytest.mark.parametrize(
    "reading",
    [
        {"goal": [0], "hidden": [-1], "achieved": [3]},
        {"goal": 0, "hidden": slice(-1, None), "achieved": lambda state: state.pipeline_state},
        {"goal": lambda state: state.info["goal"][0], "hidden": [0, 4], "achieved": "place"},
    ],
)
def test_places_keys_and_functions_read_the_same(reading):
    task = envs.from_brax(Line(), **(ARGUMENTS | reading))
    one, other = (each.reset(KEYS[2]) for each in (task, line_task()))
    assert np.array_equal(task.observe(one), line_task().observe(other)) and np.array_equal(
        one.desired_goal, other.desired_goal
    )
    assert np.array_equal(task.achieved(one), line_task().achieved(other))


def test_ends_of_an_episode_are_told_apart():
    """At the goal it terminates; when time is up it is truncated; beyond the edge it has failed, which is truncated
    too."""

    def run(goal, push, steps):
        state = line_task().reset_to(KEYS[3], jnp.array([goal]))
        state = state.replace(world=state.world.replace(pipeline_state=jnp.zeros(1)))
        for _ in range(steps):
            state = line_task().step(state, jnp.array([push]))
        return [bool(each) for each in (state.terminated, state.truncated, line_task().failed(state))]

    assert run(1.0, 1.0, 1) == [True, False, False]
    assert run(1.0, 0.0, EPISODE - 1) == [False, False, False]
    assert run(1.0, 0.0, EPISODE) == [False, True, False]
    assert run(-1.9, 5.0, 3) == [False, False, False]  # Pushes are at most 1.
    assert run(-1.9, 5.0, 4) == [False, True, True]


def test_nothing_is_worth_anything_after_a_failure_whatever_the_goal():
    """Under goals of hindsight too; after a truncation values go on."""
    pushed = walk(line_task(), lambda *given: jnp.ones((4, 1), jnp.float32), EPISODE)
    waiting = walk(line_task(), stay, EPISODE)
    assert pushed.failed.any() and not waiting.failed.any() and waiting.truncated.any()
    for rows in (pushed, waiting):
        row, step = np.nonzero(np.asarray(rows.truncated))
        for goal, reached in ((None, None), (jnp.full((len(row), 1), 9.0), line_task().reached)):
            judged = functools.partial(
                replay.transitions_at, row=row, first=step, num_steps=1, desired_goal=goal, reached=reached
            )
            found = jax.jit(judged)(rows).terminated
            assert np.array_equal(found, np.asarray(rows.failed)[row, step])


class Arriving(Line):
    """It is done at its own goal, too."""

    def step(self, state, action):
        state = super().step(state, action)
        near = jnp.abs(state.pipeline_state - state.info["goal"]) < ARGUMENTS["radius"]
        return state.replace(done=jnp.maximum(state.done, near.astype(jnp.float32).sum()))


def test_an_environment_that_is_done_at_its_own_goal_has_not_failed():
    """Where episodes go on at the goal, and where another goal is desired."""
    task = envs.from_brax(Arriving(), ends_at_goal=False, **ARGUMENTS)
    state = task.reset(KEYS[1])
    own = state.world.info["goal"]
    for goal, push in ((own, 0.0), (own - 1.0, 0.0), (own, 4.0)):
        start = state.replace(desired_goal=goal, world=state.world.replace(pipeline_state=own + push))
        after = task.step(start, jnp.zeros(1))
        assert bool(after.world.done > 0) and bool(task.failed(after)) == bool(after.truncated) == (push > 0)


def test_a_start_of_an_own_goal_is_one_at_which_it_is_not_reached():
    """Of so many starts as are asked for; a start comes with its goal."""
    shares = []
    for starts in (1, 16):
        task = envs.from_brax(Line(), starts=starts, **ARGUMENTS | {"radius": 1.0})
        begun = jax.jit(jax.vmap(task.reset))(jax.random.split(KEYS[2], 100))
        np.testing.assert_array_equal(begun.desired_goal, begun.world.info["goal"])
        shares.append(float(task.reached(task.achieved(begun), begun.desired_goal).mean()))
    assert shares[0] > 0.3 and shares[1] == 0


def test_goals_are_the_environments_own_uniform_or_some_held_out():
    own = np.asarray(line_task().goals.evaluated)
    assert line_task().goals.groups == ("train",) and np.abs(own).max() < 2.0 < float(line_task().goals.high[0]) < 2.5
    wide = envs.from_brax(Line(), low=[-3.0], high=[3.0], num_evaluated=200, **ARGUMENTS)
    assert np.abs(np.asarray(wide.goals.evaluated)).max() > 2.5
    apart = envs.from_brax(Line(), held_out=lambda goal: goal[0] > 0, **ARGUMENTS)
    desired = np.asarray(jax.jit(jax.vmap(apart.reset))(jax.random.split(KEYS[4], 200)).desired_goal)
    assert apart.goals.groups == ("train", "test") and (desired <= 0).all() and np.unique(desired).size > 150


@pytest.mark.long  # It tells of time; what episodes begin with is above.
def test_a_reset_is_computed_only_where_an_episode_has_ended():
    """Of several seeds side by side, too; the rows are those of an environment that is reset at every step."""
    resets = []

    class Counting(Line):
        counts = False

        def reset(self, rng):
            if self.counts:
                jax.debug.callback(lambda key: resets.append(1), rng)
            return super().reset(rng)

    def rows(task, num_steps):
        Counting.counts = False
        states = jax.jit(jax.vmap(jax.vmap(task.reset)))(jax.random.split(KEYS[0], (2, 4)))
        Counting.counts = True
        resets.clear()
        found = jax.jit(jax.vmap(lambda states, key: collect(task, states, stay, key, num_steps)[1]))(states, KEYS[:2])
        jax.block_until_ready(found)
        jax.effects_barrier()
        return found, len(resets)

    task = envs.from_brax(Counting(), ends_at_goal=False, **ARGUMENTS)
    assert rows(task, EPISODE)[1] == 0
    found, count = rows(task, 2 * EPISODE + 1)

    class Eager(type(task)):
        costly_reset = False

    eager, every_step = rows(Eager(**vars(task)), 2 * EPISODE + 1)
    assert 0 < count < every_step and jax.tree.all(jax.tree.map(np.array_equal, found, eager))


def test_what_is_not_finite_is_taken_back():
    class Breaking(Line):
        def step(self, state, action):
            state = super().step(state, action)
            return state.replace(obs=jax.tree.map(lambda leaf: leaf / (action[0] != 0), state.obs))

    task = envs.from_brax(Breaking(), **ARGUMENTS)
    before = task.reset(KEYS[0])
    after = task.step(before, jnp.zeros(1))
    assert after.diverged and after.truncated and np.array_equal(task.observe(after), task.observe(before))
    assert not task.step(before, jnp.ones(1)).diverged


class Whole(Line):
    """It begins at a whole number, as one of Python or of int32, and a number that follows it by half a step."""

    def reset(self, rng):
        state = super().reset(rng)
        return state.replace(pipeline_state=jnp.zeros(1, jnp.int32), info=state.info | {"pushes": 0, "mean": 0})

    def step(self, state, action):
        pushed = super().step(state, action)
        return pushed.replace(info=pushed.info | {"mean": (state.info["mean"] + state.pipeline_state.sum()) / 2})


def test_what_begins_as_a_whole_number_goes_on_as_a_fraction():
    task = envs.from_brax(Whole(), **ARGUMENTS | {"achieved": lambda state: state.pipeline_state})
    state = jax.jit(task.reset)(KEYS[0])
    for _ in range(2):
        state = jax.jit(task.step)(state, jnp.full(1, 0.25))
    assert state.world.pipeline_state == 0.5 and state.world.info["mean"] == 0.125
    assert state.world.info["pushes"] == 2 and state.world.info["pushes"].dtype == jnp.int32


class Changing(Line):
    """Its state has another shape after a step."""

    def step(self, state, action):
        state = super().step(state, action)
        return state.replace(info=state.info | {"goal": jnp.zeros(2)})


class Unbounded(Line):
    """What it shows of a place below 0 is not finite."""

    def seen(self, place, goal):
        return super().seen(place, goal) | {"pair": jnp.where(place < 0, jnp.inf, jnp.ones((2, 1)))}


class Sizeless(Line):
    """Its actions have no size."""

    @property
    def action_size(self):
        raise RuntimeError("there is no model")


@pytest.mark.parametrize(
    ("env", "arguments", "said"),
    [
        (None, {}, "env = 'NoneType': has no reset"),
        (wrappers.EpisodeWrapper(Line(), 5, 1), {}, "env = 'EpisodeWrapper': has training wrappers"),
        (wrappers.AutoResetWrapper(Line()), {}, "env = 'AutoResetWrapper': has training wrappers"),
        (Changing(), {}, "env.step: leaf .info['goal'] is float32 [2]"),
        (Line(), {"goal": "target"}, "goal = 'target': give one of its keys: goal, pair, place, way"),
        (Line(), {"goal": [5]}, "goal = [5]: give places of the observation, which has 5 numbers"),
        (Line(), {"goal": []}, "goal = []: give at least one place"),
        (Line(), {"goal": 0.5}, "goal = 0.5: give places"),
        (Line(), {"goal": np.array([0], object)}, "goal = array([0], dtype=object): give places"),
        (Line(), {"goal": lambda state: jnp.ones(1)}, "goal = [1.0]: is the same after every env.reset"),
        (Line(), {"goal": slice("a", None)}, "goal = slice('a', None, None): give places"),
        (Line(), {"goal": slice(0, 2, 0)}, "goal = slice(0, 2, 0): give places"),
        (Line(), {"goal": lambda state: jnp.zeros(0), "achieved": lambda state: jnp.zeros(0)}, "goal = 'no numbers'"),
        (Sizeless(), {}, "env.action_size: raised RuntimeError when it was traced: there is no model"),
        (Line(), {"source": 5}, "source = 5: say what is simulated"),
        (Line(), {"episode_length": 2**31}, "episode_length = 2147483648"),
        (Line(), {"starts": 10**9}, "starts = 1000000000: give a whole number from 1 to 4096"),
        (Line(), {"goal": [[0], [1, 2]]}, "goal = [[0], [1, 2]]: give places"),
        (Line(), {"achieved": "pair"}, "achieved = 2: give as many numbers as goal has, 1"),
        (Line(), {"achieved": lambda state: state.place}, "achieved: raised AttributeError"),
        (Line(), {"achieved": "goal"}, "achieved = 'goal': is the desired goal itself; give what a state achieves"),
        (Unbounded(), {}, "% of the starts': observe and achieve finite numbers"),
        (Unbounded(), {"low": [0.0], "high": [1.0]}, "% of the starts': observe and achieve finite numbers"),
        (Line(), {"hidden": ["way"]}, "hidden = ['way']: give places"),
        (Line(), {"hidden": slice(None)}, "leave something of the observation to see"),
        (Line(), {"radius": 0}, "radius = 0: give a distance greater than 0"),
        (Line(), {"radius": "wide"}, "radius = 'wide': give a number"),
        (Line(), {"episode_length": 0}, "episode_length = 0"),
        (Line(), {"starts": 0}, "starts = 0"),
        (Line(), {"ends_at_goal": "yes"}, "ends_at_goal = 'yes'"),
        (Line(), {"low": [0.0]}, "high = None: give both"),
        (Line(), {"held_out": lambda goal: goal}, "held_out = 'float32 [1]': return bool []"),
        (Line(), {"low": [0.0, 0.0], "high": [1.0, 1.0]}, "low = (2,): give as many numbers as goal has, 1"),
    ],
)
def test_what_the_environment_does_not_have_is_one_line(env, arguments, said):
    with pytest.raises(UserError) as refused:
        envs.from_brax(env, **(ARGUMENTS | arguments))
    assert said in str(refused.value) and "\n" not in str(refused.value)


class Nested(Line):
    """Its observation has a part that holds nothing."""

    def seen(self, place, goal):
        return super().seen(place, goal) | {"extra": {}, "none": None}


def test_parts_of_an_observation_that_hold_nothing_are_passed_over():
    task = envs.from_brax(Nested(), **ARGUMENTS)
    assert task.size == 5 and task.shown == line_task().shown
    with pytest.raises(UserError, match="^goal = 'extra': give one of its keys: goal, pair, place, way"):
        envs.from_brax(Nested(), **ARGUMENTS | {"goal": "extra"})


def test_a_radius_within_which_all_goals_lie_is_refused_before_anything_is_compiled():
    presets.register("wide", envs.from_brax(Line(), **ARGUMENTS | {"radius": 100.0}))
    with pytest.raises(
        UserError, match=r"^env.reached = 'True for every two goals': .*\(radius = 100\); give a smaller"
    ):
        make_train(presets.load("wide"))


SIZES = {"num_epochs": 2, "epochs_per_evaluation": 2, "updates_per_epoch": 2, "num_envs": 4, "rollout_steps": 20}


@pytest.fixture
def line():
    """The name of the task, registered."""
    presets.register("line", line_task())
    return "line"


def test_a_registered_task_is_configured_by_its_name(line):
    config = presets.load(line, "her")
    assert config.env.episode_length == EPISODE and config.env.radius == line_task().radius
    longer = envs.load(line, dataclasses.replace(config.env, episode_length=9))
    assert longer.episode_length == 9 and longer.env is line_task().env
    with pytest.raises(UserError, match="agent = 'dqn'"):
        make_train(presets.load(line, "her", agent=DQNConfig(num_steps=1)))


@pytest.mark.parametrize("name", ["__dict__", "__name__", "_line", "a/b"])
def test_a_name_of_pythons_own_registers_nothing(name):
    with pytest.raises(UserError, match="give a name of letters"):
        presets.register(name, line_task())
    assert name not in envs.registry and name not in presets.registry


@pytest.mark.parametrize("changes", [{"radius": math.nan}, {"episode_length": 2**40}, {"episode_length": 2.5}])
def test_a_task_out_of_range_or_with_a_wrong_preset_registers_nothing(changes):
    with pytest.raises(UserError, match=f"env.{next(iter(changes))} = "):
        presets.register("line", line_task().replace(**changes))
    with pytest.raises(UserError, match="preset of line: training"):
        presets.register("line", line_task(), presets.Preset("td3", 5, {}, {}, {}, {}, ""))
    assert "line" not in envs.registry and "line" not in presets.registry


@pytest.mark.long
@pytest.mark.parametrize("agent", ["td3", "sac", "crl"])
def test_every_agent_for_vectors_trains_on_it(line, agent):
    train = make_train(presets.load(line, "her", agent=agent, **SIZES))
    result = jax.jit(train)(jax.random.key(0), None, train.env)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((result.params, result.metrics)))
    assert result.metrics["train_goal/success_rate"].shape == (1,)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: envs.from_jaxgcrl("ants", radius=1.0),
            "name = 'ants': no such environment. Did you mean 'ant'? Known: reacher, ant",
        ),
        (lambda: envs.from_playground("FishSwim", config_overrides=5, **ARGUMENTS), "config_overrides = 5: give"),
        (lambda: envs.from_playground(Line(), config_overrides={"impl": "jax"}, **ARGUMENTS), "give env by its name"),
        (
            lambda: envs.from_jaxgcrl("reacher", rad=1.0),
            "arguments = 'rad': no such argument. Did you mean 'radius'? Known: goal, achieved",
        ),
        (lambda: envs.from_gymnasium("nothing", goal=[1]), "arguments = 'goal': no such argument"),
        (
            lambda: envs.from_brax(wrappers.EpisodeWrapper(wrappers.VmapWrapper(Line()), 9, 1), **ARGUMENTS),
            "env = 'EpisodeWrapper of a VmapWrapper': has training wrappers, which reset to one cached start",
        ),
    ],
)
def test_names_that_are_not_there_are_one_line(make, said):
    with pytest.raises(UserError) as refused:
        make()
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("module", "make", "remedy"),
    [
        ("jaxgcrl", lambda: envs.from_jaxgcrl("ant"), "pip install --no-deps jaxgcrl"),
        ("mujoco_playground", lambda: envs.from_playground("FishSwim", **ARGUMENTS), "infogoal-jax[playground]"),
    ],
)
def test_a_missing_package_is_named_with_its_remedy(module, make, remedy, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError) as refused:
        make()
    assert remedy in str(refused.value) and not {"brax.v1", "wandb_osh.hooks"} & {*sys.modules}


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # Of packages that ask for others' older versions.
def test_ant_of_jaxgcrl_is_itself():
    """Goals 10 m away, of which it achieves those where it stands."""
    skip_without("jaxgcrl")
    task = envs.from_jaxgcrl("ant")
    state = jax.jit(task.reset)(KEYS[0])
    assert task.radius == 0.5 and task.episode_length == 1001 and len(task.shown) == 29 and task.action_size == 8
    assert np.linalg.norm(state.desired_goal) == pytest.approx(10.0, abs=1e-3)
    assert np.array_equal(task.achieved(state), task.observe(state)[:2])
    assert np.array_equal(task.goals.inputs_of(state.desired_goal), state.desired_goal)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("maze", ["u_maze", "big_maze"])
def test_the_ball_of_jaxgcrl_s_mazes_is_what_achieves_a_goal(maze):
    """Its `goal_indices` begin one place too early there, at the speed of a joint."""
    skip_without("jaxgcrl")
    task = envs.from_jaxgcrl(f"ant_ball_{maze}")
    state = jax.jit(task.reset)(KEYS[0])
    world = jax.jit(task.step)(state, jnp.zeros(task.action_size)).world
    far = np.linalg.norm(task.achieved_goal(world) - task.read_goal(world))
    assert float(world.metrics["dist"]) == pytest.approx(far, abs=1e-3)


def skip_without(package: str) -> None:
    """Skip the test where an optional package is not installed."""
    try:
        import_jaxgcrl(package) if package == "jaxgcrl" else __import__(package)
    except (UserError, ImportError) as error:
        pytest.skip(str(error))
