"""`make_train(config)`: the whole of training as one pure function of a key.

    epoch  = collect, add to the buffer, draw what every update learns from, scan over updates
    chunk  = scan over epochs, then evaluate
    train  = scan over chunks

Offline there is nothing to collect: the environment brings its recorded rows, and the rest is the same.

The command line runs the same `chunk` between checkpoints. Nothing here calls back to Python, reads a file or keeps state.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from infogoal_jax import agents, envs, exploration, learners, networks, pairs, relabelling, replay
from infogoal_jax.agents.agent import Agent, Exploration
from infogoal_jax.config import Hyperparameters, StateEncoderConfig, TrainConfig
from infogoal_jax.errors import require
from infogoal_jax.exploration.explorer import Explorer
from infogoal_jax.learners.learner import Encode, GoalCode, InputSpec, Learner, conditioned, encode_all, encode_commanded, lookup
from infogoal_jax.relabelling import her
from infogoal_jax.relabelling.relabelling import Achievements, Context, Relabelling
from infogoal_jax.replay import Trajectories
from infogoal_jax.train import hierarchy
from infogoal_jax.train.combinations import STEERING, check_combination
from infogoal_jax.train.evaluation import EVALUATION_SEED, corrupted_images, evaluate, has_image_goals
from infogoal_jax.train.rollout import Policy, collect, rows_shape
from infogoal_jax.train.update import Experience, encode_states, training_view, updates, usable_goals

# Purposes for which keys are folded from the seed's key, so that a draw depends on nothing but seed, purpose and epoch.
INITIAL, COLLECT, UPDATE, CORRUPT = range(4)


class Parts(NamedTuple):
    """The parts that a configuration names, put together only here.

    name: of the learner, under which its metrics stand; relabelling: of the agent's transitions; learner_relabelling: of those that the
    learner's loss sees, if it asks for that.
    """

    name: str
    learner: Learner
    agent: Agent
    relabelling: Relabelling | None
    learner_relabelling: Relabelling | None
    explorer: Explorer | None
    state_encoder: networks.PatchEncoder | networks.VectorEncoder
    optimizer: optax.GradientTransformation
    batch_size: int
    table_limit: int
    stop_encoder_gradient: bool
    training_corruption: float


@flax.struct.dataclass
class TrainState:
    """Everything that training carries from epoch to epoch, for one seed.

    params, target_params: {"goal", "state", "agent"}, and "explorer" where there is one; learner, agent, explorer: their states;
    dissimilarity: bool [N, N]; seen: bool [N] goals achieved; buffer: Trajectories; env_states: [num_envs]; both None offline.
    key: the seed's key, never consumed; env_steps: int32, collected or recorded.
    """

    params: dict
    target_params: dict
    optimizer_state: Any
    learner: Any
    agent: Any
    explorer: Any
    dissimilarity: jax.Array
    seen: jax.Array
    buffer: Trajectories | None
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
    test_policies: Callable[..., dict[str, Policy]]
    experience_of: Callable[[TrainState, jax.Array, Hyperparameters, Any], tuple[Experience, TrainState]]
    parts: Parts

    def __call__(self, key: jax.Array, hyper: Hyperparameters | None = None, env: Any = None) -> TrainResult:
        """Train one seed from a typed key (`jax.random.key(0)`), with these hyperparameters or the configuration's."""
        hyper = self.config.hyper if hyper is None else hyper
        check_hyperparameters(self.config, hyper)
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


def check_hyperparameters(config: TrainConfig, hyper: Hyperparameters) -> None:
    """Raise `UserError` where float hyperparameters are not those of the configuration's parts."""
    for registered, own, given in ((learners.registry, config.learner, hyper.learner), (agents.registry, config.agent, hyper.agent)):
        needed = registered.entry_of(own).hyper
        require(type(given) is needed, f"hyper.{registered.kind}", type(given).__name__,
                f"{registered.kind} {registered.name_of(own)!r} needs {needed.__name__}; change fields of config.hyper, or take "
                "presets.default_hyperparameters")


