"""Every benchmark runs at toy size, from its command line to its last line. Those that measure another program beside
ours, or what others recorded, are named with what they need; their help is asked for, so that they start.

Benchmarks have the sizes of presets: here `presets.load` gives small ones, whatever they ask for."""

import json
import runpy
import sys

import jax
import jax.numpy as jnp
import pytest
from places import ROOT

from infogoal_jax import envs, presets
from infogoal_jax.hyperparameters import with_values

SMALL = {"num_epochs": 1, "epochs_per_evaluation": 1, "updates_per_epoch": 2, "batch_size": 8, "evaluation_starts": 1}
COLLECTED = {"num_envs": 2, "rollout_steps": 3, "buffer_steps": 100}

RUN = {
    "speed/training.py": [
        "rates --repeats 1",
        "rates --tasks fetch_pick_and_place --repeats 1",
        "size",
        "evaluating --seeds 2 --repeats 1",
    ],
    "speed/update_bytes.py": ["--tasks object_search fetch_reach --seeds 2 --largest 3"],
    "speed/offline.py": ["--batch 8 --seeds 2 --updates 2 --epochs 1"],
    "speed/before_and_after.py": [f"{ROOT} --programs rooms/her/1/2 rooms/infogoal/2/2 --rounds 1 --turns 1"],
    "speed/success.py": ["run after object_search infogoal --seeds 2 --bfloat16 --out {tmp}"],
    "speed/fetch.py": ["--tasks fetch_reach --batch 2"],
    "speed/first_run.py": ["run --seeds 1", "update --seeds 1"],
    "speed/first_steps.py": ["--only help"],
    "goals/continuous.py": ["negatives --seeds 1 --num-epochs 1 --only trajectory --out {tmp}/study.json"],
    "fidelity/fetch_absurd.py": ["--tasks fetch_reach --steps 10 --batch 2"],
    "fidelity/fetch_parity.py": [f"{ROOT}/tests/fixtures/fetch_gymnasium_v4.npz"],
}
"""Arguments of each, as often as it is run."""

NEED = {
    "fidelity/drone_faults.py": "tests/drone/test_fly.py flies the same",
    "fidelity/drone_flights.py": "tests/drone/test_fly.py flies the same",
    "fidelity/fetch_chaos.py": "the files of gymnasium-robotics",
    "fidelity/fetch_transfer.py": "gymnasium-robotics",
    "fidelity/record_fetch_reference.py": "gymnasium-robotics",
    "peers/fetch_peer_mjx.py": "MJX with Warp, or JaxGCRL",
    "peers/fetch_peer_mujoco.py": "the files of gymnasium-robotics",
    "peers/fetch_sb3_her.py": "Stable-Baselines3",
    "peers/gridworld_peer_leo.py": "a checkout of purejaxgcrl; our side is trained below",
    "peers/jaxgcrl_peer.py": "the package of JaxGCRL",
    "peers/ogbench_peer.py": "ogbench, and a checkout of it; tests/paper/test_ogbench.py runs our side",
    "peers/offline_peer.py": "PyTorch, and arrays that offline.py writes",
}
"""What a benchmark needs that is not here."""


def small(load):
    """`presets.load` with small sizes in place of others."""

    def loaded(task, *words, **changes):
        config = load(task, *words, **{**changes, **SMALL, **({} if task == "embodied_qa" else COLLECTED)})
        return with_values(config, {"learner.num_pairs": 8}) if hasattr(config.learner, "num_pairs") else config

    return loaded


def test_bytes_are_those_of_arrays_and_of_the_parts_that_are_taken(monkeypatch):
    """A loop that adds a row of a table to a vector: it reads vector and row, and writes the vector."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "speed"))
    import update_bytes

    def loop(table, vector, rows):
        return jax.lax.scan(lambda carry, row: (jnp.tanh(carry) + table[row], None), vector, rows)[0]

    shapes = jnp.zeros((64, 1000)), jnp.zeros(1000), jnp.zeros(7, jnp.int32)
    kernels = update_bytes.Program(jax.jit(loop).lower(*shapes).compile().as_text()).largest_loop()
    assert 3 * 4000 <= sum(size for _, size in kernels) / 7 <= 3 * 4000 + 100
    assert update_bytes.bytes_of_shape("(f32[2,3]{1,0}, s8[4], pred[])") == 24 + 4 + 1


def test_success_is_compared_seed_by_seed(monkeypatch, capsys, tmp_path):
    for label, values in (("before", [0.5, 0.7]), ("after", [0.6, 0.9])):
        runs = {"label": label, "task": "object_search", "method": "infogoal", "seeds": 2, "updates": 10_000}
        runs |= {"machine": "2 CPU cores, jax 0.10.2, 2026-11-30"}
        runs["success"] = {"test_goal/success_rate": [[0.0, value] for value in values]}
        (tmp_path / f"success_{label}.json").write_text(json.dumps(runs))
    monkeypatch.setattr(sys, "argv", ["success.py", "compare", str(tmp_path)])
    runpy.run_path(str(ROOT / "benchmarks" / "speed" / "success.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert "| object_search | infogoal | 10,000 | test | 0.600 | 0.750 | 0.150 ± 0.635 |" in printed
    assert "2 seeds; 2 CPU cores" in printed


def test_every_benchmark_is_run_or_says_what_it_needs():
    there = {path.relative_to(ROOT / "benchmarks").as_posix() for path in (ROOT / "benchmarks").glob("*/*.py")}
    assert there == {*RUN, *NEED} and not {*RUN} & {*NEED}


@pytest.mark.long
@pytest.mark.parametrize(("name", "words"), [(name, words) for name, each in RUN.items() for words in each])
def test_runs_at_toy_size(name, words, monkeypatch, capfd, tmp_path):
    monkeypatch.setattr(presets, "load", small(presets.load))
    path = ROOT / "benchmarks" / name
    monkeypatch.setattr(sys, "argv", [str(path), *words.format(tmp=tmp_path).split()])
    monkeypatch.syspath_prepend(str(path.parent))
    try:
        runpy.run_path(str(path), run_name="__main__")
    except SystemExit as end:
        assert not end.code
    assert capfd.readouterr().out.strip()


@pytest.mark.long
def test_our_side_beside_leo_is_trained(monkeypatch, request):
    """Its gridworld is an environment of its own, of which no other test knows."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "peers"))
    import gridworld_peer_leo

    for name, value in {"NUM_ENVS": 8, "ROLLOUT": 16, "BATCH": 16}.items():
        monkeypatch.setattr(gridworld_peer_leo, name, value)
    for registry in (envs.registry, presets.registry):
        request.addfinalizer(lambda registry=registry: registry.pop(gridworld_peer_leo.TASK, None))
    walls = jnp.pad(jnp.zeros((3, 3), bool), 1, constant_values=True)
    found = gridworld_peer_leo.run_ours(walls, total_steps=256, hidden=(8, 8), points=2, seeds=2)
    assert found.success.shape == (2, 2) and list(found.steps) == [128, 256]


@pytest.mark.long
@pytest.mark.parametrize("name", NEED)
def test_starts(name, monkeypatch, capsys):
    """Imports of what is not installed come before the help: they are named."""
    path = ROOT / "benchmarks" / name
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    monkeypatch.syspath_prepend(str(path.parent))
    try:
        runpy.run_path(str(path), run_name="__main__")
    except SystemExit as end:
        assert not end.code and "usage" in capsys.readouterr().out
    except ModuleNotFoundError as error:
        pytest.skip(f"{name} needs {NEED[name]}: {error}")
