"""A trained policy over the real protocol answers as many test questions as in the evaluation inside of the program."""

import json
import os
import subprocess
import sys

import pytest
from places import ROOT

pytest.importorskip("djitellopy", reason="needs the extra drone and djitellopy (docs/drone.md)")
pytest.importorskip("av", reason="needs the extra drone and djitellopy (docs/drone.md)")

FLIGHTS, WITHIN = 100, 0.05
SCRIPT = ROOT / "benchmarks" / "fidelity" / "drone_flights.py"


@pytest.mark.long
def test_a_hundred_flights_beside_the_evaluation(tmp_path):
    """The same questions from the same starts; the difference may be off by its standard error."""
    train = "train embodied_qa --method none --env.hovering --num-epochs 30 --no-figures --out"
    words = [sys.executable, "-m", "infogoal_jax", *train.split(), str(tmp_path / "run")]
    subprocess.run(words, check=True, env=os.environ | {"XLA_FLAGS": ""}, stdout=subprocess.DEVNULL)
    words = [
        sys.executable,
        str(SCRIPT),
        str(tmp_path / "run"),
        "--flights",
        str(FLIGHTS),
        "--out",
        str(tmp_path / "out"),
    ]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    result = json.loads((tmp_path / "out" / "flights.json").read_text())
    assert result["landed"] == FLIGHTS
    assert abs(result["difference"]) <= WITHIN + result["difference_standard_error"]
