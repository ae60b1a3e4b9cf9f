"""Equal noise at test: what is compared with what, and that test goals choose nothing."""

import json
import time
from operator import attrgetter
from types import SimpleNamespace

import hand_made
import pytest

from infogoal_jax import presets
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.stopping import stop_on_signal
from infogoal_paper import batches, noise, noise_numbers, trial_numbers, tuning
from infogoal_paper.noise_numbers import EPSILONS, Numbers


def row(method: str, epsilon: float, test: str = "0.5", validation: str = "0.5", **others) -> dict[str, str]:
    """A row of the cube, data set 7, seed 0, sampled codes; others: further columns."""
    task = {"task": "object_manipulation", "data_set": "7", "seed": "0", "code": "sampled"}
    return task | {"method": method, "epsilon": str(epsilon), "test": test, "validation": validation} | others


def test_a_method_has_its_best_noise_by_validation_goals_and_the_least_of_equals():
    validation = dict(zip(EPSILONS, ("0.1", "0.6", "0.7", "0.7", "0.2", "0.1"), strict=True))
    rows = [row("her", epsilon, test=str(epsilon), validation=validation[epsilon]) for epsilon in EPSILONS]
    assert Numbers(rows).best("object_manipulation", "her") == 0.05


def test_the_house_of_the_tuning_chooses_for_houses_and_is_not_shown():
    houses = [
        row("her", epsilon, test, validation, task="object_search", data_set=str(number))
        for epsilon in EPSILONS
        for number, test, validation in ((7, "0.4", ""), (tuning.SEED, "", str(epsilon)))
    ]
    numbers = Numbers(houses)
    assert numbers.best("object_search", "her") == EPSILONS[-1]
    assert numbers.success("object_search", "her", 0.0) == {(7, 0): 0.4}


def test_differences_are_paired_by_data_set_and_seed():
    pairs = {("7", "0"): (0.9, 0.5), ("7", "1"): (0.5, 0.1), ("8", "0"): (0.6, 0.2)}
    rows = [
        row(method, 0.0, str(value), data_set=data_set, seed=seed)
        for (data_set, seed), values in reversed(pairs.items())
        for method, value in zip(("infogoal", "her"), values, strict=True)
    ]
    rows.append(row("her", 0.0, "1.0", data_set="9"))  # Without a partner.
    found = noise_numbers.difference(Numbers(rows), "object_manipulation", ("infogoal", "her"), "test", "0")
    assert found.mean == pytest.approx(0.4) and found.half_width == pytest.approx(0, abs=1e-9)


def test_means_that_are_compared_are_of_data_sets_that_every_method_has():
    rows = [row("her", 0.0, "0.2"), row("infogoal", 0.0, "0.4"), row("her", 0.0, "1.0", data_set="8")]
    numbers = Numbers([*rows, row("her", 0.0, "0.6", task="fetch_reach", data_set="0")])
    assert [*numbers.on_shared_sets("object_manipulation", "her", 0.0).values()] == [0.2]
    assert [*numbers.on_shared_sets("fetch_reach", "her", 0.0).values()] == [0.6]


@pytest.mark.parametrize(
    ("beta", "half", "kl", "collapsed"),
    [(1e-8, 1039, 1441, True), (1e-8, 1639, 1621, True), (0.017, 8, 9, False), (0.0, 50, 40, False)],
)
def test_a_seed_collapsed_where_beta_is_gone_and_its_code_does_not_shrink(beta, half, kl, collapsed):
    assert noise_numbers.is_collapsed({"beta": str(beta), "kl_half": str(half), "kl": str(kl)}) is collapsed


