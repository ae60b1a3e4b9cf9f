"""The manifest has the paper's tables and figures and the study beside it, runs that share a program are planned
together, and training stops where success on training goals has levelled off, and not before."""

import re
from collections import Counter

import hand_made_frames
import numpy as np
import pytest

from infogoal_jax import presets
from infogoal_jax.errors import UserError
from infogoal_paper import plan
from infogoal_paper.files import command_of, home_of, run_from, run_values
from infogoal_paper.manifest import ALL_GOALS, BESIDE, PRESET, STUDIES, Choice, Run, Setting, runs_of
from infogoal_paper.paper import DESCRIPTIONS, METHODS, TABLE, TASKS


def table1(**chosen) -> list:
    """The runs of Table I."""
    return runs_of(("table1",), Choice(**chosen))


def all_goals(**chosen) -> list:
    """The runs of the study of all goals at once."""
    return runs_of(("all_goals",), Choice(**chosen))


def test_table_1_has_every_number_of_the_paper():
    there = {(run.task, run.method) for run in table1()}
    for tasks, rows in TABLE.values():
        for method, values in rows.items():
            for task, value in zip(tasks, values, strict=True):
                assert value is None or (task, method) in there


def test_the_bare_agent_of_the_shelf_is_not_relabelled_in_the_paper_s_variant():
    (bare,) = table1(tasks=("embodied_qa",), methods=("none",), sets=(0,))
    (learner,) = table1(tasks=("embodied_qa",), methods=("infogoal",), sets=(0,))
    assert presets.names_of(plan.config_of(bare))["relabelling"] == "none"
    assert presets.names_of(plan.config_of(learner))["relabelling"] == "her"


def test_with_her_every_learner_relabels():
    runs = table1(variants=("her",), tasks=("fetch_push", "object_search"))
    assert {presets.names_of(plan.config_of(run))["relabelling"] for run in runs} == {"her"}
    assert {run.method for run in runs} == {"infogoal", "infobot", "cogoal", "gcb", "vae", "dgrl", "rad", "her"}


def test_no_run_is_planned_twice():
    runs = runs_of((*STUDIES, *BESIDE), Choice(variants=("paper", "her")))
    assert len({run.name for run in runs}) == len(runs) == len(set(runs))
    assert STUDIES.keys() == DESCRIPTIONS.keys()


def test_the_study_of_all_goals_trains_what_the_paper_does_not_have():
    """The bare agent, and HER where achieved goals may enter, are the paper's where the agent is. On the shelf, and for
    the bare agent, both protocols are the same run."""
    runs = all_goals()
    shared = set(runs) & set(table1(variants=("paper", "her")))
    assert shared == {run for run in runs if run.of_paper}
    assert {run.task + "/" + run.label for run in shared} == {
        "object_search/none",
        "object_search/her",
        "embodied_qa/none+unrelabelled",
        "embodied_qa/her",
    }
    assert Counter(run.task for run in runs) == {"object_search": 33, "object_manipulation": 33, "embodied_qa": 18}
    cubes = plan.programs_of([run for run in runs if run.task == "object_manipulation" and run.method == "leo"])
    assert [len(program.runs) for program in cubes] == [3, 3], "goal sets share a program, protocols do not"


def test_agent_and_protocol_of_a_run_are_in_its_configuration():
    agents = {"object_search": "dqn", "object_manipulation": "dqn", "embodied_qa": "cql"}
    for run in all_goals(sets=(0,)):
        config = plan.config_of(run)
        names = presets.names_of(config)
        assert (config.known_goals, names["agent"]) == (run.known_goals, agents[run.task])
        of_all = run.label.split("+")[0] == "leo" or "all_goals" in run.label
        assert config.agent.all_goals == (names["relabelling"] == "random") == of_all
    (tuned,) = all_goals(tasks=("object_search",), methods=("infobot+all_goals",), known_goals=("held_out",), sets=(0,))
    hyper, with_her = plan.config_of(tuned).hyper, presets.load("object_search", "infobot", relabelling="her").hyper
    assert hyper.learner_weight == 0.01 != with_her.learner_weight
    assert hyper.learner.beta == with_her.learner.beta


