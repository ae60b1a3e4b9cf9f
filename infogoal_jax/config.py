"""What a run is made of: `TrainConfig` (static: names, sizes, switches) and `Hyperparameters` (floats, never static).

`[P]` marks a value of the paper, `[A]` one of its authors' code, `[M]` one measured for this project
(docs/reference/object_search.md). Each part of the program (environment, learner, agent, relabelling, explorer)
declares its configuration and its floats beside its code; `TrainConfig` and `Hyperparameters` hold one of each and know
none of them.
"""

import dataclasses
import reprlib
from typing import Annotated, Any, Literal

import flax.struct

from infogoal_jax import hyperparameters
from infogoal_jax.errors import UserError, require
from infogoal_jax.field_types import LARGEST_WHOLE, Count, Size, Within, checked, checked_value, hints_of
from infogoal_jax.hyperparameters import NoHyperparameters, Number, Search

PARTS = ("env", "learner", "agent", "relabelling", "explorer", "state_encoder")
"""Fields of `TrainConfig` that hold the configuration of a part. Its fields declare what they may be
(`field_types.Within`); what depends on other fields is looked at by its method `check(config)`, where it has one."""
KnownGoals = Literal["train", "held_out", "visited", "all"]


@flax.struct.dataclass
class Hyperparameters:
    """Floats that every compiled program takes as an argument, and those of its parts."""

    learning_rate: Annotated[float, Number("(0, inf)", Search(1e-4, 3e-3, "log"))] = 1e-3
    """Learning rate of Adam, for every network [A]."""
    discount: Annotated[float, Number("[0, 1)", Search(0.9, 0.995, "log of 1 - x"))] = 0.95
    """Discount of one environment step."""
    epsilon: Annotated[float, Number("[0, 1]", Search(0.05, 0.5, "linear", always=False))] = 0.2
    """Probability of a random action while collecting."""
    test_epsilon: Annotated[float, Number("[0, 1]")] = 0.0
    """Probability of a random action in evaluation. Choose it on training goals only."""
    noise: Annotated[float, Number("[0, inf)", Search(0.05, 0.5, "linear", always=False))] = 0.2
    """Standard deviation of the noise on continuous actions while collecting; 0.2 is 3 cm of a subgoal's 15 cm."""
    target_rate: Annotated[float, Number("(0, 1]", Search(0.005, 0.1, "log"))] = 0.01
    """Share by which the target networks move towards the trained networks in each update."""
    max_gradient_norm: Annotated[float, Number("(0, inf)")] = 10.0
    """Gradients are scaled down to this global norm."""
    learner_weight: Annotated[float, Number("[0, inf)", Search(0.01, 10.0, "log", is_term=True))] = 1.0
    """Weight of the goal-representation loss beside the loss of the agent [A]; searched from where it acts;
    docs/research/tuning.md names the exceptions."""
    intrinsic_weight: Annotated[float, Number("[0, inf)", Search(0.1, 10.0, "log", is_term=True))] = 5.0
    """Weight of the intrinsic reward: that of an episode spent at the mean distance from the goal, in successes; 0
    turns it off."""
    explorer_weight: Annotated[float, Number("[0, inf)")] = 0.01
    """Weight of an explorer's loss beside the loss of the agent: it shapes the state encoder of both [M]."""
    bonus_weight: Annotated[float, Number("[0, inf)", Search(0.005, 0.5, "log", is_term=True))] = 0.05
    """Weight of an explorer's bonus beside the environment's reward; its discounted sums have a standard deviation of
    1."""
    learner: Any = NoHyperparameters()
    """Float hyperparameters of the learner."""
    agent: Any = NoHyperparameters()
    """Float hyperparameters of the agent."""


