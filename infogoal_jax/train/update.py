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
from infogoal_jax.hindsight.relabelling import Achievements
from infogoal_jax.learners.learner import Corruption, GoalCode, encode_commanded, encode_goals
from infogoal_jax.pairs import GoalPairs
from infogoal_jax.replay import Rows, Transitions


@flax.struct.dataclass
class Experience:
    """What an epoch's updates sample from; fixed while they run.

    buffer: Rows; decision_count, achieved_count: running counts that turn draws into binary searches; achieved: bool [R, T + 1];
    known: bool [N], goals that may be negatives; usable: bool [N], goals that may be anchors and positives; dissimilarity: bool [N, N].
    codes: of all goals by the epoch's first parameters, for the intrinsic reward, where there are too many goals to encode in every update; or None.
    achievements: what a relabelling chooses from; None without one.
    """

    buffer: Rows
    decision_count: jax.Array
    achieved: jax.Array
    achieved_count: jax.Array
    known: jax.Array
    usable: jax.Array
    dissimilarity: jax.Array
    codes: GoalCode | None
    achievements: Achievements | None = None


@flax.struct.dataclass
class Sample:
    """What one update learns from: indices and small vectors, so that those of a whole epoch are drawn at once, outside of the loop over updates.

    transitions: B of them; external: float32 [B, n], the environment's reward for each step; achieved: int32 [B, n, K], the known goals that were
    achieved after each, padded with -1; pairs: of goals, or None.
    """

    transitions: Transitions
    external: jax.Array
    achieved: jax.Array
    pairs: GoalPairs | None


def training_corruption(parts, env, key: jax.Array) -> Corruption | None:
    """How images of goals are corrupted while training: not at all by default."""
    return Corruption(key, env.train_backgrounds, parts.training_corruption) if parts.training_corruption else None


def usable_goals(env, record, usable: jax.Array) -> jax.Array:
    """Goals achieved in these records that may enter representation learning: int32 [..., K], padded with -1."""
    goals = env.goals_of(record)
    return jnp.where((goals >= 0) & usable[goals], goals, -1)


def sample_pairs(request, env, experience: Experience, key: jax.Array) -> GoalPairs:
    """Goal pairs for the contrastive bound, as the learner's `PairRequest` asks (Algorithm 1, lines 16 to 20)."""
    keys = jax.random.split(key, 5)
    records = replay.sample_within_window(
        keys[0], experience.buffer, experience.achieved, experience.achieved_count, request.num_pairs, request.window
    )
    anchor, positive = (goal_pairs.choose_goal(k, usable_goals(env, record, experience.usable)) for k, record in zip(keys[1:3], records, strict=True))
    any_achieved = experience.achieved_count[-1] > 0  # Else the draw has nothing to choose from, and returned a row not written yet.
    positive_weight = ((anchor >= 0) & (positive >= 0) & any_achieved).astype(jnp.float32)
    anchor, positive = jnp.maximum(anchor, 0), jnp.maximum(positive, 0)
    contrast = jnp.broadcast_to(anchor[:, None], (request.num_pairs, request.num_negatives))
    if not request.anchored:
        contrast = goal_pairs.choose_from_mask(keys[3], experience.known, contrast.shape)
    negative, negative_weight = goal_pairs.sample_negatives(keys[4], experience.dissimilarity, experience.known, contrast)
    return GoalPairs(anchor, positive, contrast, negative, positive_weight, negative_weight)


def sample(parts, env, experience: Experience, key: jax.Array) -> Sample:
    """Draw what one update learns from: transitions, some of them under other goals (hindsight), and goal pairs."""
    transition_key, relabel_key, pair_key = jax.random.split(key, 3)
    buffer, num_steps, goal = experience.buffer, parts.agent.num_steps, None
    row, step = replay.draw(transition_key, experience.decision_count, parts.batch_size, buffer.valid.shape[1])
    if env.recorded is not None:
        goal = buffer.goal[row, step]  # Recorded episodes did not end where their goal was reached; what is drawn from them does.
    if parts.hindsight is not None:
        goal = parts.hindsight.relabel(relabel_key, experience.achievements, row, step, buffer.goal[row, step])
    transitions = replay.transitions_at(buffer, row, step, num_steps, goal, env.reached)
    pairs = sample_pairs(parts.learner.pairs, env, experience, pair_key) if parts.learner.pairs.num_pairs else None
    return judged(env, experience, transitions, pairs)


def judged(env, experience: Experience, transitions: Transitions, pairs: GoalPairs | None = None) -> Sample:
    """The transitions with their rewards (Eq. 5: 1 for reaching the goal) and with what was achieved."""
    external = env.reached(transitions.records, transitions.goal[:, None]).astype(jnp.float32)
    return Sample(transitions, external, usable_goals(env, transitions.records, experience.usable), pairs)


