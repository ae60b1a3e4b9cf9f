"""One gradient update (Algorithm 1, lines 21 and 22): encode a sample, add the losses, step, then the targets."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from infogoal_jax.agents.agent import AgentBatch
from infogoal_jax.learners.encoding import GoalEncoding
from infogoal_jax.learners.learner import Encode, LearnerBatch, Steps, Visited, conditioned
from infogoal_jax.replay import Transitions
from infogoal_jax.train.costs import learns_from_costs, with_actor_goals
from infogoal_jax.train.experience import Experience
from infogoal_jax.train.exploring import loss_of_explorer
from infogoal_jax.train.many_goals import under_all_goals
from infogoal_jax.train.metrics import Scalars, named, positive_regions
from infogoal_jax.train.parts import Networks, Setup, TrainState, code_seen, encode_states, goal_encoding
from infogoal_jax.train.relabelled import RelabelledBatch, draws_at_once
from infogoal_jax.train.sampling import Sample, sample


def returns(
    setup: Setup, params: dict, learner_state: Any, experience: Experience, drawn: Sample
) -> tuple[jax.Array, Any, dict]:
    """Discounted reward of each transition's steps, float32 [B]: the environment's, plus the intrinsic reward (Eq. 16).
    Then the learner's state, and metrics."""
    parts, hyper, env = setup
    batch, external = drawn.transitions, drawn.external
    if experience.codes is None:
        frozen = jax.lax.stop_gradient(params["goal"])
        encode = GoalEncoding(parts.learner, frozen, env.goals, parts.config.batch_size).of_any()
    else:
        encode = experience.codes.__getitem__
    visited = Visited(batch.desired_goal, drawn.achieved, env.cell_of(batch.records), batch.mask, drawn.first_seen)
    intrinsic, learner_state = parts.learner.intrinsic_reward(learner_state, encode, visited)
    step_reward = external + hyper.intrinsic_weight / env.episode_length * intrinsic
    if drawn.bonus is not None:
        step_reward += hyper.bonus_weight * drawn.bonus
    taken = batch.mask.sum()
    metrics = {
        "external_reward": (external * batch.mask).sum() / taken,
        "intrinsic_reward": (intrinsic * batch.mask).sum() / taken,
    }
    return discounted(step_reward, batch, hyper), learner_state, metrics


def discounted(step_reward: jax.Array, batch: Transitions | RelabelledBatch, hyper) -> jax.Array:
    """Discounted sum of the rewards [B, n] of each transition's steps, float32 [B]."""
    steps = jnp.arange(batch.mask.shape[1], dtype=jnp.int32).astype(jnp.float32)
    return (step_reward * batch.mask * (hyper.discount**steps)[None]).sum(1)


def discount_after(batch: Transitions | RelabelledBatch, hyper) -> jax.Array:
    """Discount of what follows each transition, float32 [B]: 0 after termination."""
    return hyper.discount ** batch.mask.sum(1) * (~batch.terminated).astype(jnp.float32)


def agent_batch(
    setup: Setup, networks: Networks, batch: Transitions, reward: jax.Array, key: jax.Array, table: Encode | None = None
) -> AgentBatch:
    """The transitions as codes, each occurrence of a goal with noise of its own, its input varied in the same way
    before and after the step. table: the codes of all goals by the trained parameters, where they are encoded."""
    parts, hyper, env = setup
    params, target_params, view_key = networks
    keys = jax.random.split(key, 3)
    see, see_by_target = (encode_states(setup, given, 2 * setup.config.batch_size) for given in (params, target_params))

    def encode(given):  # A relabelled goal may be any, not a training goal alone.
        encoding = goal_encoding(setup, given, view_key)
        return encoding.of_desired_goals() if parts.relabelling is None else encoding.of_any()

    code, target_code = (table or encode(params))(batch.desired_goal), encode(target_params)(batch.desired_goal)
    features, next_features, target_features = (
        see(batch.observation),
        see(batch.next_observation),
        see_by_target(batch.next_observation),
    )
    next_code = conditioned(parts.learner, params["goal"], code, next_features)
    first = {}
    if learns_from_costs(parts.relabelling):
        seen, noise_key = see_by_target(batch.observation), jax.random.fold_in(key, 3)
        first_code = conditioned(parts.learner, target_params["goal"], target_code, seen)
        first = {"first_target_features": seen, "first_target_code": code_seen(parts, first_code, noise_key)}
    target_code = conditioned(parts.learner, target_params["goal"], target_code, target_features)
    code = conditioned(parts.learner, params["goal"], code, features)
    code = jax.lax.stop_gradient(code) if parts.config.stop_encoder_gradient else code
    return AgentBatch(
        observation=batch.observation,
        next_observation=batch.next_observation,
        features=features,
        code=code_seen(parts, code, keys[0]),
        action=batch.action,
        next_features=jax.lax.stop_gradient(next_features),
        next_code=code_seen(parts, jax.lax.stop_gradient(next_code), keys[1]),
        target_features=target_features,
        target_code=code_seen(parts, target_code, keys[2]),
        reward=reward,
        discount=discount_after(batch, hyper),
        action_mask=env.action_mask(batch.observation),
        next_action_mask=env.action_mask(batch.next_observation),
        largest_value=None if env.ends_at_goal else 1.0 / (1.0 - hyper.discount),
        **first,
    )


