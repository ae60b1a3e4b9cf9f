"""`make_train(config)` returns a pure function of a key that can be jitted, vmapped over seeds and compiled once."""

import contextlib
import dataclasses
import time

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made import assert_same_bits, plain

from infogoal_jax import Hyperparameters, UserError, make_train, pairs
from infogoal_jax.agents.cql import CQLConfig
from infogoal_jax.runner.listeners import print_success
from infogoal_jax.train.update import sample_pairs

LONG = {
    "num_epochs": 40,
    "epochs_per_evaluation": 40,
    "updates_per_epoch": 50,
    "batch_size": 64,
    "buffer_steps": 12_800,
    "evaluation_starts": 10,
}


@pytest.fixture(scope="module")
def heard() -> list:
    """What the callback of `train` heard: epoch, metrics, and how many calls were going on."""
    return []


@pytest.fixture(scope="module")
def train(heard):
    config = hand_made.config(rollout_steps=20, updates_per_epoch=5)
    inside = []

    def hear(epoch, metrics):
        inside.append(epoch)
        time.sleep(0.01)
        heard.append((int(epoch), metrics, len(inside)))
        inside.pop()

    return make_train(config, hand_made.environment(), hear)


@pytest.fixture(scope="module")
def sweep_function(train):
    """Seeds and their hyperparameters side by side, in one compiled program."""
    return jax.jit(jax.vmap(train))


def repeated(hyper: Hyperparameters, times: int) -> Hyperparameters:
    """The hyperparameters as arrays with a leading axis of seeds."""
    return jax.tree.map(lambda value: jnp.full(times, value), hyper)


@pytest.fixture(scope="module")
def sweep(train, sweep_function):
    return sweep_function(jax.random.split(jax.random.key(0), 3), repeated(train.config.hyper, 3))


def test_floats_are_those_of_the_part_that_the_configuration_is_of():
    """A configuration says which part it is; the floats of another part would be read in vain."""
    other = dataclasses.replace(hand_made.config("none"), agent=CQLConfig())
    with pytest.raises(UserError, match=r"hyper.agent = 'NoHyperparameters'.*'cql' needs CQLHyperparameters"):
        make_train(other, hand_made.environment())
    train = make_train(hand_made.config("infogoal"), hand_made.environment())
    with pytest.raises(
        UserError, match=r"hyper.learner = 'NoHyperparameters'.*'infogoal' needs InfoGoalHyperparameters"
    ):
        train(jax.random.key(0), Hyperparameters(discount=0.9))


def test_metrics_have_an_axis_of_seeds_and_one_of_evaluations(train, sweep):
    assert sweep.metrics["test_goal/success_rate"].shape == (3, train.config.num_evaluations)
    assert sweep.epochs["agent/loss"].shape == (3, train.config.num_epochs)
    assert sweep.metrics["first_reached"].shape == (3, train.config.num_evaluations, 8, 3)
    for name, values in {**sweep.metrics, **sweep.epochs}.items():
        assert np.isfinite(values).all(), name


def test_same_key_gives_the_same_bits_and_another_key_another_run(train, sweep, sweep_function):
    again = sweep_function(jax.random.split(jax.random.key(0), 3), repeated(train.config.hyper, 3))
    assert_same_bits(sweep, again)
    losses = np.asarray(sweep.epochs["agent/loss"])
    assert len({row.tobytes() for row in losses}) == 3


def test_hyperparameters_change_the_run_without_compiling_again(train, sweep, sweep_function):
    other = repeated(dataclasses.replace(train.config.hyper, discount=0.5, learning_rate=3e-3), 3)
    changed = sweep_function(jax.random.split(jax.random.key(0), 3), other)
    assert not np.array_equal(changed.epochs["agent/loss"], sweep.epochs["agent/loss"])
    assert sweep_function._cache_size() == 1


def test_a_seed_driven_to_nan_leaves_the_bits_of_the_others_alone(train, sweep, sweep_function):
    hyper = repeated(train.config.hyper, 3)
    poisoned = sweep_function(
        jax.random.split(jax.random.key(0), 3), hyper.replace(learning_rate=hyper.learning_rate.at[1].set(jnp.nan))
    )
    assert np.isnan(poisoned.epochs["agent/loss"][1, -1])
    for seed in (0, 2):
        assert_same_bits(
            *(jax.tree.map(lambda leaf, seed=seed: leaf[seed], plain(result)) for result in (sweep, poisoned))
        )


