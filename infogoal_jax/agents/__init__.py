"""Reinforcement-learning agents, a file a method. `registry` is the one place where a new agent is named."""

from infogoal_jax.agents import dqn

registry = {dqn.DQNConfig: dqn.make}


def make(config, num_actions: int):
    """The agent that this configuration belongs to."""
    return registry[type(config)](config, num_actions)
