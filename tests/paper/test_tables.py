"""Tables are of the numbers of their rows, rows that do not count are marked, and statistics are those of rliable."""

import csv
import dataclasses
import io
import re

import made_up_results
import numpy as np
import pytest
from made_up_results import verdict
from scipy import stats

from infogoal_paper import claims, table_formats, tables
from infogoal_paper.manifest import METHODS
from infogoal_paper.paper import TASKS, reported
from infogoal_paper.scores import (
    MARKS,
    bootstrap,
    interquartile_mean,
    over_seeds_and_sets,
    over_tasks,
    probability_of_improvement,
    row_of,
)


def table1(results) -> str:
    """Table I in the paper's way, as Markdown."""
    return table_formats.markdown(tables.table1(results, "paper"))


def test_a_cell_is_the_mean_of_its_runs(results):
    row = row_of(results, "paper", "object_search", "infogoal")
    mean = np.mean([result.evaluations["test_goal/success_rate"][:, 5:8].mean() for result in row.results])
    table = tables.table1(results, "paper")
    cells = dict(zip(table.head, table.rows[0], strict=True))
    assert cells["ObjSearch, test"].ours.mean == pytest.approx(mean) and cells["ObjSearch, test"].paper == "0.93"
    assert cells["ObjSearch, test"].rank == 1


def test_every_format_has_the_same_numbers(results):
    table = tables.table1(results, "paper")
    rows = list(csv.reader(io.StringIO(table_formats.comma_separated(table))))
    means = [f"{float(row[1]):.2f}" for row in rows[1:]]
    for write in (table_formats.markdown, table_formats.latex):
        lines = [line for line in write(table).splitlines() if re.match(r"\W*(InfoGoal|RAD|GHRL)\b", line)]
        for line in lines:
            method = next(
                number for number, row in enumerate(rows[1:]) if row[0] in line.split("&")[0].split("|")[:2][-1]
            )
            assert means[method] in line


def test_latex_has_no_character_that_it_would_not_print():
    marks = "".join(sign for sign, _ in MARKS.values())
    assert table_formats.latex_words(f"0.50 ± 0.10{marks} 95 %").isascii()


def test_best_and_second_best_are_marked(results):
    table = tables.table1(results, "paper")
    text = table_formats.markdown(table)
    assert text.count("**") == 2 * (len(table.head) - 1)
    assert "\\textbf{" in table_formats.latex(table) and "\\underline{" in table_formats.latex(table)


def test_ranks_wait_for_the_whole_column(results):
    """Until every method ran on every goal set, the best may be missing."""
    shelf = [run for run in results if run.task == "embodied_qa"]
    for lacking in (
        {run for run in shelf if run.method == "cher"},
        {run for run in shelf if run.method == "cher" and run.goal_set == 2},
    ):
        table = tables.table1({run: result for run, result in results.items() if run not in lacking}, "paper")
        ranks = {title: {row[place].rank for row in table.rows} for place, title in enumerate(table.head) if place}
        assert ranks.pop("EQA, test") == {0} and all({1, 2} <= found for found in ranks.values())


def test_the_comparison_over_tasks_leaves_out_what_does_not_count(results):
    """HER still rises on object search: it is compared on the others, and named."""
    table = tables.over_tasks(results, "paper")
    assert not any("of 6 tasks" in cell for row in table.rows for cell in row)
    rising = np.linspace(0, 1, 8) * np.ones((3, 1))
    off = {
        run: dataclasses.replace(result, evaluations=result.evaluations | {"train_goal/success_rate": rising})
        for run, result in results.items()
        if (run.task, run.method) == ("object_search", "her")
    }
    table = tables.over_tasks(results | off, "paper")
    rows = {row[0]: row for row in table.rows}
    assert rows["HER"][1].endswith(", 5 of 6 tasks") and rows["HER"][2].endswith(", 5 of 6 tasks")
    assert "tasks" not in rows["CHER"][1] and "Left out of test: HER† on ObjSearch." in table.foot
    numbers_of = [  # Without the row, the same.
        tables.over_tasks({run: result for run, result in found.items() if run.task != "object_search"}, "paper")
        for found in (results, results | off)
    ]
    assert numbers_of[0].rows == numbers_of[1].rows


