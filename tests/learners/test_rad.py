"""RAD varies what the agent's updates see of goals, each goal by a draw of its own, and nothing else."""

import dataclasses
from types import SimpleNamespace

import hand_made
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import learners, make_train
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import NoHyperparameters
from infogoal_jax.learners import none, rad
from infogoal_jax.learners.encoding import GoalEncoding
from infogoal_jax.registry import Entry
from infogoal_jax.train.parts import Setup, training_view

AUGMENT = jax.jit(rad.make(rad.RADConfig()).augment)


def images(*batch: int) -> np.ndarray:
    """Images of random pixels, none of them 0, higher than wide."""
    return np.random.default_rng(0).integers(1, 256, (*batch, 12, 8, 3), dtype=np.uint8)


def offset_of(moved: np.ndarray, image: np.ndarray, shift: int) -> tuple[int, int]:
    """By how much an image was moved down and to the right, searched for among all shifts in the image padded by
    hand."""
    height, width, channels = image.shape
    padded = np.zeros((height + 2 * shift, width + 2 * shift, channels), np.uint8)
    padded[shift : shift + height, shift : shift + width] = image
    found = [
        (shift - down, shift - right)
        for down in range(2 * shift + 1)
        for right in range(2 * shift + 1)
        if np.array_equal(moved, padded[down : down + height, right : right + width])
    ]
    assert len(found) == 1
    return found[0]


@pytest.mark.parametrize("batch", [(), pytest.param((30,), marks=pytest.mark.long), (5, 6)])
def test_every_image_is_the_padded_original_at_some_shift(batch):
    before = images(*batch)
    after = AUGMENT(jax.random.key(0), jnp.asarray(before))
    assert after.dtype == jnp.uint8 and after.shape == before.shape
    pairs = zip(np.asarray(after).reshape(-1, 12, 8, 3), before.reshape(-1, 12, 8, 3), strict=True)
    offsets = [offset_of(moved, image, 4) for moved, image in pairs]
    assert len(set(offsets)) > len(offsets) // 2  # Each by a draw of its own.


def test_a_shift_that_can_leave_nothing_of_an_image_is_refused():
    augment = rad.make(rad.RADConfig(shift=8)).augment
    with pytest.raises(UserError, match="learner.shift = 8: give fewer pixels than an image has, 8"):
        jax.eval_shape(augment, jax.random.key(0), images(2))


def test_shifts_are_uniform_along_both_axes():
    """Each of the nine shifts of one pixel comes up in a ninth of 1800 draws, within five standard deviations (13)."""
    image = images()
    shifted = jax.jit(lambda key: rad.shifted(key, jnp.broadcast_to(image, (1800, *image.shape)), 1))
    moved = np.asarray(shifted(jax.random.key(1)))
    offsets, counts = np.unique([offset_of(one, image, 1) for one in moved], axis=0, return_counts=True)
    assert len(offsets) == 9 and (np.abs(counts - 200) < 67).all()


def test_no_shift_is_the_identity():
    before = images(4)
    np.testing.assert_array_equal(jax.jit(rad.make(rad.RADConfig(shift=0)).augment)(jax.random.key(0), before), before)


def test_vectors_are_scaled_as_a_whole_within_bounds():
    before = jax.random.normal(jax.random.key(0), (20, 50, 16))
    after = AUGMENT(jax.random.key(1), before)
    assert after.dtype == before.dtype and after.shape == before.shape
    factors = np.asarray(after / before)
    np.testing.assert_allclose(factors, np.broadcast_to(factors[..., :1], factors.shape), rtol=1e-5)
    factors = factors[..., 0]
    assert factors.min() > 0.6 - 1e-5 and factors.max() < 1.2 + 1e-5
    # The whole range.
    assert (
        factors.min() < 0.62
        and factors.max() > 1.18
        and abs(factors.mean() - 0.9) < 5 * 0.6 / np.sqrt(12 * factors.size)
    )
    assert len(np.unique(factors)) > 900  # Each by a draw of its own.


