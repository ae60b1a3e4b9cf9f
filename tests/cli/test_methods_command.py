"""What `infogoal methods` says is what training does: one set of refusals, told from names, true of the environments
themselves."""

import dataclasses
import json
import re
import subprocess
import sys

import hand_made
import hand_made_frames
import hand_made_points
import pytest

from infogoal_jax import agents, exploration, learners, presets
from infogoal_jax.agents.agent import AgentTraits
from infogoal_jax.agents.dqn import DQNConfig
from infogoal_jax.cli.choice import is_of_method
from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import NoHyperparameters
from infogoal_jax.learners import none
from infogoal_jax.learners.learner import has_own_loss, teaches_goals
from infogoal_jax.loading import check_combination, make_learner, reasons_against, traits_declared, traits_seen
from infogoal_jax.presets.loading import run_title, train_flags
from infogoal_jax.registry import Entry
from infogoal_jax.report import methods
from infogoal_jax.runs.configuration import from_dict, to_dict


@dataclasses.dataclass(frozen=True)
class Flat(DQNConfig):
    """Of an agent whose actions are vectors."""


PAIRS = [(task, method) for task in presets.TASKS for method in presets.METHODS]


@pytest.mark.parametrize(
    ("env", "config"),
    [
        (hand_made.environment, hand_made.config),
        (hand_made_frames.manipulation, hand_made_frames.manipulation_config),
        (hand_made_frames.qa, hand_made_frames.qa_config),
        (hand_made_points.points, hand_made_points.config),
        (hand_made_points.steered, hand_made_points.config),
    ],
    ids=["object_search", "object_manipulation", "embodied_qa", "fetch", "fetch steered"],
)
def test_traits_known_by_name_are_those_of_the_environment(env, config):
    assert traits_declared(config("none")) == traits_seen(env())


def test_every_task_is_judged_before_it_is_loaded():
    assert all(traits_declared(presets.load(task)) is not None for task in presets.TASKS)


def test_an_agent_that_chooses_vectors_acts_where_actions_are_vectors(monkeypatch):
    flat = agents.registry["dqn"]._replace(config=Flat, traits=lambda config: AgentTraits("vectors"))
    monkeypatch.setitem(agents.registry, "flat", flat)
    assert not reasons_against(presets.load("fetch_push", "none", agent="flat"))
    (refusal,) = reasons_against(presets.load("object_search", "none", agent="flat"))
    assert refusal.field == "agent" and "dqn" in refusal.remedy and "flat" not in refusal.remedy


def test_the_list_has_each_task_where_training_starts_or_with_the_reason_why_it_refuses():
    """What is printed, against what training is asked."""
    reasons = {
        (task, name): reason
        for name in presets.METHODS
        for reason, tasks in methods.where(name, presets.TASKS).items()
        for task in tasks
    }
    assert set(reasons) == set(PAIRS)
    for (task, name), reason in reasons.items():
        if not reason:
            check_combination(presets.load(task, name))
            continue
        field = methods.against(task, name)[0].field
        with pytest.raises(UserError, match=rf"^({re.escape(field)} = .*)?{re.escape(reason.split(';')[0])}"):
            check_combination(presets.load(task, name))


