"""The command that plays an exported policy in the reference beside ours: its intervals, and what it refuses. That the
reference plays too is for who has it installed (benchmarks/fidelity/fetch_transfer.py)."""

import sys

import numpy as np
import pytest
from places import ROOT
from scipy.stats import binomtest

from infogoal_jax.runs.low_level import shipped

sys.path.insert(0, str(ROOT / "benchmarks" / "fidelity"))
import fetch_transfer


@pytest.mark.parametrize(("successes", "episodes"), [(0, 10), (7, 10), (200, 200), (183, 200)])
def test_intervals_of_a_share_are_wilsons(successes, episodes):
    found = fetch_transfer.share(np.arange(episodes) < successes)
    wilson = binomtest(successes, episodes).proportion_ci(method="wilson")
    assert found["mean"] == successes / episodes
    assert (found["low"], found["high"]) == pytest.approx((wilson.low, wilson.high), abs=1e-6)


def test_a_policy_of_another_task_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["fetch_transfer", str(shipped("object_manipulation"))])
    with pytest.raises(SystemExit):
        fetch_transfer.main()
    assert "is a policy of object_manipulation; give one of a Fetch task" in capsys.readouterr().err
