"""Verdicts on the claims: what they rest on, and when nothing can be told."""

import dataclasses

import made_up_results
import numpy as np
import pytest

from infogoal_paper import claims, drawing, measure, numbers
from infogoal_paper.manifest import FIXED_BETAS, fixed
from infogoal_paper.scores import Bounds, row_of

RISING = np.linspace(0, 1, made_up_results.EVALUATIONS)


def finding(results, name: str):
    """What is found of the claim of this name."""
    (claim,) = (claim for claim in claims.CLAIMS if claim.name == name)
    return claim.find(results)


def changed(results, change, **wanted):
    """The results, of which those with these fields are changed: (result) -> result."""
    return {
        run: change(result) if all(getattr(run, name) == value for name, value in wanted.items()) else result
        for run, result in results.items()
    }


def rises(result):
    """The run, still rising where its training stopped."""
    curve = RISING * np.ones((len(result.run.seeds), 1))
    return dataclasses.replace(result, evaluations=result.evaluations | {"train_goal/success_rate": curve})


def with_first_reached(change):
    """Runs of which the steps to goals are changed: ([seeds, M, starts]) -> the same."""
    return lambda result: dataclasses.replace(
        result, arrays=result.arrays | {"first_reached": change(result.arrays["first_reached"].astype(int))}
    )


def with_closeness(change):
    """Runs whose codes are changed: ([seeds, views]) -> the same."""

    def apply(result):
        found = result.arrays.get("codes/closeness")
        return dataclasses.replace(
            result, arrays=result.arrays | ({} if found is None else {"codes/closeness": change(found)})
        )

    return apply


SEARCH = {"task": "object_search", "explorer": None, "relabelling": None}


def test_the_length_of_paths_is_that_of_episodes_that_both_reach(results):
    """Whether a goal is reached has no say in it: InfoBot's success falls to a third, and its paths are as long."""
    before = finding(results, "infobot-paths")
    assert before.verdict == "holds" and before.effect.value == pytest.approx(1.2, abs=0.2)
    lost = np.arange(made_up_results.GOALS) % 3 > 0
    fewer = with_first_reached(lambda first: np.where(lost[:, None], made_up_results.LENGTH + 1, first))
    after = finding(changed(results, fewer, method="infobot", **SEARCH), "infobot-paths")
    assert after.verdict == "holds" and after.effect.value == pytest.approx(before.effect.value, abs=0.4)
    assert "episodes, which both reach" in after.words
    shorter = with_first_reached(lambda first: np.where(first <= made_up_results.LENGTH, first - 3, first))
    alike = changed(changed(results, shorter, method="infobot", **SEARCH), fewer, method="infobot", **SEARCH)
    alike = finding(alike, "infobot-paths")
    assert alike.verdict == "cannot be told" and abs(alike.effect.value) < 0.25
    slow = with_first_reached(lambda first: np.where(first <= made_up_results.LENGTH, 10, first))
    assert finding(changed(results, slow, method="infogoal", **SEARCH), "infobot-paths").verdict == "fails"


def test_without_an_episode_that_both_reach_nothing_can_be_told(results):
    never = with_first_reached(lambda first: np.full_like(first, made_up_results.LENGTH + 1))
    found = finding(changed(results, never, method="infobot", **SEARCH), "infobot-paths")
    assert found.verdict == "cannot be told" and found.effect is None


@pytest.mark.parametrize("name", ["codes-grouped", "codes-corrupted", "reward-near-goal"])
def test_codes_are_judged_by_all_seeds(results, name):
    assert finding(results, name).verdict == "holds" and "3 seeds" in finding(results, name).words
    few = made_up_results.results(seeds=2)
    assert finding(few, name).verdict == "cannot be told" and "fewer than 3 seeds" in finding(few, name).faults


def test_codes_that_lie_together_by_chance_in_one_seed_decide_nothing(results):
    def one_seed(found):
        return np.where(np.arange(3)[:, None] == 0, 0.6, 0.1 + 0.01 * np.arange(3)[:, None]) * np.ones(found.shape)

    shelf = {run: result for run, result in results.items() if run.task == "embodied_qa"}
    found = finding(changed(shelf, with_closeness(one_seed), method="infogoal"), "codes-grouped")
    assert found.verdict == "cannot be told" and found.effect.value > 0.1


