"""The Fetch tasks as brax environments: brax's own `sac.train` and `ppo.train` run on `FetchBrax("fetch_reach")`
unchanged, inside `brax_training()`.

The goal is appended to the observation. Every episode has a fresh goal and a fresh start: brax's `AutoResetWrapper`
goes back to the state that it finds in `info["first_pipeline_state"]` and `info["first_obs"]`, and the environment
draws these anew in every step.
"""

import contextlib
import functools
import io
import json
import warnings

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
    # brax says that warp is not installed, and its jaxopt that it is no longer maintained.
    warnings.simplefilter("ignore")
    from brax.base import Motion, System, Transform
    from brax.envs.base import Env, State
    from brax.io import html, mjcf
    from brax.io import json as brax_json

from infogoal_jax import checks
from infogoal_jax.envs.fetch import model
from infogoal_jax.envs.fetch.environment import FetchState, make
from infogoal_jax.envs.fetch.physics import Physics
from infogoal_jax.envs.fetch.scene import ARM, GOAL, GOAL_RADIUS
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.envs.fetch.vectors import Vector
from infogoal_jax.errors import require

REWARDS = ("sparse", "dense")
UPRIGHT = [1.0, 0.0, 0.0, 0.0]
"""The quaternion that turns nothing."""


@flax.struct.dataclass
class FetchPipelineState:
    """The simulated state with brax's names: q, qd, and x, xd of the links, computed only when something (brax's
    viewer) asks for them."""

    fetch: FetchState
    physics: Physics = flax.struct.field(pytree_node=False)

    @property
    def q(self) -> jax.Array:
        """Joint positions [..., nq]."""
        return self.fetch.motion.position

    @property
    def qd(self) -> jax.Array:
        """Joint velocities [..., nv]."""
        return self.fetch.motion.velocity

    @property
    def x(self) -> Transform:
        """Positions (m) and quaternions of the links, in the order of `FetchBrax.sys.link_names`."""
        return links(self)[0]

    @property
    def xd(self) -> Motion:
        """Velocities (m/s) and angular velocities (rad/s) of the links, in the world's frame."""
        return links(self)[1]


@jax.jit
def links(state: FetchPipelineState) -> tuple[Transform, Motion]:
    """Poses and velocities of the links, for any leading axes."""

    physics = state.physics
    body_of_joint = physics.mujoco_model.jnt_bodyid

    def one(position, velocity):
        frames, thing = physics.multibody.frames(position), physics.shapes.thing_at(position)
        axes = physics.multibody.axes(frames)
        turning, moving, *_ = physics.multibody.rates(axes.angular, axes.linear, velocity[: physics.joints])
        moving = moving + turning.cross(frames.position - physics.multibody.origin)
        parts = [frames.position.array, frames.quaternion.array, turning.array, moving.array]
        if thing is not None:
            spin = thing.rotation @ Vector.of(velocity[None, -3:])
            own = (thing.center.array, position[None, -4:], spin.array, velocity[None, -6:-3])
            parts = [jnp.concatenate(both) for both in zip(parts, own, strict=True)]
        # Bodies without a joint, such as the one that drives the gripper, stand where the model has them.
        still = (
            physics.mujoco_model.body_pos,
            physics.mujoco_model.body_quat,
            *np.zeros((2, physics.mujoco_model.nbody, 3)),
        )
        pos, rot, ang, vel = (
            jnp.asarray(rest, jnp.float32).at[body_of_joint].set(part)[1:]
            for rest, part in zip(still, parts, strict=True)
        )
        return Transform(pos=pos, rot=rot), Motion(ang=ang, vel=vel)

    for _ in range(state.q.ndim - 1):
        one = jax.vmap(one)
    return one(state.q, state.qd)


