"""One gradient update (Algorithm 1, lines 16 to 22): draw what it learns from, encode it, add the losses, step, then
move the targets."""

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from infogoal_jax import pairs as goal_pairs
from infogoal_jax import replay
from infogoal_jax.agents.agent import AgentBatch
from infogoal_jax.goals import is_goal, same, with_placeholders
from infogoal_jax.learners.encoding import GoalEncoding
from infogoal_jax.learners.learner import Encode, LearnerBatch, Steps, Visited, conditioned
from infogoal_jax.networks import activations
from infogoal_jax.pairs import GoalPairs
from infogoal_jax.replay import Transitions
from infogoal_jax.train.costs import learns_from_costs, sample_costs, with_actor_goals
from infogoal_jax.train.dissimilar import sample_apart, sample_pairs_by_distance
from infogoal_jax.train.experience import Experience, external_reward, usable_goals
from infogoal_jax.train.exploring import loss_of_explorer, steps_explored
from infogoal_jax.train.many_goals import draw_goals, draw_goals_to_learn, goals_to_learn, under_all_goals
from infogoal_jax.train.metrics import Scalars, named, positive_regions
from infogoal_jax.train.parts import Networks, Setup, TrainState, code_seen, encode_states, goal_encoding
from infogoal_jax.train.relabelled import RelabelledBatch, draws_at_once, relabel_for_learner, with_relabelled_goals


@flax.struct.dataclass
class Sample:
    """What one update learns from: indices and small vectors, so that those of a whole epoch are drawn at once, outside
    of the loop over updates."""

    transitions: Transitions
    """B of them."""
    external: jax.Array
    """float32 [B, n], the environment's reward for each step."""
    achieved: jax.Array
    """[B, n, K, *shape], the known goals that were achieved after each step, padded with "no goal"."""
    pairs: GoalPairs | None
    """Pairs of goals, as the learner asks for them; None without."""
    goals: jax.Array | None = None
    """[M, *shape], known goals, as many as the learner asks for."""
    first_seen: jax.Array | None = None
    """float32 [B, n], as in `Visited`; None unless the learner asks for it."""
    bonus: jax.Array | None = None
    """float32 [B, n], of each step; None without an explorer."""
    move: tuple | None = None
    """The first step of each, as (observation, action, next observation) [B]; None without an explorer."""
    relabelled: RelabelledBatch | None = None
    """The same steps as the learner's loss sees them, some under goals achieved later; None where it sees what the
    agent sees."""
    all_goals: jax.Array | None = None
    """int32 [G], the goals that the agent learns every transition from; None without, or for all of the task."""
    goal_weight: jax.Array | None = None
    """float32 [G], of each of these goals in the agent's loss, as in `AllGoals`; None without."""
    actor_goal: jax.Array | None = None
    """[B, *shape], the goals that the actor learns for; None: those of the transitions."""
    waypoints: tuple | None = None
    """(goal, goal on the way to the actor's, observation there) [B], as in `relabelling.Waypoints`; None without."""


def sample(setup: Setup, experience: Experience, key: jax.Array) -> Sample:
    """Draw what one update learns from: transitions, some of them under other goals, and goal pairs."""
    parts, _, env = setup
    relabelling = parts.relabelling
    transition_key, relabel_key, pair_key = jax.random.split(key, 3)
    buffer, num_steps, desired_goal = experience.buffer, parts.agent.num_steps, None
    candidates = parts.config.batch_size * (1 if relabelling is None else relabelling.candidates)
    row, step = replay.draw(transition_key, experience.decision_count, candidates, buffer.valid.shape[1])
    if env.recorded is not None:
        # Recorded episodes did not end where their goal was reached; what is drawn from them does.
        desired_goal = buffer.desired_goal[row, step]
    if relabelling is not None:
        row, step, desired_goal = with_relabelled_goals(setup, experience, relabel_key, row, step)
    ends = env.reached if env.ends_at_goal else None
    transitions = replay.transitions_at(buffer, row, step, num_steps, desired_goal, ends)
    external = external_reward(env, transitions)
    drawn = Sample(transitions, external, usable_goals(setup, env.goals_of(transitions.records)), pairs=None)
    if learns_from_costs(relabelling):
        costs_key = jax.random.fold_in(key, 6)
        drawn = drawn.replace(**sample_costs(setup, experience, costs_key, drawn.transitions, row, step))
    spec, goals_key = parts.learner.sample_spec, jax.random.fold_in(key, 3)
    if spec.num_pairs:
        drawn = drawn.replace(pairs=sample_pairs(setup, experience, pair_key))
    if spec.num_goals:
        drawn = drawn.replace(goals=draw_goals_to_learn(setup, experience, goals_key, spec.num_goals))
    if parts.agent.all_goals is not None:
        known, many_key = goals_to_learn(setup, experience), jax.random.fold_in(key, 5)
        collected = buffer.desired_goal[row, step]
        goals, weight = draw_goals(parts.agent.all_goals, known, drawn.achieved, collected, many_key)
        drawn = drawn.replace(all_goals=goals, goal_weight=weight)
    if spec.first_seen:
        ahead = jnp.arange(num_steps, dtype=jnp.int32)[None]
        led_to = jnp.minimum(step[:, None] + 1 + ahead, buffer.valid.shape[1])
        drawn = drawn.replace(first_seen=experience.first_seen[row[:, None], led_to])
    if spec.relabelling is not None:
        key_of_goals, given = jax.random.fold_in(key, 4), drawn.transitions.desired_goal
        relabelled = relabel_for_learner(setup, experience, key_of_goals, row, step, given, ends)
        drawn = drawn.replace(relabelled=relabelled)
    if parts.explorer is not None:
        drawn = drawn.replace(**steps_explored(experience.bonus, buffer, row, step, num_steps))
    return drawn


