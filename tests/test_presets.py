"""Presets hold what the searches found, and mean one thing however a method is named."""

import dataclasses
import json
from pathlib import Path

import pytest

from infogoal_jax import presets
from infogoal_jax.report import tuning
from infogoal_jax.train import tune

SEARCHES = Path(__file__).parents[1] / "docs" / "results" / "tuning"


def best_of(search: Path) -> dict:
    return json.loads((search / "best.json").read_text())


@pytest.mark.parametrize("method", [name for name, parts in presets.METHODS.items() if parts.exploration == "none"])
def test_on_fetch_reach_a_preset_is_what_won_the_final(method):
    """Of the preset of that time and the three best of the search, on eight seeds that did not choose them."""
    folder = SEARCHES / "fetch_reach" / method
    (searched, trials), found, hyper = tuning.read(folder), best_of(folder / "final"), presets.load("fetch_reach", method).hyper
    ran = [json.loads(line) for line in (folder / "final" / "trials.jsonl").read_text().splitlines()]
    assert [(line["trial"], line["values"]) for line in ran] == [(trial.number, trial.values) for trial in tune.finalists(trials, 4)]
    assert found["finished"] and len(ran[0]["seeds"]) == 8 and not set(searched.seeds) & set(ran[0]["seeds"])
    assert {name: getattr(hyper, name) for name in found["values"]} == found["values"]


@pytest.mark.parametrize(("task", "method"), presets.FOUND)
def test_what_was_found_is_what_was_recorded(task, method):
    """Without a final a preset gives way only to what is better by a tenth."""
    folder = SEARCHES / task / method
    found = best_of(folder / "final" if (folder / "final").exists() else folder)
    assert presets.FOUND[task, method] == found["values"]
    assert (folder / "final").exists() or found["score"] >= found["score_of_preset"] + 0.1


@pytest.mark.parametrize("name", [name for name, parts in presets.METHODS.items() if parts.relabelling])
def test_a_relabelling_alone_is_the_method_of_its_name(name):
    by_parts = presets.load("fetch_reach", "none", relabelling=name)
    assert by_parts == presets.load("fetch_reach", name) and presets.name_of(by_parts) == name


def test_a_combination_without_a_name_takes_what_its_learner_has():
    combined, alone = presets.load("object_search", "infogoal", relabelling="her"), presets.load("object_search", "infogoal")
    assert combined.hyper == alone.hyper and combined.num_epochs == alone.num_epochs
    assert dataclasses.replace(combined, relabelling="none", hindsight=alone.hindsight) == alone