@dataclasses.dataclass(frozen=True)
class StateEncoderConfig:
    """Sizes of psi(s), the encoder of image observations, trained by the agent's loss."""

    patch: Size = 8
    """Side of the square patches that an image is cut into, in pixels; must divide the image's side."""
    channels: Size = 32
    """Numbers that each patch is reduced to."""
    features: Count = 256
    """Size of the state's code [M]; 0: the agent sees vectors as they are."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the compiled program. Make one with `presets.load`, change it with
    `dataclasses.replace`."""

    task: str
    """Name of the environment, see `infogoal_jax.envs.registry`."""
    env: Any
    """Configuration of the environment (dataset, episode length, ...)."""
    learner: Any
    """Configuration of the goal-representation learner; its type says which learner it is
    (`infogoal_jax.learners.registry`)."""
    agent: Any
    """Configuration of the reinforcement-learning agent (`infogoal_jax.agents.registry`)."""
    relabelling: Any
    """Configuration of the relabelling of goals (`infogoal_jax.relabelling.registry`)."""
    explorer: Any
    """Configuration of the explorer (`infogoal_jax.exploration.registry`)."""
    state_encoder: StateEncoderConfig = dataclasses.field(default_factory=StateEncoderConfig)
    """Configuration of the encoder of image observations."""
    hyper: Hyperparameters = dataclasses.field(default_factory=Hyperparameters)
    """Float hyperparameters: default values of arguments of the compiled program."""
    num_epochs: Size = 120
    """Epochs: each collects, then updates."""
    epochs_per_evaluation: Size = 10
    """Epochs between two evaluations; a chunk of the host loop. Must divide `num_epochs`."""
    num_envs: Size = 32
    """Environments stepped side by side."""
    rollout_steps: Size = 100
    """Steps of each environment in an epoch."""
    updates_per_epoch: Size = 100
    """Gradient updates in an epoch [P]."""
    batch_size: Size = 256
    """Transitions in an update."""
    buffer_steps: Size = 100_000
    """Environment steps that the replay buffer holds; rounded up to whole epochs."""
    known_goals: KnownGoals = "visited"
    """Goals that may enter relabelling and representation learning: training goals; goals achieved so far (`visited`),
    also with validation and test goals held out (`held_out`); or all. One protocol for every method."""
    desired_goals: Literal["training", "all"] = "training"
    """Goals that are desired while a finite task is acted in: training goals; or all of training, validation and tests,
    so that no goal is unseen (a reading of the paper, docs/reference/infogoal.md)."""
    training_corruption: Annotated[float, Within("[0, 1)", "give a weight from 0 to below 1")] = 0.0
    """Weight of the backgrounds on goal images in training, in [0, 1); 0: they are clean."""
    test_corruption: Annotated[float, Within("[0, 1]", "give a weight from 0 to 1, for example 0.4")] = 0.4
    """Weight of the backgrounds in the evaluation on corrupted goals, in [0, 1]; the paper's."""
    stop_encoder_gradient: bool = False
    """Keep the agent's gradient from the goal encoder (the paper lets it through)."""
    bfloat16: bool = False
    """Layers of the networks give each other bfloat16 in updates; parameters, their moments and losses stay float32.
    For goals that are images and many seeds on a GPU (docs/research/speed.md)."""
    evaluation_starts: Size = 10
    """Start states for each goal in an evaluation."""

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value, of_part = getattr(self, field.name), field.name in PARTS
            if of_part and (isinstance(value, type) or not dataclasses.is_dataclass(value)):
                remedy = "give a configuration, see presets.load; one of your own is a dataclass"
                raise UserError(f"{field.name} = {reprlib.repr(value)}: {remedy}")
            if field.name == "hyper":
                new = hyperparameters.checked(value)
            elif of_part:
                new = checked(value, f"{field.name}.")
            else:
                new = checked_value(value, hints_of(TrainConfig)[field.name], field.name)
            object.__setattr__(self, field.name, new)
        if self.num_epochs % self.epochs_per_evaluation:
            nearest = max(1, round(self.num_epochs / self.epochs_per_evaluation)) * self.epochs_per_evaluation
            raise UserError(
                f"num_epochs = {self.num_epochs}: must be a multiple of epochs_per_evaluation = "
                f"{self.epochs_per_evaluation}; give {nearest}, or another epochs_per_evaluation"
            )
        require(
            self.buffer_steps >= self.num_envs * self.rollout_steps,
            "buffer_steps",
            self.buffer_steps,
            f"must hold at least one epoch: num_envs x rollout_steps = {self.num_envs * self.rollout_steps}",
        )
        require(
            self.desired_goals == "training" or self.known_goals in ("visited", "all"),
            "desired_goals",
            self.desired_goals,
            f"known_goals = {self.known_goals} keeps test goals out of training: give training, or known_goals visited",
        )
        positions = self.buffer_epochs * self.num_envs * (self.rollout_steps + 1)
        require(
            positions <= LARGEST_WHOLE,
            "buffer_steps",
            self.buffer_steps,
            f"is {positions} places with whole epochs and their last observations; give at most {LARGEST_WHOLE}",
        )
        for part in (self.env, self.learner, self.agent, self.relabelling, self.explorer):
            if hasattr(part, "check"):
                part.check(self)

    @property
    def num_evaluations(self) -> int:
        """Evaluations in a run, one after every `epochs_per_evaluation` epochs."""
        return self.num_epochs // self.epochs_per_evaluation

    @property
    def buffer_epochs(self) -> int:
        """Epochs that the replay buffer holds."""
        return -(-self.buffer_steps // (self.num_envs * self.rollout_steps))
