"""Random search: fair to every method, blind to test goals, and each setting is the run that its values would make
alone."""

import dataclasses
import json

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up_results import environment, made, save, small

from infogoal_jax import Hyperparameters, make_train, presets
from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import check, search_space, values_of, with_values
from infogoal_jax.report import tuning
from infogoal_jax.report.methods import against
from infogoal_jax.runner import search, training
from infogoal_jax.runner.search import Watch, tune
from infogoal_jax.runs.search import write_plan, write_scores


@pytest.fixture(scope="module")
def env():
    return environment()


@pytest.fixture(scope="module")
def result(env, tmp_path_factory):
    """Two trials with two seeds, with what is left on disk after each evaluation."""
    folder, left = tmp_path_factory.mktemp("search"), []

    def evaluated(found):
        write_scores(folder, found)
        left.append({path.name: path.read_text() for path in folder.glob("*.json*")})

    watch = Watch(folder, evaluated=evaluated)
    return tune(small(), 2, [1000, 1001], jax.random.key(0), env=env, watch=watch), left


@pytest.mark.long
def test_each_setting_is_the_run_of_its_values_alone(result, env):
    found, _ = result
    train = make_train(found.config, search.scored_goals_only(env)[0])

    @jax.jit
    def begin(seed, hyper):
        state = train.initial(jax.random.key(seed), hyper, train.env)
        _, epochs, metrics = train.chunk(state, jnp.arange(1), hyper, train.env)
        return epochs["agent/loss"][-1], metrics["validation_goal/success_rate"]

    settings = [jax.tree.map(jnp.float32, found.config_of(trial).hyper) for trial in found.trials]
    alone = np.array([[begin(jnp.uint32(seed), hyper) for seed in found.seeds] for hyper in settings])
    np.testing.assert_allclose([trial.loss[0] for trial in found.trials], alone[..., 0], rtol=1e-4)
    np.testing.assert_allclose([trial.success[0] for trial in found.trials], alone[..., 1], atol=1e-4)
    assert len(np.unique(alone[..., 0])) == 4


@pytest.mark.long
def test_trial_0_is_the_preset_and_others_are_of_the_space(result):
    found, _ = result
    assert found.config_of(found.trials[0]) == found.config
    assert found.fields == ("learning_rate", "discount", "target_rate")  # The bare agent has no other weight.
    values, space = found.trials[1].values, search_space(found.config.hyper)
    assert all(space[field].low <= values[field] <= space[field].high for field in found.fields)
    assert values != found.trials[0].values


@pytest.mark.long
def test_what_is_left_on_disk_says_nothing_of_test_goals(result, env):
    found, left = result
    assert found.group == "validation" and [len(files) for files in left] == [3, 3]
    # There after the first evaluation already.
    assert [json.loads(files["best.json"])["epoch"] for files in left] == [1, 2]
    lines = [json.loads(line) for line in left[-1]["trials.jsonl"].splitlines()]
    assert [(line["trial"], line["preset"], line["seeds"], line["goals"]) for line in lines] == [
        (0, True, [1000, 1001], "validation"),
        (1, False, [1000, 1001], "validation"),
    ]
    assert all(np.shape(line["success"]) == (2, 2) and line["score"] == np.mean(line["success"][-1]) for line in lines)
    assert "test" not in left[-1]["trials.jsonl"] + left[-1]["best.json"]


@pytest.mark.parametrize(("make", "group"), [(None, "validation"), (hand_made.environment, "train")])
def test_test_goals_are_not_evaluated(make, group, env):
    """Where there are no validation goals, training goals are scored."""
    whole = env if make is None else make()
    restricted, scored = search.scored_goals_only(whole)
    evaluated = np.zeros(whole.goals.num_goals, bool)
    evaluated[restricted.goals.evaluated] = True
    assert scored == group and restricted.goals.groups == (group,)
    np.testing.assert_array_equal(evaluated, getattr(whole.goals, f"{group}_mask"))
    np.testing.assert_array_equal(restricted.goals.training_goals, whole.goals.training_goals)


EVERY = [presets.load("fetch_reach", "infogoal").hyper, presets.load("embodied_qa", "infobot").hyper]
"""Together all floats that are searched."""
SPACE = {field: hyper for hyper in EVERY for field in search_space(hyper)}


