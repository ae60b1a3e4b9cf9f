"""What is wrong with a task of a user's own with continuous goals is said in one line before anything is compiled, or
counted while it trains."""

import dataclasses
import types

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError, envs, make_train, presets
from infogoal_jax.agents.td3 import TD3Config
from infogoal_jax.bridges.gymnasium import TaskGymnasium, TaskVector
from infogoal_jax.envs.contract import check_contract, check_reached
from infogoal_jax.envs.goal_task import Episode, GoalTask
from infogoal_jax.envs.plane import PlaneConfig
from infogoal_jax.goals import GoalBox
from infogoal_jax.loading import reasons_against
from infogoal_jax.report.runs import RunTable
from infogoal_jax.report.summary import remarks_on
from infogoal_jax.report.video import drawn_video
from infogoal_jax.train.episodes import run_episodes
from infogoal_jax.train.experience import collect_epoch, ended_at_goal
from infogoal_jax.train.rollout import collect

GOALS = GoalBox.of([0.0, 0.0], [2.0, 2.0], use_of=lambda goal: goal[0] > 1.5)


@flax.struct.dataclass
class Square(GoalTask):
    """A point in a square."""

    action_size = 2
    source = "a square (made up)"

    def begin(self, key):
        return jax.random.uniform(key, (2,), jnp.float32, 0.0, 2.0)

    def move(self, place, action):
        return jnp.clip(place + 0.1 * action, 0.0, 2.0)

    def observation(self, place):
        return place - 1.0

    def achieved_goal(self, place):
        return place


def changed(**members):
    """The square with other members."""
    kind = types.new_class("Other", (Square,), {}, lambda names: names.update(members | {"__module__": "own"}))
    return flax.struct.dataclass(kind)(GOALS)


@flax.struct.dataclass
class Timeless:
    """A state without a time."""

    desired_goal: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    diverged: jax.Array


def timeless(self, key, goal=None):
    """A new episode of a state that lacks a field."""
    false = jnp.zeros((), bool)
    return Timeless(self.goals.draw(key), false, false, false)


def drawn_anywhere(self, key):
    """A new episode for a goal of any use."""
    return self.reset_to(key, self.goals.draw_any(key))


def drawn_outside(self, key):
    """A new episode for a goal beyond the corners."""
    return self.reset_to(key, self.goals.draw(key) + 5.0)


WRONG = {
    "a state that lacks a field": (dict(reset=timeless), "the state of env.reset = 'Timeless': has no field time"),
    "a reset that draws held-out goals": (dict(reset=drawn_anywhere), r"the goal of env.reset = \[\[1.*is held out"),
    "a reset that draws outside": (dict(reset=drawn_outside), "the goal of env.reset = .*lies outside; give 0 to 2"),
    "reached that is never true": (
        dict(reached=lambda self, record, goal: (record > goal).all(-1)),
        r"env.reached: is False where the goal \[.*\] itself is achieved; mend it",
    ),
    "reached that is always true": (
        dict(reached=lambda self, record, goal: (record - goal < 9).all(-1)),
        "env.reached = 'True for every two goals': there is nothing to learn",
    ),
    "a reward": (
        dict(reward=lambda self, world: 0.0),
        "env.reward = 'a function': nothing calls it: a goal that is reached is the reward; leave it out",
    ),
    "a function that is not written": (
        dict(achieved_goal=GoalTask.achieved_goal),
        "env.achieved_goal: achieved_goal is not written, and the contract asks for it",
    ),
    "whole numbers as observations": (
        dict(observation=lambda self, place: place.astype(jnp.int32)),
        r"env.observation: returns int32 \[2\]; return float32",
    ),
    "goals of another length": (
        dict(achieved_goal=lambda self, place: jnp.zeros(3)),
        r"env.achieved_goal: is float32 \[3\]; give float32 \[2\]",
    ),
    "what is seen is NaN": (
        dict(observation=lambda self, place: jnp.log(place - 1.0)),
        "env.observation = 'not finite at .*% of the starts': return finite numbers",
    ),
    "a world that begins as NaN": (
        dict(begin=lambda self, key: jnp.full(2, jnp.nan)),  # It is seen, too.
        "env.begin = 'not finite at 100% of the starts': return finite numbers",
    ),
    "a world that begins at infinity": (
        dict(begin=lambda self, key: jnp.full(2, jnp.inf), observation=lambda self, place: jnp.zeros(2)),
        "env.begin = 'not finite at 100% of the starts': return finite numbers",
    ),
    "a world of another shape": (
        dict(move=lambda self, place, action: jnp.zeros(3)),
        r"env.move: .*float32 \[3\].*float32 \[2\] in env.begin",
    ),
}


