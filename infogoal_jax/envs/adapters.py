"""Environments of brax, of MuJoCo Playground and of JaxGCRL as tasks with continuous goals: `from_brax`,
`from_playground`, `from_jaxgcrl`. docs/guides/bridges.md trains on one.

Such an environment shows its goal among its observations. Here the goal is apart: the agent is told which goal is
desired, hindsight changes it, and the observation is what is left. Rewards are 1 at the goal. Their own training
wrappers reset an episode to the first state that they ever drew, goal included; here every episode begins with a reset
of its own.
"""

import contextlib
import dataclasses
import importlib
import importlib.util
import inspect
import io
import sys
import types
import warnings
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import dtypes

from infogoal_jax import checks
from infogoal_jax.data.episodes import Episodes
from infogoal_jax.envs.contract import check_all_finite
from infogoal_jax.envs.goal_task import Episode, GoalTask
from infogoal_jax.errors import UserError, nearest, renamed, require, require_known, shown
from infogoal_jax.field_types import LARGEST_WHOLE
from infogoal_jax.goals import EVALUATED_GOALS, GoalBox
from infogoal_jax.keys import from_seed

Places = int | slice | Sequence[int] | str
"""Places of the flattened observation, or the key of an observation that is a dictionary."""
Reading = Places | Callable[[Any], jax.Array]
"""Where numbers are read: places of the observation, or a function of the environment's state."""
WIDEST = 1e37
"""Of a radius: float32 does not hold the goal space around a wider one."""
MOST_STARTS = 4096
"""Starts of one episode: more than any device begins beside each other for each of its environments."""
GOALS_DRAWN = 4096
"""Goals that are drawn of an environment's own, to find how far they spread."""
MOST_DRAWN = 2**16
STARTS_CHECKED = 64
"""Starts that are looked at where goals are not the environment's own."""
MARGIN = 0.05
"""How far the goal space goes beyond those, as a fraction of their spread."""
WRAPPED = ("first_obs", "first_pipeline_state", "AutoResetWrapper_first_obs", "steps", "truncation")
"""Entries of `info` that the training wrappers of brax and Playground make."""
TRAINING = ("VmapWrapper", "DomainRandomizationVmapWrapper", "BraxDomainRandomizationVmapWrapper")
"""Those of their wrappers that take a batch of keys; another one may be around them."""


