"""The offline agents beside OGBench's own code (fixtures/ogbench.npz), TD3+BC beside its authors': loss and gradient of
one update on the same parameters and transitions; what they are combined with; and a line on which they learn from
random walks."""

import dataclasses
import functools

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vector_agents
from hand_made_frames import manipulation, manipulation_config
from places import FIXTURES, recorded

from infogoal_jax import UserError, agents, envs, make_train, presets
from infogoal_jax.agents.agent import ActorGoals, AgentBatch, Waypoints
from infogoal_jax.agents.hiql import of_length
from infogoal_jax.agents.qrl import QRLConfig
from infogoal_jax.config import StateEncoderConfig
from infogoal_jax.learners.none import NoneConfig
from infogoal_jax.loading import reasons_against
from infogoal_jax.train.costs import with_actor_goals
from infogoal_jax.train.parts import Networks, encode_states

KEY = jax.random.key(0)

CASES = {
    "gcivl": ("gcivl", {}, {"alpha": 10.0}),
    "gciql_ddpg_bc": ("gciql", {"actor_loss": "ddpg_bc"}, {"alpha": 0.3}),
    "qrl": ("qrl", {"goals": "states", "size": 16}, {"alpha": 0.003}),
    "hiql": ("hiql", {"size": 4}, {"low_alpha": 3.0, "high_alpha": 3.0}),
    "crl": ("offline_crl", {"size": 16}, {"alpha": 0.1}),
    "gciql_awr": ("gciql", {"actor_loss": "awr"}, {"alpha": 10.0}),
}
NAMES = sorted({name for name, _, _ in CASES.values()})
LAST = "Dense_2"
"""The linear layer of networks with two hidden ones; OGBench calls an actor's `mean_net`."""


def nested(arrays: dict[str, np.ndarray], prefix: str) -> dict:
    """Arrays by the names of their places as nested dictionaries."""
    found: dict = {}
    for path, leaf in arrays.items():
        if path.startswith(prefix):
            *inside, name = path.removeprefix(prefix).split("/")
            place = found
            for key in inside:
                place = place.setdefault(key, {})
            place[name] = leaf
    return found


def layers(part: dict) -> dict:
    """The layers of a network of OGBench by the names that they have here."""
    if "mean_net" in part:
        return part["actor_net"] | {LAST: part["mean_net"]}
    return next((part[name] for name in ("value_net", "phi", "layers_0") if name in part), part)


def reference(case: str) -> dict:
    """What OGBench's code was given and gave: transitions, parameters, loss, its parts and its gradient."""
    with np.load(FIXTURES / "ogbench.npz", allow_pickle=False) as arrays:
        own = {name.removeprefix(f"{case}/"): arrays[name] for name in arrays if name.startswith(f"{case}/")}
    kinds = {kind: nested(own, f"{kind}/") for kind in ("batch", "params", "gradient", "info")}
    return kinds | {"loss": own["loss"], "discount": own["discount"]}


def parts_of(tree: dict, prefix: str = "modules_") -> dict:
    """The networks of OGBench's parameters whose names begin so, without the target networks."""
    names = [name for name in tree if name.startswith(prefix) and not name.startswith(f"{prefix}target_")]
    found = {name.removeprefix(prefix): layers(tree[name]) for name in names}
    for name, own in (("goal_rep", "goals"), ("low_actor", "low"), ("high_actor", "high")):  # Of HIQL.
        found |= {own: found.pop(name)} if name in found else {}
    if {"phi", "psi"} <= tree.get(f"{prefix}critic", {}).keys():  # Of contrastive RL.
        found |= {name: tree[f"{prefix}critic"][name] for name in ("phi", "psi")}
        del found["critic"]
    if "lam" in found:  # Numbers of QRL.
        found |= {"log_lambda": found.pop("lam")["log_value"], "mixture": tree[f"{prefix}value"]["alpha"]["value"]}
    return found


