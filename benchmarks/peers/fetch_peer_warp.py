"""Speed of MJX's Warp backend on the very model that our Fetch physics simulates, to set beside it on one NVIDIA GPU.

    pip install warp-lang
    python benchmarks/peers/fetch_peer_warp.py [--tasks fetch_reach fetch_pick_and_place] [--batch 8192 32768]
    [--faithful] [--iterations 100]

A control step sets the mocap body beside the gripper and takes as many physics steps as ours; resets are not timed, and
fingers are not driven. Our own contacts are not geoms' of the model, so geoms
that touch in the task are switched on here; Warp's solver is MuJoCo's Newton with MuJoCo's own limits on iterations, or
with --iterations.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from infogoal_jax import envs
from infogoal_jax.envs.fetch import model
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.report.statistics import describe_machine

CONTACTS = (
    24  # Of one robot: what Warp sets memory aside for. The cube on the table has four, held by both fingers twelve.
)
ROWS = 160  # Constraint rows of one robot.
STEP_METRES = 0.05


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


def measure(task: str, setting: model.Setting, batch: int, steps: int, iterations: int | None) -> tuple[float, float]:
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
    parser.add_argument(
        "--tasks", nargs="+", choices=TASKS, default=["fetch_reach", "fetch_push", "fetch_pick_and_place"]
    )
    parser.add_argument("--batch", type=int, nargs="+", default=[8192])
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--faithful", action="store_true")
    parser.add_argument("--iterations", type=int, help="at most so many iterations of the solver")
    arguments = parser.parse_args()
    setting = model.FAITHFUL if arguments.faithful else model.FAST
    print(
        f"MJX with Warp, {'faithful' if arguments.faithful else 'default'} setting, random actions; "
        f"{describe_machine()}\n"
    )
    print("| task | batch | env steps/s | physics steps/s | compile s |\n|---|---|---|---|---|")
    for task in arguments.tasks:
        for batch in arguments.batch:
            seconds, rate = measure(task, setting, batch, arguments.steps, arguments.iterations)
            print(f"| {task} | {batch} | {rate:,.0f} | {setting.substeps * rate:,.0f} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
