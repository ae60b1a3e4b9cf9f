"""An environment, a learner, an agent, a relabelling or an explorer from outside that breaks its contract is refused
when its training is made or traced, by the name of the function; and what the package brings keeps the contracts."""

import contextlib
import dataclasses
import itertools

import flax.struct
import hand_made
import hand_made_frames
import hand_made_points
import jax
import jax.numpy as jnp
import nbformat
import numpy as np
import pytest
from places import ROOT, block_of

from infogoal_jax import (
    UserError,
    agents,
    checks,
    envs,
    exploration,
    learners,
    loading,
    make_train,
    presets,
    relabelling,
)
from infogoal_jax.envs.contract import check_contract, check_starts
from infogoal_jax.envs.environment import Environment
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.envs.goal_task import GoalTask
from infogoal_jax.goals import GoalBox
from infogoal_jax.loading import check_environment
from infogoal_jax.networks import ImageLayers
from infogoal_jax.registry import Entry
from infogoal_jax.train import checked_parts

ENV = hand_made.environment()
CONFIG, BARE = (
    hand_made.config(method, num_epochs=2, epochs_per_evaluation=1, updates_per_epoch=1)
    for method in ("infogoal", "none")
)


def changed(**members):
    """The hand-made task with other members, as a class of a user's own."""
    own = flax.struct.dataclass(type("Own", (type(ENV),), {"__module__": "own", **members}))
    return own(**{field.name: members.get(field.name, getattr(ENV, field.name)) for field in dataclasses.fields(ENV)})


def trace(train):
    """Trace a chunk: nothing is compiled."""

    def chunk(key, env):
        numbers = jnp.arange(1, dtype=jnp.int32)
        return train.chunk(train.initial(key, train.config.hyper, env), numbers, train.config.hyper, env)

    return jax.eval_shape(chunk, jax.random.key(0), train.env)


@pytest.mark.parametrize("make", [hand_made.environment, hand_made_frames.manipulation, hand_made_frames.qa])
def test_the_package_s_environments_keep_the_contract(make):
    check_contract(make())


BANK = np.zeros((2, 8, 8, 1), np.uint8)


@pytest.mark.parametrize(
    ("made", "members", "message"),
    [
        (hand_made.environment, {"test_backgrounds": BANK}, "env.train_backgrounds = None: .*or for neither"),
        (
            hand_made.environment,
            dict(train_backgrounds=BANK, test_backgrounds=BANK),
            r"env.train_backgrounds = 'uint8 \[2, 8, 8, 1\]': goals are no images, but float32 \[16\]; give None",
        ),
        (
            hand_made_frames.manipulation,
            {"test_backgrounds": np.zeros((2, 4, 4, 3), np.uint8)},
            r"env.test_backgrounds = 'uint8 \[2, 4, 4, 3\]': give uint8 \[B, .*, as goal images are",
        ),
    ],
)
def test_backgrounds_are_those_of_goal_images(made, members, message):
    with pytest.raises(UserError, match=message):
        check_contract(made().replace(**members))


@pytest.mark.parametrize("name", ["observation", "record", "action", "desired_goal", "terminated"])
def test_recordings_are_rows_of_what_the_task_gives(name):
    """A row has one observation more than transitions."""
    env = hand_made_frames.qa()
    rows = jax.tree.map(lambda leaf: leaf[:, :-1], getattr(env.recorded, name))
    with pytest.raises(UserError, match=rf"env.recorded.{name}: leaf .*give both the same"):
        check_contract(env.replace(recorded=env.recorded.replace(**{name: rows})))


def test_goal_images_have_sides_that_the_first_layer_can_cut():
    with pytest.raises(UserError, match=r"goal images = \[12, 8\]: give sides that 8 divides"):
        ImageLayers(standardise=True).init(jax.random.key(0), jnp.zeros((1, 12, 8, 3), jnp.uint8))


def test_environments_of_vectors_keep_the_contract():
    check_contract(hand_made_points.steered())
    check_contract(envs.load("fetch_reach", FetchConfig()))


def wrong_leaf(name, value):
    """A step or reset after which this field is something else."""
    return lambda self, *arguments: type(ENV).step(self, *arguments).replace(**{name: value})


