"""Presets hold what the searches found, and mean one thing however a method is named."""

import dataclasses
import json
from pathlib import Path

import pytest

from infogoal_jax import presets

SEARCHES = Path(__file__).parents[1] / "docs" / "results" / "tuning"


@pytest.mark.parametrize(("task", "method"), presets.FOUND)
def test_what_was_found_is_what_the_search_recorded(task, method):
    best = json.loads((SEARCHES / task / method / "best.json").read_text())
    assert presets.FOUND[task, method] == best["values"]
    assert best["score"] >= best["score_of_preset"] + 0.1
    found = presets.load(task, method).hyper
    assert {name: getattr(found, name) for name in best["values"]} == best["values"]


@pytest.mark.parametrize("name", [name for name, parts in presets.METHODS.items() if parts.relabelling])
def test_a_relabelling_alone_is_the_method_of_its_name(name):
    by_parts = presets.load("fetch_reach", "none", relabelling=name)
    assert by_parts == presets.load("fetch_reach", name) and presets.name_of(by_parts) == name


def test_a_combination_without_a_name_takes_what_its_learner_has():
    combined, alone = presets.load("object_search", "infogoal", relabelling="her"), presets.load("object_search", "infogoal")
    assert combined.hyper == alone.hyper and combined.num_epochs == alone.num_epochs
    assert dataclasses.replace(combined, relabelling="none", hindsight=alone.hindsight) == alone
