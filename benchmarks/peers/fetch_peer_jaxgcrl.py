"""Speed of JaxGCRL's robot arms (brax on MJX): random actions, whole rollout under one jit, to set beside our Fetch
tasks.

    git clone https://github.com/MichalBortkiewicz/JaxGCRL jaxgcrl
    python benchmarks/peers/fetch_peer_jaxgcrl.py --repository jaxgcrl [--tasks panda_reach panda_push_easy] [--batch
    4096] [--steps 50]

Only the environments' own modules and models are loaded, so that none of what JaxGCRL pins (an old JAX, wandb) has to
be there. Meshes are left out of the models: they are for pictures only, static bodies apart no body's mass comes from
them, and contacts are pairs of primitives.
A control step is theirs: 25 substeps of 2 ms, 6 solver iterations. On a CPU set
XLA_FLAGS=--xla_cpu_use_fusion_emitters=false.
"""

import argparse
import importlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import jax

from infogoal_jax.report.statistics import describe_machine

TASKS = {"panda_reach": ("arm_reach", "ArmReach"), "panda_push_easy": ("arm_push_easy", "ArmPushEasy")}
ACTION_SIZES = {"panda_reach": 4, "panda_push_easy": 5}


def without_meshes(model: Path) -> str:
    """The MJCF `model` less its meshes and the geoms that show them."""
    root = ElementTree.parse(model).getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag == "geom" and "mesh" in child.attrib and child.get("class") != "visual":
                raise ValueError(f"{model.name}: mesh {child.get('mesh')} takes part in collisions")
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
    module, name = TASKS[task]
    environment = getattr(importlib.import_module(f"manipulation.{module}"), name)
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / f"{task}.xml"
        model.write_text(without_meshes(environments / "assets" / model.name))
        env = type(name, (environment,), {"_get_xml_path": lambda self: str(model)})()
    return jax.vmap(env.reset), jax.vmap(env.step)


def measure(repository: Path | str, task: str, batch: int, steps: int) -> tuple[float, float]:
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


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repository", type=Path, required=True, help="a checkout of JaxGCRL")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--batch", type=int, nargs="+", default=[4096])
    parser.add_argument("--steps", type=int, default=50)
    arguments = parser.parse_args()
    print(f"JaxGCRL, {describe_machine()}\n")
    print("| task | batch | env steps/s | physics steps/s | compile s |")
    print("|---|---|---|---|---|")
    for task in arguments.tasks:
        for batch in arguments.batch:
            compile_seconds, rate = measure(arguments.repository, task, batch, arguments.steps)
            print(f"| {task} | {batch} | {rate:,.0f} | {25 * rate:,.0f} | {compile_seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
