"""The table of our agents beside JaxGCRL."""

import dataclasses
import json

import numpy as np
import pytest

from infogoal_paper import jaxgcrl
from infogoal_paper.jaxgcrl import Outcome, Parts


def outcome(side, seed=0, rounds=3, seconds=2.0, seeds=1, success=0.1):
    """A program whose seeds gain as much success each round of 1,000 steps."""
    curve = [success * (number + 1) for number in range(rounds)]
    times = [seconds * (number + 1) for number in range(rounds)]
    steps = [1000.0 * (number + 1) for number in range(rounds)]
    return Outcome("ant", "crl", side, "a GPU", seed, steps, times, [curve] * seeds, seeds, 60 * rounds, 50.0)


@pytest.fixture
def numbers(tmp_path, monkeypatch):
    """Empty numbers."""
    monkeypatch.setattr(jaxgcrl, "NUMBERS", tmp_path / "jaxgcrl.json.xz")


def test_seeds_are_compared_at_the_updates_that_both_sides_made():
    """Not at the steps, of which JaxGCRL's first ones, its prefill, teach nothing."""
    ours, theirs = outcome("ours", rounds=6, seeds=2), [outcome("theirs", seed, rounds=2) for seed in (0, 1)]
    for each in theirs:
        each.steps = [steps + 2_000 for steps in each.steps]
    mine, other = jaxgcrl.rows([*theirs, ours], [ours, *theirs])
    assert mine[1:5] == ["ours, 2", "0.01", "0.60±0.00", "0.20±0.00"]
    assert other[1:5] == ["theirs, 2", "0.00", "0.20±0.00", "0.20±0.00"]
    np.testing.assert_allclose(theirs[0].updates_at(), [60, 120])
    # Ours has 0.5 after five rounds of 2 s, which two seeds share.
    assert mine[5:] == ["1,000 (2.0x)", "5.0"] and other[5:] == ["500", "never"]


def test_seeds_that_were_evaluated_at_other_steps_are_compared_in_between():
    early, late = outcome("theirs", rounds=4), outcome("theirs", seed=1, rounds=3, success=0.2)
    late.steps = [steps + 500 for steps in late.steps]  # 1,500 to 3,500, with 0.2 to 0.6
    whole = jaxgcrl.joined([early, late])
    assert whole.steps == [1500, 2000, 3000, 3500] and whole.seconds == [2.5, 3.5, 5.5, 6.5]
    assert whole.updates == 210  # 60 a round of 1,000 steps
    np.testing.assert_allclose(whole.success, [[0.15, 0.2, 0.3, 0.35], [0.2, 0.3, 0.5, 0.6]])


def test_steps_before_the_first_round_are_in_no_second():
    """As JaxGCRL's, which fill its replay."""
    theirs = outcome("theirs")
    theirs.steps = [steps + 50_000 for steps in theirs.steps]
    assert theirs.steps_per_second() == 500 and outcome("ours", rounds=1, seeds=3).steps_per_second() == 1500


def test_seconds_are_those_of_programs_that_ran_alone():
    beside, alone = outcome("theirs", seconds=9.0, success=0.3), outcome("theirs", rounds=2, seconds=1.5)
    timed = jaxgcrl.timed_alone(beside, [alone])
    np.testing.assert_allclose(timed.seconds, [1.5, 3.0, 4.5])
    assert timed.success == beside.success


def test_seconds_are_counted_to_the_first_evaluation_with_enough_success():
    """At the first of all there may have been enough earlier."""
    assert outcome("ours", rounds=6).to_success() == "10.0" and outcome("ours").to_success() == "never"
    assert outcome("ours", success=0.5).to_success() == "at most 2.0"


def test_speed_and_seconds_are_said_where_both_were_timed_alone():
    """Programs beside others say how full the GPU was, and so does one side beside others and the other alone."""
    sides = [outcome("ours", seeds=2), outcome("theirs")]
    fast = [dataclasses.replace(each, seconds=[seconds / 2 for seconds in each.seconds]) for each in sides]
    assert [row[5:] for row in jaxgcrl.rows(sides, fast)] == [["2,000 (2.0x)", "never"], ["1,000", "never"]]
    for alone in ([], fast[:1], fast[1:]):
        assert [row[5:] for row in jaxgcrl.rows(sides, alone)] == [["", ""]] * 2


