"""Tasks with a finite set of goals keep what Gymnasium promises its users, as the Fetch tasks do."""

import functools
import warnings

import gymnasium
import hand_made
import hand_made_frames
import hand_made_points
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from infogoal_jax import UserError, envs
from infogoal_jax.bridges import gymnasium as bridge
from infogoal_jax.bridges.gymnasium import TaskGymnasium, TaskVector

STEPS = 4


@pytest.fixture(scope="module")
def rooms():
    """Object search in the hand-made rooms, with episodes of a few steps."""
    return TaskGymnasium(hand_made.environment(STEPS), render_mode="rgb_array")


@pytest.fixture(scope="module")
def vector():
    """Three of them in one program."""
    return TaskVector(hand_made.environment(STEPS), 3)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(hand_made.environment, marks=pytest.mark.long),
        pytest.param(hand_made_frames.manipulation, marks=pytest.mark.long),
        hand_made_frames.qa,
    ],
)
def test_gymnasium_finds_nothing_to_warn_of(make):
    check_env(gymnasium.make(bridge.id_of("object_search"), task=make(), render_mode="rgb_array").unwrapped)


def test_the_tasks_are_registered_and_are_goal_environments():
    for name in ("object_search", "object_manipulation", "embodied_qa"):
        spec = gymnasium.spec(bridge.id_of(name))
        assert spec.kwargs == {"task": name, "timed": False} and "TaskGymnasium" in spec.entry_point
        assert spec.max_episode_steps == envs.registry[name].config().episode_length
    env = TaskGymnasium(hand_made.environment())
    assert {name: space.shape for name, space in env.observation_space.items()} == {
        "observation": (8, 8, 1),
        "achieved_goal": (8,),
        "desired_goal": (8,),
    }
    assert env.action_space == gymnasium.spaces.Discrete(env.env.action_size)


def test_rewards_are_those_that_hindsight_computes_and_the_goal_ends_the_episode(rooms):
    """Walks at random until the goal was met and time ran out once each."""
    steps, random = [], np.random.default_rng(0)
    for episode in range(200):
        seen, info = rooms.reset(seed=episode)
        assert seen["desired_goal"].sum() == 1 and not (seen["desired_goal"] & seen["achieved_goal"]).any()
        while True:
            action = random.choice(np.flatnonzero(info["action_mask"]))
            seen, reward, terminated, truncated, info = rooms.step(action)
            steps.append((seen["achieved_goal"], seen["desired_goal"], reward, info["is_success"], terminated))
            if terminated or truncated:
                break
        if len({step[4] for step in steps}) == 2 and episode > 5:
            break
    achieved, desired, given, success, ended = (np.array(part) for part in zip(*steps, strict=True))
    assert (
        set(given) == {-1.0, 0.0} and np.array_equal(given == 0, success == 1) and np.array_equal(ended, success == 1)
    )
    assert np.array_equal(rooms.compute_reward(achieved, desired, {}), given)
    assert np.array_equal(rooms.compute_terminated(achieved, desired, {}), ended)
    # In hindsight what was achieved is a goal that is reached, and nothing is none.
    something = achieved.any(-1)
    assert np.array_equal(rooms.compute_reward(achieved, achieved, {}) == 0, something) and 0 < something.mean() < 1


def test_a_question_of_the_test_is_rewarded_where_it_ends_the_episode():
    """It is no goal that is known while training, and `goals_of` names none but those."""
    env = TaskGymnasium(hand_made_frames.qa())
    walk, goal = env.env, int(np.flatnonzero(env.env.goals.test_mask)[0])
    seen, _ = env.reset(seed=0, options={"goal": goal})
    distance, terminated = np.asarray(walk.distance)[int(walk.place[goal])], False
    while not terminated:
        assert not seen["achieved_goal"][goal]
        nearer = distance[np.asarray(walk.next_node)[int(env.state.node)]].argmin()
        seen, reward, terminated, truncated, info = env.step(nearer)
        assert not truncated and reward == (0 if terminated else -1) and info["is_success"] == terminated
    assert env.compute_terminated(seen["achieved_goal"], seen["desired_goal"], info)


def test_goals_can_be_given_by_number_or_name_and_follow_the_seed(rooms):
    names = rooms.env.goals.names
    for goal in (5, names[5]):
        assert rooms.reset(seed=0, options={"goal": goal})[0]["desired_goal"].argmax() == 5
    first, again = (rooms.reset(seed=3)[0] for _ in range(2))
    assert all(np.array_equal(first[name], again[name]) for name in first)
    drawn = {int(rooms.reset()[0]["desired_goal"].argmax()) for _ in range(20)}
    assert len(drawn) > 1 and drawn <= set(np.asarray(rooms.env.goals.training_goals).tolist())
    assert rooms.render().shape == (8, 8, 3)


def test_wrong_calls_are_explained(rooms):
    for options, message in (({"goal": 99}, "goals 0 to 7"), ({"goal": "sofa"}, "no goal sofa"), ({"golf": 1}, "golf")):
        with pytest.raises(UserError, match=message):
            rooms.reset(options=options)
    with pytest.raises(UserError, match="action = 99"):
        rooms.step(99)
    with pytest.raises(UserError, match="reset"):
        TaskGymnasium(hand_made.environment()).step(0)
    for count in (0, 2.0, True):
        with pytest.raises(UserError, match="num_envs = .*whole number from 1 to"):
            TaskVector(hand_made.environment(), count)
    with pytest.raises(UserError, match="actions are vectors"):
        TaskGymnasium(hand_made_points.points())
    with pytest.raises(UserError, match="one shape"):
        rooms.compute_reward(np.zeros((2, 8)), np.zeros(8), {})
    for bits in (np.eye(3), np.ones(1), [1]):  # Of another number of goals, such as a goal's own number.
        with pytest.raises(UserError, match="achieved_goal"):
            rooms.compute_reward(bits, bits, {})


