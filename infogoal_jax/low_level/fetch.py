"""The low level of the Fetch robot: TD3 with hindsight relabelling on target states.

An eighth of the environments act without noise: their success is the learning curve, and costs no episode of its own.
The others explore, half of them under targets that move as the high level will move them: without those it takes twice
as long (docs/reference/low_level.md).
"""

import dataclasses
from typing import Annotated, Any

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import replay
from infogoal_jax.agents import td3
from infogoal_jax.agents.hrac import SMALLEST_STD, LowLevel, LowLevelConfig, network_input
from infogoal_jax.envs.fetch import environment
from infogoal_jax.envs.fetch.targets import TargetReaching, TargetSpace
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.errors import nearest, require
from infogoal_jax.field_types import LARGEST_WHOLE
from infogoal_jax.hyperparameters import Number
from infogoal_jax.low_level.trainer import INITIAL, UPDATE, PretrainConfig, TargetAgent
from infogoal_jax.relabelling import her
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.parts import numbered
from infogoal_jax.train.rollout import collect

PRESETS: dict[str, dict[str, Any]] = {
    "fetch_reach": {
        "num_envs": 128,
        "num_epochs": 20,
        "updates_per_epoch": 200,
        "batch_size": 256,
        "network": LowLevelConfig((128, 128)),
    },
    "fetch_push": {},
    "fetch_pick_and_place": {},
}
"""What each task needs away from the defaults [M]. fetch_slide has no low level: its goals lie where the gripper cannot
follow."""


@flax.struct.dataclass
class FetchHyperparameters:
    """Floats of the low level's training: an argument of the compiled program.

    [HER]: Andrychowicz et al. 2017 in OpenAI's baselines; [RL-Zoo]: the tuned values of rl-zoo3 for Fetch; [M]:
    measured for this project.
    """

    learning_rate: Annotated[float, Number("(0, 1]")] = 1e-3
    """Step of Adam [HER]."""
    discount: Annotated[float, Number("[0, 1)")] = 0.95
    """Discount of a step [RL-Zoo]."""
    target_rate: Annotated[float, Number("(0, 1]")] = 0.05
    """Share by which target networks follow at each update [RL-Zoo]."""
    noise: Annotated[float, Number("[0, inf)")] = 0.2
    """Standard deviation of the noise on actions while collecting [HER]."""
    random_share: Annotated[float, Number("[0, 1]")] = 0.3
    """Share of random actions while collecting [HER]."""
    target_noise: Annotated[float, Number("[0, inf)")] = 0.1
    """Standard deviation of the noise on target actions (TD3's own is 0.2)."""
    action_cost: Annotated[float, Number("[0, inf)")] = 1.0
    """Weight of the squared action in the actor's loss [HER]."""
    relabel_share: Annotated[float, Number("[0, 1]")] = 0.8
    """Share of transitions whose target is one that was achieved later in the episode [HER]."""
    moving_share: Annotated[float, Number("[0, 1]")] = 0.5
    """Share of the noisy episodes with a moving target, as the high level will give it [M]."""


@dataclasses.dataclass(frozen=True)
class FetchPretrainConfig(PretrainConfig):
    """Train the low level of a Fetch task. An eighth of the environments acts without noise."""

    buffer_epochs: int = 20
    """Epochs that the replay buffer holds."""
    episode_length: int = 50
    """Steps of 40 ms in an episode, always run to its end."""
    faithful: bool = False
    """Simulate as finely as the reference does (docs/reference/fetch.md)."""
    hyper: FetchHyperparameters = dataclasses.field(default_factory=FetchHyperparameters)
    """Default values of the compiled program's arguments."""

    def __post_init__(self):
        super().__post_init__()
        require(
            self.task in PRESETS,
            "task",
            self.task,
            f"no low level can be trained for it.{nearest(self.task, list(PRESETS))} Known: {', '.join(PRESETS)}",
        )
        require(self.num_envs >= 8, "num_envs", self.num_envs, "give at least 8: an eighth of them measure success")
        require(
            self.num_envs * self.buffer_epochs * self.episode_length <= LARGEST_WHOLE,
            "num_envs * buffer_epochs * episode_length",
            self.num_envs * self.buffer_epochs * self.episode_length,
            f"the replay buffer holds so many transitions; give at most {LARGEST_WHOLE} together",
        )


@flax.struct.dataclass
class Experience:
    """moments: float32 [3, D], count, sum and sum of squares of all observations so far; buffer: the last epochs."""

    moments: jax.Array
    buffer: Trajectories

    def statistics(self) -> tuple[jax.Array, jax.Array]:
        """Mean and standard deviation [D] that observations are normalised with."""
        count, total, squares = self.moments
        mean = total / jnp.maximum(count, 1.0)
        return mean, jnp.maximum(jnp.sqrt(jnp.maximum(squares / jnp.maximum(count, 1.0) - mean**2, 0.0)), SMALLEST_STD)