def test_files_of_the_paper_s_runs_say_nothing_of_agents_and_protocols():
    """They read and are written as before there were others."""
    old, new = table1(tasks=("object_search",))[0], all_goals(known_goals=("held_out",), tasks=("object_manipulation",))
    assert not {"agent", "known_goals"} & run_values(old).keys()
    assert all(run_from(run_values(run)) == run for run in (old, *new))


def test_flights_over_the_shelf_achieve_no_goal_that_is_evaluated_later():
    """Therefore both protocols of known goals are the same there, though the objects asked for are in view."""
    env = hand_made_frames.qa()
    evaluated = np.asarray(env.goals.validation_mask | env.goals.test_mask)
    achieved = np.asarray(env.achieved_goals)
    assert evaluated.any() and np.asarray(env.in_view)[:, evaluated].any()
    assert not evaluated[achieved[achieved >= 0]].any()


def test_settings_of_floats_and_goal_sets_share_a_program():
    programs = plan.programs_of(runs_of(("table1", "fig15"), Choice(methods=("infogoal",), tasks=("fetch_push",))))
    assert [len(program.runs) for program in programs] == [6]  # The preset, four betas, no intrinsic reward.
    cubes = plan.programs_of(table1(tasks=("object_manipulation",), methods=("her", "none")))
    assert [len(program.runs) for program in cubes] == [3, 3]


def test_a_run_takes_everything_from_its_preset():
    (run,) = table1(tasks=("fetch_reach",), methods=("cogoal",))
    config, preset = plan.config_of(run), presets.load("fetch_reach", "cogoal")
    for field in ("env", "learner", "agent", "hyper", "updates_per_epoch", "rollout_steps", "batch_size"):
        assert getattr(config, field) == getattr(preset, field)


def test_goal_sets_are_seeds_of_the_data():
    by_task = {task: table1(tasks=(task,), methods=("none",)) for task in TASKS}
    assert [len(runs) for runs in by_task.values()] == [3, 3, 1, 1, 1, 3]
    envs = [plan.config_of(run).env for run in by_task["object_manipulation"]]
    assert [(env.generator_seed, env.goal_seed) for env in envs] == [(0, 0), (1, 1), (2, 2)]
    assert len({plan.config_of(run).env.dataset for run in by_task["object_search"]}) == 3


def test_further_goal_sets_of_fetch_come_from_a_folder(tmp_path):
    (tmp_path / "1").mkdir()
    assert plan.fetch_sets(tmp_path) == (0, 1) and plan.fetch_sets(None) == (0,)
    runs = runs_of(("table1",), Choice(tasks=("fetch_push",), methods=("none",)), plan.fetch_sets(tmp_path))
    assert plan.config_of(runs[1], tmp_path).env.goal_images == str(tmp_path / "1" / "fetch_push.npz")
    with pytest.raises(UserError, match="goal_images"):
        plan.config_of(runs[1])


def test_the_command_of_a_further_goal_set_of_fetch_names_its_folder():
    """A word stands for the folder, which lies elsewhere on each machine."""
    runs = runs_of(("table1",), Choice(tasks=("fetch_push",), methods=("none",)), (0, 1))
    words = [command_of(run) for run in runs]
    assert "--goal-images" not in words[0] and words[1][words[1].index("--goal-images") + 1] == "GOAL_IMAGES"


NAMED = {"variants": "variants", "known_goals": "known-goals"}
"""Choices that a command names, and their flags."""


@pytest.mark.parametrize("study", [*STUDIES, *BESIDE])
def test_the_command_of_a_run_makes_it(study):
    """Tasks, methods, ways, sets and seeds of the command line choose the run, and its own study has it."""
    for run in runs_of((study,), Choice(seeds=3))[:40:2]:
        words = command_of(run)
        flags = {word[2:]: value for word, value in zip(words, [*words[1:], ""], strict=True) if word.startswith("--")}
        chosen = {"tasks": (flags["tasks"],), "methods": (flags["methods"],), "seeds": int(flags.get("seeds", 5))}
        chosen |= {name: (flags[flag],) for name, flag in NAMED.items() if flag in flags}
        chosen |= {"sets": (int(flags["sets"]),)} if "sets" in flags else {}
        assert words[2] == home_of(run) and run in runs_of((words[2],), Choice(**chosen))