@pytest.mark.long
def test_vmapped_seeds_start_like_single_runs_bit_by_bit(train):
    keys = jax.random.split(jax.random.key(5), 3)
    together = jax.jit(jax.vmap(lambda key: train.initial(key, train.config.hyper, train.env)))(keys)
    alone = jax.jit(lambda key: train.initial(key, train.config.hyper, train.env))(keys[1])
    assert_same_bits(jax.tree.map(lambda leaf: leaf[1], plain(together)), alone)


@pytest.mark.long
def test_first_five_updates_of_vmapped_seeds_equal_single_runs():
    short = hand_made.config(num_epochs=1, epochs_per_evaluation=1, updates_per_epoch=5)
    train = make_train(short, hand_made.environment())
    keys = jax.random.split(jax.random.key(5), 3)
    together, alone = jax.jit(jax.vmap(train))(keys), jax.jit(train)(keys[1])
    same = jax.tree.map(lambda leaf: leaf[1], together)
    assert_same_bits(same.state.buffer, alone.state.buffer)  # Every draw of the rollout: goals, starts, actions.
    assert_same_bits(same.state.dissimilarity, alone.state.dissimilarity)
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, atol=1e-4), same.params, alone.params)
    np.testing.assert_allclose(same.epochs["agent/loss"], alone.epochs["agent/loss"], atol=1e-4)


@pytest.fixture(scope="module")
def passed(train):
    """The traced program, to which the environment is passed."""
    return jax.make_jaxpr(train)(jax.random.key(0), train.config.hyper, train.env)


def test_an_environment_that_is_passed_is_not_compiled_in(train, passed):
    """Large datasets travel as arguments: no array of theirs is a constant of the program."""
    closed_over = jax.make_jaxpr(train)(jax.random.key(0), train.config.hyper)
    images = train.env.images.size
    assert (
        max(constant.size for constant in closed_over.consts)
        == images
        > max((np.size(constant) for constant in passed.consts), default=0)
    )


@pytest.mark.long
def test_the_environment_may_travel_as_an_argument(train, sweep):
    """The result is the same run."""
    hyper = repeated(train.config.hyper, 3)
    passed = jax.jit(jax.vmap(train, in_axes=(0, 0, None)))(jax.random.split(jax.random.key(0), 3), hyper, train.env)
    np.testing.assert_allclose(passed.epochs["agent/loss"][:, :1], sweep.epochs["agent/loss"][:, :1], rtol=1e-4)


def test_only_training_goals_are_desired(train, sweep):
    buffer = sweep.state.buffer
    desired = np.unique(np.asarray(buffer.desired_goal)[np.asarray(buffer.valid)])
    assert set(desired) <= set(np.flatnonzero(np.asarray(train.env.goals.train_mask)))


def test_env_steps_count_valid_transitions_and_every_finished_episode_restarts(train, sweep):
    buffer = sweep.state.buffer
    steps = train.config.num_epochs * train.config.num_envs * train.config.rollout_steps
    resets = steps - np.asarray(sweep.metrics["env_steps"])[:, -1]
    assert (resets > 0).all() and steps <= buffer.valid[0].size
    np.testing.assert_array_equal(np.asarray(buffer.valid).sum((1, 2)), sweep.metrics["env_steps"][:, -1])
    ended = np.asarray(buffer.terminated | buffer.truncated).sum((1, 2))
    assert (abs(ended - resets) <= train.config.num_envs).all()  # All but those that ended with the last step.


@pytest.mark.long
@pytest.mark.parametrize(
    ("known_goals", "bfloat16"), [("train", False), ("all", False), ("visited", False), ("visited", True)]
)
def test_learns_the_hand_made_rooms(known_goals, bfloat16):
    """Bare DQN reaches the goals that it was trained on; InfoGoal the test goals beside them too. `train` gives it
    nothing to know the others by."""
    config = hand_made.config(known_goals=known_goals, bfloat16=bfloat16, **LONG)
    result = jax.jit(make_train(config, hand_made.environment()))(jax.random.key(0))
    assert result.metrics["train_goal/success_rate"][-1] >= 0.85
    test_success = result.metrics["test_goal/success_rate"][-1]
    assert test_success >= 0.85 if known_goals != "train" else test_success < 0.85
    left = result.epochs["infogoal/dissimilar_between"][-1]
    assert left >= (24 if known_goals != "train" else 6)  # Rooms two apart are never seen within the window of 4.


