"""What is drawn of compact numbers: the same bytes each time, every number from its run, and verdicts that follow."""

import dataclasses
import re

import made_up_results
import numpy as np
import pytest
from made_up_results import verdict
from matplotlib.image import imread
from places import ROOT

from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_paper import all_goals, claims, drawing, numbers, table_formats, tables
from infogoal_paper.figures import FIGURES
from infogoal_paper.manifest import METHODS, STUDIES, Choice, runs_of


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


def written(results) -> dict[str, str]:
    """Every table in every format."""
    return {
        f"{table.name}.{ending}": write(table)
        for table in tables.all_tables(results)
        for ending, write in table_formats.WRITERS.items()
    }


def test_numbers_survive_their_file_and_give_the_same_tables(results, folder, tmp_path):
    loaded = numbers.load(folder)
    assert loaded.keys() == results.keys()
    some = [
        {run: each[run] for run in each if (run.task, run.relabelling) == ("object_search", None)}
        for each in (loaded, results)
    ]
    assert written(some[0]) == written(some[1]) != {}
    numbers.save(loaded, tmp_path)
    for path in folder.iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_a_merge_adds_and_replaces(results, folder, tmp_path):
    run = next(iter(results))
    new = made_up_results.result_of(run, 0.5)
    numbers.save({run: numbers.compact(new)}, tmp_path)
    before = numbers.load(folder)
    merged = numbers.merged(before, [tmp_path])
    assert merged.keys() == results.keys()
    assert merged[run].evaluations["test_goal/success_rate"].mean() == pytest.approx(0.5, abs=0.02)
    with pytest.raises(UserError, match="no such folder"):
        numbers.merged(before, [tmp_path / "nothing"])


def test_a_merge_names_runs_of_other_settings(tmp_path, capsys):
    """A preset may have changed since they were made."""
    runs = runs_of(("table1",), Choice(tasks=("fetch_push",), methods=("none", "her"), seeds=1))
    made = {run: numbers.compact(made_up_results.result_of(run)) for run in runs}
    made[runs[1]].about["config"] = made[runs[1]].about["config"] | {"batch_size": 7}
    numbers.save(made, tmp_path / "some")
    assert main(["reproduce", "merge", str(tmp_path / "some"), "--into", str(tmp_path / "all")]) == 0
    printed = capsys.readouterr().out
    assert f"1 run made with other settings than the presets have now: {runs[1].name}\n" in printed


def test_a_merge_says_what_it_takes_away(results, tmp_path, capsys):
    """A run of another study may have been made without the pictures of codes."""
    run = next(run for run, result in results.items() if any(key.startswith("picture/") for key in result.arrays))
    bare = dataclasses.replace(
        results[run], arrays={k: v for k, v in results[run].arrays.items() if not k.startswith("picture/")}
    )
    numbers.save({run: results[run]}, tmp_path / "all")
    numbers.save({run: bare}, tmp_path / "some")
    merge = ["reproduce", "merge", str(tmp_path / "some"), "--into", str(tmp_path / "all")]
    assert main(merge) == 0
    assert f"{run.name} had pictures, which" in capsys.readouterr().out
    assert main(merge) == 0
    assert "which the run in its place" not in capsys.readouterr().out


@pytest.mark.long
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
    assert {judged.verdict for judged in claims.verdicts({})} == {"cannot be told"}
    assert tables.all_tables({}) == [] and all(draw({}) is None for draw in FIGURES.values())


def test_a_few_runs_are_enough_to_draw():
    """One seed of one method on one task: intervals are missing, and nothing else."""
    runs = runs_of(("table1",), Choice(tasks=("object_search",), methods=("infogoal",), seeds=1, sets=(0,)))
    results = {run: numbers.compact(made_up_results.result_of(run)) for run in runs}
    (line,) = (
        line
        for line in table_formats.markdown(tables.table1(results, "paper")).splitlines()
        if line.startswith("| InfoGoal")
    )
    assert re.fullmatch(r"\| InfoGoal \| 0\.\d\d \(0\.93\) \|", line)
    assert FIGURES["fig10"](results) is not None and claims.verdicts(results)


