"""Configuration of the goal encoder, the same for all learners, so that methods differ in nothing else."""

import dataclasses

from infogoal_jax.errors import require


@dataclasses.dataclass(frozen=True)
class GoalEncoderConfig:
    """Sizes of the goal encoder."""

    latent_size: int = 32
    """Size d of the goal code [A]."""
    hidden: tuple[int, ...] = (128, 128, 128)
    """Widths of the goal encoder's layers [A]. A decoder has them in reverse order."""
    standardise_images: bool = False
    """Give every goal image the same mean and contrast before it is encoded. This makes codes robust to corruption
    (docs/fetch.md)."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        require(self.latent_size > 0, "learner.latent_size", self.latent_size, "give a whole number greater than 0")
        require(
            all(width > 0 for width in self.hidden),
            "learner.hidden",
            self.hidden,
            "give widths greater than 0, for example 128 128 128",
        )


def check_pairs(learner, config) -> None:
    """Raise `UserError` for numbers of goal pairs, and a window to pair goals within, that are out of range."""
    for name in ("num_pairs", "num_negatives"):
        value = getattr(learner, name)
        require(value > 0, f"learner.{name}", value, "give a whole number greater than 0")
    require(
        0 <= learner.window <= config.env.episode_length,
        "learner.window",
        learner.window,
        f"must lie between 0 and the episode length, {config.env.episode_length}",
    )
