"""Training the low level of HRAC: TD3 with hindsight relabelling on target states, as pure functions of a key.

    epoch = run every environment for one episode, add to the buffer, scan over updates

An eighth of the environments act without noise: their success is the learning curve, and costs no episode of its own. The others explore, half of
them under targets that move as the high level will move them: without those it takes twice as long (docs/low_level.md).
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax

from infogoal_jax import replay
from infogoal_jax.agents import td3
from infogoal_jax.agents.low_level import SMALLEST_STD, LowLevel, LowLevelConfig, network_input
from infogoal_jax.envs.fetch import environment
from infogoal_jax.envs.fetch.targets import TargetReaching, TargetSpace
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.errors import nearest, require
from infogoal_jax.relabelling import her
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.rollout import collect

INITIAL, COLLECT, UPDATE, EVALUATE = range(4)
"""Purposes for which keys are folded from the seed's key."""


@flax.struct.dataclass
class PretrainHyperparameters:
    """Floats of the low level's training: an argument of the compiled program.

    [HER]: Andrychowicz et al. 2017 in OpenAI's baselines; [RL-Zoo]: the tuned values of rl-zoo3 for Fetch; [M]: measured for this project.
    """

    learning_rate: float = 1e-3
    """Step of Adam [HER]. Greater than 0."""
    discount: float = 0.95
    """Discount of a step [RL-Zoo], in [0, 1)."""
    target_rate: float = 0.05
    """Share by which target networks follow at each update [RL-Zoo], in (0, 1]."""
    noise: float = 0.2
    """Standard deviation of the noise on actions while collecting [HER], 0 or more."""
    random_share: float = 0.3
    """Share of random actions while collecting [HER], in [0, 1]."""
    target_noise: float = 0.1
    """Standard deviation of the noise on target actions, 0 or more (TD3's own is 0.2)."""
    action_cost: float = 1.0
    """Weight of the squared action in the actor's loss [HER], 0 or more."""
    relabel_share: float = 0.8
    """Share of transitions whose target is one that was achieved later in the episode [HER], in [0, 1]."""
    moving_share: float = 0.5
    """Share of the noisy episodes with a moving target, as the high level will give it [M], in [0, 1]."""

    def check(self) -> None:
        """Raise `UserError` for a value out of its range."""
        for name in ("learning_rate", "target_rate"):
            require(0 < getattr(self, name) <= 1, f"hyper.{name}", getattr(self, name), "give a number above 0, at most 1")
        for name in ("noise", "target_noise", "action_cost"):
            require(getattr(self, name) >= 0, f"hyper.{name}", getattr(self, name), "give 0 or more")
        for name in ("random_share", "relabel_share", "moving_share"):
            require(0 <= getattr(self, name) <= 1, f"hyper.{name}", getattr(self, name), "give a number from 0 to 1")
        require(0 <= self.discount < 1, "hyper.discount", self.discount, "give a number from 0 to below 1, for example 0.95")


@dataclasses.dataclass(frozen=True)
class PretrainConfig:
    """What decides the compiled program of the low level's training."""

    task: str
    """fetch_reach, fetch_push or fetch_pick_and_place."""
    num_envs: int = 1024
    """Episodes in an epoch, side by side; an eighth of them without noise."""
    num_epochs: int = 60
    """Epochs: each runs one episode in every environment, then updates."""
    updates_per_epoch: int = 1000
    """Gradient updates in an epoch."""
    batch_size: int = 2048
    """Transitions in an update [RL-Zoo]."""
    buffer_epochs: int = 20
    """Epochs that the replay buffer holds."""
    episode_length: int = 50
    """Steps of 40 ms in an episode, always run to its end."""
    faithful: bool = False
    """Simulate as finely as the reference does (docs/fetch.md)."""
    network: LowLevelConfig = dataclasses.field(default_factory=LowLevelConfig)
    """Sizes of the networks."""
    hyper: PretrainHyperparameters = dataclasses.field(default_factory=PretrainHyperparameters)
    """Default values of the compiled program's arguments."""

    def __post_init__(self):
        require(self.task in PRESETS, "task", self.task,
                f"no low level can be trained for it.{nearest(self.task, list(PRESETS))} Known: {', '.join(PRESETS)}")
        for name in ("num_envs", "num_epochs", "updates_per_epoch", "batch_size", "buffer_epochs", "episode_length"):
            require(getattr(self, name) > 0, name, getattr(self, name), "give a whole number greater than 0")
        require(self.num_envs >= 8, "num_envs", self.num_envs, "give at least 8: an eighth of them measure success")
        require(len(self.network.hidden) > 0 and all(width > 0 for width in self.network.hidden), "network.hidden", self.network.hidden,
                "give widths greater than 0, for example 256 256 256")
        if isinstance(self.hyper.learning_rate, int | float):
            self.hyper.check()


