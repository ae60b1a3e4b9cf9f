"""One gradient update (Algorithm 1, lines 16 to 22): sample, encode, add the losses, step, then beta and the targets."""

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
from infogoal_jax.exploration.explorer import Moves
from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.learners.learner import GoalCode, LearnerBatch, Steps, View, Visited, conditioned, encode_commanded, encode_goals
from infogoal_jax.pairs import GoalPairs
from infogoal_jax.replay import Trajectories, Transitions

CHOICES_AT_ONCE = 10  # A matrix of 512 candidates by 512 for each, 1 MiB.


@flax.struct.dataclass
class Experience:
    """What an epoch's updates sample from; fixed while they run.

    buffer: Trajectories; decision_count, achieved_count: running counts that turn draws into binary searches; achieved: bool [R, T + 1];
    known: bool [N], goals that may be negatives; usable: bool [N], goals that may be anchors and positives; dissimilarity: bool [N, N].
    codes: of all goals by the epoch's first parameters, for the intrinsic reward, where there are too many goals to encode in every update; or None.
    relabelling: the table that a relabelling made for the epoch, learner_relabelling: that of the learner's own; bonus: float32 [K, A] of each
    observation and action; None without such a part.
    """

    buffer: Trajectories
    decision_count: jax.Array
    achieved: jax.Array
    achieved_count: jax.Array
    known: jax.Array
    usable: jax.Array
    dissimilarity: jax.Array
    codes: GoalCode | None
    relabelling: Any = None
    learner_relabelling: Any = None
    bonus: jax.Array | None = None


@flax.struct.dataclass
class RelabelledBatch:
    """Steps of a `Sample` under goals of which some were achieved later: as much of such transitions, and of their rewards, as changes.

    goal, next_observation: [B, ...]; mask, external: float32 [B, n]; terminated: bool [B].
    """

    goal: jax.Array
    next_observation: jax.Array
    mask: jax.Array
    terminated: jax.Array
    external: jax.Array


@flax.struct.dataclass
class Sample:
    """What one update learns from: indices and small vectors, so that those of a whole epoch are drawn at once, outside of the loop over updates.

    transitions: B of them; external: float32 [B, n], the environment's reward for each step; achieved: int32 [B, n, K], the known goals that were
    achieved after each, padded with -1; pairs: of goals, or None; goals: int32 [M], known ones, as many as the learner asks for.
    bonus: float32 [B, n] of each step; move: the first step of each, as (observation, action, next observation) [B]; None without an explorer.
    relabelled: the same steps as the learner's loss sees them, some under goals achieved later; None where it sees what the agent sees.
    """

    transitions: Transitions
    external: jax.Array
    achieved: jax.Array
    pairs: GoalPairs | None
    goals: jax.Array | None = None
    bonus: jax.Array | None = None
    move: tuple | None = None
    relabelled: RelabelledBatch | None = None


def training_view(parts, env, augmented: bool) -> View | None:
    """How the inputs of goals look while training: as they are, or under a background, and in updates as the learner augments them."""
    def view(key, inputs):
        corrupt_key, augment_key = jax.random.split(key)
        if parts.training_corruption:
            backgrounds = draw_backgrounds(corrupt_key, env.train_backgrounds, inputs.shape[:-3])
            inputs = corrupt(inputs, backgrounds, parts.training_corruption)
        return augment(augment_key, inputs) if augment else inputs

    augment = parts.learner.augment if augmented else None
    return view if parts.training_corruption or augment else None


def usable_goals(env, record, usable: jax.Array) -> jax.Array:
    """Goals achieved in these records that may enter representation learning: int32 [..., K], padded with -1."""
    goals = env.goals_of(record)
    return jnp.where((goals >= 0) & usable[goals], goals, -1)


def sample_pairs(spec, env, experience: Experience, key: jax.Array) -> GoalPairs:
    """Goal pairs for the contrastive bound, as the learner's `SampleSpec` asks (Algorithm 1, lines 16 to 20)."""
    keys = jax.random.split(key, 5)
    records = replay.sample_within_window(
        keys[0], experience.buffer, experience.achieved, experience.achieved_count, spec.num_pairs, spec.window
    )
    anchor, positive = (goal_pairs.choose_goal(k, usable_goals(env, record, experience.usable)) for k, record in zip(keys[1:3], records, strict=True))
    any_achieved = experience.achieved_count[-1] > 0  # Else the draw has nothing to choose from, and returned a row not written yet.
    positive_weight = ((anchor >= 0) & (positive >= 0) & any_achieved).astype(jnp.float32)
    anchor, positive = jnp.maximum(anchor, 0), jnp.maximum(positive, 0)
    contrast = jnp.broadcast_to(anchor[:, None], (spec.num_pairs, spec.num_negatives))
    if not spec.anchored:
        contrast = goal_pairs.choose_from_mask(keys[3], experience.known, contrast.shape)
    if spec.dissimilar:
        negative, negative_weight = goal_pairs.sample_negatives(keys[4], experience.dissimilarity, experience.known, contrast)
    else:  # Any known goal, similar ones too; only where it is the very goal that it would be compared with, it is none.
        negative = goal_pairs.choose_from_mask(keys[4], experience.known, contrast.shape)
        negative_weight = (experience.known[negative] & (negative != contrast)).astype(jnp.float32)
    return GoalPairs(anchor, positive, contrast, negative, positive_weight, negative_weight)


