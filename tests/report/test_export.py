"""An exported policy says with NumPy what the run's policy says with JAX, and its file needs nothing of the package."""

import dataclasses
import json
import subprocess
import sys
from typing import NamedTuple

import flax.linen
import hand_made
import hand_made_frames
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT

from infogoal_jax import agents, envs, make_train, policy_file, presets
from infogoal_jax.agents.hrac import HRACConfig
from infogoal_jax.cli.export import actions_in_words
from infogoal_jax.cli.main import main
from infogoal_jax.envs.embodied_qa import EmbodiedQAConfig
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.errors import UserError, counted
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.loading import steer
from infogoal_jax.report import export, runs
from infogoal_jax.runs import low_level, tables
from infogoal_jax.train.program import Train

SHORT = {"num_epochs": 1, "epochs_per_evaluation": 1, "updates_per_epoch": 2, "evaluation_starts": 1}
WITHIN = 1e-5


class Case(NamedTuple):
    """A task and a method with parameters drawn at random."""

    train: Train
    params: dict


def case_of(config, env) -> Case:
    """Parameters of the sizes that training has, none of them zero."""
    train = make_train(config, env)
    return Case(train, hand_made_points.random_params(train))


@pytest.fixture(scope="module")
def shelf() -> Case:
    """Embodied question answering with sampled codes."""
    return case_of(hand_made_frames.qa_config("infogoal", **SHORT), hand_made_frames.qa())


@pytest.fixture(scope="module")
def exported(shelf, tmp_path_factory) -> policy_file.ExportedPolicy:
    """Its policy as read back."""
    return export.export_params(*shelf, tmp_path_factory.mktemp("export") / "policy.npz", {"seed": 0})


def standardised():
    """Whose goal encoder gives every image the same mean and contrast."""
    config = hand_made_frames.manipulation_config("infogoal", **SHORT)
    return dataclasses.replace(config, learner=dataclasses.replace(config.learner, standardise_images=True))


CASES = {
    "codes that depend on the state": (lambda: hand_made.config("gcb", **SHORT), hand_made.environment),
    "image goals of one contrast, as those of Fetch are": (standardised, hand_made_frames.manipulation),
    "image goals": (lambda: hand_made_frames.manipulation_config("infogoal", **SHORT), hand_made_frames.manipulation),
}


def check_alike(case: Case, exported: policy_file.ExportedPolicy) -> None:
    """The values of actions are those of JAX within 1e-5, for several goals, with and without noise."""
    env = case.train.env
    values, (_, _, noise) = export.action_values(*case)
    values, random = jax.jit(values), np.random.default_rng(0)
    look = jax.jit(lambda key: env.render(env.observe(env.reset(key))))
    for goal in range(min(env.goals.num_goals, 8)):
        seen = np.asarray(look(jax.random.key(goal)))
        inputs = np.asarray(env.goals.inputs_of(jnp.asarray(goal)))
        for drawn in (np.zeros(noise.shape, np.float32), random.normal(size=noise.shape).astype(np.float32)):
            expected = np.asarray(values(seen, inputs, drawn))
            np.testing.assert_allclose(exported.values(seen, inputs, drawn), expected, rtol=WITHIN, atol=WITHIN)


def test_values_are_those_of_jax(shelf, exported):
    check_alike(shelf, exported)


@pytest.mark.parametrize("name", CASES)
def test_other_networks_too(name, tmp_path):
    config, env = CASES[name]
    case = case_of(config(), env())
    check_alike(case, export.export_params(*case, tmp_path / "policy.npz", {}))


def test_actions_are_those_of_the_evaluation(shelf, exported):
    """The greedy action among the legal ones, by the mean of the code."""
    (train, params), env = shelf, shelf.train.env
    policy = train.policy(params, train.config.hyper, env, use_mean=True)
    images = np.arange(env.num_observations, dtype=np.int32)
    goals = images % np.int32(env.goals.num_goals)
    expected, masks = (
        np.asarray(each)
        for each in jax.jit(lambda *seen: (policy(*seen, jax.random.key(0)), env.action_mask(seen[0])))(images, goals)
    )
    found = [
        exported.act(np.asarray(env.images[image]), exported.goals[goal], mask)
        for image, goal, mask in zip(images, goals, masks, strict=True)
    ]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("code", ["sampled", "mean"])
