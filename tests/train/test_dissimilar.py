"""Negatives where goals are continuous: three ways to tell that two goals are dissimilar, on walks along a line."""

from types import SimpleNamespace

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from infogoal_jax import UserError, envs, make_train, pairs, presets, replay
from infogoal_jax.envs.goal_task import GoalTask
from infogoal_jax.goals import GoalBox
from infogoal_jax.learners import infogoal
from infogoal_jax.learners.learner import LearnerBatch, SampleSpec
from infogoal_jax.train.experience import Experience, first_dissimilarity
from infogoal_jax.train.parts import Setup
from infogoal_jax.train.update import sample_pairs
from tests import hand_made

ROWS, STEPS, WINDOW, RADIUS = 24, 30, 3, 0.02
BOX = GoalBox.of([0.0], [4.0])
ENV = SimpleNamespace(
    goals=BOX,
    goals_of=lambda record: record[..., None, :],
    reached=lambda record, goal: jnp.abs(record - goal)[..., 0] < RADIUS,
)


def parts(learner) -> SimpleNamespace:
    """Parts with this learner."""
    return SimpleNamespace(learner=learner, config=SimpleNamespace(known_goals="visited"))


def asking(dissimilar_by: str, **fields) -> SimpleNamespace:
    """A learner that asks for many pairs, with negatives told so."""
    spec = SampleSpec(num_pairs=4000, window=WINDOW, num_negatives=2, dissimilar_by=dissimilar_by)
    return SimpleNamespace(sample_spec=spec, **fields)


def walks() -> np.ndarray:
    """Places along the line, float32 [R, T + 1, 1]."""
    generator = np.random.default_rng(0)
    begin, steps = generator.uniform(0.5, 3.5, (ROWS, 1)), generator.uniform(-0.1, 0.1, (ROWS, STEPS))
    return np.cumsum(np.concatenate([begin, steps], 1), 1).astype(np.float32)[..., None]


def experience(learner) -> Experience:
    """The walks, with what this learner needs."""
    rows, achieved = hand_made.rows_of(np.ones((ROWS, STEPS)), walks()), jnp.ones((ROWS, STEPS + 1), bool)
    goals, matrix = rows.record[:, :, None], first_dissimilarity(Setup(parts(learner), None, ENV))
    if matrix is not None:
        matrix = pairs.remove_similar(matrix, BOX.cell_of(goals), rows.episode(), WINDOW)
    known = pairs.AchievedGoals(goals, replay.running_count(achieved))
    return hand_made.experience(rows, achieved, known, matrix, episode=rows.episode())


def draw(learner):
    """The goals that negatives are compared with, negatives and weights, each [B, K]; and the pairs."""
    drawn = jax.jit(lambda key: sample_pairs(Setup(parts(learner), None, ENV), experience(learner), key))(
        jax.random.key(1)
    )
    return (*(np.asarray(each) for each in (drawn.contrast, drawn.negative, drawn.negative_weight)), drawn)


def test_negatives_by_trajectory_were_not_achieved_within_the_window_and_do_not_achieve_each_other():
    contrast, negative, weight, drawn = draw(asking("trajectory"))
    places = walks()[..., 0]
    near = {
        (float(first), float(second))
        for lag in range(WINDOW + 1)
        for row in places
        for first, second in zip(row[: len(row) - lag], row[lag:], strict=True)
    }
    found = list(zip(contrast[weight > 0][:, 0].tolist(), negative[weight > 0][:, 0].tolist(), strict=True))
    assert weight.mean() > 0.99 and drawn.other is None
    assert not any(pair in near or pair[::-1] in near for pair in found)
    assert (np.abs(contrast - negative)[weight > 0] >= RADIUS).all()


def test_negatives_by_cells_lie_in_cells_that_no_trajectory_joined_within_the_window():
    contrast, negative, weight, _ = draw(asking("cells"))
    cell_of = jax.jit(BOX.cell_of)
    cells = np.asarray(cell_of(walks()))
    joined = {
        pair
        for lag in range(WINDOW + 1)
        for row in cells
        for pair in zip(row[: len(row) - lag].tolist(), row[lag:].tolist(), strict=True)
    }
    found = [np.asarray(cell_of(goals))[weight > 0].tolist() for goals in (contrast, negative)]
    assert weight.mean() > 0.99
    assert not any(pair in joined or pair[::-1] in joined for pair in zip(*found, strict=True))