@pytest.mark.parametrize("field", list(SPACE))
def test_draws_fill_the_range_evenly_on_its_scale(field):
    """Half of them lie below the middle of the scale, and all within the range; a discount's middle is near its upper
    end."""
    found, space = search.draw(jax.random.key(3), SPACE[field], [field], 1000), search_space(SPACE[field])[field]
    values, (low, high, scale, *_) = np.array([trial[field] for trial in found[1:]]), space
    middle = {
        "linear": (low + high) / 2,
        "log": np.sqrt(low * high),
        "log of 1 - x": 1 - np.sqrt(abs((1 - low) * (1 - high))),
    }[scale]
    assert low <= values.min() and values.max() <= high
    assert 0.4 < (values < middle).mean() < 0.6
    assert 0.15 < (values < space.at(0.25)).mean() < 0.35


def test_the_first_draw_is_the_preset():
    hyper = presets.load("fetch_reach", "infogoal").hyper
    first, other = search.draw(jax.random.key(0), hyper, ["discount"], 2)
    assert first == {"discount": values_of(hyper)["discount"]} != other


def test_methods_try_the_same_values_of_the_fields_that_they_share():
    first = search.draw(jax.random.key(0), Hyperparameters(), ["learning_rate", "discount"], 5)
    second = search.draw(jax.random.key(0), Hyperparameters(), ["intrinsic_weight", "discount", "learning_rate"], 5)
    assert first == [{field: trial[field] for field in ("learning_rate", "discount")} for trial in second]


def test_the_space_is_one_of_hyperparameters_that_can_be_had():
    """Both ends of every range; but not what only evaluations depend on."""
    for field, hyper in SPACE.items():
        for value in search_space(hyper)[field][:2]:
            check(with_values(hyper, {field: value}))
    assert "test_epsilon" not in SPACE


