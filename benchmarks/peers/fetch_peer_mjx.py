"""Speed of other simulations on MJX, with random actions, to set beside our Fetch tasks on one accelerator: JaxGCRL's
robot arms (brax on MJX), and MJX's Warp backend on the very model that our Fetch physics simulates.

    git clone https://github.com/MichalBortkiewicz/JaxGCRL jaxgcrl
    python benchmarks/peers/fetch_peer_mjx.py --jaxgcrl jaxgcrl [--tasks panda_reach panda_push_easy] [--batch 4096]
    pip install warp-lang
    python benchmarks/peers/fetch_peer_mjx.py [--tasks fetch_reach fetch_pick_and_place] [--batch 8192 32768]
        [--faithful] [--iterations 100]

Of JaxGCRL only the environments' own modules and models are loaded, so that none of what it pins (an old JAX, wandb)
has to be there. Meshes are left out of the models: they are for pictures only, static bodies apart no body's mass comes
from them, and contacts are pairs of primitives. A control step is theirs: 25 substeps of 2 ms, 6 solver iterations. On
a CPU set XLA_FLAGS=--xla_cpu_use_fusion_emitters=false.

With Warp, on one NVIDIA GPU, a control step sets the mocap body beside the gripper and takes as many physics steps as
ours; resets are not timed, and fingers are not driven. Our own contacts are not geoms' of the model, so geoms that
touch in the task are switched on here; Warp's solver is MuJoCo's Newton with MuJoCo's own limits on iterations, or with
--iterations.
"""

import argparse
import functools
import importlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from infogoal_jax import envs
from infogoal_jax.envs.fetch import model
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.report.statistics import describe_machine

ARMS = {"panda_reach": ("arm_reach", "ArmReach"), "panda_push_easy": ("arm_push_easy", "ArmPushEasy")}
ACTION_SIZES = {"panda_reach": 4, "panda_push_easy": 5}
CONTACTS, ROWS = 24, 160
"""Contacts and constraint rows of one robot that Warp sets memory aside for. The cube on the table has four contacts,
held by both fingers twelve."""
STEP_METRES = 0.05


def without_meshes(file: Path) -> str:
    """The MJCF `file` less its meshes and the geoms that show them."""
    root = ElementTree.parse(file).getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag == "geom" and "mesh" in child.attrib and child.get("class") != "visual":
                raise ValueError(f"{file.name}: mesh {child.get('mesh')} takes part in collisions")
            if child.tag == "mesh" or (child.tag == "geom" and "mesh" in child.attrib):
                parent.remove(child)
    return ElementTree.tostring(root, encoding="unicode")


def make(repository: Path | str, task: str) -> tuple[Callable, Callable]:
    """`reset(keys [B]) -> states` and `step(states, actions [B, A]) -> states`, both pure, of the checkout in
    `repository`.

    Actions lie in [-1, 1], A = `ACTION_SIZES[task]`; `states` is brax's State with `obs`, `reward` and `done`, each
    with a leading axis B.
    """
    environments = Path(repository).resolve() / "jaxgcrl" / "envs"
    if str(environments) not in sys.path:  # the package's own __init__ would import its agents
        sys.path.insert(0, str(environments))
    module, name = ARMS[task]
    environment = getattr(importlib.import_module(f"manipulation.{module}"), name)
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / f"{task}.xml"
        scene.write_text(without_meshes(environments / "assets" / scene.name))
        env = type(name, (environment,), {"_get_xml_path": lambda self: str(scene)})()
    return jax.vmap(env.reset), jax.vmap(env.step)


def measure_jaxgcrl(repository: Path | str, task: str, batch: int, steps: int) -> tuple[float, float]:
    """Compile seconds, and control steps a second of a rollout with random actions (the second run of two: the first
    warms up)."""
    reset, step = make(repository, task)

    def rollout(states, key):
        def one(states, key):
            actions = jax.random.uniform(key, (batch, ACTION_SIZES[task]), minval=-1.0, maxval=1.0)
            states = step(states, actions)
            return states, states.reward

        return jax.lax.scan(one, states, jax.random.split(key, steps))

    started = time.perf_counter()
    states = jax.jit(reset)(jax.random.split(jax.random.key(0), batch))
    program = jax.jit(rollout).lower(states, jax.random.key(1)).compile()
    compile_seconds = time.perf_counter() - started
    states, _ = jax.block_until_ready(program(states, jax.random.key(1)))
    started = time.perf_counter()
    jax.block_until_ready(program(states, jax.random.key(2)))
    return compile_seconds, batch * steps / (time.perf_counter() - started)