@flax.struct.dataclass
class AdaptedTask(GoalTask):
    """An environment of another library as a task. Its world is the environment's own state."""

    env: Any = flax.struct.field(pytree_node=False, default=None)
    """The environment: `reset(rng) -> state` and `step(state, action) -> state`, with `obs` and `done` in the state."""
    read_goal: Callable[[Any], jax.Array] = flax.struct.field(pytree_node=False, default=None)
    """(the environment's state) -> the goal that it has drawn, float32 [D]."""
    read_achieved: Callable[[Any], jax.Array] = flax.struct.field(pytree_node=False, default=None)
    """(the environment's state) -> the goal that it achieves, float32 [D]."""
    size: int = flax.struct.field(pytree_node=False, default=0)
    """Numbers of the flattened observation."""
    shown: tuple[int, ...] = flax.struct.field(pytree_node=False, default=())
    """Places of the flattened observation that the agent sees."""
    achieved_places: tuple[int, ...] = flax.struct.field(pytree_node=False, default=())
    """Places of it that are the goal that is achieved; none: they do not tell it."""
    own_goals: bool = flax.struct.field(pytree_node=False, default=True)
    """Whether training goals are those that the environment draws with each start, of one reset."""
    starts: int = flax.struct.field(pytree_node=False, default=1)
    """Starts that are drawn to find one at which the goal is not reached; each costs a reset of the environment."""
    action_size: int = flax.struct.field(pytree_node=False, default=1)
    """Size of an action, each number from -1 to 1."""
    source: str = flax.struct.field(pytree_node=False, default="simulated")
    """What is simulated, in words."""
    types: tuple[Any, ...] = flax.struct.field(pytree_node=False, default=())
    """Of each leaf of the environment's state, after any number of steps."""

    can_fail = True
    costly_reset = True

    def reset(self, key: jax.Array) -> Episode:
        """A new episode for a training goal. Where the environment's own goals are desired, a start comes with its
        goal: the first of several at which it is not reached."""
        if not self.own_goals:
            return super().reset(key)
        if self.starts == 1:
            world = self.begin(key)
            return self.episode(world, self.read_goal(world))
        worlds = jax.vmap(self.begin)(jax.random.split(key, self.starts))
        goals = jax.vmap(self.read_goal)(worlds)
        first = self.first_away(worlds, goals)
        return self.episode(jax.tree.map(lambda leaf: leaf[first], worlds), goals[first])

    def begin(self, key: jax.Array) -> Any:
        """A state of the environment, with numbers of fixed types."""
        leaves, layout = jax.tree.flatten(with_types(self.env.reset(raw(key))))
        return layout.unflatten(jnp.asarray(leaf, dtype) for leaf, dtype in zip(leaves, self.types, strict=True))

    def move(self, world: Any, action: jax.Array) -> Any:
        """The state after an action. The environment is given dictionaries of its own, since it may write into
        them."""
        moved = self.env.step(copied(world), action)
        return jax.tree.map(lambda old, new: jnp.asarray(new, old.dtype), world, moved)

    def observation(self, world: Any) -> jax.Array:
        """The flattened observation, without what tells of the goal."""
        return taken(self.shown, flat(world.obs))

    def achieved_goal(self, world: Any) -> jax.Array:
        return self.read_achieved(world)

    def achieved_in(self, observation: jax.Array) -> jax.Array:
        """The goal that is achieved where this was seen: the whole flattened observation, or what the agent sees."""
        there = range(self.size) if observation.shape[-1] == self.size else self.shown
        if not self.achieved_places or not set(self.achieved_places) <= set(there):
            return super().achieved_in(observation)
        return taken(tuple(map(there.index, self.achieved_places)), observation)

    def recorded_observation(self, episodes: Episodes) -> np.ndarray:
        """What the agent sees of whole observations [N, F] of a recording, or of those that show just that."""
        seen, own = episodes.observations, len(self.shown)
        remedy = f"give whole observations of {self.size} numbers, or the {own} that the agent sees"
        require(seen.ndim == 2 and seen.shape[1] in (self.size, own), "observations", list(seen.shape), remedy)
        return seen[:, np.array(self.shown, np.int32)] if seen.shape[1] == self.size else seen

    def fails(self, world: Any) -> jax.Array:
        """Whether the environment is done elsewhere than at its own goal, which may be another than the desired one."""
        return (world.done > 0) & ~self.reached(self.read_achieved(world), self.read_goal(world))

    def mujoco_model(self) -> Any:
        """MuJoCo's model of the robot; None where the environment has none."""
        env = getattr(self.env, "unwrapped", self.env)
        return getattr(getattr(env, "sys", None), "mj_model", None) or getattr(env, "mj_model", None)

    def joint_positions(self, world: Any) -> jax.Array:
        """The positions of that model [nq], of a state of brax or Playground."""
        return world.pipeline_state.q if hasattr(world, "pipeline_state") else world.data.qpos

    def is_finite(self, world: Any) -> jax.Array:
        """Whether what is seen and achieved is finite: other numbers of a simulator may be infinite by design."""
        return jnp.isfinite(self.observation(world)).all() & jnp.isfinite(self.achieved_goal(world)).all()