def reset_for(goal):
    """A reset whose desired goal is always this one."""
    return lambda self, key: type(ENV).reset(self, key).replace(desired_goal=jnp.int32(goal))


BROKEN = {
    "step": (dict(step=wrong_leaf("time", jnp.zeros(()))), r"state of env.step: leaf .time is float32 \[\], and int32"),
    "step of one more": (dict(step=wrong_leaf("node", jnp.zeros((1,), jnp.int32))), r"leaf .node is int32 \[1\]"),
    "no step": (dict(step=lambda self, state, action: None), "state of env.step: leaf .* not there"),
    "step that raises": (
        dict(step=lambda self, state, action: state.nothing),
        "env.step: raised AttributeError.*nothing",
    ),
    "step of fewer arguments": (dict(step=lambda self, state: state), "env.step: raised TypeError"),
    "reset": (dict(reset=lambda self, key: (key,)), "the state of env.reset = 'tuple': has no field desired_goal"),
    "reset for a test goal": (
        dict(reset=reset_for(5)),
        r"the goal of env.reset = \['test_1'\]: is held out of training; draw it from env.goals.desired_goals",
    ),
    "reset for no goal": (dict(reset=reset_for(-1)), "the goal of env.reset = .*: the task has the goals 0 to 7"),
    "starts that are not finite": (
        dict(render=lambda self, seen: jnp.full((*jnp.shape(seen), 3), jnp.nan, jnp.float32), draw=Environment.draw),
        "env.observe = 'not finite at 100% of the starts': return finite numbers",
    ),
    "reset_to": (dict(reset_to=lambda self, key, goal: 0), "the state of env.reset = .*has no field desired_goal"),
    "observe": (dict(observe=lambda self, state: jnp.zeros(3)), r"env.observe: is float32 \[3\]; give int32 \[\]"),
    "observe nothing": (dict(observe=lambda self, state: ()), "env.observe = .*return an array"),
    "render": (dict(render=lambda self, seen: jnp.zeros((3, 3))), r"env.render: returns float32 \[3, 3\] of one"),
    "render of one": (
        dict(render=lambda self, seen: jnp.zeros(3)),
        r"env.render: is float32 \[3\]; give .*\[2, 3, 3\]",
    ),
    "reached": (dict(reached=lambda self, record, goal: (record == goal)[..., None]), "leaf .terminated is bool"),
    "goals_of": (dict(goals_of=lambda self, record: record), r"env.goals_of: is int32 \[\]; give int32 \[K\]"),
    "goals_of floats": (dict(goals_of=lambda self, record: record[..., None] * 1.0), "env.goals_of: is float32"),
    "cell_of": (dict(cell_of=lambda self, record: record > 0), r"env.cell_of: is bool \[\]; give int32"),
    "cell_of without cells": (
        dict(num_cells=1),
        r"env.cell_of = \[\d+\]: give cells from 0 to below env.num_cells = 1",
    ),
    "action_mask": (dict(action_mask=lambda self, seen: jnp.ones(6)), r"env.action_mask: is float32 \[6\]; give bool"),
    "decides": (dict(decides=lambda self, state: 1), r"env.decides: is int32 \[\]; give bool"),
    "action_size": (dict(action_size=True), "env.action_size = True: give a whole number from 1"),
    "action_size of none": (dict(action_size=0), "env.action_size = 0: give a whole number from 1"),
    "action_size of billions": (dict(action_size=2**31), "env.action_size = 2147483648: give a whole number from 1 to"),
    "goals": (dict(goals=[0, 1]), "env.goals = 'list': give GoalSet.of or GoalBox.of"),
    "render nothing": (dict(render=lambda self, seen: jnp.zeros(0, jnp.float32)), r"env.render: returns float32 \[0\]"),
    "draw": (dict(draw=3), "env.draw = 3: give a function"),
    "draw a float": (
        dict(draw=lambda self, state: jnp.zeros((4, 4, 3))),
        r"env.draw: is float32 .*give uint8 \[H, W, 3",
    ),
    "draw nothing": (
        dict(draw=lambda self, state: jnp.zeros((0, 4, 3), jnp.uint8)),
        "env.draw = .*give a picture with",
    ),
    "discrete of several": (dict(discrete=np.zeros(2)), "env.discrete = array.*give True or False"),
    "discrete": (dict(discrete=1), "env.discrete = 1: give True or False"),
    "num_observations": (dict(num_observations=2.0), "env.num_observations = 2.0: give a whole number"),
    "recorded": (dict(recorded=[1]), "recorded is True, should be False"),
    "goal_positions": (dict(goal_positions=np.zeros((2, 2), np.float32)), "env.goal_positions = .*give float32"),
    "near_goals": (dict(near_goals=np.zeros(8)), r"env.near_goals = 'float32.*give bool \[8\]"),
    "near_goals of none": (dict(near_goals=lambda self: None), "env.near_goals = 'method': give bool"),
    "backgrounds": (dict(test_backgrounds=np.zeros((2, 3, 4, 4), np.float32)), "env.test_backgrounds = .*give uint8"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_an_environment_that_breaks_the_contract_is_refused(case):
    members, message = BROKEN[case]
    with pytest.raises(UserError, match=message):
        make_train(CONFIG, changed(**members))


def test_an_environment_that_keeps_it_is_trained():
    trace(make_train(BARE, changed()))


def test_test_goals_are_desired_where_the_configuration_says_so():
    """As a reading of the paper has it."""
    config = dataclasses.replace(BARE, desired_goals="all")
    assert make_train(config, changed(reset=reset_for(5))).env.goals.desired_mask.all()


def test_recordings_for_goals_that_are_held_out_are_refused():
    """Of a finite set: their codes would be looked up among those of training goals. The rows that are no transitions
    may have any."""
    env = hand_made_frames.qa()
    check_starts(env)
    rows, held_out = env.recorded, int(np.flatnonzero(env.goals.test_mask)[0])
    goals = jnp.where(rows.valid, rows.desired_goal, held_out)
    check_starts(env.replace(recorded=rows.replace(desired_goal=goals)))
    of_test = rows.replace(desired_goal=jnp.full_like(goals, held_out))
    with pytest.raises(UserError, match=r"^env.recorded.desired_goal = \['.*'\]: is held out of training; give"):
        check_starts(env.replace(recorded=of_test))


class InALine(GoalTask):
    """A point on a line moves towards its goal."""

    def begin(self, key):
        return jax.random.uniform(key, (1,), jnp.float32)

    def move(self, world, action):
        return world + 0.1 * action

    def observation(self, world):
        return world

    def achieved_goal(self, world):
        return world


def in_a_line(goals=None, members=(), **fields):
    """The task with other members and fields, as a class of a user's own."""
    own = flax.struct.dataclass(type("Own", (InALine,), {"__module__": "own", "action_size": 1, **dict(members)}))
    return own(GoalBox.of([0.0], [1.0]) if goals is None else goals, **fields)


def test_a_goal_task_keeps_the_contract():
    check_contract(in_a_line())


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, np.inf, None, "1", True, 1e-30, 1e30, 10**400, np.ones(2)])
def test_a_radius_that_nothing_lies_within_is_refused(radius):
    with pytest.raises(UserError, match="env.radius = .*give a distance above 0"):
        check_contract(in_a_line(radius=radius))