def test_a_task_without_a_docstring_is_not_described_by_its_signature():
    """Which Python puts in its place."""
    for task, words in ((changed(), "A task of one's own."), (Square(GOALS), "A point in a square.")):
        presets.register("square", task)
        assert presets.registry["square"].description == words


@pytest.mark.parametrize("case", WRONG)
def test_a_task_in_which_nothing_can_be_learned_is_refused_in_one_line(case):
    members, message = WRONG[case]
    with pytest.raises(UserError, match=message) as error:
        presets.register("square", changed(**members))
        make_train(presets.load("square", "none"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.long)], ids=["masks", "program"])
def test_how_many_axes_an_observation_has_is_asked_of_a_task_once(whole):
    """Not wherever the program asks for the actions that can be taken: a reset of a simulator takes seconds to
    trace."""
    resets = []

    @flax.struct.dataclass
    class Counting(Square):
        def begin(self, key):
            resets.append(1)
            return super().begin(key)

    config = presets.load("point_maze", "none", num_epochs=1, epochs_per_evaluation=1)
    env = Counting(goals=GOALS, episode_length=5, radius=0.1)
    train = make_train(config, env)
    resets.clear()
    batch = jnp.zeros((3, 4, 2)), jnp.zeros((5, 2))
    masks = jax.jit(lambda env, *seen: [env.action_mask(one) for one in seen])(env, *batch)
    assert [mask.shape for mask in masks] == [(3, 4, 2), (5, 2)] and not resets
    if not whole:
        return
    state = jax.eval_shape(train.initial, jax.random.key(0), config.hyper, env)
    initial = len(resets)
    jax.eval_shape(train.chunk, state, jnp.arange(1), config.hyper, env)
    assert (initial, len(resets) - initial) == (1, 2)


def test_a_task_that_does_not_say_how_large_its_actions_are_is_refused():
    """Without it actions of one number would be broadcast over a place."""
    kind = flax.struct.dataclass(type("Own", (GoalTask,), {"__module__": "own"}))
    with pytest.raises(UserError, match="^env = 'Own': has no action_size, which the contract asks for"):
        presets.register("square", kind(GOALS))


@pytest.mark.parametrize(
    ("members", "said"),
    [
        ({"radius": jnp.sqrt}, "^env.radius = .*sqrt.*: give a distance above 0$"),
        ({"radius": [0.1, 0.2]}, r"^env.radius = \[0.1, 0.2\]: give a distance above 0$"),
        ({"episode_length": jnp.sqrt}, "^env.episode_length = .*: give a whole number from 1"),
        ({"ends_at_goal": jnp.ones(())}, "^env.ends_at_goal = .*: give True or False"),
    ],
)
def test_members_of_other_kinds_are_refused(members, said):
    with pytest.raises(UserError, match=said):
        presets.register("square", Square(GOALS, **members))


def test_a_task_that_is_no_pytree_is_refused():
    class Forgotten(Square):
        """Without the decorator."""

    for use in (lambda env: presets.register("forgotten", env), TaskGymnasium, lambda env: TaskVector(env, 2)):
        with pytest.raises(UserError, match="^env = 'Forgotten': is no pytree; write @flax.struct.dataclass above"):
            use(Forgotten(GOALS))


@pytest.mark.parametrize("kind", [list, tuple, np.asarray, jnp.asarray])
def test_bounds_of_actions_are_given_as_any_array(kind):
    env = changed(action_bounds=kind([[-1.0, 0.0], [3.0, 1.0]]))
    check_contract(env)
    assert env.own_action(jnp.array([0.0, 1.0])).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("bounds", ["wide", [-1, 1], [[-1, -1, -1], [1, 1, 1]], [[1, 1], [-1, -1]], [[-1], [1, 1]]])
