"""The finite goal space of a task as arrays. A goal is an int32 index into a `GoalSet` everywhere; -1 stands for "no goal"."""

import flax.struct
import jax


@flax.struct.dataclass
class GoalSet:
    """N goals, their inputs and their uses.

    inputs: [N, ...] what the goal encoder sees (float32 text embeddings [N, 384], or uint8 images).
    regions: int32 [N] the part of the world a goal lies in (a room); for reports and for the share of positives within and between.
    train_mask, validation_mask, test_mask: bool [N], disjoint. Only training goals are ever commanded while training.
    names, region_names: for reports. groups: which of "train", "validation" and "test" have goals.
    """

    inputs: jax.Array
    regions: jax.Array
    train_mask: jax.Array
    validation_mask: jax.Array
    test_mask: jax.Array
    names: tuple[str, ...] = flax.struct.field(pytree_node=False)
    region_names: tuple[str, ...] = flax.struct.field(pytree_node=False)
    groups: tuple[str, ...] = flax.struct.field(pytree_node=False)

    @property
    def num_goals(self) -> int:
        """N, the number of goals."""
        return len(self.names)
