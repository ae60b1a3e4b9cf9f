"""What a preset is: the tuned configuration of a task, with what each method changes in it.

`[P]` marks a value of the paper, `[A]` one of its authors' code, `[M]` one measured for this project, `[T]` one that
`infogoal tune` found to be better on validation goals, by the rule of docs/research/tuning.md.
"""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Changes:
    """What a method changes in the preset of a task.

    learner: fields of its configuration.
    all_goals: fields of an agent that learns from all goals at once.
    hyper: float hyperparameters by dotted name, "learner.beta".
    training: fields of `TrainConfig`.
    """

    learner: dict[str, Any] = dataclasses.field(default_factory=dict)
    all_goals: dict[str, Any] = dataclasses.field(default_factory=dict)
    hyper: dict[str, float] = dataclasses.field(default_factory=dict)
    training: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Preset:
    """The tuned configuration of a task.

    agent, relabelling: names of the task's own.
    env: fields of the environment that training sets.
    learner: fields of every learner that has them.
    state_encoder: fields of the state encoder.
    agents, relabellings: fields of an agent and of a relabelling by their names.
    all_goals: fields of an agent that learns from all goals at once (`agents/all_goals.py`).
    hyper, training: as in `Changes`, for every method.
    methods: what each method changes, or learner, or learner with a relabelling (`infobot+her`) or with an agent that
      learns from all goals at once (`infobot+all_goals`).
    description: the task in a line, for the help of the command line.
    small: the preset of first trials; None: the task has none.
    """

    agent: str
    training: dict[str, Any]
    hyper: dict[str, float]
    methods: dict[str, Changes]
    relabelling: str = "none"
    description: str = ""
    env: dict[str, Any] = dataclasses.field(default_factory=dict)
    learner: dict[str, Any] = dataclasses.field(default_factory=dict)
    state_encoder: dict[str, int] = dataclasses.field(default_factory=dict)
    agents: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    relabellings: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    all_goals: dict[str, Any] = dataclasses.field(default_factory=dict)
    small: "Preset | None" = None

    def changes_of(self, method: str) -> Changes:
        """What this method changes."""
        return self.methods.get(method, Changes())


INFOBOT = {"intrinsic_weight": 1.0, "learner.beta": 3e-5}
"""InfoBot's floats: the authors' beta of 0.01 stands beside rewards of 10, squared [M]."""
MEAN = {"code": "mean"}
"""On object search the all-goals head learns less under the noise of InfoGoal's codes [M],
docs/research/all_goals.md."""
