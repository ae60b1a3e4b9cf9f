"""Definition 1 on houses: optimal values are exact, and codes are compared with them as the page says."""

import hand_made
import numpy as np
import pytest

from infogoal_paper import sufficiency


def house():
    """The hand-made graph: next nodes [K, A], what is in view [K, M] and rooms [M]."""
    scenes = hand_made.scenes()
    return scenes.next_state, scenes.visible, np.tile(np.arange(hand_made.ROOMS), 2)


def test_optimal_values_are_the_discount_to_the_power_of_the_steps_left():
    next_node, at_goal, _ = house()
    env = hand_made.environment()
    values = sufficiency.optimal_values(next_node, at_goal, 0.9)
    steps = np.asarray(env.distance)[:, next_node].astype(float)
    goals = np.asarray(env.goals.evaluated)
    np.testing.assert_allclose(values[goals], 0.9**steps, rtol=1e-9)


def test_differences_are_weighted_means():
    found = sufficiency.pairwise(np.array([[0.0, 1.0], [1.0, 3.0]]), np.array([0.25, 0.75]))
    np.testing.assert_allclose(found, [[0, 1.75], [1.75, 0]])


def test_equal_codes_overlap_wholly_and_far_ones_not():
    overlap = sufficiency.overlaps(np.array([[0.0], [0.0], [2.0], [50.0]]), np.ones((4, 1)))
    np.testing.assert_allclose(overlap[0], [1, 1, np.exp(-0.5), 0], atol=1e-9)


@pytest.mark.parametrize(
    ("first", "second", "index"), [([0, 0, 1, 1], [1, 1, 0, 0], 1.0), ([0, 0, 1, 1], [0, 1, 0, 1], -0.5)]
)
def test_the_rand_index_is_1_for_the_same_parts_and_does_not_ask_for_their_names(first, second, index):
    assert sufficiency.rand_index(np.array(first), np.array(second)) == pytest.approx(index)


def test_codes_of_rooms_have_clusters_within_which_values_are_equal_and_random_ones_have_not():
    next_node, at_goal, rooms = house()
    values = sufficiency.pairwise(
        sufficiency.optimal_values(next_node, at_goal, 0.9), np.full(next_node.shape, 1 / next_node.size)
    )
    codes = np.eye(hand_made.ROOMS)[rooms] + 0.01 * np.random.default_rng(0).normal(size=(len(rooms), hand_made.ROOMS))
    good = sufficiency.comparison(codes, np.full_like(codes, 0.1), values, rooms)
    bad = sufficiency.comparison(np.random.default_rng(1).normal(size=codes.shape), None, values, rooms)
    assert good["within"] == good["within_rooms"] == pytest.approx(0) and good["agreement"] == 1
    assert good["between"] == good["between_rooms"] > 0.01 and good["nearest"] == pytest.approx(0)
    assert good["overlap"] == pytest.approx(4 / 28) and good["overlapping"] == pytest.approx(0)
    assert bad["within"] > 0.005 and bad["agreement"] < 0.6 and bad["overlap"] == 0


def test_the_table_has_a_row_for_each_method_that_ran_and_what_rooms_themselves_would_give():
    columns = ("within", "between", "nearest", "agreement", "rank", "overlap", "overlapping")
    rows = [
        {"method": method, "data_set": "7", "seed": str(seed), "machine": "a machine, 2026-11-28"}
        | {"within_rooms": "0.02", "between_rooms": "0.14"}
        | dict.fromkeys(columns, str(0.1 + 0.1 * seed))
        | ({"overlapping": "nan"} if method == "none" else {})
        for method in ("none", "infogoal")
        for seed in range(2)
    ]
    lines = sufficiency.tables(rows)["differences"].splitlines()
    assert [line.split(" | ")[0] for line in lines[2:5]] == ["| InfoGoal", "| bare agent", "| rooms themselves"]
    assert lines[4].startswith("| rooms themselves | 0.020 | 0.140 |") and lines[3].endswith("|  |")
    assert not sufficiency.tables([])