def inside(params: dict) -> dict:
    """The layers of each network here, without the names of flax around them."""

    def unwrapped(part):
        while isinstance(part, dict) and "Dense_0" not in part and len(part) == 1:
            (part,) = part.values()
        return part

    return {name: unwrapped(part) for name, part in params.items()}


def filled(params: dict, given: dict) -> dict:
    """The parameters with these layers of each network that is given."""

    def put(part, name):
        if not isinstance(part, dict) or "Dense_0" in part:
            return jax.tree.map(lambda own, new: new.reshape(own.shape), part, given[name])
        return {key: put(value, name) for key, value in part.items()}

    return {name: put(part, name) if name in given else part for name, part in params.items()}


def batch_of(batch: dict, discount: float) -> AgentBatch:
    """OGBench's transitions as an agent here sees them: its observations are features, its goals codes."""
    return AgentBatch(
        observation=batch["observations"],
        next_observation=batch["next_observations"],
        features=batch["observations"],
        code=batch["value_goals"],
        action=batch["actions"],
        next_features=batch["next_observations"],
        next_code=batch["value_goals"],
        target_features=batch["next_observations"],
        target_code=batch["value_goals"],
        reward=batch["rewards"],
        discount=discount * batch["masks"],
        action_mask=None,
        next_action_mask=None,
        first_target_features=batch["observations"],
        first_target_code=batch["value_goals"],
        actor=ActorGoals(batch["actor_goals"], batch["actor_goals"]),
    )


def with_waypoints(given: AgentBatch, batch: dict) -> AgentBatch:
    """The same with OGBench's subgoals."""
    low, high = batch["low_actor_goals"], batch["high_actor_targets"]
    goal = batch["high_actor_goals"]
    return given.replace(actor=ActorGoals(goal, goal), waypoints=Waypoints(low, low, high, high, goal))


def agent_of(name: str, action_size: int = vector_agents.A, **changes):
    sizes = {"hidden": (16, 16)} | changes
    return vector_agents.agent_of(name, action_size, **sizes), agents.registry.entry(name)


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.long if case == "gciql_ddpg_bc" else []) for case in CASES]
)
def test_an_update_is_that_of_ogbench(case):
    """Loss, each part of it, and the gradient for every parameter, on random parameters."""
    name, changes, floats = CASES[case]
    given, (agent, entry) = reference(case), agent_of(name, **changes)
    batch = batch_of(given["batch"], given["discount"])
    batch = with_waypoints(batch, given["batch"]) if name == "hiql" else batch
    begin = functools.partial(agent.init, jax.random.key(0), batch.features[0], batch.code[0])
    example, state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(begin))
    params = filled(example, parts_of(given["params"]))
    target_params = filled(params, parts_of(given["params"], "modules_target_"))

    def loss(params):
        return agent.loss(params, target_params, batch, state, entry.hyper(**floats), jax.random.key(0))

    (found, metrics), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(params)
    np.testing.assert_allclose(found, given["loss"], rtol=1e-5)
    for part, values in given["info"].items():
        for metric in {f"{part}_loss", *values} & {*metrics} & {*values}:
            np.testing.assert_allclose(metrics[metric], values[metric], rtol=1e-5, err_msg=metric)
    assert_same(parts_of(given["gradient"]), inside(gradient))


def assert_same(theirs: dict, ours: dict) -> None:
    """Gradients {network: arrays by layer} are the same, to 1e-5 of the largest number of a network."""
    assert theirs.keys() == ours.keys()
    for name in theirs:
        flat = jax.tree_util.tree_leaves_with_path(theirs[name])
        size = max(np.abs(leaf).max() for _, leaf in flat)
        assert size > 0
        for (path, leaf), own in zip(flat, jax.tree.leaves(ours[name]), strict=True):
            np.testing.assert_allclose(own, leaf, rtol=1e-5, atol=1e-5 * size, err_msg=f"{name}{path}")


