"""A Ray cluster of this computer's own, for what is trained on several machines."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from places import ROOT


@contextmanager
def cluster_of_two(prepare: str | None = None, environment: dict[str, str] | None = None) -> Iterator:
    """A real cluster of two machines with a CPU each, and these two: (cluster, machines). This process is at a third
    machine, which has nothing to compute with. The test is skipped where Ray is not installed.

    prepare: `module.function` that every worker calls before its first task; environment: of the workers.
    """
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    runner = str(ROOT / "tests" / "runner")
    hook: dict[str, Any] = {"env_vars": environment or {}}
    if prepare is not None:
        hook["worker_process_setup_hook"] = prepare
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(ROOT / "tests"), runner]))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.syspath_prepend(runner)
        there = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        machines = [there.add_node(num_cpus=1) for _ in range(2)]
        ray.init(address=there.address, runtime_env=hook, log_to_driver=False)
        try:
            yield there, machines
        finally:
            ray.shutdown()
            there.shutdown()
