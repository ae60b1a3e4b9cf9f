"""Replay buffer: rows of consecutive environment steps, as a task stores what it observes: an index where there is a
list of all images, else a vector or an image. Pure functions over `Trajectories`.

A row holds T + 1 observations and the T transitions between them. A row may hold several episodes. The step from the
last observation of an episode to the first of the next is marked invalid, as one that diverged is, and no function
below looks across it.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp


@flax.struct.dataclass
class Trajectories:
    """R rows of T transitions."""

    observation: jax.Array
    """Pytree of [R, T + 1, ...], what the agent saw."""
    record: jax.Array
    """Pytree of [R, T + 1, ...], what was achieved."""
    action: jax.Array
    """int32 [R, T], or float32 [R, T, A]."""
    desired_goal: jax.Array
    """[R, T, *shape]."""
    valid: jax.Array
    """bool [R, T], whether t -> t + 1 is a transition of one episode: no reset, and no step that diverged."""
    terminated: jax.Array
    """bool [R, T], whether the transition reached the goal, and so ended its episode."""
    truncated: jax.Array
    """bool [R, T], whether the episode ended otherwise with the step: time was up, it failed, or the step diverged."""
    decided: jax.Array
    """bool [R, T], whether the agent chose the action at t. A subgoal holds for several steps."""
    failed: jax.Array | None = None
    """bool [R, T], whether the episode failed with the transition; None where none can."""
    there: jax.Array | None = None
    """bool [R, T + 1], whether an observation stands at this place; None where one stands at each. Recorded episodes of
    several lengths leave places empty, which achieve nothing."""

    def episode(self) -> jax.Array:
        """Number of the episode that each observation belongs to, int32 [R, T + 1], counted from 0 in each row."""
        return jnp.pad(jnp.cumsum((~self.valid).astype(jnp.int32), axis=1), ((0, 0), (1, 0)))


@flax.struct.dataclass
class Transitions:
    """B transitions of up to n steps, each within one episode."""

    observation: jax.Array
    """[B, ...] before the first step."""
    next_observation: jax.Array
    """[B, ...] after the last step."""
    action: jax.Array
    """[B, ...] of the first step."""
    desired_goal: jax.Array
    """[B, *shape]."""
    records: jax.Array
    """[B, n, ...] achieved after each step."""
    mask: jax.Array
    """float32 [B, n], 1 for a step that was taken."""
    terminated: jax.Array
    """bool [B], whether the last step reached the goal, or failed: nothing follows."""
    failed: jax.Array | None = None
    """bool [B], whether the episode failed with the last step; None where none can."""


def empty(example: Trajectories, buffer_epochs: int) -> Trajectories:
    """Make a buffer for `buffer_epochs` times the rows of `example`, all invalid. Only the shapes of `example` are
    read."""
    return jax.tree.map(lambda leaf: jnp.zeros((leaf.shape[0] * buffer_epochs, *leaf.shape[1:]), leaf.dtype), example)


def add(buffer: Trajectories, rows: Trajectories, epoch: jax.Array) -> Trajectories:
    """Replace the oldest rows of the buffer by those of this epoch. `epoch` is not batched over seeds, and decides the
    place."""
    capacity, new = buffer.valid.shape[0], rows.valid.shape[0]
    start = (epoch * new) % capacity
    return jax.tree.map(lambda old, row: jax.lax.dynamic_update_slice_in_dim(old, row, start, axis=0), buffer, rows)


def running_count(mask: jax.Array) -> jax.Array:
    """Running count over a flattened mask. Computed once an epoch, it makes each uniform draw among the true entries a
    binary search."""
    return jnp.cumsum(mask.reshape(-1).astype(jnp.int32))


def draw(key: jax.Array, count: jax.Array, num: int | tuple[int, ...], width: int) -> tuple[jax.Array, jax.Array]:
    """Draw `num` positions (row, column), or positions of this shape, uniformly among the true entries of a mask [R,
    width]. count: its `running_count`."""
    shape = (num,) if isinstance(num, int) else num
    rank = jax.random.randint(key, shape, 0, jnp.maximum(count[-1], 1), jnp.int32)
    flat = jnp.minimum(jnp.searchsorted(count, rank, side="right"), count.shape[0] - 1)
    return flat // width, flat % width


def transitions_at(
    buffer: Trajectories,
    row: jax.Array,
    first: jax.Array,
    num_steps: int,
    desired_goal: jax.Array | None = None,
    reached: Callable | None = None,
) -> Transitions:
    """The transitions that start at these rows and steps, int32 [B] each, with at most `num_steps` steps of one
    episode.

    desired_goal: [B, *shape] in place of the stored ones. `reached(records [B, n, ...], goal [B, 1, *shape]) ->
    bool [B, n]` then decides where an episode terminates; None: reaching a goal ends nothing.
    """
    length = buffer.valid.shape[1]
    step = first[:, None] + jnp.arange(num_steps, dtype=jnp.int32)[None]
    inside = step < length
    step = jnp.minimum(step, length - 1)
    going_on = inside & buffer.valid[row[:, None], step]
    mask = jnp.cumprod(going_on, axis=1, dtype=jnp.int32)
    records = jax.tree.map(lambda leaf: leaf[row[:, None], step + 1], buffer.record)
    if desired_goal is None or reached is None:
        desired_goal = buffer.desired_goal[row, first] if desired_goal is None else desired_goal
        last = first + mask.sum(1, dtype=jnp.int32) - 1
        terminated = buffer.terminated[row, last]
    else:
        hit = reached(records, desired_goal[:, None]) & (mask > 0)
        earlier = jnp.cumsum(hit, axis=1, dtype=jnp.int32) - hit.astype(jnp.int32)
        mask = mask * (earlier == 0).astype(jnp.int32)  # Nothing counts after the first hit.
        last, terminated = first + mask.sum(1, dtype=jnp.int32) - 1, hit.any(1)
    failed = None if buffer.failed is None else buffer.failed[row, last]
    if failed is not None:
        terminated = terminated | failed
    return Transitions(
        observation=jax.tree.map(lambda leaf: leaf[row, first], buffer.observation),
        next_observation=jax.tree.map(lambda leaf: leaf[row, last + 1], buffer.observation),
        action=buffer.action[row, first],
        desired_goal=desired_goal,
        records=records,
        mask=mask.astype(jnp.float32),
        terminated=terminated,
        failed=failed,
    )


def steps_left(valid: jax.Array) -> jax.Array:
    """Count the valid transitions from each step to the end of its episode, its own included: bool [R, T] to int32 [R,
    T]."""

    def back(following, now):
        left = jnp.where(now, following + 1, 0)
        return left, left

    start = jnp.zeros(valid.shape[0], jnp.int32)
    return jax.lax.scan(back, start, valid.T, reverse=True)[1].T


def sample_within_window(
    key: jax.Array, buffer: Trajectories, achieved: jax.Array, count: jax.Array, num: int, window: int
):
    """Sample pairs of steps of one episode, at most `window` apart, that both achieve a goal (Algorithm 1, lines 16 and
    17).

    The first step is uniform over all that achieve a goal, the second over those in its window, the first included (lag
    0).
    achieved: bool [R, T + 1], steps that achieve a goal. count: `running_count(achieved)`.
    Returns the rows and both steps, int32 [num] each.
    """
    choose_first, choose_second = jax.random.split(key)
    width = achieved.shape[1]
    row, first = draw(choose_first, count, num, width)
    around = first[:, None] + jnp.arange(-window, window + 1, dtype=jnp.int32)[None]
    inside = (around >= 0) & (around < width)
    around = jnp.clip(around, 0, width - 1)
    breaks = jnp.pad(
        jnp.cumsum(~buffer.valid[row], axis=1, dtype=jnp.int32), ((0, 0), (1, 0))
    )  # [num, T + 1] number of the episode
    same_episode = jnp.take_along_axis(breaks, around, axis=1) == jnp.take_along_axis(breaks, first[:, None], axis=1)
    possible = inside & same_episode & achieved[row[:, None], around]
    preference = jnp.where(possible, jax.random.uniform(choose_second, around.shape, jnp.float32), -1.0)
    second = jnp.take_along_axis(around, preference.argmax(1)[:, None], axis=1)[:, 0]
    return row, first, second