PRESETS: dict[str, dict[str, Any]] = {
    "fetch_reach": {"num_envs": 128, "num_epochs": 20, "updates_per_epoch": 200, "batch_size": 256, "network": LowLevelConfig((128, 128))},
    "fetch_push": {},
    "fetch_pick_and_place": {},
}
"""What each task needs away from the defaults [M]. fetch_slide has no low level: its goals lie where the gripper cannot follow."""


def preset(task: str, **changes: Any) -> PretrainConfig:
    """The tuned configuration of a task; `changes` replace its fields. Raises `UserError` for a task without a low level."""
    return PretrainConfig(task, **(PRESETS.get(task, {}) | changes))


@flax.struct.dataclass
class PretrainState:
    """What training carries from epoch to epoch, for one seed.

    params, target_params: {"actor", "critic"}; moments: float32 [3, D], count, sum and sum of squares of all observations so far.
    """

    params: dict
    target_params: dict
    optimizer_state: Any
    moments: jax.Array
    buffer: Trajectories
    key: jax.Array

    def statistics(self) -> tuple[jax.Array, jax.Array]:
        """Mean and standard deviation [D] that observations are normalised with."""
        count, total, squares = self.moments
        mean = total / jnp.maximum(count, 1.0)
        return mean, jnp.maximum(jnp.sqrt(jnp.maximum(squares / jnp.maximum(count, 1.0) - mean**2, 0.0)), SMALLEST_STD)


@dataclasses.dataclass(frozen=True, eq=False)
class Pretrain:
    """The functions that the low level's training is made of, all pure: vmap them over seeds or hyperparameters.

    initial(key, hyper) -> state; policy(state) -> LowLevel; epoch(state, number, hyper) -> (state, metrics), which is `learn` after `run`:
    run(low_level, key, explores, hyper) -> (rows, metrics), one episode in each environment, to learn from or (explores False) to measure;
    learn(state, rows, number, hyper) -> (state, metrics).
    """

    config: PretrainConfig
    env: TargetReaching
    initial: Callable[[jax.Array, PretrainHyperparameters], PretrainState]
    policy: Callable[[PretrainState], LowLevel]
    run: Callable[[LowLevel, jax.Array, jax.Array, PretrainHyperparameters], tuple[Trajectories, dict[str, jax.Array]]]
    learn: Callable[[PretrainState, Trajectories, jax.Array, PretrainHyperparameters], tuple[PretrainState, dict[str, jax.Array]]]
    epoch: Callable[[PretrainState, jax.Array, PretrainHyperparameters], tuple[PretrainState, dict[str, jax.Array]]]


