"""No explorer: the agent's loss alone trains the state encoder, and there is no bonus."""

import dataclasses

from infogoal_jax.exploration.explorer import Explorer


@dataclasses.dataclass(frozen=True)
class NoneConfig:
    """No settings."""

    def check(self, config) -> None:
        """Nothing to validate."""


def make(config: NoneConfig) -> Explorer | None:
    """None."""
    return None
