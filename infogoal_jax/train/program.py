"""`make_train(config)`: the whole of training as one pure function of a key.

    epoch  = collect, add to the buffer, draw what every update learns from, scan over updates
    chunk  = scan over epochs, then evaluate
    train  = scan over chunks

Offline there is nothing to collect: the environment brings its recorded rows, and the rest is the same.

The command line runs the same chunk between checkpoints. What is here reads no file, calls nothing in Python, but for a
callback that is asked for, and keeps no state: `infogoal_jax.make_train` loads the environment that a configuration
names.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from infogoal_jax import checks, replay
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.keys import fold
from infogoal_jax.learners.learner import InputSpec, conditioned
from infogoal_jax.train.contracts import check_simulated, with_checked_inputs
from infogoal_jax.train.evaluation import EVALUATION_SEED, evaluate_settings
from infogoal_jax.train.experience import collect_epoch, first_dissimilarity, make_experience, update_statistics
from infogoal_jax.train.metrics import count_dissimilar_regions
from infogoal_jax.train.parts import (
    INITIAL,
    UPDATE,
    Parts,
    Setup,
    TrainResult,
    TrainState,
    check_hyperparameters,
    encode_states,
    make_parts,
    numbered,
)
from infogoal_jax.train.rollout import Policy, rows_shape, trained_policy, training_policy
from infogoal_jax.train.update import updates


@dataclasses.dataclass(frozen=True, eq=False)
class Train:
    """A pure function `(key, hyper=None, env=None) -> TrainResult`, and the functions that it is made of.

    env: pass `train.env` under `jax.jit` so that large datasets travel as arguments instead of being compiled in.
    """

    config: TrainConfig
    env: Any
    initial: Callable[[jax.Array, Hyperparameters, Any], TrainState]
    epochs: Callable[[TrainState, jax.Array, Hyperparameters, Any], tuple]
    """(state, numbers, hyper, env) -> (state, {name: [E]}): epochs of these numbers, int32 [E], which all seeds
    share."""
    evaluation: Callable[[TrainState, Hyperparameters, Any], dict[str, jax.Array]]
    """(state, hyper, env) -> the metrics of an evaluation."""
    parts: Parts
    check_env: Callable[[Any], None] = lambda env: None
    """Raises `UserError` for an environment that cannot be given in the place of `env`."""
    callback: Callable[[Any, dict[str, Any]], None] | None = None
    """Called with the epoch and the metrics of each evaluation while the program runs; None: nothing in the program."""

    def __call__(self, key: jax.Array, hyper: Hyperparameters | None = None, env: Any = None) -> TrainResult:
        """Train one seed from a typed key (`jax.random.key(0)`), with these hyperparameters or the configuration's."""
        hyper = self.config.hyper if hyper is None else hyper
        check_hyperparameters(self.config, hyper)
        env = self.env if env is None else env
        self.check_env(env)
        env = jax.tree.map(jnp.asarray, env)  # Recordings wait outside of the device until now.
        checks.key(key)

        def step(state, numbers):
            state, epoch_metrics, metrics = self.chunk(state, numbers, hyper, env)
            if self.callback is not None:
                jax.debug.callback(self.callback, numbers[-1] + 1, metrics)
            return state, (epoch_metrics, metrics)

        epochs = jnp.arange(self.config.num_epochs, dtype=jnp.int32).reshape(self.config.num_evaluations, -1)
        state, (epoch_metrics, metrics) = jax.lax.scan(step, self.initial(key, hyper, env), epochs)
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), epoch_metrics)
        return TrainResult(metrics=metrics, epochs=flat, params=state.params, state=state)

    @functools.cached_property
    def state_shapes(self) -> TrainState:
        """Shapes and types of the state of one seed, for which `initial` is traced once."""
        return jax.eval_shape(self.initial, jax.random.key(0), self.config.hyper, self.env)

    def setup(self, hyper: Hyperparameters | None = None, env: Any = None) -> Setup:
        """What the functions of the program are given, with these hyperparameters and environment or its own."""
        return Setup(self.parts, self.config.hyper if hyper is None else hyper, self.env if env is None else env)

    def policy(self, params: dict, hyper: Hyperparameters, env: Any, use_mean: bool | jax.Array = False) -> Policy:
        """The policy of `rollout.trained_policy`. It raises `UserError` for other observations than the task's, for
        what are no goals of it, and for what is not finite."""
        setup = self.setup(hyper, env)
        shapes, recorded = self.state_shapes, setup.env.recorded
        seen = (shapes.buffer if recorded is None else recorded).observation
        seen = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), seen)
        return with_checked_inputs(trained_policy(setup, params, use_mean), setup.env, seen)

    def evaluate(
        self,
        params: dict,
        hyper: Hyperparameters,
        env: Any,
        num_starts: int,
        corruption: float | None = None,
        seed: int = EVALUATION_SEED,
    ) -> dict[str, jax.Array]:
        """The metrics of `evaluation.evaluate_settings`. Raises `UserError` for a task that nobody can act in."""
        setup = self.setup(hyper, env)
        check_simulated(setup.env, "env", type(setup.env).__name__)
        return evaluate_settings(setup, params, num_starts, corruption, seed)

    def chunk(self, state: TrainState, numbers: jax.Array, hyper: Hyperparameters, env: Any) -> tuple:
        """Epochs of these numbers, int32 [E], then an evaluation: (state, {name: [E]}, {name: evaluation})."""
        state, epoch_metrics = self.epochs(state, numbers, hyper, env)
        return state, epoch_metrics, self.evaluation(state, hyper, env)