def test_at_equal_training_what_a_run_learned_after_the_first_one_stopped_does_not_count(results):
    """InfoGoal is trained for longer than the others, and learns all test goals in that time, or none."""

    def longer(result, last: float):
        more = np.full((len(result.run.seeds), 6), last)
        late = {name: np.concatenate([curve, more], 1) for name, curve in result.evaluations.items()}
        late["train_goal/success_rate"][:] = np.linspace(0.1, 0.9, late["train_goal/success_rate"].shape[1])
        return dataclasses.replace(result, evaluations=late)

    def cells(last: float, table) -> dict:
        reach = {run: result for run, result in results.items() if run.task == "fetch_reach"}
        made = {run: longer(result, last) if run.method == "infogoal" else result for run, result in reach.items()}
        return {row[0]: row[1].ours.mean for row in table(made, "paper").rows}

    assert cells(0.0, tables.table1)["InfoGoal"] != cells(1.0, tables.table1)["InfoGoal"]
    assert cells(0.0, tables.equal_training) == cells(1.0, tables.equal_training)


def test_near_and_far_test_goals_of_fetch_are_told_apart(results):
    """No seed reaches a far test goal any more: near ones stay as they were. Runs from before do not say which."""

    def without_far(result):
        first, far = result.arrays["first_reached"].copy(), ~result.arrays["near"]
        first[:, far] = made_up_results.LENGTH + 1
        return dataclasses.replace(result, arrays=result.arrays | {"first_reached": first})

    push = {run: result for run, result in results.items() if run.task == "fetch_push" and run.method == "her"}
    before, after = (
        tables.near_and_far(found) for found in (push, {run: without_far(result) for run, result in push.items()})
    )
    assert before.head == ["method", "Push, near", "Push, far"] and before.rows[0][2].ours.mean > 0.3
    assert after.rows[0][1].ours.mean == before.rows[0][1].ours.mean and after.rows[0][2].ours.mean == 0
    old = {name: value for name, value in next(iter(push.values())).arrays.items() if name != "near"}
    assert tables.near_and_far({run: dataclasses.replace(result, arrays=old) for run, result in push.items()}) is None


def test_a_row_whose_term_is_off_or_whose_curve_rises_is_marked_and_does_not_count(results):
    run = next(run for run in results if (run.task, run.method) == ("fetch_pick_and_place", "infogoal"))
    assert verdict(results, "first-test-PickAndPlace") == "holds"
    without = {
        other: result
        for other, result in results.items()
        if (other.task, other.method) != ("fetch_pick_and_place", "rad")
    }
    assert verdict(without, "first-test-PickAndPlace") == "cannot be told"  # The row that is missing might be better.
    off = results | {run: dataclasses.replace(results[run], about=results[run].about | {"learner_share": 0.001})}
    rising = np.linspace(0, 1, 8) * np.ones((3, 1))
    rises = dataclasses.replace(
        results[run], evaluations=results[run].evaluations | {"train_goal/success_rate": rising}
    )
    for found, mark in ((off, "‡"), (results | {run: rises}, "†")):
        assert verdict(found, "first-test-PickAndPlace") == "cannot be told"
        assert mark in table1(found)
    assert "‡" not in table1(results)


def test_methods_on_partly_different_goal_sets_are_marked_and_compared_on_those_that_both_have(results):
    """InfoBot did not run in the third house; where all lack it, nothing is amiss."""

    def without(*methods):
        return {
            run: result
            for run, result in results.items()
            if (run.task, run.goal_set) != ("object_search", 2) or run.method not in methods
        }

    found = without("infobot")
    assert row_of(found, "paper", "object_search", "infobot").marks() == "¶"
    assert row_of(found, "paper", "object_search", "infogoal").marks() == ""
    assert "¶" in table1(found) and "InfoBot¶ on ObjSearch" in " ".join(tables.over_tasks(found, "paper").foot)
    find = {claim.name: claim.find for claim in claims.CLAIMS}
    assert find["first-test-ObjSearch"](found).faults == ()
    in_two = find["infobot-paths"](found)
    assert in_two.effect == find["infobot-paths"](without(*METHODS)).effect != find["infobot-paths"](results).effect
    assert in_two.faults == () and "on 2 goal sets" in in_two.words
    assert "¶" not in table1(without(*METHODS))


