"""No relabelling: a transition keeps its desired goal."""

import dataclasses

from infogoal_jax.relabelling.relabelling import Relabelling


@dataclasses.dataclass(frozen=True)
class NoneConfig:
    """No settings."""

    def check(self, config) -> None:
        """Nothing to validate."""


def make(config: NoneConfig) -> Relabelling | None:
    """None."""
    return None