def test_the_file_says_whether_it_acts_on_samples(code, tmp_path):
    case = case_of(with_values(hand_made.config("infogoal+all_goals"), {"agent.code": code}), hand_made.environment())
    exported = export.export_params(*case, tmp_path / "policy.npz", {})
    assert exported.about["samples_code"] == (code == "sampled")


def test_the_file_says_what_it_is_for(shelf, exported):
    about = exported.about
    assert (about["task"], about["method"], about["seed"]) == ("embodied_qa", "infogoal", 0)
    assert about["actions"] == list(hand_made_frames.shelf().actions)
    assert actions_in_words(about) == counted(len(about["actions"]), "action")
    assert len(about["goal_names"]) == len(about["goal_objects"]) == shelf.train.env.goals.num_goals
    assert set(about["goal_objects"]) <= set(hand_made_frames.OBJECTS)


def test_the_file_says_which_generated_shelf_it_is_for(exported, tmp_path):
    """The simulated drone flies before that one."""
    assert (exported.about["generator_seed"], exported.about["gathered"]) == (0, False)
    task = EmbodiedQAConfig(episode_length=15, generator_seed=3, gathered=True)
    case = case_of(hand_made_frames.qa_config("infogoal", env=task, **SHORT), hand_made_frames.qa())
    about = export.export_params(*case, tmp_path / "policy.npz", {}).about
    assert (about["generator_seed"], about["gathered"]) == (3, True)


def test_the_file_has_a_row_for_each_goal_where_several_images_show_one(tmp_path):
    """A privileged agent's goals are poses, of which an image each is held."""
    case = case_of(hand_made_frames.privileged_config("her", **SHORT), hand_made_frames.manipulation(privileged=True))
    policy = export.export_params(*case, tmp_path / "policy.npz", {"seed": 0})
    goals = case.train.env.goals
    assert len(policy.about["goal_names"]) == goals.num_goals < len(goals.inputs)
    np.testing.assert_array_equal(policy.goals, goals.inputs_of(jnp.arange(goals.num_goals)))


def test_the_file_names_the_moves_of_the_cube(tmp_path):
    case = case_of(hand_made_frames.manipulation_config("none", **SHORT), hand_made_frames.manipulation())
    about = export.export_params(*case, tmp_path / "policy.npz", {}).about
    assert about["actions"] == ["joint 1 +", "joint 1 -", "joint 2 +", "joint 2 -", "joint 6 +", "joint 6 -"]


def test_the_reader_needs_numpy_alone(shelf, tmp_path):
    """Its file is copied away and runs where the package is not."""
    export.export_params(*shelf, tmp_path / "policy.npz", {})
    (tmp_path / "policy_file.py").write_text((ROOT / "infogoal_jax" / "policy_file.py").read_text())
    code = (
        "import sys; sys.path.insert(0, '.'); import numpy as np, policy_file;"
        "policy = policy_file.ExportedPolicy('policy.npz'); shape, kind = policy.program['inputs'][1][0];"
        "policy.act(np.zeros(shape, kind), policy.goals[0]);"
        "assert not {'jax', 'flax', 'infogoal_jax'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-I", "-c", code], cwd=tmp_path, check=True)


def test_another_shape_is_refused(exported):
    with pytest.raises(ValueError, match="wants"):
        exported.values(np.zeros((3, 3), np.uint8), exported.goals[0])


@pytest.mark.parametrize(("name", "settings"), [("split", {"sizes": [1, 1], "axis": 0}), ("unstack", {"axis": 0})])
def test_an_operation_may_have_several_results(name, settings, tmp_path):
    """Newer versions of jax take arrays apart by `unstack`."""
    program = {
        "constants": 0,
        "inputs": [[0, 1, 2], [[[2, 3], "float32"]] * 3],
        "operations": [[name, [0], [3, 4], settings], ["sub", [4, 3], [5], {}]],
        "outputs": [5],
    }
    np.savez(tmp_path / "policy.npz", about='{"format_version": 1, "code_size": 0}', program=json.dumps(program))
    rows = np.arange(6, dtype=np.float32).reshape(2, 3)
    (difference,) = policy_file.ExportedPolicy(tmp_path / "policy.npz").run(rows, rows, rows)
    assert np.array_equal(difference.ravel(), [3, 3, 3])


