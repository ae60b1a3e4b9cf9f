"""The whole program with HRAC, on a world of points without physics (`hand_made_points`) and on the real tasks made
small."""

import dataclasses

import hand_made
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import Hyperparameters, make_train, presets
from infogoal_jax.runner.sweep import Sweep, advance, prepare, side_by_side
from infogoal_jax.runs import tables
from infogoal_jax.train.program import TrainResult

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def program():
    """Training of two seeds of InfoGoal on the points, and what trains them with any hyperparameters: in the programs
    of `training.run`, which other tests of this configuration find compiled."""
    train = make_train(hand_made_points.config(), hand_made_points.steered())

    def run(hyper: Hyperparameters) -> TrainResult:
        of_these = dataclasses.replace(train, config=dataclasses.replace(train.config, hyper=hyper))
        sweep, found = Sweep(train.config, side_by_side(of_these, range(2))), []
        prepare(sweep)
        while not sweep.finished:
            advance(sweep)
            found.append((sweep.learned, sweep.scored))
        states = sweep.states.state
        epochs, metrics = zip(*found, strict=True)
        return TrainResult(
            metrics=jax.tree.map(lambda *each: np.stack(each, 1), *metrics),
            epochs=jax.tree.map(lambda *each: np.concatenate(each, 1), *epochs),
            params=states.params,
            state=states,
        )

    return train, run


@pytest.fixture(scope="module")
def sweep(program):
    train, run = program
    return run(train.config.hyper)


def test_every_metric_is_finite_and_every_kind_of_evaluation_is_there(sweep):
    for name, values in {**sweep.metrics, **sweep.epochs}.items():
        assert np.isfinite(values).all(), name
    for corrupted in ("", "corrupted_"):
        for group in ("train", "test"):
            for suffix in ("", "_mean_code"):
                success = sweep.metrics[f"{corrupted}{group}_goal{suffix}/success_rate"]
                assert success.shape == (2, 2) and (success >= 0).all() and (success <= 1).all()
    assert sweep.metrics["first_reached"].shape == (2, 2, 8, 2)


def test_training_leaves_the_low_level_and_the_dissimilarity_of_goals_as_they_may_be(program, sweep):
    train, _ = program
    assert set(sweep.params) == {"goal", "state", "agent"} and set(sweep.params["agent"]) == {
        "actor",
        "critic",
        "adjacency",
    }
    assert train.env.low_level.gain == 1.0
    for matrix in (sweep.state.dissimilarity, sweep.state.agent[:, 0]):
        assert (matrix == matrix.transpose(0, 2, 1)).all() and not jnp.diagonal(matrix, axis1=1, axis2=2).any()
    goals = train.env.goals
    # Never achieved: the grid is.
    assert sweep.state.dissimilarity[:, goals.evaluated].sum() == 2 * len(goals.evaluated) * (goals.num_goals - 1)
    buffer = sweep.state.buffer
    desired = np.unique(np.asarray(buffer.desired_goal)[np.asarray(buffer.valid)])
    np.testing.assert_array_equal(desired, goals.training_goals)


def test_the_same_key_gives_the_same_bits_and_hyperparameters_change_a_run_without_compiling(program, sweep):
    """The compiled programs take any; a seed with a learning rate of its own is in test_training.py."""
    train, run = program
    hand_made.assert_same_bits(run(train.config.hyper), sweep)
    changed = run(train.config.hyper.replace(discount=0.5, noise=0.4))
    assert (changed.epochs["agent/loss"] != sweep.epochs["agent/loss"]).any(1).all()
    assert len({row.tobytes() for row in np.asarray(sweep.epochs["agent/loss"])}) == 2


@pytest.mark.parametrize("method", ["infogoal", "none"])
def test_first_updates_of_vmapped_seeds_equal_single_runs(method):
    short = hand_made_points.config(method, num_epochs=1, epochs_per_evaluation=1, updates_per_epoch=5)
    train = make_train(short, hand_made_points.steered())
    keys = jax.random.split(jax.random.key(5), 3)
    together, alone = jax.jit(jax.vmap(train))(keys), jax.jit(train)(keys[1])
    same = jax.tree.map(lambda leaf: leaf[1], together)
    for name in ("desired_goal", "valid", "terminated", "truncated", "decided"):
        np.testing.assert_array_equal(getattr(same.state.buffer, name), getattr(alone.state.buffer, name))
    np.testing.assert_allclose(same.state.buffer.observation, alone.state.buffer.observation, atol=1e-5)
    np.testing.assert_array_equal(same.state.agent, alone.state.agent)
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, atol=1e-4), same.params, alone.params)


