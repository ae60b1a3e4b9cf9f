"""`make_train(config)`: the whole of training as one pure function of a key.

    epoch  = collect, add to the buffer, scan over updates
    chunk  = scan over epochs, then evaluate
    train  = scan over chunks

The command line runs the same `chunk` between checkpoints. Nothing here calls back to Python, reads a file or keeps state.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from infogoal_jax import agents, envs, learners, networks, pairs, replay
from infogoal_jax.agents.agent import Agent
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.errors import require
from infogoal_jax.learners.learner import Learner, encode_goals
from infogoal_jax.replay import Rows
from infogoal_jax.train.evaluation import evaluate
from infogoal_jax.train.rollout import Policy, collect
from infogoal_jax.train.update import Experience, update, usable_goals

# Purposes for which keys are folded from the seed's key, so that a draw depends on nothing but seed, purpose and epoch.
INITIAL, COLLECT, UPDATE = range(3)


class Parts(NamedTuple):
    """The parts that a configuration names, put together only here."""

    method: str
    learner: Learner
    agent: Agent
    state_encoder: networks.PatchEncoder
    optimizer: optax.GradientTransformation
    batch_size: int
    table_limit: int
    stop_encoder_gradient: bool


@flax.struct.dataclass
class TrainState:
    """Everything that training carries from epoch to epoch, for one seed.

    params, target_params: {"goal", "state", "agent"}; learner: state of the learner; dissimilarity: bool [N, N]; seen: bool [N] goals achieved;
    buffer: Rows; env_states: [num_envs]; key: the seed's key, never consumed; env_steps: int32.
    """

    params: dict
    target_params: dict
    optimizer_state: Any
    learner: Any
    dissimilarity: jax.Array
    seen: jax.Array
    buffer: Rows
    env_states: Any
    key: jax.Array
    env_steps: jax.Array


@flax.struct.dataclass
class TrainResult:
    """metrics: evaluations, {name: [num_evaluations, ...]}; epochs: {name: [num_epochs]}; params: the last parameters; state: to go on from."""

    metrics: dict[str, jax.Array]
    epochs: dict[str, jax.Array]
    params: dict
    state: TrainState


@dataclasses.dataclass(frozen=True, eq=False)
class Train:
    """A pure function `(key, hyper=None, env=None) -> TrainResult`, and the functions that it is made of.

    env: pass `train.env` under `jax.jit` so that large datasets travel as arguments instead of being compiled in.
    """

    config: TrainConfig
    env: Any
    initial: Callable[[jax.Array, Hyperparameters, Any], TrainState]
    chunk: Callable[[TrainState, jax.Array, Hyperparameters, Any], tuple]
    policy: Callable[..., Policy]
    parts: Parts

    def __call__(self, key: jax.Array, hyper: Hyperparameters | None = None, env: Any = None) -> TrainResult:
        """Train one seed from a typed key (`jax.random.key(0)`), with these hyperparameters or the configuration's."""
        hyper = self.config.hyper if hyper is None else hyper
        env = self.env if env is None else env
        epochs = jnp.arange(self.config.num_epochs).reshape(self.config.num_evaluations, -1)
        state, (epoch_metrics, metrics) = jax.lax.scan(
            lambda state, numbers: self._scannable(state, numbers, hyper, env), self.initial(key, hyper, env), epochs
        )
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), epoch_metrics)
        return TrainResult(metrics=metrics, epochs=flat, params=state.params, state=state)

    def _scannable(self, state, numbers, hyper, env):
        state, epoch_metrics, metrics = self.chunk(state, numbers, hyper, env)
        return state, (epoch_metrics, metrics)


def make_parts(config: TrainConfig, env) -> Parts:
    """The learner, agent and encoders that the configuration names."""
    size, method = config.state_encoder, learners.entry(config.method)
    require(isinstance(config.learner, method.config), "learner", type(config.learner).__name__,
            f"method {config.method!r} needs a {method.config.__name__}; make the configuration with presets.load, and resume with the same --method")
    return Parts(
        method=config.method,
        learner=method.make(config.learner),
        agent=agents.make(config.agent, env.num_actions),
        state_encoder=networks.PatchEncoder(size.patch, size.channels, size.features),
        optimizer=optax.scale_by_adam(),
        batch_size=config.batch_size,
        table_limit=config.batch_size,
        stop_encoder_gradient=config.stop_encoder_gradient,
    )


