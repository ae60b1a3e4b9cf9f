"""All goals at once in the program: who is learned of, what enters, and which combinations make sense."""

import dataclasses

import hand_made
import hand_made_frames
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError, make_train, presets
from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.agents.dqn import DQNConfig
from infogoal_jax.agents.hrac import HRACConfig
from infogoal_jax.agents.td3 import TD3Config
from infogoal_jax.envs.environment import has_image_goals
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.learners.infobot import InfoBotConfig
from infogoal_jax.loading import load_environment
from infogoal_jax.replay import Transitions
from infogoal_jax.train.experience import make_experience
from infogoal_jax.train.many_goals import draw_goals, goal_weights, under_all_goals
from infogoal_jax.train.parts import Networks

TRAIN, TEST = np.arange(hand_made.ROOMS), np.arange(hand_made.ROOMS) + hand_made.ROOMS


def training(method: str, **changes):
    """Training of this method on the hand-made rooms under all goals."""
    return make_train(hand_made.config(f"{method}+all_goals", **changes), hand_made.environment())


def initial(train):
    """The state of one seed before the first epoch."""
    return jax.jit(train.initial)(jax.random.key(0), train.config.hyper, train.env)


@pytest.fixture(scope="module")
def begun():
    """Training with InfoGoal, and the state of one seed before the first epoch. What is done with all goals changes
    nothing about it."""
    train = training("infogoal")
    return train, initial(train)


def run(train):
    """What training of one seed returns."""
    return jax.jit(train)(jax.random.key(0), train.config.hyper, train.env)


@pytest.mark.long
def test_leo_learns_nothing_of_goals_that_are_held_out():
    """Outputs of test goals keep the bits they started with; those of training goals do not."""
    train = training("leo", known_goals="held_out")
    before = initial(train).params["agent"]
    result = run(train)
    assert result.state.seen[TEST].any()
    for name in ("weights", "biases"):
        after = result.params["agent"][name]
        np.testing.assert_array_equal(after[..., TEST], before[name][..., TEST])
        assert (after[..., TRAIN] != before[name][..., TRAIN]).any((0, 1)).all()


@pytest.mark.long
def test_the_bare_agent_is_the_same_whatever_may_be_known():
    """It learns of desired goals alone: `infogoal reproduce all_goals` trains it under one protocol for both."""
    short = {"num_epochs": 4, "epochs_per_evaluation": 4}
    found = [
        run(make_train(hand_made.config("none", known_goals=known_goals, **short), hand_made.environment()))
        for known_goals in ("visited", "held_out")
    ]
    assert found[0].state.seen[TEST].any()
    jax.tree.map(np.testing.assert_array_equal, *(each.params for each in found))


@pytest.mark.parametrize(("known_goals", "enter"), [("held_out", False), ("train", False), ("visited", True)])
def test_what_is_held_out_enters_neither_updates_nor_pairs(begun, known_goals, enter):
    """Though every goal was achieved."""
    train, (_, state) = training("infogoal", known_goals=known_goals), begun
    seen = state.replace(seen=jnp.ones_like(state.seen))
    known = jax.jit(lambda state: make_experience(train.setup(), state, 0)[0].known.mask)(seen)
    for mask in (np.asarray(known), np.asarray(train.env.goals.usable_mask(known_goals))):
        assert mask[TRAIN].all() and mask[TEST].all() == mask[TEST].any() == enter


@pytest.mark.long
def test_same_key_gives_the_same_bits():
    train = training("none", num_epochs=2)
    again = jax.jit(train)
    first, second = (again(jax.random.key(0), train.config.hyper, train.env) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first.params, second.params)


