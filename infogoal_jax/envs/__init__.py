"""Environments: pytrees of arrays with pure functions over them. `load` makes one by name. A new one is registered in
`registry`."""

from functools import partial
from typing import Any

from infogoal_jax.envs import embodied_qa, goal_task, joint_targets, object_manipulation, object_search, plane
from infogoal_jax.envs.adapters import from_brax as from_brax
from infogoal_jax.envs.adapters import from_jaxgcrl as from_jaxgcrl
from infogoal_jax.envs.adapters import from_playground as from_playground
from infogoal_jax.envs.environment import Traits
from infogoal_jax.envs.fetch.tasks import TASKS as FETCH_TASKS
from infogoal_jax.envs.fetch.tasks import FetchConfig, TargetsConfig
from infogoal_jax.envs.live import from_gymnasium as from_gymnasium
from infogoal_jax.envs.recordings import from_recordings as from_recordings
from infogoal_jax.errors import require
from infogoal_jax.field_types import checked
from infogoal_jax.registry import Entry, Registry


def make_fetch(name: str, config: FetchConfig):
    """Make a Fetch task. MuJoCo is imported here, because it takes half a second and no other task needs it."""
    from infogoal_jax.envs.fetch import environment, image_goals

    if config.goals == "images":
        return image_goals.make(name, config)
    return environment.with_positions(environment.make(name, config), config.held_out)


def fetch_traits(config: FetchConfig) -> Traits:
    images = config.goals == "images"
    return Traits(
        finite_goals=images, image_goals=images, moves=False, target_states=images, ends_at_goal=config.ends_at_goal
    )


def make_fetch_targets(name: str, config: TargetsConfig):
    """Make the target states of a Fetch task, without MuJoCo until then."""
    from infogoal_jax.envs.fetch import targets

    return targets.make(name, config)


def target_traits(config: TargetsConfig) -> Traits:
    return Traits(finite_goals=False, moves=False)


registry = Registry(
    "task",
    {
        "object_search": Entry(object_search.ObjectSearchConfig, object_search.make, traits=object_search.traits),
        "object_manipulation": Entry(
            object_manipulation.ObjectManipulationConfig, object_manipulation.make, traits=object_manipulation.traits
        ),
        "embodied_qa": Entry(embodied_qa.EmbodiedQAConfig, embodied_qa.make, traits=embodied_qa.traits),
        "point_maze": Entry(plane.PlaneConfig, plane.make_maze, traits=goal_task.traits),
        "reacher": Entry(plane.PlaneConfig, plane.make_reacher, traits=goal_task.traits),
        **{name: Entry(FetchConfig, partial(make_fetch, name), traits=fetch_traits) for name in FETCH_TASKS},
        # The same tasks by another name, under which the goals that training and presets mean are positions.
        **{
            f"{name}_positions": Entry(FetchConfig, partial(make_fetch, name), traits=fetch_traits)
            for name in FETCH_TASKS
        },
        # What the low levels of HRAC are trained on. The goals of fetch_slide lie where the gripper cannot follow.
        **{
            f"{name}_targets": Entry(TargetsConfig, partial(make_fetch_targets, name), traits=target_traits)
            for name in FETCH_TASKS
            if name != "fetch_slide"
        },
        "object_manipulation_targets": Entry(
            joint_targets.JointTargetsConfig, joint_targets.make, traits=joint_targets.traits
        ),
    },
)


def load(task: str, config: Any = None):
    """Make the environment of this name: `env.reset(key)`, `env.step(state, action)`, batched by `jax.vmap`.

    config: the configuration of the task; None for its defaults. Raises `UserError` for an unknown name, for values of
    other types than declared, and for what cannot be made.
    """
    found = registry.entry(task)
    require(
        config is None or isinstance(config, found.config),
        "config",
        type(config).__name__,
        f"{task} needs a {found.config.__name__}; leave it out for the defaults",
    )
    return found.make(found.config() if config is None else checked(config, "env."))
