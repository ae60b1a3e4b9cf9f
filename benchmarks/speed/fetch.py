"""Speed of the Fetch tasks: whole episodes of random actions under one jit, resets included, beside peers measured in
the same run; and what their goal images cost in training.

    python benchmarks/speed/fetch.py [--tasks fetch_reach fetch_pick_and_place] [--batch 8192 32768] [--faithful]
        [--parts]               where the time of a physics step goes
        [--jaxgcrl CHECKOUT]    JaxGCRL's arms on the same device (peers/fetch_peer_mjx.py)
        [--assets FOLDER]       the reference's models on C MuJoCo in two processes (peers/fetch_peer_mujoco.py)
    python benchmarks/speed/fetch.py --images [--tasks fetch_reach] [--seeds 5] [--updates 100] [--out FILE.json]

Compile time and run time are told apart; the run is the better of two. With `--images`: the encoder's work, the
gradient through it and the gather of images as shares of the fused step's time. One epoch of the preset is a rollout
and `--updates` updates. Each part is compiled alone and run on the same arrays as in training; parts of an update run
as often as in an epoch, inside a scan as there.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp

from infogoal_jax import compiled, envs, make_train, presets, replay
from infogoal_jax.envs.fetch.environment import Fetch
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.learners.encoding import encode_all
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.train.experience import make_experience
from infogoal_jax.train.rollout import collect
from infogoal_jax.train.update import updates as updates_of

PEER = {
    "fetch_reach": "panda_reach",
    "fetch_push": "panda_push_easy",
    "fetch_pick_and_place": "panda_push_easy",
    "fetch_slide": "panda_push_easy",
}


def timed(function, *arguments) -> tuple[float, float]:
    """Seconds to compile, and seconds of the better of two runs after a first one."""
    started = time.perf_counter()
    program = compiled(function, *arguments)
    compile_seconds = time.perf_counter() - started
    jax.block_until_ready(program(*arguments))
    runs = []
    for _ in range(2):
        started = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        runs.append(time.perf_counter() - started)
    return compile_seconds, min(runs)


def measure(env: Fetch, batch: int) -> tuple[float, float]:
    """Compile seconds, and environment steps a second of `batch` episodes with random actions."""

    def episodes(key):
        reset_key, action_key = jax.random.split(key)
        states = jax.vmap(env.reset)(jax.random.split(reset_key, batch))

        def step(states, step_key):
            states = jax.vmap(env.step)(states, jax.random.uniform(step_key, (batch, 4), minval=-1.0, maxval=1.0))
            return states, (env.reward(env.achieved(states), states.desired_goal), states.diverged)

        states, (rewards, diverged) = jax.lax.scan(step, states, jax.random.split(action_key, env.episode_length))
        return states.observation, rewards.mean(), diverged.sum()

    compile_seconds, run_seconds = timed(episodes, jax.random.key(0))
    return compile_seconds, batch * env.episode_length / run_seconds


def parts(env: Fetch, batch: int, repeats: int = 40) -> dict[str, float]:
    """Milliseconds of a physics step of `batch` robots, and of the parts it is made of, each timed alone in a loop."""
    physics = env.physics
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), batch))
    target, quaternion = states.gripper + 0.01, states.gripper_quaternion

    def looped(part):
        def run(motions):
            def once(_, motions):
                leaves = jax.tree.leaves(jax.vmap(part)(motions, target, quaternion))
                total = sum(jnp.abs(leaf).reshape(batch, -1).sum(-1) for leaf in leaves if leaf.dtype != bool)
                # Each round needs the last: nothing is optimised away.
                return motions.replace(velocity=motions.velocity + 1e-20 * total[:, None])

            return jax.lax.fori_loop(0, repeats, once, motions)

        return timed(run, states.motion)[1] / repeats * 1e3

    def dynamics(motion):
        thing = physics.shapes.thing_at(motion.position)
        return thing, physics.multibody.dynamics(motion.frames, thing, motion.position, motion.velocity)

    def rows(motion, target, quaternion):
        thing, (axes, inertia, force) = dynamics(motion)
        return inertia, force, physics.rows(motion, axes, thing, target, quaternion)

    return {
        "kinematics": looped(lambda motion, *_: physics.multibody.frames(motion.position)),
        "inertia and forces": looped(lambda motion, *_: dynamics(motion)[1]),
        "and constraint rows": looped(rows),
        "and solver, and kinematics: whole step": looped(
            lambda motion, target, quaternion: physics.substep(motion, target, quaternion, jnp.zeros(2)).replace(
                frames=None
            )
        ),
    }


def image_costs(task: str, seeds: int, updates: int) -> dict[str, float]:
    """Seconds of each part of an epoch, for this many seeds side by side."""
    config = presets.load(task, "infogoal")
    train = make_train(config)
    env, learner, hyper = train.env, train.parts.learner, config.hyper
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds, dtype=jnp.uint32))
    states = jax.jit(jax.vmap(train.initial, in_axes=(0, None, None)))(keys, hyper, env)
    draws = jax.random.split(jax.random.key(1), updates)
    images = 3 * config.learner.num_pairs  # Anchors, positives and negatives of an update.

    def rollout(state, env):
        policy = train.policy(state.params, hyper, env)
        return collect(env, state.env_states, policy, state.key, config.rollout_steps)[1]

    def updating(state, rows, env):
        buffer = replay.add(state.buffer, rows, jnp.int32(0))
        filled = jax.tree.map(lambda leaf: jnp.resize(leaf[: config.num_envs], leaf.shape), buffer)
        state = state.replace(buffer=filled, seen=jnp.ones_like(state.seen))
        last = jnp.int32(filled.valid.shape[0] // config.num_envs - 1)
        experience = make_experience(train.setup(hyper, env), state, last)[0]
        return updates_of(train.setup(hyper, env), experience, state, jax.random.key(2), updates)[0].params

    def chosen(key, env):
        return env.goals.inputs[jax.random.randint(key, (images,), 0, env.goals.num_goals)]

    def gather(state, env):
        return jax.lax.scan(
            lambda total, key: (total + chosen(key, env).sum(dtype=jnp.int32), None), jnp.int32(0), draws
        )[0]

    def encode(state, env, gradient: bool):
        def loss(params, key):
            code = learner.encode(params, chosen(key, env))
            return sum(leaf.mean() for leaf in jax.tree.leaves(code))

        def step(params, key):
            value, slope = jax.value_and_grad(loss)(params, key) if gradient else (loss(params, key), params)
            return jax.tree.map(lambda leaf, by: leaf - 1e-6 * value * by, params, slope), None

        return jax.lax.scan(step, state.params["goal"], draws)[0]

    over_seeds = {
        name: jax.vmap(function, in_axes=(0, None))
        for name, function in {
            "rollout": rollout,
            "images gathered": gather,
            "encoded": lambda state, env: encode(state, env, False),
            "encoded, with gradient": lambda state, env: encode(state, env, True),
            "all goals encoded, once": lambda state, env: encode_all(learner, state.params["goal"], env.goals),
        }.items()
    }
    rows = jax.jit(over_seeds["rollout"])(states, env)
    found = {name: timed(function, states, env)[1] for name, function in over_seeds.items()}
    found["updates"] = timed(jax.vmap(updating, in_axes=(0, 0, None)), states, rows, env)[1]
    return found


def print_rates(arguments) -> None:
    """Print the table of speeds."""
    sys.path.append(str(Path(__file__).parents[1] / "peers"))  # Peers are imported only where they are asked for.
    print(
        f"{'faithful' if arguments.faithful else 'default'} setting, random actions, episodes of 50 steps; "
        f"{describe_machine()}\n"
    )
    print(
        "| task | batch | env steps/s | physics steps/s | compile s | peer env steps/s | ratio "
        "|\n|---|---|---|---|---|---|---|"
    )
    peers = {}
    for task in arguments.tasks:
        if arguments.jaxgcrl and PEER[task] not in peers:
            from fetch_peer_mjx import measure_jaxgcrl

            peers[PEER[task]] = max(
                measure_jaxgcrl(arguments.jaxgcrl, PEER[task], batch, 20)[1] for batch in arguments.batch
            )
        name, rate = PEER[task], peers.get(PEER[task])
        if arguments.assets:
            from fetch_peer_mujoco import measure as measure_mujoco

            name, rate = "C MuJoCo, 2 processes", measure_mujoco(arguments.assets, task, arguments.seconds, 2)
        env = envs.load(task, FetchConfig(faithful=arguments.faithful, ends_at_goal=False))
        for batch in arguments.batch:
            compile_seconds, ours = measure(env, batch)
            peer = f"{rate:,.0f} ({name}) | {ours / rate:.1f}" if rate else "|"
            print(
                f"| {task} | {batch} | {ours:,.0f} | {env.physics.setting.substeps * ours:,.0f} | "
                f"{compile_seconds:.1f} | {peer} |",
                flush=True,
            )
        if arguments.parts:
            for part, milliseconds in parts(env, arguments.batch[-1]).items():
                print(f"|   {part} | {arguments.batch[-1]} | {milliseconds:.3f} ms a physics step |", flush=True)


def print_shares(arguments) -> None:
    """Print what goal images cost."""
    results = []
    for task in arguments.tasks:
        found = image_costs(task, arguments.seeds, arguments.updates)
        whole = found["rollout"] + found["updates"]  # The updates include everything else.
        shares = {
            "gather": found["images gathered"],
            "encoder": found["encoded"] - found["images gathered"],
            "gradient": found["encoded, with gradient"] - found["encoded"],
            "all goals, once an epoch": found["all goals encoded, once"],
        }
        for name, value in found.items():
            print(f"{name:24s} {value * 1e3:9.1f} ms")
        for name, value in shares.items():
            print(f"share of an epoch, {name:24s} {value / whole:6.1%}")
        print(f"{task}, {arguments.seeds} seeds, {arguments.updates} updates; {describe_machine()}")
        relative = {name: value / whole for name, value in shares.items()}
        results.append({"task": task, "seeds": arguments.seeds, "seconds": found, "shares": relative})
    if arguments.out:
        arguments.out.write_text(json.dumps({"machine": describe_machine(), "tasks": results}) + "\n")


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--tasks", nargs="+", choices=TASKS, default=["fetch_reach", "fetch_push", "fetch_pick_and_place"]
    )
    parser.add_argument("--batch", type=int, nargs="+", default=[8192])
    parser.add_argument("--faithful", action="store_true")
    parser.add_argument("--parts", action="store_true")
    parser.add_argument("--jaxgcrl", type=Path)
    parser.add_argument("--assets", type=Path)
    parser.add_argument("--seconds", type=float, default=10.0, help="for C MuJoCo")
    parser.add_argument("--images", action="store_true", help="what goal images cost in training")
    parser.add_argument("--seeds", type=int, default=5, help="for --images")
    parser.add_argument("--updates", type=int, default=100, help="for --images")
    parser.add_argument("--out", type=Path, help="file to write the numbers of --images to (json)")
    arguments = parser.parse_args()
    print_shares(arguments) if arguments.images else print_rates(arguments)


if __name__ == "__main__":
    main()
