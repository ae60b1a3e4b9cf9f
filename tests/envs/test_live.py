"""Live goal environments of Gymnasium as tasks: an episode through the task is the one that the environment plays
alone, the same key gives the same numbers, and what cannot be put back is refused."""

import functools
import json
import sys

import gymnasium
import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from hand_made_robots import GoalEnv, Mass

from infogoal_jax import UserError, envs
from infogoal_jax.cli import main as cli
from infogoal_jax.cli.main import main
from infogoal_jax.data.episodes import Episodes
from infogoal_jax.envs import live
from infogoal_jax.envs.contract import check_contract
from infogoal_jax.envs.recordings import with_recordings

KEYS = jax.random.split(jax.random.key(0), 3)
LIMIT = 12


class Hidden(GoalEnv):
    """No MuJoCo, and its state lies in a list, where nobody finds it."""

    def begin(self):
        self.state = [np.zeros(2), self.np_random.uniform(-1, 1, 2)]

    def move(self, action):
        self.state[1] = 0.9 * self.state[1] + 0.1 * action
        self.state[0] = self.state[0] + 0.1 * self.state[1]

    def seen(self):
        place, speed = self.state
        return {
            "observation": np.concatenate([place, speed]),
            "achieved_goal": place.copy(),
            "desired_goal": self.goal.copy(),
        }


class Strict(Hidden):
    """It fails after three steps, and refuses a fourth."""

    def step(self, action):
        assert self.steps < 3, "call reset"
        self.steps += 1
        seen, reward, _, _, info = super().step(action)
        return seen, reward, self.steps == 3, False, info

    def begin(self):
        super().begin()
        self.steps = 0


class Noisy(Mass):
    """Every step is pushed at random."""

    def move(self, action):
        super().move(action + 0.1 * self.np_random.normal(size=2))


class Drawn(Mass):
    """Each episode has a motor of its own, in a dictionary."""

    def begin(self):
        super().begin()
        self.motor = {"gain": self.np_random.uniform(0.5, 2.0)}

    def move(self, action):
        super().move(self.motor["gain"] * action)


class Damped(Mass):
    """Each episode has a damping of its own, in MuJoCo's model."""

    def begin(self):
        super().begin()
        self.model.dof_damping[:] = self.np_random.uniform(0.5, 2.0)


def read_hidden(env):
    """The state of `Hidden`."""
    return np.concatenate([*env.unwrapped.state, env.unwrapped.goal])


def write_hidden(env, state):
    """Put it back."""
    env.unwrapped.state, env.unwrapped.goal = [state[:2], state[2:4]], state[4:]


def timed(kind):
    """A function that makes such an environment with Gymnasium's time limit."""
    return lambda: gymnasium.wrappers.TimeLimit(kind(), LIMIT)


ARGUMENTS = {Mass: {"make": timed(Mass)}, Hidden: {"make": timed(Hidden), "read": read_hidden, "write": write_hidden}}


@functools.cache
def task_of(kind, **more):
    """The task, made by those that need it."""
    return envs.from_gymnasium(**{"ends_at_goal": False} | ARGUMENTS[kind] | more, num_evaluated=4)


def actions_of(steps, rows=()):
    """Actions that lead far."""
    return np.random.default_rng(0).uniform(-1, 1, (steps, *rows, 2)).astype(np.float32)


@pytest.mark.parametrize("kind", [Mass, Hidden])
def test_an_episode_is_the_one_that_the_environment_plays_alone(kind):
    """Every bit that is seen, what counts as success, and the end."""
    task, alone = task_of(kind), timed(kind)()
    check_contract(task)
    state, step = jax.jit(task.reset)(KEYS[0]), jax.jit(task.step)
    seen, _ = alone.reset(seed=int(jax.random.key_data(KEYS[0])[-1]))
    successes = set()
    for number, action in enumerate(actions_of(LIMIT)):
        assert not state.truncated and state.time == number
        whole = np.concatenate([seen["achieved_goal"], seen["observation"]]).astype(np.float32)
        assert np.array_equal(task.observe(state), whole)
        assert np.array_equal(state.desired_goal, seen["desired_goal"].astype(np.float32))
        state = step(state, action)
        seen, _, _, truncated, info = alone.step(action)
        assert bool(task.reached(task.achieved(state), state.desired_goal)) == info["is_success"]
        successes.add(info["is_success"])
    assert truncated and state.truncated and not state.terminated and not task.failed(state)