def test_what_bounds_no_actions_is_refused(bounds):
    with pytest.raises(UserError, match="^env.action_bounds"):
        check_contract(changed(action_bounds=bounds))


@pytest.mark.parametrize(("radius", "field"), [(0.0, "env.radius"), (-1.0, "env.radius"), (5.0, "env.reached")])
def test_a_radius_that_decides_nothing_is_refused(radius, field):
    with pytest.raises(UserError, match=f"^{field} = "):
        presets.register("square", Square(GOALS, radius=radius))
        make_train(presets.load("square", "none"))


@pytest.mark.parametrize("env", [GOALS, "square", envs.load("point_maze").goals])
def test_what_is_no_goal_task_is_not_registered(env):
    with pytest.raises(UserError, match="^env = .*give a GoalTask"):
        presets.register("square", env)
    assert "square" not in envs.registry and "square" not in presets.registry


def test_values_are_bounded_by_what_staying_at_the_goal_is_worth():
    """Every step at the goal is worth 1 otherwise: a sigmoid is refused, and targets are clipped higher."""
    goes_on = presets.load("point_maze", "none", env=PlaneConfig(ends_at_goal=False))
    assert goes_on.agent.bounded and not reasons_against(goes_on)
    of_sigmoid = dataclasses.replace(goes_on, agent=TD3Config(bounded=True, critic="product"))
    with pytest.raises(UserError, match=r"^agent.bounded = True: an episode of point_maze goes on at its goal"):
        make_train(of_sigmoid)
    assert not reasons_against(dataclasses.replace(goes_on, agent=TD3Config(critic="product")))
    all_goals = presets.load("fetch_reach", "all_goals", env=dataclasses.replace(goes_on.env), agent="td3")
    assert "agent.all_goals" in {
        refusal.field for refusal in reasons_against(dataclasses.replace(all_goals, task="reacher"))
    }
    presets.register("square", Square(GOALS, ends_at_goal=False))
    config = presets.load("square", "none")
    assert config.agent.bounded and not reasons_against(config)


@pytest.mark.long
def test_steps_to_numbers_that_are_not_finite_are_counted():
    """From half of the square every step leads to NaN: it is taken back, is no transition, and stands in the epochs."""
    presets.register(
        "square", changed(move=lambda self, place, action: jnp.where(place[0] > 1.0, jnp.nan, place + 0.1 * action))
    )
    train = make_train(presets.load("square", "none", num_envs=16, rollout_steps=40, batch_size=8))

    def collected(key):
        state = train.initial(key, train.config.hyper, train.env)
        return collect_epoch(train.setup(), state, 0)

    state, counts = jax.jit(collected)(jax.random.key(0))
    rows = state.buffer
    assert int(counts["collect/diverged"]) == (~rows.valid & rows.truncated).sum() > 0
    assert np.isfinite(rows.observation).all()


@pytest.mark.long
def test_where_every_step_diverges_metrics_are_numbers():
    """Rewards are a mean over the steps that were taken, of which there is none."""
    presets.register("square", changed(move=lambda self, place, action: place + jnp.nan))
    config = presets.load(
        "square", "none", num_envs=2, rollout_steps=4, batch_size=2, updates_per_epoch=1, buffer_steps=8
    )
    train = make_train(config)

    def an_epoch(key):
        return train.epochs(train.initial(key, config.hyper, train.env), jnp.arange(1), config.hyper, train.env)[1]

    metrics = jax.jit(an_epoch)(jax.random.key(0))
    assert metrics["env_steps"] == 0 and metrics["agent/external_reward"] == 0
    assert all(np.isfinite(value).all() for value in metrics.values())


def test_what_achieves_no_goal_has_a_cell_of_its_own():
    """As the last corner of the goal space has, whose visits it would share."""
    cells = np.asarray(Square(GOALS).cell_of(jnp.array([[0.0, 0.0], [2.0, 2.0], [9.0, 9.0], [jnp.nan, 0.0]])))
    assert cells.tolist() == [0, GOALS.num_cells - 1, GOALS.num_cells - 1, GOALS.num_cells]
    assert Square(GOALS).num_cells == GOALS.num_cells + 1


