"""Training of a batch and what is measured of it: goal sets side by side in one program, padding that nothing meets,
the numbers of each goal set alone; and each run is measured once, of this very training, however a process ended."""

import shutil
import time

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from killed_reproduction import config_of, go_on, reproduce, runs

from infogoal_jax.data import goal_images
from infogoal_jax.hyperparameters import values_of
from infogoal_jax.loading import make_train
from infogoal_jax.runner import sweep
from infogoal_paper import batches, files, measure, plan, progress, work
from infogoal_paper.finishing import Extras
from infogoal_paper.manifest import PRESET, Run, Setting

SEEDS = 0, 1


def smaller() -> object:
    """The hand-made rooms without their last corridor's outermost place, of which no goal is in view then."""
    env = hand_made.environment()
    kept = env.num_observations - 4
    node = jnp.where(env.next_node[:kept] < kept, env.next_node[:kept], jnp.arange(kept)[:, None])
    starts = jnp.where(env.starts < kept, env.starts, 0)
    return env.replace(
        next_node=node,
        images=env.images[:kept],
        in_view=env.in_view[:kept],
        achieved_goals=env.achieved_goals[:kept],
        position=env.position[:kept],
        distance=env.distance[:, :kept],
        starts=starts,
        source="a smaller one",
    )


def test_houses_of_different_sizes_with_a_memory_have_one_shape():
    envs = [hand_made.environment_from_above(memory=True), hand_made.environment_from_above(memory=True)]
    kept = {name: getattr(envs[1], name)[:-4] for name in OF_AN_IMAGE}
    envs[1] = envs[1].replace(**kept, distance=envs[1].distance[:, :-4])
    padded = plan.with_one_shape(envs)
    assert batches.shape_of(padded[0]) == batches.shape_of(padded[1]) != batches.shape_of(envs[1])


OF_AN_IMAGE = ("next_node", "images", "in_view", "achieved_goals", "position", "cell")


@pytest.fixture(scope="module")
def both():
    """Two goal sets of different sizes, padded to one shape."""
    return plan.with_one_shape([hand_made.environment(), smaller()])


def test_padded_goal_sets_have_one_shape(both):
    assert batches.shape_of(hand_made.environment()) != batches.shape_of(smaller())
    assert batches.shape_of(both[0]) == batches.shape_of(both[1])
    for name, value in vars(hand_made.environment()).items():
        if isinstance(value, jax.Array):
            np.testing.assert_array_equal(getattr(both[0], name), value)  # The larger one is as it was.


def test_what_is_added_is_never_met(both):
    """No move of the smaller house leads there, and no start lies there."""
    own, padded = smaller(), both[1]
    kept = own.num_observations
    assert (np.asarray(padded.next_node)[:kept] < kept).all() and not np.asarray(padded.in_view)[kept:].any()
    for row, count in zip(np.asarray(padded.starts), np.asarray(padded.num_starts), strict=True):
        assert (row[:count] < kept).all()
    assert (np.asarray(padded.achieved_goals)[kept:] == -1).all()


def batch_of(envs, values=(("discount", 0.9),)) -> batches.Batch:
    """Two seeds under two settings on each of these goal sets."""
    config = hand_made.config("infogoal", num_epochs=2, epochs_per_evaluation=1, updates_per_epoch=3)
    settings = Setting("preset", ()), Setting("other", values)
    runs = {
        (place, setting): Run("object_search", "infogoal", None, None, place, setting, SEEDS)
        for place in range(len(envs))
        for setting in settings
    }
    return batches.Batch(config, tuple(envs), tuple((setting, seed) for setting in settings for seed in SEEDS), runs)


@pytest.mark.parametrize(
    "order",
    [(0, 1), pytest.param((1, 0), marks=pytest.mark.long), pytest.param((1,), marks=pytest.mark.long)],
    ids=["preset first", "preset last", "alone"],
)
def test_the_floats_of_a_setting_are_its_own_whichever_comes_first(order, tmp_path):
    """The first setting of a batch may be another than the preset, where the preset's run is done already."""
    fixed = Setting("beta 0.1", (("learner.beta_start", 0.1), ("learner.beta_step", 0.0)))
    both = [Run("fetch_reach", "infogoal", None, None, 0, setting, SEEDS) for setting in (Setting(*PRESET), fixed)]
    (batch,) = batches.batches_of([both[place] for place in order], None, 64)
    floats = batches.floats_of(batch)
    for (setting, _), found in zip(batch.members, floats, strict=True):
        run = both[0] if setting.name == PRESET[0] else both[1]
        assert found == values_of(plan.config_of(run).hyper), setting.name
    assert len(floats) == len(order) * len(SEEDS)


