"""Environments of brax, MuJoCo Playground, JaxGCRL and Gymnasium, and datasets of OGBench, by their names: `infogoal
train --env brax:reacher`. A task of each library, whose configuration has the id, so that a run remembers it.
`presets/loading.py` registers such a task when it is asked for."""

import dataclasses
import os
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar

from infogoal_jax.data.episodes import holds_moves
from infogoal_jax.envs import adapters, live
from infogoal_jax.envs.adapters import AdaptedTask
from infogoal_jax.envs.environment import Traits
from infogoal_jax.envs.goal_task import GoalTask, GoalTaskConfig, traits
from infogoal_jax.envs.recordings import from_recordings, naming_field, recorded_in
from infogoal_jax.errors import nearest, renamed, require
from infogoal_jax.field_types import LARGEST_WHOLE, Size, Within
from infogoal_jax.files import expanded
from infogoal_jax.registry import Entry

FLAGS = "--env.goal 4 5 --env.achieved 0 1 --env.radius 0.1"


@dataclasses.dataclass(frozen=True)
class LibraryConfig(GoalTaskConfig):
    """Which environment of another library."""

    id: str = ""
    """Of the environment, as its library has it."""
    episode_length: Size = 1000
    """Steps of an episode; at most those of the environment's own time limit, where it has one."""
    radius: Annotated[float, Within("[0, inf)", "give a distance above 0, or 0 for the environment's own")] = 0.0
    """Distance below which a goal is reached; 0: the environment's own."""


@dataclasses.dataclass(frozen=True)
class NamedConfig(LibraryConfig):
    """Which environment, and where its goal stands in the flattened observation."""

    goal: tuple[int, ...] = ()
    """Places of the goal that the environment draws; empty: those that are known for it."""
    achieved: tuple[int, ...] = ()
    """Places of the goal that is achieved; with `goal`."""
    hidden: tuple[int, ...] = ()
    """Further places that tell of the goal; with `goal`."""

    def check(self, config) -> None:
        """Raise `UserError` for places that go with a goal alone."""
        require(bool(self.goal) == bool(self.achieved), "env.achieved", self.achieved, "goes with --env.goal")
        require(bool(self.goal) or not self.hidden, "env.hidden", self.hidden, "goes with --env.goal")


class BraxConfig(NamedConfig):
    """As `NamedConfig`, of brax."""


class PlaygroundConfig(NamedConfig):
    """As `NamedConfig`, of MuJoCo Playground."""


class JaxGCRLConfig(NamedConfig):
    """As `NamedConfig`, of JaxGCRL, whose episodes go on at the goal."""


class GymnasiumConfig(LibraryConfig):
    """As `LibraryConfig`, of Gymnasium, where a goal is known as one."""


@dataclasses.dataclass(frozen=True)
class OGBenchConfig:
    """Which recorded episodes of OGBench's kind. Nobody acts: success is measured elsewhere."""

    id: str = ""
    """Name of one of its datasets, which OGBench has downloaded."""
    dataset: str = ""
    """File of recorded episodes in its place (docs/reference/datasets.md)."""
    episode_length: ClassVar[int] = LARGEST_WHOLE
    """That of the recordings is known once they are read: nothing is too long for it before."""


BRAX = {
    "reacher": {
        "goal": [4, 5],
        "hidden": [8, 9, 10],
        "achieved": lambda state: state.obs[4:6] + state.obs[8:10],
        "radius": 0.02,
    }
}
"""The environments of brax that draw a goal, here a tip's target: arguments of `from_brax`. That of the pusher never
changes."""


def reach(env: Any) -> dict[str, Any]:
    """The finger of Playground's reacher has to come to the target."""
    model = env.mj_model
    finger, target = (model.geom(name).id for name in ("finger", "target"))
    body = model.body("target").mocapid[0]
    return {
        "goal": lambda state: state.data.mocap_pos[body, :2],  # Its geometry follows with the first step alone.
        "achieved": lambda state: state.data.geom_xpos[finger, :2],
        "hidden": slice(model.nq, -model.nv),
        "radius": float(model.geom_size[[finger, target], 0].sum()),
    }


PLAYGROUND = {"ReacherEasy": reach, "ReacherHard": reach}
"""The environments of Playground whose goal is known here: functions of the environment to arguments of `from_brax`."""