def make(config: FetchPretrainConfig) -> TargetAgent:
    """The agent that learns a Fetch task's target states."""
    robot = environment.make(
        config.task, FetchConfig(faithful=config.faithful, episode_length=config.episode_length, ends_at_goal=False)
    )
    space = TargetSpace(robot.task)
    env = TargetReaching(robot, space)
    actor, critic = td3.Actor(config.network.hidden, robot.action_size), td3.TwinCritic(config.network.hidden)

    def initial(key, hyper):
        keys = jax.random.split(numbered(key, INITIAL, 0))
        inputs, action = (
            jnp.zeros(robot.observation_size + space.size, jnp.float32),
            jnp.zeros(robot.action_size, jnp.float32),
        )
        params = {"actor": actor.init(keys[0], inputs), "critic": critic.init(keys[1], inputs, action)}
        experience = Experience(
            moments=jnp.zeros((3, robot.observation_size), jnp.float32).at[0].set(1.0).at[2].set(1.0), buffer=None
        )
        example = jax.eval_shape(lambda: run(policy(params, experience), key, True, hyper)[0])
        return params, experience.replace(buffer=replay.empty(example, config.buffer_epochs))

    def policy(params, experience: Experience) -> LowLevel:
        return LowLevel(params["actor"], *experience.statistics(), config.network.hidden, robot.action_size)

    def run(low_level: LowLevel, key, explores, hyper):
        """With `explores`, all but an eighth act with noise, a share of them under moving targets. Without, nobody
        does, and the targets of the second half move straight ahead to the task's goal. `success_rate`: share of the
        others that end at their target, of those without noise;
        `success_any`: that were there at any time; `following_rate`: share of the second half that end at the goal.
        """
        reset_key, act_key = jax.random.split(key)
        number, explores = jnp.arange(config.num_envs, dtype=jnp.int32), jnp.asarray(explores)
        noisy = explores & (number >= config.num_envs // 8)
        moving_share = jnp.where(explores, hyper.moving_share * noisy, number >= config.num_envs // 2)
        begin = jax.vmap(lambda key, share: env.replace(moving_share=share).reset(key))

        def act(observation, target, key):
            best = low_level.act(observation, target)
            return jnp.where(noisy[:, None], td3.explore(key, best, hyper.noise, hyper.random_share), best)

        moving_env = env.replace(random_share=jnp.where(explores, env.random_share, 0.0))
        starts = begin(jax.random.split(reset_key, config.num_envs), moving_share)
        ends, rows = collect(moving_env, starts, act, act_key, config.episode_length)
        at_target = space.reached(rows.record, rows.goal[:, :1])
        still, led = ~noisy & (moving_share == 0), ~noisy & (moving_share > 0)
        return rows, {
            "env_steps": rows.valid.sum(dtype=jnp.int32),
            "success_rate": at_target[:, -1].mean(where=still, dtype=jnp.float32),
            "success_any": at_target.any(1).mean(where=still, dtype=jnp.float32),
            "following_rate": robot.reached(robot.achieved(ends.robot), ends.robot.goal).mean(
                where=led, dtype=jnp.float32
            ),
        }

    def remember(experience: Experience, rows: Trajectories, number) -> Experience:
        seen = rows.observation.reshape(-1, robot.observation_size)
        moments = experience.moments + jnp.stack(
            [jnp.full(seen.shape[1], float(len(seen)), jnp.float32), seen.sum(0), (seen**2).sum(0)]
        )
        return Experience(moments, replay.add(experience.buffer, rows, number))

    def draw(experience: Experience, key, number, hyper):
        """Rows and steps of transitions, and the records achieved later that each may be relabelled with: [U, B]."""
        buffer, num_updates = experience.buffer, config.updates_per_epoch
        draw_key, update_key = jax.random.split(numbered(key, UPDATE, number))
        place_key, future_key = jax.random.split(draw_key)
        row, step = replay.draw(
            place_key, replay.running_count(buffer.valid), num_updates * config.batch_size, config.episode_length
        )
        later = her.future_record(future_key, buffer, replay.steps_left(buffer.valid), row, step)
        batches = jax.tree.map(
            lambda leaf: leaf.reshape(num_updates, config.batch_size, *leaf.shape[1:]), (row, step, later)
        )
        return batches, jax.random.split(update_key, num_updates)

    def loss(params, target_params, experience: Experience, drawn, key, hyper):
        """TD3's losses under relabelled targets, and what the actor's actions cost."""
        relabel_key, noise_key = jax.random.split(key)
        row, step, later = drawn
        batch = replay.transitions_at(experience.buffer, row, step, 1)
        target = her.relabel(relabel_key, batch.goal, later, hyper.relabel_share)
        reward = space.reward(batch.records[:, 0], target)
        inputs, next_inputs = (
            network_input(seen, target, *experience.statistics())
            for seen in (batch.observation, batch.next_observation)
        )
        following = td3.next_value(noise_key, actor, critic, target_params, next_inputs, hyper.target_noise)
        # No step costs more than 1.
        value = jnp.clip(reward + hyper.discount * following, -1.0 / (1.0 - hyper.discount), 0.0)
        learned = td3.losses(actor, critic, params, inputs, batch.action, value, huber=False)
        return learned.critic + learned.actor + hyper.action_cost * (learned.actions**2).mean(), learned.metrics

    return TargetAgent(
        config,
        initial,
        policy,
        run,
        remember,
        draw,
        loss,
        learning_rate=lambda hyper, update: hyper.learning_rate,
        key=numbered,
        curve=("env_steps", "success_rate", "success_any", "value", "td_error"),
        measured=("following_rate", "success_any", "success_rate"),
        compared=("success_rate", "following_rate"),
        describe=lambda report: (
            f"target states {report['success_rate']:.4f}, moving ahead to the goal {report['following_rate']:.4f}"
        ),
        header={},
        num_measured=config.num_envs // 2,  # Half of the episodes have targets that stay.
    )