@pytest.mark.parametrize(
    ("method", "changes", "searched", "left_alone"),
    [
        (
            "none",
            {"agent": "cql"},
            {"agent.conservative_weight", "epsilon"},
            {"learner_weight", "intrinsic_weight", "bonus_weight", "noise"},
        ),
        pytest.param(
            "infogoal",
            {},
            {"learner_weight", "intrinsic_weight", "learner.beta_step"},
            {"learner.fixed_beta", "noise"},
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_method_is_searched_in_what_it_depends_on(method, changes, searched, left_alone, env):
    matter = search.fields_that_matter(make_train(small(method, **changes), env))
    assert {"learning_rate", "discount", "target_rate"} | searched <= set(matter)
    assert not left_alone & set(matter)


def test_methods_have_the_same_budget():
    for task in presets.TASKS:
        methods = [method for method in presets.METHODS if not against(task, method)]
        budgets = [search.same_budget(presets.load(task, method)) for method in methods]
        assert len({tuple(getattr(config, name) for name in search.BUDGET) for config in budgets}) == 1


@pytest.mark.parametrize(
    ("trials", "seeds", "fields", "message"),
    [
        (2, [1000], ["learning_rte"], "fields = 'learning_rte'.*Did you mean 'learning_rate'"),
        (2, [1000], ["test_epsilon"], "fields = 'test_epsilon': is not searched"),
        (2, [1000], ["discount", "discount"], "fields = .*once"),
        (2, [1000], ["intrinsic_weight"], "fields = 'intrinsic_weight': changes nothing about none"),
        (2, [0, 1], [], "first_seed = 0.*1000 or more"),
        (2, [], [], "seeds = 0"),
        (0, [1000], [], "trials = 0"),
        (2, [1000, 1000], [], "different"),
    ],
)
def test_mistakes_are_refused_before_anything_is_compiled(trials, seeds, fields, message, env, monkeypatch):
    monkeypatch.setattr(jax.stages.Lowered, "compile", lambda *arguments: pytest.fail("compiled"))
    with pytest.raises(UserError, match=message):
        tune(small(), trials, seeds, jax.random.key(0), fields, env=env)


@pytest.mark.long
def test_a_final_runs_trials_of_a_search_again(result, env):
    """With the seeds of the search each is what it was there, wherever it stands; with others it is not."""
    found, _ = result
    finalists = [search.Trial(5, found.trials[1].values), search.Trial(0, found.trials[0].values)]
    again = search.final(found.config, finalists, found.seeds, env=env)
    assert (
        [trial.trial for trial in again.trials] == [5, 0]
        and again.fields == found.fields
        and again.epochs == found.epochs
    )
    np.testing.assert_allclose(
        [trial.loss for trial in again.trials], [found.trials[number].loss for number in (1, 0)], rtol=1e-4
    )
    others = search.final(found.config, finalists, [1002, 1003], env=env)
    assert not np.isclose(others.trials[0].loss[-1], found.trials[1].loss[-1]).any()


@pytest.mark.parametrize(
    ("task", "method", "changes"),
    [
        ("object_search", "her", {"num_epochs": 40, "stop_encoder_gradient": False}),
        ("object_manipulation", "infogoal", {"agent": "dqn", "relabelling": "her"}),
        ("embodied_qa", "none", {"relabelling": "none", "evaluation_starts": 3}),
    ],
)
def test_the_flags_of_the_best_train_with_its_configuration(task, method, changes, tmp_path, monkeypatch):
    """`infogoal train` is given them, and would run what was best: other parts, switches and lists included."""
    config = presets.load(task, method, **changes)
    config = dataclasses.replace(
        config,
        env=dataclasses.replace(config.env, episode_length=60),
        agent=dataclasses.replace(config.agent, hidden=(16, 8)),
        learner=dataclasses.replace(config.learner, standardise_images=True),
    )
    found = made(config, [[0.0], [1.0]])
    save(found, tmp_path / "search")
    ran = []

    def run(config, *arguments, **named):
        ran.append(config)
        raise UserError("that is enough")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(training, "run", run)
    assert main(["train", task, *json.loads((tmp_path / "search" / "best.json").read_text())["flags"]]) == 2
    assert ran == [found.config_of(found.trials[1])] and ran[0].hyper.learning_rate == 5e-4


def test_stopping_leaves_what_is_known(tmp_path, monkeypatch, capsys):
    """Ctrl-C after the first evaluation; the command had its own flags, and those of the configuration."""
    asked = []

    def interrupted(config, trials, seeds, key, fields, watch):
        asked.append((config.num_epochs, presets.names_of(config)["learner"], trials, list(seeds), fields))
        found = made(config, [[0.25], [0.5]])
        watch.folder.mkdir()
        write_plan(watch.folder, found)
        watch.evaluated(found)
        return found

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(search, "tune", interrupted)
    flags = (
        "--method her --num-epochs 40 --trials 2 --seeds 1 --first-seed 1005 --fields learning-rate discount "
        "--out "
        "search"
    )
    assert main(["tune", "object_search", *flags.split()]) == 130
    assert asked == [(40, "none", 2, [1005], ("learning_rate", "discount"))]
    assert json.loads((tmp_path / "search" / "best.json").read_text())["score"] == 0.5
    assert "go on with: infogoal tune --resume search" in capsys.readouterr().out
    for flag in ("--trials 8", "--seeds=3", "--first-seed 1001", "--space_seed 4", "--fields discount"):
        assert main(["tune", "--resume", "search", *flag.split()]) == 2
        assert f"--{flag.split('=')[0].split()[0][2:].replace('_', '-')}: a search that" in capsys.readouterr().err


def test_the_table_says_what_was_scored_and_how_to_train(capsys):
    tuning.print_result(made(small(), [[0.0, 0.7], [0.0, 0.75]]))
    printed = " ".join(capsys.readouterr().out.split())
    assert "training goals, for want of validation goals" in printed and "0.75" in printed and "s compiling" in printed
    assert "infogoal train object_search --method none" in printed and "--hyper.learning-rate 0.0005" in printed


def test_no_number_of_the_table_is_broken_over_two_lines(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    found = made(small("infogoal"), [[0.0], [0.7]])
    values = dict.fromkeys(search_space(found.config.hyper), 0.00097461)
    for trial in found.trials:
        trial.values.update(values)
    tuning.print_result(found)
    printed = capsys.readouterr().out
    assert printed.partition("scores")[0].count(" 0.0009746 ") == 2 * len(values) > 6
    assert "for want of validation goals, seed 1000, after epoch 1" in printed


def test_the_score_shown_is_that_of_the_trial_that_is_best_now(tmp_path, capsys):
    with tuning.watching(small(), 2, 1, tmp_path) as watch:
        for successes in ([[0.25], [0.5]], [[0.25, 0.35], [0.5, 0.0]]):
            watch.evaluated(made(small(), successes))
    printed = capsys.readouterr().out
    assert "best 0.50, preset 0.25" in printed and "best 0.35, preset 0.35" in printed
    assert not any("test" in (tmp_path / name).read_text() for name in ("trials.jsonl", "best.json"))


@pytest.mark.parametrize(("weight", "floored"), [(0.012, True), (0.0015, True), (0.1, False)])
def test_a_best_setting_that_all_but_turns_the_method_off_is_named(weight, floored, capsys):
    """The search begins where the term acts; a preset may lie below."""
    found = made(small("vae"), [[0.0], [0.7]])
    found.trials[1].values["learner_weight"] = weight
    tuning.print_result(found)
    assert ("at the lower end of its range: learner_weight" in capsys.readouterr().out) == floored
    assert search_space(found.config.hyper)["learner_weight"].low == 0.01