def test_what_is_merged_replaces_rows_of_the_same_task_and_method_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(noise_numbers, "NUMBERS", tmp_path / "kept.csv.xz")
    trial_numbers.write([row("her", 0.0, "0.1"), row("infogoal", 0.0, "0.2")], noise_numbers.NUMBERS)
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "object_manipulation_her.csv").write_text(
        "task,method,data_set,seed,epsilon,code,test\nobject_manipulation,her,7,0,0.0,sampled,0.8\n"
    )
    assert noise_numbers.merge(tmp_path / "new") == ["object_manipulation_her"]
    assert {each["method"]: each["test"] for each in noise_numbers.read()} == {"infogoal": "0.2", "her": "0.8"}


ROOMS = noise.run_of("object_search", "none", 0, toy=True)


@pytest.fixture
def rooms_for_houses(monkeypatch):
    """The hand-made task, whose house need not be built, in place of object search."""
    monkeypatch.setattr(batches, "config_of", lambda run, images: hand_made.config("none"))
    monkeypatch.setattr(batches, "load_environment", lambda config: hand_made.environment())
    monkeypatch.setattr(batches, "build_data", lambda run: None)


@pytest.mark.long
def test_a_method_is_evaluated_at_every_noise_on_both_codes_and_not_twice(rooms_for_houses, tmp_path, monkeypatch):
    """After no update: what training does has tests of its own."""

    def train_nothing(sweep, callback, stop):
        sweep.states, sweep.learned = sweep.programs.states.initial(), {}
        sweep.evaluations = sweep.config.num_epochs // sweep.config.epochs_per_evaluation
        callback.evaluated(sweep)

    monkeypatch.setattr(noise, "train_sweep", train_nothing)
    path = tmp_path / "object_search_none.csv"
    with stop_on_signal() as stop:
        noise.run("object_search", "none", path, time.time() + 600, stop, [ROOMS])
    rows = trial_numbers.read(path)
    found = {(each["seed"], float(each["epsilon"]), each["code"]): each["test"] for each in rows}
    assert set(found) == {
        (seed, epsilon, code) for seed in "01" for epsilon in EPSILONS for code in ("sampled", "mean")
    }
    assert all(found[seed, epsilon, "mean"] == value for (seed, epsilon, _), value in found.items())  # It has no noise.


def test_what_is_not_trained_to_its_end_leaves_no_rows(rooms_for_houses, tmp_path):
    path = tmp_path / "object_search_none.csv"
    with stop_on_signal() as stop:
        noise.run("object_search", "none", path, time.time() - 1, stop, [ROOMS])
    assert not path.exists()


@pytest.mark.parametrize(
    ("evaluations", "seconds", "goes_on"), [(1, 50, True), (1, 60, False), (3, 80, True), (3, 90, False)]
)
def test_a_run_that_cannot_end_in_the_time_that_is_left_makes_room(evaluations, seconds, goes_on):
    """A hundred seconds before the deadline, of four chunks."""
    watch = object.__new__(noise.Watch)
    watch.deadline = time.time() + 100
    chunks = SimpleNamespace(num_evaluations=4)
    sweep = SimpleNamespace(config=chunks, evaluations=evaluations, last_seconds=seconds)
    assert watch.has_time(sweep) is goes_on


def held_out(method: str, updates: int, data_set: str = "8") -> dict[str, str]:
    """A row of the held-out cube, greedy."""
    return row(method, 0.0, task=noise_numbers.HELD_OUT, data_set=data_set, updates=str(updates))


def test_the_held_out_cube_is_compared_at_the_last_updates_that_all_made():
    rows = [held_out("her", updates) for updates in (60, 90, 120)]
    rows += [held_out("all_goals", updates) for updates in (60, 90)]
    rows += [row("her", 0.0, updates="7")]
    found = noise_numbers.at_shared_updates(rows)
    assert {(each["method"], each["updates"]) for each in found} == {("her", "90"), ("all_goals", "90"), ("her", "7")}


