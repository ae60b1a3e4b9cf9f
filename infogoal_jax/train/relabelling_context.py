"""What a relabelling may look at before the updates of an epoch."""

import jax

from infogoal_jax.learners.encoding import encode_all
from infogoal_jax.learners.learner import GoalCode, conditioned
from infogoal_jax.relabelling.relabelling import Achievements, Context
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.parts import Setup, TrainState, encode_states


def relabelling_context(
    setup: Setup,
    state: TrainState,
    number: jax.Array,
    rows: Trajectories,
    written: jax.Array,
    achievements: Achievements,
    codes: GoalCode | None,
) -> Context:
    """What a relabelling may look at before the updates of this epoch. codes: of all goals, or None where they are
    few."""
    parts, hyper, env = setup
    learner, agent = parts.learner, parts.agent

    def goal_codes():
        return (encode_all(learner, state.params["goal"], env.goals) if codes is None else codes).mean

    def value(observation, desired_goal):
        features = encode_states(setup, state.params, desired_goal.shape[0])(observation)
        code = learner.encode(state.params["goal"], env.goals.inputs_of(desired_goal))
        code = conditioned(learner, state.params["goal"], code, features)
        return agent.value(state.params["agent"], features, code.mean, env.action_mask(observation))

    return Context(
        rows=rows,
        written=written,
        achievements=achievements,
        goal_positions=env.goal_positions,
        goal_codes=goal_codes,
        value=value,
        reached=env.reached,
        discount=hyper.discount,
        updates=number * parts.config.updates_per_epoch,
    )
