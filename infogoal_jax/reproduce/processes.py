"""Processes beside this one: several on one folder, so that programs are compiled side by side and small ones share a
GPU; and the connection to a Ray cluster."""

import contextlib
import logging
import os
import subprocess
import sys
import threading
from pathlib import Path

from infogoal_jax.errors import UserError
from infogoal_jax.stopping import stop_on_signal

MEMORY = 0.9
"""Share of a GPU's memory that its processes have together."""
WAIT = 0.5
"""Seconds between two looks at a signal."""


def work_side_by_side(arguments: list[str], processes: int, gpus: int, say=print) -> list[int]:
    """Run `infogoal ARGUMENTS` in so many processes, spread over GPUs 0, 1, ...; gpus: how many, 0: leave devices as
    they are. What they print is printed, with the number of the process. Returns their exit statuses.

    A signal is handed on: each process stops after its evaluation.
    """
    children, readers = [], []
    with stop_on_signal() as stop:
        for number in range(processes):
            child = subprocess.Popen(
                [sys.executable, "-m", "infogoal_jax", *arguments],
                env=environment(number, processes, gpus),
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
            )
            children.append(child)
            readers.append(threading.Thread(target=repeat, args=(number, child, say), daemon=True))
            readers[-1].start()
        stop.finishing = "the evaluations of its processes"
        try:
            wait(children, stop)
        finally:
            stop.finishing = ""
            for child in children:
                if child.poll() is None:
                    child.terminate()
    for reader in readers:
        reader.join()
    return [child.wait() for child in children]


def wait(children: list[subprocess.Popen], stop) -> None:
    """Wait for all processes; hand a signal on to them once."""
    told = False
    while any(child.poll() is None for child in children):
        if stop.requested and not told:
            told = True
            for child in children:
                child.terminate()
        for child in children:
            try:
                child.wait(WAIT / len(children))
            except subprocess.TimeoutExpired:
                continue


def environment(number: int, processes: int, gpus: int) -> dict[str, str]:
    """The environment of a process: its GPU, and its share of the memory."""
    if not gpus:
        return dict(os.environ)
    on_one = -(-processes // gpus)
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    names = visible.split(",") if visible else [str(gpu) for gpu in range(gpus)]
    return os.environ | {
        "CUDA_VISIBLE_DEVICES": names[number % min(gpus, len(names))],
        "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{MEMORY / on_one:.3f}",
    }


def repeat(number: int, child: subprocess.Popen, say) -> None:
    """Print what a process prints."""
    with child.stdout:
        for line in child.stdout:
            say(f"{number}: {line.rstrip()}", flush=True)


def arguments_of(asked, minutes: float) -> list[str]:
    """The arguments of one process: what was asked for, without drawing, for so many minutes."""
    words = ["reproduce", asked.name, "--no-draw", "--out", str(Path(asked.out)), "--seeds", str(asked.seeds)]
    words += ["--vmap-size", str(asked.vmap_size), "--minutes", str(minutes)]
    for flag, values in (
        ("tasks", asked.tasks),
        ("methods", asked.methods),
        ("variants", asked.variants),
        ("sets", asked.sets),
    ):
        words += [f"--{flag}", *map(str, values)] if values else []
    words += ["--known", str(asked.known)] if asked.known else []
    words += ["--goal-images", str(asked.goal_images)] if asked.goal_images else []
    return words + ["--retry"] * asked.retry + ["--quick"] * asked.quick


@contextlib.contextmanager
def connected(address: str):
    """Inside, the process is connected to the cluster. Gives the module `ray`."""
    try:
        import ray
    except ImportError as error:
        raise UserError("engine = 'ray': is not installed; pip install 'infogoal-jax[ray]'") from error
    if ray.is_initialized():
        yield ray
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Of the cluster that is started here.
    own = {} if address else {"include_dashboard": False}
    try:
        ray.init(address=address or "local", log_to_driver=False, logging_level=logging.ERROR, **own)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise UserError(
            f"ray_address = {address!r}: {str(error).strip() or type(error).__name__}; give HOST:PORT of a cluster "
            "that this machine belongs to, auto for the one that runs here, or ray://HOST:10001"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()
