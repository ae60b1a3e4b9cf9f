"""The table of a sweep."""

import pytest

from infogoal_jax.report.sweeps import print_sweep
from infogoal_jax.runner.jobs import Plan
from infogoal_jax.runs import tables


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
