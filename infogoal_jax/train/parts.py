"""What a training program is made of: the parts of a configuration with the environment that goes with them, what
their networks see, and the state that goes from epoch to epoch."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from infogoal_jax import agents, exploration, hyperparameters, learners, networks, relabelling
from infogoal_jax.agents.agent import Agent
from infogoal_jax.config import Hyperparameters, StateEncoderConfig, TrainConfig
from infogoal_jax.envs.environment import Environment, one_observation
from infogoal_jax.errors import require
from infogoal_jax.exploration.explorer import Explorer
from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.keys import fold
from infogoal_jax.learners.encoding import GoalEncoding, View
from infogoal_jax.learners.learner import GoalCode, Learner
from infogoal_jax.relabelling.relabelling import Relabelling
from infogoal_jax.replay import Trajectories
from infogoal_jax.rows import take_rows
from infogoal_jax.train.checked_parts import checked_part


class Parts(NamedTuple):
    """The parts that a configuration is of, put together only here."""

    config: TrainConfig
    name: str
    """Of the learner; its metrics stand under this name."""
    learner: Learner
    agent: Agent
    relabelling: Relabelling | None
    """Of the agent's transitions; the learner may have one of its own, `SampleSpec.relabelling`."""
    explorer: Explorer | None
    state_encoder: networks.PatchEncoder | networks.VectorEncoder | networks.AsItIs
    optimizer: optax.GradientTransformation


class Setup(NamedTuple):
    """What every function of the program is given: the parts, which decide the program, and two of its arguments."""

    parts: Parts
    hyper: Hyperparameters
    """Those of a seed, which differ from the configuration's in a sweep."""
    env: Environment

    @property
    def config(self) -> TrainConfig:
        """The configuration that the parts are of."""
        return self.parts.config


def make_parts(config: TrainConfig, env) -> Parts:
    """The parts that the configuration names, for this environment."""
    return Parts(
        config=config,
        name=learners.registry.name_of(config.learner),
        learner=make_learner(config),
        agent=checked_part("agent", agents.registry.entry_of(config.agent), config, env),
        relabelling=checked_part("relabelling", relabelling.registry.entry_of(config.relabelling), config, env),
        explorer=checked_part("explorer", exploration.registry.entry_of(config.explorer), config, env),
        state_encoder=make_state_encoder(config.state_encoder, env),
        optimizer=optax.scale_by_adam(),
    )


def sees_means(parts: Parts) -> bool:
    """Whether the agent learns from means of codes and acts on them, in place of samples."""
    goals = parts.agent.all_goals
    return goals is not None and goals.code == "mean"


def tests_on_means(parts: Parts) -> bool:
    """Whether the trained policy acts on means of codes without being asked to."""
    return parts.learner.mean_at_test or sees_means(parts)


def code_seen(parts: Parts, code: GoalCode, key: jax.Array) -> jax.Array:
    """What the agent learns from of codes, float32 [..., d]."""
    return code.mean if sees_means(parts) else code.sample(key)


def make_learner(config: TrainConfig) -> Learner:
    """The learner that the configuration names. Raises `UserError` for one of a user's own that is none."""
    return checked_part("learner", learners.registry.entry_of(config.learner), config, None)


def make_state_encoder(size: StateEncoderConfig, env):
    """psi(s) for what the network sees of a state: an image, or a vector."""
    seen = jax.eval_shape(env.render, one_observation(env))
    if seen.ndim == 1:
        return networks.VectorEncoder(size.features) if size.features else networks.AsItIs()
    remedy = "observations are images; give a size greater than 0"
    require(size.features > 0, "state_encoder.features", size.features, remedy)
    require(
        seen.shape[0] % size.patch == seen.shape[1] % size.patch == 0,
        "state_encoder.patch",
        size.patch,
        f"must divide height and width of the images, {seen.shape[0]} and {seen.shape[1]}",
    )
    return networks.PatchEncoder(size.patch, size.channels, size.features)