def make_train(config: TrainConfig, env: Any = None) -> Train:
    """The training function of this configuration. `env`: an environment already loaded; None loads the one that the configuration names."""
    env = envs.load(config.task, config.env) if env is None else env
    parts = make_parts(config, env)
    learner, agent, encoder = parts.learner, parts.agent, parts.state_encoder

    def policy(params, hyper_epsilon, env, use_mean=False) -> Policy:
        """The policy of these parameters. The goal is drawn anew from its code at every step (paper, Sec. IV), or its mean is used."""
        observations = jnp.arange(env.num_observations)
        encode = encode_goals(learner, params["goal"], env.goals, parts.table_limit)
        table = env.num_observations <= config.num_envs * config.rollout_steps  # Each image once, if that is cheaper than step by step.
        features = encoder.apply(params["state"], env.render(observations)) if table else None

        def act(observation, goal, key):
            sample_key, act_key = jax.random.split(key)
            code = encode(goal)
            code = code.mean if use_mean else code.sample(sample_key)
            seen = features[observation] if table else encoder.apply(params["state"], env.render(observation))
            return agent.act(params["agent"], seen, code, env.action_mask(observation), act_key, hyper_epsilon)

        return act

    def rollout(state, hyper, env, key):
        return collect(env, state.env_states, policy(state.params, hyper.epsilon, env), key, config.rollout_steps)

    def initial(key, hyper, env) -> TrainState:
        """The state before the first epoch. Compile it with the rest: it traces a rollout for the shapes of the buffer."""
        keys = jax.random.split(jax.random.fold_in(key, INITIAL), 4)
        goal_params, learner_state = learner.init(keys[0], env.goals.inputs, hyper)
        env_states = jax.vmap(env.reset)(jax.random.split(keys[3], config.num_envs))
        observation = env.render(jax.tree.map(lambda leaf: leaf[0], env.observe(env_states)))
        state_params, code = encoder.init(keys[1], observation), learner.encode(goal_params, env.goals.inputs[0]).mean
        params = {"goal": goal_params, "state": state_params, "agent": agent.init(keys[2], encoder.apply(state_params, observation), code)}
        state = TrainState(
            params=params, target_params=params, optimizer_state=parts.optimizer.init(params), learner=learner_state,
            dissimilarity=pairs.initial_dissimilarity(env.goals.num_goals), seen=jnp.zeros(env.goals.num_goals, bool),
            buffer=None, env_states=env_states, key=key, env_steps=jnp.zeros((), jnp.int32),
        )
        example = jax.eval_shape(lambda: rollout(state, hyper, env, key)[1])
        return state.replace(buffer=replay.empty(example, config.buffer_epochs))

    def epoch(state: TrainState, number, hyper, env):
        env_states, rows = rollout(state, hyper, env, jax.random.fold_in(jax.random.fold_in(state.key, COLLECT), number))
        buffer = replay.add(state.buffer, rows, number)
        usable = env.goals.train_mask if config.known_goals == "train" else jnp.ones_like(env.goals.train_mask)
        seen = state.seen.at[jnp.where((achieved := env.goals_of(rows.record)) < 0, env.goals.num_goals, achieved)].set(True, mode="drop")
        state = state.replace(env_states=env_states, buffer=buffer, seen=seen, env_steps=state.env_steps + rows.valid.sum())
        if learner.pairs.num_pairs:
            dissimilarity = pairs.remove_similar(state.dissimilarity, usable_goals(env, rows.record, usable), rows.episode(), learner.pairs.window)
            state = state.replace(dissimilarity=dissimilarity)
        written = jnp.arange(buffer.valid.shape[0]) < (number + 1) * config.num_envs
        achieved = (usable_goals(env, buffer.record, usable) >= 0).any(-1) & written[:, None]
        experience = Experience(
            buffer=buffer, valid_count=replay.running_count(buffer.valid), achieved=achieved, achieved_count=replay.running_count(achieved),
            known=jnp.ones_like(usable) if config.known_goals == "all" else usable & seen, usable=usable, dissimilarity=state.dissimilarity,
        )
        update_key = jax.random.fold_in(jax.random.fold_in(state.key, UPDATE), number)
        state, metrics = jax.lax.scan(
            lambda carry, key: update(parts, env, hyper, experience, carry, key), state, jax.random.split(update_key, config.updates_per_epoch)
        )
        metrics = jax.tree.map(lambda leaf: leaf.mean(0), metrics)
        if learner.pairs.num_pairs:
            left = pairs.count_similar_regions(state.dissimilarity, env.goals.regions, seen)
            metrics |= {f"{config.method}/{name}": value for name, value in left.items()}
        ended = jnp.maximum(rows.terminated.sum() + rows.truncated.sum(), 1)
        metrics |= {"collect/success_rate": rows.terminated.sum() / ended, "collect/nothing_achieved": (env.goals_of(rows.record) < 0).all(-1).mean()}
        return state, metrics | {"env_steps": state.env_steps}

    def chunk(state: TrainState, numbers, hyper, env):
        """Epochs `numbers` (int32 [E], not batched over seeds), then an evaluation: (state, {name: [E]}, {name: evaluation})."""
        state, epoch_metrics = jax.lax.scan(lambda carry, number: epoch(carry, number, hyper, env), state, numbers)
        policies = {"": policy(state.params, hyper.test_epsilon, env), "_mean_code": policy(state.params, hyper.test_epsilon, env, use_mean=True)}
        metrics = evaluate(env, policies, config.evaluation_starts)
        return state, epoch_metrics, metrics | {"env_steps": state.env_steps}

    return Train(config=config, env=env, initial=initial, chunk=chunk, policy=policy, parts=parts)
