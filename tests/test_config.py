"""Configurations and calls from Python are checked where they are made: types, ranges, and what a program can hold."""

import dataclasses
import math

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import Hyperparameters, UserError, envs, make_train, presets

CONFIG = hand_made.config()


def with_part(part: str, **values):
    return dataclasses.replace(CONFIG, **{part: dataclasses.replace(getattr(CONFIG, part), **values)})


def with_hyper(**values):
    return dataclasses.replace(CONFIG, hyper=CONFIG.hyper.replace(**values))


def test_numbers_of_numpy_are_those_of_python():
    config = dataclasses.replace(
        with_hyper(discount=np.float32(0.5)), num_envs=np.int64(4), test_corruption=np.float32(0.25)
    )
    assert (config.hyper.discount, config.num_envs, config.test_corruption) == (0.5, 4, 0.25)
    assert type(config.hyper.discount) is type(config.test_corruption) is float and type(config.num_envs) is int
    assert with_part("env", scenes=["Home_101_1"]).env.scenes == ("Home_101_1",)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: with_part("learner", window=3.5), r"learner.window = 3.5: expected int, got float"),
        (lambda: with_part("learner", loss="x"), "learner.loss = 'x': give one of 'nce', 'ratio'"),
        (lambda: with_part("agent", huber="x"), "agent.huber = 'x': expected bool, got str"),
        (
            lambda: with_part("learner", window="\ud800"),
            r"learner.window = '.ud800': is text with a half of a character",
        ),
        (lambda: with_part("env", scenes="Home_101_1"), "env.scenes = 'Home_101_1': expected list, got str"),
        (lambda: with_part("agent", hidden=(1.5,)), r"agent.hidden = \(1.5,\): expected int"),
        (lambda: dataclasses.replace(CONFIG, num_envs=True), "num_envs = True: expected int, got bool"),
        (lambda: dataclasses.replace(CONFIG, batch_size=10**20), "batch_size = 1000.*at most 2147483647"),
        (lambda: dataclasses.replace(CONFIG, buffer_steps=2**31 - 1), "buffer_steps = .*places.*at most 2147483647"),
        (lambda: dataclasses.replace(CONFIG, test_corruption=math.nan), "test_corruption = nan"),
        (lambda: dataclasses.replace(CONFIG, learner="infogoal"), "learner = 'infogoal': give a configuration"),
        (lambda: dataclasses.replace(CONFIG, hyper={"discount": 0.9}), "hyper = {'discount': 0.9}: give a record"),
        (lambda: with_hyper(learner=0), "hyper.learner = 0: give a record"),
        (lambda: with_hyper(learning_rate=np.float32(9), discount=7.0), "hyper.discount = 7.0: give a number in"),
        (lambda: with_hyper(discount=np.array([0.5, 2.0])), "hyper.discount = 2.0: give a number in"),
        (lambda: with_hyper(learning_rate=1e39), r"hyper.learning_rate = 1e\+39: give a finite number"),
        (lambda: with_hyper(discount="0.9"), "hyper.discount = '0.9': give a number"),
        (lambda: presets.load(5), "task = 5: give the name of a task"),
        (lambda: presets.load("object_search", 5), "method = 5: give the name of a method"),
        (lambda: presets.load("object_search", num_env=5), "num_env = 5: no such field.*Did you mean 'num_envs'"),
        (
            lambda: envs.load("object_search", CONFIG),
            "config = 'TrainConfig': object_search needs a ObjectSearchConfig",
        ),
        (lambda: make_train("object_search"), "config = 'object_search': give a TrainConfig"),
        (lambda: make_train(CONFIG, 5), "env = 5: give an environment"),
        (
            lambda: make_train(presets.load("embodied_qa"), hand_made.environment()),
            "env = 'ObjectSearch': is an environment of another task than embodied_qa",
        ),
        (
            lambda: make_train(dataclasses.replace(CONFIG, env=presets.load("embodied_qa").env)),
            "env = 'EmbodiedQAConfig': object_search needs ObjectSearchConfig",
        ),
    ],
)
def test_what_cannot_be_used_is_named(make, message):
    with pytest.raises(UserError, match=message):
        make()


@pytest.fixture(scope="module")
def train():
    return make_train(CONFIG, hand_made.environment())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((5,), "key = 5: give one key"),
        ((jax.random.split(jax.random.key(0)),), "give one key.*see jax.vmap"),
        ((jax.random.key(0), 5), "hyper = 5: give Hyperparameters"),
        ((jax.random.key(0), CONFIG.hyper.replace(discount=2.0)), "hyper.discount = 2.0"),
        ((jax.random.key(0), Hyperparameters()), "hyper.learner = 'NoHyperparameters'"),
        ((jax.random.key(0), None, 5), "env = 5: give an environment"),
    ],
)
def test_the_training_function_checks_what_it_is_given(arguments, message, train):
    with pytest.raises(UserError, match=message):
        train(*arguments)


def test_what_is_traced_has_no_value_to_check(train):
    """Inside of `jax.jit` and `jax.vmap`; docs/training.md says so."""
    keys, hyper = jax.random.split(jax.random.key(0), 2), CONFIG.hyper.replace(discount=jnp.array([0.5, 7.0]))
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, hyper)
    shapes = jax.eval_shape(jax.vmap(train, in_axes=(0, axes, None)), keys, hyper, train.env)
    assert shapes.metrics["test_goal/success_rate"].shape == (2, CONFIG.num_evaluations)