def steps_to_learn_from(setup: Setup, params: dict, drawn: Sample, codes: AgentBatch) -> tuple[jax.Array, Steps]:
    """The goals [B] and transitions that the learner's loss sees: the agent's, or the same steps relabelled; with the
    environment's reward alone."""
    hyper = setup.hyper
    if drawn.relabelled is None:
        reward = discounted(drawn.external, drawn.transitions, hyper)
        return drawn.transitions.desired_goal, Steps(codes.features, codes.next_features, reward, codes.discount)
    relabelled = drawn.relabelled
    following = jax.lax.stop_gradient(
        encode_states(setup, params, 2 * setup.config.batch_size)(relabelled.next_observation)
    )
    reward = discounted(relabelled.external, relabelled, hyper)
    return relabelled.desired_goal, Steps(codes.features, following, reward, discount_after(relabelled, hyper))


def features_of_goals(setup: Setup, params: dict) -> Callable[[jax.Array], jax.Array]:
    """Goals int32 [...] to the features [..., F] of the observations that they are, without gradient."""
    parts, _, env = setup
    return lambda goals: jax.lax.stop_gradient(parts.state_encoder.apply(params["state"], env.goals.inputs_of(goals)))


def update(
    setup: Setup, experience: Experience, state: TrainState, drawn: Sample, key: jax.Array
) -> tuple[TrainState, dict]:
    """One update of every network and of the learner's state. Returns the state and this update's metrics, named by
    part.

    The optimizer sees all parameters as one vector, networks see trees: on a GPU a step for each layer would be as many
    kernels, and a bias that is a slice of a vector is not added in the kernel of the product that it belongs to.
    """
    parts, hyper, env = setup
    learner, agent = parts.learner, parts.agent
    loss_key, code_key, agent_key, view_key = jax.random.split(key, 4)
    batch, pairs, targets = drawn.transitions, drawn.pairs, state.target_params
    reward, learner_state, reward_metrics = returns(setup, state.params, state.learner, experience, drawn)

    def total_loss(params):
        networks = Networks(params, targets, view_key)
        encoding = goal_encoding(setup, params, view_key)
        encode = encoding.of_any()
        # Goals of a table are encoded once for agent and learner, so that their gradients go back as one.
        table = encode if encoding.has_table and encoding.view is None else None
        codes = agent_batch(setup, networks, batch, reward, code_key, table)
        if agent.all_goals is not None:
            codes = codes.replace(
                all_goals=under_all_goals(
                    setup, networks, batch, drawn.all_goals, drawn.goal_weight, jax.random.fold_in(key, 5)
                )
            )
        if drawn.actor_goal is not None:
            codes = with_actor_goals(
                setup, networks, codes, drawn.actor_goal, drawn.waypoints, jax.random.fold_in(key, 6)
            )
        seen = LearnerBatch(
            encode,
            env.goals.inputs_of,
            pairs,
            drawn.goals,
            *steps_to_learn_from(setup, params, drawn, codes),
            features_of_goals(setup, params) if learner.needs_features_of_goals else None,
        )
        learner_loss, learner_metrics, after = learner.loss(
            params["goal"], learner_state, seen, hyper.learner, loss_key
        )
        agent_loss, agent_metrics = agent.loss(
            params["agent"], targets["agent"], codes, state.agent, hyper.agent, agent_key
        )
        total, states = agent_loss + hyper.learner_weight * learner_loss, {"learner": after}
        metrics = named("agent", agent_metrics | reward_metrics | {"loss": agent_loss}) | named(
            parts.name, learner_metrics
        )
        if parts.explorer is not None:
            explorer_loss, explorer_metrics, after = loss_of_explorer(setup, networks, state.explorer, drawn.move, key)
            total, states = total + hyper.explorer_weight * explorer_loss, states | {"explorer": after}
            metrics |= named("explorer", explorer_metrics)
        return total, (metrics, states)

    gradient, (metrics, states) = jax.grad(total_loss, has_aux=True)(state.params)
    gradient, restore = ravel_pytree(gradient)
    norm = jnp.linalg.norm(gradient)
    scale = jnp.minimum(1.0, hyper.max_gradient_norm / (norm + 1e-6))
    # optax mixes counts with floats, which a user may have forbidden to the code of his own.
    with jax.numpy_dtype_promotion("standard"):
        direction, optimizer_state = parts.optimizer.update(gradient * scale, state.optimizer_state)
    params = jax.tree.map(jnp.subtract, state.params, restore(hyper.learning_rate * direction))
    target_params = optax.incremental_update(params, state.target_params, hyper.target_rate)
    state = state.replace(params=params, target_params=target_params, optimizer_state=optimizer_state, **states)
    metrics |= {"agent/gradient_norm": norm}
    if pairs is not None and env.goals.finite:
        metrics |= named(parts.name, positive_regions(pairs, env.goals.regions))
    return state, metrics


def updates(
    setup: Setup, experience: Experience, state: TrainState, key: jax.Array, count: int
) -> tuple[TrainState, dict]:
    """`count` updates. Returns the state and the means of their metrics.

    What they learn from is drawn at once: draws would be many of the kernels that a GPU has to start.
    """
    sample_key, update_key = jax.random.split(key)
    drawn = jax.lax.map(
        lambda key: sample(setup, experience, key),
        jax.random.split(sample_key, count),
        batch_size=draws_at_once(setup.parts.relabelling, count),
    )
    keys = jax.random.split(update_key, count)

    def step(state, drawn_and_key):
        state, metrics = update(setup, experience, state, *drawn_and_key)
        return state, Scalars.of(metrics)

    state, metrics = jax.lax.scan(step, state, (drawn, keys))
    return state, metrics.means()