def test_drawn_goals_are_known_and_shares_were_achieved_and_desired_in_the_batch():
    known = jnp.asarray(np.isin(np.arange(100), [3, 7, 20, 30]))
    achieved, desired = jnp.array([[[7, -1]], [[-1, 20]], [[7, 20]]]), jnp.array([3, 3, 30])

    def drawn(achieved, *shares):
        return draw_goals(OfAllGoals(True, *shares), known, achieved, desired, jax.random.key(0))[0]

    @jax.jit
    def all_drawn(achieved, nothing):
        both = drawn(achieved, 80, 0.5, 0.25), drawn(achieved, 80, 0.5, 0.0)
        return *both, drawn(nothing, 80, 1.0, 0.0), drawn(achieved, 0, 0.5, 0.25)

    goals, less_desired, any_known, none = jax.device_get(all_drawn(achieved, -np.ones_like(achieved)))
    assert goals.shape == (80,) and set(goals[:40]) == {7, 20} and set(goals[40:60]) == {3, 30}
    assert set(goals[60:]) == {3, 7, 20, 30}
    np.testing.assert_array_equal(np.delete(less_desired, range(40, 60)), np.delete(goals, range(40, 60)))
    assert np.asarray(known)[any_known].all() and none is None


@pytest.mark.parametrize("code", [pytest.param("sampled", marks=pytest.mark.long), "mean"])
def test_an_agent_that_learns_from_means_of_codes_acts_on_them(begun, code):
    """However often it acts, it does the same."""
    config = with_values(hand_made.config("infogoal+all_goals"), {"agent.code": code})
    train, (_, state) = make_train(config, hand_made.environment()), begun
    env, hyper = train.env, train.config.hyper.replace(test_epsilon=jnp.asarray(0.0))
    policy = train.policy(state.params, hyper, env)
    rooms, goals = jnp.arange(env.num_observations), jnp.arange(env.num_observations) % env.goals.num_goals
    actions = jax.jit(jax.vmap(policy, in_axes=(None, None, 0)))(rooms, goals, jax.random.split(jax.random.key(1), 32))
    assert (actions == actions[0]).all() == (code == "mean")


@pytest.mark.parametrize("goals", [pytest.param(None, marks=pytest.mark.long), jnp.array([6, 0, 6])])
def test_rewards_are_those_of_each_goal_alone(begun, goals):
    """As the environment decides, for every goal and transition. After a failure nothing follows under any goal."""
    train, state = begun
    env, hyper, params = train.env, train.config.hyper, state.params
    start = jnp.arange(env.num_observations)
    arrived = env.next_node[start, 0]
    count = len(start)
    failed = start % 3 == 0
    batch = Transitions(
        start, arrived, jnp.zeros(count, int), None, arrived[:, None], jnp.ones((count, 1)), failed, failed
    )
    known = jnp.ones(env.goals.num_goals, bool).at[0].set(False)
    weight, key = goal_weights(known if goals is None else known[goals]), jax.random.key(1)

    @jax.jit
    def found_of(batch):
        return under_all_goals(train.setup(), Networks(params, params, key), batch, goals, weight, key)

    found = found_of(batch)
    for place, goal in enumerate(range(8) if goals is None else goals.tolist()):
        reached = np.asarray(env.in_view[arrived, goal])
        np.testing.assert_array_equal(found.reward[:, place], reached)
        np.testing.assert_allclose(found.discount[:, place], hyper.discount * ~(reached | failed))
        np.testing.assert_allclose(found.weight[place], (goal != 0) / (7 if goals is None else 2))


@pytest.mark.long
@pytest.mark.parametrize("method", ["leo", "none", "infogoal"])
def test_goals_of_the_hand_made_rooms_are_learned(method):
    """Those that were desired, and those that were only achieved on the way."""
    train = training(method, num_epochs=40, epochs_per_evaluation=40, updates_per_epoch=25)
    metrics = run(train).metrics
    assert metrics["train_goal/success_rate"][-1] > 0.8 and metrics["test_goal/success_rate"][-1] > 0.8


