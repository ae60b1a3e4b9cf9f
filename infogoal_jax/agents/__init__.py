"""Reinforcement-learning agents, a file a method. `registry` is the one place where a new agent is named."""

from infogoal_jax.agents import cql, dqn, hrac
from infogoal_jax.registry import Entry, find

registry: dict[str, Entry] = {
    "dqn": Entry(dqn.DQNConfig, dqn.make),
    "hrac": Entry(hrac.HRACConfig, hrac.make),
    "cql": Entry(cql.CQLConfig, cql.make),
}
"""An agent is made for an environment: `make(config, env)` reads the size of its actions, and the space of its subgoals."""


def entry(algorithm: str) -> Entry:
    """The registered agent of this name, or a `UserError` with the nearest one."""
    return find(registry, "algorithm", algorithm)