def test_an_update_near_the_data_is_that_of_td3_bc():
    """Where target actions have no noise. The critics' squared errors are halved here."""
    arrays = recorded("td3_bc")
    batch, given, expected = (nested(arrays, f"{kind}/") for kind in ("batch", "params", "gradient"))
    agent, entry = agent_of("td3", huber=False, behaviour=True)
    # No goals: the authors' agent has none.
    seen, none = batch["observations"], np.zeros((len(batch["observations"]), 0), np.float32)
    transitions = batch_of(
        batch | {"value_goals": none, "actor_goals": none, "masks": batch["not_done"]}, arrays["discount"]
    )
    example, state = hand_made.initial(agent, KEY, seen[0], none[0])
    params = filled(example, {name: given[name] for name in ("actor", "critic")})
    target_params = filled(example, {name: given[f"target_{name}"] for name in ("actor", "critic")})
    hyper = entry.hyper(target_noise=0.0, action_cost=0.0, behaviour_alpha=arrays["alpha"])

    def loss(params):
        return agent.loss(params, target_params, transitions, state, hyper, KEY)[0]

    found, gradient = jax.jit(jax.value_and_grad(loss))(params)
    np.testing.assert_allclose(found, arrays["critic_loss"] / 2 + arrays["actor_loss"], rtol=1e-5)
    assert_same(expected | {"critic": jax.tree.map(lambda leaf: leaf / 2, expected["critic"])}, inside(gradient))


@pytest.mark.parametrize("name", NAMES)
def test_only_costs_teach_it(name):
    config = presets.load("point_maze", "none", agent=name)
    assert type(config.relabelling).__name__ == "MixedConfig" and not reasons_against(config)
    against = reasons_against(presets.load("point_maze", "none", agent=name, relabelling="her"))
    assert {refusal.field for refusal in against} == {"relabelling"}


def test_qrl_learns_from_achieved_goals_only_where_they_do_not_lie_at_their_states_by_form():
    """As OGBench, which draws any goals alone."""
    shares = {
        task: presets.load(task, "none", agent="qrl").relabelling.current_share for task in ("point_maze", "ogbench")
    }
    assert shares == {"point_maze": 0.2, "ogbench": 0.0}
    given = presets.load("ogbench", "none", agent=QRLConfig(goals="codes")).relabelling
    assert (given.current_share, given.future_share) == (0.2, 0.0)


def test_qrl_holds_a_state_at_its_goal_whatever_else_is_rewarded():
    """Which states are at their goal is known, not read off a reward that may have an intrinsic part."""
    agent, entry = agent_of("qrl", size=8)
    batch = vector_agents.random_batch()
    batch = batch.replace(actor=ActorGoals(batch.code, batch.next_code), at_goal=np.arange(len(batch.reward)) < 2)
    params, state = vector_agents.started(agent)

    @jax.jit
    def distance_loss(batch):
        return agent.loss(params, params, batch, state, entry.hyper(), KEY)[1]["distance_loss"]

    found = distance_loss(batch)
    assert found == distance_loss(batch.replace(reward=batch.reward + 3.0))
    assert found != distance_loss(batch.replace(at_goal=~batch.at_goal))


def test_a_vector_of_nothing_stays_nothing_in_hiql():
    """A state of zeros and a goal of zeros, of which its first parameters make a subgoal of zeros."""
    nothing, slope = jax.value_and_grad(lambda vector: of_length(vector).sum())(jnp.zeros(4))
    assert nothing == 0 and jnp.isfinite(slope).all()
    np.testing.assert_allclose(of_length(jnp.array([3.0, 4.0, 0.0, 0.0])), [1.2, 1.6, 0.0, 0.0], rtol=1e-6)


