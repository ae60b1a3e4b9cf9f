"""Learning each transition from many goals at once, where the agent asks for it (`agents/all_goals.py`)."""

import jax
import jax.numpy as jnp

from infogoal_jax import pairs as goal_pairs
from infogoal_jax.agents.agent import AllGoals
from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.agents.value_heads import returns_of_all
from infogoal_jax.goals import select
from infogoal_jax.keys import draw_chance
from infogoal_jax.replay import Transitions
from infogoal_jax.train.experience import Experience
from infogoal_jax.train.parts import Networks, Setup, code_seen, goal_encoding


def goals_to_learn(setup: Setup, experience: Experience) -> jax.Array:
    """Goals of a finite set that something may be learned of: known ones, and those that are desired from the start;
    bool [N]."""
    return experience.known.mask | setup.env.goals.desired_mask


def draw_goals_to_learn(setup: Setup, experience: Experience, key: jax.Array, num: int) -> jax.Array:
    """Goals [num, *shape] that something may be learned of: known ones and training goals. In a continuous space half
    of them are of each kind."""
    if setup.env.goals.finite:
        return goal_pairs.choose_from_mask(key, goals_to_learn(setup, experience), (num,))
    known_key, desired_key, choose_key = jax.random.split(key, 3)
    desired_goal = jax.vmap(setup.env.goals.draw)(jax.random.split(desired_key, num))
    take_known = draw_chance(choose_key, 0.5, (num,)) & experience.known.any()
    return select(take_known, experience.known.draw(known_key, (num,)), desired_goal)


def draw_goals(
    spec: OfAllGoals, known: jax.Array, achieved: jax.Array, desired_goal: jax.Array, key: jax.Array
) -> tuple[jax.Array | None, jax.Array]:
    """The goals int32 [num_goals] that an update learns from: a share of those achieved in the batch, a share of those
    that were desired, else any known one. None: all goals of the task. And the weight of each in the loss.

    known: bool [N]; achieved: int32 [B, n, K], padded with -1; desired_goal: int32 [B].
    """
    if not 0 < spec.num_goals < known.shape[0]:
        return None, goal_weights(known)
    goal_key, which_key, any_key = jax.random.split(key, 3)
    num_achieved = round(spec.achieved_share * spec.num_goals)
    num_desired = min(round(spec.desired_share * spec.num_goals), spec.num_goals - num_achieved)
    of_transition = goal_pairs.choose_goal(goal_key, achieved.reshape(achieved.shape[0], -1))
    found = of_transition[jax.random.randint(which_key, (num_achieved,), 0, achieved.shape[0], jnp.int32)]
    place = jax.random.randint(jax.random.fold_in(key, 3), (num_desired,), 0, len(desired_goal), jnp.int32)
    anything = goal_pairs.choose_from_mask(any_key, known, (spec.num_goals,))
    found = jnp.where(found >= 0, found, anything[:num_achieved])
    goals = jnp.concatenate([found, desired_goal[place], anything[num_achieved + num_desired :]])
    return goals, goal_weights(known[goals])


def goal_weights(known: jax.Array) -> jax.Array:
    """The weight of each goal in a mean over the known ones, float32 [G]: known bool [G].

    Drawn with the goals, not in the loss: there XLA sums it again for every tile of the values on a GPU, which took a
    fifth of an update of the cube.
    """
    count = jnp.maximum(known.sum(dtype=jnp.int32), 1)
    return known.astype(jnp.float32) / count.astype(jnp.float32)


def under_all_goals(
    setup: Setup, networks: Networks, batch: Transitions, goals: jax.Array | None, weight: jax.Array, key: jax.Array
) -> AllGoals:
    """The transitions under the goals [G], or under all goals of the task, of which unknown ones have no weight. key:
    of the noise of codes."""
    parts, hyper, env = setup
    params, target_params, view_key = networks
    goals = jnp.arange(env.goals.num_goals, dtype=jnp.int32) if goals is None else goals
    records = jax.tree.map(lambda leaf: leaf[:, :, None], batch.records)
    reward, discount = returns_of_all(env.reached(records, goals), batch.mask, hyper.discount)
    if batch.failed is not None:
        discount = discount * (~batch.failed).astype(jnp.float32)[:, None]
    code, target_code = (goal_encoding(setup, given, view_key).of_any()(goals) for given in (params, target_params))
    if parts.config.stop_encoder_gradient:
        code = jax.lax.stop_gradient(code)
    keys = jax.random.split(key)
    return AllGoals(
        weight=weight,
        code=code_seen(parts, code, keys[0]),
        target_code=code_seen(parts, target_code, keys[1]),
        reward=reward,
        discount=discount,
    )