def test_success_is_the_environments_own():
    """Under a goal that is passed by."""
    task, alone = task_of(Mass), Mass()
    alone.reset(seed=int(jax.random.key_data(KEYS[1])[-1]))
    goal = np.array([0.6, 0.0], np.float32)
    alone.goal, state, told = goal, jax.jit(task.reset_to)(KEYS[1], goal), []
    state, step = state.replace(world=jax.jit(task.begin)(KEYS[1])), jax.jit(task.step)
    for _ in range(LIMIT):
        state = step(state, np.array([1, 0], np.float32))
        told.append(alone.step(np.array([1, 0], np.float32))[-1]["is_success"])
        assert bool(task.reached(task.achieved(state), state.desired_goal)) == told[-1]
    assert 0 < sum(told) < LIMIT


@pytest.mark.parametrize("kind", [Mass, pytest.param(Hidden, marks=pytest.mark.long)])
def test_rows_do_not_know_of_each_other(kind):
    """A batch over seeds and environments, by one simulator or by three, is each of its rows."""
    keys = jax.random.split(KEYS[1], (2, 3))
    actions = np.moveaxis(actions_of(4, (2, 3)), 0, 2)

    def play(task, keys, actions):
        states = task.reset(keys)
        for push in actions:
            states = task.step(states, push)
        return states.world, task.observe(states)

    one, three = (task_of(kind, simulators=count) for count in (1, 3))
    together, by_three = (
        jax.jit(jax.vmap(jax.vmap(functools.partial(play, task))))(keys, actions) for task in (one, three)
    )
    single = jax.jit(functools.partial(play, three))(keys[1, 2], actions[1, 2])
    for here, there, alone in zip(*map(jax.tree.leaves, (together, by_three, single)), strict=True):
        assert np.array_equal(here, there) and np.array_equal(here[1, 2], alone)


def test_resets_and_goals_are_drawn_anew_by_the_key():
    task = task_of(Mass)
    states = jax.jit(jax.vmap(task.reset))(KEYS)
    goals = {*map(tuple, np.asarray(states.desired_goal).tolist())}
    assert len(goals) == len(KEYS) == len(np.unique(states.world.bytes, axis=0))
    assert task.goals.evaluated.shape == (4, 2) and (np.abs(task.goals.evaluated) <= 1).all()
    asked = jax.jit(task.reset_to)(KEYS[0], jnp.array([0.5, -0.5]))
    assert np.array_equal(asked.desired_goal, [0.5, -0.5]) and np.abs(task.achieved(asked)).max() < 0.2


def test_ends_of_an_episode_are_told_apart():
    """Far away the mass is lost, which is a failure; at the goal an episode ends where that is asked for."""

    def play(task, goal):
        state, step = jax.jit(task.reset_to)(KEYS[0], np.array(goal, np.float32)), jax.jit(task.step)
        for _ in range(LIMIT):
            state = step(state, np.ones(2, np.float32))
            if state.terminated or state.truncated:
                break
        return [bool(flag) for flag in (state.terminated, state.truncated, task.failed(state))], int(state.time)

    (flags, time), (ended, sooner) = play(task_of(Mass), [1.0, 1.0]), play(task_of(Mass, ends_at_goal=True), [1.0, 1.0])
    assert flags == [False, True, True] and time < LIMIT
    assert ended == [True, False, False] and sooner < time


def test_an_environment_that_is_over_is_not_stepped():
    def read(env):
        return np.append(read_hidden(env), env.unwrapped.steps)

    def write(env, state):
        write_hidden(env, state[:-1])
        env.unwrapped.steps = state[-1]

    task = envs.from_gymnasium(Strict, episode_length=LIMIT, read=read, write=write, num_evaluated=2)
    state = task.reset_to(KEYS[0], np.full(2, 0.9))
    ends = []
    for _ in range(5):
        state = task.step(state, np.zeros(2, np.float32))
        ends.append(bool(state.truncated))
    assert ends == [False, False, True, True, True]


class Done(Mass):
    """It is over at its goal, and refuses another step."""

    over = False

    def begin(self):
        super().begin()
        self.over = False

    def step(self, action):
        assert not self.over, "call reset"
        seen, reward, lost, _, info = super().step(action)
        self.over = info["is_success"] or lost
        return seen, reward, self.over, False, info


def towards(task, state, steps):
    """The states after so many steps to the goal that the environment has drawn."""
    states, step, goal = [state], jax.jit(task.step), np.asarray(state.world.obs["desired_goal"])
    for _ in range(steps):
        push = np.clip(3 * (goal - np.asarray(task.achieved(states[-1]))), -1, 1).astype(np.float32)
        states.append(step(states[-1], push))
    return states[1:]