class FetchBrax(Env):
    """A Fetch task: fetch_reach, fetch_push, fetch_pick_and_place or fetch_slide.

    reward: "sparse", 0 at the goal and -1 elsewhere, or "dense", minus the distance in m. `done`: the goal is reached,
    unless `config` has episodes go on there; they are as long as the `episode_length` that brax's training is given,
    not as that of `config`. A step that diverges is taken back and the episode goes on.
    Metrics: `success`, `distance_per_step` (m) and `diverged`, of every step.
    """

    def __init__(self, task: str, reward: str = "sparse", config: FetchConfig | None = None):
        known = isinstance(reward, str) and reward in REWARDS
        require(known, "reward", reward, f"give one of {', '.join(REWARDS)}")
        checks.text(task, "task", f"give one of {', '.join(TASKS)}")
        fits = config is None or isinstance(config, FetchConfig)
        require(fits, "config", config, "give a FetchConfig, or leave it out")
        self.fetch, self.reward = make(task, FetchConfig() if config is None else config), reward

    def reset(self, rng: jax.Array) -> State:
        """A new episode. rng: a key of either kind, raw as brax's are or typed."""
        key = rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)
        key, reset_key = jax.random.split(key)
        fetch = self.fetch.reset(reset_key)
        return State(
            pipeline_state=self._pipeline(fetch),
            obs=self._observation(fetch),
            reward=jnp.zeros((), jnp.float32),
            done=jnp.zeros((), jnp.float32),
            metrics={name: jnp.zeros((), jnp.float32) for name in ("success", "distance_per_step", "diverged")},
            info={"key": jax.random.key_data(key)},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """40 ms under an action [4] in [-1, 1]."""
        fetch = self.fetch.step(state.pipeline_state.fetch, action)
        record = self.fetch.achieved(fetch)
        distance = jnp.sqrt(((record - fetch.desired_goal) ** 2).sum())
        reward = -distance if self.reward == "dense" else self.fetch.reward(record, fetch.desired_goal)
        success = self.fetch.reached(record, fetch.desired_goal).astype(jnp.float32)
        metrics = {"success": success, "distance_per_step": distance, "diverged": fetch.diverged.astype(jnp.float32)}
        info = dict(state.info)
        if "first_obs" in info:  # brax resets by itself: give it a new episode to start from.
            key, reset_key = jax.random.split(jax.random.wrap_key_data(info["key"]))
            fresh = self.fetch.reset(reset_key)
            info |= {
                "key": jax.random.key_data(key),
                "first_pipeline_state": self._pipeline(fresh),
                "first_obs": self._observation(fresh),
            }
        return state.replace(
            pipeline_state=self._pipeline(fetch),
            obs=self._observation(fetch),
            reward=reward,
            done=fetch.terminated.astype(jnp.float32),
            metrics=state.metrics | metrics,
            info=info,
        )

    @property
    def observation_size(self) -> int:
        """Of the task's observation and the goal's three numbers behind it."""
        return self.fetch.observation_size + 3

    @property
    def action_size(self) -> int:
        """Displacement of the gripper and opening of the fingers."""
        return self.fetch.action_size

    @property
    def backend(self) -> str:
        """brax's name for the physics: model and formulas are MuJoCo's, as in MJX."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Seconds of a step."""
        return model.CONTROL_STEP

    @functools.cached_property
    def sys(self) -> System:
        """The model in the form of brax's viewer. Its time step is that of the states, 40 ms."""
        with warnings.catch_warnings():
            # brax recommends MJX instead of its own physics, neither of which runs here.
            warnings.simplefilter("ignore")
            return mjcf.load_model(self.fetch.physics.mujoco_model).tree_replace({"opt.timestep": model.CONTROL_STEP})

    def _pipeline(self, fetch: FetchState) -> FetchPipelineState:
        return FetchPipelineState(fetch=fetch, physics=self.fetch.physics)

    def _observation(self, fetch: FetchState) -> jax.Array:
        return jnp.concatenate([fetch.observation, fetch.desired_goal])


@contextlib.contextmanager
def brax_training():
    """Let brax 0.14's training run on jax 0.10 inside this block: jax removed a function that brax calls
    (https://github.com/google/brax/issues/671)."""
    name = "device_put_replicated"
    before = vars(jax).get(name)
    setattr(jax, name, device_put_replicated)
    try:
        yield
    finally:
        delattr(jax, name)
        if before is not None:
            setattr(jax, name, before)


def device_put_replicated(tree, devices):
    """Copy the tree's leaves to each device, along a new first axis, as jax's migration guide replaces the function of
    this name."""
    along = jax.sharding.NamedSharding(
        jax.sharding.Mesh(np.array(devices), ("device",)), jax.sharding.PartitionSpec("device")
    )
    return jax.tree.map(lambda leaf: jax.device_put(jnp.stack([leaf] * len(devices)), along), tree)


def render_html(env: Env, states: list[State], height: int = 480) -> str:
    """A page with brax's viewer: the states of one environment one after the other, each for 40 ms, and their goals. It
    loads brax's scripts from the web when it is opened.

    The arm's links are added to what MuJoCo's model has. Raises `UserError` for no states, or batches of them.
    """
    require(len(states) > 0, "states", "none", "give at least one")
    for number, state in enumerate(states):
        require(
            state.obs.ndim == 1,
            f"states[{number}]",
            f"a batch of {state.obs.shape[:-1]}",
            "give the states of one environment",
        )
    system = env.unwrapped.sys
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[state.pipeline_state for state in states])
    poses, goals = jax.device_get((stacked.x, stacked.fetch.desired_goal))
    scene = json.loads(brax_json.dumps(system, []))
    for link, geoms in link_geoms(env.unwrapped.fetch.physics.mujoco_model, list(system.link_names)).items():
        scene["geoms"].setdefault(link, []).extend(geoms)
    positions = np.concatenate([poses.pos, goals[:, None]], 1)
    rotations = np.concatenate([poses.rot, np.broadcast_to(np.array(UPRIGHT), (len(states), 1, 4))], 1)
    scene["states"] = {
        "x": [
            {"pos": position.tolist(), "rot": rotation.tolist()}
            for position, rotation in zip(positions, rotations, strict=True)
        ]
    }
    return html.render_from_json(json.dumps(scene), height, colab=False, base_url=None)


def link_geoms(mj: mujoco.MjModel, names: list[str]) -> dict[str, list[dict]]:
    """Shapes that the viewer draws besides those of the model: the arm's links, and the goal as one more link."""

    def geom(
        kind: str,
        link: int,
        place: list[float],
        turn: list[float],
        colour: tuple[float, float, float],
        size: list[float],
    ) -> list[dict]:
        return [{"name": kind, "link_idx": link, "pos": place, "rot": turn, "rgba": [*colour, 1.0], "size": size}]

    geoms = {"goal": geom("Sphere", len(names), [0.0, 0.0, 0.0], UPRIGHT, GOAL, [GOAL_RADIUS, 0.0, 0.0])}
    for first, last, radius, colour in ARM:
        way = mj.body(last).pos
        turn = np.zeros(4)
        mujoco.mju_quatZ2Vec(turn, way)
        geoms[first] = geom(
            "Capsule",
            names.index(first),
            (way / 2).tolist(),
            turn.tolist(),
            colour,
            [radius, float(np.linalg.norm(way)) / 2, 0.0],
        )
    return geoms
