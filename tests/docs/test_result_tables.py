"""Tables of the pages say what the numbers in docs/results give, and what is run again replaces what was kept."""

import json
from pathlib import Path

import pytest
from places import ROOT

from infogoal_jax import presets
from infogoal_jax.hyperparameters import check, with_values
from infogoal_jax.runner.search import check_fields, search_space
from infogoal_paper import pages, trial_numbers, trials, tuning

MOST_FILES, MOST_BYTES = 60, 3_000_000


@pytest.fixture(scope="module")
def tables():
    """The tables of every source, by its name."""
    return {name: source() for name, source in pages.SOURCES.items()}


@pytest.fixture(scope="module")
def written(tables):
    """What every page should be, by its path."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pages, "SOURCES", {name: lambda found=found: found for name, found in tables.items()})
        return pages.written(list(tables))


def test_pages_say_what_the_numbers_give(written):
    """If not, `python -m infogoal_paper.pages` writes them."""
    assert [str(path.relative_to(ROOT)) for path, text in written.items() if path.read_text() != text] == []


def test_a_changed_number_is_noticed(written, monkeypatch, tmp_path):
    page = tmp_path / "page.md"
    text = (ROOT / "docs" / "research" / "tuning.md").read_text()
    page.write_text(text.replace("| InfoGoal | 0.94 |", "| InfoGoal | 0.95 |"))
    monkeypatch.setattr(pages, "PAGES", [page])
    assert pages.written(["tuning"])[page] == written[ROOT / "docs" / "research" / "tuning.md"] != page.read_text()


def test_every_table_for_pages_is_on_one(tables):
    text = "".join(page.read_text() for page in pages.PAGES)
    for name, found in tables.items():
        for table in found:
            assert f"<!-- table: {name}/{table} -->" in text, table


def test_results_are_light():
    """But for the page and the tables that `infogoal reproduce` writes beside them, which are not kept."""
    kept = [path for path in pages.RESULTS.rglob("*") if path.is_file() and path.parent.name != "tables"]
    sizes = [path.stat().st_size for path in kept if path.name != "index.html"]
    assert len(sizes) <= MOST_FILES and sum(sizes) <= MOST_BYTES


def write_search(folder: Path, best: float) -> None:
    """A finished search of two trials and two seeds: of the preset half of what the best one has."""
    folder.mkdir(parents=True, exist_ok=True)
    about = {"config": {"num_epochs": 20}, "seeds": [1000, 1001], "data": "made up", "device": "a device"}
    (folder / "config.json").write_text(json.dumps(about))
    (folder / "best.json").write_text(json.dumps({"trial": 3, "goals": "validation", "finished": True}))
    trials = [
        {
            "trial": number,
            "values": {"discount": 0.9 + number / 100},
            "epochs": [10, 20],
            "success": [[0.0, 0.0], [score, score + 0.2]],
            "loss": [[1.0, 1.0], [1.0, 1.0]],
            "diverged": [],
        }
        for number, score in ((0, best / 2), (3, best))
    ]
    (folder / "trials.jsonl").write_text("".join(json.dumps(trial) + "\n" for trial in trials))


def test_a_search_that_is_run_again_replaces_what_was_kept(tmp_path):
    path = tmp_path / tuning.NUMBERS.name
    write_search(tmp_path / "first" / "object_search" / "vae", 0.4)
    write_search(tmp_path / "first" / "fetch_reach" / "vae", 0.4)
    assert tuning.merge(tmp_path / "first", path) == ["fetch_reach/vae", "object_search/vae"]
    write_search(tmp_path / "second" / "object_search" / "vae", 0.6)
    tuning.merge(tmp_path / "second", path)
    shown = tuning.tables(tuning.load(path))
    assert "| method | ObjSearch | Reach |" in shown["searches"]
    assert "| VAE | 0.40, 0.30 | 0.30, 0.20 |" in shown["searches"]
    before = path.read_bytes()
    tuning.merge(tmp_path / "second", path)
    assert path.read_bytes() == before


def test_a_search_that_was_stopped_is_not_kept_and_goes_on(tmp_path, monkeypatch):
    """What it has found so far lies there as of a finished one."""
    path, folder = tmp_path / tuning.NUMBERS.name, tmp_path / "fetch_reach" / "vae"
    write_search(folder, 0.4)
    tuning.merge(tmp_path, path)
    write_search(folder, 0.8)
    (folder / "best.json").write_text(json.dumps({"trial": 3, "goals": "validation", "finished": False}))
    kept = path.read_bytes()
    assert tuning.merge(tmp_path, path) == [] and path.read_bytes() == kept
    begun = []
    monkeypatch.setattr(tuning.subprocess, "run", lambda command, check: begun.append(command[3:]))
    tuning.search("fetch_reach", "vae", 16, 2, tmp_path)
    write_search(folder / "final", 0.4)
    tuning.final(folder)
    tuning.search("fetch_reach", "her", 16, 2, tmp_path)
    assert begun[0] == ["tune", "--resume", str(folder)] and begun[1][:4] == ["tune", "fetch_reach", "--method", "her"]


def test_trials_that_share_no_evaluation_have_no_difference(tmp_path):
    """One was stopped before an evaluation of the other."""
    write_trial(tmp_path / "trials", "cube_her", 0.1)
    write_trial(tmp_path / "trials", "another", 0.2)
    other = tmp_path / "trials" / "another.csv"
    other.write_text(other.read_text().replace("000,", "001,"))
    rows = [row for path in sorted((tmp_path / "trials").iterdir()) for row in trial_numbers.read(path)]
    pairs = [(("cube_her", "preset"), ("another", "preset")), (("cube_her", "preset"), ("cube_her", "preset"))]
    shown = trial_numbers.differences(rows, pairs)
    assert "another" not in shown and "0.00" in shown


def test_the_fields_that_are_asked_for_are_those_that_were_searched():
    """`infogoal tune --fields` knows them, and the numbers are of them."""
    searches = tuning.load(tuning.NUMBERS)
    for method, fields in tuning.FIELDS.items():
        check_fields(fields, search_space(presets.load("object_search", method).hyper))
        assert set(searches[f"object_search/{method}"]["trials"][0]["values"]) == set(fields)


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
    assert "| `two` | preset | 2 | 0.30 |" in text and "| `three` | preset | 3 | 0.40 ± 0.50 |" in text


def test_what_all_lines_of_a_table_of_trials_share_stands_below_it(tmp_path):
    """Seeds and updates; what differs keeps its column."""
    write_trial(tmp_path / "first", "one", 0.1)
    write_trial(tmp_path / "first", "other", 0.3)
    trial_numbers.merge(tmp_path / "first", tmp_path / trial_numbers.FILE, trials.QUEUE)
    text = trial_numbers.table(trial_numbers.read(tmp_path / trial_numbers.FILE), ["one", "other"], None)
    assert "| `one` | preset | 0.30 |\n| `other` | preset | 0.50 |\n\n2 seeds, 3,000 updates; a machine." in text


def test_what_is_listed_as_run_is_what_the_numbers_are_of():
    """Trials in the numbers have just the settings and seeds of the queue, so that its floats are those that ran."""
    ran = trial_numbers.settings_of(trial_numbers.read(trials.NUMBERS))
    queued = {name: dict.fromkeys(trial.settings, trial.seeds) for name, trial in trials.QUEUE.items() if name in ran}
    assert {
        name: {setting: seeds for setting, (seeds, _) in settings.items()} for name, settings in ran.items()
    } == queued


@pytest.mark.parametrize(
    ("ran", "words"),
    [
        ({}, "to be run"),
        ({"a": (3, 90), "b": (3, 100)}, "90 of 100 updates"),
        ({"a": (3, 100), "b": (3, 100)}, "done"),
        ({"a": (3, 100), "b": (2, 100)}, "without b"),
        ({"a": (3, 100), "c": (3, 100)}, "without b; the numbers have other settings: c"),
    ],
)
def test_a_trial_is_done_when_all_its_settings_and_seeds_are(ran, words):
    trial = trials.Trial("object_search", "her", {}, {"a": {}, "b": {}}, seeds=3)
    assert trials.progress_of(trial, 100, ran) == words


@pytest.mark.parametrize("name", trials.QUEUE)
def test_every_trial_is_legal(name, monkeypatch, tmp_path):
    monkeypatch.setattr(trials, "tuning_house", lambda folder: ["--env.dataset", "house", "--env.split", "split.json"])
    config = trials.configuration(trials.QUEUE[name], tmp_path)
    for values in trials.QUEUE[name].settings.values():
        check(with_values(config.hyper, values))