WHOLE, BYTES = np.array([-7, 5, 12, 2], np.int32), np.array([200, 100, 7, 3], np.uint8)
FLOATS = np.array([-3.7, 30.5, 1.0, 2.0], np.float32)
TABLE = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
PLACES = np.array([[0, 3, -1], [2, 1, 9]], np.int32)
"""Of rows of the table, one of them from its end and one beyond it."""
OF_WHOLE_NUMBERS = {
    "quotients, towards zero": (jax.lax.div, WHOLE, WHOLE[::-1]),
    "quotients, rounded down": (lambda x: x // 2, WHOLE),
    "bits of both": (jax.lax.bitwise_and, WHOLE, WHOLE[::-1]),
    "bits of either": (jax.lax.bitwise_or, WHOLE, WHOLE[::-1]),
    "bits of none": (jax.lax.bitwise_not, WHOLE),
    "flags": (lambda x, y: (x > 3) & ~(y > 3) | (x > y), WHOLE, WHOLE[::-1]),
    "sums of bytes": (lambda x: jax.lax.reduce_sum(x, (0,)), BYTES),
    "sums of whole numbers": (lambda x: x.sum(), WHOLE),
    "products of bytes": (lambda x: jnp.dot(x, x, preferred_element_type=jnp.int32), BYTES),
    "powers": (lambda x, y: x**y, FLOATS, WHOLE),
    "what depends on no argument": (lambda x: (x + 1, jnp.arange(3.0)), FLOATS),
}


def check_replayed(function, *arguments) -> None:
    """An exported function gives what JAX gives, with NumPy, and as a low level, which JAX runs from the file."""
    program, constants = export.trace(function, [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arguments])
    expected, program = jax.tree.leaves(jax.jit(function)(*arguments)), json.loads(json.dumps(program))
    for operations in (policy_file.OPERATIONS, low_level.IN_JAX):
        for found, other in zip(
            policy_file.run_program(program, constants, arguments, operations), expected, strict=True
        ):
            assert found.dtype == other.dtype
            np.testing.assert_allclose(found, other, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", OF_WHOLE_NUMBERS)
def test_whole_numbers_and_flags_are_computed_as_jax_does(name):
    check_replayed(*OF_WHOLE_NUMBERS[name])


def test_numbers_that_numpy_alone_does_not_have_are_refused():
    with pytest.raises(UserError, match="^policy = 'bfloat16': give float32"):
        check_replayed(lambda x: (x.astype(jnp.bfloat16) * 2).astype(jnp.float32), FLOATS)


ACT_IN_VECTORS = [name for name in agents.registry if name not in ("dqn", "cql")]
OTHERS = {
    "rows of a table": (lambda x, at: x[at], TABLE, PLACES),
    "columns of a table, some beyond it": (lambda x, at: jnp.take(x, at, axis=1), TABLE, PLACES),
    "whole numbers, some beyond": (lambda x, at: jnp.take(x, at), WHOLE, PLACES),
    "one of each column": (lambda x, at: jnp.take_along_axis(x, at[:1], 0), TABLE, PLACES),
    "single elements": (lambda x, at: x[at[0], at[1]], TABLE, PLACES),
    "rows of each of several": (lambda x, at: jax.vmap(lambda x, at: x[at])(x, at), np.stack([TABLE] * 2), PLACES),
    "rows from a place on": (lambda x, at: jax.lax.dynamic_slice(x, (at[0, 0], at[1, 0]), (2, 2)), TABLE, PLACES),
    "lowest and highest": (lambda x: (x.argmin(0), x.argmax(1), x.min(), x.max(0)), TABLE),
    "all and any": (lambda x: ((x > -1).all(0), (x > 1).any(1), (x > 0).any()), TABLE),
    "bits of all and any": (lambda x: (jax.lax.reduce_and(x, (0,)), jax.lax.reduce_or(x, (0,))), BYTES),
    "bits of one": (lambda x, y: x ^ y, WHOLE, WHOLE[::-1]),
    "products": (lambda x, y: (x.prod(), y.prod(0)), WHOLE, FLOATS),
    "sums so far": (lambda x: (jnp.cumsum(x, 1), jax.lax.cumsum(x, 0, reverse=True)), TABLE),
    "rounded": (lambda x: (jnp.round(x), jax.lax.round(x), jnp.ceil(x)), np.float32([-2.5, -0.5, 0.4, 1.5, 2.5])),
    "turned and stacked": (lambda x: jnp.stack([x[::-1], jnp.roll(x, 1, 0)], 1), TABLE),
    "padded and cut": (lambda x: jax.lax.pad(x, -1.0, ((1, 0, 0), (-1, 2, 0))), TABLE),
    "functions of flax": (lambda x: (flax.linen.gelu(x), flax.linen.softplus(x), flax.linen.softmax(x)), FLOATS),
    "angles": (lambda x: (jnp.arctan2(x, x[::-1]), jnp.arcsin(jnp.sin(x)), jnp.tan(x)), FLOATS),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_operations_do_as_with_jax(name):
    check_replayed(*OTHERS[name])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "sac" else pytest.mark.long) for name in ACT_IN_VECTORS]
)
def test_the_policy_of_every_agent_for_vectors_is_exported(name, tmp_path):
    """On points; what is exported is held to what JAX gives before it is kept."""
    preset = presets.load("fetch_reach", "her" if name == "crl" else "none", agent=name)
    small = hand_made_points.config("none", **SHORT)
    hyper = presets.default_hyperparameters(small.learner, preset.agent)
    config = dataclasses.replace(small, agent=preset.agent, relabelling=preset.relabelling, hyper=hyper)
    env = hand_made_points.steered() if name == "hrac" else hand_made_points.points()
    exported = export.export_params(*case_of(config, env), tmp_path / "policy.npz", {})
    assert not exported.about["discrete"]