def arguments_of(task: str, config: NamedConfig, known: dict[str, Any] | None) -> dict[str, Any]:
    """What `from_brax` is told: the places that are given, or what is known of the environment."""
    told = {"episode_length": config.episode_length, "ends_at_goal": config.ends_at_goal}
    if config.radius:
        told["radius"] = config.radius
    if config.goal:
        require(config.radius > 0, "env.radius", config.radius, f"goes with --env.goal; give {FLAGS}")
        return told | {"goal": list(config.goal), "achieved": list(config.achieved), "hidden": list(config.hidden)}
    remedy = f"no goal of {task}:{config.id} is known; name places of its observation, as {FLAGS}"
    require(known is not None, "env.goal", config.goal, remedy)
    return known | told


def make_brax(config: BraxConfig) -> AdaptedTask:
    brax = adapters.imported("brax.envs", "pip install brax")
    names = sorted(brax._envs)
    require(config.id in names, "env.id", config.id, f"brax has no such environment.{nearest(config.id, names)}")
    told = arguments_of("brax", config, BRAX.get(config.id))
    made = adapters.made_quietly("env.id", lambda: brax.get_environment(config.id))
    return adapters.from_brax(made, **told, source=f"{config.id} of brax, simulated")


def make_playground(config: PlaygroundConfig) -> AdaptedTask:
    """The environment of Playground, simulated by MJX."""
    env = adapters.playground_environment(config.id, {})
    known = PLAYGROUND[config.id](env) if config.id in PLAYGROUND and not config.goal else None
    source = f"{config.id} of MuJoCo Playground, simulated"
    return adapters.from_brax(env, **arguments_of("playground", config, known), source=source)


def make_jaxgcrl(config: JaxGCRLConfig) -> AdaptedTask:
    """The environment of JaxGCRL, which knows its goal."""
    return adapters.from_jaxgcrl(config.id, **arguments_of("jaxgcrl", config, {}))


WITHIN = 0.45
"""Of the mazes of Gymnasium-Robotics, which have it in their code alone."""


def make_gymnasium(config: GymnasiumConfig) -> AdaptedTask:
    """The environment of Gymnasium, simulated as it is."""
    name = config.id.rpartition(":")[-1]
    known = WITHIN if name.startswith(("PointMaze_", "AntMaze_")) else None
    told = {"ends_at_goal": config.ends_at_goal, "episode_length": config.episode_length}
    return live.from_gymnasium(config.id, radius=config.radius or known, **told)


def with_recordings(make: Callable[[LibraryConfig], AdaptedTask], config: LibraryConfig) -> AdaptedTask:
    """The task, with what it learns from offline where a file is named. Raises `UserError`, naming the flag, where the
    library has no such environment or the environment no such places."""
    fields = {name: f"env.{name}" for name in ("goal", "achieved", "hidden", "radius", "episode_length")}
    with renamed(make="env.id", name="env.id", env="env.id", **fields):
        task = make(config)
    return recorded_in(task, config.dataset)


DOWNLOADED = "~/.ogbench/data"
"""Where OGBench puts its datasets, unless it is told another folder."""


def file_of(config: OGBenchConfig) -> str:
    """The file of the recordings. Raises `UserError` where none is named, and where OGBench has not downloaded it."""
    require(
        bool(config.id or config.dataset), "env.id", config.id, "name a dataset of OGBench, or give --env.dataset FILE"
    )
    file = config.dataset or str(expanded(f"{DOWNLOADED}/{config.id}.npz"))
    remedy = f"is not in {DOWNLOADED}: ogbench.download_datasets([NAME]) fetches it, or give --env.dataset FILE"
    require(bool(config.dataset) or os.path.exists(file), "env.id", config.id, remedy)
    return file


def traits_of_recordings(config: OGBenchConfig) -> Traits:
    """What the header of the file tells; of no file, that actions are vectors, as all of OGBench's with states are."""
    moves = bool(config.id or config.dataset) and holds_moves(file_of(config))
    return Traits(finite_goals=False, moves=moves, recorded=True, ends_at_goal=True)


def make_ogbench(config: OGBenchConfig) -> GoalTask:
    """Recorded episodes alone."""
    file = file_of(config)
    with naming_field("env.dataset" if config.dataset else "env.id", config.dataset or config.id, file):
        return from_recordings(file)


LIBRARIES = {
    "brax": Entry(BraxConfig, partial(with_recordings, make_brax), traits=traits),
    "playground": Entry(PlaygroundConfig, partial(with_recordings, make_playground), traits=traits),
    "jaxgcrl": Entry(JaxGCRLConfig, partial(with_recordings, make_jaxgcrl), traits=traits),
    "gymnasium": Entry(GymnasiumConfig, partial(with_recordings, make_gymnasium), traits=traits),
    "ogbench": Entry(OGBenchConfig, make_ogbench, traits=traits_of_recordings),
}
"""The task of each library, by its name."""