class Mixed(Hidden):
    """Its place is a number of NumPy at first and one of Python later, which round differently beside an action."""

    def begin(self):
        self.x, self.y = self.np_random.uniform(-1, 1, 2)

    def move(self, action):
        self.x, self.y = (float(at + 0.05 * push) for at, push in zip((self.x, self.y), action, strict=True))

    def seen(self):
        place = np.array([self.x, self.y])
        return {"observation": np.tile(place, 2), "achieved_goal": place, "desired_goal": self.goal.copy()}


def test_numbers_of_numpy_and_of_python_are_put_back_as_what_they_were():
    envs.from_gymnasium(Mixed, episode_length=LIMIT, num_evaluated=2)  # It is compared with itself there.


class Ending(Mass):
    """It is over where it counts its goal as reached, and can be stepped on."""

    def step(self, action):
        seen, reward, lost, truncated, info = super().step(action)
        return seen, reward, info["is_success"] or lost, truncated, info


def test_a_goal_that_is_to_be_reached_more_closely_than_the_environments_own_can_be():
    task = envs.from_gymnasium(Ending, episode_length=3 * LIMIT, num_evaluated=2, radius=0.05)
    states = towards(task, jax.jit(task.reset)(KEYS[1]), 3 * LIMIT)
    ends = [bool(state.terminated) for state in states]
    last = ends.index(True)
    assert not any(bool(state.truncated) for state in states[:last])
    assert np.linalg.norm(task.achieved(states[last]) - states[last].desired_goal) < 0.05


def test_an_environment_whose_episode_ended_at_its_goal_is_not_stepped():
    """As training and evaluation step all environments, and use none of the states after an end; where an episode for
    another goal goes on, what is refused is one line."""
    task = envs.from_gymnasium(Done, episode_length=LIMIT, num_evaluated=2)
    ends = [bool(state.terminated) for state in towards(task, jax.jit(task.reset)(KEYS[1]), LIMIT)]
    assert ends == sorted(ends) and ends[-1] and not ends[0]
    start = jax.jit(task.reset)(KEYS[1])
    other = start.replace(desired_goal=-start.desired_goal)
    with pytest.raises(ValueError, match="Done: raised AssertionError: call reset; it was at its own goal, where"):
        jax.block_until_ready(towards(task, other, LIMIT))


def test_actions_reach_from_bound_to_bound():
    """And what lies within them is not changed."""
    task = envs.from_gymnasium(lambda: Mass(low=(0, -4), high=(1, 4)), episode_length=LIMIT, num_evaluated=2)
    one = live.Simulator(lambda: Mass(low=(0, -4), high=(1, 4)), None, None)
    given = []
    one.env.move = given.append
    for action in ([-1, -1], [0, 0], [1, 1]):
        one.step(np.array(action, np.float32))
    assert np.array_equal(given, [[0, -4], [0.5, 0], [1, 4]]) and task.action_size == 2
    assert np.array_equal(task.own_action(np.array([[-1, -1], [0, 0], [2, 1]])), given)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_an_action_at_a_bound_lies_in_the_environments_space(kind):
    """The sum of middle and half width is rounded, and missed the bound; an environment may refuse such an action."""
    low, high = np.random.default_rng(0).uniform([[-1], [0.01]], [[-0.01], [1]], (2, 50)).astype(kind)
    one = live.Simulator(Mass, None, None)
    one.env.action_space, given = spaces.Box(low, high, dtype=kind), []
    one.env.move = given.append
    for action in (-1, 1, -3, 3):
        one.step(np.full(50, action, np.float32))
    assert all(one.env.action_space.contains(action) for action in given)
    np.testing.assert_allclose(given, [low, high, low, high], atol=1e-7)


def test_bounds_are_rounded_inwards():
    space = spaces.Box(np.array([-0.7, 0.0]), np.array([0.1, 0.7]), dtype=np.float64)
    low, high = live.within(space)
    assert space.contains(low) and space.contains(high)
    np.testing.assert_allclose([low, high], [space.low, space.high], atol=1e-7)


class Other(Mass):
    """With other spaces."""

    def __init__(self, observation=None, action=None, **parts):
        super().__init__()
        self.observation_space = observation or spaces.Dict(self.observation_space.spaces | parts)
        self.action_space = action or self.action_space


class Farther(Mass):
    """Whose rewards have a threshold of their own."""

    def compute_reward(self, achieved, desired, info):
        return -(np.linalg.norm(achieved - desired, axis=-1) > 0.5).astype(np.float32)