def make_parts(config: TrainConfig, env) -> Parts:
    """The learner, agent, relabelling and encoders that the configuration names."""
    learner = learners.registry.entry_of(config.learner).make(config.learner)
    share = learner.sample_spec.relabelled_share
    return Parts(
        name=learners.registry.name_of(config.learner),
        learner=learner,
        agent=agents.registry.entry_of(config.agent).make(config.agent, env),
        relabelling=relabelling.registry.entry_of(config.relabelling).make(config.relabelling),
        learner_relabelling=her.make(her.HERConfig(future_share=share)) if share else None,
        explorer=exploration.registry.entry_of(config.explorer).make(config.explorer),
        state_encoder=make_state_encoder(config.state_encoder, env),
        optimizer=optax.scale_by_adam(),
        batch_size=config.batch_size,
        table_limit=config.batch_size,
        stop_encoder_gradient=config.stop_encoder_gradient,
        training_corruption=config.training_corruption,
    )


def make_state_encoder(size: StateEncoderConfig, env):
    """psi(s) for what the network sees of a state: an image, or a vector."""
    seen = jax.eval_shape(lambda key: env.render(env.observe(env.reset(key))), jax.random.key(0))
    if seen.ndim > 1:
        require(seen.shape[0] % size.patch == seen.shape[1] % size.patch == 0, "state_encoder.patch", size.patch,
                f"must divide height and width of the images, {seen.shape[0]} and {seen.shape[1]}")
    return networks.VectorEncoder(size.features) if seen.ndim == 1 else networks.PatchEncoder(size.patch, size.channels, size.features)


def load_environment(config: TrainConfig, env: Any = None):
    """The environment that the configuration names, or `env`; under HRAC with the low level in it, so that its actions are subgoals.

    Raises `UserError` for files that cannot be used, and for an environment that the agent, or this way of training, is not made for.
    """
    if env is None:
        check_combination(config)
        env = envs.load(config.task, config.env)
    check_combination(config, env)
    check_hyperparameters(config, config.hyper)
    if agents.registry.name_of(config.agent) in STEERING and not isinstance(env, hierarchy.SubgoalEnv):
        return hierarchy.steer(env, config.agent)
    return env