def sample_pairs(setup: Setup, experience: Experience, key: jax.Array) -> GoalPairs:
    """Goal pairs for the contrastive bound, as the learner's `SampleSpec` asks (Algorithm 1, lines 16 to 20)."""
    env, spec = setup.env, setup.parts.learner.sample_spec
    if spec.radius is not None:
        return sample_pairs_by_distance(setup, experience, key)
    buffer, count = experience.buffer, experience.achieved_count
    keys, shape = jax.random.split(key, 5), (spec.num_pairs, spec.num_negatives)
    row, first, second = replay.sample_within_window(
        keys[0], buffer, experience.achieved, count, spec.num_pairs, spec.window
    )
    records = jax.tree.map(lambda leaf: jnp.stack([leaf[row, first], leaf[row, second]]), buffer.record)
    anchor, positive = jax.vmap(goal_pairs.choose_goal)(keys[1:3], usable_goals(setup, env.goals_of(records)))
    # Else the draw has nothing to choose from, and returned a row not written yet.
    any_achieved = count[-1] > 0
    positive_weight = (is_goal(anchor) & is_goal(positive) & any_achieved).astype(jnp.float32)
    anchor, positive = with_placeholders(anchor), with_placeholders(positive)
    place = row[:, None], first[:, None]
    contrast = jnp.broadcast_to(anchor[:, None], (*shape, *anchor.shape[1:]))
    if not spec.anchored and env.goals.finite:
        contrast = experience.known.draw(keys[3], shape)
    elif not spec.anchored:
        place_key, goal_key = jax.random.split(keys[3])
        place = replay.draw(place_key, count, shape, buffer.valid.shape[1] + 1)
        contrast = with_placeholders(goal_pairs.choose_goal(goal_key, experience.known.goals[place]))
    if not spec.dissimilar:
        # Any known goal, similar ones too; only where it is the very goal that it would be compared with, it is none.
        negative = experience.known.draw(keys[4], shape)
        known = experience.known.mask[negative] if env.goals.finite else any_achieved & is_goal(negative)
        negative_weight = (known & ~same(negative, contrast)).astype(jnp.float32)
    elif env.goals.finite:
        negative, negative_weight = goal_pairs.sample_negatives(
            keys[4], experience.dissimilarity, experience.known.mask, contrast
        )
    else:
        negative, negative_weight = sample_apart(setup, experience, keys[4], place, contrast)
    other = None
    if spec.dissimilar_by == "classifier":
        other = with_placeholders(experience.known.draw(jax.random.fold_in(key, 5), (spec.num_pairs,)))
    return GoalPairs(anchor, positive, contrast, with_placeholders(negative), positive_weight, negative_weight, other)


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
    taken = jnp.maximum(batch.mask.sum(), 1.0)  # None where every step diverged.
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
            # By the cost alone: the agent's reward may have an intrinsic part.
            codes = codes.replace(at_goal=drawn.external[:, 0] == 0)
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

    with activations("bfloat16" if setup.config.bfloat16 else None):
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
