"""What training carries from epoch to epoch, and what it returns."""

from typing import Any

import flax.struct
import jax

from infogoal_jax.replay import Trajectories
from infogoal_jax.threefry import written_out

# Purposes for which keys are folded from the seed's key, so that a draw depends on nothing but seed, purpose and epoch.
INITIAL, COLLECT, UPDATE, CORRUPT = range(4)


def numbered(key: jax.Array, purpose: int, number: jax.Array) -> jax.Array:
    """A seed's key for a purpose and a number, such as that of the epoch; neither is batched."""
    return jax.random.fold_in(jax.random.fold_in(written_out(key), purpose), number)


@flax.struct.dataclass
class TrainState:
    """Everything that training carries from epoch to epoch, for one seed.

    params, target_params: {"goal", "state", "agent"}, and "explorer" where there is one; learner, agent, explorer:
    their states;
    dissimilarity: bool [N, N]; seen: bool [N] goals achieved; buffer: Trajectories; env_states: [num_envs]; both None
    offline.
    key: the seed's key, never consumed; env_steps: int32, collected or recorded.
    """

    params: dict
    target_params: dict
    optimizer_state: Any
    learner: Any
    agent: Any
    explorer: Any
    dissimilarity: jax.Array
    seen: jax.Array
    buffer: Trajectories | None
    env_states: Any
    key: jax.Array
    env_steps: jax.Array


@flax.struct.dataclass
class TrainResult:
    """metrics: evaluations, {name: [num_evaluations, ...]}; epochs: {name: [num_epochs]}; params: the last parameters;
    state: to go on from."""

    metrics: dict[str, jax.Array]
    epochs: dict[str, jax.Array]
    params: dict
    state: TrainState
