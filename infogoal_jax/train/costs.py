"""Learning from costs, with goals of the actor's own, where a relabelling draws these (`relabelling/mixed.py`)."""

from typing import Any

import jax
import jax.numpy as jnp

from infogoal_jax.agents.agent import ActorGoals, AgentBatch, Waypoints
from infogoal_jax.goals import is_goal, with_placeholders
from infogoal_jax.learners.learner import conditioned
from infogoal_jax.relabelling.relabelling import Relabelling
from infogoal_jax.replay import Transitions
from infogoal_jax.train.experience import Experience
from infogoal_jax.train.parts import Networks, Setup, code_seen, encode_states, goal_encoding


def learns_from_costs(relabelling: Relabelling | None) -> bool:
    """Whether rewards are costs, and the actor has goals of its own."""
    return relabelling is not None and relabelling.costs is not None


def sample_costs(
    setup: Setup, experience: Experience, key: jax.Array, batch: Transitions, row: jax.Array, step: jax.Array
) -> dict[str, Any]:
    """The fields of `Sample` for transitions of one step with costs: -1, and nothing once the goal is achieved before
    the step. An episode that fails costs for ever. And with the actor's goals."""
    buffer = experience.buffer
    before = jax.tree.map(lambda leaf: leaf[row, step], buffer.record)
    at_goal = setup.env.reached(before, batch.desired_goal)
    failed = jnp.zeros_like(at_goal) if batch.failed is None else batch.failed
    cost = jnp.where(failed, 1.0 / (1.0 - setup.hyper.discount), 1.0)
    goal, way = setup.parts.relabelling.costs(key, experience.relabelling, row, step, buffer.desired_goal[row, step])
    waypoints = None
    if way is not None:
        waypoints = way.low_goal, way.goal, jax.tree.map(lambda leaf: leaf[row, way.step], buffer.observation)
    return {
        "transitions": batch.replace(terminated=at_goal | failed),
        "external": jnp.where(at_goal, 0.0, -cost)[:, None],
        "actor_goal": goal,
        "waypoints": waypoints,
    }


def with_actor_goals(
    setup: Setup, networks: Networks, batch: AgentBatch, goal: jax.Array, waypoints: tuple | None, key: jax.Array
) -> AgentBatch:
    """The transitions with the actor's goals as codes, and with what lies on the way to them, without gradient."""
    parts, params = setup.parts, jax.lax.stop_gradient(networks.params)
    encode = goal_encoding(setup, params, networks.view_key).of_any()
    here, last = jax.lax.stop_gradient((batch.features, batch.next_features))

    def code_in(number, features, code):
        code = conditioned(parts.learner, params["goal"], code, features)
        return code_seen(parts, code, jax.random.fold_in(key, number))

    of_goal = encode(goal)
    batch = batch.replace(actor=ActorGoals(code_in(0, here, of_goal), code_in(1, last, of_goal)))
    if waypoints is None:
        return batch
    low_goal, on_the_way, observation = waypoints
    there = encode_states(setup, params, setup.config.batch_size)(observation)
    of_low_goal = encode(with_placeholders(low_goal))
    return batch.replace(
        waypoints=Waypoints(
            low_weight=is_goal(low_goal).astype(jnp.float32),
            weight=is_goal(on_the_way).astype(jnp.float32),
            low_code=code_in(2, here, of_low_goal),
            next_low_code=code_in(3, last, of_low_goal),
            code=code_in(4, here, encode(with_placeholders(on_the_way))),
            features=there,
            code_there=code_in(5, there, of_goal),
        )
    )
