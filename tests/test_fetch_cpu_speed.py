"""Fetch on the CPU is fast without a flag: XLA's CPU fusions would multiply the work along the arm, and a barrier keeps them from it.

The one timed test of the project, and a ratio: the same program in a process that starts its devices before anything of ours is imported, and in one
with those fusions switched off.
"""

import json
import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import pytest

from infogoal_jax.envs import load
from infogoal_jax.envs.fetch.physics import mjx, scan, shallow_fusions

SWITCHED_OFF = "--xla_cpu_use_fusion_emitters=false"
LARGEST_RATIO = 3.0
"""With the barrier it is 1; without, 700."""
PROGRAM = """
import json, time
import jax
jax.devices()  # The backend reads its flags now, before we are imported.
import jax.numpy as jnp
from infogoal_jax.envs import load

env = load("fetch_reach")
states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 16))
step = jax.jit(jax.vmap(env.step))
actions = jnp.zeros((16, 4))
times = []
for _ in range(12):
    started = time.perf_counter()
    states = jax.block_until_ready(step(states, actions))
    times.append(time.perf_counter() - started)
print(json.dumps(times))
"""


def fastest_step(flags: str) -> float:
    """Seconds of the fastest step of 16 robots, after the one that compiles, in a process of its own with these XLA flags."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"} | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    return min(json.loads(done.stdout.splitlines()[-1])[1:])


def test_the_cpu_is_fast_without_a_flag_and_however_late_we_are_imported():
    ratio = fastest_step("") / fastest_step(SWITCHED_OFF)
    assert ratio < LARGEST_RATIO


@pytest.fixture(scope="module")
def arm():
    """Physics of the smallest arm, and the number of barriers when its kinematics is traced."""
    physics = load("fetch_reach").physics

    def barriers() -> int:
        data = physics.template

        def kinematics(position):
            return mjx.kinematics(physics.model, data.replace(qpos=position)).xpos

        # A new function each time, or the trace would come from a cache.
        return str(jax.make_jaxpr(lambda position: kinematics(position))(jnp.zeros(physics.model.nq))).count("optimization_barrier")

    return physics, barriers


def test_the_barrier_is_in_every_walk_over_the_tree_inside_the_block_and_nowhere_else(arm):
    """Fails if an MJX walks its tree by another function than the one that is replaced."""
    physics, barriers = arm
    installed = scan.body_tree
    assert barriers() == 0
    with shallow_fusions():
        assert scan.body_tree is not installed
        inside = barriers()
    assert scan.body_tree is installed
    assert inside >= physics.model.nbody // 2 and barriers() == 0


def test_a_step_is_traced_with_barriers_and_leaves_mjx_as_it_was():
    env, installed = load("fetch_reach"), scan.body_tree
    state = jax.eval_shape(env.reset, jax.random.key(0))
    traced = str(jax.make_jaxpr(env.step)(state, jnp.zeros(4)))
    assert traced.count("optimization_barrier") > 10
    assert scan.body_tree is installed


def test_mjx_is_restored_when_tracing_raises():
    installed = scan.body_tree
    with pytest.raises(ZeroDivisionError), shallow_fusions(), shallow_fusions():
        raise ZeroDivisionError
    assert scan.body_tree is installed


def test_two_threads_trace_one_after_the_other_and_restore_mjx(arm):
    """The second waits for the first, so that neither takes the other's replacement for the original."""
    _, barriers = arm
    installed, entered, counts = scan.body_tree, threading.Event(), []

    def trace():
        with shallow_fusions():
            entered.set()
            counts.append(barriers())

    with shallow_fusions():
        other = threading.Thread(target=trace)
        other.start()
        assert not entered.wait(0.3)
        counts.append(barriers())
    other.join(60)
    assert entered.is_set() and scan.body_tree is installed
    assert counts[0] == counts[1] > 0

    threads = [threading.Thread(target=trace) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert {*counts} == {counts[0]} and len(counts) == 6
    assert scan.body_tree is installed and barriers() == 0
