"""Every method goes through one program on a house, and methods of each kind on every kind of task: houses and poses
under DQN, image goals under HRAC, recorded flights under CQL. And every recorded (task, method) of the presets still
gives the numbers that it gave when the record was made: nothing is learned differently.

Programs take minutes to compile: they run among the long tests. The others trace them, of each kind of method on the
house and one under HRAC.

The record holds two short epochs of each. To see whether a change of the code leaves every bit as it was, on one
machine:

    PYTHONPATH=tests python tests/train/test_every_method.py record FILE [TASK ...]     # before the change
    PYTHONPATH=tests python tests/train/test_every_method.py compare FILE [TASK ...]    # after it

Recorded programs are compiled with `QUICKEST`, whatever XLA_FLAGS say: other options round differently, and where XLA
compiles a program in several pieces, a change in one place of it can move the rounding of another by a bit.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import re
import sys
from pathlib import Path

import hand_made
import hand_made_frames
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import FIXTURES

from infogoal_jax import envs, make_train, presets
from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.envs.fetch.tasks import TASKS as FETCH_TASKS
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.report import export
from infogoal_jax.report.methods import against
from infogoal_jax.runner.compilation import QUICKEST, known

TASKS = {
    "object_search": (hand_made.config, hand_made.environment),
    "fetch_reach": (hand_made_points.config, hand_made_points.steered),
    "object_manipulation": (hand_made_frames.manipulation_config, hand_made_frames.manipulation),
    "embodied_qa": (hand_made_frames.qa_config, hand_made_frames.qa),
}
ELSEWHERE = ("infogoal", "infobot", "cher")
"""Methods that are run on the other tasks too: pairs, codes that depend on states, and candidates that are compared.
The record compares what every method comes to on the real tasks."""
SHORT = {"num_epochs": 2, "epochs_per_evaluation": 1, "updates_per_epoch": 3, "evaluation_starts": 1}


@functools.cache
def working(tasks=tuple(TASKS)) -> list[tuple[str, str]]:
    """Pairs of one of these tasks and a method that go together."""
    return [(task, method) for task in tasks for method in presets.METHODS if not against(task, method)]


def train_of(task: str, method: str):
    """Training of this method on the small counterpart of this task."""
    make_config, make_environment = TASKS[task]
    preset = presets.load(task, method)
    changes = {name: getattr(preset, name) for name in ("relabelling", "explorer")}
    config = make_config(presets.METHODS[method].learner, **SHORT, **changes)
    fields = ("head", "critic", "bounded", "layer_norm", *(field.name for field in dataclasses.fields(OfAllGoals)))
    names = [name for name in fields if hasattr(preset.agent, name) and hasattr(config.agent, name)]
    head = {name: getattr(preset.agent, name) for name in names}
    return make_train(dataclasses.replace(config, agent=dataclasses.replace(config.agent, **head)), make_environment())


def swept(train, keys, env):
    """Two seeds in one program."""
    return jax.vmap(lambda key: train(key, None, env))(keys)


def test_every_method_of_the_paper_has_a_task():
    """All on the searched house, explorers included; what is refused elsewhere is the explorer, and values by the
    numbers of goals where actions are continuous."""
    assert {method for task, method in working() if task == "object_search"} == set(presets.METHODS)
    assert {method for task in TASKS for method in presets.METHODS if (task, method) not in working()} == {
        "sse_db",
        "leo",
    }


@pytest.mark.parametrize(
    ("task", "method"),
    [
        pytest.param(task, method, marks=[] if (task, method) == ("object_search", "dgrl") else pytest.mark.long)
        for task, method in working()
    ],
)
def test_the_policy_of_every_method_is_exported(task, method, tmp_path):
    """Which holds what it writes to what JAX gives."""
    train = train_of(task, method)
    exported = export.export_params(train, hand_made_points.random_params(train), tmp_path / "policy.npz", {})
    assert exported.about["task"] == task


@contextlib.contextmanager
def nothing_promoted():
    """Nothing that NumPy does without being asked, which a user may have forbidden to code of his own: what can be
    traced here has the same types everywhere."""
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


@functools.lru_cache(maxsize=8)
def program(task: str, method: str, in_64_bits: bool = False) -> jax.stages.Traced:
    """An epoch and the evaluation after it. Those that are asked for again soon are kept: they are large."""
    with jax.enable_x64(True) if in_64_bits else nothing_promoted():
        train = train_of(task, method)

        def chunk(key, env):
            numbers = jnp.arange(1, dtype=jnp.int32)
            return train.chunk(train.initial(key, train.config.hyper, env), numbers, train.config.hyper, env)

        return jax.jit(chunk).trace(jax.random.key(0), train.env)


@functools.cache
def traced(task: str, method: str, in_64_bits: bool = False):
    """Shapes and types of the state, of the epoch and of the evaluation."""
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), program(task, method, in_64_bits).out_info)


TRACED = [*(("object_search", method) for method in presets.METHODS), ("fetch_reach", "infogoal")]
OF_EACH_KIND = ("infogoal", "gcb", "cher", "sse_db", "leo")
"""Pairs, codes that depend on states, candidates that are compared, an explorer, all goals at once."""
IN_64_BITS = [("object_search", "infogoal")]


@pytest.mark.parametrize(
    ("task", "method"),
    [pytest.param(*pair, marks=[] if pair[1] in OF_EACH_KIND else [pytest.mark.long]) for pair in TRACED],
)
def test_goes_through_an_epoch_and_an_evaluation(task, method):
    """Traced, not run: shapes agree from the first draw to the evaluation after an epoch, and the method's own loss has
    its metrics. Seeds are beside each other where the programs run, among the long tests."""
    state, epochs, metrics = program(task, method).out_info
    assert metrics["test_goal/success_rate"].shape == () and epochs["agent/loss"].shape == (1,)
    assert state.params["agent"].keys() == state.target_params["agent"].keys()
    learner = presets.METHODS[method].learner
    assert any(name.startswith(f"{learner}/") for name in epochs) == (learner not in ("none", "rad", "leo"))


@pytest.mark.parametrize(
    ("task", "method"),
    [pytest.param(*pair, marks=[] if pair in IN_64_BITS else [pytest.mark.long]) for pair in working()],
)
def test_every_program_is_the_same_with_64_bits(task, method):
    """Traced: what is carried from epoch to epoch and what comes out has the types that it has without."""
    assert traced(task, method, in_64_bits=True) == traced(task, method)


SCATTER = re.compile(r'"stablehlo\.scatter"\(.*?unique_indices = (\w+).*?\(\{\n(.*?)\n *\}\)', re.S)
LOOK_UP = ("infogoal", "gcb", "cher", pytest.param("dgrl", marks=pytest.mark.long))
"""Methods that look up codes, partners, candidates and vectors of a codebook."""


@pytest.mark.parametrize("method", LOOK_UP)
def test_no_order_of_threads_changes_a_sum_of_floats_on_a_gpu(method):
    """Its scatters add floats to places that differ alone: the same key gives the same bits."""
    text = program("object_search", method).lower(lowering_platforms=("cuda",)).as_text()
    additions = [unique for unique, body in SCATTER.findall(text) if re.search(r"stablehlo\.add.*tensor<f32>", body)]
    assert additions and set(additions) == {"true"}  # Those of the values of the actions that were taken.


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "method"), [pair for pair in working() if pair[0] == "object_search" or pair[1] in ELSEWHERE]
)
def test_trains_without_a_number_that_is_not_finite(task, method):
    """Two epochs of two seeds, which differ."""
    train = train_of(task, method)
    sweep = jax.jit(lambda keys, env: swept(train, keys, env), compiler_options=known(QUICKEST))
    result = sweep(jax.random.split(jax.random.key(0), 2), train.env)
    for leaf in jax.tree.leaves((result.metrics, result.epochs, result.params)):
        assert np.isfinite(leaf).all()
    assert not np.array_equal(*result.epochs["agent/loss"])


@pytest.mark.long
@pytest.mark.parametrize("task", FETCH_TASKS)
def test_the_physics_is_the_same_whatever_jax_is_set_to(task):
    """Traced: the state after a step has the types of the one before it, with 64 bits and where nothing is
    promoted."""

    def stepped(key):
        env = envs.load(task, FetchConfig(goals="positions"))
        before = env.reset(key)
        after = env.step(before, jnp.zeros(4, jnp.float32))
        return before, after, env.observe(after), env.reached(env.achieved(after), after.desired_goal)

    with nothing_promoted():
        plain = jax.eval_shape(stepped, jax.random.key(0))
    with jax.enable_x64(True):
        assert jax.eval_shape(stepped, jax.random.key(0)) == plain
    assert jax.tree.map(lambda leaf: leaf.dtype, plain[0]) == jax.tree.map(lambda leaf: leaf.dtype, plain[1])


RECORD = FIXTURES / "same_numbers.json"
SMALL = {"num_epochs": 2, "epochs_per_evaluation": 2, "updates_per_epoch": 3, "batch_size": 16, "evaluation_starts": 1}
KEPT = ("epochs/agent/loss", "epochs/agent/gradient_norm", "test_goal/success_rate")
COLLECTED = {"num_envs": 4, "rollout_steps": 25}
TOUCHED = COLLECTED | {"rollout_steps": 5}
"""What is collected in an epoch, and where a robot touches things: contacts make much of a rounding, step by step. With
other options of the compiler, in place of other machines, PickAndPlace's first epoch of 25 steps differed by 40 %, that
of 10 by 0.3 %, that of 5 by 0.07 % at most."""
TOUCHING = ("fetch_push", "fetch_pick_and_place")
"""Tasks in which a robot touches things."""
EXPENSIVE, THEIR_METHODS = ("object_manipulation", *TOUCHING), ("infogoal", "her")
"""Tasks that take half a minute each and have the agent and the learners of FetchReach, and whose numbers are tested on
them; `compare` has all."""


def small_config(task: str, method: str):
    """The preset with two epochs of a few updates."""
    collected = {} if task == "embodied_qa" else TOUCHED if task in TOUCHING else COLLECTED
    config = presets.load(task, method, **SMALL | collected)
    return with_values(config, {"learner.num_pairs": 16}) if hasattr(config.learner, "num_pairs") else config


def numbers(task: str, method: str) -> dict[str, list[float]]:
    """The metrics of both epochs and of the evaluation."""
    train = make_train(small_config(task, method))
    result = jax.jit(train, compiler_options=known(QUICKEST))(jax.random.key(0), None, train.env)
    values = {f"epochs/{name}": value for name, value in result.epochs.items()} | result.metrics
    return {
        name: np.ravel(np.asarray(value, np.float64)).tolist()
        for name, value in sorted(values.items())
        if np.ndim(value) <= 1
    }


def summary(found: dict[str, list[float]]) -> dict:
    """What is kept of the metrics: a few of them, and a digest of the bits of all."""
    digest = hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()[:16]
    return {name.removeprefix("epochs/"): found[name] for name in KEPT} | {"digest": digest}


def difference(found: dict, recorded: dict) -> float:
    """The largest relative difference of what is kept, in the first epoch."""
    names = [metric.removeprefix("epochs/") for metric in KEPT if metric.startswith("epochs/")]
    pairs = [(found[name][0], recorded[name][0]) for name in names]
    return max(abs(new - old) / max(abs(old), 1e-12) for new, old in pairs)


def compared() -> list[str]:
    """What the test compares."""
    names = [name.split("/") for name in json.loads(RECORD.read_text())]
    return [f"{task}/{method}" for task, method in names if task not in EXPENSIVE or method in THEIR_METHODS]


@pytest.mark.long
@pytest.mark.parametrize("name", compared())
def test_nothing_is_learned_differently(name):
    """To what rounding on another machine leaves of the first epoch; `compare` is exact, on the machine that recorded.

    In the second epoch a bit can have become another action, or another goal of CHER's: 3 % of the loss between two
    machines on which the first epoch differs by a ten millionth.
    """
    task, method = name.split("/")
    expected, found = json.loads(RECORD.read_text())[name], summary(numbers(task, method))
    for metric in (metric.removeprefix("epochs/") for metric in KEPT if metric.startswith("epochs/")):
        rtol = 5e-3 if task in TOUCHING else 1e-3
        np.testing.assert_allclose(found[metric][:1], expected[metric][:1], rtol=rtol, atol=1e-5, err_msg=metric)


def main():
    """Record, or compare bit by bit."""
    command, path, *only = sys.argv[1], Path(sys.argv[2]), *sys.argv[3:]
    record = json.loads(path.read_text()) if path.exists() else {}
    for task, method in working(tuple(presets.TASKS)):
        name = f"{task}/{method}"
        if only and task not in only:
            continue
        found = numbers(task, method)
        if command == "record":
            record[name] = summary(found)
            lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(kept)}" for name, kept in record.items())
            path.write_text(f"{{\n{lines}\n}}\n")
            print(name, flush=True)
        else:
            now, before = summary(found), record[name]
            same = all(now[metric] == value for metric, value in before.items())
            print(name, "equal" if same else f"DIFFERENT, by {difference(now, before):.1e}", flush=True)
        jax.clear_caches()


if __name__ == "__main__":
    main()
