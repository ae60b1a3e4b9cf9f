"""What a run is made of: `TrainConfig` (static: names, sizes, switches) and `Hyperparameters` (floats, never static).

`[P]` marks a value of the paper, `[A]` one of its authors' code, `[M]` one measured for this project (docs/object_search.md).
Each part of the program (environment, learner, agent) declares its own configuration beside its code; `TrainConfig` holds one of each.
"""

import dataclasses
import json
import math
from typing import Any, Literal

import flax.struct

from infogoal_jax.errors import UserError, require

KnownGoals = Literal["train", "visited", "all"]


@flax.struct.dataclass
class Hyperparameters:
    """Floats that every compiled program takes as an argument: sweep them with `jax.vmap`, change them without compiling again."""

    learning_rate: float = 1e-3
    """Step of Adam, for every network [A]. Greater than 0."""
    discount: float = 0.95
    """Discount of one environment step, in [0, 1)."""
    epsilon: float = 0.2
    """Share of random actions while collecting, in [0, 1]."""
    noise: float = 0.2
    """Standard deviation of the noise on continuous actions while collecting: 3 cm of the subgoal's 15. 0 or more."""
    target_noise: float = 0.2
    """Standard deviation of the noise on the actions that TD3's targets are made from. 0 or more."""
    adjacency_weight: float = 20.0
    """Weight of HRAC's penalty for subgoals that cannot be reached in time. 0 or more."""
    test_epsilon: float = 0.0
    """Share of random actions in evaluation, in [0, 1]. Choose it on training goals only."""
    conservative_weight: float = 1.0
    """Weight of CQL's penalty on the values of moves that were not recorded. 0 or more."""
    target_rate: float = 0.01
    """Share by which the target network follows at each update, in (0, 1]."""
    max_gradient_norm: float = 10.0
    """Gradients are scaled down to this global norm. Greater than 0."""
    learner_weight: float = 1.0
    """Weight of the goal-representation loss beside the loss of the agent [A]."""
    intrinsic_weight: float = 5.0
    """Intrinsic reward of a whole episode spent at the mean distance from the goal, in successes; 0 turns it off."""
    explorer_weight: float = 0.01
    """Weight of an explorer's loss beside the loss of the agent: it shapes the state encoder of both [M]. 0 or more."""
    bonus_weight: float = 0.05
    """Weight of an explorer's bonus beside the environment's reward; its discounted sums have a standard deviation of 1. 0 or more."""
    beta_start: float = 0.0
    """First value of the Lagrange multiplier beta, in [0, 1]."""
    beta_step: float = 2.5e-4
    """rho of Eq. 15, for the linear rule only; the step of the authors' sign rule is always 1e-5. 0 holds beta still."""
    beta_threshold: float = 0.96
    """alpha of Eq. 15: the accuracy above which beta grows [A], in (0, 1)."""
    fixed_beta: float = 0.01
    """Where InfoGoal's beta ramps to, by 1e-5 an update [A], under `--learner.beta-rule fixed`; InfoBot's beta from the start. In [0, 1]."""

    def check(self) -> None:
        """Raise `UserError` for a value out of its range. Called on Python floats only, never on traced values."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            require(isinstance(value, int | float) and math.isfinite(value), f"hyper.{field.name}", value, "give a finite number")
        for name in ("learning_rate", "max_gradient_norm"):
            require(getattr(self, name) > 0, f"hyper.{name}", getattr(self, name), "give a number greater than 0")
        for name in ("learner_weight", "intrinsic_weight", "explorer_weight", "bonus_weight", "beta_step", "noise", "target_noise",
                     "adjacency_weight", "conservative_weight"):
            require(getattr(self, name) >= 0, f"hyper.{name}", getattr(self, name), "give 0 or more")
        for name in ("epsilon", "test_epsilon", "beta_start", "fixed_beta"):
            require(0 <= getattr(self, name) <= 1, f"hyper.{name}", getattr(self, name), "give a number from 0 to 1")
        require(0 <= self.discount < 1, "hyper.discount", self.discount, "give a number from 0 to below 1, for example 0.95")
        require(0 < self.target_rate <= 1, "hyper.target_rate", self.target_rate, "give a number above 0, at most 1, for example 0.01")
        require(0 < self.beta_threshold < 1, "hyper.beta_threshold", self.beta_threshold, "give an accuracy between 0 and 1, for example 0.96")


@dataclasses.dataclass(frozen=True)
class StateEncoderConfig:
    """Sizes of psi(s), the encoder of image observations, trained by the agent's loss."""

    patch: int = 8
    """Side of the square patches that an image is cut into, in pixels; must divide the image's side."""
    channels: int = 32
    """Numbers that each patch is reduced to."""
    features: int = 256
    """Size of the state's code [M]."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            require(value > 0, f"state_encoder.{field.name}", value, "give a whole number greater than 0")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the compiled program. Make one with `presets.load`, change it with `dataclasses.replace`."""

    task: str
    """Name of the environment, see `infogoal_jax.envs.registry`."""
    method: str
    """Name of the goal-representation learner, see `infogoal_jax.learners.registry`; `none` is the bare agent."""
    algorithm: str
    """Name of the reinforcement-learning agent, see `infogoal_jax.agents.registry`."""
    relabelling: str
    """Name of the relabelling in hindsight, see `infogoal_jax.hindsight.registry`; `none` keeps the goals."""
    env: Any
    """Configuration of the environment (dataset, episode length, ...)."""
    learner: Any
    """Configuration of the goal-representation learner."""
    agent: Any
    """Configuration of the reinforcement-learning agent."""
    hindsight: Any
    """Configuration of the relabelling."""
    exploration: str
    """Name of the explorer, see `infogoal_jax.exploration.registry`; `none` leaves the state encoder and the reward alone."""
    explorer: Any
    """Configuration of the explorer."""
    state_encoder: StateEncoderConfig = dataclasses.field(default_factory=StateEncoderConfig)
    """Configuration of the encoder of image observations."""
    hyper: Hyperparameters = dataclasses.field(default_factory=Hyperparameters)
    """Default values of the compiled program's arguments."""
    num_epochs: int = 120
    """Epochs: each collects, then updates."""
    epochs_per_evaluation: int = 10
    """Epochs between two evaluations; a chunk of the host loop. Must divide `num_epochs`."""
    num_envs: int = 32
    """Environments stepped side by side."""
    rollout_steps: int = 100
    """Steps of each environment in an epoch."""
    updates_per_epoch: int = 100
    """Gradient updates in an epoch [P]."""
    batch_size: int = 256
    """Transitions in an update."""
    buffer_steps: int = 100_000
    """Environment steps that the replay buffer holds, rounded up to whole epochs."""
    known_goals: KnownGoals = "visited"
    """Goals that may enter representation learning: training goals, goals achieved so far, or all. One protocol for every method."""
    training_corruption: float = 0.0
    """Weight of the backgrounds that goal images are corrupted with while training, in [0, 1); 0: they are clean."""
    test_corruption: float = 0.4
    """Weight of the backgrounds in the evaluation on corrupted goal images [P], in [0, 1]."""
    stop_encoder_gradient: bool = False
    """Keep the gradient of the agent's loss from reaching the goal encoder (the paper lets it through)."""
    evaluation_starts: int = 10
    """Start states tried for each goal in an evaluation."""

    def __post_init__(self):
        for name in ("num_epochs", "epochs_per_evaluation", "num_envs", "rollout_steps", "updates_per_epoch", "batch_size",
                     "buffer_steps", "evaluation_starts"):
            value = getattr(self, name)
            require(isinstance(value, int) and not isinstance(value, bool) and value > 0, name, value, "give a whole number greater than 0")
        if self.num_epochs % self.epochs_per_evaluation:
            nearest = max(1, round(self.num_epochs / self.epochs_per_evaluation)) * self.epochs_per_evaluation
            raise UserError(f"num_epochs = {self.num_epochs}: must be a multiple of epochs_per_evaluation = "
                            f"{self.epochs_per_evaluation}; give {nearest}, or another epochs_per_evaluation")
        require(self.buffer_steps >= self.num_envs * self.rollout_steps, "buffer_steps", self.buffer_steps,
                f"must hold at least one epoch: num_envs x rollout_steps = {self.num_envs * self.rollout_steps}")
        require(self.known_goals in ("train", "visited", "all"), "known_goals", self.known_goals, "give train, visited or all")
        require(0 <= self.training_corruption < 1, "training_corruption", self.training_corruption, "give a weight from 0 to below 1")
        require(0 <= self.test_corruption <= 1, "test_corruption", self.test_corruption, "give a weight from 0 to 1, for example 0.4")
        if isinstance(self.hyper.learning_rate, int | float):
            self.hyper.check()
        for part in (self.state_encoder, self.env, self.learner, self.agent, self.hindsight, self.explorer):
            part.check(self)

    @property
    def num_evaluations(self) -> int:
        """Evaluations in a run, one after every `epochs_per_evaluation` epochs."""
        return self.num_epochs // self.epochs_per_evaluation

    @property
    def buffer_epochs(self) -> int:
        """Epochs that the replay buffer holds."""
        return -(-self.buffer_steps // (self.num_envs * self.rollout_steps))


def to_json(config: TrainConfig) -> str:
    """The resolved configuration as indented JSON, as it is saved with each run."""
    return json.dumps(dataclasses.asdict(config), indent=2, sort_keys=True)
