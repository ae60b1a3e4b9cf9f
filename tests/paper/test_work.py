"""The work on a folder: nothing that is finished is lost or repeated, and no two processes train the same run."""

import dataclasses
import json
import random
import shutil
import time

import killed_reproduction
import numpy as np
import pytest
from killed_reproduction import SEEDS, log_of, reproduce, runs

from infogoal_jax.errors import UserError
from infogoal_jax.runner import sweep
from infogoal_jax.runs.folder import locked
from infogoal_paper import batches, checkpoints, files, plan, progress
from infogoal_paper.finishing import Extras

LONGEST = 600
"""Seconds for a process on a busy machine."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder whose runs are finished, in this process."""
    folder = tmp_path_factory.mktemp("whole")
    outcome = reproduce(folder, 2)
    assert outcome.finished == runs(2) and not outcome.failed and not outcome.stopped
    return folder


def are_same(folder, whole, run, count: int) -> None:
    """A run has the numbers of the first evaluations of the one that was left alone."""
    mine, other = (files.read(files.path_of(each, run)).evaluations for each in (folder, whole))
    for name, value in mine.items():
        np.testing.assert_allclose(value, other[name][:, :count], atol=1e-5)


def out_of_luck(training):
    raise ValueError("out of luck")


def test_a_run_keeps_its_numbers(whole):
    first, second = (files.read(files.path_of(whole, run)) for run in runs(1))
    curve = first.evaluations["train_goal/success_rate"]
    assert curve.shape == (len(SEEDS), 6) and first.arrays["first_reached"].shape[:2] == (len(SEEDS), 6)
    assert first.about["program"]["lanes"] == 4 and first.about["learner_share"] is None
    assert not np.array_equal(curve, second.evaluations["train_goal/success_rate"])  # The settings have other floats.


def test_a_member_learns_as_it_does_alone(whole, tmp_path):
    """Members of one program do not touch each other."""
    with killed_reproduction.small_programs(tmp_path):
        (batch,) = batches.batches_of(runs(1)[1:], None, 64)
        training = batches.begin(batch)
        for _ in range(6):
            killed_reproduction.go_on(training)
    alone = np.stack([each for each in training.history["train_goal/success_rate"]], 1)
    together = files.read(files.path_of(whole, runs(1)[1])).evaluations["train_goal/success_rate"]
    np.testing.assert_allclose(alone, together, atol=1e-5)


