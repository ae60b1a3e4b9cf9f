"""No explorer: the state encoder is trained by the agent's loss alone, and moves earn no bonus."""

import dataclasses

from infogoal_jax.exploration.explorer import Explorer


@dataclasses.dataclass(frozen=True)
class NoneConfig:
    """There is nothing to choose."""

    def check(self, config) -> None:
        """Always right."""


def make(config: NoneConfig) -> Explorer | None:
    """None: nothing is added."""
    return None