def test_negatives_by_a_classifier_are_those_that_it_does_not_call_similar():
    close = 0.25
    learner = asking("classifier", similar=lambda params, first, second: jnp.abs(first - second)[..., 0] < close)
    contrast, negative, weight, drawn = draw(learner)
    apart = np.abs(contrast - negative)[..., 0] / 2  # The encoder sees 4 as 2.
    assert weight.mean() > 0.99 and (apart[weight > 0] >= close - 1e-6).all()
    assert np.isin(np.asarray(drawn.other), walks()).all() and drawn.other.shape == (4000, 1)


@pytest.mark.long
def test_the_classifier_learns_from_pairs_which_goals_are_similar():
    learner = infogoal.make(
        infogoal.InfoGoalConfig(window=WINDOW, num_pairs=128, hidden=(32, 32), dissimilar_by="classifier")
    )
    hyper, optimizer = infogoal.InfoGoalHyperparameters(), optax.adam(3e-3)
    params, state = hand_made.initial(learner, jax.random.key(0), hand_made.example(jnp.zeros((2, 1))), hyper)
    known = experience(learner).replace(goal_params=params)

    def loss(params, key):
        drawn = sample_pairs(Setup(parts(learner), None, ENV), known, key)
        batch = LearnerBatch(
            lambda goals: learner.encode(params, BOX.inputs_of(goals)), BOX.inputs_of, drawn, None, drawn.anchor, None
        )
        return learner.loss(params, state, batch, hyper, key)[1]["classifier_loss"]

    @jax.jit
    def learn(params):
        def step(carry, key):
            params, optimizer_state = carry
            found, gradient = jax.value_and_grad(loss)(params, key)
            change, optimizer_state = optimizer.update(gradient, optimizer_state)
            return (optax.apply_updates(params, change), optimizer_state), found

        keys = jax.random.split(jax.random.key(2), 300)
        (params, _), losses = jax.lax.scan(step, (params, optimizer.init(params)), keys)
        return params, losses

    params, losses = learn(params)
    here, losses, similar = np.linspace(-0.8, 0.8, 9)[:, None], np.asarray(losses), jax.jit(learner.similar)
    assert losses[-20:].mean() < 0.6 * losses[:20].mean()
    assert similar(params, here, here + 0.03).all()
    assert not similar(params, here, here + np.where(here > 0, -0.8, 0.8)).any()


def test_goals_of_a_set_need_no_other_way():
    with pytest.raises(UserError, match=r"learner.dissimilar_by = 'cells': goals of object_search are a finite set"):
        make_train(presets.load("object_search", learner=infogoal.InfoGoalConfig(dissimilar_by="cells")))


@flax.struct.dataclass
class ManyNumbers(GoalTask):
    """A state of thirteen numbers, each of which an action moves."""

    action_size, source = 13, "made up"

    def begin(self, key):
        return jax.random.uniform(key, (13,))

    def move(self, world, action):
        return world + 0.1 * action

    def observation(self, world):
        return world

    def achieved_goal(self, world):
        return world


def test_goals_in_one_cell_are_not_told_apart_by_cells():
    presets.register("many_numbers", ManyNumbers(GoalBox.of([0.0] * 13, [1.0] * 13), radius=0.5))
    with pytest.raises(UserError, match="learner.dissimilar_by = 'cells': goals of so many numbers lie in one cell"):
        make_train(presets.load("many_numbers", learner=infogoal.InfoGoalConfig(dissimilar_by="cells")))


def test_every_place_of_the_space_has_a_cell_of_its_own_and_no_goal_has_none():
    box = envs.load("point_maze").goals
    cell_of = jax.jit(box.cell_of)
    goals = jnp.array([[0.0, 0.0], [3.0, 3.0], [-1.0, 9.0], [jnp.nan, 0.0]])
    np.testing.assert_array_equal(cell_of(goals), [0, box.num_cells - 1, box.cells_per_axis - 1, -1])
    axis = (np.arange(box.cells_per_axis) + 0.5) * 3.0 / box.cells_per_axis
    middles = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2).astype(np.float32)
    assert len({*np.asarray(cell_of(middles)).tolist()}) == box.num_cells == len(middles)
