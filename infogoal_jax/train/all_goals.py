"""Transitions under all goals: which goals an update learns from, and the transitions' rewards and codes under them."""

import jax
import jax.numpy as jnp

from infogoal_jax import pairs
from infogoal_jax.agents.agent import AllGoals
from infogoal_jax.agents.value_heads import returns_of_all
from infogoal_jax.learners.learner import GoalEncoding
from infogoal_jax.relabelling.relabelling import AllGoalsSpec
from infogoal_jax.replay import Transitions
from infogoal_jax.train.encoding import training_view


def spec_of(parts) -> AllGoalsSpec | None:
    """What the relabelling asks for; None where a transition has one goal."""
    return None if parts.relabelling is None else parts.relabelling.all_goals


def draw_goals(spec: AllGoalsSpec, known: jax.Array, achieved: jax.Array, key: jax.Array) -> jax.Array | None:
    """The goals int32 [num_goals] that an update learns from: a share of those achieved in the batch, else any known
    one. None: all goals of the task.

    known: bool [N]; achieved: int32 [B, n, K], padded with -1.
    """
    if not 0 < spec.num_goals < known.shape[0]:
        return None
    goal_key, which_key, any_key = jax.random.split(key, 3)
    count = round(spec.achieved_share * spec.num_goals)
    of_transition = pairs.choose_goal(goal_key, achieved.reshape(achieved.shape[0], -1))
    found = of_transition[jax.random.randint(which_key, (count,), 0, achieved.shape[0])]
    anything = pairs.choose_from_mask(any_key, known, (spec.num_goals,))
    return anything.at[:count].set(jnp.where(found >= 0, found, anything[:count]))


def under_all_goals(
    parts,
    env,
    hyper,
    params,
    target_params,
    batch: Transitions,
    goals: jax.Array | None,
    known: jax.Array,
    view_key: jax.Array,
    key: jax.Array,
) -> AllGoals:
    """The transitions under these goals [G], or under all goals of the task, of which unknown ones have no weight.

    known: bool [N]; view_key: of how goal inputs are varied; key: of the noise of codes.
    """
    goals = jnp.arange(env.goals.num_goals) if goals is None else goals
    records = jax.tree.map(lambda leaf: leaf[:, :, None], batch.records)
    reward, discount = returns_of_all(env.reached(records, goals), batch.mask, hyper.discount)
    view = training_view(parts, env, augmented=True)
    code, target_code = (
        GoalEncoding(parts.learner, given["goal"], env.goals, parts.config.batch_size, view, view_key).of_any()(goals)
        for given in (params, target_params)
    )
    if parts.config.stop_encoder_gradient:
        code = jax.lax.stop_gradient(code)
    keys = jax.random.split(key)
    mean = spec_of(parts).mean_code
    return AllGoals(
        weight=known[goals].astype(jnp.float32),
        code=code.mean if mean else code.sample(keys[0]),
        target_code=target_code.mean if mean else target_code.sample(keys[1]),
        reward=reward,
        discount=discount,
    )
