"""What the networks see while training: features of states, and the inputs of goals as they are corrupted and
augmented."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.learners.learner import View


def encode_states(parts, params, env, asked: int) -> Callable[[Any], jax.Array]:
    """psi(s): stored observations [...] to features [..., F], by the encoder of these parameters.

    Every image once if there are fewer than will be asked for, else only those asked for.
    """
    if env.num_observations is not None and env.num_observations <= asked:
        return parts.state_encoder.apply(params["state"], env.render(jnp.arange(env.num_observations))).__getitem__
    return lambda observation: parts.state_encoder.apply(params["state"], env.render(observation))


def training_view(parts, env, augmented: bool) -> View | None:
    """How the inputs of goals look while training: as they are, or under a background, and in updates as the learner
    augments them."""

    def view(key, inputs):
        corrupt_key, augment_key = jax.random.split(key)
        if parts.config.training_corruption:
            backgrounds = draw_backgrounds(corrupt_key, env.train_backgrounds, inputs.shape[:-3])
            inputs = corrupt(inputs, backgrounds, parts.config.training_corruption)
        return augment(augment_key, inputs) if augment else inputs

    augment = parts.learner.augment if augmented else None
    return view if parts.config.training_corruption or augment else None