def from_brax(
    env: Any,
    *,
    goal: Reading,
    achieved: Reading,
    radius: float,
    hidden: Places = (),
    episode_length: int = 1000,
    ends_at_goal: bool = True,
    low: Any = None,
    high: Any = None,
    held_out: Callable[[jax.Array], jax.Array] | None = None,
    num_evaluated: int = EVALUATED_GOALS,
    starts: int = 1,
    source: str = "",
    goals_drawn: int = GOALS_DRAWN,
) -> AdaptedTask:
    """An environment of brax, without training wrappers, as a task.

    goal: where the goal [D] stands that the environment draws: places of the observation, which the agent then does not
        see, or a function of its state. achieved: where the goal stands that a state achieves.
    radius: distance below which a goal is reached. hidden: further places that tell of the goal, such as the way to it.
    episode_length: steps of an episode. ends_at_goal: whether reaching the goal ends it. Where the environment sets
        `done` and the goal is not reached, the episode has failed: nothing is worth anything after it.
    low, high: corners [D] between which training goals are drawn uniformly; None: the environment's own goals. An
        episode of training then has the start and the goal of one reset, one of an evaluation those of two.
    held_out: (goal [D]) -> whether no training goal lies there, see `GoalBox.of`; own goals then come from those that
        were drawn once. num_evaluated: goals of each use that an evaluation asks for.
    starts: starts that are drawn to find one at which the goal is not reached.
    goals_drawn: own goals that are drawn, a reset each, to find how far they spread.

    Observations that are pytrees are flattened in the order of `jax.tree.leaves`, which sorts the keys of dictionaries.
    Raises `UserError`, naming the argument, for what the environment does not have.
    """
    for name in ("reset", "step", "action_size"):
        there = checks.called(f"env.{name}", hasattr, env, name)
        require(there, "env", type(env).__name__, f"has no {name}: give an environment of brax")
    action_size = checks.whole(env.action_size, "env.action_size", 1, LARGEST_WHOLE)
    checks.number(radius, "radius", 0.0, WIDEST)
    require(radius > 0, "radius", radius, "give a distance greater than 0")
    checks.whole(episode_length, "episode_length", 1, LARGEST_WHOLE)
    checks.whole(starts, "starts", 1, MOST_STARTS)
    checks.whole(goals_drawn, "goals_drawn", 2, MOST_DRAWN)
    checks.flag(ends_at_goal, "ends_at_goal")
    checks.text(source, "source", "say what is simulated, in words")
    require((low is None) == (high is None), "high", high, "give both low and high, or neither")
    state = checked_state(env, action_size)
    layout = Layout.of(state.obs)
    read_goal, told = layout.reader(goal, "goal")
    read_achieved, of_achieved = layout.reader(achieved, "achieved")
    goal_size, achieved_size = (
        checks.traced(name, read, state).shape[0] for name, read in (("goal", read_goal), ("achieved", read_achieved))
    )
    require(goal_size > 0, "goal", "no numbers", "give a function that returns at least one")
    require(goal_size == achieved_size, "achieved", achieved_size, f"give as many numbers as goal has, {goal_size}")
    require(
        not told or told != of_achieved, "achieved", achieved, "is the desired goal itself; give what a state achieves"
    )
    told = {*told, *layout.places(hidden, "hidden")}
    shown = tuple(place for place in range(layout.size) if place not in told)
    require(len(shown) > 0, "hidden", sorted(told), "leave something of the observation to see")
    task = AdaptedTask(
        goals=None,
        radius=float(radius),
        episode_length=episode_length,
        ends_at_goal=ends_at_goal,
        env=env,
        read_goal=read_goal,
        read_achieved=read_achieved,
        size=layout.size,
        shown=shown,
        achieved_places=of_achieved,
        own_goals=low is None and held_out is None,
        starts=starts,
        action_size=action_size,
        types=types_of(state),
        source=source or f"{type(getattr(env, 'unwrapped', env)).__name__}, simulated",
    )
    drawn, sampler = drawn_goals(task, goals_drawn if low is None else STARTS_CHECKED), None
    if low is None:
        require(
            np.isfinite(drawn).all(), "goal", drawn[~np.isfinite(drawn).all(1)][:1], "is not finite after env.reset"
        )
        remedy = "is the same after every env.reset; read it where the environment draws it, or give low and high"
        require(bool((np.ptp(drawn, 0) > 0).any()), "goal", drawn[0].tolist(), remedy)
        spread = np.maximum(MARGIN * np.ptp(drawn, 0), radius)
        low, high = drawn.min(0) - spread, drawn.max(0) + spread
        sampler = partial(draw_one, drawn)
    with renamed(use_of="held_out"):
        goals = GoalBox.of(low, high, sampler=sampler, use_of=held_out, num_evaluated=num_evaluated)
    require(goals.shape == (goal_size,), "low", np.shape(low), f"give as many numbers as goal has, {goal_size}")
    return task.replace(goals=goals)


