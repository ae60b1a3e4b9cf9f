"""What each loss of the offline agents reads, and which networks it teaches, on transitions of which every part has
numbers of its own. The fixtures of `test_offline.py` are OGBench's, where the target networks see the same states under
the same goals as what learns: one taken for another would not be seen there."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vector_agents

from infogoal_jax import agents
from infogoal_jax.agents.agent import ActorGoals, AgentBatch, Waypoints

KEY = jax.random.key(0)
AFTER = "reward discount target_features target_code first_target_features first_target_code"
CASES = {
    # name, changes: {loss: what of the batch and of the (target) networks it reads; the networks that it teaches}
    ("gcivl", ""): {
        "value_loss": (f"features code {AFTER} value target:value", "value"),
        "actor_loss": ("features next_features action actor.code actor.next_code actor value", "actor"),
    },
    ("gciql", "actor_loss=ddpg_bc"): {
        "value_loss": ("features code action first_target_features first_target_code value target:critic", "value"),
        "critic_loss": ("features code action reward discount next_features next_code critic value", "critic"),
        "actor_loss": ("features action actor.code actor critic", "actor"),
    },
    ("gciql", "actor_loss=awr"): {"actor_loss": ("features action actor.code actor critic value", "actor")},
    ("qrl", "actor_loss=ddpg_bc"): {
        "distance_loss": (
            "features next_features code at_goal value goals mixture log_lambda",
            "value goals mixture log_lambda",
        ),
        "dynamics_loss": ("features next_features action value dynamics mixture", "value dynamics mixture"),
        # -d over its own mean size is -1, whatever d is: the embeddings show in the slope alone.
        "actor_loss": ("features action actor.code actor", "actor"),
    },
    ("qrl", "actor_loss=awr"): {
        "actor_loss": ("features next_features action actor.code actor.next_code actor value goals mixture", "actor")
    },
    ("hiql", ""): {
        "value_loss": (f"features code {AFTER} value goals target:value", "value goals"),
        "low_loss": (
            "features next_features action waypoints.low_code waypoints.next_low_code waypoints.low_weight "
            "low value goals",
            "low",
        ),
        "high_loss": (
            "features actor.code waypoints.code waypoints.features waypoints.code_there waypoints.weight "
            "high value goals",
            "high",
        ),
    },
    ("offline_crl", ""): {
        "contrastive_loss": ("features code action phi psi", "phi psi"),
        "actor_loss": ("features action actor.code actor phi psi", "actor"),
    },
}


@functools.cache
def made(name: str, changes: str):
    """The agent, parameters, other ones as those of its target networks, its state and its floats."""
    sizes = {"qrl": {"size": 16}, "hiql": {"size": 4}, "offline_crl": {"size": 8}}.get(name, {})
    agent = vector_agents.agent_of(name, **sizes, **dict([changes.split("=")] if changes else []))
    params, state = vector_agents.started(agent)
    params, target_params = (vector_agents.varied(params, seed) for seed in (1, 2))
    return agent, params, target_params, state, agents.registry.entry(name).hyper()


def batch_of() -> AgentBatch:
    """Transitions of which no two parts are equal."""
    generator = np.random.default_rng(3)

    def normal(size):
        return jnp.asarray(generator.normal(size=(vector_agents.B, size)), jnp.float32)

    goal, state = functools.partial(normal, vector_agents.D), functools.partial(normal, vector_agents.F)
    some = jnp.arange(vector_agents.B) % 3 > 0
    return vector_agents.random_batch(
        reward=normal(1)[:, 0],
        first_target_features=state(),
        first_target_code=goal(),
        at_goal=some,
        actor=ActorGoals(goal(), goal()),
        waypoints=Waypoints(goal(), goal(), goal(), state(), goal(), some * 1.0, 1.0 - some),
    )


def parts_of(given: tuple) -> dict[str, tuple]:
    """Every part of (params, target_params, batch) by its name, with what `given` is where that part alone is another
    one."""
    params, target_params, batch = given
    found = {name: (params | {name: other(params[name])}, target_params, batch) for name in params}
    for name in target_params:
        found[f"target:{name}"] = (params, target_params | {name: other(target_params[name])}, batch)
    for path, _ in jax.tree_util.tree_leaves_with_path(batch):
        name = jax.tree_util.keystr(path).lstrip(".")
        if "mask" not in name:
            changed = jax.tree_util.tree_map_with_path(
                lambda at, own, path=path: other(own) if at == path else own, batch
            )
            found[name] = (params, target_params, changed)
    return found


def other(tree):
    """Other numbers of the same shapes."""
    return jax.tree.map(lambda leaf: ~leaf if leaf.dtype == bool else 0.3 - 1.5 * leaf, tree)


@pytest.mark.parametrize("case", CASES, ids="-".join)
def test_each_loss_reads_what_it_should_and_teaches_its_own_networks(case):
    agent, params, target_params, state, hyper = made(*case)
    given, losses = (params, target_params, batch_of()), CASES[case]

    @jax.jit
    def found(params, target_params, batch):
        """The losses [L], and the slope of each in the networks and in what encoders give."""

        def losses_of(params, features, code):
            seen = batch.replace(features=features, code=code)
            metrics = agent.loss(params, target_params, seen, state, hyper, KEY)[1]
            return jnp.stack([metrics[name] for name in losses])

        values, slopes_of = jax.vjp(losses_of, params, batch.features, batch.code)
        return values, jax.vmap(slopes_of)(jnp.eye(len(losses)))

    before, slopes = found(*given)
    after = {name: found(*changed)[0] for name, changed in parts_of(given).items()}
    networks, *encoded = slopes
    for number, (name, (reads, teaches)) in enumerate(losses.items()):
        assert {part for part, changed in after.items() if changed[number] != before[number]} == {*reads.split()}, name
        taught = {
            network for network, slope in networks.items() if any(leaf[number].any() for leaf in jax.tree.leaves(slope))
        }
        assert taught == {*teaches.split()}, name
        encoders = name not in ("actor_loss", "low_loss", "high_loss")  # The encoders of states, and of goals.
        assert [bool(slope[number].any()) for slope in encoded] == [encoders, encoders and name != "dynamics_loss"], (
            name
        )


@pytest.mark.parametrize("case", [("gcivl", ""), ("qrl", "actor_loss=awr")], ids="-".join)
def test_an_action_counts_the_more_the_nearer_it_leads(case):
    """exp(alpha (V(s', g) - V(s, g))), of each transition by itself."""
    agent, params, target_params, state, hyper = made(*case)
    hyper = hyper.replace(alpha=2.0)

    @jax.jit
    def weights(batch):
        """Of the loss, and by the agent's own values [B]."""

        def of_one(batch):
            metrics = agent.loss(params, target_params, batch, state, hyper, KEY)[1]
            return -metrics["actor_loss"] / metrics["log_density"]

        alone = jax.tree.map(lambda leaf: leaf[:, None], batch)
        nearer = agent.value(params, batch.next_features, batch.actor.next_code, None)
        return jax.vmap(of_one)(alone), jnp.exp(
            2.0 * (nearer - agent.value(params, batch.features, batch.actor.code, None))
        )

    found, expected = weights(batch_of())
    np.testing.assert_allclose(found, np.minimum(expected, 100.0), rtol=1e-4)
    assert (expected > 1).any() and (expected < 1).any()