def test_goal_encoders_are_compared_at_the_updates_that_all_of_them_made():
    own = [outcome("ours", seeds=2), outcome("ours+infogoal", rounds=2, seeds=2), outcome("theirs", rounds=1)]
    alone = dataclasses.replace(outcome("ours"), task="reacher")
    other = dataclasses.replace(outcome("ours+infogoal, beta 0"), agent="sac")
    found = jaxgcrl.encoder_success([*own, alone, other, dataclasses.replace(outcome("ours"), agent="sac")])
    assert {place: {name: each.tolist() for name, each in own.items()} for place, own in found.items()} == {
        ("ant", "crl"): {"none": [0.2, 0.2], "infogoal": [0.2, 0.2]},
        ("ant", "sac"): {"none": [0.1 * 3], "infogoal, beta 0": [0.1 * 3]},
    }
    assert [row[1] for row in jaxgcrl.rows(own, [])] == ["ours, 2", "theirs, 1"]
    assert jaxgcrl.encoder_success([own[0], own[2], alone]) == {}


def test_what_no_side_learned_is_one_line_in_place_of_rows():
    sides = [outcome("ours", seeds=2, success=0.02), outcome("theirs", success=0.01)]
    assert jaxgcrl.rows(sides, []) == []
    assert "ant, crl (2 and 1, " in jaxgcrl.unlearned(sides)
    one_learned = [outcome("ours"), sides[1]]
    assert jaxgcrl.unlearned(one_learned) == "" and len(jaxgcrl.rows(one_learned, [])) == 2


def test_a_side_has_one_colour_in_every_panel_and_a_line_of_the_legend(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(jaxgcrl, "save", lambda figure, path: figures.append(figure))
    beside = [outcome(side) for side in ("theirs", "ours")] * 2
    beside[2:] = [dataclasses.replace(each, task="reacher") for each in beside[2:]]
    jaxgcrl.draw(beside, [], tmp_path / "figure.png")
    axes = figures[0].axes
    ant, reacher = ({line.get_label(): line.get_color() for line in each.get_lines()} for each in axes[:2])
    assert ant == reacher and ant["ours"] != ant["theirs"]
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["ours", "theirs"]


def test_what_is_taken_again_replaces_what_was_there(numbers, tmp_path):
    assert jaxgcrl.tables() == {}
    for number, success in enumerate((0.1, 0.2)):
        (tmp_path / f"{number}.json").write_text(json.dumps([dataclasses.asdict(outcome("ours", success=success))]))
    (tmp_path / "parts.json").write_text(
        json.dumps([dataclasses.asdict(Parts("ant", "crl", 5, "a GPU", 9e3, 8e3, 2e3))])
    )
    jaxgcrl.take({"beside": [tmp_path / "0.json"]})
    for _ in range(2):
        jaxgcrl.take(
            {"beside": [tmp_path / "1.json"], "alone": [tmp_path / "0.json"], "parts": [tmp_path / "parts.json"]}
        )
    kept = jaxgcrl.read()
    assert [each.success[0][0] for each in kept["beside"]] == [0.2] and len(kept["alone"]) == 1
    assert "0.60" in jaxgcrl.tables()["peers"]
    # Of an epoch that takes four times as long as collecting does, three quarters are updates.
    assert jaxgcrl.tables()["parts"].splitlines()[2:] == ["| ant, crl, 5 | 9,000 | 8,000 | 2,000 | 0.75 |"]


def test_what_both_sides_ran_and_one_learned_is_drawn(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(jaxgcrl, "save", lambda figure, path: drawn.append(figure))
    low = [dataclasses.replace(outcome(side, success=0.01), task="pusher") for side in ("ours", "theirs")]
    outcomes = [outcome("ours", seeds=4), outcome("ours+infogoal", success=0.2), outcome("theirs"), *low]
    maze = [dataclasses.replace(outcome(side), task="maze") for side in ("ours", "ours+vae")]
    for alone in (outcomes[:1], [outcomes[0], outcomes[2]]):
        jaxgcrl.draw([*outcomes, *maze, outcome("ours+cogoal")], alone, tmp_path / "x.png")
    assert [each.axes[1].get_visible() for each in drawn] == [False, True]
    upper, lower = drawn[1].axes
    assert upper.get_title() == "ant, crl"
    assert [line.get_label() for line in upper.lines if line.get_linewidth() > 1] == ["ours", "theirs"]
    np.testing.assert_allclose(upper.lines[0].get_xdata(), [1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose(lower.lines[0].get_xdata(), [0.5, 1.0, 1.5])  # Four seeds share 2 s a round.
