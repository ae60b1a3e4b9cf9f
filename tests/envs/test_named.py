"""Environments of other libraries by their names, from the command line to a run that remembers them."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from infogoal_jax import agents, envs, presets
from infogoal_jax.cli.choice import with_environment
from infogoal_jax.cli.main import main
from infogoal_jax.data.episodes import of_arrays, save
from infogoal_jax.envs import named
from infogoal_jax.errors import UserError
from infogoal_jax.loading import load_environment, reasons_against
from infogoal_jax.report.methods import against
from infogoal_jax.runs import configuration

# Of brax itself, about the fields of MuJoCo that it reads.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
FAMILIES = ("brax", "playground", "jaxgcrl")
SMALL = "--num-epochs 1 --epochs-per-evaluation 1 --env.episode-length 10 --rollout-steps 10 --num-envs 2"
SMALL += " --updates-per-epoch 2 --batch-size 8 --evaluation-starts 1 --no-figures"


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("--env brax:reacher --seeds 2", "brax --env.id reacher --seeds 2"),
        ("--seeds 2 --env=jaxgcrl:ant", "jaxgcrl --env.id ant --seeds 2"),
        ("--env playground:ReacherEasy --help", "playground --env.id ReacherEasy --help"),
        ("brax:reacher --seeds 2", "brax:reacher --seeds 2"),
        ("point_maze --env.held-out", "point_maze --env.held-out"),
        ("--env ogbench:cube-single-play-v0 --seeds 2", "ogbench --env.id cube-single-play-v0 --seeds 2"),
        ("--env ogbench:my/walks.npz", "ogbench --env.dataset my/walks.npz"),
        ("--env ogbench:~/walks.npz", f"ogbench --env.dataset {Path.home()}/walks.npz"),
        ("", ""),
    ],
)
def test_words_mean_a_task_and_a_name(words, meant):
    assert with_environment(words.split()) == meant.split()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "--env brx:reacher",
            "env = 'brx:reacher': give brax:NAME or playground:NAME or jaxgcrl:NAME or gymnasium:NAME",
        ),
        ("--env brax:", "env = 'brax:': give brax:NAME"),
        ("--env", "env = '': give brax:NAME"),
        ("--env brax", "or gymnasium:NAME or ogbench:NAME\n"),
        ("brax:reacher", "task = 'brax:reacher': no such task"),
        ("brax:reacher", "another library's: --env LIBRARY:NAME\n"),
        ("point_maze --env brax:reacher", "'point_maze' is a task already"),
        ("--env brax:reachr", "env.id = 'reachr': brax has no such environment. Did you mean 'reacher'?"),
        ("--env gymnasium:FetchReech-v4", "env.id = 'FetchReech-v4': Gymnasium has no such environment"),
        ("--env gymnasium:CartPol-v9", "one of your own: --import FILE that registers it. Did you mean 'CartPole-v1'?"),
        ("--env jaxgcrl:antt", "env.id = 'antt': no such environment. Did you mean 'ant'?"),
        ("--env brax:ant", "env.goal = (): no goal of brax:ant is known; name places"),
        ("--env brax:pusher", "env.goal = (): no goal of brax:pusher is known; name places"),
        ("--env brax:reacher --env.goal 4 5", "env.achieved = (): goes with --env.goal"),
        pytest.param(
            "--env brax:reacher --env.goal 4 --env.achieved 99 --env.radius 1",
            "env.achieved = [99]: give places",
            marks=pytest.mark.long,
        ),
        ("--env brax:reacher --env.goal 4 --env.achieved 0", "env.radius = 0.0: goes with --env.goal"),
        ("--env brax:reacher --env.radius -1", "env.radius = -1.0: give a distance"),
        ("--env ogbench:antmaze-v0", "env.id = 'antmaze-v0': is not in ~/.ogbench/data: ogbench.download_datasets"),
        (
            "--env ogbench:gone.npz --env.dataset other.npz",
            "env = 'ogbench:gone.npz': says what --env.dataset does, which is given too; leave one of both out",
        ),
        ("--env brax:reacher --env.id=ant", "env = 'brax:reacher': says what --env.id does, which is given too"),
        ("--env brax:reacher --env.goal tip --env.achieved 0", "env.goal = 'tip': give a whole number"),
        ("--env ogbench:gone.npz", "env.dataset = 'gone.npz': no such file"),
        ("ogbench", "env.id = '': name a dataset of OGBench, or give --env.dataset FILE"),
    ],
)
def test_what_is_not_there_is_one_line(words, said, capsys):
    assert main(["train", *words.split(), "--method", "none"]) == 2
    output, error = capsys.readouterr()
    assert said in error and error.count("\n") == 1 and not output


@pytest.mark.parametrize("family", FAMILIES)
def test_a_missing_package_is_one_line(family, monkeypatch):
    for module in ("brax.envs", "mujoco_playground"):
        monkeypatch.setitem(sys.modules, module, None)
    config = presets.load(family, "none")
    with pytest.raises(UserError, match=r"cannot be imported .*; pip install") as error:
        load_environment(dataclasses.replace(config, env=dataclasses.replace(config.env, id="reacher")))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("family", FAMILIES)
def test_lists_of_tasks_have_it_only_once_it_is_asked_for(family):
    assert family not in presets.registry and family not in envs.registry
    config = presets.load(family, "none")
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, id="x", goal=(1,), achieved=(2,)))
    values = configuration.to_dict(config)
    for registry in (envs.registry, presets.registry):
        del registry[family]
    assert configuration.from_dict(values) == config  # A run of it is read in a process that never heard of it.


@pytest.mark.long
def test_what_brax_has_is_what_is_told():
    """The goal is where the tip has to be, and the agent sees none of it."""
    config = presets.load("brax", "none").env
    task = named.make_brax(dataclasses.replace(config, id="reacher", episode_length=7))
    assert task.goals.shape == (2,) and task.radius == 0.02 and task.episode_length == 7
    assert task.shown == (0, 1, 2, 3, 6, 7) and task.source == "reacher of brax, simulated"
    own = dataclasses.replace(config, id="reacher", goal=(4, 5), achieved=(0, 1), radius=0.3)
    told = named.arguments_of("brax", own, named.BRAX["reacher"])
    assert (told["goal"], told["achieved"], told["hidden"], told["radius"]) == ([4, 5], [0, 1], [], 0.3)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # Of packages that ask for others' older versions.
@pytest.mark.parametrize(
    ("name", "package", "said"),
    [
        ("brax:reacher", "brax", "reacher of brax"),
        ("playground:ReacherEasy", "mujoco_playground", "ReacherEasy of MuJoCo Playground"),
        ("jaxgcrl:ant", "jaxgcrl", "ant of JaxGCRL"),
    ],
)
def test_a_run_remembers_its_environment(name, package, said, tmp_path, capsys):
    """It is trained, gone on with, evaluated and exported, where the package is installed."""
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    run = str(tmp_path / "run")
    assert main(["train", "--env", name, "--method", "none", *SMALL.split(), "--out", run]) == 0
    assert said in capsys.readouterr().out
    for words in (["train", "--resume", run, "--num-epochs", "2", "--no-figures"], ["evaluate", run]):
        assert main(words) == 0
    assert main(["export", run, "--out", str(tmp_path / "policy.npz")]) == 0
    assert (tmp_path / "policy.npz").exists()


@pytest.mark.parametrize("downloaded", [True, False])
def test_a_dataset_of_ogbench_is_learned_from_by_its_name(downloaded, tmp_path, monkeypatch, capsys):
    """Where OGBench downloads to, or from a file, which may have moved when the run goes on."""
    monkeypatch.setenv("HOME", str(tmp_path))
    seen = np.random.default_rng(0).uniform(-1, 1, (60, 3)).astype(np.float32)
    file = tmp_path / ".ogbench" / "data" / "walks-v0.npz"
    file.parent.mkdir(parents=True)
    save(file, of_arrays({"observations": seen, "actions": seen[:, :2], "terminals": np.arange(60) % 20 == 19}))
    run, words = str(tmp_path / "run"), "--num-epochs 1 --epochs-per-evaluation 1 --updates-per-epoch 2 --batch-size 8"
    name = "walks-v0" if downloaded else str(file)
    command = ["train", "--env", f"ogbench:{name}", "--method", "none", *words.split(), "--no-figures", "--out", run]
    assert main(command) == 0 and "learned from recordings" in capsys.readouterr().out
    assert configuration.read(tmp_path / "run").config.agent == presets.load("ogbench", "none").agent
    moved = []
    if not downloaded:
        file.rename(tmp_path / "moved.npz")
        moved = ["--env.dataset", str(tmp_path / "moved.npz")]
    assert main(["train", "--resume", run, "--num-epochs", "2", "--no-figures", *moved]) == 0


def test_every_method_and_agent_is_judged_for_recordings_alone(tmp_path):
    """Among them InfoGoal, which is asked for where no method is named; agents that choose among moves by the file."""
    assert not any(against("ogbench", name) for name in ("infogoal", "cogoal", "none"))
    for agent in agents.registry:  # Checks ask for the length of an episode, which no file tells before it is read.
        parts = {"agent": agent} if agent in ("dqn", "cql") else {"agent": agent, "relabelling": "mixed"}
        acts = agents.traits_of(agents.registry[agent].config()).actions
        assert bool(against("ogbench", "none", **parts)) == (acts != "vectors" or agent in ("td3", "sac", "crl")), agent
    for agent in ("td3", "sac", "crl"):
        assert not against("ogbench", "none", agent=agent, relabelling="her")
    for moves in (False, True):
        actions = np.arange(12) % 3 if moves else np.zeros((12, 1))
        np.savez(tmp_path / "walks.npz", actions=actions)  # Its header is enough.
        env = named.OGBenchConfig(dataset=str(tmp_path / "walks.npz"))
        for agent, relabelling, of_moves in (("cql", "her", True), ("gciql", "mixed", False)):
            config = presets.load("ogbench", "none", agent=agent, relabelling=relabelling, env=env)
            assert [refusal.field for refusal in reasons_against(config)] == ["agent"] * (moves != of_moves)
