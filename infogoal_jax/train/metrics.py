"""Metrics of updates: numbers by name, and counts of goal pairs within and between the regions of a task."""

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.pairs import GoalPairs


@flax.struct.dataclass
class Scalars:
    """Numbers by name, as one vector: a loop would store each on its own."""

    values: jax.Array
    """float32 [n], or of several updates [U, n]."""
    names: tuple[str, ...] = flax.struct.field(pytree_node=False)

    @classmethod
    def of(cls, numbers: dict[str, jax.Array]) -> "Scalars":
        """The vector of these numbers []."""
        return cls(jnp.stack([jnp.asarray(number, jnp.float32) for number in numbers.values()]), tuple(numbers))

    def means(self) -> dict[str, jax.Array]:
        """The mean of each over the first axis."""
        return dict(zip(self.names, self.values.mean(0), strict=True))


def named(part: str, metrics: dict) -> dict:
    """The metrics under the name of the part that they are about."""
    return {f"{part}/{name}": value for name, value in metrics.items()}


def positive_regions(pairs: GoalPairs, regions: jax.Array) -> dict[str, jax.Array]:
    """Shares of the positive pairs whose two goals lie in one region (two different goals), and in different
    regions."""
    total = jnp.maximum(pairs.positive_weight.sum(), 1.0)
    same = regions[pairs.anchor] == regions[pairs.positive]
    found = {"positives_within": same & (pairs.anchor != pairs.positive), "positives_between": ~same}
    return {
        name: (of_kind.astype(jnp.float32) * pairs.positive_weight).sum() / total for name, of_kind in found.items()
    }


def count_dissimilar_regions(dissimilarity: jax.Array, regions: jax.Array, seen: jax.Array) -> dict[str, jax.Array]:
    """Count the dissimilar pairs of seen goals within and between regions. The counts show whether the window fits the
    geometry."""
    same_region = regions[:, None] == regions[None, :]
    upper = jnp.triu(dissimilarity & seen[:, None] & seen[None, :])
    counted = {"dissimilar_within": upper & same_region, "dissimilar_between": upper & ~same_region}
    return {name: found.sum(dtype=jnp.int32) for name, found in counted.items()}
