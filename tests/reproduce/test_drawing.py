"""What is drawn of compact numbers: the same bytes each time, every number from its run, and verdicts that follow."""

import csv
import dataclasses
import io
import re

import made_up_results
import numpy as np
import pytest
from matplotlib.image import imread
from places import ROOT

from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.reproduce import claims, drawing, numbers, table_formats, tables
from infogoal_jax.reproduce.figures import FIGURES
from infogoal_jax.reproduce.manifest import METHODS, STUDIES, Choice, runs_of
from infogoal_jax.reproduce.scores import MARKS, row_of


@pytest.fixture(scope="module")
def results():
    """Made-up numbers of every run."""
    return made_up_results.results(seeds=3)


@pytest.fixture(scope="module")
def folder(results, tmp_path_factory):
    """Their compact numbers."""
    folder = tmp_path_factory.mktemp("numbers")
    numbers.save(results, folder)
    return folder


def changed(results, level: float, **wanted):
    """The results, with other numbers for the runs that have these fields."""
    return {
        run: numbers.compact(made_up_results.result_of(run, level))
        if all(getattr(run, name) == value for name, value in wanted.items())
        else result
        for run, result in results.items()
    }


def verdict(results, name: str) -> str:
    """The verdict on the claim of this name."""
    (claim,) = (claim for claim in claims.CLAIMS if claim.name == name)
    return claim.find(results).verdict


def table1(results) -> str:
    """Table I in the paper's way, as Markdown."""
    return table_formats.markdown(tables.table1(results, "paper"))


def written(results) -> dict[str, str]:
    """Every table in every format."""
    return {
        f"{table.name}.{ending}": write(table)
        for table in tables.all_tables(results)
        for ending, write in table_formats.WRITERS.items()
    }


def test_numbers_survive_their_file_and_give_the_same_tables(results, folder, tmp_path):
    loaded = numbers.load(folder)
    assert loaded.keys() == results.keys() and written(loaded) == written(results)
    numbers.save(loaded, tmp_path)
    for path in folder.iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_a_merge_adds_and_replaces(results, folder, tmp_path):
    run = next(iter(results))
    new = made_up_results.result_of(run, 0.5)
    numbers.save({run: numbers.compact(new)}, tmp_path)
    merged = numbers.merged([tmp_path], folder)
    assert merged.keys() == results.keys()
    assert merged[run].evaluations["test_goal/success_rate"].mean() == pytest.approx(0.5, abs=0.02)
    with pytest.raises(UserError, match="no such folder"):
        numbers.merged([tmp_path / "nothing"], folder)


def test_a_merge_names_runs_of_other_settings(tmp_path, capsys):
    """A preset may have changed since they were made."""
    runs = runs_of(("table1",), Choice(tasks=("fetch_push",), methods=("none", "her"), seeds=1))
    made = {run: numbers.compact(made_up_results.result_of(run)) for run in runs}
    made[runs[1]].about["config"] = made[runs[1]].about["config"] | {"batch_size": 7}
    numbers.save(made, tmp_path / "some")
    assert main(["reproduce", "merge", str(tmp_path / "some"), "--into", str(tmp_path / "all")]) == 0
    printed = capsys.readouterr().out
    assert f"1 runs were made with other settings than the presets have now: {runs[1].name}\n" in printed