def test_a_row_that_was_not_measured_says_so(results):
    """The check of its term could not be made: it counts, with a mark."""
    run = next(run for run in results if (run.task, run.method) == ("fetch_push", "vae"))
    lost = dataclasses.replace(results[run], about=results[run].about | {"learner_share": None})
    assert row_of(results | {run: lost}, "paper", "fetch_push", "vae").marks() == "°"
    assert row_of(results, "paper", "fetch_push", "her").marks() == ""


def test_seeds_that_diverged_are_left_out(results):
    run = next(run for run in results if (run.task, run.method) == ("fetch_reach", "rad"))
    result = results[run]
    lost = dataclasses.replace(result, about=result.about | {"diverged": [1]})
    row = row_of(results | {run: lost}, "paper", "fetch_reach", "rad")
    assert [len(each) for each in row.scores("test_goal")] == [2] and row.marks() == "§"


def rliable_iqm(scores: np.ndarray) -> float:
    """`aggregate_iqm` of rliable/metrics.py: scores [runs, tasks]."""
    return stats.trim_mean(scores, proportiontocut=0.25, axis=None)


def rliable_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """`probability_of_improvement` of rliable/metrics.py: scores [runs, tasks]."""
    found = []
    for task in range(x.shape[1]):
        if np.array_equal(x[:, task], y[:, task]):
            found.append(0.5)
        else:
            wins, _ = stats.mannwhitneyu(x[:, task], y[:, task], alternative="greater")
            found.append(wins / (len(x) * len(y)))
    return np.mean(found)


@pytest.fixture
def scores():
    """Two methods, [runs, tasks], with ties."""
    draw = np.random.default_rng(0)
    return draw.integers(0, 9, (5, 6)) / 8, draw.integers(0, 9, (7, 6)) / 8


def of_one_set(scores: np.ndarray) -> list:
    """Scores [runs, tasks], by task and goal set: one goal set each."""
    return [[runs] for runs in scores.T]


def mean(tasks) -> np.ndarray:
    """The mean over tasks and goal sets."""
    return np.mean([np.mean([runs.mean(-1) for runs in sets], axis=0) for sets in tasks], axis=0)


def test_the_interquartile_mean_is_rliable_s(scores):
    for each in scores:
        assert interquartile_mean(of_one_set(each)) == pytest.approx(rliable_iqm(each), abs=1e-12)


def test_the_probability_of_improvement_is_rliable_s(scores):
    x, y = map(of_one_set, scores)
    assert probability_of_improvement(x, y) == pytest.approx(rliable_improvement(*scores), abs=1e-12)
    assert probability_of_improvement(x, x) == pytest.approx(0.5)


def test_tasks_and_goal_sets_with_more_runs_count_no_more():
    few, many = np.array([0.0, 0.1, 0.2, 0.3]), np.tile([0.6, 0.7, 0.8, 0.9], 3)
    for tasks in ([[few], [many]], [[few, many]]):
        assert interquartile_mean(tasks) == pytest.approx(interquartile_mean([[few], [many[:4]]]))


def test_runs_are_compared_on_the_same_goal_set():
    """A method that is better on each goal set by little is better for sure, however much the goal sets differ."""
    better, worse = ([np.array([level, level + 0.01]) + gain for level in (0.1, 0.5, 0.8)] for gain in (0.05, 0))
    assert probability_of_improvement([better], [worse]) == 1
    assert bootstrap(probability_of_improvement, [better], [worse]) == (1, 1, 1)


def test_the_bootstrap_draws_within_tasks():
    """Two tasks of equal runs each: whatever is drawn, the mean is the same; a pooled bootstrap would vary."""
    assert bootstrap(mean, [[np.zeros(5)], [np.ones(5)]]) == (0.5, 0.5, 0.5)