@pytest.mark.parametrize(("name", "array"), [("near_goals", np.zeros(3, bool)), ("goal_positions", np.zeros((3, 2)))])
def test_what_each_goal_of_a_set_has_no_box_has(name, array):
    members = {name: array.astype(np.float32) if array.ndim == 2 else array}
    with pytest.raises(UserError, match=f"env.{name} = .*: the goals are no finite set"):
        check_contract(in_a_line(members=members))


def test_a_goal_task_has_a_box_of_goals():
    with pytest.raises(UserError, match="env.goals = 'GoalSet': a GoalTask has a GoalBox"):
        check_contract(in_a_line(ENV.goals))


@pytest.mark.parametrize("name", ["begin", "move", "observation", "achieved_goal"])
@pytest.mark.parametrize(
    "found", [None, 3, "a", [1.0], jnp.zeros(0), jnp.zeros(()), jnp.zeros((2, 2)), jnp.zeros(1, jnp.int32)]
)
def test_a_function_of_a_goal_task_that_returns_something_else_is_refused(name, found):
    with pytest.raises(UserError, match="env"):
        check_contract(in_a_line(members={name: lambda self, *arguments: found}))


MEMBERS = sorted(name for name in vars(Environment) if not name.startswith("_") and name != "unwrapped")
MEMBERS += ["goals", "action_size", "episode_length", "source", "radius", "begin", "move", "observation"]
ODD = [None, True, 0, -1, 1, 2**31, 10**400, 0.5, float("nan"), "x", "\ud800", b"x", (), [0.0], {"a": 1}, object(), int]
ODD += [np.zeros(()), np.zeros(2), np.zeros((2, 0)), np.array(["a"]), np.array([None], object), jnp.zeros((2, 3, 4))]
ODD += [jnp.zeros(1, jnp.int32), jnp.zeros(1, jnp.bfloat16), jax.ShapeDtypeStruct((1,), "float32"), ENV.goals]