def returns(parts, params, learner_state, env, hyper, experience: Experience, drawn: Sample) -> tuple[jax.Array, Any, dict]:
    """Discounted reward of each transition's steps, float32 [B]: the environment's, plus the intrinsic reward (Eq. 16). Then the learner's state, and
    metrics."""
    batch, external = drawn.transitions, drawn.external
    if experience.codes is None:
        encode = encode_goals(parts.learner, jax.lax.stop_gradient(params["goal"]), env.goals, parts.table_limit)
    else:
        encode = experience.codes.__getitem__
    intrinsic, learner_state = parts.learner.intrinsic_reward(learner_state, encode, batch.goal, drawn.achieved, batch.mask)
    step_reward = external + hyper.intrinsic_weight / env.episode_length * intrinsic
    discounts = hyper.discount ** jnp.arange(batch.mask.shape[1])
    taken = batch.mask.sum()
    metrics = {"external_reward": (external * batch.mask).sum() / taken, "intrinsic_reward": (intrinsic * batch.mask).sum() / taken}
    return (step_reward * batch.mask * discounts).sum(1), learner_state, metrics


def encode_states(parts, params, env, asked: int) -> Callable[[Any], jax.Array]:
    """psi(s): stored observations [...] to features [..., F], by the encoder of these parameters.

    Every image once if there are fewer than will be asked for, else only those asked for.
    """
    if env.num_observations is not None and env.num_observations <= asked:
        return parts.state_encoder.apply(params["state"], env.render(jnp.arange(env.num_observations))).__getitem__
    return lambda observation: parts.state_encoder.apply(params["state"], env.render(observation))


def agent_batch(parts, env, hyper, params, target_params, batch: Transitions, reward, corruption, key) -> AgentBatch:
    """The transitions as codes, each occurrence of a goal with noise of its own."""
    keys = jax.random.split(key, 3)
    see, see_by_target = (encode_states(parts, given, env, 2 * parts.batch_size) for given in (params, target_params))
    encoded = encode_commanded if parts.hindsight is None else encode_goals  # Relabelled goals are any, and not among those commanded.
    code, target_code = (
        encoded(parts.learner, given["goal"], env.goals, parts.table_limit, corruption)(batch.goal) for given in (params, target_params)
    )
    code = jax.lax.stop_gradient(code) if parts.stop_encoder_gradient else code
    return AgentBatch(
        observation=batch.observation,
        next_observation=batch.next_observation,
        features=see(batch.observation),
        code=code.sample(keys[0]),
        action=batch.action,
        next_features=jax.lax.stop_gradient(see(batch.next_observation)),
        next_code=jax.lax.stop_gradient(code).sample(keys[1]),
        target_features=see_by_target(batch.next_observation),
        target_code=target_code.sample(keys[2]),
        reward=reward,
        discount=hyper.discount ** batch.mask.sum(1) * ~batch.terminated,
        action_mask=env.action_mask(batch.observation),
        next_action_mask=env.action_mask(batch.next_observation),
    )


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
    loss_key, code_key, agent_key, corruption_key = jax.random.split(key, 4)
    batch, pairs = drawn.transitions, drawn.pairs
    corruption = training_corruption(parts, env, corruption_key)
    targets = restore(state.target_params)
    reward, learner_state, reward_metrics = returns(parts, restore(state.params), state.learner, env, hyper, experience, drawn)

    def total_loss(vector):
        params = restore(vector)
        encode = encode_goals(learner, params["goal"], env.goals, parts.table_limit, corruption)
        learner_loss, learner_metrics = learner.loss(params["goal"], learner_state, encode, pairs, loss_key)
        codes = agent_batch(parts, env, hyper, params, targets, batch, reward, corruption, code_key)
        agent_loss, agent_metrics = agent.loss(params["agent"], targets["agent"], codes, state.agent, hyper, agent_key)
        return agent_loss + hyper.learner_weight * learner_loss, (learner_metrics, agent_metrics | {"loss": agent_loss})

    gradient, (learner_metrics, agent_metrics) = jax.grad(total_loss, has_aux=True)(state.params)
    norm = jnp.linalg.norm(gradient)
    scale = jnp.minimum(1.0, hyper.max_gradient_norm / (norm + 1e-6))
    direction, optimizer_state = parts.optimizer.update(gradient * scale, state.optimizer_state)
    params = state.params - hyper.learning_rate * direction
    target_params = optax.incremental_update(params, state.target_params, hyper.target_rate)
    state = state.replace(params=params, target_params=target_params, optimizer_state=optimizer_state,
                          learner=learner.update(learner_state, learner_metrics, hyper))
    metrics = {f"agent/{name}": value for name, value in (agent_metrics | reward_metrics | {"gradient_norm": norm}).items()}
    if pairs is not None:
        learner_metrics |= positive_regions(pairs, env.goals.regions)
    return state, metrics | {f"{parts.method}/{name}": value for name, value in learner_metrics.items()}


def updates(parts, env, hyper, experience: Experience, state, key: jax.Array, count: int):
    """`count` updates.

    What they learn from is drawn at once, and parameters go through the loop as one vector: draws, and an optimizer that goes from layer to layer,
    would be most of the kernels that a GPU has to start.
    """
    sample_key, update_key = jax.random.split(key)
    params, restore = ravel_pytree(state.params)
    state = state.replace(params=params, target_params=ravel_pytree(state.target_params)[0])
    drawn = jax.vmap(lambda key: sample(parts, env, experience, key))(jax.random.split(sample_key, count))
    keys = jax.random.split(update_key, count)
    state, metrics = jax.lax.scan(lambda carry, step: update(parts, env, hyper, experience, restore, carry, *step), state, (drawn, keys))
    return state.replace(params=restore(state.params), target_params=restore(state.target_params)), metrics
