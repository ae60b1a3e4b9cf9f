"""Configurations and calls from Python are checked where they are made: types, ranges, and what a program can hold.
Presets hold what the searches found, and mean one thing however a method is named."""

import dataclasses
import math
import typing
from typing import Literal

import hand_made
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import Hyperparameters, UserError, envs, learners, make_train, presets, relabelling
from infogoal_jax.envs.embodied_qa import EmbodiedQAConfig
from infogoal_jax.envs.object_manipulation import ObjectManipulationConfig
from infogoal_jax.envs.object_search import ObjectSearchConfig
from infogoal_jax.errors import require
from infogoal_jax.field_types import Positive, Share, Weight, hints_of, lies_in
from infogoal_jax.goals import GoalSet
from infogoal_jax.hyperparameters import values_of
from infogoal_jax.learners.vae import VAEConfig
from infogoal_jax.presets.preset import Changes
from infogoal_jax.registry import Entry, Registry
from infogoal_jax.report import task_figures
from infogoal_jax.runner import search as searching
from infogoal_jax.runner.training import checked_seeds
from infogoal_paper import tuning

CONFIG = hand_made.config()
SEARCHES = tuning.load(tuning.NUMBERS)


def with_part(part: str, **values):
    return dataclasses.replace(CONFIG, **{part: dataclasses.replace(getattr(CONFIG, part), **values)})


def with_hyper(**values):
    return dataclasses.replace(CONFIG, hyper=CONFIG.hyper.replace(**values))


def beyond(field: dataclasses.Field, hint) -> list:
    """Values that a field declares it cannot have: another word than its own, numbers at or past the ends of its
    interval, numbers that are not finite, and none of several."""
    if typing.get_origin(hint) is Literal:
        return ["another"]
    found = [math.inf, math.nan] if hint in (float, Share, Weight, Positive) else []
    for within in getattr(hint, "__metadata__", ()):
        ends, inside = (
            [float(end) for end in within.interval[1:-1].split(",")],
            within.interval[0] + within.interval[-1],
        )
        kind = int if isinstance(field.default, int) or hint.__origin__ == tuple[int, ...] else float
        past = [end + step * (mark in "[]") for end, step, mark in zip(ends, (-1, 1), inside, strict=True)]
        found += [kind(value) for value in past if math.isfinite(value)]
    return [*((value,) for value in found), ()] if found and isinstance(field.default, tuple) else found


def test_an_interval_that_ends_at_no_float32_has_its_end():
    assert lies_in(0.1, "[0, 0.1]") and lies_in(0.3, "[0.3, 1]") and not lies_in(0.3, "(0.3, 1]")


@pytest.mark.parametrize("kind", presets.loading.REGISTRIES)
def test_every_field_of_a_part_is_held_to_what_it_declares(kind):
    """Whatever part it is of: a value beyond is named with its field."""
    looked_at = 0
    for entry in presets.loading.REGISTRIES[kind].values():
        config = entry.config()
        for field in dataclasses.fields(config):
            for value in beyond(field, hints_of(entry.config)[field.name]):
                with pytest.raises(UserError, match=rf"^{kind}\.{field.name} = ") as error:
                    dataclasses.replace(CONFIG, **{kind: dataclasses.replace(config, **{field.name: value})})
                assert "\n" not in str(error.value)
                looked_at += 1
    assert looked_at > 3


def test_numbers_of_numpy_are_those_of_python():
    config = dataclasses.replace(
        with_hyper(discount=np.float32(0.5)), num_envs=np.int64(4), test_corruption=np.float32(0.25)
    )
    assert (config.hyper.discount, config.num_envs, config.test_corruption) == (0.5, 4, 0.25)
    assert type(config.hyper.discount) is type(config.test_corruption) is float and type(config.num_envs) is int
    assert with_part("env", scenes=["Home_101_1"]).env.scenes == ("Home_101_1",)


def of_goals(count: int):
    """The hand-made rooms with so many names of goals."""
    env = hand_made.environment()
    return env.replace(goals=env.goals.replace(names=("a goal",) * count))


@dataclasses.dataclass(frozen=True)
class OtherVAEConfig(VAEConfig):
    """The configuration of a learner that is not registered yet."""


def register(name: str, entry) -> None:
    """Into a registry of learners that is thrown away."""
    Registry("learner", learners.registry)[name] = entry