def test_goals_of_a_region_lie_together():
    draw = np.random.default_rng(0)
    region, use = np.arange(40) % 4, np.repeat([0, 2], 20)
    near = 10 * draw.normal(size=(4, 8))[region] + 0.1 * draw.normal(size=(40, 8))
    assert measure.closeness(near, region, use) > 0.9
    assert abs(measure.closeness(draw.normal(size=(40, 8)), region, use)) < 0.15
    place = draw.normal(size=(50, 2))
    reward = -np.linalg.norm(place - 1, axis=1)
    assert measure.reward_by_distance(np.where(np.arange(50) % 5, reward, np.nan), place, np.ones(2)) == pytest.approx(
        1
    )


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("sse-db-efficiency", {"task": "object_search", "method": "none", "explorer": "sse_db"}),
        ("sse-db-test", {"task": "object_search", "method": "none", "explorer": "sse_db"}),
        ("sse-db-optimality", {"task": "object_search", "method": "infobot", "explorer": "sse_db"}),
        ("beta", {"task": "fetch_pick_and_place", "method": "infogoal"}),
        ("beta-too-high", {"task": "fetch_push", "method": "infogoal"}),
        ("beta-adaptive", {"task": "fetch_reach", "method": "infogoal"}),
        ("beta-prior", {"task": "fetch_pick_and_place", "method": "infogoal"}),
    ],
)
def test_a_row_that_does_not_count_decides_nothing(results, name, wanted):
    found = finding(changed(results, rises, **wanted), name)
    assert found.verdict == "cannot be told" and any("levelled off" in fault for fault in found.faults)
    assert not finding(results, name).faults


@pytest.mark.parametrize("name", ["codes-grouped", "reward-near-goal"])
def test_codes_of_rows_that_do_not_count_are_left_out_and_named(results, name):
    found = finding(changed(results, rises, task="object_search", method="infogoal"), name)
    assert found.verdict == "holds" and "left out" in found.words and "on ObjSearch" in found.words


def test_a_mean_over_tasks_says_what_each_task_gives(results):
    """HER is better than InfoGoal on one task of six; the mean holds, and the task is seen in it."""
    other = changed(results, lambda result: made_up(result, 0.4), task="fetch_push", method="infogoal")
    found = finding(other, "relabelling-below-infogoal")
    assert found.verdict == "holds" and "Push -0." in found.words and "EQA 0." in found.words


def test_few_more_goals_are_not_many_more(results):
    """0.03 above the bare agent, for sure, is not what the claim says."""
    few = changed(results, lambda result: made_up(result, 0.23), method="infobot")
    exact = {
        run: dataclasses.replace(
            result,
            evaluations=result.evaluations
            | {"test_goal/success_rate": np.full_like(result.evaluations["test_goal/success_rate"], level)},
        )
        for run, result in few.items()
        if (level := {"infobot": 0.23, "none": 0.2}.get(run.method)) is not None
    }
    found = finding(few | exact, "infobot-helps")
    assert found.effect.low == pytest.approx(0.03) and found.verdict == "fails"


def test_a_fixed_beta_that_is_missing_might_be_the_best(results):
    setting = fixed(FIXED_BETAS[1])[0]
    without = {run: result for run, result in results.items() if run.setting.name != setting}
    assert "rows are missing" in finding(without, "beta-adaptive").faults


def test_an_effect_on_one_goal_set_of_three_decides_nothing(results):
    """Seeds agree, goal sets do not: InfoGoal is far ahead in one house, and as good as InfoBot in the others."""

    def as_good(result):
        level = 0.95 if result.run.goal_set == 0 else 0.72
        return numbers.compact(made_up_results.result_of(result.run, level))

    found = finding(changed(results, as_good, method="infogoal", **SEARCH), "first-test-ObjSearch")
    assert found.effect.value > 0.08 and found.verdict == "cannot be told" and "3 goal sets" in found.words


def test_a_row_that_is_surely_better_decides_against_a_first_place(results):
    """Another row, which is not sure to be worse, does not hide it."""

    def noisy(result):
        success = np.array([[0.2], [0.9], [0.7]]) * np.ones((1, made_up_results.EVALUATIONS))
        return dataclasses.replace(result, evaluations=result.evaluations | {"test_goal/success_rate": success})

    worse = changed(results, lambda result: made_up(result, 0.5), method="infogoal", task="fetch_reach")
    better = changed(worse, lambda result: made_up(result, 0.8), method="her", task="fetch_reach")
    both = changed(better, noisy, method="rad", task="fetch_reach", relabelling=None)
    assert finding(both, "first-test-Reach").verdict == "fails"


def made_up(result, level: float):
    """The run with another success."""
    return numbers.compact(made_up_results.result_of(result.run, level))


def test_a_claim_about_several_methods_is_one_about_each(results):
    """One that is better than InfoGoal everywhere fails it, whatever the others' mean is."""
    assert finding(results, "relabelling-below-infogoal").verdict == "holds"

    def better(result):
        return dataclasses.replace(
            result, evaluations={name: np.ones_like(values) for name, values in result.evaluations.items()}
        )

    found = finding(changed(results, better, method="cher"), "relabelling-below-infogoal")
    assert found.verdict == "fails" and "InfoGoal minus CHER" in found.words and "weakest of 3" in found.words
    without = {run: result for run, result in results.items() if run.method != "ghrl"}
    assert finding(without, "relabelling-below-infogoal").verdict == "cannot be told"


