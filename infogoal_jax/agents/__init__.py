"""Reinforcement-learning agents, a file a method. `registry` is the one place where a new agent is named."""

from infogoal_jax.agents import dqn, hrac

registry = {dqn.DQNConfig: dqn.make, hrac.HRACConfig: hrac.make}


def make(config, env):
    """The agent that this configuration belongs to, for this environment: it reads the size of its actions, and the space of its subgoals."""
    return registry[type(config)](config, env)