def load_with(**changes) -> None:
    """The configuration of a preset with something misspelt."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(
            presets.registry, "object_search", dataclasses.replace(presets.registry["object_search"], **changes)
        )
        presets.load("object_search")


def goals_of(**changes) -> GoalSet:
    """Three goals, with something that does not fit."""
    fit = {"inputs": np.zeros((3, 4), np.float32), "regions": [0, 0, 0], "uses": [0, 0, 2], "names": ("a", "b", "c")}
    return GoalSet.of(**fit | changes, region_names=("a room",))


def without_training_goals():
    """The hand-made rooms, all of whose goals are for the test."""
    env = hand_made.environment()
    goals, count = env.goals, env.goals.num_goals
    return env.replace(goals=GoalSet.of(goals.inputs, goals.regions, [2] * count, goals.names, goals.region_names))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: with_part("learner", window=3.5), r"learner.window = 3.5: expected int, got float"),
        (lambda: with_part("learner", loss="x"), "learner.loss = 'x': give one of 'nce', 'ratio'"),
        (lambda: with_part("agent", huber="x"), "agent.huber = 'x': expected bool, got str"),
        (
            lambda: with_part("learner", window="\ud800"),
            r"learner.window = '.ud800': is text with a half of a character",
        ),
        (lambda: with_part("env", scenes="Home_101_1"), "env.scenes = 'Home_101_1': expected list, got str"),
        (lambda: with_part("agent", hidden=(1.5,)), r"agent.hidden = \(1.5,\): expected int"),
        (lambda: dataclasses.replace(CONFIG, num_envs=True), "num_envs = True: expected int, got bool"),
        (lambda: dataclasses.replace(CONFIG, batch_size=10**20), "batch_size = 1000.*at most 2147483647"),
        (lambda: dataclasses.replace(CONFIG, buffer_steps=2**31 - 1), "buffer_steps = .*places.*at most 2147483647"),
        (lambda: hand_made.config("gcb", batch_size=1), "batch_size = 1: learner gcb compares transitions .*give 2"),
        (
            lambda: presets.load("point_maze", agent="crl", relabelling="her", batch_size=1),
            "batch_size = 1: goals of the other transitions are the contrast; give 2",
        ),
        (lambda: presets.load("point_maze", agent="offline_crl", batch_size=1), "batch_size = 1: goals of the other"),
        (
            lambda: make_train(hand_made.config("none", num_envs=1, rollout_steps=1, buffer_steps=1)),
            "buffer_steps = 1: holds 1 step of each environment, which may pass without a decision.*: give 2$",
        ),
        (
            lambda: make_train(hand_made_points.config("none", num_envs=2, rollout_steps=3, buffer_steps=6)),
            "buffer_steps = 6: holds 3 steps of each environment.*: give 12$",
        ),
        (lambda: dataclasses.replace(CONFIG, test_corruption=math.nan), "test_corruption = nan"),
        (lambda: dataclasses.replace(CONFIG, learner="infogoal"), "learner = 'infogoal': give a configuration"),
        (lambda: dataclasses.replace(CONFIG, hyper={"discount": 0.9}), "hyper = {'discount': 0.9}: give a record"),
        (lambda: with_hyper(learner=0), "hyper.learner = 0: give a record"),
        (lambda: with_hyper(learning_rate=np.float32(9), discount=7.0), "hyper.discount = 7.0: give a number in"),
        (lambda: with_hyper(discount=np.array([0.5, 2.0])), "hyper.discount = 2.0: give a number in"),
        (lambda: with_hyper(learning_rate=1e39), r"hyper.learning_rate = 1e\+39: give a finite number"),
        (lambda: with_hyper(discount="0.9"), "hyper.discount = '0.9': give a number"),
        # Programs are given float32, which has no number between this one and 1, and none between that one and 0.
        (lambda: with_hyper(discount=0.99999999), r"hyper.discount = 0.99999999: give a number in \[0, 1\)"),
        (lambda: with_hyper(learning_rate=1e-60), r"hyper.learning_rate = 1e-60: give a number in \(0, inf\)"),
        (
            lambda: dataclasses.replace(CONFIG, training_corruption=0.99999999),
            "training_corruption = 0.99999999: give a weight from 0 to below 1",
        ),
        (
            lambda: make_train(presets.load("object_search", num_epochs=700_000)),
            "num_epochs = 700000: num_envs x rollout_steps = 3,200 each are more steps .*: give 2,147,483,647 steps",
        ),
        (
            lambda: make_train(presets.load("object_search", "infobot", stop_encoder_gradient=True)),
            "stop_encoder_gradient = True: nothing else than the agent's loss teaches .*'infobot'",
        ),
        (lambda: presets.load(5), "task = 5: give the name of a task"),
        (lambda: presets.load("object_search", 5), "method = 5: give the name of a method"),
        (lambda: presets.load("object_search", num_env=5), "num_env = 5: no such field.*Did you mean 'num_envs'"),
        (
            lambda: presets.load("object_search", beta_threshold=0.9),
            "beta_threshold = 0.9: no such field of TrainConfig. It is one of config.hyper.learner: ",
        ),
        (
            lambda: envs.load("object_search", CONFIG),
            "config = 'TrainConfig': object_search needs a ObjectSearchConfig",
        ),
        (lambda: envs.load("embodied_qa", EmbodiedQAConfig(generator_seed=-1)), "env.generator_seed = -1: give 0"),
        (lambda: envs.load("object_manipulation", ObjectManipulationConfig(num_goals=(0, 1, 1))), "env.num_goals = "),
        (lambda: envs.load("object_search", ObjectSearchConfig(episode_length="x")), "env.episode_length = 'x'.*int"),
        (lambda: with_part("learner", window=None), "learner.window = None: expected int, got None"),
        (lambda: with_part("learner", window=np.zeros(2)), "expected int, got numpy.ndarray"),
        (
            lambda: register("my_vae", Entry(VAEConfig, print)),
            "learner = 'my_vae': VAEConfig is the configuration of 'vae'",
        ),
        (
            lambda: register("my_vae", (VAEConfig, print)),
            r"learner = 'my_vae': give an Entry\(Config, make, ...\), not tup",
        ),
        (
            lambda: register("my_vae", Entry(OtherVAEConfig, print, of_agent=3)),
            "learner = 'my_vae': Entry.of_agent = 3: give fields by name",
        ),
        (
            lambda: register("my_vae", Entry(OtherVAEConfig, print, of_relabelling=3)),
            "learner = 'my_vae': Entry.of_relabelling = 3: give fields by name",
        ),
        (
            lambda: register("my_vae", Entry(OtherVAEConfig, print, is_method=3)),
            "learner = 'my_vae': Entry.is_method = 3: give True or False",
        ),
        (lambda: load_with(methods={"infogaol": Changes()}), r"preset of object_search = 'infogaol'.*'infogoal'"),
        (lambda: load_with(training={"num_epoch": 20}), r"preset of object_search = 'num_epoch'.*'num_epochs'"),
        (lambda: load_with(hyper={"discout": 0.9}), r"preset of object_search = 'discout'.*'discount'"),
        (lambda: goals_of(uses=[0, 2, 7]), "uses = .*array.*give positions in"),
        (lambda: goals_of(uses=["train", "test", "test"]), "uses = .*array.*give positions in"),
        (lambda: goals_of(regions=[0, 1, 0]), "regions = .*region_names has the regions 0 to 0"),
        (lambda: goals_of(names=("a", "b")), "names = 2: give one for each of the 3 goals in uses"),
        (lambda: goals_of(inputs=np.zeros((2, 4), np.float32)), "inputs = 2: give one for each"),
        (
            lambda: make_train(CONFIG, without_training_goals()),
            r"env.goals = \('test',\): give one or more training goals",
        ),
        (lambda: checked_seeds(3), r"seeds = 3: give a list of whole numbers, such as range\(3\)"),
        (lambda: checked_seeds([0.0]), r"seeds = \[0.0\]: give a list of whole numbers"),
        (lambda: make_train("object_search"), "config = 'object_search': give a TrainConfig"),
        (lambda: make_train(CONFIG, 5), "env = 5: give an environment"),
        (lambda: make_train(CONFIG, of_goals(8193)), "env.goals = 8193: give at most 8192"),
        (
            lambda: make_train(presets.load("embodied_qa"), hand_made.environment()),
            "env = 'ObjectSearch': is an environment of another task than embodied_qa",
        ),
        (
            lambda: make_train(dataclasses.replace(CONFIG, env=presets.load("embodied_qa").env)),
            "env = 'EmbodiedQAConfig': object_search needs ObjectSearchConfig",
        ),
    ],
)
def test_what_cannot_be_used_is_named(make, message):
    with pytest.raises(UserError, match=message):
        make()


@pytest.fixture(scope="module")
def train():
    return make_train(CONFIG, hand_made.environment())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((5,), "key = 5: give one key"),
        ((jax.random.split(jax.random.key(0)),), "give one key.*see jax.vmap"),
        ((jnp.asarray(5),), r"key = Array\(5.*give one key"),
        ((jnp.zeros((3, 2), jnp.uint32),), "give one key.*see jax.vmap"),
        ((jax.random.key(0), 5), "hyper = 5: give Hyperparameters"),
        ((jax.random.key(0), CONFIG.hyper.replace(discount=2.0)), "hyper.discount = 2.0"),
        ((jax.random.key(0), Hyperparameters()), "hyper.learner = 'NoHyperparameters'"),
        ((jax.random.key(0), None, 5), "env = 5: give an environment"),
    ],
)
def test_the_training_function_checks_what_it_is_given(arguments, message, train):
    with pytest.raises(UserError, match=message):
        train(*arguments)


def test_what_is_traced_has_no_value_to_check():
    """Inside of `jax.jit` and `jax.vmap`; docs/guides/training.md says so."""
    train = make_train(hand_made.config("none"), hand_made.environment())
    keys, hyper = jax.random.split(jax.random.key(0), 2), train.config.hyper.replace(discount=jnp.array([0.5, 7.0]))
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, hyper)
    shapes = jax.eval_shape(jax.vmap(train, in_axes=(0, axes, None)), keys, hyper, train.env)
    assert shapes.metrics["test_goal/success_rate"].shape == (2, train.config.num_evaluations)


def trials_of(search: tuning.Search) -> list[searching.Trial]:
    """The trials of a search or final, in order; success by evaluation and seed."""
    return [
        searching.Trial(trial["trial"], trial["values"], trial["success"], [], trial["diverged"])
        for trial in search["trials"]
    ]


def best_of(search: tuning.Search) -> dict[str, float]:
    """The values of the best trial."""
    return next(trial["values"] for trial in search["trials"] if trial["trial"] == search["best"])


@pytest.mark.parametrize("method", [name for name in presets.METHODS if f"fetch_reach/{name}/final" in SEARCHES])
def test_on_fetch_reach_a_preset_is_what_won_the_final(method):
    """Of the preset of that time and the three best of the search, on eight seeds that did not choose them."""
    searched, final = SEARCHES[f"fetch_reach/{method}"], SEARCHES[f"fetch_reach/{method}/final"]
    ran = trials_of(final)
    assert [(trial.trial, trial.values) for trial in ran] == [
        (trial.trial, trial.values) for trial in searching.finalists(trials_of(searched), 4)
    ]
    assert len(final["seeds"]) == 8 and not set(searched["seeds"]) & set(final["seeds"])
    assert max(ran, key=lambda trial: trial.order).values == best_of(final)
    assert values_of(presets.load("fetch_reach", method).hyper).items() >= best_of(final).items()


def test_what_a_search_without_a_final_found_is_better_by_a_tenth():
    """Else the preset does not give way to it."""
    search = SEARCHES["object_search/cogoal"]
    preset, *others = trials_of(search)
    assert values_of(presets.load("object_search", "cogoal").hyper).items() >= best_of(search).items()
    assert max(trial.score for trial in others) >= preset.score + 0.1


@pytest.mark.parametrize(
    "name", [name for name, entry in relabelling.registry.items() if name != "none" and entry.is_method]
)
def test_a_relabelling_alone_is_the_method_of_its_name(name):
    by_parts = presets.load("fetch_reach", "none", relabelling=name)
    assert by_parts == presets.load("fetch_reach", name) and presets.name_of(by_parts) == name


def test_a_combination_without_a_name_takes_what_its_learner_has():
    combined, alone = (
        presets.load("object_search", "infogoal", relabelling="her"),
        presets.load("object_search", "infogoal"),
    )
    assert combined.hyper == alone.hyper and combined.num_epochs == alone.num_epochs
    assert dataclasses.replace(combined, relabelling=alone.relabelling) == alone


def test_a_method_may_change_how_its_agent_learns_from_all_goals():
    sampled, mean = (presets.load("object_search", f"{name}+all_goals") for name in ("none", "infogoal"))
    assert (sampled.agent.code, mean.agent.code) == ("sampled", "mean")
    assert mean.learner == presets.load("object_search", "infogoal").learner


def test_a_part_says_itself_what_it_changes_in_an_agent(monkeypatch):
    """Fields that an agent lacks are passed over; a learner's word is heard after that of all goals at once."""

    @dataclasses.dataclass(frozen=True)
    class OwnConfig(learners.none.NoneConfig):
        """No learner, with another agent."""

    entry = Entry(OwnConfig, learners.none.make, of_agent={"num_steps": 7, "head": "concatenated", "wings": 2})
    monkeypatch.setitem(learners.registry, "own", entry)
    for name, bounded in (("own", False), ("own+all_goals", True)):
        agent = presets.load("object_search", name).agent
        assert (agent.num_steps, agent.head, agent.bounded) == (7, "concatenated", bounded)