def test_the_held_out_cube_has_its_agent_and_protocol_and_beta_0_its_floats():
    run = noise.run_of(noise_numbers.HELD_OUT, "infogoal+all_goals+beta_0", 8, toy=False)
    assert (run.task, run.method, run.relabelling) == ("object_manipulation", "infogoal", "all_goals")
    assert (run.agent, run.known_goals, run.goal_set) == ("dqn", "held_out", 8)
    assert dict(run.setting.values) == noise_numbers.NO_BETA and len(run.seeds) == noise_numbers.SEEDS
    assert noise.run_of("object_manipulation", "her", 7, toy=False).agent is None


@pytest.mark.parametrize(("rival", "verdict"), [("0.2", "holds"), ("0.9", "fails")])
def test_a_first_place_at_equal_noise_is_decided_by_the_weakest_difference(rival, verdict):
    """Under the text InfoGoal, InfoBot and GCB are those with HER; a row that is missing leaves a first place open."""
    labels = ["infogoal+her", "infobot+her", "gcb+her", "cogoal", "vae", "dgrl", "rad", "none", "her", "cher", "ghrl"]
    rows = [
        row(
            label,
            epsilon,
            {"infogoal+her": "0.7", "vae": rival}.get(label, "0.1"),
            seed=str(seed),
            data_set=str(number),
        )
        for label in labels
        for epsilon in EPSILONS
        for number in (7, 8, 9)
        for seed in range(3)
    ]
    found = noise_numbers.is_first(Numbers(rows), "object_manipulation", "test_goal", "text", "best")
    assert found.verdict == verdict and (verdict == "holds" or found.words == "VAE")
    without = [each for each in rows if each["method"] != "gcb+her"]
    found = noise_numbers.is_first(Numbers(without), "object_manipulation", "test_goal", "text", "0.1")
    assert found.verdict == ("fails" if verdict == "fails" else "cannot be told")
    assert ("GCB not run" in found.details) == (verdict == "holds")


def test_what_is_missing_of_a_study_is_what_has_too_few_seeds():
    rows = [
        {"task": "embodied_qa", "method": method, "data_set": number, "seed": str(seed)}
        for method in ("her", "rad")
        for number in (7, 8, 9)
        for seed in range(3 if number == 8 else 5)
    ]
    asked = ["embodied_qa"], ["her", "none"]
    assert list(noise_numbers.missing(rows, *asked)) == [
        ("embodied_qa", "her", (8,)),
        ("embodied_qa", "none", (7, 8, 9)),
    ]
    assert list(noise_numbers.missing(rows, *asked, [9])) == [("embodied_qa", "none", (9,))]
    assert len(list(noise_numbers.missing([], asked[0]))) == len(noise_numbers.METHODS)


def test_a_reading_changes_its_preset_alone():
    run = noise.run_of("fetch_reach+read", "infogoal+her@listed_corrupted", 0, toy=False)
    assert (run.task, run.method, run.relabelling, run.agent) == ("fetch_reach", "infogoal", "her", None)
    settings = noise_numbers.settings_of("fetch_reach+read", "infogoal+her@listed_corrupted")
    assert settings == {"learner.positives": "listed", "learner.radius": 0.25, "training_corruption": 0.4}
    assert noise_numbers.settings_of("fetch_reach+read", "infogoal@listed_1")["learner.radius"] == 0.05
    assert noise_numbers.settings_of("fetch_reach", "infogoal") == {}


def test_the_head_under_hrac_draws_as_few_goals_as_on_fetch():
    fetch, cube = noise_numbers.HELD_OUT_FETCH[0], noise_numbers.HELD_OUT_HRAC
    few = noise.run_of(fetch, "all_goals", 0, toy=False).preset().agent.num_goals
    assert noise_numbers.settings_of(cube, "infogoal+all_goals") == {"agent.num_goals": few}
    assert (
        noise_numbers.settings_of(cube, "her") == noise_numbers.settings_of(noise_numbers.HELD_OUT, "all_goals") == {}
    )


