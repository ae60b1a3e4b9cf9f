"""All goals at once in the program: who is learned of, what enters, and which combinations make sense."""

import dataclasses

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError, make_train, presets
from infogoal_jax.learners.infobot import InfoBotConfig
from infogoal_jax.relabelling.relabelling import AllGoalsSpec
from infogoal_jax.replay import Transitions
from infogoal_jax.train.all_goals import draw_goals, under_all_goals

TEST = np.arange(hand_made.ROOMS) + hand_made.ROOMS


def trained(method: str, **changes):
    """Training of this method on the hand-made rooms under all goals, and its result."""
    relabelling = None if method == "leo" else "all_goals"
    train = make_train(hand_made.config(method, relabelling=relabelling, **changes), hand_made.environment())
    return train, jax.jit(train)(jax.random.key(0), train.config.hyper, train.env)


def test_leo_learns_nothing_of_goals_that_are_held_out():
    """Outputs of test goals keep the bits they started with; those of training goals do not."""
    train, result = trained("leo", known_goals="held_out")
    before = train.initial(jax.random.key(0), train.config.hyper, train.env).params["agent"]
    after = result.params["agent"]
    for name in ("weights", "biases"):
        np.testing.assert_array_equal(after[name][..., TEST], before[name][..., TEST])
        assert (after[name][..., : hand_made.ROOMS] != before[name][..., : hand_made.ROOMS]).any((0, 1)).all()


@pytest.mark.parametrize(("known_goals", "enter"), [("held_out", False), ("train", False), ("visited", True)])
def test_what_is_held_out_enters_nowhere(known_goals, enter):
    """Neither as a goal of an update nor in pairs, though it was achieved."""
    train, result = trained("infogoal", known_goals=known_goals, epochs_per_evaluation=4)
    assert result.state.seen[TEST].any()
    experience, _ = train.experience_of(result.state, jnp.asarray(3), train.config.hyper, train.env)
    assert experience.known[TEST].any() == experience.usable[TEST].any() == enter
    assert experience.dissimilarity[np.ix_(TEST, range(hand_made.ROOMS))].all() == (not enter)


def test_same_key_gives_the_same_bits():
    train, result = trained("infogoal")
    again = jax.jit(train)(jax.random.key(0), train.config.hyper, train.env)
    jax.tree.map(np.testing.assert_array_equal, result.params, again.params)


def test_drawn_goals_are_known_and_a_share_was_achieved_in_the_batch():
    known = jnp.zeros(50, bool).at[jnp.array([3, 7, 20])].set(True)
    achieved = jnp.array([[[7, -1]], [[-1, 20]], [[7, 20]]])
    goals = draw_goals(AllGoalsSpec(40, 0.5, mean_code=False), known, achieved, jax.random.key(0))
    assert goals.shape == (40,) and set(np.asarray(goals[:20]).tolist()) == {7, 20}
    assert set(np.asarray(goals[20:]).tolist()) == {3, 7, 20}
    nothing = draw_goals(AllGoalsSpec(40, 1.0, mean_code=False), known, -jnp.ones_like(achieved), jax.random.key(1))
    assert known[nothing].all()
    assert draw_goals(AllGoalsSpec(0, 0.5, mean_code=False), known, achieved, jax.random.key(0)) is None


@pytest.mark.parametrize("goals", [None, jnp.array([6, 0, 6])])
def test_rewards_are_those_of_each_goal_alone(goals):
    """As the environment decides, for every goal and transition."""
    train = make_train(hand_made.config("none", relabelling="all_goals"), hand_made.environment())
    env, hyper = train.env, train.config.hyper
    params = train.initial(jax.random.key(0), hyper, env).params
    start = jnp.arange(env.num_observations)
    arrived = env.next_node[start, 0]
    count = len(start)
    batch = Transitions(
        start, arrived, jnp.zeros(count, int), None, arrived[:, None], jnp.ones((count, 1)), jnp.zeros(count, bool)
    )
    known = jnp.ones(env.goals.num_goals, bool).at[0].set(False)
    key = jax.random.key(1)
    found = under_all_goals(train.parts, env, hyper, params, params, batch, goals, known, key, key)
    for place, goal in enumerate(range(8) if goals is None else goals.tolist()):
        reached = np.asarray(env.in_view[arrived, goal])
        np.testing.assert_array_equal(found.reward[:, place], reached)
        np.testing.assert_allclose(found.discount[:, place], hyper.discount * ~reached)
        assert found.weight[place] == (goal != 0)


def test_heads_learn_the_training_goals_of_the_hand_made_rooms():
    """LEO and the head reach what was commanded, after so few epochs that nothing else would explain it."""
    for method in ("leo", "none"):
        _, result = trained(method, num_epochs=40, epochs_per_evaluation=40, updates_per_epoch=25)
        assert result.metrics["train_goal/success_rate"][-1] > 0.8, method


def test_what_does_not_go_together_is_refused():
    env = hand_made.environment()
    for changes, blame in (
        ({"relabelling": "all_goals", "agent": "hrac"}, "hrac"),
        ({"relabelling": "all_goals", "learner": InfoBotConfig(state_conditioned=True)}, "depends on the state"),
        ({"relabelling": "all_goals", "explorer": "sse_db"}, "sse_db"),
        ({"learner": "index", "agent": presets.load("object_search").agent}, "go together only"),
    ):
        with pytest.raises(UserError, match=blame):
            make_train(hand_made.config("none", **changes), env)
    config = hand_made.config("none")
    with pytest.raises(UserError, match="agent.head = 'index'"):
        make_train(dataclasses.replace(config, agent=dataclasses.replace(config.agent, head="index")), env)
    with pytest.raises(UserError, match="relabelling.achieved_share = 2"):
        hand_made.config("none", relabelling=presets.REGISTRIES["relabelling"]["all_goals"].config(achieved_share=2))


def test_names_say_what_is_learned_from():
    assert presets.name_of(presets.load("object_search", "leo")) == "leo"
    assert presets.load("object_search", "leo").agent.head == "index"
    head = presets.load("object_search", "infogoal", relabelling="all_goals")
    assert presets.name_of(head) == "infogoal+all_goals" and head.agent.head == "product" and head.agent.bounded