def test_what_does_not_go_together_is_refused():
    env = hand_made.environment()
    for changes, blame in (
        ({"learner": InfoBotConfig(state_conditioned=True)}, "depends on the state"),
        ({"explorer": "sse_db"}, "sse_db"),
    ):
        with pytest.raises(UserError, match=blame):
            make_train(hand_made.config("all_goals", **changes), env)
    with pytest.raises(UserError, match="go together only"):
        make_train(hand_made.config("leo", agent=presets.load("object_search").agent), env)
    for agent, blame in (
        ("sac", "^agent = 'sac': values one goal at a time: give one of dqn, hrac, td3, cql"),
        (HRACConfig(), "^agent.all_goals = False: method all_goals learns from all goals"),
        (HRACConfig(all_goals=True), "^agent.critic = 'concatenated': values one goal at a time"),
        (TD3Config(all_goals=True), "^agent.critic = 'concatenated': values one goal at a time"),
    ):
        with pytest.raises(UserError, match=blame):
            presets.load("fetch_reach", "all_goals", agent=agent)
    config = hand_made.config("none")
    with pytest.raises(UserError, match="agent.head = 'index'"):
        make_train(dataclasses.replace(config, agent=dataclasses.replace(config.agent, head="index")), env)
    for given, blame in (
        ({"achieved_share": 2}, "agent.achieved_share = 2"),
        ({"desired_share": -1}, "agent.desired_share = -1"),
        ({"achieved_share": 0.8, "desired_share": 0.3}, "agent.desired_share = 0.3: with .* it makes 1.1"),
    ):
        with pytest.raises(UserError, match=blame):
            hand_made.config("none", agent=DQNConfig(**given))


def test_an_environment_with_goals_by_number_can_be_given_again():
    """As `infogoal reproduce` does: one is loaded, and its training function is made of it. Its images count as before
    in what the task is."""
    config = hand_made_frames.manipulation_config("leo", agent="dqn")
    env = load_environment(config, hand_made_frames.manipulation())
    assert env.goals.by_index and load_environment(config, env).goals.by_index
    assert not has_image_goals(env) and has_image_goals(hand_made_frames.manipulation())
    with pytest.raises(UserError, match="image_goals is True, should be False"):
        load_environment(presets.load("object_search", "leo"), env)


@pytest.mark.parametrize("norm", [pytest.param(False, marks=pytest.mark.long), True])
@pytest.mark.parametrize("kind", ["product", pytest.param("concatenated", marks=pytest.mark.long)])
@pytest.mark.parametrize("field", ["head", pytest.param("critic", marks=pytest.mark.long)])
def test_settings_of_the_head_reach_its_network(field, kind, norm):
    """Of DQN and of HRAC: normalised layers have parameters, and bounded values begin in the middle, which HRAC has for
    products alone."""
    config, env = {
        "head": (hand_made.config, hand_made.environment),
        "critic": (hand_made_points.config, hand_made_points.steered),
    }[field]
    config = config("none")
    agent = dataclasses.replace(config.agent, **{field: kind}, bounded=True, layer_norm=norm)
    parts = make_train(dataclasses.replace(config, agent=agent), env()).parts
    features, code = jnp.ones((1, config.state_encoder.features)), jnp.ones((1, config.learner.latent_size))
    params, _ = jax.jit(parts.agent.init)(jax.random.key(0), features[0], code[0])
    assert ("LayerNorm_0" in str(jax.tree.structure(params))) == norm
    value = jax.jit(parts.agent.value)(params, features, code, jnp.ones((1, 6), bool))
    assert (field, kind) == ("critic", "concatenated") or 0.1 < value.min() <= value.max() < 0.9


def test_names_say_what_is_learned_from():
    assert presets.name_of(presets.load("object_search", "leo")) == "leo"
    assert presets.load("object_search", "leo").agent.head == "index"
    head = presets.load("object_search", "infogoal+all_goals")
    assert presets.name_of(head) == "infogoal+all_goals" and head.agent.head == "product" and head.agent.bounded


def test_the_relabelling_is_free():
    """It says what looks at one goal a transition; another one is part of the name."""
    own, her = presets.load("object_search", "all_goals"), presets.load("object_search", "her+all_goals")
    names = [presets.names_of(config)["relabelling"] for config in (own, her)]
    assert names == ["random", "her"] and own.agent == her.agent and own.agent.all_goals
    assert [presets.name_of(config) for config in (own, her)] == ["all_goals", "all_goals+her"]
    assert dataclasses.replace(own, relabelling=her.relabelling) == her
    with pytest.raises(UserError, match=r"^relabelling = 'all_goals': .*give --method infogoal\+all_goals"):
        presets.load("object_search", "infogoal", relabelling="all_goals")