@pytest.fixture(scope="module")
def study():
    """The runs of the study of all goals at once, those that it shares with the paper among them."""
    return made_up_results.results(seeds=3, studies=("all_goals",))


def test_the_study_s_cells_are_means_of_its_runs(study):
    """Of the protocol that the column names; the bare agent's are the same under both, and LEO has no images."""
    for task, protocol in (("object_search", "held_out"), ("object_manipulation", "visited")):
        table = all_goals.success_table(study, task)
        row = dict(zip(table.head, next(row for row in table.rows if row[0] == "InfoGoal + head"), strict=True))
        own = [run for run in study if (run.task, run.method, run.known_goals) == (task, "infogoal", protocol)]
        assert len(own) == 3 and {run.relabelling for run in own} == {"all_goals"}
        mean = np.mean([study[run].evaluations["test_goal/success_rate"][:, 5:8].mean() for run in own])
        cell = row[f"test, {protocol}"]
        assert cell.ours.mean == pytest.approx(mean) and cell.rank == 1 and cell.run in {run.name for run in own}
    rows = {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}
    assert rows["bare agent"]["test, visited"].ours == rows["bare agent"]["test, held_out"].ours
    assert rows["LEO"]["corrupted test, visited"].ours is None
    assert all_goals.success_table(study, "embodied_qa").head == ["method", "training", "validation", "test"]


def test_the_study_s_differences_are_paired_by_goal_set_and_seed(study):
    """Seeds that differ much, methods that differ little: the interval is that of the differences."""
    draw, shifted = np.random.default_rng(0), {}
    for run, result in study.items():
        level = np.random.default_rng(run.goal_set).random((3, 1))
        gain = 0.1 * (run.label == "all_goals") + 0.001 * draw.normal(size=(3, 1))
        found = result.evaluations | {"test_goal/success_rate": level + gain + np.zeros((1, 8))}
        shifted[run] = dataclasses.replace(result, evaluations=found)
    table = all_goals.differences_table(shifted, "embodied_qa")
    rows = {row[0]: row[table.head.index("test")] for row in table.rows}
    for other in ("HER", "LEO"):
        value, low, high = map(float, re.findall(r"-?\d\.\d\d", rows[f"all-goals head minus {other}"]))
        assert low > 0.09 and value == pytest.approx(0.1, abs=0.005) and high < 0.11
    assert rows["InfoBot + head minus HER"] == "0.00 [0.00, 0.00]"


def test_a_faulty_row_of_the_study_is_marked_in_both_tables(study):
    """LEO still rises on the shelf, and InfoBot's head lacks a goal set."""
    rising = np.linspace(0, 1, 8) * np.ones((3, 1))
    found = {
        run: dataclasses.replace(
            result,
            evaluations=result.evaluations
            | ({"train_goal/success_rate": rising} if (run.task, run.method) == ("embodied_qa", "leo") else {}),
        )
        for run, result in study.items()
        if (run.task, run.label, run.goal_set) != ("embodied_qa", "infobot+all_goals", 2)
    }
    success, differences = (
        make(found, "embodied_qa") for make in (all_goals.success_table, all_goals.differences_table)
    )
    marks = {row[0]: row[1].marks for row in success.rows}
    assert marks["LEO"] == "†" and marks["InfoBot + head"] == "¶" and marks["all-goals head"] == ""
    assert {cell.rank for row in success.rows for cell in row[1:]} == {0}
    last = {row[0]: row[-1] for row in differences.rows}
    assert last["InfoBot + head minus LEO"].endswith("¶†") and last["all-goals head minus HER"].endswith("]")


