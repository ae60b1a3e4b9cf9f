"""What several test files share because it takes long to compile."""

import gc
from pathlib import Path

import jax
import pytest

from infogoal_jax import presets
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.train import host

MEMORY_MAPS = Path("/proc/self/maps")
MANY_MAPS = 20_000
"""On a CPU a program with the physics of Fetch lies in some 6,000 memory maps. Linux allows a process 65,530, and LLVM aborts it at the next."""


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Forget compiled programs between files when they are many; what is needed again is compiled again."""
    yield
    if MEMORY_MAPS.exists() and MEMORY_MAPS.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def reach_run(tmp_path_factory) -> host.Sweep:
    """Two seeds of FetchReach with image goals, trained for two epochs on episodes of 10 steps: nothing is learned, everything is there."""
    config = presets.load(
        "fetch_reach", env=FetchConfig(goals="images", episode_length=10), num_epochs=2, epochs_per_evaluation=1, num_envs=8, rollout_steps=10,
        updates_per_epoch=2, batch_size=16, buffer_steps=160, evaluation_starts=1,
    )
    return host.run(config, [0, 1], tmp_path_factory.mktemp("reach") / "run")