@pytest.mark.parametrize(
    ("task", "most"),
    [
        ("fetch_reach", 64),
        *(pytest.param(*each, marks=pytest.mark.long) for each in (("fetch_reach", 3), ("fetch_push", 64))),
    ],
)
def test_goal_sets_are_side_by_side_as_far_as_the_members_go_but_for_push(task, most, tmp_path):
    """A GPU's compiler fails on some programs of several goal sets of Push."""
    (tmp_path / "1").mkdir()
    shutil.copy(goal_images.shipped(task), tmp_path / "1" / f"{task}.npz")
    both = [Run(task, "none", None, None, goal_set, Setting(*PRESET), SEEDS) for goal_set in (0, 1)]
    found = batches.batches_of(both, tmp_path, most)
    assert [len(batch.envs) for batch in found] == ([2] if (task, most) == ("fetch_reach", 64) else [1, 1])
    assert [run.goal_set for batch in found for run in batch.runs.values()] == [0, 1]


def trained(envs) -> batches.Training:
    """A batch after its first evaluation."""
    training = batches.begin(batch_of(envs))
    go_on(training)
    return training


@pytest.fixture(scope="module")
def together(both):
    """Both goal sets, two settings and two seeds in one program."""
    return trained(both)


@pytest.mark.long
def test_a_goal_set_learns_as_it_does_alone(both, together):
    for place, env in enumerate(both):
        alone = trained([env])
        for name, values in alone.history.items():
            np.testing.assert_allclose(together.history[name][0][place], values[0], atol=2e-3, err_msg=name)


@pytest.mark.long
def test_a_member_is_the_training_function_of_its_seed(both, together):
    train = make_train(together.batch.config, both[0])
    state = train.initial(jax.random.key(1), together.batch.config.hyper, both[0])
    state, _, metrics = jax.jit(train.chunk)(state, jnp.arange(1), together.batch.config.hyper, both[0])
    for name, value in metrics.items():
        np.testing.assert_allclose(together.history[name][0][0, 1], value, atol=2e-3, err_msg=name)


@pytest.mark.long
def test_the_share_of_the_learner_follows_its_weight(together):
    """No weight, no share; a large one, nearly all."""
    state, hyper = jax.tree.map(lambda leaf: leaf[0, 0], (together.states, together.hyper))
    share = jax.jit(measure.learner_share(together.train))
    env, shares = together.batch.envs[0], []
    for weight in (0.0, 0.1, 1.0, 1e4):
        shares.append(float(share(state, 0, hyper.replace(learner_weight=jnp.float32(weight)), env)))
    assert shares[0] < 1e-3 and shares == sorted(shares) and shares[-1] > 0.99


def test_a_learner_without_a_loss_has_no_share():
    assert measure.learner_share(make_train(hand_made.config("none"), hand_made.environment())) is None


def test_settings_are_cut_into_parts_that_fit():
    needed = (("a", SEEDS), ("b", SEEDS), ("c", (0,)))
    assert batches.parts_of(needed, 64) == [list(needed)]
    assert [[setting for setting, _ in part] for part in batches.parts_of(needed, 3)] == [["a"], ["b", "c"]]
    assert [[setting for setting, _ in part] for part in batches.parts_of(needed, 1)] == [["a"], ["b"], ["c"]]


FIRST, SECOND = runs(1)


def judge(training, run, config) -> Extras:
    """A number of the parameters of each seed, for the closeness of its codes."""
    weight = np.asarray(training.states.params["weight"][training.batch.index(run)])
    return Extras(arrays={"codes/closeness": weight.mean(1, keepdims=True)})


def closeness(folder, run) -> np.ndarray:
    """What was measured of a run."""
    return files.read(files.path_of(folder, run)).arrays["codes/closeness"]


