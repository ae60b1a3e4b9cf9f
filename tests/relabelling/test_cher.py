"""CHER chooses, of candidates that HER relabelled, those whose goals are diverse and nearly reached."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import places
import pytest
from hand_made import GOALS, STEPS, context, random_rows

from infogoal_jax import replay
from infogoal_jax.relabelling import cher

RECORDED = places.recorded("cher")
CASES = ("n16_lambda1", "n16_lambda3", "n128_lambda1", "n128_lambda3", "n128_step20000", "n32_pairs")


def coverage(similarity, chosen) -> float:
    """F_div by its definition: how well each candidate is covered by the best of the chosen ones."""
    return float(np.asarray(similarity)[:, list(chosen)].max(1).sum())


def everything(count: int, picks: int):
    """Places at which every candidate that is left is compared; the last stands for those that are gone."""
    return np.minimum(np.arange(count), count - 1 - np.arange(picks)[:, None])


@pytest.mark.parametrize("case", CASES)
def test_choices_are_those_of_the_public_code(case):
    """With the cover of the chosen ones only: weights, every pick at the recorded places, and the objective after
    each."""
    recorded = {name.removeprefix(f"{case}_"): RECORDED[name] for name in RECORDED if name.startswith(case)}
    goals, achieved = (jnp.asarray(recorded[name], jnp.float32) for name in ("goals", "achieved_goals"))

    @jax.jit
    def choose(goals, achieved, weight, places):
        weights, distance = (
            cher.neighbour_weights(goals),
            cher.proximity_distances(goals, jnp.arange(len(goals))[:, None], achieved),
        )
        return weights, distance, cher.pick_nearest(weights, weight * distance, places)

    weights, distance, chosen = map(
        np.asarray, choose(goals, achieved, float(recorded["lambda"]), recorded["draw_positions"])
    )
    np.testing.assert_allclose(weights, recorded["weight"], atol=1e-5)
    np.testing.assert_allclose(distance, recorded["proximity_distance"], atol=1e-6)
    np.testing.assert_array_equal(chosen, recorded["repaired_selection"])
    objective = np.cumsum((weights - float(recorded["lambda"]) * distance)[chosen])
    np.testing.assert_allclose(objective, recorded["repaired_objective"], rtol=1e-5, atol=1e-5)


def test_weight_of_proximity_grows_as_in_the_public_code():
    config = cher.CHERConfig()
    assert cher.proximity_weight(config, 0) == RECORDED["config_lambda_starter"]
    later = int(RECORDED["n128_step20000_learning_step"])
    np.testing.assert_allclose(cher.proximity_weight(config, later), RECORDED["n128_step20000_lambda"], rtol=1e-5)
    weights = [float(cher.proximity_weight(config, jnp.asarray(updates))) for updates in range(0, 50_000, 1000)]
    assert np.all(np.diff(weights) > 0)


def test_weight_of_proximity_stays_a_number_however_long_it_grows():
    """An infinite one times a distance of 0 is NaN, which no choice is made by."""
    weights = [float(cher.proximity_weight(cher.CHERConfig(), jnp.asarray(updates))) for updates in (800_000, 10**7)]
    assert np.isfinite(weights).all() and weights[0] < weights[1] * 10 and min(weights) > 1e20


def test_goals_that_were_reached_already_can_be_left_out():
    assert [cher.make(cher.CHERConfig(skip_reached=skip)).skip_reached for skip in (False, True)] == [False, True]


def test_weights_among_equal_goals():
    """Where all goals are equal the mean distance is 0: similarities are 1, not undefined, and one candidate stands for
    all."""
    equal = np.full((4, 2), 0.3, np.float32)
    np.testing.assert_array_equal(jax.jit(cher.neighbour_weights)(equal), [3, 1, 0, 0])
    assert (np.asarray(jax.jit(cher.dense_similarity)(equal)) == 1).all()


def test_comparing_all_finds_the_best_choice_where_candidates_do_not_cover_each_other():
    random = np.random.default_rng(0)
    weights, cost = random.random((2, 9)).astype(np.float32)
    chosen = cher.pick_nearest(jnp.asarray(weights), jnp.asarray(cost), everything(9, 4))
    assert set(np.asarray(chosen).tolist()) == set(
        max(itertools.combinations(range(9), 4), key=lambda some: (weights - cost)[list(some)].sum())
    )


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 5))])
def test_greedy_cover_is_near_the_best_and_never_less_than_promised(seed):
    """Greedy choice of a monotone submodular function reaches at least 1 - 1/e of the best (Nemhauser et al. 1978)."""
    positions = jnp.asarray(np.random.default_rng(seed).normal(size=(10, 2)), jnp.float32)
    similarity = cher.dense_similarity(positions)
    chosen = np.asarray(jax.jit(cher.pick_dense)(similarity, np.zeros(10, np.float32), everything(10, 4)))
    values = [coverage(similarity, some) for some in itertools.combinations(range(10), 4)]
    assert len(set(chosen.tolist())) == 4
    assert coverage(similarity, chosen) >= (1 - 1 / np.e) * max(values)
    assert coverage(similarity, chosen) >= np.quantile(values, 0.9)


def test_a_place_that_is_covered_is_not_chosen_again():
    """Five goals in one place, three in another: the second pick goes to the other, though each of the first place
    would cover more by itself."""
    similarity = cher.dense_similarity(jnp.asarray([[0.0]] * 5 + [[10.0]] * 3))
    first, second = jax.jit(cher.pick_dense)(similarity, np.zeros(8, np.float32), everything(8, 2))
    assert first < 5 <= second


@pytest.mark.parametrize("similarity", ["nearest", "dense"])
def test_comparing_three_is_better_than_chance(similarity):
    """The objective of every choice among three beats the mean of random halves by several of their deviations."""
    random = np.random.default_rng(1)
    positions, cost = jnp.asarray(random.normal(size=(64, 3)), jnp.float32), jnp.asarray(random.random(64), jnp.float32)
    weights, dense = jax.jit(lambda at: (cher.neighbour_weights(at), cher.dense_similarity(at)))(positions)
    kept, paid = np.asarray(weights), np.asarray(cost)

    def objective(chosen):
        chosen = np.asarray(chosen)
        return (kept[chosen].sum() if similarity == "nearest" else coverage(dense, chosen)) - paid[chosen].sum()

    by_chance = [objective(random.permutation(64)[:32]) for _ in range(50)]

    @jax.jit
    def pick(key):
        places = cher.draw_places(key, 64, 32)
        return (
            cher.pick_nearest(weights, cost, places)
            if similarity == "nearest"
            else cher.pick_dense(dense, cost, places)
        )

    for seed in range(5):
        chosen = pick(jax.random.key(seed))
        assert len(set(np.asarray(chosen).tolist())) == 32
        assert objective(chosen) > np.mean(by_chance) + 2 * np.std(by_chance)


def test_places_are_different_and_every_three_are_equally_likely():
    draw = jax.jit(jax.vmap(lambda key: cher.draw_places(key, 6, 3)))
    places = np.asarray(draw(jax.random.split(jax.random.key(0), 3000)))
    for pick in range(3):
        drawn = np.sort(places[:, pick], axis=1)
        threes, counts = np.unique(drawn, axis=0, return_counts=True)
        possible = list(itertools.combinations(range(6 - pick), 3))
        assert [tuple(three) for three in threes.tolist()] == possible
        np.testing.assert_allclose(counts / 3000, 1 / len(possible), atol=0.04)


def test_distance_to_what_was_achieved_instead():
    """To the nearest of several achieved goals; where nothing was achieved, the farthest of the others'; nothing
    anywhere is no distance."""
    positions = jnp.asarray([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0]])
    achieved = jnp.asarray([[1, 2], [-1, 2], [-1, -1], [-1, 0]])
    distances, here = jax.jit(cher.proximity_distances), np.zeros((4, 2), np.float32)
    np.testing.assert_allclose(distances(here, achieved, positions), [5, 10, 10, 0])
    np.testing.assert_array_equal(distances(here, np.full((4, 2), -1), positions), [0, 0, 0, 0])


@functools.partial(jax.jit, static_argnums=0)
def choice(config, scale: float = 1.0, updates: int = 0):
    """Candidates of the hand-made rows, goals on a line: which are chosen, and how far each goal lies from what was
    achieved."""
    rows, positions = random_rows(), scale * jnp.asarray([0.0, 1.0, 2.5, 4.0, 7.0, 7.5, 9.0, 13.0, 20.0])[:, None]
    relabelling = cher.make(config)
    table = relabelling.prepare(context(rows, goal_positions=positions, updates=updates))
    row, step = replay.draw(jax.random.key(0), replay.running_count(rows.valid), 128, STEPS)
    goal = relabelling.relabel(jax.random.key(1), table, row, step, rows.desired_goal[row, step])
    chosen = relabelling.choose(jax.random.key(2), table, row, step, goal)
    return (
        chosen,
        cher.proximity_distances(positions[goal], rows.record[row, step + 1], positions),
        cher.dense_similarity(positions[goal]),
    )


@pytest.mark.long
@pytest.mark.parametrize("similarity", ["nearest", "dense"])
def test_half_is_chosen_diverse_at_first_and_near_in_the_end(similarity):
    """Half of the candidates, each once. After many updates they lie much nearer to what was achieved than by cover
    alone, and cover less."""
    diverse, distance, cover = map(np.asarray, choice(cher.CHERConfig(similarity=similarity, proximity_weight=0.0)))
    near = np.asarray(choice(cher.CHERConfig(similarity=similarity), updates=50_000)[0])
    for chosen in (diverse, near):
        assert len(chosen) == 64 == len(set(chosen.tolist())) and chosen.min() >= 0 and chosen.max() < 128
    assert distance[near].mean() < 0.8 * min(distance[diverse].mean(), distance.mean())
    assert coverage(cover, diverse) >= coverage(cover, near)


@pytest.mark.long
def test_only_distances_in_the_world_depend_on_its_unit():
    """The same goals in another unit: the same choice, unless the configuration asks for the world's unit."""
    for unit, same in (("mean", True), ("world", False)):
        config = cher.CHERConfig(proximity_unit=unit)
        assert (set(choice(config)[0].tolist()) == set(choice(config, scale=2.0**-10)[0].tolist())) == same


def test_many_updates_draw_side_by_side_what_each_draws_alone():
    random = np.random.default_rng(2)
    weights, cost = jnp.asarray(random.random((2, 5, 32)), jnp.float32)
    draw = jax.jit(jax.vmap(lambda key: cher.draw_places(key, 32, 16)))
    places = draw(jax.random.split(jax.random.key(0), 5))
    together, pick = jax.jit(jax.vmap(cher.pick_nearest))(weights, cost, places), jax.jit(cher.pick_nearest)
    weights, cost, places = map(np.asarray, (weights, cost, places))
    for number, chosen in enumerate(np.asarray(together)):
        np.testing.assert_array_equal(chosen, pick(weights[number], cost[number], places[number]))


@pytest.mark.parametrize("known", [True, False])
def test_goals_lie_where_the_task_says_and_else_where_their_codes_are(known):
    positions, codes = jnp.arange(float(GOALS))[:, None], jnp.ones((GOALS, 3))
    seen = context(random_rows(), goal_positions=positions if known else None, goal_codes=lambda: codes)
    np.testing.assert_array_equal(cher.make(cher.CHERConfig()).prepare(seen).positions, positions if known else codes)
