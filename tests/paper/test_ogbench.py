"""The tables of our offline agents beside OGBench."""

import dataclasses
import json

import pytest

from infogoal_jax import UserError
from infogoal_paper import ogbench
from infogoal_paper.ogbench import Outcome


def outcome(side="ours", seeds=(0, 1), rate=None, updates=(), success=0.5, agent="crl", **changes):
    """A program whose seeds have this success in the first of two tasks, and none in the other."""
    found = [[[success, 0.0] for _ in updates] for _ in seeds]
    return dataclasses.replace(
        Outcome(side, agent, "none", list(seeds), "data", "a GPU", rate, 1.0, list(updates), found, []), **changes
    )


def write(path, *outcomes):
    path.write_text("".join(json.dumps(dataclasses.asdict(each)) + "\n" for each in outcomes))
    return path


@pytest.fixture
def numbers(tmp_path, monkeypatch):
    """Empty numbers."""
    monkeypatch.setattr(ogbench, "NUMBERS", tmp_path / "kept.jsonl")
    return ogbench.NUMBERS


def test_sides_are_compared_after_equal_updates():
    ours = outcome(updates=(10, 20), rate=900.0)
    ours.success = [[[0.5, 0.0], [1.0, 1.0]], [[0.7, 0.0], [1.0, 1.0]]]
    alone = outcome(seeds=(0,), rate=600.0)
    theirs = [outcome("theirs", (seed,), 300.0 if seed == 0 else None, (10,), 0.4) for seed in (0, 1)]
    _, _, row, _, said = ogbench.peers([ours, alone, *theirs]).splitlines()
    assert row == "| `offline_crl` | 900 (3.0x) | 600 (2.0x) | 300 | 0.30±0.64 | 0.20±0.00 |"
    assert said.startswith("Data; a GPU. Success after 10 updates. 2 seeds")


def test_a_side_without_an_evaluation_leaves_its_cell_empty():
    row = ogbench.peers([outcome(rate=900.0), outcome("theirs", (0,), 300.0, (10,))]).splitlines()[2]
    assert row == "| `offline_crl` | 900 (3.0x) |  | 300 |  | 0.25 (1) |"


def test_what_is_taken_again_replaces_what_was_there_and_the_best_speed_stays(numbers, tmp_path):
    assert ogbench.tables() == {}
    first = write(tmp_path / "1.jsonl", outcome(rate=900.0), outcome(rate=900.0, updates=(10,)))
    second = write(tmp_path / "2.jsonl", outcome(rate=100.0, updates=(10, 20), success=0.8), outcome(rate=200.0))
    ogbench.take([first])
    ogbench.take([second])
    (kept,) = ogbench.read([numbers]).values()
    assert kept.rate == 900.0 and kept.updates == [10, 20] and kept.success[0][1] == [0.8, 0.0]
    assert len(numbers.read_text().splitlines()) == 1


def test_small_sizes_are_not_kept(numbers, tmp_path):
    before = write(numbers, outcome(updates=(10,))).read_text()
    with pytest.raises(UserError, match="batch 8.*OGBench's sizes"):
        ogbench.take([write(tmp_path / "toy.jsonl", outcome(seeds=(0,), updates=(10,), sizes="batch 8"))])
    assert numbers.read_text() == before


def test_goal_encoders_are_judged_on_held_out_tasks_apart():
    plain = outcome(updates=(10,), held_out=[2], noise=1.0)
    plain.noisy = [[[0.2, 0.0]], [[0.2, 0.0]]]
    other = outcome(updates=(10,), held_out=[2], agent="gciql", seeds=(0,))
    head, _, row, _, said = ogbench.encoders([plain, other]).splitlines()
    assert head == "| goal encoder | `offline_crl` | `gciql` |"
    assert row == "| none | 0.50±0.00, 0.00±0.00, 0.10±0.00 | 0.50, 0.00 (1) |"
    assert "2 seeds" in said and "told wrong by 1 " in said
    found = ogbench.of_outcomes({each.program(): each for each in (plain, outcome(updates=(10,)), outcome("theirs"))})
    assert found.keys() == {"peers", "encoders"}
