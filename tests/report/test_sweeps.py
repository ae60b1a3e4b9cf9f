"""The table of a sweep."""

import dataclasses

import hand_made
import numpy as np
import pytest

from infogoal_jax.report.summary import score_table
from infogoal_jax.report.sweeps import print_comparison, print_sweep
from infogoal_jax.runner.jobs import Plan
from infogoal_jax.runs import configuration, tables
from infogoal_jax.runs.configuration import Description


def rows_until(epoch: int, success: float) -> list[dict]:
    """A seed that is evaluated every second epoch."""
    return [{"seed": 0, "epoch": each, "test_goal/success_rate": success} for each in range(2, epoch + 1, 2)]


def test_settings_of_which_seeds_diverged_say_how_many_are_left(tmp_path, capsys):
    """The number of all was said of every mean."""
    plan = Plan([{"learning_rate": 0.1}, {"learning_rate": 0.2}], [0, 1, 2], 0)
    for name, loss in zip(plan.names, (1.0, float("nan")), strict=True):
        (tmp_path / name).mkdir()
        for seed in plan.seeds:
            own = {"seed": seed, "epoch": 2}
            watched = dict.fromkeys(tables.WATCHED, loss if seed else 1.0) | own
            tables.append_rows(tmp_path / name, "epochs", [watched])
            tables.append_rows(tmp_path / name, "evaluations", [own | {"test_goal/success_rate": 0.5}])
    print_sweep(tmp_path, plan)
    assert "success at the last evaluation: 1 to 3 seeds, mean ± 95 % interval\n" in capsys.readouterr().out


@pytest.mark.parametrize("longest", [4, 6])
def test_settings_that_were_trained_for_longer_are_told_from_others(longest, tmp_path, capsys):
    plan = Plan([{"learning_rate": 0.1}, {"learning_rate": 0.2}], [0], 0)
    for name, epoch, success in zip(plan.names, (4, longest), (0.25, 0.5), strict=True):
        (tmp_path / name).mkdir()
        tables.append_rows(tmp_path / name, "evaluations", rows_until(epoch, success))
        tables.append_rows(tmp_path / name, "epochs", [dict.fromkeys(tables.WATCHED, 1.0) | {"seed": 0, "epoch": 1}])
    print_sweep(tmp_path, plan)
    said = capsys.readouterr().out
    assert "success at the last evaluation: 1 seed, no interval\n" in said
    printed = [line.split() for line in said.splitlines()]
    assert ("epoch" in printed[0]) == (longest > 4)
    rows = [line for line in printed if line[:1] in (["0.1"], ["0.2"])]
    own = (["4"], ["6"]) if longest > 4 else ([], [])
    assert rows == [["0.1", "0.25", *own[0]], ["0.2", "0.50", *own[1]]]


def test_runs_that_are_compared_are_told_with_what_diverged(tmp_path, capsys):
    """A figure alone was left of it, which names what it leaves out in its small print."""
    for name, loss, epoch in (("a", 1.0, 2), ("b", float("nan"), 4)):
        (tmp_path / name).mkdir()
        config = dataclasses.replace(hand_made.config("none"), num_epochs=epoch)
        configuration.write(tmp_path / name, Description(config, [0], "rooms", {}, "cpu"))
        tables.append_rows(tmp_path / name, "evaluations", rows_until(epoch, 0.5))
        tables.append_rows(tmp_path / name, "epochs", [dict.fromkeys(tables.WATCHED, loss) | {"seed": 0, "epoch": 1}])
    print_comparison([tmp_path / name for name in "ab"])
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["none", "(a)", "0.50"] in [line[:3] for line in printed]
    assert ["none", "(b)", "1"] in [line[:3] for line in printed]  # No success: its one seed diverged.
    print_comparison([tmp_path / "a"], labels=["mine"])
    assert ["mine", "0.50"] in [line.split()[:2] for line in capsys.readouterr().out.splitlines()]


def test_a_code_without_noise_has_one_row():
    """Its sample is its mean."""
    same = {f"{kind}/success_rate": np.array([0.5, 0.7]) for kind in ("train_goal", "train_goal_mean_code")}
    other = {name: values + 0.1 * ("mean_code" in name) for name, values in same.items()}
    assert [score_table(scores).row_count for scores in (same, other)] == [1, 2]
    # What is equal of one kind of goals alone, such as no success at all, is equal by chance.
    both = other | {name.replace("train", "test"): scores for name, scores in same.items()}
    assert score_table(both).row_count == 4
    assert "code" not in [column.header for column in score_table(same).columns]