def test_what_is_done_is_not_done_again(whole):
    begun = log_of(whole, "begun")
    assert not reproduce(whole, 2).finished and log_of(whole, "begun") == begun


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param("cut short", marks=pytest.mark.long),
        "one byte",
        pytest.param("another run", marks=pytest.mark.long),
    ],
)
def test_a_damaged_run_is_made_again(whole, tmp_path, damage):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    path, other = (files.path_of(tmp_path, run) for run in runs(1))
    sound = path.read_bytes()
    if damage == "cut short":
        path.write_bytes(sound[: len(sound) // 2])
    elif damage == "one byte":
        changed = bytearray(sound)
        changed[len(changed) // 3] ^= 0xFF
        path.write_bytes(bytes(changed))
    else:
        path.write_bytes(other.read_bytes())
    said = []
    assert reproduce(tmp_path, 1, say=said.append).finished == runs(1)[:1]
    assert any("is made again" in words for words in said)
    assert files.read(path).run == runs(1)[0]


def test_a_run_of_other_settings_is_made_again(whole, tmp_path):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    result = files.read(files.path_of(tmp_path, runs(1)[0]))
    result.about["config"]["batch_size"] += 1
    files.save(tmp_path, result)
    assert reproduce(tmp_path, 1).finished == runs(1)[:1]


def test_what_fails_is_shown_and_waits_for_retry(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(sweep, "advance", out_of_luck)
        outcome = reproduce(tmp_path, 2)
    assert outcome.failed == runs(2) and not outcome.finished
    state = progress.state_of(tmp_path, runs(1)[0])
    assert state.kind == "failed" and "out of luck" in state.words
    assert "out of luck" in (tmp_path / progress.PAGE).read_text()
    failure = json.loads(files.path_of(tmp_path, runs(1)[0], "failed.json").read_text())
    assert "raise ValueError" in failure["trace"]
    assert not reproduce(tmp_path, 2).finished
    assert reproduce(tmp_path, 1, retry=True).finished == runs(1)
    assert progress.state_of(tmp_path, runs(1)[0]).kind == "done"


def test_what_fails_again_is_begun_once_a_retry(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep, "advance", out_of_luck)
    assert reproduce(tmp_path, 1).failed == runs(1)
    assert reproduce(tmp_path, 1, retry=True).failed == runs(1)
    assert sorted(log_of(tmp_path, "begun")) == sorted(run.name for run in runs(1) * 2)


def test_a_remake_that_fails_over_a_damaged_file_has_failed(whole, tmp_path, monkeypatch):
    """It is no finished run, and waits for retry as others do."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    run, path = runs(1)[0], files.path_of(tmp_path, runs(1)[0])
    path.write_bytes(path.read_bytes()[:100])

    assert progress.sound_state_of(tmp_path, run, killed_reproduction.config_of).kind == "left"
    with monkeypatch.context() as patch:
        patch.setattr(sweep, "advance", out_of_luck)
        assert reproduce(tmp_path, 1).failed == [run]
    sound = progress.sound_state_of(tmp_path, run, killed_reproduction.config_of)
    for state in (progress.state_of(tmp_path, run), sound):
        assert state.kind == "failed" and "out of luck" in state.words
    assert not reproduce(tmp_path, 1).finished
    assert reproduce(tmp_path, 1, retry=True).finished == [run]
    assert progress.state_of(tmp_path, run).kind == "done"


def test_a_run_that_was_stopped_at_a_lower_ceiling_is_made_again(whole, tmp_path):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    result = files.read(files.path_of(tmp_path, runs(1)[0]))
    short = {name: value[:, :5] for name, value in result.evaluations.items()}
    short["train_goal/success_rate"] = np.linspace(0, 1, 5) * np.ones((len(SEEDS), 1))
    files.save(tmp_path, dataclasses.replace(result, evaluations=short))
    assert reproduce(tmp_path, 1).finished == runs(1)[:1]


def test_the_lock_that_a_killed_process_left_beside_a_finished_run_goes(whole, tmp_path):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    lock = files.path_of(tmp_path, runs(1)[0], "lock")
    lock.touch()
    assert reproduce(tmp_path, 1).finished == [] and not lock.exists()


@pytest.mark.long
def test_a_run_that_another_process_trains_is_left_to_it(tmp_path):
    path = files.path_of(tmp_path, runs(1)[0], "lock")
    path.parent.mkdir(parents=True)
    with locked(path, path.parent):
        assert progress.state_of(tmp_path, runs(1)[0]).kind == "running"
        assert reproduce(tmp_path, 1).finished == runs(1)[1:]
    assert reproduce(tmp_path, 1).finished == runs(1)[:1]


@pytest.mark.parametrize("end", [pytest.param("clock", marks=pytest.mark.long), "killed"])
def test_it_goes_on_from_the_checkpoint(end, whole, tmp_path, evaluations, monkeypatch):
    """The same numbers as those of a run that was left alone, and no evaluation twice."""
    advance = sweep.advance

    def killed(members):
        if members.evaluations == 3:
            raise KeyboardInterrupt
        advance(members)

    if end == "killed":
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(sweep, "advance", killed)
            reproduce(tmp_path, 1, keeping=0.0)
    else:
        assert reproduce(tmp_path, 1, deadline=time.time() + 3600).stopped
    assert not log_of(tmp_path, "finished") and len(list((tmp_path / "unfinished").iterdir())) == 1
    assert reproduce(tmp_path, 1).finished == runs(1) and evaluations == [1, 2, 3, 4, 5, 6]
    assert not list((tmp_path / "unfinished").iterdir())
    for run in runs(1):
        are_same(tmp_path, whole, run, 6)


def test_training_goes_on_where_no_checkpoint_can_be_written(tmp_path, monkeypatch):
    def refused(path, training):
        raise UserError("the disk is full")

    said = []
    monkeypatch.setattr(checkpoints, "save", refused)
    assert reproduce(tmp_path, 1, keeping=0.0, say=said.append).finished == runs(1)
    assert any("the disk is full" in words for words in said)


FIRST, SECOND = runs(1)


@pytest.fixture
def first_levels_early(whole, monkeypatch):
    """From now on the first run levels off at its third evaluation, the second one never."""
    own = files.read(files.path_of(whole, FIRST)).evaluations["train_goal/success_rate"][:, :3]

    def levelled(curve):
        return 3 if np.shape(curve)[1] >= 3 and np.allclose(np.asarray(curve)[:, :3], own, atol=1e-5) else None

    monkeypatch.setattr(plan, "levelled", levelled)


@pytest.mark.parametrize(
    ("seconds", "sizes"),
    [(0.0, [4, 4, 4, 2, 2, 2]), pytest.param(1e9, [4] * 6, marks=pytest.mark.long)],
    ids=["leaves", "stays"],
)
def test_a_run_that_has_levelled_off_is_written_at_once(
    seconds, sizes, whole, first_levels_early, tmp_path, monkeypatch
):
    """It leaves the batch where compiling that anew takes no longer than it costs. The other one never notices."""
    prepare, advance, found, measured = sweep.prepare, sweep.advance, [], []

    def prepared(members):
        prepare(members)
        members.prepare_seconds = seconds

    def noted(members):
        found.append(len(members.states.state.env_steps))
        advance(members)

    def judge(training, run, config):
        measured.append((run, training.evaluations, files.path_of(tmp_path, SECOND).exists()))
        return Extras(arrays={"codes/closeness": np.zeros((len(SEEDS), 1))})

    monkeypatch.setattr(sweep, "prepare", prepared)
    monkeypatch.setattr(sweep, "advance", noted)
    assert reproduce(tmp_path, 1, judge).finished == [FIRST, SECOND]
    assert found == sizes and measured == [(FIRST, 3, False), (SECOND, 6, True)]
    assert not list((tmp_path / "unfinished").iterdir())
    for run, count in ((FIRST, 3), (SECOND, 6)):
        are_same(tmp_path, whole, run, count)
        program = files.read(files.path_of(tmp_path, run)).about["program"]
        assert program["runs"] == [run.name] and program["lanes"] == len(SEEDS)


def test_what_goes_on_without_a_levelled_run_is_stopped_and_goes_on(whole, first_levels_early, tmp_path, evaluations):
    assert reproduce(tmp_path, 1, deadline=time.time() + 3600).finished == [FIRST]
    assert reproduce(tmp_path, 1).finished == [SECOND] and evaluations == [1, 2, 3, 4, 5, 6]
    assert not list((tmp_path / "unfinished").iterdir())
    are_same(tmp_path, whole, SECOND, 6)


def test_the_page_counts_and_tells_the_time_to_go(whole):
    assert progress.summary(whole, runs(2)).startswith("4 runs: 4 done, 0 running, 0 failed, 0 left; time to go: 0 min")
    more = progress.summary(whole, runs(3))
    assert "4 done, 0 running, 0 failed, 2 left" in more and "not known" not in more
    assert runs(2)[0].name in (whole / progress.PAGE).read_text()


def repeated(folder) -> list[str]:
    """Runs that were begun again after they were finished."""
    done, again = set(), []
    for line in (folder / killed_reproduction.LOG).read_text().splitlines():
        what, name, _ = line.split()
        again += [name] if what == "begun" and name in done else []
        done |= {name} if what == "finished" else set()
    return again


@pytest.mark.long
def test_killed_at_any_point_it_loses_and_repeats_nothing(tmp_path):
    """Processes that are killed at 20 random moments, then one that is left alone."""
    moments, kills = random.Random(0), 0
    while kills < 20:
        folder = tmp_path / str(kills)
        process = killed_reproduction.start(folder)
        time.sleep(moments.uniform(0.5, 12))
        while process.is_alive() and kills < 20:
            process.kill()
            process.join()
            kills += 1
            finished = [run for run in runs() if files.path_of(folder, run).exists()]
            for run in finished:
                files.read(files.path_of(folder, run))
            process = killed_reproduction.start(folder)
            time.sleep(moments.uniform(0.5, 12))
        process.join(LONGEST)
        assert process.exitcode == 0
        assert repeated(folder) == [], "a finished run was repeated"
        assert all(files.path_of(folder, run).exists() for run in runs())
        assert not list(folder.rglob("*.lock")) and not list(folder.rglob(".*.partial"))
        assert not list((folder / "unfinished").iterdir())
        kills += 1


@pytest.mark.long
def test_two_processes_share_the_work(tmp_path):
    both = [killed_reproduction.start(tmp_path), killed_reproduction.start(tmp_path)]
    for process in both:
        process.join(LONGEST)
        assert process.exitcode == 0
    assert sorted(log_of(tmp_path, "begun")) == sorted(run.name for run in runs())
    assert sorted(log_of(tmp_path, "finished")) == sorted(run.name for run in runs())
    lines = [line.split() for line in (tmp_path / killed_reproduction.LOG).read_text().splitlines()]
    for number in range(3):  # No program is compiled by both.
        assert len({process for _, name, process in lines if f"set_{number}" in name}) == 1


def test_what_killed_processes_left_is_deleted(tmp_path, monkeypatch):
    """One was killed between the file of its last run and the deletion of its checkpoint, others within a write."""
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "delete_measured", lambda folder, runs: None)
        reproduce(tmp_path, 2, keeping=0.0)
    one, other = checkpoints.kept(tmp_path)
    files.path_of(tmp_path, runs(2)[-1]).unlink()
    left = tmp_path / checkpoints.UNFINISHED
    partial = [folder / ".abc.1.partial" for folder in (left, files.path_of(tmp_path, runs(1)[0]).parent)]
    for path in partial:
        path.write_bytes(b"the first half")
    reproduce(tmp_path, 1)
    (kept,) = left.iterdir()
    assert not any(path.exists() for path in partial)
    assert kept in (one, other) and runs(2)[-1].name in checkpoints.kept(tmp_path)[kept]