def raises(*arguments, **settings):
    """An operation that NumPy refuses."""
    raise TypeError("no such numbers")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [(lambda x, y, **_: np.minimum(x, y), "and JAX"), (raises, "NumPy raised TypeError: no such numbers")],
)
def test_a_policy_that_numpy_runs_in_another_way_is_not_kept(wrong, words, shelf, tmp_path, monkeypatch):
    file = tmp_path / "policy.npz"
    file.write_bytes(b"the one before")
    monkeypatch.setitem(policy_file.OPERATIONS, "max", wrong)
    with pytest.raises(UserError, match=rf"^policy.*{words}.*mend in policy_file.py the one of .*, max, "):
        export.export_params(*shelf, file, {})
    assert file.read_bytes() == b"the one before"


def test_floats_of_another_size_are_taken(shelf, exported):
    """NumPy's own are of 64 bits, as its noise is."""
    seen = np.asarray(shelf.train.env.render(shelf.train.env.observe(shelf.train.env.reset(jax.random.key(0)))))
    goal, noise = exported.goals[0], np.full(exported.about["code_size"], 0.5)
    expected = exported.values(seen, goal, noise.astype(np.float32))
    assert np.array_equal(exported.values(seen, goal.astype(np.float64), noise), expected)


def test_a_policy_of_choices_drives_nothing(exported):
    with pytest.raises(ValueError, match="actions are choices: call act"):
        exported.drive(None, exported.goals[0], 0)


def test_a_policy_of_two_levels_values_nothing_and_chooses_a_target_where_it_has_none(tmp_path):
    """At whatever step it is asked first."""
    case = case_of(hand_made_points.config("none", **SHORT), hand_made_points.steered())
    policy = export.export_params(*case, tmp_path / "policy.npz", {})
    (shape, kind), seen = policy.program["inputs"][1][1], np.array([1.3, 0.7, 0.5] + [0.0] * 7)
    goal = np.ones(shape, kind)
    with pytest.raises(ValueError, match="actions are vectors: call drive"):
        policy.values(seen, goal)
    for broken in (np.nan, np.inf):  # A sensor that fails is no reason for an arbitrary action.
        with pytest.raises(ValueError, match="not finite, of which no action follows"):
            policy.drive(np.where(np.arange(10) == 4, broken, seen), goal, 0)
    first, later = (policy.drive(seen, goal, step)[1] for step in (0, 1))
    assert np.array_equal(first, later) and first.any()
    assert np.array_equal(policy.drive(seen, goal, 1, 0 * first)[1], 0 * first)


def test_a_file_that_is_no_policy_is_refused(tmp_path):
    np.savez(tmp_path / "images.npz", images=np.zeros(3))
    with pytest.raises(ValueError, match=r"images.npz: is no policy of `infogoal export`"):
        policy_file.ExportedPolicy(tmp_path / "images.npz")


def reach() -> Case:
    """FetchReach with image goals under HRAC and the low level that is shipped."""
    env = steer(envs.load("fetch_reach", FetchConfig(goals="images")), HRACConfig())
    return case_of(hand_made_points.config("infogoal", **SHORT), env)