def check_arguments(arguments: dict[str, Any], settled: Collection[str] = ()) -> None:
    """Raise `UserError` for a name that is no argument of `from_brax`, or one of those that are settled already."""
    known = [name for name in inspect.signature(from_brax).parameters if name != "env" and name not in settled]
    for name in arguments:
        require_known("arguments", name, known, "no such argument")


def from_playground(env: Any, *, config_overrides: dict[str, Any] | None = None, **arguments: Any) -> AdaptedTask:
    """An environment of MuJoCo Playground as a task: the environment, or its name there, such as "FishSwim". It is then
    simulated by MJX in JAX, not by Warp, unless `config_overrides` says otherwise. arguments: of `from_brax`.

    Raises `UserError` as `from_brax`, where Playground is not installed, and for a name that it does not have.
    """
    check_arguments(arguments)
    if isinstance(env, str):
        by_name = config_overrides is None or isinstance(config_overrides, dict)
        require(by_name, "config_overrides", config_overrides, "give a dictionary of values by their names")
        arguments = {"source": f"{env} of MuJoCo Playground, simulated"} | arguments
        env = playground_environment(env, config_overrides or {})
    else:
        require(config_overrides is None, "config_overrides", config_overrides, "give env by its name, or leave it out")
    return from_brax(env, **arguments)


def playground_environment(name: str, overrides: dict[str, Any]) -> Any:
    """The environment of Playground of this name. Raises `UserError` where Playground is not installed, and for a name
    that it does not have.

    Playground 0.2.0 compares the versions of MuJoCo as texts, so that its reacher asks MuJoCo 3.10 or later for
    `MjSpec.find_body`, which is `MjSpec.body` there.
    """
    registry = imported("mujoco_playground", 'pip install "infogoal-jax[playground]"').registry
    known = [*registry.ALL_ENVS]
    require(name in known, "env", name, f"Playground has no such environment.{nearest(name, known)}")
    spec = imported("mujoco", "pip install mujoco").MjSpec
    if not hasattr(spec, "find_body"):
        spec.find_body = spec.body
    return made_quietly("env", lambda: registry.load(name, config_overrides={"impl": "jax"} | overrides))