@pytest.mark.long
def test_bare_dqn_learns_its_training_goals_only():
    """On the mean of seeds that differ by some 0.07 from one another."""
    train = make_train(hand_made.config("none", **LONG), hand_made.environment())
    metrics = jax.jit(jax.vmap(train))(jax.random.split(jax.random.key(0), 16)).metrics
    assert metrics["train_goal/success_rate"][:, -1].mean() >= 0.85
    assert metrics["test_goal/success_rate"][:, -1].mean() < 0.6


def test_no_pair_carries_weight_before_any_goal_was_achieved(train):
    """Rows not written yet hold record 0, at which goals may well be in view."""
    env = train.env.replace(achieved_goals=train.env.achieved_goals.at[0].set(0))
    shapes = jax.eval_shape(train.initial, jax.random.key(0), train.config.hyper, env).buffer
    buffer = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    nowhere, num_goals = jnp.zeros(buffer.record.shape, bool), env.goals.num_goals
    everything, dissimilarity = pairs.KnownGoals(jnp.ones(num_goals, bool)), pairs.initial_dissimilarity(num_goals)

    @jax.jit
    def draw(buffer, key):
        experience = hand_made.experience(buffer, nowhere, everything, dissimilarity)
        return sample_pairs(train.setup(), experience, key)

    assert not draw(buffer, jax.random.key(0)).positive_weight.any()


@pytest.mark.long
def test_the_smallest_buffer_always_holds_a_transition():
    """Of two steps, of which every second may reset the environment: nothing is divided by no transition."""
    short = {"num_epochs": 40, "epochs_per_evaluation": 40, "updates_per_epoch": 1, "evaluation_starts": 1}
    config = hand_made.config("none", num_envs=1, rollout_steps=1, buffer_steps=2, batch_size=1, **short)
    train = make_train(config, hand_made.environment(episode_length=1))
    epochs = jax.device_get(jax.jit(train)(jax.random.key(0), None, train.env).epochs)
    assert 0 < epochs["collect/valid"].mean() < 1
    assert all(np.isfinite(values).all() for values in epochs.values())


def test_a_callback_hears_of_each_evaluation_of_each_seed(sweep, heard):
    jax.effects_barrier()
    name = "train_goal/episode_length"
    found = sorted((epoch, float(metrics[name])) for epoch, metrics, _ in heard[:6])
    expected = sorted(
        (epoch, float(value)) for row in sweep.metrics[name] for epoch, value in zip((2, 4), row, strict=True)
    )
    assert found == expected and len({*found}) == 6
    assert [inside for *_, inside in heard[:6]] == [1] * 6  # Never two at once: their lines would run together.


def test_a_line_is_printed_for_all_seeds_of_an_evaluation(tmp_path):
    show, written = print_success(20, num_seeds=2), tmp_path / "log"
    with written.open("w") as log, contextlib.redirect_stdout(log):
        for epoch, success in ((10, 0.2), (10, 0.4), (20, 0.9), (10, 0.0), (10, 1.0)):  # The third was interrupted.
            show(
                np.int32(epoch),
                {"train_goal/success_rate": np.float32(success), "test_goal/success_rate": np.float32(0)},
            )
        print_success(20)(np.int32(5), {"train_goal/success_rate": np.float32(1)})  # A task that holds no goals out.
        lines = written.read_text().splitlines()  # While it trains: a file or a pipe gets each line when it is printed.
    assert lines == [
        "epoch 10/20  train 0.30  test 0.00",
        "epoch 10/20  train 0.50  test 0.00",
        "epoch 5/20  train 1.00",
    ]


def test_a_callback_leaves_nothing_in_a_program_without_it(passed):
    without = jax.make_jaxpr(make_train(hand_made.config("none"), hand_made.environment()))(jax.random.key(0))
    assert "debug_callback" in str(passed) and "callback" not in str(without)
