"""Reinforcement-learning agents, one file each. A new one is registered in `registry`."""

from infogoal_jax.agents import cql, crl, dqn, gciql, gcivl, hiql, hrac, offline, offline_crl, qrl, sac, td3
from infogoal_jax.registry import Entry, Registry

registry = Registry(
    "agent",
    {
        "dqn": Entry(dqn.DQNConfig, dqn.make, traits=dqn.traits),
        "hrac": Entry(hrac.HRACConfig, hrac.make, hrac.HRACHyperparameters, hrac.traits),
        "td3": Entry(td3.TD3Config, td3.make, td3.TD3Hyperparameters, td3.traits),
        "sac": Entry(sac.SACConfig, sac.make, sac.SACHyperparameters, sac.traits),
        "crl": Entry(crl.CRLConfig, crl.make, crl.CRLHyperparameters, crl.traits, of_relabelling=crl.OF_RELABELLING),
        "gcivl": Entry(gcivl.GCIVLConfig, gcivl.make, gcivl.GCIVLHyperparameters, offline.traits, relabelling="mixed"),
        "gciql": Entry(gciql.GCIQLConfig, gciql.make, gciql.GCIQLHyperparameters, offline.traits, relabelling="mixed"),
        "hiql": Entry(
            hiql.HIQLConfig,
            hiql.make,
            hiql.HIQLHyperparameters,
            offline.traits,
            of_relabelling=hiql.OF_RELABELLING,
            relabelling="mixed",
        ),
        "offline_crl": Entry(
            offline_crl.OfflineCRLConfig,
            offline_crl.make,
            offline_crl.OfflineCRLHyperparameters,
            offline.traits,
            of_relabelling=offline_crl.OF_RELABELLING,
            relabelling="mixed",
        ),
        "qrl": Entry(
            qrl.QRLConfig,
            qrl.make,
            qrl.QRLHyperparameters,
            offline.traits,
            of_relabelling=qrl.OF_RELABELLING,
            relabelling="mixed",
        ),
        "cql": Entry(cql.CQLConfig, cql.make, cql.CQLHyperparameters, dqn.traits),
    },
)
"""`make(config, env)` makes an agent for an environment: it reads the number of actions, or the space of subgoals."""
