"""Readings of the paper that the presets do not have: which goals are desired in training, and similar by distance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made import config, environment
from hand_made_points import config as config_of_points
from hand_made_points import points, steered

from infogoal_jax import make_train, pairs, presets
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.loading import load_environment
from infogoal_jax.runner.search import scored_goals_only
from infogoal_jax.train.dissimilar import sample_pairs_by_distance
from infogoal_jax.train.experience import first_dissimilarity


@pytest.mark.parametrize(("desired_goals", "groups"), [("training", 1), ("all", 2)])
def test_episodes_are_for_training_goals_or_for_all_that_are_evaluated(desired_goals, groups):
    env = load_environment(config(desired_goals=desired_goals), environment())
    goals = np.unique(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 200)).desired_goal)
    masks = np.stack([env.goals.train_mask, env.goals.test_mask])[:groups]
    np.testing.assert_array_equal(goals, np.flatnonzero(masks.any(0)))
    np.testing.assert_array_equal(env.goals.desired_mask, masks.any(0))
    assert env.goals.training_goals.shape == (4,)  # What is scored as a training goal stays one.


def test_a_search_desires_all_goals_too_though_it_evaluates_some_alone():
    scored, _ = scored_goals_only(environment())
    env = load_environment(config(desired_goals="all"), scored)
    assert len(env.goals.evaluated) == 4
    np.testing.assert_array_equal(env.goals.desired_mask, env.goals.train_mask | env.goals.test_mask)


def test_an_arm_too_has_episodes_for_all_goals():
    env = points()
    env = env.with_goals(env.goals.replace(desired=env.goals.evaluated))
    goals = np.unique(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 400)).desired_goal)
    np.testing.assert_array_equal(goals, np.unique(env.goals.evaluated))


def test_goals_are_dissimilar_by_distance_alone():
    positions = jnp.asarray([[0.0, 0.0], [0.3, 0.0], [0.3, 0.4]])
    found = pairs.dissimilarity_by_distance(positions, 0.35)
    np.testing.assert_array_equal(found, [[False, False, True], [False, False, True], [True, True, False]])


@pytest.mark.parametrize("positives", ["distance", "listed"])
def test_pairs_are_as_near_as_the_radius_and_negatives_farther(positives):
    """Of known goals, here every third, or of training, validation and test goals whether they are known or not."""
    env, radius = points(), 0.2
    made = with_values(config_of_points(), {"learner.positives": positives, "learner.radius": radius})
    setup = make_train(made, steered(env)).setup()
    known = jnp.arange(env.goals.num_goals) % 3 == 0
    experience = Drawn(pairs.KnownGoals(known), first_dissimilarity(setup))
    drawn = jax.jit(lambda key: sample_pairs_by_distance(setup, experience, key))(jax.random.key(0))
    place, allowed = (
        np.asarray(env.goal_positions),
        np.asarray(env.goals.listed_mask if positives == "listed" else known),
    )
    apart = [
        np.linalg.norm(place[drawn.anchor] - place[other], axis=-1) for other in (drawn.positive, drawn.negative[:, 0])
    ]
    assert (apart[0] <= radius + 1e-6).all() and (apart[0] > 0).mean() > 0.3
    assert (apart[1][np.asarray(drawn.negative_weight[:, 0]) > 0] > radius).all()
    for goals in (drawn.anchor, drawn.positive, drawn.negative[np.asarray(drawn.negative_weight) > 0]):
        assert allowed[np.asarray(goals)].all()
    assert (drawn.positive_weight == 1).all() and drawn.negative_weight.mean() > 0.9


class Drawn:
    """What pairs by distance are drawn from."""

    def __init__(self, known, dissimilarity):
        self.known, self.dissimilarity = known, dissimilarity


@pytest.mark.parametrize(
    ("task", "changes", "field"),
    [
        ("object_search", {"desired_goals": "all", "known_goals": "held_out"}, "desired_goals"),
        ("embodied_qa", {"desired_goals": "all"}, "desired_goals"),
        ("point_maze", {"desired_goals": "all"}, "desired_goals"),
        ("point_maze", {"learner.positives": "listed"}, "learner.positives"),
        ("fetch_reach", {"learner.positives": "listed", "learner.radius": 0.0}, "learner.radius"),
    ],
)
def test_a_reading_that_a_task_cannot_have_is_refused_by_its_field(task, changes, field):
    with pytest.raises(UserError, match=f"^{field} = "):
        make_train(with_values(presets.load(task, "infogoal"), changes))


def test_a_task_that_does_not_say_where_its_goals_lie_has_none_by_distance():
    with pytest.raises(UserError, match="learner.positives = 'listed'"):
        load_environment(with_values(config(), {"learner.positives": "listed"}), environment())