@pytest.fixture(scope="module")
def trained():
    """What three seeds come to, by the weight of the backgrounds that their goals are corrupted with while they
    train."""
    made = {}

    def train(weight: float, change=lambda env: env):
        if weight not in made:
            config = hand_made_points.config(
                num_epochs=24,
                epochs_per_evaluation=8,
                updates_per_epoch=40,
                num_envs=16,
                buffer_steps=10_000,
                evaluation_starts=4,
                training_corruption=weight,
            )
            made[weight] = make_train(config, hand_made_points.steered())
            made[weight, "compiled"] = jax.jit(jax.vmap(made[weight], in_axes=(0, None, None)))
        hyper = made[weight].config.hyper.replace(learning_rate=3e-3, target_rate=0.05, intrinsic_weight=1.0)
        env = made[weight].env
        return made[weight, "compiled"](jax.random.split(jax.random.key(0), 3), hyper, env.replace(env=change(env.env)))

    return train


@pytest.mark.parametrize("weight", [0.0, 0.4])
def test_the_whole_program_learns_its_training_goals(trained, weight):
    result = trained(weight)
    assert all(np.isfinite(values).all() for values in {**result.metrics, **result.epochs}.values())
    success = np.asarray(result.metrics[f"{'corrupted_' if weight else ''}train_goal/success_rate"])
    assert success[:, -1].mean() > success[:, 0].mean() + 0.15
    error = np.asarray(result.epochs["agent/adjacency_loss"])
    assert (error[:, -1] < 0.6 * error[:, 0]).all()


def test_training_looks_at_training_backgrounds_alone_and_only_when_it_corrupts(trained):
    def other_test(env):
        return env.replace(test_backgrounds=255 - env.test_backgrounds)

    def other_train(env):
        return env.replace(train_backgrounds=255 - env.train_backgrounds)

    for weight in (0.0, 0.4):
        result, again = trained(weight), trained(weight, other_test)
        jax.tree.map(np.testing.assert_array_equal, again.params, result.params)
        assert not np.array_equal(
            again.metrics["corrupted_test_goal/episode_length"], result.metrics["corrupted_test_goal/episode_length"]
        )
        changed = trained(weight, other_train)
        assert np.array_equal(changed.epochs["agent/loss"], result.epochs["agent/loss"]) == (weight == 0.0)
    assert not np.array_equal(trained(0.0).epochs["agent/loss"], trained(0.4).epochs["agent/loss"])


def test_fetch_reach_trains_with_its_own_physics(reach_run):
    """The preset, made small: two seeds of the real task, with its low level and images."""
    config = reach_run.train.config
    epochs, evaluations = (tables.read_table(reach_run.folder, name) for name in ("epochs", "evaluations"))
    assert not reach_run.diverged and len(epochs) == len(evaluations) == 2 * config.num_epochs
    for row in (*epochs, *evaluations):
        assert all(np.isfinite(value).all() for value in row.values())
    assert {"test_goal/success_rate", "corrupted_test_goal_mean_code/success_rate"} <= set(evaluations[-1])
    assert (
        epochs[-1]["env_steps"] > 0.8 * config.num_epochs * config.num_envs * config.rollout_steps
        and epochs[-1]["collect/goals_seen"] > 8
    )
    one, other = (row["agent/loss"] for row in epochs[-2:])
    assert one != other  # Two seeds.


def test_fetch_push_trains_with_its_own_physics():
    """Grip and object: a subgoal of six numbers, two adjacency networks."""
    config = presets.load(
        "fetch_push",
        num_epochs=2,
        epochs_per_evaluation=1,
        num_envs=8,
        updates_per_epoch=5,
        batch_size=32,
        buffer_steps=1000,
        evaluation_starts=1,
    )
    train = make_train(config)
    result = jax.jit(jax.vmap(train, in_axes=(0, None, None)))(
        jax.random.split(jax.random.key(0), 2), config.hyper, train.env
    )
    assert all(np.isfinite(values).all() for values in {**result.metrics, **result.epochs}.values())
    assert result.metrics["corrupted_test_goal/success_rate"].shape == (2, 2)
    assert result.state.buffer.action.shape[-1] == 6 and (jnp.abs(result.state.buffer.action) <= 1).all()
    apart = np.asarray(result.state.agent)
    assert apart.shape[:2] == (2, 2) and (apart == apart.swapaxes(2, 3)).all()
    learned = (~apart).sum((2, 3)) - apart.shape[2]
    assert (learned[:, 0] > learned[:, 1]).all() and (
        learned[:, 0] > 50
    ).all()  # The grip moves about more than the object.