class Broken(Mass):
    """Which fails after a while."""

    def move(self, action):
        super().move(action)
        if self.data.time > 0.05 * LIMIT * 2:
            raise OSError("the motor is hot")


HOT = "infogoal: Broken-v0: raised OSError: the motor is hot (test_live.py, line "


class Silent(Mass):
    """Which tells nothing at a reset."""

    def reset(self, **given):
        super().reset(**given)


class Lost(Mass):
    """Which does not know where it begins, or where it shall go."""

    def __init__(self, member):
        super().__init__()
        self.member = member

    def seen(self):
        return super().seen() | {self.member: np.full(2, np.nan)}


class Nowhere(Mass):
    """Without a threshold."""

    distance_threshold = None


class Untold(Nowhere, Farther):
    """Whose rewards alone tell how near a goal has to be."""


IMAGE = spaces.Box(0, 255, (8, 8, 3), np.uint8)


@pytest.mark.parametrize(
    ("make", "more", "said"),
    [
        (lambda: Other(observation=spaces.Box(-1, 1, (4,))), {}, r"observation_space\['observation'\] = .*give a Dict"),
        (lambda: Other(achieved_goal=spaces.Box(-1, 1, (3,))), {}, "desired_goal = 2: achieved_goal has 3 numbers"),
        (lambda: Other(observation=spaces.Dict({"observation": IMAGE})), {}, "'observation'.*pixels"),
        (lambda: Other(action=spaces.Discrete(3)), {}, r"action_space = 'Discrete\(3\)': actions are vectors"),
        (lambda: Other(action=spaces.Box(-np.inf, np.inf, (2,))), {}, "action_space = .*give finite bounds"),
        (Hidden, {}, "make = 'Hidden': goes elsewhere after 1 steps when put back; give read and write"),
        (Drawn, {}, "make = 'Drawn': goes elsewhere after 1 steps when put back; give .* and a reset may draw"),
        (Damped, {}, "make = 'Damped': goes elsewhere after 1 steps when put back"),
        (Noisy, {}, "make = 'Noisy': goes elsewhere .* a step may draw no random numbers"),
        (lambda: Lost("achieved_goal"), {}, r"achieved_goal of Lost = \[nan, nan\]: is not finite after a reset"),
        (lambda: Lost("desired_goal"), {}, r"desired_goal of Lost = \[nan, nan\]: is not finite after a reset"),
        (Nowhere, {}, "radius = None: the environment has no distance_threshold"),
        (Farther, {}, "distance_threshold = 0.3: compute_reward takes goals that are farther away"),
        (Untold, {"radius": 0.1}, "radius = 0.1: compute_reward takes goals that are farther away .*own, or more"),
        (Mass, {"episode_length": None}, "episode_length = None: the environment has no time limit"),
        (Mass, {"read": read_hidden}, "write = None: give both read and write"),
        (Mass, {"read": lambda env: "x", "write": write_hidden}, "the state of read"),
        (Silent, {}, "make: raised TypeError"),
        (lambda: 1 / 0, {}, "make: raised ZeroDivisionError: division by zero"),
        (lambda: 0, {}, "make = 'int': has no observation_space"),
        ("Mass-v0", {}, "make = 'Mass-v0': Gymnasium has no such environment"),
        ("a_module:Mass-v0", {}, "make: raised ModuleNotFoundError"),
    ],
)
def test_what_cannot_be_a_task_is_refused(make, more, said):
    with pytest.raises(UserError, match=said) as error:
        envs.from_gymnasium(make, **({"episode_length": LIMIT} | more))
    assert "\n" not in str(error.value)


def test_without_gymnasium_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(UserError, match=r"gymnasium: cannot be imported .*infogoal-jax\[gymnasium\]"):
        envs.from_gymnasium("FetchReach-v4")


SMALL = {"num_envs": 2, "rollout_steps": LIMIT, "updates_per_epoch": 2, "batch_size": 8, "buffer_steps": 400}
SMALL |= {"epochs_per_evaluation": 1, "evaluation_starts": 1}


@pytest.fixture
def mass_id():
    """The id of the mass at Gymnasium."""
    name = "Mass-v0"
    gymnasium.register(name, entry_point=Mass, max_episode_steps=LIMIT)
    yield name
    del gymnasium.registry[name]