def sample(parts, env, experience: Experience, key: jax.Array) -> Sample:
    """Draw what one update learns from: transitions, some of them under other goals, and goal pairs."""
    transition_key, relabel_key, pair_key = jax.random.split(key, 3)
    buffer, num_steps, goal = experience.buffer, parts.agent.num_steps, None
    candidates = parts.batch_size * (1 if parts.relabelling is None else parts.relabelling.candidates)
    row, step = replay.draw(transition_key, experience.decision_count, candidates, buffer.valid.shape[1])
    if env.recorded is not None:
        goal = buffer.goal[row, step]  # Recorded episodes did not end where their goal was reached; what is drawn from them does.
    if parts.relabelling is not None:
        row, step, goal = with_relabelled_goals(parts.relabelling, experience, relabel_key, row, step)
    drawn = with_rewards(env, experience, replay.transitions_at(buffer, row, step, num_steps, goal, env.reached))
    spec, goals_key = parts.learner.sample_spec, jax.random.fold_in(key, 3)
    if spec.num_pairs:
        drawn = drawn.replace(pairs=sample_pairs(spec, env, experience, pair_key))
    if spec.num_goals:
        drawn = drawn.replace(goals=goal_pairs.choose_from_mask(goals_key, experience.known | env.goals.train_mask, (spec.num_goals,)))
    if parts.learner_relabelling is not None:
        other = parts.learner_relabelling.relabel(jax.random.fold_in(key, 4), experience.learner_relabelling, row, step, drawn.transitions.goal)
        relabelled = with_rewards(env, experience, replay.transitions_at(buffer, row, step, num_steps, other, env.reached))
        kept = {name: getattr(relabelled.transitions, name) for name in ("goal", "next_observation", "mask", "terminated")}
        drawn = drawn.replace(relabelled=RelabelledBatch(**kept, external=relabelled.external))
    if parts.explorer is not None:
        taken = jnp.minimum(step[:, None] + jnp.arange(num_steps), buffer.valid.shape[1] - 1)
        place = row[:, None], taken
        bonus = experience.bonus[buffer.observation[place], buffer.action[place]]
        drawn = drawn.replace(bonus=bonus, move=(buffer.observation[row, step], buffer.action[row, step], buffer.observation[row, step + 1]))
    return drawn