def test_the_quick_way_has_something_for_every_figure():
    for study in (*STUDIES, *BESIDE):
        assert runs_of((study,), Choice(toy=True, variants=("paper", "her"))), study


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"tasks": ("fetch",)}, "tasks"),
        ({"methods": ("dqn",)}, "methods"),
        ({"methods": ("leo",)}, "methods = 'leo': give some of infogoal, "),
        ({"variants": ("his",)}, "variants"),
        ({"seeds": 0}, "seeds"),
    ],
)
def test_unknown_names_are_refused(chosen, words):
    with pytest.raises(UserError, match=words):
        table1(**chosen)


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"tasks": ("fetch_push",)}, "tasks = 'fetch_push': give some of object_search, "),
        ({"methods": ("infogoal",)}, f"methods = 'infogoal': give some of {', '.join(ALL_GOALS)}"),
        ({"known_goals": ("train",)}, "known_goals = 'train': give some of visited, held_out"),
    ],
)
def test_names_that_the_study_of_all_goals_does_not_have_are_refused(chosen, words):
    with pytest.raises(UserError, match=re.escape(words)):
        all_goals(**chosen)


def test_every_method_has_a_title():
    assert set(METHODS) == set(TABLE["test_goal"][1])


def curve(*values: float) -> np.ndarray:
    """Two seeds around these values, [2, evaluations]."""
    return np.array(values) + np.array([[-0.05], [0.05]])


@pytest.mark.parametrize(
    ("values", "count"),
    [
        ((1, 1, 1, 1, 1, 1), 6),
        ((0, 0, 0, 0, 0, 0), None),
        ([0] * 12, 10),
        ([0.05] * 6 + [0.15] * 6, 12),
        ([0.01] * 4 + [0.04, 0.06, 0.05, 0.06, 0.07, 0.06], None),
        ((1, 1, 1, 1, 1), None),
        (np.linspace(0, 1, 15), None),
        ((0, 0.2, 0.4, 0.6, 0.8, 1, 1, 1, 1, 1, 1), 11),
        ((0.9, 0.9, 0.9, 0.5, 0.5, 0.5), 6),
    ],
)
def test_a_curve_levels_off_where_its_last_window_is_no_higher(values, count):
    """And not on the floor before the budget is spent, or while it creeps up from its first window."""
    assert plan.levelled(curve(*values)) == count
    assert plan.still_rises(curve(*values)) == (count is None)


def test_what_comes_after_changes_nothing():
    """Settings of one program that have levelled off go on with the others: their number stays."""
    early = curve(0, 0.5, 1, 1, 1, 1, 1, 1)
    late = np.concatenate([early, curve(0.2, 0.1, 0.9)], axis=1)
    assert plan.levelled(early) == plan.levelled(late) and plan.shown(early) == plan.shown(late)


def test_numbers_are_of_the_last_window():
    assert plan.shown(curve(*np.linspace(0, 1, 15))) == slice(12, 15)
    assert plan.shown(curve(1, 1, 1, 1, 1, 1, 0.5)) == slice(3, 6)


def test_a_run_is_trained_once_it_levelled_off_or_came_to_the_ceiling():
    ceiling = plan.budget_of("object_search").evaluations
    assert plan.is_trained(curve(1, 1, 1, 1, 1, 1), "object_search")
    assert not plan.is_trained(curve(*np.linspace(0, 1, ceiling - 1)), "object_search")
    assert plan.is_trained(curve(*np.linspace(0, 1, ceiling)), "object_search")


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_budget(task):
    found = plan.budget_of(task)
    assert found.chunk > 0 and found.evaluations == plan.MOST


def test_what_is_measured_is_known_without_jax():
    run = Run("object_search", "none", None, None, 0, Setting(*PRESET), (0, 1), True)
    assert plan.missing(run, None, ()) == ["codes", "pictures"]
    assert plan.missing(run, None, ("codes/closeness", "picture/code_mean")) == []
