"""What a code still says of the goal that it was made from: the probe of the trials.

Success mixes what a code says with what the policy makes of it. Here the policy is left out. From the code of a goal a
goal is guessed, in two ways, and the error is how far the guess lies from the truth, in degrees (cube) or metres
(Fetch), to be held beside the tolerance of success:

- `code_error`: the goal whose mean code is nearest to a sample of the code. That is the resolution of the code.
- `readout_error`: the goal whose pose is nearest to the one that a linear map reads out of the mean code. The map is
  fitted (ridge regression) to clean images of all goals but the test goals, so for test goals it has to generalise.

Both for clean images, and for images under test backgrounds: `corrupted_...`.
"""

import jax
import jax.numpy as jnp

from infogoal_jax.envs.object_manipulation import ObjectManipulation
from infogoal_jax.learners.learner import encode_all
from infogoal_jax.train.settings import corrupted_images

RIDGE = 1e-3
"""Of the mean squared entry of the codes, which are standardised."""


def poses(env) -> jax.Array:
    """What is to be read out of each goal's code float32 [num_goals, D]: positions in metres on Fetch; on the cube the
    products of the quaternion's entries, which do not see its sign."""
    if not isinstance(env.unwrapped, ObjectManipulation):
        return env.goal_positions
    quaternion = env.unwrapped.goal_quaternion
    return (quaternion[:, :, None] * quaternion[:, None, :]).reshape(len(quaternion), -1)


def distances(env, goals: jax.Array, guesses: jax.Array) -> jax.Array:
    """How far these goals [M] lie from the guessed ones [M], in degrees or metres."""
    if not isinstance(env.unwrapped, ObjectManipulation):
        return jnp.linalg.norm(env.goal_positions[goals] - env.goal_positions[guesses], axis=-1)
    quaternion = env.unwrapped.goal_quaternion
    cosine_of_half = jnp.abs((quaternion[goals] * quaternion[guesses]).sum(-1))
    return jnp.degrees(2 * jnp.arccos(jnp.minimum(cosine_of_half, 1.0)))


def nearest(table: jax.Array, points: jax.Array) -> jax.Array:
    """The row of `table` [N, D] that is nearest to each of `points` [M, D], by the mean absolute difference."""
    return jax.lax.map(lambda point: jnp.abs(table - point).mean(-1).argmin(), points)


def fit(codes: jax.Array, targets: jax.Array, shown: jax.Array):
    """Ridge regression of targets [N, D] on codes [N, L], over the rows of `shown` bool [N]. Returns the map, codes
    [M, L] -> targets [M, D]."""
    weight = shown[:, None] / shown.sum()
    mean, target_mean = (weight * codes).sum(0), (weight * targets).sum(0)
    spread = jnp.sqrt((weight * (codes - mean) ** 2).sum(0)) + 1e-6
    scaled = (codes - mean) / spread
    moments = scaled.T @ (weight * scaled) + RIDGE * jnp.eye(codes.shape[-1])
    slopes = jnp.linalg.solve(moments, scaled.T @ (weight * (targets - target_mean)))
    return lambda new: target_mean + (new - mean) / spread @ slopes


def code_errors(train, params, goals: jax.Array) -> dict[str, jax.Array]:
    """The errors named at the top of this file for goals int32 [M], each float32 [M]."""
    env, learner = train.env, train.parts.learner
    table, targets = encode_all(learner, params["goal"], env.goals).mean, poses(env)
    read_out = fit(table, targets, ~env.goals.test_mask)
    weight = train.parts.config.test_corruption
    pictures = {"": env.goals.inputs_of(goals), "corrupted_": corrupted_images(env, goals, 1, weight)[:, 0]}
    errors = {}
    for prefix, images in pictures.items():
        code = learner.encode(params["goal"], images)
        guesses = {"code_error": nearest(table, code.sample(jax.random.key(0)))}
        guesses["readout_error"] = nearest(targets, read_out(code.mean))
        errors |= {prefix + name: distances(env, goals, guess) for name, guess in guesses.items()}
    return errors