def test_a_batch_takes_no_actions_that_are_not_whole(vector):
    """Gymnasium's own check would cut them off."""
    vector.reset(seed=0)
    with pytest.raises(UserError, match="actions = .*3 whole numbers"):
        vector.step(np.full(3, 0.7))


def test_a_batch_starts_its_next_episodes_in_gymnasium_s_next_step_mode(vector):
    assert vector.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    seen, info = vector.reset(seed=0)
    assert vector.observation_space.contains(seen) and info["action_mask"].shape == (3, vector.env.action_size)
    ended = np.zeros(3, bool)
    for _ in range(3 * STEPS):
        before = seen
        actions = [np.flatnonzero(mask)[0] for mask in info["action_mask"]]
        seen, reward, terminated, truncated, info = vector.step(np.array(actions))
        assert vector.observation_space.contains(seen) and not (terminated & truncated).any()
        same = (seen["desired_goal"] == before["desired_goal"]).all(-1)
        assert same[~ended].all() and not reward[ended].any() and not info["_is_success"][ended].any()
        expected = vector.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})
        assert np.array_equal(reward[~ended], expected[~ended])
        ended = terminated | truncated
    assert vector.render() is None


@pytest.mark.long
def test_stable_baselines_trains_with_hindsight():
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.DQN(
        "MultiInputPolicy",
        TaskGymnasium(hand_made.environment()),
        replay_buffer_class=sb3.HerReplayBuffer,
        learning_starts=50,
        policy_kwargs={"net_arch": [16]},
    )
    model.learn(200)
    batch = model.replay_buffer.sample(128)
    bits = batch.next_observations["achieved_goal"] * batch.next_observations["desired_goal"]
    assert ((bits.sum(1) > 0) == (batch.rewards[:, 0] == 0)).all()


def length_of(env) -> int:
    """Steps after which an episode that does not reach its goal is truncated: turning on the spot, whatever is met
    along the way starts it anew."""
    for seed in range(50):
        env.reset(seed=seed)
        for steps in range(1, 200):
            *_, terminated, truncated, _ = env.step(env.unwrapped.env.action_size - 1)
            if terminated:
                break
            if truncated:
                return steps
    raise AssertionError("no episode was truncated")


ID = bridge.id_of("object_search")


@pytest.mark.parametrize("steps", [7, 30])
def test_gymnasium_s_limit_is_the_only_one(steps):
    """Shorter than the task's own, and longer."""
    env = gymnasium.make(ID, task=hand_made.environment(), max_episode_steps=steps)
    assert env.spec.max_episode_steps == steps and length_of(env) == steps
    batch = gymnasium.make_vec(ID, 2, task=hand_made.environment(), max_episode_steps=steps)
    assert batch.env.episode_length == steps


def test_without_gymnasium_the_task_s_limit_holds(rooms):
    assert length_of(rooms) == STEPS
    assert gymnasium.make(ID, task=hand_made.environment(), max_episode_steps=-1).unwrapped.env.episode_length > 10**9


def test_two_limits_are_refused():
    longer = envs.registry["fetch_reach"].config(episode_length=100, ends_at_goal=False)
    with pytest.raises(UserError, match="config.episode_length = 100: two limits; give max_episode_steps=100"):
        gymnasium.make(bridge.id_of("fetch_reach"), config=longer)
    with pytest.raises(UserError, match="config.episode_length = 100, max_episode_steps = 50: two limits"):
        gymnasium.make_vec(bridge.id_of("fetch_reach"), 2, config=longer)
    batch = gymnasium.make_vec(bridge.id_of("fetch_reach"), 2, config=longer, max_episode_steps=100)
    assert batch.env.episode_length == 100
    env = bridge.make("fetch_reach", config=longer)
    assert env.env.episode_length == env.spec.max_episode_steps == 100
    assert gymnasium.make(env.spec).spec.max_episode_steps == 100


def test_a_fork_of_a_process_in_which_jax_runs_is_refused():
    """In the words of the parent, and at once, where its workers would wait without end."""
    make = functools.partial(gymnasium.make, ID, task=hand_made.environment())
    with warnings.catch_warnings(), pytest.raises(UserError, match='fork: .*context="spawn".*TaskVector'):
        warnings.simplefilter("ignore")  # JAX and Python warn of the fork too.
        gymnasium.vector.AsyncVectorEnv([make] * 2, context="fork")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("goal", [True, 1.0, None, "nobody", -1, 8, 2**40, [1], np.array([1])]),
        ("options", [[], 1, "goal", {"goals": 1}, {1: 2}]),
        ("seed", [-1, 1.0, True, "1"]),
    ],
)
def test_what_no_episode_can_begin_with_is_named(rooms, name, values):
    for value in values:
        with pytest.raises(UserError, match=name):
            rooms.reset(**{"options": {"goal": value}} if name == "goal" else {name: value})


@pytest.mark.parametrize("action", [True, 1.0, None, "1", -1, 6, [1], np.array([1])], ids=repr)
def test_what_is_no_action_is_refused(rooms, action):
    rooms.reset(seed=0)
    with pytest.raises(UserError, match="action"):
        rooms.step(action)


def test_bits_that_are_none_are_no_reward(rooms):
    desired = np.eye(8)[:2]
    assert list(rooms.compute_reward(desired, desired.astype(bool), {})) == [0, 0]
    for wrong in (desired * np.nan, desired * 2, -desired, desired[0], "bits"):
        with pytest.raises(UserError, match="achieved_goal"):
            rooms.compute_reward(wrong, desired, {})
