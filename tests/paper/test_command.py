"""What `infogoal reproduce` does with a folder: it draws when all is done, and mixes no sizes; and several processes on
one folder, of which each has its GPU, its share of the memory, and what was asked for. And the compact numbers that it
refuses, and what runs have cost."""

import dataclasses
import errno
import json
import os
from pathlib import Path

import killed_reproduction
import made_up_results
import numpy as np
import pytest

from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.runner import compilation
from infogoal_paper import command, files, numbers, tables, work
from infogoal_paper.command import DONE, MORE, Asked
from infogoal_paper.figures import FIGURES


def asked(folder: Path, **more) -> Asked:
    """Two runs of FetchPush."""
    return Asked("table1", ("fetch_push",), ("none", "her"), ("paper",), (), 2, folder, **more)


def fill(folder: Path, runs, **about) -> None:
    """Write made-up files of these runs."""
    for run in runs:
        files.save(folder, made_up_results.result_of(run, **about))


@pytest.mark.parametrize("statuses", [[130, 0], [0, 130], [130, 130], [0, 0], [-9, 130]])
def test_several_processes_draw_when_all_is_done_whoever_ended_first(statuses, tmp_path, monkeypatch):
    """A process that ends while another still trains says that there is more to do."""

    def work(arguments, processes, gpus):
        fill(tmp_path, asked(tmp_path).runs())
        return statuses

    monkeypatch.setattr(command, "run_in_processes", work)
    assert command.reproduce(asked(tmp_path, processes=2)) == DONE
    assert (tmp_path / "index.html").exists()


def test_several_processes_do_not_draw_while_a_run_is_left(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "run_in_processes", lambda *_: fill(tmp_path, asked(tmp_path).runs()[:1]) or [0, -9])
    assert command.reproduce(asked(tmp_path, processes=2)) == MORE
    assert not (tmp_path / "index.html").exists() and "process 1 ended with status -9" in capsys.readouterr().out


def test_without_time_to_draw_it_says_so(tmp_path, capsys):
    fill(tmp_path, asked(tmp_path).runs())
    assert command.reproduce(asked(tmp_path, minutes=0.5)) == DONE
    assert "no time was left to draw" in capsys.readouterr().out and not (tmp_path / "index.html").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"sets": (0, 7)}, "sets = 7: there are 0"),
        ({"name": "fig8", "tasks": ("embodied_qa",)}, "tasks = .*embodied_qa.*: fig8 has no such run; name others"),
    ],
)
def test_what_no_run_has_is_named(given, said, tmp_path):
    with pytest.raises(UserError, match=said):
        dataclasses.replace(asked(tmp_path), **given).runs()


def test_runs_are_merged_beside_the_numbers_of_their_folder(tmp_path):
    """Of earlier merges; files of other kinds beside them are none of these."""
    first, second = asked(tmp_path).runs()[:2]
    fill(tmp_path / "out" / "runs", [first])
    numbers.save(numbers.of_folder(tmp_path / "out" / "runs"), tmp_path / "out")
    fill(tmp_path / "out" / "runs", [second])
    np.savez(tmp_path / "out" / "goals.npz", images=np.zeros(3))
    assert set(numbers.merged({}, [tmp_path / "out"])) == {first, second}


@pytest.mark.parametrize("first", [True, False])
def test_toy_runs_and_real_ones_do_not_mix(first, tmp_path):
    """In the folder of the runs, among the known numbers, and where numbers are merged or drawn."""
    run = asked(tmp_path).runs()[0]
    sizes = {toy: dataclasses.replace(run, toy=toy) for toy in (True, False)}
    fill(tmp_path / "out", [sizes[first]])
    with pytest.raises(UserError, match=f"quick = {not first}: .*out"):
        command.reproduce(asked(tmp_path / "out", quick=not first))
    numbers.save(numbers.of_folder(tmp_path / "out"), tmp_path / "numbers")
    with pytest.raises(UserError, match=f"quick = {not first}: .*known"):
        command.reproduce(asked(tmp_path / "none", quick=not first, known=tmp_path / "numbers"))
    fill(tmp_path / "other", [sizes[not first]])
    with pytest.raises(UserError, match="folders = .*toy size"):
        command.merge([tmp_path / "other"], tmp_path / "numbers")


