"""Tables of the pages say what the numbers in docs/results give, and a study's numbers survive their file."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from infogoal_jax.hyperparameters import check, with_values
from infogoal_jax.runs.tables import append_rows, read_table

sys.path.insert(0, str(ROOT / "benchmarks" / "paper"))
import study_numbers
import tables
import trial_numbers
import trials
import tuning_study

MOST_FILES, MOST_BYTES = 60, 6_000_000


@pytest.fixture(scope="module")
def written():
    """What every page should be, by its path."""
    return tables.written(list(tables.STUDIES))


def test_pages_say_what_the_numbers_give(written):
    """If not, `python benchmarks/paper/tables.py` writes them."""
    assert [str(path.relative_to(ROOT)) for path, text in written.items() if path.read_text() != text] == []


def test_a_changed_number_is_noticed(written, monkeypatch, tmp_path):
    page = tmp_path / "page.md"
    page.write_text((ROOT / "docs" / "results.md").read_text().replace("0.89 ± 0.09", "0.99 ± 0.09"))
    monkeypatch.setattr(tables, "PAGES", [page])
    assert tables.written(["house_study"])[page] == written[ROOT / "docs" / "results.md"] != page.read_text()


def test_every_table_for_pages_is_on_one():
    text = "".join(page.read_text() for page in tables.PAGES)
    for name, module in tables.STUDIES.items():
        for table in module.tables(tables.load(name)):
            assert f"<!-- table: {name}/{table} -->" in text, table


def test_results_are_light():
    sizes = [path.stat().st_size for path in tables.RESULTS.rglob("*") if path.is_file()]
    assert len(sizes) <= MOST_FILES and sum(sizes) <= MOST_BYTES


def write_run(folder: Path, seeds: int = 2, epochs: int = 4) -> None:
    """A finished run of made-up numbers that was evaluated after every second epoch."""
    draw = np.random.default_rng(0)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(
        json.dumps({"config": {"learner": {"name": "infogoal"}}, "seeds": list(range(seeds)), "data": "made up"})
    )
    (folder / "result.json").write_text(json.dumps({"machine": "a machine", "seconds": 2.5}))
    for epoch in range(1, epochs + 1):
        append_rows(
            folder,
            "epochs",
            [{"seed": seed, "epoch": epoch, "infogoal/beta": draw.random(), "loss": 1.0} for seed in range(seeds)],
        )
        if epoch % 2 == 0:
            rows = [
                {
                    "seed": seed,
                    "epoch": epoch,
                    "test_goal/success_rate": draw.random(),
                    "env_steps": 100 * epoch,
                    "first_reached": draw.integers(0, 102, (3, 5)).tolist(),
                }
                for seed in range(seeds)
            ]
            append_rows(folder, "evaluations", rows)


def test_numbers_of_a_folder_survive_their_file(tmp_path):
    write_run(tmp_path / "task" / "infogoal")
    (tmp_path / "task" / "baselines.json").write_text('{"test_goal_random/success_rate": 0.25}')
    collected = study_numbers.collect(tmp_path)
    study_numbers.save(collected, tmp_path / study_numbers.FILE)
    loaded = study_numbers.load(tmp_path / study_numbers.FILE)
    assert loaded.baselines == {"task": {"test_goal_random/success_rate": 0.25}}
    before, after = (results.finished("task", ["none", "infogoal"])["infogoal"] for results in (collected, loaded))
    assert after.about["result"] == {"machine": "a machine", "seconds": 2.5} and after.evaluations.seeds == [0, 1]
    assert list(after.evaluations.epochs) == [2, 4] and set(after.evaluations.values) == set(before.evaluations.values)
    rows = read_table(tmp_path / "task" / "infogoal", "epochs")
    assert np.allclose(
        after.evaluations.values["infogoal/beta"].T.ravel(),
        [row["infogoal/beta"] for row in rows if row["epoch"] in (2, 4)],
    )
    for name, value in before.evaluations.values.items():
        assert np.array_equal(after.evaluations.values[name], value.astype(np.float32)), name
    study_numbers.save(loaded, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / study_numbers.FILE).read_bytes()


def test_a_folder_adds_to_the_numbers_that_lie_in_it(tmp_path):
    write_run(tmp_path / "first")
    study_numbers.save(study_numbers.collect(tmp_path), tmp_path / study_numbers.FILE)
    (tmp_path / "first").rename(tmp_path / "second")
    assert set(study_numbers.collect(tmp_path).runs) == {"first", "second"}


def test_trials_of_a_search_are_kept(tmp_path):
    folder = tmp_path / "object_search" / "vae"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(
        json.dumps({"config": {"num_epochs": 20}, "seeds": [1000, 1001], "data": "made up", "device": "a device"})
    )
    (folder / "best.json").write_text(
        json.dumps({"trial": 3, "goals": "validation", "compile_seconds": 1.0, "run_seconds": 2.0})
    )
    trials = [
        {
            "trial": number,
            "values": {"discount": 0.9 + number / 100},
            "epochs": [10, 20],
            "success": [[0.0, 0.0], success],
            "diverged": [],
        }
        for number, success in ((0, [0.25, 0.5]), (3, [0.5, 1.0]))
    ]
    (folder / "trials.jsonl").write_text("".join(json.dumps(trial) + "\n" for trial in trials))
    study_numbers.save(tuning_study.collect(tmp_path), tmp_path / study_numbers.FILE)
    assert "| VAE | 0.38 | 0.75 | 3 | discount 0.93 | 20 of 20 |" in tuning_study.report(
        study_numbers.load(tmp_path / study_numbers.FILE)
    )


def write_trial(folder: Path, name: str, success: float, kl: str = "20", seeds: int = 2) -> None:
    """A trial's file with three evaluations of made-up numbers: seeds are 0.2 apart, evaluations 0.1."""
    folder.mkdir(exist_ok=True)
    lines = [
        f"{name},preset,{seed},{updates},{success + 0.2 * seed + number / 10:.4g},{kl},a machine"
        for number, updates in enumerate((1000, 2000, 3000))
        for seed in range(seeds)
    ]
    (folder / f"{name}.csv").write_text(
        "\n".join(["trial,lane,seed,updates,test_goal/success_rate,learner/kl,machine", *lines]) + "\n"
    )


