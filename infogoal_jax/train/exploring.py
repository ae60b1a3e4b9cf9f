"""What an explorer adds, where there is one: a bonus for each step, and a loss of its own."""

from typing import Any

import jax
import jax.numpy as jnp

from infogoal_jax.exploration.explorer import Moves
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.parts import Networks, Setup, TrainState, encode_states


def explore(setup: Setup, state: TrainState, buffer: Trajectories, written: jax.Array) -> tuple[jax.Array, TrainState]:
    """The bonus of each observation and action, float32 [K, A], and the state with what the explorer made of the rows
    of the buffer that are written, bool [R]."""
    parts, hyper, env = setup
    see = encode_states(setup, state.params, env.num_observations)
    features = see(jnp.arange(env.num_observations, dtype=jnp.int32))
    bonus, explored = parts.explorer.compute_bonus(
        state.params["explorer"], state.explorer, features, buffer, written, hyper.discount
    )
    return bonus, state.replace(explorer=explored)


def steps_explored(
    bonus: jax.Array, buffer: Trajectories, row: jax.Array, step: jax.Array, num_steps: int
) -> dict[str, Any]:
    """The fields of `Sample` for transitions that start at these rows and steps [B]: their bonuses and moves."""
    ahead = jnp.arange(num_steps, dtype=jnp.int32)[None]
    taken = jnp.minimum(step[:, None] + ahead, buffer.valid.shape[1] - 1)
    place = row[:, None], taken
    return {
        "bonus": bonus[buffer.observation[place], buffer.action[place]],
        "move": (buffer.observation[row, step], buffer.action[row, step], buffer.observation[row, step + 1]),
    }


def loss_of_explorer(
    setup: Setup, networks: Networks, state: Any, move: tuple, key: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array], Any]:
    """The explorer's loss of single steps (observation, action, next observation) [B], its metrics and its state. key:
    of the update."""
    observation, action, following = move
    see, see_by_target = (
        encode_states(setup, given, 2 * setup.config.batch_size) for given in (networks.params, networks.target_params)
    )
    moves = Moves(see(observation), action, jax.lax.stop_gradient(see_by_target(following)))
    return setup.parts.explorer.loss(networks.params["explorer"], state, moves, jax.random.fold_in(key, 4))
