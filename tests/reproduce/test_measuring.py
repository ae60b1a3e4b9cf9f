"""What is measured of a run after its training: once, of this very training, however a process ended in between."""

import shutil
import time

import numpy as np
import pytest
from killed_reproduction import config_of, reproduce, runs

from infogoal_jax.reproduce import completion, files, lanes, progress, work
from infogoal_jax.reproduce.finishing import Extras

FIRST, SECOND = runs(1)


def judge(training, run, config) -> Extras:
    """A number of the parameters of each seed, for the closeness of its codes."""
    place, which = training.batch.places[run]
    weight = np.asarray(training.states.params["weight"][place, which])
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

    return lambda: monkeypatch.setattr(lanes, "go_on", never)


@pytest.mark.parametrize("end", ["clock", "kill before the first", "kill after the first"])
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


def test_what_is_measured_later_costs_its_training_once(tmp_path, monkeypatch):
    """A run of a batch of two says of the program what the other one does, whoever measures it alone."""
    with monkeypatch.context() as patch:
        patch.setattr(work, "MEASURING", 1e9)
        reproduce(tmp_path, 1, judge, deadline=time.time() + 3600)
    reproduce(tmp_path, [SECOND], judge)
    first, second = (dict(files.read(files.path_of(tmp_path, run)).about["program"]) for run in (FIRST, SECOND))
    assert len(second.pop("spans")) == len(first.pop("spans")) + 1
    assert second == first and second["runs"] == sorted([FIRST.name, SECOND.name]) and second["lanes"] == 4


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


def test_what_is_measured_is_known_without_jax():
    assert completion.missing(FIRST, None, ()) == ["codes", "pictures"]
    assert completion.missing(FIRST, None, ("codes/closeness", "picture/code_mean")) == []
