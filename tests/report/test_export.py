"""An exported policy says with NumPy what the run's policy says with JAX, and its file needs nothing of the package."""

import subprocess
import sys

import hand_made
import hand_made_frames
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT

from infogoal_jax import policy_file
from infogoal_jax.errors import UserError
from infogoal_jax.learners.learner import encode_goals
from infogoal_jax.report import export, runs
from infogoal_jax.train import host
from infogoal_jax.train.policies import tested_policy

SHORT = {"num_epochs": 1, "epochs_per_evaluation": 1, "updates_per_epoch": 2, "evaluation_starts": 1}
WITHIN = 1e-5


def run_of(folder, config, env) -> runs.Run:
    """A run of this configuration, trained for a moment, as read back."""
    sweep = host.run(config, [0, 1], folder, env=env)
    run = runs.load_run(folder)
    run.__dict__["train"] = sweep.train  # The hand-made environment is in no file.
    return run


@pytest.fixture(scope="module")
def shelf_run(tmp_path_factory) -> runs.Run:
    """Embodied question answering with sampled codes."""
    folder = tmp_path_factory.mktemp("export") / "run"
    return run_of(folder, hand_made_frames.qa_config("infogoal", **SHORT), hand_made_frames.qa())


CASES = {
    "codes that depend on the state": (lambda: hand_made.config("gcb", **SHORT), hand_made.environment),
    "image goals": (lambda: hand_made_frames.manipulation_config("infogoal", **SHORT), hand_made_frames.manipulation),
}


def check_alike(run: runs.Run, exported: policy_file.ExportedPolicy, seed: int) -> None:
    """The values of actions are those of JAX within 1e-5, for every goal, with and without noise."""
    env = run.env
    values, (_, _, noise) = export.action_values(run, seed)
    random = np.random.default_rng(0)
    for goal in range(env.goals.num_goals):
        state = env.reset(jax.random.key(goal))
        seen = np.asarray(env.render(env.observe(state)))
        inputs = np.asarray(env.goals.inputs_of(jnp.asarray(goal)))
        for drawn in (np.zeros(noise.shape, np.float32), random.normal(size=noise.shape).astype(np.float32)):
            expected = np.asarray(jax.jit(values)(seen, inputs, drawn))
            np.testing.assert_allclose(exported.values(seen, inputs, drawn), expected, rtol=WITHIN, atol=WITHIN)


@pytest.mark.parametrize("seed", [0, 1])
def test_values_are_those_of_jax(shelf_run, tmp_path, seed):
    check_alike(shelf_run, export.export(shelf_run, tmp_path / "policy.npz", seed), seed)


@pytest.mark.parametrize("case", CASES)
def test_other_networks_too(case, tmp_path):
    config, env = CASES[case]
    run = run_of(tmp_path / "run", config(), env())
    check_alike(run, export.export(run, tmp_path / "policy.npz"), 0)


def test_actions_are_those_of_the_evaluation(shelf_run, tmp_path):
    """The greedy action among the legal ones, by the mean of the code."""
    exported = export.export(shelf_run, tmp_path / "policy.npz")
    env, parts = shelf_run.env, shelf_run.train.parts
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), runs.read_params(shelf_run, shelf_run.train))
    encode = encode_goals(parts.learner, params["goal"], env.goals, shelf_run.config.batch_size)
    policy = tested_policy(parts, params, shelf_run.config.hyper, env, encode, use_mean=True)
    images = jnp.arange(env.num_observations)
    goals = images % env.goals.num_goals
    expected, masks = np.asarray(policy(images, goals, jax.random.key(0))), np.asarray(env.action_mask(images))
    found = [
        exported.act(np.asarray(env.images[image]), exported.goals[goal], mask)
        for image, goal, mask in zip(np.asarray(images), np.asarray(goals), masks, strict=True)
    ]
    np.testing.assert_array_equal(found, expected)


def test_the_file_says_what_it_is_for(shelf_run, tmp_path):
    about = export.export(shelf_run, tmp_path / "policy.npz").about
    assert (about["task"], about["method"]) == ("embodied_qa", "infogoal")
    assert about["actions"] == list(hand_made_frames.shelf().actions)
    assert len(about["goal_names"]) == len(about["goal_objects"]) == shelf_run.env.goals.num_goals
    assert set(about["goal_objects"]) <= set(hand_made_frames.OBJECTS)


def test_the_reader_needs_numpy_alone(shelf_run, tmp_path):
    """Its file is copied away and runs where the package is not."""
    export.export(shelf_run, tmp_path / "policy.npz")
    (tmp_path / "policy_file.py").write_text((ROOT / "infogoal_jax" / "policy_file.py").read_text())
    code = (
        "import sys, policy_file; policy = policy_file.ExportedPolicy('policy.npz');"
        "import numpy as np; shape, kind = policy.program['inputs'][1][0];"
        "print(policy.act(np.zeros(shape, kind), policy.goals[0]));"
        "assert not {'jax', 'flax', 'infogoal_jax'} & set(sys.modules)"
    )
    subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, '.'); {code}"], cwd=tmp_path, check=True
    )


def test_another_shape_is_refused(shelf_run, tmp_path):
    exported = export.export(shelf_run, tmp_path / "policy.npz")
    with pytest.raises(ValueError, match="wants"):
        exported.values(np.zeros((3, 3), np.uint8), exported.goals[0])


def test_continuous_actions_are_refused(tmp_path):
    run = run_of(tmp_path / "run", hand_made_points.config("none", **SHORT), hand_made_points.steered())
    with pytest.raises(UserError, match="continuous"):
        export.export(run, tmp_path / "policy.npz")


def test_a_seed_that_is_not_there_is_refused(shelf_run, tmp_path):
    with pytest.raises(UserError, match="seed = 7"):
        export.export(shelf_run, tmp_path / "policy.npz", 7)


def test_stablehlo_gives_the_same(shelf_run, tmp_path):
    pytest.importorskip("flatbuffers", reason="JAX writes StableHLO by flatbuffers, which is not installed")
    exported = export.export(shelf_run, tmp_path / "policy.npz", 0, tmp_path / "policy.stablehlo")
    program = jax.export.deserialize(bytearray((tmp_path / "policy.stablehlo").read_bytes()))
    seen, noise = np.asarray(shelf_run.env.images[0]), np.zeros(exported.about["code_size"], np.float32)
    expected = exported.values(seen, exported.goals[0], noise)
    np.testing.assert_allclose(program.call(seen, exported.goals[0], noise), expected, rtol=WITHIN, atol=WITHIN)
