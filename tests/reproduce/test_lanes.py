"""Goal sets side by side in one program: padding that nothing meets, and the numbers of each goal set alone."""

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax.hyperparameters import values_of
from infogoal_jax.reproduce import lanes, measure, plan
from infogoal_jax.reproduce.manifest import PRESET, Lane, Run
from infogoal_jax.reproduce.plan import config_of
from infogoal_jax.train.program import make_train

SEEDS = 0, 1


def smaller() -> object:
    """The hand-made rooms without their last corridor's outermost place, of which no goal is in view then."""
    env = hand_made.environment()
    kept = env.num_observations - 4
    node = jnp.where(env.next_node[:kept] < kept, env.next_node[:kept], jnp.arange(kept)[:, None])
    starts = jnp.where(env.starts < kept, env.starts, 0)
    return env.replace(
        next_node=node,
        images=env.images[:kept],
        in_view=env.in_view[:kept],
        achieved_goals=env.achieved_goals[:kept],
        position=env.position[:kept],
        distance=env.distance[:, :kept],
        starts=starts,
        source="a smaller one",
    )


@pytest.fixture(scope="module")
def both():
    """Two goal sets of different sizes, padded to one shape."""
    return plan.with_one_shape([hand_made.environment(), smaller()])


def test_padded_goal_sets_have_one_shape(both):
    assert lanes.shape_of(hand_made.environment()) != lanes.shape_of(smaller())
    assert lanes.shape_of(both[0]) == lanes.shape_of(both[1])
    for name, value in vars(hand_made.environment()).items():
        if isinstance(value, jax.Array):
            np.testing.assert_array_equal(getattr(both[0], name), value)  # The larger one is as it was.


def test_what_is_added_is_never_met(both):
    """No move of the smaller house leads there, and no start lies there."""
    own, padded = smaller(), both[1]
    kept = own.num_observations
    assert (np.asarray(padded.next_node)[:kept] < kept).all() and not np.asarray(padded.in_view)[kept:].any()
    for row, count in zip(np.asarray(padded.starts), np.asarray(padded.num_starts), strict=True):
        assert (row[:count] < kept).all()
    assert (np.asarray(padded.achieved_goals)[kept:] == -1).all()


def batch_of(envs, values=(("discount", 0.9),)) -> lanes.Batch:
    """Two seeds under two settings on each of these goal sets."""
    config = hand_made.config("infogoal", num_epochs=2, epochs_per_evaluation=1, updates_per_epoch=3)
    settings = Lane("preset", ()), Lane("other", values)
    runs = {
        (place, lane): Run("object_search", "infogoal", None, None, place, lane, SEEDS)
        for place in range(len(envs))
        for lane in settings
    }
    return lanes.Batch(config, tuple(envs), tuple((lane, seed) for lane in settings for seed in SEEDS), runs)


@pytest.mark.parametrize("order", [(0, 1), (1, 0), (1,)], ids=["preset first", "preset last", "alone"])
def test_the_floats_of_a_lane_are_its_own_whichever_comes_first(order, tmp_path):
    """The first lane of a batch may be another than the preset, where the preset's run is done already."""
    fixed = Lane("beta 0.1", (("learner.beta_start", 0.1), ("learner.beta_step", 0.0)))
    both = [Run("fetch_reach", "infogoal", None, None, 0, lane, SEEDS) for lane in (Lane(*PRESET), fixed)]
    (batch,) = lanes.batches_of([both[place] for place in order], None, 64)
    floats = lanes.floats_of(batch)
    for (lane, _), found in zip(batch.lanes, floats, strict=True):
        run = both[0] if lane.name == PRESET[0] else both[1]
        assert found == values_of(config_of(run).hyper), lane.name
    assert len(floats) == len(order) * len(SEEDS)


def trained(envs) -> lanes.Training:
    """A batch after its first evaluation."""
    training = lanes.begin(batch_of(envs))
    lanes.go_on(training)
    return training


@pytest.fixture(scope="module")
def together(both):
    """Both goal sets, two settings and two seeds in one program."""
    return trained(both)


@pytest.mark.long
def test_a_goal_set_learns_as_it_does_alone(both, together):
    for place, env in enumerate(both):
        alone = trained([env])
        for name, values in alone.history.items():
            np.testing.assert_allclose(together.history[name][0][place], values[0][0], atol=2e-3, err_msg=name)


@pytest.mark.long
def test_a_lane_is_the_training_function_of_its_seed(both, together):
    train = make_train(together.batch.config, both[0])
    state = train.initial(jax.random.key(1), together.batch.config.hyper, both[0])
    state, _, metrics = jax.jit(train.chunk)(state, jnp.arange(1), together.batch.config.hyper, both[0])
    for name, value in metrics.items():
        np.testing.assert_allclose(together.history[name][0][0, 1], value, atol=2e-3, err_msg=name)


@pytest.mark.long
def test_the_share_of_the_learner_follows_its_weight(together):
    """No weight, no share; a large one, nearly all."""
    state, hyper = jax.tree.map(lambda leaf: leaf[0, 0], (together.states, together.hyper))
    share = jax.jit(measure.learner_share(together.train))
    env, shares = together.env_of(0), []
    for weight in (0.0, 0.1, 1.0, 1e4):
        shares.append(float(share(state, 0, hyper.replace(learner_weight=jnp.float32(weight)), env)))
    assert shares[0] < 1e-3 and shares == sorted(shares) and shares[-1] > 0.99


def test_a_learner_without_a_loss_has_no_share():
    assert measure.learner_share(make_train(hand_made.config("none"), hand_made.environment())) is None


def test_lanes_are_cut_into_parts_that_fit():
    needed = (("a", SEEDS), ("b", SEEDS), ("c", (0,)))
    assert lanes.parts_of(needed, 64) == [list(needed)]
    assert [[lane for lane, _ in part] for part in lanes.parts_of(needed, 3)] == [["a"], ["b", "c"]]
    assert [[lane for lane, _ in part] for part in lanes.parts_of(needed, 1)] == [["a"], ["b"], ["c"]]