@pytest.mark.long
def test_a_run_that_goes_on_is_the_one_that_was_never_stopped(mass_id, tmp_path):
    """To the same bits of every file, with two seeds beside each other."""
    whole, part = tmp_path / "whole", tmp_path / "part"
    words = ["train", "--env", f"gymnasium:{mass_id}", "--method", "none", "--seeds", "2"]
    assert main([*words, *flags(2), "--out", str(whole)]) == 0
    assert main([*words, *flags(1), "--out", str(part)]) == 0
    assert main(["train", "--resume", str(part), "--num-epochs", "2", "--no-figures"]) == 0
    for name in ("checkpoint", "policy", "epochs.csv", "evaluations.csv"):
        assert (whole / name).read_bytes() == (part / name).read_bytes()


def flags(epochs):
    """Of `SMALL`."""
    return ["--num-epochs", str(epochs), "--no-figures", *(f"--{n.replace('_', '-')}={v}" for n, v in SMALL.items())]


@pytest.fixture
def broken_id():
    """The id of what fails after a while at Gymnasium."""
    gymnasium.register("Broken-v0", entry_point=Broken, max_episode_steps=4 * LIMIT)
    yield "Broken-v0"
    del gymnasium.registry["Broken-v0"]


def test_a_robot_that_fails_in_a_compiled_program_is_one_line(broken_id, monkeypatch, capsys):
    """Whatever the command was about to do."""

    def play(arguments):
        task = envs.from_gymnasium(broken_id, ends_at_goal=False, num_evaluated=4)
        state, step = jax.jit(task.reset)(KEYS[0]), jax.jit(task.step)
        for _ in range(4 * LIMIT):
            state = step(state, np.zeros(2, np.float32))
        jax.block_until_ready(state)

    monkeypatch.setattr(cli, "run", play)
    assert main([]) == 2
    error = capsys.readouterr().err
    assert error.strip().splitlines()[-1].startswith(HOT)


@pytest.mark.long
def test_a_robot_that_fails_is_one_line_of_training(broken_id, tmp_path, monkeypatch, capsys):
    """In the evaluation, where nothing is updated."""
    hand_made.leave_out_updates(monkeypatch)
    out = ["--out", str(tmp_path / "run")]
    assert main(["train", "--env", f"gymnasium:{broken_id}", "--method", "none", *flags(4), *out]) == 2
    error = capsys.readouterr().err
    assert error.strip().splitlines()[-1].startswith(HOT)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_fetch_of_gymnasium_robotics_is_learned(tmp_path):
    """Where it is installed; a whole episode is equal there too."""
    pytest.importorskip("gymnasium_robotics")
    task = envs.from_gymnasium("FetchPickAndPlace-v4", ends_at_goal=False, num_evaluated=2)
    alone = gymnasium.make("FetchPickAndPlace-v4")
    seen, _ = alone.reset(seed=int(jax.random.key_data(KEYS[0])[-1]))
    state, step = jax.jit(task.reset)(KEYS[0]), jax.jit(task.step)
    for action in np.random.default_rng(0).uniform(-1, 1, (50, 4)).astype(np.float32):
        whole = np.concatenate([seen["achieved_goal"], seen["observation"]]).astype(np.float32)
        assert np.array_equal(task.observe(state), whole)
        state, (seen, _, _, truncated, _) = step(state, action), alone.step(action)
    assert state.truncated and truncated
    words = ["train", "--env", "gymnasium:FetchReach-v4", "--method", "none", "--num-epochs", "30", "--no-figures"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    last = (tmp_path / "run" / "evaluations.jsonl").read_text().splitlines()[-1]
    assert json.loads(last)["train_goal/success_rate"] >= 0.9


def test_recordings_of_a_goal_environment_show_what_the_agent_sees():
    """Their observations stand apart from what was achieved, as `infogoal data import-minari` writes them."""
    task, numbers = task_of(Hidden), np.random.default_rng(0)
    seen, achieved, desired = (numbers.uniform(-1, 1, (6, size)).astype(np.float32) for size in (4, 2, 2))
    episodes = Episodes(seen, np.zeros((6, 2)), np.arange(6) == 5, achieved, desired)
    found = with_recordings(task, episodes).recorded
    np.testing.assert_array_equal(found.observation[0], np.concatenate([achieved, seen], 1))
    np.testing.assert_array_equal(found.record[0], achieved)
    whole = Episodes(np.concatenate([achieved, desired, seen], 1), np.zeros((6, 2)), np.arange(6) == 5)
    again = with_recordings(task, whole).recorded
    np.testing.assert_array_equal(again.observation[0], found.observation[0])
    np.testing.assert_array_equal(again.record[0], achieved)
