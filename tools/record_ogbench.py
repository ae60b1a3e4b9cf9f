"""Write tests/fixtures/ogbench.npz: one update of each offline agent of OGBench, run on random transitions, so that
tests/agents/test_offline.py can compare the agents here with it.

    git clone https://github.com/seohongpark/ogbench && pip install distrax ml_collections
    python tools/record_ogbench.py ogbench/impls tests/fixtures/ogbench.npz

Parameters and transitions are drawn by NumPy. Written are these, the loss, its parts, and the gradient that its update
makes; no code.
"""

import sys
from pathlib import Path

import jax
import numpy as np

B, F, A = 12, 6, 2
SMALL = {"actor_hidden_dims": (16, 16), "value_hidden_dims": (16, 16), "batch_size": B}
CASES = {
    "gcivl": ("gcivl", {"alpha": 10.0}),
    "gciql_ddpg_bc": ("gciql", {"actor_loss": "ddpgbc", "alpha": 0.3}),
    "gciql_awr": ("gciql", {"actor_loss": "awr", "alpha": 10.0}),
    "qrl": ("qrl", {"alpha": 0.003, "latent_dim": 16}),
    "crl": ("crl", {"alpha": 0.1, "latent_dim": 16}),
    "hiql": ("hiql", {"high_alpha": 3.0, "low_alpha": 3.0, "rep_dim": 4}),
}


def transitions(generator: np.random.Generator) -> dict[str, np.ndarray]:
    """Random transitions with every kind of goal; a quarter of the values' goals are reached."""
    names = ("observations", "next_observations", "value_goals", "actor_goals")
    names += ("low_actor_goals", "high_actor_goals", "high_actor_targets")
    batch = {name: generator.normal(size=(B, F)).astype(np.float32) for name in names}
    batch["actions"] = np.tanh(generator.normal(size=(B, A))).astype(np.float32)
    reached = (np.arange(B) % 4 == 0).astype(np.float32)
    batch["value_goals"][reached > 0] = batch["observations"][reached > 0]
    return batch | {"rewards": reached - 1.0, "masks": 1.0 - reached}


def flat(tree, prefix: str) -> dict[str, np.ndarray]:
    """The leaves of nested dictionaries by the names of their places."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {prefix + "/".join(str(key.key) for key in path): np.asarray(leaf) for path, leaf in leaves}


def recorded(agents: dict, name: str, changes: dict, seed: int) -> dict[str, np.ndarray]:
    """What one agent makes of transitions, by name."""
    generator, (cls, config) = np.random.default_rng(seed), agents[name]
    batch, config = transitions(generator), config()
    config.update(SMALL | changes)
    agent = cls.create(0, batch["observations"], batch["actions"], config)
    params = jax.tree.map(
        lambda leaf: np.asarray(leaf) + (0.1 * generator.normal(size=leaf.shape)).astype(np.float32),
        agent.network.params,
    )
    agent = agent.replace(network=agent.network.replace(params=params))
    gradient, info = jax.grad(lambda own: agent.total_loss(batch, own, rng=jax.random.key(0)), has_aux=True)(params)
    loss = agent.total_loss(batch, params, rng=jax.random.key(0))[0]
    found = flat(batch, "batch/") | flat(params, "params/") | flat(gradient, "gradient/") | flat(info, "info/")
    return found | {"loss": np.asarray(loss), "discount": np.float32(config.discount)}


def main():
    """Run each agent and write the file."""
    impls, path = sys.argv[1:]
    sys.path.insert(0, impls)
    import agents
    from agents import crl, gciql, gcivl, hiql, qrl

    modules = {"gcivl": gcivl, "gciql": gciql, "qrl": qrl, "crl": crl, "hiql": hiql}
    known = {name: (agents.agents[name], module.get_config) for name, module in modules.items()}
    found = {}
    for seed, (case, (name, changes)) in enumerate(CASES.items()):
        found |= {f"{case}/{key}": value for key, value in recorded(known, name, changes, seed).items()}
    np.savez_compressed(Path(path), **found)


if __name__ == "__main__":
    main()