def test_a_reading_is_compared_with_the_preset_on_the_same_data_sets_and_seeds():
    """The preset ran on three cubes, the reading on one: what the others say of the preset does not count."""
    presets_ = [
        row("her", epsilon, test="0.5" if number == 7 else "0.1", data_set=str(number), seed=str(seed))
        for epsilon in EPSILONS
        for number in (7, 8, 9)
        for seed in range(3)
    ]
    read = [
        row("her@desired", epsilon, test=f"{0.7 + seed / 100}", task="object_manipulation+read", seed=str(seed))
        for epsilon in EPSILONS
        for seed in range(3)
    ]
    for each in presets_ + read:
        each["corrupted_test"] = "0.3"
    lines = noise_numbers.readings_table(Numbers(presets_ + read)).splitlines()
    assert lines[0] == "| reading | cube | cube, corrupted |" and lines[2:] == [
        "| preset | -/-/-/0.50/- | -/-/-/0.30/- |",
        "| all goals desired | -/-/-/**0.71**/- | -/-/-/0.30/- |",
    ]


def test_a_clean_choice_is_the_best_of_the_drawn_settings_and_a_final_decides(tmp_path, monkeypatch):
    """The preset, trial 0, is never it, nor is a setting with a seed that diverged before one without."""

    def search(name: str, *trials: tuple[int, float, list[int]]) -> dict:
        ran = [
            {"trial": number, "values": {"discount": number / 100}, "success": [[0.0], [score]], "diverged": diverged}
            for number, score, diverged in trials
        ]
        return {"search": name, "trials": ran}

    searches = [
        search("object_search/her", (0, 0.1, []), (9, 0.9, [])),
        search("clean/object_search/her", (0, 0.9, []), (3, 0.5, []), (4, 0.6, []), (5, 0.7, [1000])),
        search("clean/object_search/her/final", (0, 0.9, []), (4, 0.3, []), (3, 0.4, [])),
        search("clean/object_search/vae", (0, 0.9, []), (3, 0.5, []), (4, 0.6, []), (5, 0.7, [1000])),
    ]
    path = tmp_path / "tuning.jsonl.xz"
    trial_numbers.write_compressed(path, "".join(json.dumps(each) + "\n" for each in searches))
    choices = tuning.clean_choices("object_search", path)
    assert choices == {"her": {"discount": 0.03}, "vae": {"discount": 0.04}}
    monkeypatch.setattr(tuning, "clean_choices", lambda task: choices)
    run = noise.run_of("object_search+read", "her@clean", 7, toy=False)
    assert dict(run.setting.values) == choices["her"] and run.relabelling is None and run.method == "her"
    with pytest.raises(UserError, match="no clean search"):
        noise.run_of("object_search+read", "gcb+her@clean", 7, toy=False)


