"""The final of a search: the preset and the best trials again, with other seeds; and searches that cannot have one."""

import dataclasses
import json
from pathlib import Path

import pytest
from made_up_results import environment, made, save, small

from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.runner import search
from infogoal_jax.runs.search import read_trials


@pytest.fixture(scope="module")
def env():
    return environment()


def test_the_best_trial():
    config = small()
    # The last evaluation counts, not the best.
    assert made(config, [[0.0, 0.5], [0.9, 0.4], [0.0, 0.7]]).best.trial == 2
    assert made(config, [[0.0, 0.7], [0.0, 0.7]]).best.trial == 0  # Among equals the preset,
    assert made(config, [[0.0, 0.7], [0.5, 0.7]]).best.trial == 1  # unless another was good earlier.
    assert made(config, [[0.0, 0.2], [0.0, 0.7]], diverged=[1]).best.trial == 0


def test_finalists_are_the_preset_and_the_best_others_of_different_values():
    found = made(small(), [[0.1], [0.3], [0.9], [0.5], [0.9]], diverged=[1])
    trials = [
        dataclasses.replace(trial, values=found.trials[2].values) if trial.trial == 4 else trial
        for trial in found.trials
    ]
    finalists = search.finalists(trials, 3)
    assert [trial.trial for trial in finalists] == [0, 2, 3]  # 4 has the values of 2.
    assert all(trial.success == [] and trial.values == found.trials[trial.trial].values for trial in finalists)
    assert [trial.trial for trial in search.finalists(trials)] == [0, 2, 3, 1]  # What diverged comes last.
    assert [trial.trial for trial in search.finalists(trials[:2])] == [0, 1]  # All of a short search.
    for count, message in (
        (1, "trials = 1: a final has at least 2"),
        (5, "trials = 5: the search has 4 different settings"),
    ):
        with pytest.raises(UserError, match=message):
            search.finalists(trials, count)


@pytest.fixture
def searched(env, tmp_path, monkeypatch):
    """A search of six trials on disk, in the folder `search`, and what `infogoal final` would run: (configuration,
    trials, seeds) a call."""
    found, asked = made(small("vae"), [[0.0, 0.1], [0.0, 0.3], [0.0, 0.9], [0.0, 0.5], [0.0, 0.7], [0.0, 0.2]]), []
    save(found, tmp_path / "search")

    def interrupted(config, trials, seeds, watch):
        asked.append((config, [trial.trial for trial in trials], list(seeds)))
        trials = [dataclasses.replace(trial, success=trial.success[:1]) for trial in found.trials]
        return dataclasses.replace(found, trials=trials)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(search, "final", interrupted)
    return found, asked


def test_the_command_for_a_final(searched):
    """Configuration and trials are the search's, seeds are others."""
    found, asked = searched
    assert read_trials(Path("search"))[1] == found.trials
    assert (
        main(["final", "search"]) == 130
        and main(["final", "search", "--trials", "2", "--seeds", "1", "--first-seed", "1500"]) == 130
    )
    assert asked == [(found.config, [0, 2, 4, 3], list(range(1001, 1009))), (found.config, [0, 2], [1500])]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["search", "--first-seed", "993"], "first_seed = 993: the search had the seeds [1000]"),
        (["search", "--trials", "9"], "trials = 9"),
        (["nowhere"], "search = 'nowhere': holds no trials.jsonl"),
        (["search", "--first-seed", "-1"], "seeds = '-1 to 6'"),
        ([], "search = '': give the folder of a search"),
    ],
)
def test_what_cannot_be_a_final(flags, message, searched, capsys):
    assert main(["final", *flags]) == 2 and not searched[1]
    assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (lambda lines: [], "(it should have the trials 0, 1, 2"),
        (lambda lines: lines[1:], "(it should have the trials 0, 1, 2"),
        (lambda lines: [line | {"values": None} for line in lines], "line 1: is damaged"),
        (lambda lines: [*lines[:2], {"trial": 0}], "line 3: is damaged or was not written by this version (values is"),
        (lambda lines: [line | {"loss": [[1.0]]} for line in lines], "(loss of trial 0 = [[1.0]]: should be [2][1]"),
        (lambda lines: [lines[0] | {"values": {"discount": 0.9}}, *lines[1:]], "different fields"),
        (
            lambda lines: [line | {name: line[name][:1] for name in ("epochs", "success", "loss")} for line in lines],
            "was stopped after 1 of 2 evaluations",
        ),
    ],
)
def test_a_search_that_is_damaged_or_unfinished_has_no_final(changes, message, searched, capsys):
    path = Path("search/trials.jsonl")
    path.write_text(
        "".join(
            f"{json.dumps(line)}\n" for line in changes([json.loads(line) for line in path.read_text().splitlines()])
        )
    )
    assert main(["final", "search"]) == 2 and not searched[1]
    assert message in " ".join(capsys.readouterr().err.split())
