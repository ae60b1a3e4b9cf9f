"""The command that plays an exported policy in the reference beside ours: its intervals, and what it refuses. That the
reference plays too is for who has it installed (benchmarks/fidelity/fetch_transfer.py)."""

import sys

import jax
import numpy as np
import pytest
from places import ROOT
from scipy.stats import binomtest

from infogoal_jax import envs, make_train, presets
from infogoal_jax.report import export

sys.path.insert(0, str(ROOT / "benchmarks" / "fidelity"))
import fetch_transfer


@pytest.mark.parametrize(("successes", "episodes"), [(0, 10), (7, 10), (200, 200), (183, 200)])
def test_intervals_of_a_share_are_wilsons(successes, episodes):
    found = fetch_transfer.share(np.arange(episodes) < successes)
    wilson = binomtest(successes, episodes).proportion_ci(method="wilson")
    assert found["mean"] == successes / episodes
    assert (found["low"], found["high"]) == pytest.approx((wilson.low, wilson.high), abs=1e-6)


def test_a_policy_of_another_task_is_refused(tmp_path, monkeypatch, capsys):
    train = make_train(presets.load("point_maze", "none"), envs.load("point_maze"))
    params = train.state_shapes.params
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), params)
    export.export_params(train, zeros, tmp_path / "policy.npz", {})
    monkeypatch.setattr(sys, "argv", ["fetch_transfer", str(tmp_path / "policy.npz")])
    with pytest.raises(SystemExit):
        fetch_transfer.main()
    assert "is a policy of point_maze; give one of a Fetch task" in capsys.readouterr().err