def cube() -> Case:
    """The cube under HRAC: image observations, angles of joints, a low level with discrete moves."""
    agent = presets.load("object_manipulation").agent
    config = hand_made_frames.manipulation_config("infogoal", agent=agent, **SHORT)
    return case_of(config, steer(hand_made_frames.manipulation(), config.agent))


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "actions"),
    [(reach, "drives by continuous actions, vectors of 4"), (cube, "drives by 6 moves, whose numbers `drive` returns")],
)
def test_both_levels_of_continuous_policies_do_as_with_jax(make, actions, tmp_path):
    """Over an episode, in which the robot goes where the file says: actions and targets of both are the same."""
    case = make()
    (train, params), env, goal, target = case, case.train.env, 3, None
    exported = export.export_params(*case, tmp_path / "policy.npz", {})
    assert actions_in_words(exported.about) == actions
    policy = train.policy(params, train.config.hyper, env, use_mean=True)
    decide = jax.jit(
        lambda seen, goal: policy(jax.tree.map(lambda leaf: leaf[None], seen), goal[None], jax.random.key(0))
    )
    state, step = jax.jit(env.reset)(jax.random.key(1)), jax.jit(env.step)
    inputs = np.asarray(env.goals.inputs_of(jnp.asarray(goal)))
    for number in range(2 * exported.about["interval"] + 1):
        stored = env.observe(state)
        if hasattr(stored, "joints"):
            seen, body = np.asarray(env.render(stored)), np.asarray(stored.joints)
        else:
            seen, body = np.asarray(stored), None
        action, target = exported.drive(seen, inputs, number, target, body=body)
        (subgoal,) = decide(stored, jnp.asarray(goal))
        before, state = state, step(state, subgoal)
        np.testing.assert_allclose(target, state.target, rtol=WITHIN, atol=WITHIN)
        expected = np.asarray(env.low_level.act(stored, state.target))
        np.testing.assert_allclose(action, expected, rtol=WITHIN, atol=WITHIN)
        assert not np.array_equal(before.target, state.target) or number % exported.about["interval"]


def test_a_seed_that_is_not_there_or_diverged_is_refused(shelf, tmp_path):
    run = runs.Run(
        config=shelf.train.config, seeds=[0, 1], data="", versions={}, device="", folder=tmp_path, name="run"
    )
    with pytest.raises(UserError, match="seed = 7"):
        export.export(run, tmp_path / "policy.npz", 7)
    assert run.seed_of() == 0 and dataclasses.replace(run, seeds=[5, 6]).seed_of() == 5
    lost = dict.fromkeys(tables.WATCHED, float("nan")) | {"seed": 0, "epoch": 1}
    tables.append_rows(tmp_path, "epochs", [lost])
    with pytest.raises(UserError, match="seed = 0: diverged in training: give another one"):
        export.export(run, tmp_path / "policy.npz")


def test_stablehlo_gives_the_same(shelf, exported, tmp_path):
    pytest.importorskip("flatbuffers", reason="JAX writes StableHLO by flatbuffers, which is not installed")
    export.export_params(*shelf, tmp_path / "policy.npz", {}, tmp_path / "policy.stablehlo")
    program = jax.export.deserialize(bytearray((tmp_path / "policy.stablehlo").read_bytes()))
    seen, noise = np.asarray(shelf.train.env.images[0]), np.zeros(exported.about["code_size"], np.float32)
    expected = exported.values(seen, exported.goals[0], noise)
    np.testing.assert_allclose(program.call(seen, exported.goals[0], noise), expected, rtol=WITHIN, atol=WITHIN)


def test_nothing_is_written_where_stablehlo_cannot_be(shelf, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax._src.export.serialization", None)  # As without flatbuffers.
    with pytest.raises(UserError, match=r"stablehlo = .*pip install flatbuffers"):
        export.export_params(*shelf, tmp_path / "policy.npz", {}, tmp_path / "policy.stablehlo")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [{"frames": np.zeros(3)}, b"somebody's own"], ids=["dataset", "text"])
def test_what_is_no_policy_is_not_written_over(content, tmp_path, capsys):
    file = tmp_path / "mine.npz"
    np.savez(file, **content) if isinstance(content, dict) else file.write_bytes(content)
    before = file.read_bytes()
    assert main(["export", str(tmp_path), "--out", str(file)]) == 2
    assert "is there already and is no exported policy" in capsys.readouterr().err and file.read_bytes() == before