def test_seconds_are_shared_out_among_what_a_program_trained(study):
    """A program of five members took 20 seconds for eight evaluations."""
    result = next(iter(study.values()))
    assert all_goals.seconds_of(result).tolist() == pytest.approx([0.5 * number for number in range(1, 9)])
    row = all_goals.rows_of(study, "object_search")["leo", "held_out"]
    found = all_goals.progress_of(row)
    assert found.steps[-1] == 8 and found.success.shape == (3, 8)
    lost = dataclasses.replace(row.results[1], about=row.results[1].about | {"diverged": [1]})
    assert all_goals.progress_of(row._replace(results=(row.results[0], lost))).success.shape == (2, 8)


def test_the_study_is_drawn_from_its_numbers(study, tmp_path):
    """Tables, the figure and what the page of the docs shows; nothing of it before its first run. Of the shelf."""
    study = {run: result for run, result in study.items() if run.task == "embodied_qa"}
    numbers.save(study, tmp_path / "numbers")
    assert main(["reproduce", "all_goals", "--from", str(tmp_path / "numbers"), "--out", str(tmp_path)]) == 0
    assert (imread(tmp_path / "figures" / "all_goals.png")[..., :3].min(-1) < 0.9).mean() > 0.01
    page, shown = (tmp_path / "all_goals.md").read_text(), all_goals.on_page(study)
    assert {path.name for path in tmp_path.iterdir()} == {"numbers", "tables", "figures", "all_goals.md"}
    not_run = {"object_search": "Not run yet.", "object_manipulation": "Not run yet."}
    assert shown.keys() == {"embodied_qa", "figure"} | not_run.keys()
    assert {task: shown.pop(task) for task in not_run} == not_run
    training = {"| method | training | test |", "| methods | test |"}
    lines = {line for name, text in shown.items() if name != "figure" for line in text.splitlines()}
    assert training <= lines and cells(lines) <= cells(set(page.splitlines()))
    before = {run: result for run, result in study.items() if run.of_paper}
    assert all_goals.on_page(before) == {} and all_goals.figure(before) is None


def cells(lines: set[str]) -> set[tuple[str, float]]:
    """The means of a table in Markdown, each with the name of its row."""
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ") and re.search(r"\d\.\d\d", line)]
    return {(name, float(re.search(r"-?\d\.\d\d", cell)[0])) for name, *others in rows for cell in others if cell}


def test_the_paper_s_tables_have_no_number_of_the_study(results, study):
    """Not even of what it cost."""
    both = {run: result for run, result in results.items() if run.method in ("her", "none")}
    beside = {run: result for run, result in study.items() if not run.of_paper}
    assert len(beside) == 72 and written(both | beside) == written(both) != {}


def test_updates_are_counted_over_runs_seeds_and_evaluations(results):
    """In millions, and are no part of the minutes."""
    found = {run: result for run, result in results.items() if (run.task, run.method) == ("object_search", "rad")}
    found = {
        run: dataclasses.replace(result, about=result.about | {"updates": 7_000_000}) for run, result in found.items()
    }
    sizes = [result.evaluations["train_goal/success_rate"].size for result in found.values()]
    assert len(sizes) > 1
    table = tables.costs(found)
    for row in table.rows:
        cells = dict(zip(table.head, row, strict=True))
        seconds = [float(cells[name].replace(",", "")) for name in ("compiling and measuring (s)", "training (s)")]
        assert cells["updates (million)"] == f"{7 * sum(sizes):,}"
        assert float(cells["process-minutes"].replace(",", "")) == pytest.approx(sum(seconds) / 60, abs=0.6)


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
    """If not, `infogoal reproduce all --from docs/results --out docs/results --page docs/research/reproduction.md`
    writes them."""
    folder, page = ROOT / "docs" / "results", ROOT / "docs" / "research" / "reproduction.md"
    results = numbers.load(folder)
    shown = tables.all_tables(results)
    pictures = drawing.current_figures(results, folder / "figures")
    assert {path.name for path in pictures} == {path.name for path in (folder / "figures").iterdir()}
    assert page.read_text() == drawing.report(shown, claims.verdicts(results), pictures, page)