def test_the_bootstrap_draws_goal_sets_and_then_seeds():
    """Goal sets that differ, seeds that agree: a bootstrap of pooled runs would take them for 15 independent ones."""
    sets = [np.full(5, level) for level in (0.1, 0.5, 0.9)]
    value, low, high = bootstrap(mean, [sets])
    assert (value, low, high) == pytest.approx((0.5, 0.1, 0.9))


def test_the_bootstrap_covers_the_mean():
    """Of 200 samples of a known mean, about 95 % have it in their interval."""
    draw, inside = np.random.default_rng(0), 0
    for number in range(200):
        tasks = [[draw.normal(size=40)] for _ in range(3)]
        low, high = bootstrap(mean, tasks, seed=number)[1:]
        inside += low < 0 < high
    assert 0.9 < inside / 200 < 0.99


@pytest.mark.parametrize("spread", [0.0, 0.5], ids=["alike", "different"])
def test_the_interval_of_an_effect_covers_it_over_seeds_and_goal_sets(spread):
    """Of 400 effects on two tasks, one of three goal sets and one of one, at least 95 % have theirs in the interval."""
    draw, inside = np.random.default_rng(1), 0
    for _ in range(400):
        sets = [draw.normal(scale=spread) + draw.normal(scale=0.2, size=5) for _ in range(3)]
        _, low, high = over_tasks([sets, [draw.normal(scale=0.2, size=5)]])
        inside += low < 0 < high
    assert inside / 400 > 0.93


def test_the_interval_of_one_task_is_the_wider_one_of_the_table():
    for levels in ((0.1, 0.5, 0.9), (0.5, 0.5, 0.5)):
        scores = [np.array([level, level + 0.2]) for level in levels]
        table = over_seeds_and_sets(scores)
        value, low, high = over_tasks([scores])
        assert value == pytest.approx(table.mean)
        assert (high - low) / 2 == pytest.approx(max(table.seeds, table.sets))
    assert np.isnan(over_tasks([[np.array([0.1])]]).low)


def test_one_interval_is_over_seeds_and_one_over_sets():
    """Sets that differ much, seeds that agree: only the interval over sets is wide."""
    close = over_seeds_and_sets([np.array([level, level + 0.01]) for level in (0.1, 0.5, 0.9)])
    assert close.mean == pytest.approx(0.505) and close.seeds < 0.02 and close.sets > 0.9
    alone = over_seeds_and_sets([np.array([0.1, 0.2, 0.3])])
    assert alone.seeds == pytest.approx(stats.t.ppf(0.975, 2) * 0.1 / np.sqrt(3)) and np.isnan(alone.sets)
    assert np.isnan(over_seeds_and_sets([np.array([0.1]), np.array([0.3])]).seeds)


def test_the_table_of_readings_says_how_far_each_learner_is_from_the_paper(results):
    """InfoGoal reaches 0.9 of all goals, so that its distance is that of the paper's numbers to 0.9."""
    table = tables.fit(results)
    row = next(row for row in table.rows if row[0] == "InfoGoal")
    paper = [float(reported(task, "test_goal", "infogoal")) for task in TASKS[:-1]]
    assert float(row[1]) == pytest.approx(np.mean([abs(0.9 - value) for value in paper]), abs=0.02)
    assert row[3] == "yes" and "adopts the idea of HER" in row[4]
    assert next(row for row in table.rows if row[0] == "VAE")[3] == "no"


def test_the_order_of_methods_is_compared_with_the_paper_s_task_by_task(results):
    """On object search ours are InfoGoal, InfoBot, the relabellings, then the others: nearly the paper's order."""
    rows = {row[0]: row[1:] for row in tables.order(results).rows}
    assert len(rows) == 2 and all(len(row) == len(TASKS) for row in rows.values())
    ours = [made_up_results.SUCCESS.get(method, 0.4) for method in METHODS]
    paper = [float(reported("object_search", "test_goal", method)) for method in METHODS]
    exact = stats.spearmanr(ours, paper).statistic
    assert float(rows["relabelling as in Algorithm 1"][0]) == pytest.approx(exact, abs=0.1)