def make_train(config: TrainConfig, env: Any, check_env: Callable[[Any], None] = lambda env: None) -> Train:
    """The training function of this configuration in this environment, which is loaded already
    (`infogoal_jax.make_train` does). check_env: raises `UserError` for another environment that cannot take its
    place."""
    parts = make_parts(config, env)
    learner, agent, encoder = parts.learner, parts.agent, parts.state_encoder

    def initial(key, hyper, env) -> TrainState:
        """The state before the first epoch."""
        setup = Setup(parts, hyper, env)
        keys = jax.random.split(fold(key, INITIAL), 4)
        env_states = jax.vmap(env.reset)(jax.random.split(keys[3], config.num_envs))
        observation = jax.tree.map(lambda leaf: leaf[0], env.observe(env_states))
        params, explorer_state = {"state": encoder.init(keys[1], env.render(observation))}, None
        features = encode_states(setup, params, 1)(observation)
        params["goal"], learner_state = learner.init(
            keys[0], InputSpec(env.goals.inputs_of(env.goals.examples), features, env.num_cells), hyper.learner
        )
        code = conditioned(
            learner,
            params["goal"],
            learner.encode(params["goal"], env.goals.inputs_of(env.goals.examples[:1])),
            features[None],
        ).mean[0]
        params["agent"], agent_state = agent.init(keys[2], features, code)
        if parts.explorer is not None:
            params["explorer"], explorer_state = parts.explorer.init(
                jax.random.fold_in(keys[2], 1), features, env.action_size
            )
        state = TrainState(
            params=params,
            target_params=params,
            optimizer_state=parts.optimizer.init(ravel_pytree(params)[0]),
            learner=learner_state,
            agent=agent_state,
            explorer=explorer_state,
            dissimilarity=first_dissimilarity(setup),
            seen=jnp.zeros(env.goals.num_goals, bool) if env.goals.finite else None,
            buffer=None,
            env_states=None,
            key=key,
            env_steps=jnp.zeros((), jnp.int32),
        )
        if env.recorded is not None:
            return update_statistics(setup, state, env.recorded)
        example = rows_shape(env, env_states, training_policy(setup, params, key), config.rollout_steps)
        return state.replace(buffer=replay.empty(example, config.buffer_epochs), env_states=env_states)

    def epoch(state: TrainState, number, hyper, env):
        setup, collected = Setup(parts, hyper, env), {}
        if env.recorded is None:
            state, collected = collect_epoch(setup, state, number)
        experience, state = make_experience(setup, state, number)
        update_key = numbered(state.key, UPDATE, number)
        state, metrics = updates(setup, experience, state, update_key, config.updates_per_epoch)
        metrics |= collected
        if learner.sample_spec.num_pairs and env.goals.finite:
            left = count_dissimilar_regions(state.dissimilarity, env.goals.regions, state.seen)
            metrics |= {f"{parts.name}/{name}": value for name, value in left.items()}
        return state, metrics | {"env_steps": state.env_steps}

    def epochs(state: TrainState, numbers, hyper, env):
        return jax.lax.scan(lambda carry, number: epoch(carry, number, hyper, env), state, numbers)

    def evaluation(state: TrainState, hyper, env):
        """Success of the present parameters, where the task can be acted in."""
        metrics = {"env_steps": state.env_steps}
        if not env.simulated:
            return metrics
        return evaluate_settings(Setup(parts, hyper, env), state.params, config.evaluation_starts) | metrics

    return Train(
        config=config, env=env, initial=initial, epochs=epochs, evaluation=evaluation, parts=parts, check_env=check_env
    )