def kept(folder) -> list:
    """The checkpoints that are left."""
    return list((folder / "unfinished").glob("*"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder whose runs are trained and measured in one go."""
    folder = tmp_path_factory.mktemp("whole")
    assert reproduce(folder, 1, judge).finished == [FIRST, SECOND]
    assert not kept(folder) and files.read(files.path_of(folder, FIRST)).about["measuring_failed"] == ""
    return folder


@pytest.fixture
def no_training(monkeypatch):
    """From the call of it on, nothing may be trained."""

    def never(training):
        raise AssertionError("trained again")

    return lambda: monkeypatch.setattr(sweep, "advance", never)


@pytest.mark.parametrize(
    "end",
    [
        pytest.param("clock", marks=pytest.mark.long),
        "kill before the first",
        pytest.param("kill after the first", marks=pytest.mark.long),
    ],
)
def test_what_was_not_measured_is_measured_at_the_next_start(end, whole, tmp_path, monkeypatch, no_training):
    measured = []

    def killed(training, run, config):
        if len(measured) == int(end == "kill after the first"):
            raise KeyboardInterrupt
        measured.append(run)
        return judge(training, run, config)

    if end == "clock":
        with monkeypatch.context() as patch:
            patch.setattr(work, "MEASURING", 1e9)
            assert reproduce(tmp_path, 1, judge, deadline=time.time() + 3600).stopped
    else:
        with pytest.raises(KeyboardInterrupt):
            reproduce(tmp_path, 1, killed)
    assert len(kept(tmp_path)) == 1
    assert all(files.path_of(tmp_path, run).exists() for run in (FIRST, SECOND)), "what is trained has its file"
    state = progress.sound_state_of(tmp_path, SECOND, config_of)
    assert (state.kind, state.words) == ("left", "is trained, and to be measured")
    no_training()
    again = []

    def counted(training, run, config):
        again.append(run)
        return judge(training, run, config)

    reproduce(tmp_path, 1, counted)
    assert again == ([SECOND] if end == "kill after the first" else [FIRST, SECOND]), "what was measured is kept"
    assert not kept(tmp_path)
    for run in (FIRST, SECOND):
        np.testing.assert_allclose(closeness(tmp_path, run), closeness(whole, run), atol=1e-5)
    assert not reproduce(tmp_path, 1, judge).finished


@pytest.mark.long
def test_a_measure_that_failed_waits_for_retry_with_its_checkpoint(tmp_path, no_training):
    def fails(training, run, config):
        raise ValueError("out of memory")

    outcome = reproduce(tmp_path, 1, fails)
    assert outcome.finished == [FIRST, SECOND] and not outcome.failed and len(kept(tmp_path)) == 1
    assert "out of memory" in files.read(files.path_of(tmp_path, FIRST)).about["measuring_failed"]
    no_training()
    assert not reproduce(tmp_path, 1, judge).finished
    reproduce(tmp_path, 1, judge, retry=True)
    assert np.isfinite(closeness(tmp_path, FIRST)).all() and not kept(tmp_path)


@pytest.mark.long
def test_an_unmeasured_run_without_a_checkpoint_is_trained_again_on_request(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(work, "MEASURING", 1e9)
        reproduce(tmp_path, 1, judge, deadline=time.time() + 3600)
    for path in kept(tmp_path):
        path.unlink()
    assert not reproduce(tmp_path, 1, judge).finished
    assert reproduce(tmp_path, 1, judge, retry=True).finished == [FIRST, SECOND]
    assert np.isfinite(closeness(tmp_path, SECOND)).all()


def test_a_run_goes_on_from_the_checkpoint_of_others_too(whole, tmp_path, evaluations):
    """A process that is asked for a part of the runs finds them in the checkpoint of all."""
    assert reproduce(tmp_path, 1, judge, deadline=time.time() + 3600).stopped
    assert reproduce(tmp_path, [SECOND], judge).finished == [SECOND] and len(kept(tmp_path)) == 1
    assert reproduce(tmp_path, [FIRST, SECOND], judge).finished == [FIRST]
    assert evaluations == [1, 2, 3, 4, 5, 6, 4, 5, 6] and not kept(tmp_path)
    for run in (FIRST, SECOND):
        np.testing.assert_allclose(closeness(tmp_path, run), closeness(whole, run), atol=1e-5)
        mine, other = (files.read(files.path_of(folder, run)).evaluations for folder in (tmp_path, whole))
        np.testing.assert_allclose(mine["test_goal/success_rate"], other["test_goal/success_rate"], atol=1e-5)


@pytest.mark.parametrize("end", ["trained to it", pytest.param("found at it when resumed", marks=pytest.mark.long)])
def test_what_is_measured_later_costs_its_training_once(end, tmp_path, monkeypatch, request):
    """A run of a batch of two says of the program what the other one does, whoever measures it alone."""
    if end == "found at it when resumed":
        request.getfixturevalue("evaluations")
        assert reproduce(tmp_path, 1, judge, deadline=time.time() + 3600).stopped
        monkeypatch.setattr(plan, "levelled", lambda curve: 3 if np.shape(curve)[1] >= 3 else None)
    with monkeypatch.context() as patch:
        patch.setattr(work, "MEASURING", 1e9)
        reproduce(tmp_path, 1, judge, deadline=time.time() + 3600)
    reproduce(tmp_path, [SECOND], judge)
    first, second = (dict(files.read(files.path_of(tmp_path, run)).about["program"]) for run in (FIRST, SECOND))
    assert len(second.pop("spans")) == len(first.pop("spans")) + 1
    assert second == first and second["runs"] == sorted([FIRST.name, SECOND.name]) and second["lanes"] == 4


@pytest.mark.long
def test_a_checkpoint_is_kept_for_a_run_whose_old_file_has_other_settings(whole, tmp_path, evaluations):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    for run in (FIRST, SECOND):
        result = files.read(files.path_of(tmp_path, run))
        result.about["config"]["batch_size"] += 1
        files.save(tmp_path, result)
    assert reproduce(tmp_path, 1, judge, deadline=time.time() + 3600).stopped
    assert reproduce(tmp_path, [FIRST], judge).finished == [FIRST] and len(kept(tmp_path)) == 1
    assert reproduce(tmp_path, [SECOND], judge).finished == [SECOND] and not kept(tmp_path)
    assert evaluations == [1, 2, 3, 4, 5, 6, 4, 5, 6]
