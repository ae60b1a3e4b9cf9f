"""Every method goes through one program on a house, and methods of each kind on every kind of task: houses and poses
under DQN, image goals under HRAC, recorded flights under CQL.

Programs take minutes to compile: they run among the long tests.
"""

import dataclasses

import hand_made
import hand_made_frames
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import make_train, presets
from infogoal_jax.train.combinations import reasons_against

TASKS = {
    "object_search": (hand_made.config, hand_made.environment),
    "fetch_reach": (hand_made_points.config, hand_made_points.steered),
    "object_manipulation": (hand_made_frames.manipulation_config, hand_made_frames.manipulation),
    "embodied_qa": (hand_made_frames.qa_config, hand_made_frames.qa),
}
ELSEWHERE = ("infogoal", "infobot", "cher")
"""Methods that are run on the other tasks too: pairs, codes that depend on states, and candidates that are compared.
test_same_numbers.py compares what every method comes to on the real tasks."""
COMPILE_QUICKLY = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
SHORT = {"num_epochs": 2, "epochs_per_evaluation": 1, "updates_per_epoch": 3, "evaluation_starts": 1}


def working() -> list[tuple[str, str]]:
    """Pairs of a task and a method that go together."""
    return [
        (task, method)
        for task in TASKS
        for method in presets.METHODS
        if not reasons_against(presets.load(task, method))
    ]


def train_of(task: str, method: str):
    """Training of this method on the small counterpart of this task."""
    make_config, make_environment = TASKS[task]
    preset = presets.load(task, method)
    changes = {name: getattr(preset, name) for name in ("relabelling", "explorer")}
    learner = presets.METHODS[method].learner
    # LEO's learner is no method of its own.
    config = make_config(method if method == "leo" else learner, **SHORT, **changes)
    names = [
        name for name in ("head", "critic", "bounded") if hasattr(preset.agent, name) and hasattr(config.agent, name)
    ]
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


@pytest.mark.parametrize("method", presets.METHODS)
def test_goes_through_an_epoch_and_an_evaluation(method):
    """Traced, not run: shapes agree from the first draw to the evaluation after an epoch, and the method's own loss has
    its metrics. Seeds are beside each other where the programs run, among the long tests."""
    train = train_of("object_search", method)

    def chunk(key, env):
        return train.chunk(train.initial(key, train.config.hyper, env), jnp.arange(1), train.config.hyper, env)

    state, epochs, metrics = jax.eval_shape(chunk, jax.random.key(0), train.env)
    assert metrics["test_goal/success_rate"].shape == () and epochs["agent/loss"].shape == (1,)
    assert state.params["agent"].keys() == state.target_params["agent"].keys()
    learner = presets.METHODS[method].learner
    assert any(name.startswith(f"{learner}/") for name in epochs) == (learner not in ("none", "rad", "index"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "method"), [pair for pair in working() if pair[0] == "object_search" or pair[1] in ELSEWHERE]
)
def test_trains_without_a_number_that_is_not_finite(task, method):
    """Two epochs of two seeds, which differ."""
    train = train_of(task, method)
    sweep = jax.jit(lambda keys, env: swept(train, keys, env), compiler_options=COMPILE_QUICKLY)
    result = sweep(jax.random.split(jax.random.key(0), 2), train.env)
    for leaf in jax.tree.leaves((result.metrics, result.epochs, result.params)):
        assert np.isfinite(leaf).all()
    assert not np.array_equal(*result.epochs["agent/loss"])