def test_the_list_is_readable_on_a_narrow_terminal(monkeypatch, capsys):
    """At 80 columns no line is longer, no name is cut, and what a method is takes a few lines."""
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["methods"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80 and len(lines) < 12 * len(presets.METHODS)
    for name in (*presets.METHODS, *presets.TASKS):
        assert any(re.search(rf"\b{name}\b", line) for line in lines), name


def test_methods_that_bring_a_learner_or_a_relabelling_go_together_with_every_task():
    """The rows of the paper's Table I; what learns from all goals at once needs an agent of moves. Where goals are
    continuous, methods that count or rank the goals of a set are refused too."""
    refused = {(task, name) for task, name in PAIRS if methods.against(task, name)}
    everywhere = {name for name, parts in presets.METHODS.items() if parts.explorer != "none" or parts.learner == "leo"}
    continuous = {task for task in presets.TASKS if not traits_declared(presets.load(task)).finite_goals}
    assert {name for task, name in refused if task not in continuous} <= everywhere
    assert {name for task, name in refused if task in continuous} == everywhere | {"cher", "ghrl", "all_goals"}
    assert not methods.against("object_manipulation", "leo", agent="dqn")


@pytest.mark.parametrize("explorer", [name for name in exploration.registry if name != "none"])
def test_a_bonus_goes_together_with_lists_of_observations_and_moves(explorer):
    assert not reasons_against(presets.load("object_search", "none", explorer=explorer))
    assert reasons_against(presets.load("object_manipulation", "none", explorer=explorer))
    reasons = {
        task: " ".join(refusal.reason for refusal in methods.against(task, "none", explorer=explorer))
        for task in presets.TASKS
    }
    assert (
        "recorded" in reasons["embodied_qa"]
        and "finite" in reasons["fetch_push"]
        and "continuous" in reasons["fetch_push"]
    )
    by_moves = presets.load("object_manipulation", "none", agent="dqn", explorer=explorer)
    assert "do not form a finite set" in reasons_against(by_moves)[0].reason


@pytest.mark.parametrize("name", list(presets.METHODS))
def test_a_method_is_described_by_whole_sentences(name):
    assert methods.description(name).endswith(".") and len(methods.description(name)) < 250


def test_each_method_has_a_description_of_its_own():
    """LEO was described as its relabelling is."""
    assert len({methods.description(name) for name in presets.METHODS}) == len(presets.METHODS)


def test_agents_of_each_task():
    moves, drives, vectors = {"dqn", "cql"}, {"hrac"}, {"td3", "sac", "crl"}
    expected = dict.fromkeys(presets.FETCH_TASKS, drives | vectors) | {
        "object_search": moves,
        "object_manipulation": moves | drives,
        "embodied_qa": moves,
    }
    for task, names in expected.items():
        assert set(methods.agents_of(task)) & (moves | drives | vectors) == names


@pytest.mark.parametrize(
    ("task", "changes", "field"),
    [
        ("object_search", {"training_corruption": 0.4}, "training_corruption"),
        ("embodied_qa", {"training_corruption": 0.4}, "training_corruption"),
        ("fetch_reach", {"training_corruption": 0.4}, None),
        ("object_manipulation", {"training_corruption": 0.4}, None),
        ("fetch_push", {"agent": "dqn"}, "agent"),
        ("embodied_qa", {"agent": "hrac"}, "agent"),
        ("object_search", {"stop_encoder_gradient": True}, "stop_encoder_gradient"),
        ("object_search", {"method": "her", "stop_encoder_gradient": True}, "stop_encoder_gradient"),
        ("object_search", {"method": "infogoal", "stop_encoder_gradient": True}, None),
    ],
)
def test_refusals_by_name(task, changes, field):
    config = presets.load(task, **({"method": "none"} | changes))
    assert [refusal.field for refusal in reasons_against(config)] == ([] if field is None else [field])


def test_target_states_of_positions_are_refused_by_name():
    config = presets.load("fetch_reach", "none")
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, goals="positions"))
    with pytest.raises(UserError, match=r"agent = 'hrac'.*give td3"):
        check_combination(config)


@pytest.mark.parametrize("name", list(learners.registry))
def test_learners_said_to_have_no_loss_have_none(name):
    """A loss that looks at nothing is 0; one of its own cannot do without a batch. InfoBot's teaches no goals."""
    learner = make_learner(presets.load("object_search", learner=name))
    assert teaches_goals(learner) == (has_own_loss(learner) and name != "infobot")
    if has_own_loss(learner):
        with pytest.raises((AttributeError, TypeError)):
            learner.loss({}, (), None, NoHyperparameters(), None)
    else:
        assert learner.loss({}, (), None, NoHyperparameters(), None)[0] == 0


