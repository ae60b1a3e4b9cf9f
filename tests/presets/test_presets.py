"""Presets hold what the searches found, and mean one thing however a method is named."""

import dataclasses
import sys

import pytest
from places import ROOT

from infogoal_jax import presets, relabelling
from infogoal_jax.hyperparameters import values_of
from infogoal_jax.train import tune

sys.path.insert(0, str(ROOT / "benchmarks" / "paper"))
import tuning

SEARCHES = tuning.load(tuning.NUMBERS)


def trials_of(search: tuning.Search) -> list[tune.Trial]:
    """The trials of a search or final, in order; success by evaluation and seed."""
    return [
        tune.Trial(trial["trial"], trial["values"], trial["success"], [], trial["diverged"])
        for trial in search["trials"]
    ]


def best_of(search: tuning.Search) -> dict[str, float]:
    """The values of the best trial."""
    return next(trial["values"] for trial in search["trials"] if trial["trial"] == search["best"])


@pytest.mark.parametrize("method", [name for name in presets.METHODS if f"fetch_reach/{name}/final" in SEARCHES])
def test_on_fetch_reach_a_preset_is_what_won_the_final(method):
    """Of the preset of that time and the three best of the search, on eight seeds that did not choose them."""
    searched, final = SEARCHES[f"fetch_reach/{method}"], SEARCHES[f"fetch_reach/{method}/final"]
    ran = trials_of(final)
    assert [(trial.number, trial.values) for trial in ran] == [
        (trial.number, trial.values) for trial in tune.finalists(trials_of(searched), 4)
    ]
    assert len(final["seeds"]) == 8 and not set(searched["seeds"]) & set(final["seeds"])
    assert max(ran, key=lambda trial: trial.order).values == best_of(final)
    assert values_of(presets.load("fetch_reach", method).hyper).items() >= best_of(final).items()


def test_what_a_search_without_a_final_found_is_better_by_a_tenth():
    """Else the preset does not give way to it."""
    search = SEARCHES["object_search/cogoal"]
    preset, *others = trials_of(search)
    assert values_of(presets.load("object_search", "cogoal").hyper).items() >= best_of(search).items()
    assert max(trial.score for trial in others) >= preset.score + 0.1


@pytest.mark.parametrize("name", [name for name in relabelling.registry if name != "none"])
def test_a_relabelling_alone_is_the_method_of_its_name(name):
    by_parts = presets.load("fetch_reach", "none", relabelling=name)
    assert by_parts == presets.load("fetch_reach", name) and presets.name_of(by_parts) == name


def test_a_combination_without_a_name_takes_what_its_learner_has():
    combined, alone = (
        presets.load("object_search", "infogoal", relabelling="her"),
        presets.load("object_search", "infogoal"),
    )
    assert combined.hyper == alone.hyper and combined.num_epochs == alone.num_epochs
    assert dataclasses.replace(combined, relabelling=alone.relabelling) == alone


def test_all_public_names_can_be_completed():
    """Those that are imported when they are first asked for are listed like the others, and are there."""
    assert set(presets.__all__) <= set(dir(presets))
    assert all(getattr(presets, name) is not None for name in presets.__all__)