@pytest.mark.parametrize("method", ["infogoal", "her", "none"])
def test_a_small_preset_has_the_same_task_and_goals(method):
    full, small = presets.load("object_search", method), presets.load("object_search", method, small=True)
    sizes = {name: getattr(full, name) for name in ("hyper", "num_epochs", "batch_size")}
    assert dataclasses.replace(small, **sizes) == full and presets.name_of(small) == method
    assert small.num_epochs * small.batch_size < full.num_epochs * full.batch_size
    search = SEARCHES[f"clean/object_search/{method}"]
    after = search["epochs"].index(small.num_epochs)
    reached = [np.mean(trial["success"][after]) for trial in search["trials"]]
    chosen = next(
        i for i, trial in enumerate(search["trials"]) if values_of(small.hyper).items() >= trial["values"].items()
    )
    assert reached[chosen] > max(reached) - 0.1


def test_all_public_names_can_be_completed():
    """Those that are imported when they are first asked for are listed like the others, and are there."""
    assert set(presets.__all__) <= set(dir(presets))
    assert all(getattr(presets, name) is not None for name in presets.__all__)


@pytest.mark.parametrize("field", ["hidden", "num_steps", "huber"])
def test_a_record_in_the_place_of_a_number_is_refused(field):
    with pytest.raises(UserError, match=f"agent.{field} = .*expected"):
        with_part("agent", **{field: CONFIG.agent})