def test_the_package_and_the_table_load_no_data_and_start_no_device():
    """Importing the package prints nothing, and what draws does without the statistics of scipy, whose import takes a
    second."""
    code = """
import sys
import infogoal_jax, infogoal_jax.report.figures
from jax._src import xla_bridge
assert not xla_bridge._backends
assert not {'wandb', 'tensorboardX', 'scipy.stats'} & {*sys.modules}
print("imported")
from infogoal_jax import envs, presets
from infogoal_jax.cli.main import main
def refuse(*arguments):
    raise AssertionError("loaded an environment")
envs.load = refuse
envs.registry.update({name: entry._replace(make=refuse) for name, entry in envs.registry.items()})
assert main(["methods"]) == 0
assert not xla_bridge._backends
assert not {"mujoco", "djitellopy", "av", "ultralytics", "infogoal_drone.mission"} & {*sys.modules}
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("imported\n") and done.stderr == ""
    for name in (*presets.METHODS, *presets.TASKS, *agents.registry):
        assert name in done.stdout


def test_one_combination_in_words(capsys):
    assert main("methods fetch_push her".split()) == 0
    assert "works" in capsys.readouterr().out
    assert main("methods fetch_push her --agent dqn".split()) == 1
    printed = capsys.readouterr().out
    assert "does not work" in printed and "agent = 'dqn'" in printed and "give hrac" in printed
    assert "chooses among a few moves, and an action of fetch_push is a vector" in " ".join(printed.split())
    assert main("methods object_search none --agent cql".split()) == 0
    assert "meant for recorded moves" in capsys.readouterr().out
    for arguments, words in (
        ("fetch_pusch", "Did you mean 'fetch_push'"),
        ("fetch_push hers", "Did you mean 'her'"),
        ("fetch_push her --agent hrak", "Did you mean 'hrac'"),
        ("fetch_push --agent dqn", "TASK METHOD"),
    ):
        assert main(["methods", *arguments.split()]) == 2
        assert words in capsys.readouterr().err


def test_training_is_refused_before_anything_is_loaded(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("infogoal_jax.envs.load", lambda *arguments: pytest.fail("loaded an environment"))
    assert main("train object_search --method none --stop-encoder-gradient".split()) == 2
    assert "stop_encoder_gradient = True" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_a_learner_that_is_registered_later_is_a_method_too(monkeypatch):
    """As docs/guides/own_agent.md registers one: it can be loaded, read back and named."""

    @dataclasses.dataclass(frozen=True)
    class MineConfig(none.NoneConfig):
        """A configuration of its own says which learner it is of."""

    monkeypatch.setitem(learners.registry, "mine", Entry(MineConfig, none.make))
    config = presets.load("object_search", "mine")
    assert presets.names_of(config)["learner"] == presets.name_of(config) == "mine"
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config
    assert "mine" in train_flags(config)


def test_goals_as_numbers_under_another_relabelling_are_changes_of_leo():
    config = presets.load("object_search", "leo+her")
    assert train_flags(config) == ["--method", "leo", "--relabelling", "her"]


@pytest.mark.parametrize(
    ("own", "asked", "same"),
    [
        ("her", "her", True),
        ("none", "her", False),
        ("none", "sse_db", False),
        ("infogoal", "none", False),
        ("her", "none", True),
        ("vae", "vae", True),
    ],
)
def test_a_run_goes_on_with_its_own_method_only(own, asked, same):
    """A relabelling or an explorer that the run was not made with is no detail; one that was added to a learner is left
    alone."""
    assert is_of_method(presets.load("object_search", own), asked) == same


def test_runs_without_the_task_s_own_relabelling_say_so():
    """Two runs of embodied question answering that differ in it have different names."""
    assert presets.name_of(presets.load("embodied_qa", "none")) == "none"
    assert presets.name_of(presets.load("embodied_qa", "none", relabelling="none")) == "unrelabelled"


@pytest.mark.parametrize(
    ("task", "method", "said"),
    [
        ("point_maze", "her", "point_maze, none with her"),
        ("point_maze", "infogoal", "point_maze, infogoal with her"),
        ("object_search", "her", "object_search, her"),
        ("object_search", "leo", "object_search, leo"),
        ("object_search", "none", "object_search, none"),
    ],
)
def test_a_run_s_title_names_the_relabelling(task, method, said):
    """Also where every method of the task has it, and no method's name tells it."""
    assert run_title(presets.load(task, method)) == said


def test_a_reason_is_said_once():
    """Of LEO both the relabelling and the codes ask for a finite set."""
    for task in presets.TASKS:
        for method in presets.METHODS:
            for reason in methods.where(method, (task,)):
                said = reason.split("; ")
                assert len(said) == len({*said}), (task, method)
