"""The wheel, installed in an environment of its own where the repository is not: everything a user does first works."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

pytestmark = pytest.mark.long  # It installs everything anew, for which pip needs a network or its cache.

TINY = (
    "--num-epochs 2 --epochs-per-evaluation 1 --updates-per-epoch 2 --num-envs 4 --rollout-steps 10 --batch-size 16 "
    "--buffer-steps 100 --evaluation-starts 1 --agent.num-steps 2 --state-encoder.features 16 --agent.hidden 16"
)
FROM_PYTHON = """
import sys
import jax, numpy as np
import infogoal_jax
from infogoal_jax import envs, presets
from infogoal_jax.data import backgrounds
assert infogoal_jax.__file__.startswith(sys.prefix), infogoal_jax.__file__
assert not {"tensorboardX", "wandb", "gymnasium"} & {*sys.modules}
run = infogoal_jax.load_run("run")
action = run.policy(1)(np.zeros(1, np.int32), np.zeros(1, np.int32), jax.random.key(0))
assert action.shape == (1,)
for task in presets.TASKS:  # Goal images, backgrounds, low levels, questions and texts are in the wheel or are built.
    env = infogoal_jax.make_train(presets.load(task)).env
    assert env.goals.num_goals > 1, task
    print(task, env.goals.num_goals)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with an environment `env` in which the wheel is installed."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "infogoal_jax", source / "infogoal_jax", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    run(folder, sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", ".", "./source")
    shutil.rmtree(source)
    run(folder, sys.executable, "-m", "venv", "env")
    (wheel,) = folder.glob("*.whl")
    run(folder, python(folder), "-m", "pip", "install", "--quiet", "-c", ROOT / "constraints.txt", wheel)
    return folder


def python(folder: Path) -> Path:
    """The interpreter of the new environment."""
    return folder / "env" / "bin" / "python"


def run(folder: Path, *command: str | Path) -> str:
    """What a command prints in this folder, without the repository on its path."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stdout[-2000:]} {done.stderr[-2000:]}"
    return done.stdout


def test_the_first_things_that_a_user_does(folder):
    """The console command trains, evaluates and draws; `python -m infogoal_jax` is the same; shipped data load."""
    infogoal = folder / "env" / "bin" / "infogoal"
    assert "train" in run(folder, infogoal)
    assert "object_search" in run(folder, python(folder), "-m", "infogoal_jax", "methods")
    assert "success rate" in run(folder, infogoal, *f"train object_search --seeds 2 --out run {TINY}".split())
    assert "success rate" in run(folder, infogoal, *"evaluate run --starts 1".split())
    assert "learning_curves.pdf" in run(folder, infogoal, *"report run --format pdf".split())
    assert (folder / "run" / "figures" / "learning_curves.png").stat().st_size > 10_000
    assert len(run(folder, python(folder), "-I", "-c", FROM_PYTHON).splitlines()) == 6