def test_a_trial_that_is_run_again_replaces_its_rows(tmp_path):
    write_trial(tmp_path / "first", "cube_her", 0.1, kl="")
    write_trial(tmp_path / "first", "another", 0.2, kl="")
    write_trial(tmp_path / "second", "cube_her", 0.5, seeds=3)
    path = tmp_path / "kept" / trial_numbers.FILE
    assert trial_numbers.merge(tmp_path / "first", path, trials.QUEUE) == ["another", "cube_her"]
    assert "learner/kl" not in trial_numbers.read(path)[0]  # An empty column is not kept.
    trial_numbers.merge(tmp_path / "second", path, trials.QUEUE)
    rows = trial_numbers.read(path)
    assert [row["trial"] for row in rows] == ["cube_her"] * 9 + ["another"] * 6  # In the queue's order.
    assert rows[:9] == trial_numbers.read(tmp_path / "second" / "cube_her.csv") and rows[9]["learner/kl"] == ""
    before = path.read_bytes()
    trial_numbers.merge(tmp_path / "second", path, trials.QUEUE)
    assert path.read_bytes() == before


def test_a_table_of_trials_has_an_interval_from_three_seeds_on(tmp_path):
    write_trial(tmp_path / "first", "two", 0.1)
    write_trial(tmp_path / "first", "three", 0.1, seeds=3)
    trial_numbers.merge(tmp_path / "first", tmp_path / trial_numbers.FILE, trials.QUEUE)
    text = trial_numbers.table(trial_numbers.read(tmp_path / trial_numbers.FILE), ["two", "three"], None)
    assert (
        "| `two` | preset | visited | 2 | 1,000 to 3,000 |  |  | 0.30 |" in text
        and "| `three` | preset | visited | 3 | 1,000 to 3,000 |  |  | 0.40 ± 0.50 |" in text
    )


@pytest.mark.parametrize("name", trials.QUEUE)
def test_every_trial_is_legal(name, monkeypatch, tmp_path):
    monkeypatch.setattr(trials, "tuning_house", lambda folder: ["--env.dataset", "house", "--env.split", "split.json"])
    config = trials.configuration(trials.QUEUE[name], tmp_path)
    for values in trials.QUEUE[name].lanes.values():
        check(with_values(config.hyper, values))