@pytest.mark.parametrize("inputs", [images(6), np.random.default_rng(0).normal(size=(6, 16)).astype(np.float32)])
def test_same_key_same_draw_and_another_key_another(inputs):
    first, again, other = (AUGMENT(jax.random.key(seed), jnp.asarray(inputs)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_nothing_but_the_inputs_differs_from_the_plain_learner():
    learner, plain = rad.make(rad.RADConfig(hidden=(32,))), none.make(none.NoneConfig(hidden=(32,)))
    inputs = jnp.asarray(images(5)[:, :8])
    (params, _), (of_plain, _) = (
        hand_made.initial(one, jax.random.key(0), hand_made.example(inputs), NoHyperparameters())
        for one in (learner, plain)
    )
    jax.tree.map(np.testing.assert_array_equal, params, of_plain)
    code = jax.jit(learner.encode)(params, inputs)
    np.testing.assert_array_equal(code.mean, jax.jit(plain.encode)(params, inputs).mean)
    assert code.std is None and plain.augment is None
    assert learner.loss(params, (), hand_made.learner_batch(None), NoHyperparameters(), jax.random.key(0))[0] == 0


@pytest.mark.parametrize("corruption", [0.0, 0.3])
def test_updates_see_varied_goals_and_acting_sees_them_as_collecting_does(corruption):
    """Under the corruption of training, if any, which both see."""
    env, key = hand_made_points.points(), jax.random.key(0)
    parts = SimpleNamespace(learner=rad.make(rad.RADConfig()), config=SimpleNamespace(training_corruption=corruption))
    acting, updating = (training_view(Setup(parts, None, env), augmented) for augmented in (False, True))
    assert (acting is None) == (corruption == 0)
    seen = jax.jit(acting)(key, env.goals.inputs) if corruption else env.goals.inputs
    varied = jax.jit(updating)(key, env.goals.inputs)
    pairs = zip(np.asarray(varied), np.asarray(seen), strict=True)
    moved = [
        any(np.array_equal(one, cut) for cut in cuts(image, 4)) and not np.array_equal(one, image)
        for one, image in pairs
    ]
    assert np.mean(moved) > 0.9  # One of 81 shifts is none.


def cuts(image: np.ndarray, shift: int):
    """Every shift of an image over zeros."""
    padded = np.pad(image, ((shift, shift), (shift, shift), (0, 0)))
    return (
        padded[y : y + image.shape[0], x : x + image.shape[1]]
        for y in range(2 * shift + 1)
        for x in range(2 * shift + 1)
    )


def test_a_goal_is_varied_anew_for_each_place_in_a_batch():
    env, learner = hand_made.environment(), rad.make(rad.RADConfig(hidden=(32,)))
    params, _ = hand_made.initial(learner, jax.random.key(0), hand_made.example(env.goals.inputs), NoHyperparameters())
    view = training_view(
        Setup(SimpleNamespace(learner=learner, config=SimpleNamespace(training_corruption=0.0)), None, env),
        augmented=True,
    )
    same_goal = jnp.zeros(10, jnp.int32)

    def codes(*given):
        return jax.jit(lambda: GoalEncoding(learner, params, env.goals, 32, *given).of_any()(same_goal).mean)()

    varied, plain = codes(view, jax.random.key(1)), codes()
    assert len(np.unique(varied, axis=0)) == 10 and len(np.unique(plain, axis=0)) == 1


def test_factors_the_wrong_way_round_are_named():
    with pytest.raises(UserError, match="learner.amplitude_high = 0.5"):
        dataclasses.replace(hand_made.config(), learner=rad.RADConfig(amplitude_high=0.5))


@pytest.mark.long
def test_training_varies_goals_in_updates_alone(monkeypatch):
    """A whole run: whatever is varied has the size of an update's batch, which no rollout and no evaluation has."""
    sizes = []

    def make(config):
        learner = rad.make(config)
        return learner._replace(
            augment=lambda key, inputs: sizes.append(inputs.shape[0]) or learner.augment(key, inputs)
        )

    monkeypatch.setitem(learners.registry, "rad", Entry(rad.RADConfig, make))
    train = make_train(hand_made.config("rad", num_epochs=1, epochs_per_evaluation=1), hand_made.environment())
    result = jax.jit(train)(jax.random.key(0))
    assert set(sizes) == {train.config.batch_size}
    for name, values in (result.metrics | result.epochs).items():
        assert np.isfinite(values).all(), name