def touching(task: str, setting: model.Setting) -> mujoco.MjModel:
    """The model of a task, with collisions of hand, object and ground."""
    mj = model.load(TASKS[task], setting)
    kinds = {"ground": (1, 2), "hand": (2, 1), "object": (3, 3)}
    for geom in range(mj.ngeom):
        name = mj.geom(geom).name
        kind = (
            "ground"
            if name in ("table", "floor")
            else "object"
            if name == "object"
            else "hand"
            if name in (*model.FINGERS, "palm")
            else None
        )
        if kind is not None:
            mj.geom_contype[geom], mj.geom_conaffinity[geom] = kinds[kind]
    return mj


def measure_warp(
    task: str, setting: model.Setting, batch: int, steps: int, iterations: int | None
) -> tuple[float, float]:
    """Compile seconds, and control steps a second of `batch` robots with random actions (the better of two runs after a
    first one)."""
    mj = touching(task, setting)
    if iterations is not None:
        mj.opt.iterations = iterations
    env = envs.load(task, FetchConfig(faithful=setting.whole_body, ends_at_goal=False))
    gripper, place = mj.body("wrist_roll").id, jnp.asarray(mj.site("gripper").pos, jnp.float32)
    warp_model = mjx.put_model(mj, impl="warp")
    empty = mjx.make_data(mj, impl="warp", naconmax=CONTACTS * batch, njmax=ROWS)

    def start(key):
        """Where an episode of ours starts, the bodies' places worked out."""
        motion = env.reset(key).motion
        state = empty.replace(
            qpos=motion.position, qvel=motion.velocity, mocap_quat=jnp.asarray([[1.0, 0.0, 1.0, 0.0]]) / 2**0.5
        )
        return mjx.forward(warp_model, state)

    def control_step(state, action):
        target = state.xpos[gripper] + state.xmat[gripper].reshape(3, 3) @ place + STEP_METRES * action[:3]
        state = state.replace(mocap_pos=target[None])
        return jax.lax.fori_loop(0, setting.substeps, lambda _, state: mjx.step(warp_model, state), state)

    def rollout(states, key):
        def step(states, step_key):
            return jax.vmap(control_step)(
                states, jax.random.uniform(step_key, (batch, 4), minval=-1.0, maxval=1.0)
            ), None

        return jax.lax.scan(step, states, jax.random.split(key, steps))[0].qpos

    states = jax.jit(jax.vmap(start))(jax.random.split(jax.random.key(0), batch))
    started = time.perf_counter()
    program = jax.jit(rollout).lower(states, jax.random.key(0)).compile()
    compile_seconds, runs = time.perf_counter() - started, []
    for seed in range(3):
        started = time.perf_counter()
        jax.block_until_ready(program(states, jax.random.key(seed)))
        runs.append(time.perf_counter() - started)
    return compile_seconds, batch * steps / min(runs[1:])


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jaxgcrl", type=Path, help="a checkout of JaxGCRL: measure its arms instead of Warp")
    parser.add_argument("--tasks", nargs="+", choices=[*ARMS, *TASKS])
    parser.add_argument("--batch", type=int, nargs="+", default=[8192])
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--faithful", action="store_true")
    parser.add_argument("--iterations", type=int, help="at most so many iterations of the solver")
    arguments = parser.parse_args()
    setting = model.FAITHFUL if arguments.faithful else model.FAST
    if arguments.jaxgcrl:
        about, tasks, substeps = "JaxGCRL", arguments.tasks or list(ARMS), 25
        measure = functools.partial(measure_jaxgcrl, arguments.jaxgcrl)
    else:
        about = f"MJX with Warp, {'faithful' if arguments.faithful else 'default'} setting"
        tasks = arguments.tasks or ["fetch_reach", "fetch_push", "fetch_pick_and_place"]
        measure = functools.partial(measure_warp, setting=setting, iterations=arguments.iterations)
        substeps = setting.substeps
    print(f"{about}, random actions; {describe_machine()}\n")
    print("| task | batch | env steps/s | physics steps/s | compile s |\n|---|---|---|---|---|")
    for task in tasks:
        for batch in arguments.batch:
            seconds, rate = measure(task=task, batch=batch, steps=arguments.steps)
            print(f"| {task} | {batch} | {rate:,.0f} | {substeps * rate:,.0f} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