def test_known_runs_that_were_not_measured_are_made_again_with_retry(tmp_path):
    wanted = dataclasses.replace(asked(tmp_path), methods=("infogoal", "none"))
    fill(tmp_path / "some", wanted.runs(), learner_share=None)
    numbers.save(numbers.of_folder(tmp_path / "some"), tmp_path / "known")
    known = dataclasses.replace(wanted, known=tmp_path / "known")
    assert known.runs() == []
    assert [run.method for run in dataclasses.replace(known, retry=True).runs()] == ["infogoal"]


def test_known_runs_of_a_lower_ceiling_are_made_again(tmp_path):
    run = asked(tmp_path).runs()[0]
    result = made_up_results.result_of(run)
    rising = result.evaluations | {"train_goal/success_rate": np.linspace(0, 1, 8) * np.ones((2, 1))}
    files.save(tmp_path / "some", dataclasses.replace(result, evaluations=rising))
    numbers.save(numbers.of_folder(tmp_path / "some"), tmp_path / "known")
    assert run in asked(tmp_path, known=tmp_path / "known").runs()


RISING = np.linspace(0, 1, 26)


@pytest.mark.parametrize(
    ("earlier", "later", "kept"),
    [(RISING, 0.0, True), (np.ones(26), 0.0, False), (RISING, 1.0, False)],
    ids=["rose", "was level", "later one learned"],
)
def test_a_run_that_still_rose_is_not_replaced_by_a_shorter_one_on_the_floor(tmp_path, earlier, later, kept):
    """A short run on the floor looks level where a long one was seen to rise."""
    run = asked(tmp_path).runs()[0]
    made = made_up_results.result_of(run)
    size = len(run.seeds), 1
    before, after = (
        dataclasses.replace(made, evaluations={"train_goal/success_rate": np.tile(curve, size)}, arrays={})
        for curve in (earlier, np.full(10, later))
    )
    files.save(tmp_path, after)
    found = numbers.merged({run: before}, [tmp_path])[run]
    assert found.evaluations["train_goal/success_rate"].shape[1] == (26 if kept else 10)
    other = dataclasses.replace(before, about=before.about | {"config": {}})
    assert numbers.is_superseded(other, after)


def test_protocols_are_of_the_study_of_all_goals_alone(capsys, tmp_path):
    flags = ["--list", "--known-goals", "held_out", "--out", str(tmp_path)]
    assert main(["reproduce", "table1", *flags]) == 2
    assert "known_goals = ('held_out',): the paper's runs let goals enter that are achieved" in capsys.readouterr().err
    assert main(["reproduce", "all_goals", *flags, "--page", str(tmp_path / "page.md")]) == 2
    assert "page = " in capsys.readouterr().err
    assert main(["reproduce", "all_goals", *flags, "--tasks", "object_search", "--methods", "leo"]) == 0
    assert capsys.readouterr().out.count("object_search/leo+held_out/preset/set_") == 3
    words = command.arguments_of(Asked("all_goals", known_goals=("held_out",), out=tmp_path), 9.0)
    assert words[words.index("--known-goals") + 1] == "held_out"


@pytest.mark.parametrize("processes", [[], ["--processes", "1"]])
@pytest.mark.parametrize("command", ["reproduce table1", "train point_maze"])
def test_gpus_go_with_several_processes(command, processes, capsys, tmp_path):
    assert main([*command.split(), "--gpus", "2", *processes, "--out", str(tmp_path)]) == 2
    assert "gpus = 2" in (refusal := capsys.readouterr().err) and "--processes of at least 2" in refusal


