"""What ends a flight, apart from its object: numbers that a person may choose."""

import dataclasses

from infogoal_jax.errors import require


@dataclasses.dataclass(frozen=True)
class Limits:
    """What ends a flight."""

    steps: int = 50
    """Moves that are tried at most [P]."""
    battery_floor: int = 25
    """Per cent of the battery at which it lands."""
    confidence: float = 0.5
    """Of the detector, from which an object counts as seen."""

    def check(self) -> None:
        """Raise `UserError` for values out of range."""
        require(self.steps > 0, "steps", self.steps, "give a whole number greater than 0")
        require(15 <= self.battery_floor < 100, "battery_floor", self.battery_floor, "give 15 to 99 per cent")
        require(0 < self.confidence <= 1, "confidence", self.confidence, "give a number in (0, 1]")