def test_damaged_numbers_are_refused(folder, tmp_path):
    content = (folder / "table1.npz").read_bytes()
    (tmp_path / "table1.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match="table1.npz"):
        numbers.load(tmp_path)


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


def test_the_wall_clock_counts_time_once(results):
    """Two processes side by side, a pause, and a third."""
    runs = [run for run in results if (run.task, run.method) == ("object_search", "rad") and not run.relabelling]
    spans = [[[0, 600]], [[300, 900]], [[3000, 3300]]]
    made = {
        run: dataclasses.replace(
            results[run], about=results[run].about | {"program": results[run].about["program"] | {"spans": own}}
        )
        for run, own in zip(runs, spans, strict=True)
    }
    assert tables.costs(made).rows[-1][-1] == "20"
    program = {key: value for key, value in results[runs[0]].about["program"].items() if key != "spans"}
    made[runs[0]] = dataclasses.replace(results[runs[0]], about=results[runs[0]].about | {"program": program})
    assert tables.costs(made).rows[-1][-1] == "15 (2 of 3 runs)"
    only = tables.costs({runs[0]: made[runs[0]]})
    assert only.head[-1] == "process-minutes" and {len(row) for row in only.rows} == {len(only.head)}


def test_a_figure_of_other_numbers_is_not_shown(results, tmp_path):
    """It stands in the folder from before; it is shown again once it is drawn of the numbers, or gone with them."""
    drawing.draw(("fig12",), results, tmp_path, format="pdf")
    assert 'id="fig12"' in (tmp_path / "index.html").read_text()
    assert (tmp_path / "figures" / "fig12.pdf").read_bytes().startswith(b"%PDF")
    run = next(run for run in results if (run.task, run.method) == ("embodied_qa", "infogoal"))
    other = results | {run: numbers.compact(made_up_results.result_of(run, 0.5))}
    drawing.draw(("table1",), other, tmp_path)
    assert 'id="fig12"' not in (tmp_path / "index.html").read_text()
    drawing.draw(("table1",), results | {run: results[run]}, tmp_path)
    assert 'id="fig12"' in (tmp_path / "index.html").read_text()
    drawing.draw(("fig12",), {}, tmp_path)
    assert not list((tmp_path / "figures").iterdir())


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


def test_methods_on_partly_different_goal_sets_are_marked_and_decide_nothing(results):
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
    for name in ("infobot-paths", "first-test-ObjSearch", "infobot-helps"):
        (claim,) = (claim for claim in claims.CLAIMS if claim.name == name)
        assert claim.find(results).verdict == "holds"
        assert "ObjSearch" in claim.find(found).words.partition("left out")[2] or claim.find(found).faults, name
    assert verdict(found, "infobot-paths") == verdict(found, "first-test-ObjSearch") == "cannot be told"
    assert "¶" not in table1(without(*METHODS))


def test_rows_that_do_not_count_are_left_out_of_means_over_tasks(results):
    """Where the bare agent does not count on object search, no relabelling is compared with it there."""
    (claim,) = (claim for claim in claims.CLAIMS if claim.name == "relabelling-helps")
    off = {
        run: dataclasses.replace(
            result, evaluations=result.evaluations | {"train_goal/success_rate": np.linspace(0, 1, 8) * np.ones((3, 1))}
        )
        for run, result in results.items()
        if (run.task, run.method) == ("object_search", "none")
    }
    finding = claim.find(results | off)
    assert finding.verdict == "holds" and "left out, because a row does not count: ObjSearch;" in finding.words
    assert "left out" not in claim.find(results).words


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


@pytest.mark.parametrize(
    ("name", "wanted", "otherwise"),
    [
        ("first-test-Reach", {"task": "fetch_reach", "method": "infogoal"}, 0.3),
        ("relabelling-helps", {"method": "none"}, 0.9),
        ("infobot-helps", {"method": "none"}, 0.95),
        ("relabelling-below-infogoal", {"method": "infogoal"}, 0.1),
        ("sse-db-test", {"task": "object_search", "method": "infogoal"}, 0.0),
    ],
)
def test_a_verdict_follows_the_numbers(results, name, wanted, otherwise):
    assert verdict(results, name) == "holds"
    assert verdict(changed(results, otherwise, **wanted), name) == "fails"


def test_without_runs_nothing_can_be_told():
    assert {finding.verdict for _, finding in claims.verdicts({})} == {"cannot be told"}
    assert tables.all_tables({}) == [] and all(draw({}) is None for draw in FIGURES.values())


def test_a_few_runs_are_enough_to_draw():
    """One seed of one method on one task: intervals are missing, and nothing else."""
    runs = runs_of(("table1",), Choice(tasks=("object_search",), methods=("infogoal",), seeds=1, sets=(0,)))
    results = {run: numbers.compact(made_up_results.result_of(run)) for run in runs}
    (line,) = (line for line in table1(results).splitlines() if line.startswith("| InfoGoal"))
    assert re.fullmatch(r"\| InfoGoal \| 0\.\d\d \(0\.93\) \|", line)
    assert FIGURES["fig10"](results) is not None and claims.verdicts(results)


@pytest.mark.long
def test_everything_is_drawn(folder, tmp_path):
    """Every table and figure, the verdicts and the page, which holds all of it and needs nothing else."""
    results = numbers.load(folder)
    (tmp_path / "reproduction.md").write_text("stale words\n<!-- by hand -->\nCauses.\n")
    paths = drawing.draw(tuple(STUDIES), results, tmp_path)
    assert {path.stem for path in paths if path.suffix == ".png"} == set(FIGURES)
    for path in tmp_path.glob("figures/*.png"):
        assert (imread(path)[..., :3].min(-1) < 0.9).mean() > 0.01, f"{path.name} is blank"
    report, page = (tmp_path / "reproduction.md").read_text(), (tmp_path / "index.html").read_text()
    assert report.endswith("<!-- by hand -->\nCauses.\n") and "stale words" not in report
    for claim in claims.CLAIMS:
        assert claim.says in report
    assert all(name in page for name in METHODS.values()) and page.count("data:image/png") == len(FIGURES)
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert all(result.command in page for result in results.values())
    before = {path: path.read_bytes() for path in tmp_path.glob("tables/*")}
    drawing.draw(("table1",), results, tmp_path)
    assert all(path.read_bytes() == content for path, content in before.items())


def test_the_docs_say_what_the_numbers_give():
    """If not, `infogoal reproduce all --from docs/results --out docs/results --page docs/reproduction.md` writes
    them."""
    folder, page = ROOT / "docs" / "results", ROOT / "docs" / "reproduction.md"
    results = numbers.load(folder)
    shown = tables.all_tables(results)
    pictures = drawing.current_figures(results, folder / "figures")
    assert {path.name for path in pictures} == {path.name for path in (folder / "figures").iterdir()}
    assert page.read_text() == drawing.report(shown, claims.verdicts(results), pictures, page)