@pytest.mark.parametrize(("beta", "verdict"), [(0.013, "holds"), (0.0, "fails")])
def test_a_beta_that_fell_to_nothing_is_as_far_off_as_any(results, beta, verdict):
    def with_beta(result):
        values = np.full_like(result.evaluations["infogoal/beta"], beta)
        return dataclasses.replace(result, evaluations=result.evaluations | {"infogoal/beta": values})

    there = {"task": "fetch_pick_and_place", "method": "infogoal"}
    assert finding(changed(results, with_beta, **there), "beta").verdict == verdict


def test_a_row_that_was_trained_with_former_settings_is_marked_and_counts(results):
    def with_another_batch(result):
        config = result.about["config"] | {"batch_size": 7}
        return dataclasses.replace(result, about=result.about | {"config": config})

    name = "first-test-PickAndPlace"
    former = changed(results, with_another_batch, task="fetch_pick_and_place", method="infogoal")
    rows = [row_of(found, "paper", "fetch_pick_and_place", "infogoal") for found in (results, former)]
    assert [row.marks() for row in rows] == ["", "◇"]
    assert finding(former, name) == finding(results, name) and finding(results, name).verdict == "holds"


def judged(results, name: str):
    """The claim of this name under both readings."""
    (found,) = (each for each in claims.verdicts(results) if each.claim.name == name)
    return found


def test_a_claim_is_decided_where_both_readings_of_the_paper_agree(results):
    """With HER InfoGoal is worse than HER on one task: under the text, where it relabels, it is not first there."""
    assert judged(results, "first-test-Reach").verdict == "holds"
    worse = changed(
        results, lambda result: made_up(result, 0.3), method="infogoal", task="fetch_reach", relabelling="her"
    )
    found = judged(worse, "first-test-Reach")
    assert (found.paper.verdict, found.text.verdict, found.verdict) == ("holds", "fails", claims.DEPENDS)
    assert judged(worse, "first-test-PickAndPlace").verdict == "holds"


def test_a_claim_that_one_reading_leaves_open_does_not_depend_on_the_reading(results):
    """It is decided under one of them alone."""
    relabelled = {"method": "infogoal", "task": "fetch_reach", "relabelling": "her"}
    found = judged(changed(results, rises, **relabelled), "first-test-Reach")
    assert (found.paper.verdict, found.text.verdict) == ("holds", "cannot be told")
    assert found.verdict == "cannot be told"
    (row,) = drawing.verdict_rows([found])
    assert row[2].startswith("holds: ") and row[3].startswith("cannot be told: ")


@pytest.mark.parametrize(
    "name", ["relabelling-helps", "relabelling-overfits", "relabelling-below-infogoal", "gcb-helps", "codes-grouped"]
)
def test_a_mean_over_tasks_is_not_told_of_some_of_them(results, name):
    without = {run: result for run, result in results.items() if run.task != "object_manipulation"}
    found = finding(without, name)
    assert found.verdict == "cannot be told" and "no runs on ObjMani" in found.faults


def test_a_row_that_is_missing_cannot_save_a_first_place(results):
    without = {run: result for run, result in results.items() if run.method != "gcb"}
    found = finding(without, "first-test-Reach")
    assert found.verdict == "cannot be told" and "GCB not run" in found.faults
    worse = changed(without, lambda result: made_up(result, 0.3), method="infogoal", task="fetch_reach")
    assert finding(worse, "first-test-Reach").verdict == "fails"


def test_the_text_has_the_rows_with_her_of_three_learners_and_the_other_rows_as_they_are(results):
    for method, relabelling in (("infogoal", "her"), ("infobot", "her"), ("gcb", "her"), ("vae", None), ("her", None)):
        row = row_of(results, "text", "fetch_push", method)
        assert {result.run.relabelling for result in row.results} == {relabelling}
    assert (
        row_of(results, "text", "embodied_qa", "none").results
        == row_of(results, "paper", "embodied_qa", "none").results
    )


def test_a_claim_about_figures_is_asked_under_algorithm_1_alone(results):
    found = judged(results, "sse-db-test")
    assert found.text is None and found.verdict == found.paper.verdict


def test_a_bound_beside_its_verdict_does_not_round_to_it():
    assert claims.Finding(Bounds(-0.0571, -0.1101, -0.0041), "").shown == "-0.057 [-0.110, -0.004]"
    assert claims.Finding(Bounds(-0.02, -0.05, 0.0), "").shown == "-0.02 [-0.05, 0.00]"