def test_a_process_is_asked_for_the_same(capsys, tmp_path):
    """The arguments are those of the command line: the same runs are listed."""
    asked = Asked("fig15", ("fetch_push",), ("infogoal",), ("paper",), (0,), 3, tmp_path, quick=True, retry=True)
    words = command.arguments_of(asked, 9.0)
    assert {"--retry", "--quick", "--no-draw"} <= set(words) and words[words.index("--minutes") + 1] == "9.0"
    assert main([*words, "--list"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("seeds_0-1_toy: left") == len(asked.runs()) == 6


@pytest.mark.long
def test_two_processes_train_what_one_would(tmp_path, capsys):
    flags = [
        "--quick",
        "--tasks",
        "object_search",
        "--methods",
        "none",
        "her",
        "--variants",
        "paper",
        "--out",
        str(tmp_path),
    ]
    assert main(["reproduce", "table1", *flags, "--processes", "2"]) == 0
    printed = capsys.readouterr().out
    assert "2 runs: 2 done" in printed and "0: object_search" in printed and "1: object_search" in printed
    names = {files.read(path).run.label for path in Path(tmp_path).rglob("runs/**/*.npz")}
    assert names == {"none", "her"} and (tmp_path / "index.html").exists()


def test_the_quick_way_compiles_for_a_short_run(tmp_path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(compilation, "is_known", lambda option, value: True)
    toy, found = killed_reproduction.runs(1)[0], []
    with killed_reproduction.small_programs(tmp_path):
        monkeypatch.setattr(work, "train_program", lambda *_: found.append(compilation.compiler_options()))
        for run in (toy, dataclasses.replace(toy, toy=False)):
            work.work_on([run], work.Work(tmp_path))
    assert found[0] == found[1] | compilation.QUICKLY["cpu"] != found[1]


@pytest.mark.long
def test_the_quick_way_trains_the_study_of_all_goals(tmp_path):
    """The head on object search under both protocols, and on the shelf: from training to its tables and figure."""
    flags = ["--tasks", "object_search", "embodied_qa", "--methods", "all_goals", "--out", str(tmp_path / "runs")]
    assert main(["reproduce", "all_goals", "--quick", *flags]) == 0
    assert {path.stem for path in tmp_path.rglob("figures/*")} == {"all_goals"}
    assert main(["reproduce", "merge", str(tmp_path / "runs"), "--into", str(tmp_path / "numbers")]) == 0
    assert [path.name for path in (tmp_path / "numbers").iterdir()] == ["all_goals.npz"]
    made = numbers.load(tmp_path / "numbers")
    names = {f"{run.task}/{run.label}" for run in made}
    assert names == {"object_search/all_goals", "object_search/all_goals+held_out", "embodied_qa/all_goals"}
    for run, result in made.items():
        assert result.about["config"]["known_goals"] == run.known_goals
        assert np.isfinite(result.evaluations["test_goal/success_rate"]).all() and not result.missing()


@pytest.mark.long
def test_the_quick_way_does_all_of_it(tmp_path):
    """Every table and figure from training to the page, at a size at which nothing is learned."""
    assert main(["reproduce", "all", "--quick", "--out", str(tmp_path), "--processes", "2"]) == 0
    assert {path.stem for path in tmp_path.glob("figures/*.png")} == set(FIGURES)
    made = [files.read(path) for path in Path(tmp_path).rglob("runs/**/*.npz")]
    assert [result.run.name for result in made if result.missing() or result.about["measuring_failed"]] == []
    assert {"table1_paper", "table1_her", "table2", "costs"} <= {path.stem for path in tmp_path.glob("tables/*.md")}
    assert (tmp_path / "reproduction.md").exists() and (tmp_path / "index.html").exists()


def test_damaged_numbers_are_refused(results, tmp_path):
    numbers.save(results, tmp_path)
    content = (tmp_path / "paper.npz").read_bytes()
    members = dict(np.load(tmp_path / "paper.npz"))
    (tmp_path / "paper.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match="paper.npz"):
        numbers.load(tmp_path)
    evaluations, shapes = members["evaluations.float32"], json.loads(members["shapes"].tobytes())
    for changes, blame in (
        ({"evaluations.float32": evaluations[:-1]}, "shapes = not those of the arrays"),
        ({"evaluations.float32": np.append(evaluations, 0)}, "evaluations.float32 = .*numbers"),
        ({"shapes": text([*shapes[:-1], None])}, "shapes = not those of the arrays"),
        ({"shapes": text([*shapes[:-1], {"evaluations": ["float32", "a"]}])}, "shapes = not those of the arrays"),
        ({"shapes": text(5)}, "shapes = 'int': should be a list"),
        ({"names": members["names"][:0]}, "names = unreadable"),
        ({"names": text([])}, "names = .* should be as many"),
    ):
        np.savez(tmp_path / "paper.npz", **members | changes)
        with pytest.raises(UserError, match=f"paper.npz.*{blame}"):
            numbers.load(tmp_path)
    del members["shapes"]
    np.savez(tmp_path / "paper.npz", **members)
    with pytest.raises(UserError, match="paper.npz.*shapes = unreadable"):
        numbers.load(tmp_path)


def text(value) -> np.ndarray:
    """JSON as a member of an archive."""
    return np.frombuffer(json.dumps(value).encode(), np.uint8)


def test_a_disk_that_refuses_compact_numbers_is_one_sentence(results, tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("infogoal_jax.files.replace_file", full)
    with pytest.raises(UserError, match="paper.npz: could not be written .No space left"):
        numbers.save(results, tmp_path)


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