@pytest.mark.parametrize("broken, diverged", [("observation", True), ("achieved_goal", False)])
def test_a_step_to_an_observation_that_is_not_finite_is_undone(broken, diverged):
    """A NaN among the goals that are achieved is none, and goes on."""
    task = changed(**{broken: lambda self, place: jnp.where(place[0] > 1.0, jnp.nan, place)})
    state = task.episode(jnp.array([0.95, 1.0]), jnp.array([0.2, 0.2]))
    stepped = task.step(state, jnp.array([1.0, 0.0]))
    assert bool(stepped.diverged) == bool(stepped.truncated) == diverged
    assert np.isclose(stepped.world[0], 0.95 if diverged else 1.05)


def test_a_task_of_the_package_keeps_its_name():
    """One's own may be registered again, as a cell of a notebook is run again."""
    before = envs.registry["point_maze"]
    with pytest.raises(UserError, match="^name = 'point_maze': is a task already; give yours another name"):
        presets.register("point_maze", Square(GOALS))
    assert envs.registry["point_maze"] is before
    presets.register("square", Square(GOALS))
    presets.register("square", Square(GOALS, radius=np.float32(0.5), episode_length=np.int64(50)))
    assert presets.load("square").env.radius == 0.5


def test_a_sampler_of_one_goal_is_refused():
    goals = GoalBox.of([0.0, 0.0], [2.0, 2.0], sampler=lambda key: jnp.array([0.5, 0.25]))
    with pytest.raises(UserError, match=r"^sampler = \[0.5, 0.25\]: is the only goal that it draws"):
        check_reached(Square(goals))


NOT_EVALUATED = RunTable([0], np.arange(0), {})


def test_a_report_names_seeds_whose_codes_are_no_bottleneck():
    """Beta of the second seed is 0 to the end while its KL grows; that of the third is too, but it does not."""
    beta = np.array([0.01, 0.0, 0.0])[:, None] * np.ones((3, 20))
    kl = np.stack([np.full(20, 9.0), np.linspace(10, 1400, 20), np.linspace(50, 40, 20)])
    (said,) = remarks_on(RunTable([4, 5, 6], np.arange(20), {"infogoal/beta": beta, "infogoal/kl": kl}), NOT_EVALUATED)
    assert "in 1 seed (5)" in said and "--hyper.learner.beta-floor" in said
    early = {"infogoal/beta": beta[:, :19], "infogoal/kl": kl[:, :19]}
    assert not remarks_on(RunTable([4, 5, 6], np.arange(19), early), NOT_EVALUATED)


def test_a_report_says_what_epochs_tell_of_a_task():
    never = RunTable([0], np.arange(2), {"collect/success_rate": np.zeros((1, 2)), "collect/diverged": np.ones((1, 2))})
    first, second = remarks_on(never, NOT_EVALUATED)
    assert "no episode of training reached its goal" in first and second.startswith("2 steps of training")
    assert not remarks_on(RunTable([0], np.arange(1), {"collect/success_rate": np.full((1, 1), 0.1)}), NOT_EVALUATED)
    evaluated = RunTable([0], np.arange(1), {"train_goal/success_rate": np.full((1, 1), 0.1)})
    assert len(remarks_on(never, evaluated)) == 1  # No episode of training ended yet.
    nothing = {"collect/diverged": np.zeros((1, 2)), "collect/nothing_achieved": np.array([[0.5, 0.0]])}
    (said,) = remarks_on(RunTable([0], np.arange(2), nothing), NOT_EVALUATED)
    assert said == "25.00% of the steps of training achieved no goal: `achieved_goal` was NaN"


