"""No relabelling: a transition keeps the goal that it was made for."""

import dataclasses

from infogoal_jax.relabelling.relabelling import Relabelling


@dataclasses.dataclass(frozen=True)
class NoneConfig:
    """There is nothing to choose."""

    def check(self, config) -> None:
        """Always right."""


def make(config: NoneConfig) -> Relabelling | None:
    """None: nothing is relabelled."""
    return None