def made_quietly(field: str, make: Callable[[], Any]) -> Any:
    """What this makes, without warnings, such as that of brax that its environments are no longer maintained. Raises
    `UserError`, naming the field, where it fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return checks.called(field, make)


JAXGCRL = {
    "reacher": ("reacher", "Reacher", {"backend": "generalized"}),
    "ant": ("ant", "Ant", {"backend": "spring"}),
    "ant_ball": ("ant_ball", "AntBall", {"backend": "spring"}),
    "ant_push": ("ant_push", "AntPush", {"backend": "mjx"}),
    "humanoid": ("humanoid", "Humanoid", {"backend": "spring"}),
    "pusher_easy": ("pusher", "Pusher", {"backend": "generalized", "kind": "easy"}),
    "pusher_hard": ("pusher", "Pusher", {"backend": "generalized", "kind": "hard"}),
    "pusher_reacher": ("pusher", "PusherReacher", {"backend": "generalized"}),
    **{
        f"arm_{name}": (f"manipulation.arm_{name}", f"Arm{name.title().replace('_', '')}", {"backend": "mjx"})
        for name in ("reach", "grasp", "push_easy", "push_hard", "binpick_easy", "binpick_hard")
    },
    **{
        f"{body}_{maze}": (module, kind, {"backend": "spring", "maze_layout_name": maze})
        for body, module, kind in (
            ("ant", "ant_maze", "AntMaze"),
            ("humanoid", "humanoid_maze", "HumanoidMaze"),
            ("simple", "simple_maze", "SimpleMaze"),
        )
        for maze in ("u_maze", "big_maze", "hardest_maze")
    },
    **{
        f"ant_ball_{maze}": ("ant_ball_maze", "AntBallMaze", {"backend": "spring", "maze_layout_name": maze})
        for maze in ("u_maze", "big_maze")
    },
}
"""The environments of JaxGCRL by its own names: module, class and arguments, as its `create_env` has them. Left out are
`ant_random_start`, which starts beside its own goal, where an evaluation asks for others, `cheetah`, which has one goal
alone, and `pusher2`, which has a radius for each of two things."""
ACHIEVED = {f"ant_ball_{maze}": (29, 30) for maze in ("u_maze", "big_maze")}
"""Places of the ball in the state where `goal_indices` are others: of a joint's speed and of the ball's first number.
The `success` of these environments looks at the ball."""
RADII = {
    "pusher_reacher": 0.1,
    **{f"humanoid_{maze}": 0.5 for maze in ("u_maze", "big_maze", "hardest_maze")},
    "arm_grasp": 0.07,
}
"""Of those that have no `goal_reach_thresh`: what their `success` is computed with. Of `arm_grasp` it allows both
fingertips 5 cm and their distance 2 cm; its goal follows the cube, and here stays where the cube was at first."""


def from_jaxgcrl(name: str, **arguments: Any) -> AdaptedTask:
    """An environment of JaxGCRL as a task, by its name there. Goals, what achieves them, the radius and the length of
    an episode, 1,001 steps that go on at the goal, are its own; arguments: of `from_brax`, to change them. Networks see
    goals as they are, in the units of the state, as there.

    `pip install --no-deps jaxgcrl`: its package asks for an old jax and NumPy, and works with today's, see
    `import_jaxgcrl`.
    Raises `UserError` as `from_brax`, where JaxGCRL is not installed, and for a name that it does not have.
    """
    check_arguments(arguments)
    made, given = jaxgcrl_environment(name)
    env = made_quietly("name", lambda: made(**given))
    # Its observation is the state and then the goal; `goal_indices` are places of the state.
    radius = getattr(env, "goal_reach_thresh", RADII.get(name))
    known = radius is not None or "radius" in arguments
    require(known, "radius", None, f"{name} of JaxGCRL has none; give a distance below which a goal is reached")
    own = {
        "goal": slice(int(env.state_dim), None),
        "achieved": [int(place) for place in ACHIEVED.get(name, np.asarray(env.goal_indices))],
        "radius": None if radius is None else float(radius),
        "episode_length": 1001,
        "ends_at_goal": False,
        "source": f"{name} of JaxGCRL, simulated",
    }
    task = from_brax(env, **(own | arguments))
    return task.replace(goals=task.goals.replace(seen=jnp.asarray))


def jaxgcrl_environment(name: str) -> tuple[type, dict[str, Any]]:
    """The class of an environment of JaxGCRL, by its name there, and the arguments that make it. Raises `UserError` as
    `import_jaxgcrl`, and for a name that it does not have."""
    require_known("name", name, JAXGCRL, "no such environment")
    module, kind, given = JAXGCRL[name]
    made = getattr(import_jaxgcrl(f"jaxgcrl.envs.{module}"), kind)
    if name.startswith("arm_"):  # It looks for its models from the folder that one is in.
        own_path, folder = made._get_xml_path, Path(sys.modules["jaxgcrl"].__file__).parent
        made = type(kind, (made,), {"_get_xml_path": lambda self: str(folder / own_path(self))})
    return made, given


def import_jaxgcrl(module: str) -> Any:
    """A module of JaxGCRL 0.2.8. While it is imported, stand-ins take the place of what its package imports and is not
    there: `brax.v1`, which brax 0.14 has no longer and which only types are taken from, and the loggers of Weights &
    Biases. Raises `UserError` where JaxGCRL is not installed."""
    brax_envs = imported("brax.envs", "pip install brax")
    stand_ins = {
        "brax.v1": {"envs": brax_envs},
        "wandb": {},
        "wandb_osh": {},
        "wandb_osh.hooks": {"TriggerWandbSyncHook": object},
    }
    missing = [name for name in stand_ins if not is_there(name)]
    for name in missing:
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(stand_ins[name])
    try:
        return imported(module, "pip install --no-deps jaxgcrl")
    finally:
        for name in missing:
            del sys.modules[name]


def is_there(module: str) -> bool:
    """Whether a module can be imported."""
    try:
        return module in sys.modules or importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # Of what it is part of.
        return False


@dataclasses.dataclass(frozen=True)
class Layout:
    """How an observation is flattened. size: its numbers; keys: the places of each key of a dictionary."""

    size: int
    keys: dict[str, tuple[int, ...]]

    @classmethod
    def of(cls, observation: Any) -> "Layout":
        """The layout of an observation of these shapes."""
        sizes = [int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(observation)]
        require(sum(sizes) > 0, "env", "an observation of no numbers", "give an environment with observations")
        numbers = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        named = jax.tree.unflatten(jax.tree.structure(observation), numbers)
        parts = {key: jax.tree.leaves(part) for key, part in named.items()} if isinstance(observation, dict) else {}
        return cls(sum(sizes), {str(key): tuple(np.concatenate(part)) for key, part in parts.items() if part})

    def places(self, given: Places, field: str) -> tuple[int, ...]:
        """The places that are meant, each from 0 to below `size`."""
        if isinstance(given, str):
            words = f"give one of its keys: {', '.join(self.keys)}" if self.keys else f"give places below {self.size}"
            require(given in self.keys, field, given, words)
            return self.keys[given]
        remedy = f"give places of the observation, which has {self.size} numbers, or the key of a dictionary"
        require(not isinstance(given, np.ma.MaskedArray), field, "a masked array", remedy)
        try:
            if isinstance(given, slice):
                return tuple(range(self.size)[given])
            as_they_are = np.ndim(given) == 0 or isinstance(given, np.ndarray | jax.Array)
            several = np.atleast_1d(np.asarray(given if as_they_are else list(given)))
        except (TypeError, ValueError) as error:
            raise UserError(f"{field} = {shown(given)}: {remedy}") from error
        if not several.size:
            return ()
        require(several.dtype.kind in "iu" and several.ndim == 1, field, given, remedy)
        require(((several >= -self.size) & (several < self.size)).all(), field, given, remedy)
        return tuple(int(place) % self.size for place in several)

    def reader(self, given: Reading, field: str) -> tuple[Callable[[Any], jax.Array], tuple[int, ...]]:
        """What reads the numbers of a state, and the places of the observation that it reads."""
        if callable(given):
            function = checks.function(given, field, 1, "give a function of the environment's state")
            return lambda state: jnp.ravel(jnp.asarray(function(state), jnp.float32)), ()
        places = self.places(given, field)
        require(len(places) > 0, field, given, "give at least one place of the observation")
        return lambda state: taken(places, flat(state.obs)), places


def flat(observation: Any) -> jax.Array:
    """The numbers of an observation, float32 [F], in the order of `jax.tree.leaves`."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(leaf, jnp.float32)) for leaf in jax.tree.leaves(observation)])