@pytest.mark.parametrize("apart", [139, pytest.param(1, marks=pytest.mark.long)])
def test_whatever_a_member_of_a_task_is_it_keeps_the_contract_or_is_refused(apart):
    """A value, or a function that returns one: some thirty of four thousand, and all of them."""
    makers = (changed, lambda **found: in_a_line(members=found))
    every = itertools.product(makers, MEMBERS, ODD, (False, True))
    for make, name, value, is_function in itertools.islice(every, 0, None, apart):
        with contextlib.suppress(UserError):
            env = make(**{name: (lambda self, *arguments, value=value: value) if is_function else value})
            check_environment(CONFIG, env)
            check_contract(env)


def test_a_set_of_goals_is_no_observation():
    """Though it has a shape and a type."""
    with pytest.raises(UserError, match="env.render"):
        check_contract(changed(render=lambda self, *arguments: ENV.goals))


REGISTRIES = {
    "learner": (learners.registry, CONFIG.learner),
    "agent": (agents.registry, CONFIG.agent),
    "relabelling": (relabelling.registry, relabelling.registry["her"].config()),
    "explorer": (exploration.registry, exploration.registry["sse_db"].config()),
}


def training_with(monkeypatch, kind, change):
    """Training with a part of the package as one of a user's own, changed; beside learners of one's own those of the
    paper, beside other parts the bare agent."""
    registry, config = REGISTRIES[kind]
    whole = CONFIG if kind == "learner" else BARE
    entry = registry.entry_of(config)

    def make(*arguments):
        return change(entry.make(*arguments))

    make.__module__ = "own"
    own = dataclasses.dataclass(frozen=True)(type("OwnConfig", (entry.config,), {"__module__": __name__}))
    monkeypatch.setitem(registry, "own", Entry(own, make, entry.hyper, entry.traits))
    fields = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return make_train(dataclasses.replace(whole, **{kind: own(**fields)}), ENV)


def replaced(name, change):
    """A part whose function of this name gives back something else."""

    def of(part):
        function = getattr(part, name)
        return part._replace(**{name: lambda *arguments: change(function(*arguments))})

    return of