def make_train(config: TrainConfig, env: Any = None) -> Train:
    """The training function of this configuration. `env`: an environment already loaded; None loads the one that the configuration names."""
    env = load_environment(config, env)
    parts = make_parts(config, env)
    learner, agent, encoder = parts.learner, parts.agent, parts.state_encoder

    def policy(params, exploration: Exploration, env, encode: Encode, use_mean=False) -> Policy:
        """The policy of these parameters. The goal is drawn anew from its code at every step (paper, Sec. IV), or its mean is used."""
        see = encode_states(parts, params, env, config.num_envs * config.rollout_steps)

        def act(observation, goal, key):
            sample_key, act_key = jax.random.split(key)
            features = see(observation)
            code = conditioned(learner, params["goal"], encode(goal), features)
            code = code.mean if use_mean else code.sample(sample_key)
            return agent.act(params["agent"], features, code, env.action_mask(observation), act_key, exploration)

        return act

    def test_policies(params, hyper, env, num_starts, corruption=None, seed=EVALUATION_SEED) -> dict[str, Policy]:
        """The policies that an evaluation compares, by the names of their metrics: code sampled or mean, goals as they are or corrupted.

        They act on the episodes of `evaluation.goal_starts` with this number of starts. corruption: weight, None for the configuration's.
        """
        exploration = Exploration(hyper.test_epsilon, 0.0)
        views = {"": lookup(learner.encode(params["goal"], env.goals.inputs_of(env.goals.evaluated)), env.goals, env.goals.evaluated)}
        if has_image_goals(env):
            weight = config.test_corruption if corruption is None else corruption
            codes = learner.encode(params["goal"], corrupted_images(env, num_starts, weight, seed))
            views["corrupted_"] = lambda goal: codes  # A background for each episode, the same for its whole length.
        return {
            f"{prefix}{{group}}_goal{suffix}": policy(params, exploration, env, encode, use_mean=bool(suffix) or learner.mean_at_test)
            for suffix in ("", "_mean_code") for prefix, encode in views.items()
        }

    def training_policy(params, hyper, env, key) -> Policy:
        encode = encode_commanded(learner, params["goal"], env.goals, parts.table_limit, training_view(parts, env, augmented=False), key)
        return policy(params, Exploration(hyper.epsilon, hyper.noise), env, encode)

    def initial(key, hyper, env) -> TrainState:
        """The state before the first epoch."""
        keys = jax.random.split(jax.random.fold_in(key, INITIAL), 4)
        env_states = jax.vmap(env.reset)(jax.random.split(keys[3], config.num_envs))
        observation = jax.tree.map(lambda leaf: leaf[0], env.observe(env_states))
        params, explorer_state = {"state": encoder.init(keys[1], env.render(observation))}, None
        features = encode_states(parts, params, env, 1)(observation)
        params["goal"], learner_state = learner.init(
            keys[0], InputSpec(env.goals.inputs_of(env.goals.commanded), features, env.num_cells), hyper.learner)
        code = conditioned(learner, params["goal"], learner.encode(params["goal"], env.goals.inputs[:1]), features[None]).mean[0]
        params["agent"], agent_state = agent.init(keys[2], features, code)
        if parts.explorer is not None:
            params["explorer"], explorer_state = parts.explorer.init(jax.random.fold_in(keys[2], 1), features, env.action_size)
        state = TrainState(
            params=params, target_params=params, optimizer_state=parts.optimizer.init(ravel_pytree(params)[0]), learner=learner_state,
            agent=agent_state, explorer=explorer_state, dissimilarity=pairs.initial_dissimilarity(env.goals.num_goals),
            seen=jnp.zeros(env.goals.num_goals, bool), buffer=None, env_states=None, key=key, env_steps=jnp.zeros((), jnp.int32),
        )
        if env.recorded is not None:
            return update_statistics(state, env.recorded, env)
        example = rows_shape(env, env_states, training_policy(params, hyper, env, key), config.rollout_steps)
        return state.replace(buffer=replay.empty(example, config.buffer_epochs), env_states=env_states)

    def usable_mask(env) -> jax.Array:
        """Goals that may be anchors and positives, and that transitions may be relabelled with, once they are achieved: bool [N]."""
        return env.goals.train_mask if config.known_goals == "train" else jnp.ones_like(env.goals.train_mask)

    def update_statistics(state: TrainState, rows: Trajectories, env) -> TrainState:
        """The state that has seen these rows: goals achieved, pairs that are no longer dissimilar, and what the agent makes of them."""
        achieved = env.goals_of(rows.record)
        state = state.replace(
            agent=agent.observe(state.agent, rows), env_steps=state.env_steps + rows.valid.sum(),
            learner=learner.observe(state.learner, env.cell_of(rows.record)[:, 1:], rows.valid),
            seen=state.seen.at[jnp.where(achieved < 0, env.goals.num_goals, achieved)].set(True, mode="drop"),
        )
        if not learner.sample_spec.num_pairs:
            return state
        similar = usable_goals(env, rows.record, usable_mask(env))
        return state.replace(dissimilarity=pairs.remove_similar(state.dissimilarity, similar, rows.episode(), learner.sample_spec.window))

    def gather(state: TrainState, number, hyper, env) -> tuple[TrainState, dict]:
        """Collect the rows of an epoch into the buffer."""
        collect_key = jax.random.fold_in(jax.random.fold_in(state.key, COLLECT), number)
        corruption_key = jax.random.fold_in(jax.random.fold_in(state.key, CORRUPT), number)
        acting = training_policy(state.params, hyper, env, corruption_key)
        env_states, rows = collect(env, state.env_states, acting, collect_key, config.rollout_steps)
        state = update_statistics(state.replace(env_states=env_states, buffer=replay.add(state.buffer, rows, number)), rows, env)
        ended = jnp.maximum(rows.terminated.sum() + rows.truncated.sum(), 1)
        return state, {
            "collect/success_rate": rows.terminated.sum() / ended, "collect/nothing_achieved": (env.goals_of(rows.record) < 0).all(-1).mean(),
            "collect/valid": rows.valid.mean(), "collect/goals_seen": state.seen.sum(),
        }

    def experience_of(state: TrainState, number, hyper, env) -> tuple[Experience, TrainState]:
        """What the updates of an epoch draw from, and the state with what the explorer made of it."""
        offline, usable = env.recorded is not None, usable_mask(env)
        buffer = env.recorded if offline else state.buffer
        written = jnp.arange(buffer.valid.shape[0]) < (buffer.valid.shape[0] if offline else (number + 1) * config.num_envs)
        goals = usable_goals(env, buffer.record, usable)
        achieved = (goals >= 0).any(-1) & written[:, None]
        achieved_count = replay.running_count(achieved)
        known = jnp.ones_like(usable) if config.known_goals == "all" else usable & state.seen
        codes = encode_all(learner, state.params["goal"], env.goals) if env.goals.num_goals > parts.table_limit else None
        bonus = table = learner_table = None
        if parts.relabelling is not None or parts.learner_relabelling is not None:
            achievements = Achievements(goals, achieved_count, replay.steps_left(buffer.valid), known)
            context = relabelling_context(state, number, hyper, env, buffer, written, achievements, codes)
            table = None if parts.relabelling is None else parts.relabelling.prepare(context)
            learner_table = None if parts.learner_relabelling is None else parts.learner_relabelling.prepare(context)
        if parts.explorer is not None:
            features = encode_states(parts, state.params, env, env.num_observations)(jnp.arange(env.num_observations))
            bonus, explored = parts.explorer.compute_bonus(state.params["explorer"], state.explorer, features, buffer, written, hyper.discount)
            state = state.replace(explorer=explored)
        return Experience(
            buffer=buffer, decision_count=replay.running_count(buffer.valid & buffer.decided), achieved=achieved, achieved_count=achieved_count,
            known=known, usable=usable, dissimilarity=state.dissimilarity, codes=codes,
            relabelling=table, learner_relabelling=learner_table, bonus=bonus,
        ), state

    def relabelling_context(state: TrainState, number, hyper, env, rows: Trajectories, written, achievements: Achievements,
                            codes: GoalCode | None) -> Context:
        """What a relabelling may look at before the updates of this epoch. codes: of all goals, or None where they are few."""
        def positions():
            if env.goal_positions is not None:
                return env.goal_positions
            return (encode_all(learner, state.params["goal"], env.goals) if codes is None else codes).mean

        def value(observation, goal):
            features = encode_states(parts, state.params, env, goal.shape[0])(observation)
            code = conditioned(learner, state.params["goal"], learner.encode(state.params["goal"], env.goals.inputs_of(goal)), features)
            return agent.value(state.params["agent"], features, code.mean, env.action_mask(observation))

        return Context(rows, written, achievements, positions, value, env.reached, hyper.discount, number * config.updates_per_epoch)

    def epoch(state: TrainState, number, hyper, env):
        collected = {}
        if env.recorded is None:
            state, collected = gather(state, number, hyper, env)
        experience, state = experience_of(state, number, hyper, env)
        update_key = jax.random.fold_in(jax.random.fold_in(state.key, UPDATE), number)
        state, metrics = updates(parts, env, hyper, experience, state, update_key, config.updates_per_epoch)
        metrics = jax.tree.map(lambda leaf: leaf.mean(0), metrics) | collected
        if learner.sample_spec.num_pairs:
            left = pairs.count_dissimilar_regions(state.dissimilarity, env.goals.regions, state.seen)
            metrics |= {f"{parts.name}/{name}": value for name, value in left.items()}
        return state, metrics | {"env_steps": state.env_steps}

    def chunk(state: TrainState, numbers, hyper, env):
        """Epochs `numbers` (int32 [E], not batched over seeds), then an evaluation: (state, {name: [E]}, {name: evaluation})."""
        state, epoch_metrics = jax.lax.scan(lambda carry, number: epoch(carry, number, hyper, env), state, numbers)
        metrics = evaluate(env, test_policies(state.params, hyper, env, config.evaluation_starts), config.evaluation_starts)
        return state, epoch_metrics, metrics | {"env_steps": state.env_steps}

    return Train(config=config, env=env, initial=initial, chunk=chunk, test_policies=test_policies, experience_of=experience_of, parts=parts)