def make_pretrain(config: PretrainConfig) -> Pretrain:
    """The training program of a low level."""
    robot = environment.make(config.task, FetchConfig(faithful=config.faithful, episode_length=config.episode_length, ends_at_goal=False))
    space = TargetSpace(robot.task)
    env = TargetReaching(robot, space)
    actor, critic = td3.Actor(config.network.hidden, robot.action_size), td3.TwinCritic(config.network.hidden)
    optimizer, length = optax.scale_by_adam(), config.episode_length

    def initial(key, hyper) -> PretrainState:
        keys = jax.random.split(numbered(key, INITIAL, 0))
        inputs, action = jnp.zeros(robot.observation_size + space.size), jnp.zeros(robot.action_size)
        params = {"actor": actor.init(keys[0], inputs), "critic": critic.init(keys[1], inputs, action)}
        moments = jnp.zeros((3, robot.observation_size)).at[0].set(1.0).at[2].set(1.0)
        state = PretrainState(params=params, target_params=params, optimizer_state=optimizer.init(params), moments=moments, buffer=None, key=key)
        example = jax.eval_shape(lambda: run(policy(state), key, True, hyper)[0])
        return state.replace(buffer=replay.empty(example, config.buffer_epochs))

    def policy(state: PretrainState) -> LowLevel:
        mean, std = state.statistics()
        return LowLevel(state.params["actor"], mean, std, config.network.hidden, robot.action_size)

    def run(low_level: LowLevel, key, explores, hyper):
        """With `explores`, all but an eighth act with noise, a share of them under moving targets. Without, nobody does, and the targets of the
        second half move straight ahead to the task's goal. `success_rate`: share of the others that end at their target, of those without noise;
        `success_any`: that were there at any time; `following_rate`: share of the second half that end at the goal.
        """
        reset_key, act_key = jax.random.split(key)
        number, explores = jnp.arange(config.num_envs), jnp.asarray(explores)
        noisy = explores & (number >= config.num_envs // 8)
        moving_share = jnp.where(explores, hyper.moving_share * noisy, number >= config.num_envs // 2)
        begin = jax.vmap(lambda key, share: env.replace(moving_share=share).reset(key))

        def act(observation, target, key):
            best = low_level.act(observation, target)
            return jnp.where(noisy[:, None], td3.explore(key, best, hyper.noise, hyper.random_share), best)

        moving_env = env.replace(random_share=jnp.where(explores, env.random_share, 0.0))
        starts = begin(jax.random.split(reset_key, config.num_envs), moving_share)
        ends, rows = collect(moving_env, starts, act, act_key, length)
        at_target = space.reached(rows.record, rows.goal[:, :1])
        still, led = ~noisy & (moving_share == 0), ~noisy & (moving_share > 0)
        return rows, {
            "success_rate": at_target[:, -1].mean(where=still), "success_any": at_target.any(1).mean(where=still),
            "following_rate": robot.reached(robot.achieved(ends.robot), ends.robot.goal).mean(where=led),
        }

    def draws(buffer: Trajectories, key):
        """Rows and steps of the transitions of all updates of an epoch, and the records achieved later that each may be relabelled with: [U, B]."""
        draw_key, future_key = jax.random.split(key)
        row, step = replay.draw(draw_key, replay.running_count(buffer.valid), config.updates_per_epoch * config.batch_size, length)
        later = her.future_record(future_key, buffer, replay.steps_left(buffer.valid), row, step)
        return jax.tree.map(lambda leaf: leaf.reshape(config.updates_per_epoch, config.batch_size, *leaf.shape[1:]), (row, step, later))

    def update(state: PretrainState, drawn, key, hyper):
        relabel_key, noise_key = jax.random.split(key)
        row, step, later = drawn
        batch = replay.transitions_at(state.buffer, row, step, 1)
        target = her.relabel(relabel_key, batch.goal, later, hyper.relabel_share)
        reward = space.reward(batch.records[:, 0], target)
        inputs, next_inputs = (network_input(o, target, *state.statistics()) for o in (batch.observation, batch.next_observation))
        next_action = td3.smoothed(noise_key, actor.apply(state.target_params["actor"], next_inputs), hyper.target_noise)
        following = critic.apply(state.target_params["critic"], next_inputs, next_action).min(0)
        target_value = jnp.clip(reward + hyper.discount * following, -1.0 / (1.0 - hyper.discount), 0.0)  # No step costs more than 1.

        def loss(params):
            values = critic.apply(params["critic"], inputs, batch.action)
            action = actor.apply(params["actor"], inputs)
            actor_value = critic.apply(jax.lax.stop_gradient(params["critic"]), inputs, action)[0]
            actor_loss = -actor_value.mean() + hyper.action_cost * (action**2).mean()
            return td3.critic_loss(values, target_value, huber=False) + actor_loss, (values.mean(), jnp.abs(values - target_value).mean())

        gradient, (value, error) = jax.grad(loss, has_aux=True)(state.params)
        direction, optimizer_state = optimizer.update(gradient, state.optimizer_state)
        params = jax.tree.map(lambda leaf, by: leaf - hyper.learning_rate * by, state.params, direction)
        target_params = optax.incremental_update(params, state.target_params, hyper.target_rate)
        return state.replace(params=params, target_params=target_params, optimizer_state=optimizer_state), {"value": value, "td_error": error}

    def learn(state: PretrainState, rows: Trajectories, number, hyper):
        seen = rows.observation.reshape(-1, robot.observation_size)
        moments = state.moments + jnp.stack([jnp.full(seen.shape[1], float(len(seen))), seen.sum(0), (seen**2).sum(0)])
        state = state.replace(buffer=replay.add(state.buffer, rows, number), moments=moments)
        draw_key, update_key = jax.random.split(numbered(state.key, UPDATE, number))
        drawn, keys = draws(state.buffer, draw_key), jax.random.split(update_key, config.updates_per_epoch)
        state, metrics = jax.lax.scan(lambda carry, step: update(carry, *step, hyper), state, (drawn, keys))
        return state, jax.tree.map(jnp.mean, metrics) | {"env_steps": rows.valid.sum()}

    def epoch(state: PretrainState, number, hyper):
        rows, success = run(policy(state), numbered(state.key, COLLECT, number), True, hyper)
        state, metrics = learn(state, rows, number, hyper)
        return state, metrics | {name: success[name] for name in ("success_rate", "success_any")}

    return Pretrain(config, env, initial, policy, run, learn, epoch)


def numbered(key: jax.Array, purpose: int, number: jax.Array) -> jax.Array:
    """A seed's key for a purpose (`COLLECT`, `UPDATE`, `EVALUATE`) and the number of an epoch or of a round of evaluation, neither batched."""
    return jax.random.fold_in(jax.random.fold_in(key, purpose), number)