def with_relabelled_goals(relabelling, experience: Experience, key: jax.Array, row: jax.Array,
                          step: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The transitions that are learned from, among those that start at these rows and steps [B], and the goals that they are given."""
    relabel_key, choose_key = jax.random.split(key)
    goal = relabelling.relabel(relabel_key, experience.relabelling, row, step, experience.buffer.goal[row, step])
    if relabelling.choose is None:
        return row, step, goal
    kept = relabelling.choose(choose_key, experience.relabelling, row, step, goal)
    return row[kept], step[kept], goal[kept]


def with_rewards(env, experience: Experience, transitions: Transitions) -> Sample:
    """The transitions with their rewards (Eq. 5: 1 for reaching the goal) and with what was achieved."""
    external = env.reached(transitions.records, transitions.goal[:, None]).astype(jnp.float32)
    return Sample(transitions, external, usable_goals(env, transitions.records, experience.usable), pairs=None)


def returns(parts, params, learner_state, env, hyper, experience: Experience, drawn: Sample) -> tuple[jax.Array, Any, dict]:
    """Discounted reward of each transition's steps, float32 [B]: the environment's, plus the intrinsic reward (Eq. 16). Then the learner's state, and
    metrics."""
    batch, external = drawn.transitions, drawn.external
    if experience.codes is None:
        encode = encode_goals(parts.learner, jax.lax.stop_gradient(params["goal"]), env.goals, parts.table_limit)
    else:
        encode = experience.codes.__getitem__
    visited = Visited(batch.goal, drawn.achieved, env.cell_of(batch.records), batch.mask)
    intrinsic, learner_state = parts.learner.intrinsic_reward(learner_state, encode, visited)
    step_reward = external + hyper.intrinsic_weight / env.episode_length * intrinsic
    if drawn.bonus is not None:
        step_reward += hyper.bonus_weight * drawn.bonus
    taken = batch.mask.sum()
    metrics = {"external_reward": (external * batch.mask).sum() / taken, "intrinsic_reward": (intrinsic * batch.mask).sum() / taken}
    return discounted(step_reward, batch, hyper), learner_state, metrics


def discounted(step_reward: jax.Array, batch: Transitions | RelabelledBatch, hyper) -> jax.Array:
    """Discounted sum of the rewards [B, n] of each transition's steps, float32 [B]."""
    return (step_reward * batch.mask * hyper.discount ** jnp.arange(batch.mask.shape[1])).sum(1)


def discount_after(batch: Transitions | RelabelledBatch, hyper) -> jax.Array:
    """Discount of what follows each transition, float32 [B]: 0 after termination."""
    return hyper.discount ** batch.mask.sum(1) * ~batch.terminated


def encode_states(parts, params, env, asked: int) -> Callable[[Any], jax.Array]:
    """psi(s): stored observations [...] to features [..., F], by the encoder of these parameters.

    Every image once if there are fewer than will be asked for, else only those asked for.
    """
    if env.num_observations is not None and env.num_observations <= asked:
        return parts.state_encoder.apply(params["state"], env.render(jnp.arange(env.num_observations))).__getitem__
    return lambda observation: parts.state_encoder.apply(params["state"], env.render(observation))


def agent_batch(parts, env, hyper, params, target_params, batch: Transitions, reward, view_key, key) -> AgentBatch:
    """The transitions as codes, each occurrence of a goal with noise of its own, its input varied in the same way before and after the step."""
    keys = jax.random.split(key, 3)
    see, see_by_target = (encode_states(parts, given, env, 2 * parts.batch_size) for given in (params, target_params))
    encoded = encode_commanded if parts.relabelling is None else encode_goals  # Relabelled goals are any, and not among those commanded.
    view = training_view(parts, env, augmented=True)
    code, target_code = (
        encoded(parts.learner, given["goal"], env.goals, parts.table_limit, view, view_key)(batch.goal) for given in (params, target_params)
    )
    features, next_features, target_features = see(batch.observation), see(batch.next_observation), see_by_target(batch.next_observation)
    next_code = conditioned(parts.learner, params["goal"], code, next_features)
    target_code = conditioned(parts.learner, target_params["goal"], target_code, target_features)
    code = conditioned(parts.learner, params["goal"], code, features)
    code = jax.lax.stop_gradient(code) if parts.stop_encoder_gradient else code
    return AgentBatch(
        observation=batch.observation,
        next_observation=batch.next_observation,
        features=features,
        code=code.sample(keys[0]),
        action=batch.action,
        next_features=jax.lax.stop_gradient(next_features),
        next_code=jax.lax.stop_gradient(next_code).sample(keys[1]),
        target_features=target_features,
        target_code=target_code.sample(keys[2]),
        reward=reward,
        discount=discount_after(batch, hyper),
        action_mask=env.action_mask(batch.observation),
        next_action_mask=env.action_mask(batch.next_observation),
    )


def steps_to_learn_from(parts, params, env, hyper, drawn: Sample, codes: AgentBatch) -> tuple[jax.Array, Steps]:
    """The goals [B] and transitions that the learner's loss sees: the agent's, or the same steps relabelled; with the environment's reward alone."""
    if drawn.relabelled is None:
        reward = discounted(drawn.external, drawn.transitions, hyper)
        return drawn.transitions.goal, Steps(codes.features, codes.next_features, reward, codes.discount)
    relabelled = drawn.relabelled
    following = jax.lax.stop_gradient(encode_states(parts, params, env, 2 * parts.batch_size)(relabelled.next_observation))
    reward = discounted(relabelled.external, relabelled, hyper)
    return relabelled.goal, Steps(codes.features, following, reward, discount_after(relabelled, hyper))


def positive_regions(pairs: GoalPairs, regions: jax.Array) -> dict[str, jax.Array]:
    """Shares of the positive pairs whose two goals lie in one region (two different goals), and in different regions."""
    total = jnp.maximum(pairs.positive_weight.sum(), 1.0)
    same = regions[pairs.anchor] == regions[pairs.positive]
    within = ((same & (pairs.anchor != pairs.positive)) * pairs.positive_weight).sum() / total
    return {"positives_within": within, "positives_between": (~same * pairs.positive_weight).sum() / total}


def update(parts, env, hyper, experience: Experience, restore: Callable, state, drawn: Sample, key: jax.Array):
    """One update of every network and of the learner's state. Returns the state and this update's metrics, named by part.

    Parameters and targets of the state are vectors, `restore` makes trees of them.
    """
    learner, agent = parts.learner, parts.agent
    loss_key, code_key, agent_key, view_key = jax.random.split(key, 4)
    batch, pairs = drawn.transitions, drawn.pairs
    targets = restore(state.target_params)
    reward, learner_state, reward_metrics = returns(parts, restore(state.params), state.learner, env, hyper, experience, drawn)

    def total_loss(vector):
        params = restore(vector)
        encode = encode_goals(learner, params["goal"], env.goals, parts.table_limit, training_view(parts, env, augmented=True), view_key)
        codes = agent_batch(parts, env, hyper, params, targets, batch, reward, view_key, code_key)
        seen = LearnerBatch(encode, env.goals.inputs_of, pairs, drawn.goals, *steps_to_learn_from(parts, params, env, hyper, drawn, codes))
        learner_loss, learner_metrics, after = learner.loss(params["goal"], learner_state, seen, hyper.learner, loss_key)
        agent_loss, agent_metrics = agent.loss(params["agent"], targets["agent"], codes, state.agent, hyper.agent, agent_key)
        total, states = agent_loss + hyper.learner_weight * learner_loss, {"learner": after}
        metrics = named("agent", agent_metrics | reward_metrics | {"loss": agent_loss}) | named(parts.name, learner_metrics)
        if parts.explorer is not None:
            moves = moves_of(parts, env, params, targets, drawn.move)
            explorer_loss, explorer_metrics, after = parts.explorer.loss(params["explorer"], state.explorer, moves, jax.random.fold_in(key, 4))
            total, states = total + hyper.explorer_weight * explorer_loss, states | {"explorer": after}
            metrics |= named("explorer", explorer_metrics)
        return total, (metrics, states)

    gradient, (metrics, states) = jax.grad(total_loss, has_aux=True)(state.params)
    norm = jnp.linalg.norm(gradient)
    scale = jnp.minimum(1.0, hyper.max_gradient_norm / (norm + 1e-6))
    direction, optimizer_state = parts.optimizer.update(gradient * scale, state.optimizer_state)
    params = state.params - hyper.learning_rate * direction
    target_params = optax.incremental_update(params, state.target_params, hyper.target_rate)
    state = state.replace(params=params, target_params=target_params, optimizer_state=optimizer_state, **states)
    metrics |= {"agent/gradient_norm": norm}
    return state, metrics if pairs is None else metrics | named(parts.name, positive_regions(pairs, env.goals.regions))


def named(part: str, metrics: dict) -> dict:
    """The metrics under the name of the part that they are about."""
    return {f"{part}/{name}": value for name, value in metrics.items()}


def moves_of(parts, env, params, target_params, move: tuple) -> Moves:
    """Single steps (observation, action, next observation) [B] as an explorer sees them."""
    observation, action, following = move
    see, see_by_target = (encode_states(parts, given, env, 2 * parts.batch_size) for given in (params, target_params))
    return Moves(see(observation), action, jax.lax.stop_gradient(see_by_target(following)))


def draws_at_once(parts, count: int) -> int:
    """How many updates' samples are drawn side by side: all of them, but for a relabelling that compares candidates, whose tables take memory."""
    return count if parts.relabelling is None or parts.relabelling.choose is None else min(count, CHOICES_AT_ONCE)


def updates(parts, env, hyper, experience: Experience, state, key: jax.Array, count: int):
    """`count` updates.

    What they learn from is drawn at once, and parameters go through the loop as one vector: draws, and an optimizer that goes from layer to layer,
    would be most of the kernels that a GPU has to start.
    """
    sample_key, update_key = jax.random.split(key)
    params, restore = ravel_pytree(state.params)
    state = state.replace(params=params, target_params=ravel_pytree(state.target_params)[0])
    drawn = jax.lax.map(lambda key: sample(parts, env, experience, key), jax.random.split(sample_key, count), batch_size=draws_at_once(parts, count))
    keys = jax.random.split(update_key, count)
    state, metrics = jax.lax.scan(lambda carry, step: update(parts, env, hyper, experience, restore, carry, *step), state, (drawn, keys))
    return state.replace(params=restore(state.params), target_params=restore(state.target_params)), metrics
