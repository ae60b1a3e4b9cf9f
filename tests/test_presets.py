"""Presets hold what the searches found, and mean one thing however a method is named."""

import dataclasses
import json
from pathlib import Path

import pytest

from infogoal_jax import presets

SEARCHES = Path(__file__).parents[1] / "docs" / "results" / "tuning"


def best_of(search: Path) -> dict:
    return json.loads((search / "best.json").read_text())


@pytest.mark.parametrize("search", [path.parent for path in sorted(SEARCHES.glob("*/*/final"))], ids=lambda path: f"{path.parent.name}-{path.name}")
def test_a_preset_is_what_won_the_final(search):
    """On seeds that did not choose the finalists."""
    found, hyper = best_of(search / "final"), presets.load(search.parent.name, search.name).hyper
    assert {name: getattr(hyper, name) for name in found["values"]} == found["values"]
    seeds = [set(json.loads(line)["seeds"]) for path in (search, search / "final") for line in (path / "trials.jsonl").read_text().splitlines()]
    assert found["finished"] and not seeds[0] & seeds[-1]


@pytest.mark.parametrize(("task", "method"), presets.FOUND)
def test_without_a_final_a_preset_gives_way_to_what_is_better_by_a_tenth(task, method):
    search = SEARCHES / task / method
    found = best_of(search / "final" if (search / "final").exists() else search)
    assert presets.FOUND[task, method] == found["values"]
    assert found["score"] >= found["score_of_preset"] + (0 if (search / "final").exists() else 0.1)


@pytest.mark.parametrize("name", [name for name, parts in presets.METHODS.items() if parts.relabelling])
def test_a_relabelling_alone_is_the_method_of_its_name(name):
    by_parts = presets.load("fetch_reach", "none", relabelling=name)
    assert by_parts == presets.load("fetch_reach", name) and presets.name_of(by_parts) == name


def test_a_combination_without_a_name_takes_what_its_learner_has():
    combined, alone = presets.load("object_search", "infogoal", relabelling="her"), presets.load("object_search", "infogoal")
    assert combined.hyper == alone.hyper and combined.num_epochs == alone.num_epochs
    assert dataclasses.replace(combined, relabelling="none", hindsight=alone.hindsight) == alone
