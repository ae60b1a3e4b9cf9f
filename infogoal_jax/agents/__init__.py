"""Reinforcement-learning agents, a file each. `registry` is the one place where a new one is named."""

from infogoal_jax.agents import cql, dqn, hrac
from infogoal_jax.registry import Entry, Registry

registry = Registry("agent", {
    "dqn": Entry(dqn.DQNConfig, dqn.make),
    "hrac": Entry(hrac.HRACConfig, hrac.make, hrac.HRACHyperparameters),
    "cql": Entry(cql.CQLConfig, cql.make, cql.CQLHyperparameters),
})
"""An agent is made for an environment: `make(config, env)` reads the size of its actions, and the space of its subgoals."""