def taken(places: tuple[int, ...], observation: jax.Array) -> jax.Array:
    """The numbers at these places of a flattened observation."""
    return observation[np.array(places, np.int32)]


def raw(key: jax.Array) -> jax.Array:
    """The words of a key, which these environments draw from."""
    return jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key


def with_types(state: Any) -> Any:
    """The state with arrays in the place of Python's numbers, whose types would change with the first step."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf)), state)


def checked_state(env: Any, action_size: int) -> Any:
    """The shapes of a state of the environment, and the types that hold it after any number of steps: what begins as
    whole numbers may go on as fractions. Raises `UserError` for an environment that cannot be stepped over and over,
    and for one with training wrappers around it."""
    remedy = "has training wrappers, which reset to one cached start; give the environment itself"
    outermost = type(env).__name__
    require(outermost not in TRAINING, "env", outermost, remedy)
    inside = type(getattr(env, "env", None)).__name__
    require(inside not in TRAINING, "env", f"{outermost} of a {inside}", remedy)
    state = checks.traced("env.reset", lambda key: with_types(env.reset(key)), checks.Spec((2,), "uint32").struct)
    for name in ("obs", "done"):
        require(hasattr(state, name), "env.reset", type(state).__name__, f"returns a state without {name}")
    wrappers = [name for name in WRAPPED if name in (getattr(state, "info", None) or {})]
    require(not wrappers, "env", type(env).__name__, remedy)
    action, narrower = checks.Spec((action_size,), "float32").struct, None
    while narrower != types_of(state):
        narrower = types_of(state)
        again = checks.traced(
            "env.step", lambda state, action: with_types(env.step(state, action)), copied(state), action
        )
        checks.same_shapes(without_types(again), without_types(state), "the state of env.step", "that of env.reset")
        state = jax.tree.map(of_wider_type, state, again)
    return state


def types_of(state: Any) -> tuple[Any, ...]:
    """The type of each leaf."""
    return tuple(leaf.dtype for leaf in jax.tree.leaves(state))


def of_wider_type(old: jax.ShapeDtypeStruct, new: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    """The shape of a leaf with a type that holds the numbers of both."""
    wider = old.dtype if old.dtype == new.dtype else dtypes.canonicalize_dtype(jnp.promote_types(old.dtype, new.dtype))
    return jax.ShapeDtypeStruct(old.shape, wider)


def copied(state: Any) -> Any:
    """The same state with dictionaries of its own."""
    return jax.tree.map(lambda leaf: leaf, state)


def without_types(state: Any) -> Any:
    """The shapes of a state alone."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float32), state)


def drawn_goals(task: AdaptedTask, count: int) -> np.ndarray:
    """So many goals that the environment draws, float32 [M, D]. Raises `UserError` where what is seen or achieved at
    its start is not finite."""

    def begun(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        world = task.begin(key)
        return task.read_goal(world), task.is_finite(world)

    keys = jax.random.split(from_seed(np.uint32(0)), count)
    drawn, finite = map(np.asarray, jax.jit(jax.vmap(begun))(keys))
    remedy = "observe and achieve finite numbers; `hidden` leaves out places of the observation"
    check_all_finite("env.reset", finite, remedy)
    return drawn


def draw_one(goals: np.ndarray, key: jax.Array) -> jax.Array:
    """One of these goals [M, D], each equally likely."""
    return jnp.asarray(goals)[jax.random.randint(key, (), 0, len(goals), jnp.int32)]


def imported(module: str, remedy: str) -> Any:
    """An optional module, without what it says while it is imported. Raises `UserError` with the remedy where it, or
    what it needs, cannot be imported."""
    try:
        silent = io.StringIO()
        with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module(module)
    except ImportError as error:
        raise UserError(f"{module}: cannot be imported ({error}); {remedy}") from error