def test_a_world_may_have_empty_arrays():
    """As `mjx.Data` of a robot that touches nothing has."""

    @flax.struct.dataclass
    class Robot(Square):
        def begin(self, key):
            return {"place": super().begin(key), "contacts": jnp.zeros((0, 3))}

        def move(self, world, action):
            return world | {"place": super().move(world["place"], action)}

        def observation(self, world):
            return super().observation(world["place"])

        def achieved_goal(self, world):
            return world["place"]

    presets.register("robot", Robot(GOALS, radius=0.2))
    sizes = dict(num_epochs=1, epochs_per_evaluation=1, num_envs=4, rollout_steps=10, buffer_steps=80)
    train = make_train(presets.load("robot", "none", updates_per_epoch=1, batch_size=8, evaluation_starts=2, **sizes))
    shapes = jax.eval_shape(train, jax.random.key(0))
    assert shapes.metrics["test_goal/success_rate"].shape == (1,)


def test_an_episode_keeps_what_the_task_does_not():
    """Time, its end, and no start at the goal."""
    env = Square(GOALS, radius=0.5, episode_length=2)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 200))
    assert isinstance(states, Episode) and not np.any(env.reached(env.achieved(states), states.desired_goal))
    still = np.zeros((200, 2), np.float32)
    step = jax.jit(jax.vmap(env.step))
    once = step(states, still)
    twice = step(once, still)
    assert not once.truncated.any() and twice.truncated.all() and (twice.time == 2).all()


AT_EDGE = np.array([[1.3, 1.0], [1.0, 1.0]], np.float32)


def falling(**members) -> Square:
    """A square that one falls from where one goes to the first goal at its edge; at the second one stays."""

    def begin(self, key):
        return jnp.ones(2, jnp.float32)

    env = changed(begin=begin, can_fail=True, fails=lambda self, place: place[0] > 1.15, **members)
    return env.replace(radius=0.15, episode_length=4, ends_at_goal=False)


def to_goal(observation, goal, key):
    """A step towards the goal."""
    return jnp.where(goal > 1.1, 1.0, 0.0)


def test_a_video_counts_no_success_where_an_episode_fails_at_its_goal(tmp_path):
    env = falling(draw=lambda self, state: jnp.zeros((16, 16, 3), jnp.uint8))
    assert drawn_video(env, to_goal, tmp_path / "falling.gif", AT_EDGE, seed=0, height=16) == [False, True]


def played_and_collected(env):
    """Episodes for the goals at the edge, as they are evaluated, and which of the same steps count as success in
    training."""

    @jax.jit
    def run(key):
        starts = jax.vmap(env.reset_to)(jax.random.split(key, 2), AT_EDGE)
        rows = collect(env, starts, to_goal, key, 4)[1]
        return run_episodes(env, starts, to_goal, key), ended_at_goal(env, rows)

    return run(jax.random.key(0))


def test_an_episode_that_fails_at_its_goal_is_no_success():
    """Where no goal ends an episode."""
    episodes, counted = played_and_collected(falling())
    assert episodes.steps.tolist() == [2, 4] and episodes.first_reached.tolist() == [2, 1]
    assert episodes.success.tolist() == [False, True]
    assert counted[:, 1].tolist() == [False, False] and counted[1].tolist() == [False, False, False, True]


def test_an_episode_that_diverges_at_its_goal_is_no_success(tmp_path):
    """Its last step is taken back, so that it is still there. In a video neither."""

    def move(self, place, action):
        return jnp.where(place[0] > 1.15, jnp.nan, place + 0.1 * action)

    def draw(self, state):
        return jnp.zeros((16, 16, 3), jnp.uint8)

    env = changed(begin=lambda self, key: jnp.ones(2, jnp.float32), move=move, draw=draw)
    env = env.replace(radius=0.15, episode_length=4, ends_at_goal=False)

    episodes, counted = played_and_collected(env)
    assert episodes.steps.tolist() == [3, 4] and episodes.first_reached.tolist() == [2, 1]
    assert episodes.success.tolist() == [False, True]
    assert not counted[0].any() and counted[1].tolist() == [False, False, False, True]
    assert drawn_video(env, to_goal, tmp_path / "leaving.gif", AT_EDGE, seed=0, height=16) == [False, True]


@pytest.mark.parametrize("discrete", [False, True])
def test_a_task_of_short_episodes_goes_with_the_preset_that_it_is_given(discrete):
    presets.register(f"short_{discrete}", changed(discrete=discrete).replace(episode_length=1))
    for method in ("none", "infogoal", "cogoal"):
        assert not reasons_against(presets.load(f"short_{discrete}", method))