def check_hyperparameters(config: TrainConfig, hyper: Hyperparameters) -> None:
    """Raise `UserError` where float hyperparameters are not those of the configuration's parts, or out of range."""
    require(isinstance(hyper, Hyperparameters), "hyper", hyper, "give Hyperparameters, such as config.hyper")
    for registered, own, given in (
        (learners.registry, config.learner, hyper.learner),
        (agents.registry, config.agent, hyper.agent),
    ):
        needed = registered.entry_of(own).hyper
        require(
            type(given) is needed,
            f"hyper.{registered.kind}",
            type(given).__name__,
            f"{registered.kind} {registered.name_of(own)!r} needs {needed.__name__}; change fields of config.hyper, or "
            "take presets.default_hyperparameters",
        )
    hyperparameters.check(hyper)


def encode_states(setup: Setup, params: dict, asked: int) -> Callable[[Any], jax.Array]:
    """psi(s): stored observations [...] to features [..., F], by the encoder of these parameters.

    Every image once if there are fewer than will be asked for, else only those asked for.
    """
    parts, _, env = setup
    if env.num_observations is not None and env.num_observations <= asked:
        images = env.render(jnp.arange(env.num_observations, dtype=jnp.int32))
        table = parts.state_encoder.apply(params["state"], images)
        return lambda observation: take_rows(table, observation)
    return lambda observation: parts.state_encoder.apply(params["state"], env.render(observation))


def training_view(setup: Setup, augmented: bool) -> View | None:
    """How the inputs of goals look while training: as they are, or under a background, and in updates as the learner
    augments them."""
    parts, _, env = setup

    def view(key, inputs):
        corrupt_key, augment_key = jax.random.split(key)
        if parts.config.training_corruption:
            backgrounds = draw_backgrounds(corrupt_key, env.train_backgrounds, inputs.shape[:-3])
            inputs = corrupt(inputs, backgrounds, parts.config.training_corruption)
        return augment(augment_key, inputs) if augment else inputs

    augment = parts.learner.augment if augmented else None
    return view if parts.config.training_corruption or augment else None


def goal_encoding(setup: Setup, params: dict, view_key: jax.Array | None) -> GoalEncoding:
    """How an update encodes goals with these parameters, their inputs varied by draws from the key."""
    view = training_view(setup, augmented=True)
    return GoalEncoding(setup.parts.learner, params["goal"], setup.env.goals, setup.config.batch_size, view, view_key)


# Purposes for which keys are folded from the seed's key, so that a draw depends on nothing but seed, purpose and epoch.
INITIAL, COLLECT, UPDATE, CORRUPT = range(4)


def numbered(key: jax.Array, purpose: int, number: jax.Array) -> jax.Array:
    """A seed's key for a purpose and a number, such as that of the epoch; neither is batched."""
    return fold(key, purpose, number)


class Networks(NamedTuple):
    """The networks of one update."""

    params: dict
    """Those that are trained."""
    target_params: dict
    """Those of the target networks."""
    view_key: jax.Array | None
    """Of how the update varies goal inputs."""


@flax.struct.dataclass
class TrainState:
    """Everything that training carries from epoch to epoch, for one seed."""

    params: dict
    """{"goal", "state", "agent"}, and "explorer" where there is one."""
    target_params: dict
    """As `params`, of the target networks."""
    optimizer_state: Any
    """Of Adam, over all parameters as one vector."""
    learner: Any
    """The learner's state."""
    agent: Any
    """The agent's state."""
    explorer: Any
    """The explorer's state; None without one."""
    dissimilarity: jax.Array | None
    """G_neg, bool [N, N], of goals or of cells; None where goals are continuous and no cells are asked for."""
    seen: jax.Array | None
    """bool [N], goals achieved so far; None where goals are not finite."""
    buffer: Trajectories | None
    """The replay buffer; None offline."""
    env_states: Any
    """States of the environments, [num_envs]; None offline."""
    key: jax.Array
    """The seed's key, never consumed."""
    env_steps: jax.Array
    """int32 [], steps collected or recorded."""


@flax.struct.dataclass
class TrainResult:
    """What training one seed returns.

    metrics: evaluations, {name: [num_evaluations, ...]}.
    epochs: {name: [num_epochs]}.
    params: the last parameters.
    state: to go on from.
    """

    metrics: dict[str, jax.Array]
    epochs: dict[str, jax.Array]
    params: dict
    state: TrainState