WRONG = [
    ("learner", lambda part: None, "learner = 'NoneType': its make has to return a Learner"),
    ("learner", lambda part: part._replace(loss=None, encode=3), "learner.encode = 3"),
    ("learner", lambda part: part._replace(encode=lambda params: 0), "learner.encode = .*cannot be called with 2"),
    ("learner", lambda part: part._replace(sample_spec=3), "learner.sample_spec = 'int': give a SampleSpec"),
    ("learner", lambda part: part._replace(sample_spec=part.sample_spec._replace(window=-1)), "window = -1"),
    ("learner", replaced("init", lambda found: found[0]), r"learner.init = .*return \(params, state\)"),
    ("learner", replaced("encode", lambda code: code.mean), r"learner.encode = 'float32.*return a GoalCode"),
    ("learner", replaced("encode", lambda code: code.replace(mean=code.mean[0])), "the mean of learner.encode: is"),
    ("learner", replaced("encode", lambda code: code.replace(std=code.std[..., :1])), "the std of learner.encode: is"),
    ("learner", replaced("loss", lambda found: found[0]), r"learner.loss = .*return \(loss, metrics, state\)"),
    ("learner", replaced("loss", lambda found: (jnp.zeros(2), *found[1:])), "the loss of learner.loss: is float32"),
    ("learner", replaced("loss", lambda found: (found[0], [], found[2])), "the metrics of learner.loss = "),
    ("learner", replaced("loss", lambda found: (found[0], {"a": jnp.ones(2)}, found[2])), r"learner.loss\['a'\] = "),
    ("learner", replaced("loss", lambda found: (*found[:2], ())), "the state of learner.loss: leaf"),
    (
        "learner",
        replaced("loss", lambda found: 1 / 0),
        r"learner.loss: raised ZeroDivisionError .*: division by zero \(test_own_contracts.py, line \d+\)",
    ),
    ("learner", replaced("intrinsic_reward", lambda found: (found[0][0], found[1])), "the reward of learner.intrinsic"),
    ("agent", lambda part: part.init, "agent = 'function': its make has to return an Agent"),
    ("agent", lambda part: part._replace(num_steps=0), "agent.num_steps = 0"),
    ("agent", replaced("init", lambda found: found[0]), r"agent.init = .*return \(params, state\)"),
    ("agent", replaced("act", lambda found: found * 1.0), r"agent.act: is float32 \[8\]; give int32 \[8\]"),
    ("agent", replaced("act", lambda found: found[0]), r"agent.act: is int32 \[\]; give int32 \[8\]"),
    ("agent", replaced("loss", lambda found: found[0]), r"agent.loss = .*return \(loss, metrics\)"),
    ("agent", replaced("observe", lambda found: (1,)), "the state of agent.observe: leaf"),
    ("relabelling", lambda part: 3, "relabelling = 'int': its make has to return a Relabelling"),
    ("relabelling", lambda part: part._replace(candidates=2), "relabelling.candidates = 2"),
    ("relabelling", replaced("relabel", lambda found: found * 1.0), "relabelling.relabel: is float32"),
    ("relabelling", replaced("relabel", lambda found: found[:1]), "relabelling.relabel: is int32"),
    ("explorer", lambda part: 3, "explorer = 'int': its make has to return an Explorer"),
    ("explorer", replaced("compute_bonus", lambda found: found[0]), r"compute_bonus = .*return \(bonus, state\)"),
    ("explorer", replaced("compute_bonus", lambda found: (found[0].T, found[1])), "the bonus of explorer.compute_bon"),
    ("explorer", replaced("loss", lambda found: found[:2]), r"explorer.loss = .*return \(loss, metrics, state\)"),
]


@pytest.mark.parametrize(("kind", "change", "message"), WRONG, ids=range(len(WRONG)))
def test_a_part_that_breaks_its_contract_is_refused(monkeypatch, kind, change, message):
    with pytest.raises(UserError, match=message):
        trace(training_with(monkeypatch, kind, change))


@pytest.mark.parametrize("kind", REGISTRIES)
def test_a_part_that_keeps_it_is_trained(monkeypatch, kind):
    trace(training_with(monkeypatch, kind, lambda part: part))


@pytest.mark.long
@pytest.mark.parametrize(
    ("learner", "relabelled"),
    [("infobot", "her"), ("cogoal", "cher"), ("gcb", "ghrl"), ("vae", "none"), ("dgrl", "none"), ("rad", "her")],
)
def test_the_package_s_parts_keep_the_contract(monkeypatch, learner, relabelled):
    monkeypatch.setattr(checked_parts, "is_foreign", lambda made_by: True)
    monkeypatch.setattr(loading, "is_foreign", lambda made_by: True)
    config = relabelling.registry[relabelled].config()
    trace(make_train(hand_made.config(learner, updates_per_epoch=1, relabelling=config), ENV))


@pytest.mark.long
@pytest.mark.parametrize("task", ["two_rooms", "walled_square"])
def test_a_documented_task_is_the_same_whatever_jax_is_set_to(task):
    """Traced, with the types that it has without: the task of the page, and that of the notebook."""
    if task == "two_rooms":
        script = block_of("guides/own_task.md")
    else:
        cells = nbformat.read(ROOT / "notebooks" / "your_own.ipynb", as_version=4).cells
        script = "\n".join(cell.source for cell in cells if cell.id in ("imports", "task"))

    def traced():
        exec(script, {"__name__": "own_task"})
        return trace(make_train(presets.load(task, "infogoal", relabelling="her", updates_per_epoch=1)))

    try:
        with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
            plain = checks.shapes(traced())
        with jax.enable_x64(True):
            assert checks.shapes(traced()) == plain
    finally:
        for registry in (envs.registry, presets.registry):
            registry.pop(task, None)
