"""Reinforcement-learning agents, one file each. A new one is registered in `registry`."""

from typing import Any

from infogoal_jax.agents import cql, crl, dqn, gciql, gcivl, hiql, hrac, offline, offline_crl, qrl, sac, td3
from infogoal_jax.agents.agent import AgentTraits
from infogoal_jax.registry import Entry, Registry

registry = Registry(
    "agent",
    {
        "dqn": Entry(dqn.DQNConfig, dqn.make, traits=dqn.traits),
        "hrac": Entry(hrac.HRACConfig, hrac.make, hrac.HRACHyperparameters, hrac.traits),
        "td3": Entry(td3.TD3Config, td3.make, td3.TD3Hyperparameters, td3.traits),
        "sac": Entry(sac.SACConfig, sac.make, sac.SACHyperparameters, sac.traits),
        "crl": Entry(crl.CRLConfig, crl.make, crl.CRLHyperparameters, crl.traits, of_relabelling=crl.OF_RELABELLING),
        "gcivl": offline.entry(gcivl.GCIVLConfig, gcivl.make, gcivl.GCIVLHyperparameters),
        "gciql": offline.entry(gciql.GCIQLConfig, gciql.make, gciql.GCIQLHyperparameters),
        "hiql": offline.entry(hiql.HIQLConfig, hiql.make, hiql.HIQLHyperparameters, hiql.OF_RELABELLING),
        "offline_crl": offline.entry(
            offline_crl.OfflineCRLConfig,
            offline_crl.make,
            offline_crl.OfflineCRLHyperparameters,
            offline_crl.OF_RELABELLING,
            offline_crl.traits,
        ),
        "qrl": offline.entry(qrl.QRLConfig, qrl.make, qrl.QRLHyperparameters, qrl.of_relabelling),
        "cql": Entry(cql.CQLConfig, cql.make, cql.CQLHyperparameters, dqn.traits),
    },
)
"""`make(config, env)` makes an agent for an environment: it reads the number of actions, or the space of subgoals."""


def traits_of(agent: Any) -> AgentTraits:
    """What the agent of this configuration declares."""
    declared = registry.entry_of(agent).traits
    return AgentTraits() if declared is None else declared(agent)