GOOD = dict(agent="td3", training={}, hyper={}, methods={})


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(presets.Preset)])
@pytest.mark.parametrize("value", [None, 3, ["td3"], b"x", {1: 2}, CONFIG.agent], ids=str)
def test_a_preset_of_other_types_is_refused_where_it_is_registered(field, value):
    if field == "small" and value is None:
        return  # As it is where a task has none.
    with pytest.raises(UserError, match=f"preset of point_maze_2: {field} = "):
        presets.registry["point_maze_2"] = presets.Preset(**GOOD | {field: value})
    assert "point_maze_2" not in presets.registry


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (dict(training={"nope": 3}), "'nope': no such method, part or field in it"),
        (dict(hyper={"learner.nope": 3.0}), "'learner.nope': no such"),
        (dict(env={"nope": 1}), "'nope': no such method, part or field in env"),
        (dict(state_encoder={"nope": 1}), "in state_encoder"),
        (dict(learner={"nope": 1}), "in learner"),
        (dict(agents={"nope": {}}), "in agents"),
        (dict(agents={"td3": {"nope": 1}}), r"in agents\['td3'\]"),
        (dict(relabellings={"her": {"nope": 1}}), r"in relabellings\['her'\]"),
        (dict(methods={"nope": Changes()}), "in methods"),
        (dict(methods={"infogoal": Changes(learner={"nope": 1})}), r"in methods\['infogoal'\]"),
        (dict(methods={"her": Changes(all_goals={"nope": 1})}), r"in methods\['her'\]"),
        (dict(small=presets.Preset(**GOOD | {"training": {"nope": 3}})), "'nope': no such method, part or field in it"),
    ],
)
def test_a_name_in_a_preset_that_nothing_has_is_refused(changes, said):
    envs.registry["point_maze_2"] = envs.registry["point_maze"]
    presets.registry["point_maze_2"] = presets.Preset(**GOOD)
    presets.load("point_maze_2")
    presets.registry["point_maze_2"] = presets.Preset(**GOOD | changes)
    with pytest.raises(UserError, match=f"preset of point_maze_2 = {said}|preset of point_maze_2 = .*{said}"):
        presets.load("point_maze_2")


@pytest.mark.parametrize("registry", [envs.registry, learners.registry, presets.registry, task_figures.registry])
@pytest.mark.parametrize("name", ["mine", 3])
def test_whichever_way_something_is_registered_it_is_checked(registry, name):
    before = dict(registry)
    for register in (
        lambda: registry.__setitem__(name, 3),
        lambda: registry.update({name: 3}),
        lambda: registry.setdefault(name, 3),
        lambda: registry.__ior__({name: 3}),
    ):
        with pytest.raises(UserError):
            register()
    for known, value in before.items():
        assert registry.setdefault(known) is value
    assert dict(registry) == before


def test_an_error_is_one_line_whatever_its_value_is():
    with pytest.raises(UserError) as refused:
        require(False, "env", {"a": np.zeros((3, 3)), "b": "two  spaces\n"}, "give one")
    assert "\n" not in str(refused.value) and "two  spaces\\n" in str(refused.value)