@pytest.mark.parametrize("method", ["infogoal", "infogoal+her", "infogoal+all_goals"])
def test_a_search_asks_the_command_for_a_method_that_there_is(method, tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(tuning, "data_of", lambda *_: [])
    monkeypatch.setattr(tuning.subprocess, "run", lambda command, check: commands.append(command))
    for task, other in (("object_search", None), ("object_manipulation", "her" if method == "infogoal" else None)):
        tuning.search(task, method, 2, 2, tmp_path)
        asked = {flag: value for flag, value in zip(commands[-1], commands[-1][1:], strict=False) if flag[:2] == "--"}
        assert asked.get("--relabelling") == other
        config = presets.load(task, asked["--method"], relabelling=other)
        assert presets.name_of(config) == (method if other is None else "infogoal+her")


def small(method: str, data_set: int, seed: int, value: float) -> dict[str, str]:
    """A row of the small preset, of validation goals in the house of the tuning, of test goals in others."""
    kinds = ("", str(value)) if data_set != tuning.SEED else (str(value), "")
    about = {"task": noise_numbers.FIRST_TRIALS, "data_set": str(data_set), "seed": str(seed), "updates": "4000"}
    return row(method, noise_numbers.SAME, kinds[1], kinds[0], machine="a machine", **about)


def test_the_small_preset_is_compared_seed_by_seed_with_its_own_floats_and_epochs():
    preset = presets.load("object_search", "infogoal", small=True)
    run = noise.run_of(noise_numbers.FIRST_TRIALS, "infogoal", 7, toy=False)
    assert dict(run.setting.values)["learning_rate"] == preset.hyper.learning_rate != run.preset().hyper.learning_rate
    assert noise_numbers.settings_of(noise_numbers.FIRST_TRIALS, "her") == {"num_epochs": preset.num_epochs}
    rows = [
        small(method, house, seed, value + 0.1 * seed)
        for method, value in (("infogoal", 0.5), ("her", 0.2))
        for house in (7, tuning.SEED)
        for seed in range(3)
    ]
    table = noise_numbers.small_table(Numbers(rows))
    assert "validation goals, house 100 | test goals, house 7" in table
    assert "| InfoGoal - HER | **+0.30±0.00** | **+0.30±0.00** |" in table
    assert "test goals" not in noise_numbers.small_table(Numbers([each for each in rows if each["data_set"] != "7"]))


def test_what_a_memory_does_to_a_lead_is_paired_and_what_is_changed_is_a_field():
    task = noise_numbers.SEARCHING
    reached = {("object_search", "infogoal"): 0.5, ("object_search", "her"): 0.1}
    reached |= {(task, "infogoal@memory"): 0.4, (task, "her@memory"): 0.5}
    rows = [
        row(method, epsilon, str(value + seed / 10), task=each, seed=str(seed), data_set="7", train="0.9")
        for (each, method), value in reached.items()
        for epsilon in EPSILONS
        for seed in range(3)
    ]
    table = noise_numbers.searching_table(Numbers(rows)).splitlines()
    assert table[0] == "|  | preset | with a memory | its training goals |"
    assert "| HER | 0.20/0.20 | 0.60/0.60 | 0.90 |" in table and "| bare agent |  |  |  |" in table
    assert "| InfoGoal - HER | **+0.40±0.00**/**+0.40±0.00** | **-0.10±0.00**/**-0.10±0.00** |  |" in table
    settings = {method: noise_numbers.settings_of(task, method) for method in noise_numbers.BESIDE[task]}
    for method, values in settings.items():
        preset = noise.run_of(task, method, 7, toy=False).preset()
        for field, value in values.items():
            before, after = (attrgetter(field)(config) for config in (preset, with_values(preset, values)))
            assert after == value != before


@pytest.mark.parametrize("task", noise_numbers.CHOSEN_OF)
def test_clean_choices_stand_beside_presets_on_data_sets_that_no_choice_has_seen(task):
    own, chosen = noise_numbers.SHOWN[task], noise_numbers.CHOSEN_OF[task]
    assert noise_numbers.DATA_SETS[own] == noise_numbers.DATA_SETS[chosen]
    assert set(noise_numbers.DATA_SETS[own]) - {tuning.SEED} == {7, 8, 9}
    again = [noise_numbers.again(task, method) for method in noise_numbers.METHODS]
    ran = [
        method
        for method, (_, name) in zip(noise_numbers.METHODS, again, strict=True)
        if name in noise_numbers.methods_of(chosen)
    ]
    assert set(ran) >= {method for pair in noise_numbers.CLEAN_PAIRS.get(task, ()) for method in pair}
    assert set(ran) <= noise_numbers.methods_of(own).keys()


def test_presets_are_compared_with_clean_choices_on_the_data_sets_of_both():
    own, chosen = noise_numbers.SHOWN["object_manipulation"], noise_numbers.CHOSEN_OF["object_manipulation"]
    rows = [row("her", 0.0, "0.5", task=own, data_set=number) for number in "789"]
    rows += [row("her@clean", 0.0, "0.6", task=chosen, data_set=number) for number in "78"]
    found = noise_numbers.on_both(rows, Numbers(rows), "object_manipulation")
    assert [(each["task"], each["data_set"]) for each in found] == [(task, n) for task in (own, chosen) for n in "78"]