def test_what_is_achieved_by_no_known_goal_is_no_subgoal_of_hiql():
    """Both levels learn from the other transitions as if these were all."""
    agent, entry = agent_of("hiql", size=4)
    batch = vector_agents.random_batch()
    code, features = batch.code, batch.features
    way = Waypoints(code, code + 1, code - 1, features + 1, code, *2 * [np.arange(len(code)) < 4])
    batch = batch.replace(
        actor=ActorGoals(code, code), waypoints=way, first_target_features=features, first_target_code=code
    )
    params, state = vector_agents.started(agent)

    @jax.jit
    def levels(batch):
        metrics = agent.loss(params, params, batch, state, entry.hyper(), KEY)[1]
        return metrics["low_loss"], metrics["high_loss"]

    def first(tree):
        return jax.tree.map(lambda leaf: leaf[:4], tree)

    alone = first(batch).replace(waypoints=first(way).replace(low_weight=None, weight=None))
    np.testing.assert_allclose(levels(batch), levels(alone), rtol=1e-5)
    every = batch.replace(waypoints=way.replace(low_weight=None, weight=None))
    assert not np.allclose(levels(batch), levels(every), rtol=1e-2)


def test_the_actor_learns_for_goals_as_the_update_varies_them():
    """RAD's, by the key of the update's view, as the values'."""
    train = make_train(presets.load("point_maze", "rad", agent="gciql", batch_size=4, buffer_steps=3200), None)
    shapes = train.state_shapes.params
    params = jax.tree.map(lambda leaf: np.full(leaf.shape, 0.1, leaf.dtype), shapes)
    features = np.ones((4, train.config.state_encoder.features), np.float32)
    batch = vector_agents.random_batch().replace(features=features, next_features=features)
    goal = train.env.goals.evaluated[:4]

    @jax.jit
    def codes(view_key):
        networks = Networks(params, params, view_key)
        return with_actor_goals(train.setup(), networks, batch, goal, None, KEY).actor.code

    assert not np.array_equal(codes(KEY), codes(jax.random.key(1)))


def test_rewards_at_the_goal_are_asked_for_elsewhere():
    against = reasons_against(presets.load("point_maze", "none", agent="td3", relabelling="mixed"))
    assert {refusal.field for refusal in against} == {"relabelling"}


def test_states_and_goals_are_seen_as_they_are():
    """OGBench's preset has no encoder: for an agent of either kind the first layer sees the state beside the goal."""
    env = envs.load("point_maze")
    presets.register("seen_as_they_are", env, presets.OGBENCH)
    for name in ("gciql", "offline_crl"):
        config = presets.load("seen_as_they_are", "none", agent=name)
        assert config.batch_size == 1024 and config.agent.hidden == (512, 512, 512)
        train = make_train(config, env)
        params = jax.eval_shape(
            lambda key, train=train, config=config: train.initial(key, config.hyper, train.env), KEY
        )
        assert not jax.tree.leaves((params.params["state"], params.params["goal"]))
        seen = params.params["agent"]["actor"]["params"]["Dense_0"]["kernel"]
        assert seen.shape == (env.goals.shape[0] + jax.eval_shape(lambda: env.observe(env.reset(KEY))).shape[0], 512)
    state, goal = np.ones((1, 2), np.float32), env.goals.evaluated[:1]
    setup = train.setup()
    assert (encode_states(setup, {"state": {}}, 1)(state) == state).all()
    assert (train.parts.learner.encode({}, env.goals.inputs_of(goal)).mean == env.goals.inputs_of(goal)).all()


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("state_encoder.features", {"state_encoder": StateEncoderConfig(features=0)}),
        ("learner.latent_size", {"learner": NoneConfig(latent_size=0)}),
    ],
)
def test_images_are_not_seen_as_they_are(field, changes):
    config = dataclasses.replace(manipulation_config("none"), **changes)
    with pytest.raises(UserError, match=rf"^{field} = 0: .*; give a size greater than 0$"):
        make_train(config, manipulation())


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("hiql", "offline_crl")])
def test_learns_where_to_go_on_a_line(name):
    """From random walks, for goals that are reached later and for any. By 400 updates two of six seeds of QRL are below
    0.9; by 800 all are at 1."""
    agent, entry = agent_of(name, 1, **({"hidden": (32, 32)} | ({"size": 32} if name == "qrl" else {})))
    hyper = entry.hyper(alpha=3.0) if name == "gcivl" else entry.hyper(alpha=0.01)
    before, after = vector_agents.success_on_the_line(agent, hyper, 0.7, costs=True, updates=800)
    assert after > 0.95 > before
