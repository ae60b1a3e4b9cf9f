"""The folder of a run has one writer at a time, holds nobody else's files, and keeps nothing of processes that were
killed.

Runs, searches and finals that are killed or stopped while they start, compile, train, write or draw, at random, end
with the same bits as those that were left alone. Their program is a small one (`killed_run.small_train`), so that
hundreds of processes start, compile and are killed in minutes; test_resume.py kills the real one.
"""

import dataclasses
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import hand_made
import killed_run
import pytest

from infogoal_jax import load_run
from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.report import runs
from infogoal_jax.runner.training import describe
from infogoal_jax.runs import checkpoint, configuration, disk, folder
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.folder import RUN, SEARCH, check_new, newest_run, only_writer
from infogoal_jax.runs.tables import read_table


def contents(path: Path) -> dict[str, bytes]:
    """Every file below a folder and what it holds."""
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_a_second_writer_is_refused_and_the_first_one_s_lock_goes_with_it(tmp_path):
    by_us = f"being written by another process .process {os.getpid()} on "
    with only_writer(tmp_path / "run"), pytest.raises(UserError, match=by_us), only_writer(tmp_path / "run"):
        pass
    assert contents(tmp_path) == {}
    with only_writer(tmp_path / "run"):
        pass


HOLDING = """
import sys, time
from pathlib import Path
from infogoal_jax.runs.folder import only_writer
with only_writer(Path(sys.argv[1])):
    (Path(sys.argv[1]) / "ready").touch()
    time.sleep(600)
"""


def test_a_killed_process_leaves_no_lock_and_no_half_written_file(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", HOLDING, str(tmp_path)])
    while not (tmp_path / "ready").exists():
        assert process.poll() is None
        time.sleep(0.02)
    with pytest.raises(UserError, match="being written by another process"), only_writer(tmp_path):
        pass
    process.send_signal(signal.SIGKILL)
    process.wait()
    (tmp_path / "figures").mkdir()
    for path in (tmp_path / ".checkpoint.1234.partial", tmp_path / "figures" / ".curve.png.77.partial"):
        path.write_bytes(bytes(1000))  # As a killed process leaves it: nobody has its lock.
    with only_writer(tmp_path):
        pass
    assert contents(tmp_path) == {"ready": b""}


def test_what_is_still_being_written_stays(tmp_path):
    """A report may draw while the run goes on."""

    def write(file):
        folder.remove_abandoned(tmp_path)
        file.write(b"whole")

    disk.write_atomically(tmp_path / "checkpoint", write)
    assert contents(tmp_path) == {"checkpoint": b"whole"}


def test_a_file_system_without_locks_is_said_and_used(tmp_path, monkeypatch, capsys):
    def no_locks(file):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(folder, "try_lock", no_locks)
    with only_writer(tmp_path):
        pass
    assert "without locks" in capsys.readouterr().err


@pytest.mark.parametrize("names", [RUN, SEARCH])
def test_a_new_run_starts_where_none_of_its_files_is(names, tmp_path):
    check_new(tmp_path, names)
    (tmp_path / "notes.txt").write_text("somebody's own")
    check_new(tmp_path, names)
    for name in names:
        (tmp_path / name).write_text("somebody's own")
        with pytest.raises(UserError, match=f"out = .*holds .*{name}.*give another folder"):
            check_new(tmp_path, names)
        (tmp_path / name).unlink()
    with pytest.raises(UserError, match="could not be written"):
        check_new(tmp_path / ("x" * 300), names)


@pytest.mark.parametrize(
    "command",
    ["train object_search --seeds 1", "tune object_search --trials 2 --fields discount", "pretrain fetch_reach"],
)
def test_files_of_others_stay_as_they_are(command, tmp_path, capsys, monkeypatch):
    """In a folder with the files of a search, of a run or of a person: refused, and every byte is as before."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", os.environ["XDG_CACHE_HOME"])
    for name in ("config.json", "epochs.csv", "evaluations.csv", "evaluations.jsonl", "timing.json"):
        (tmp_path / name).write_text(f"my own {name}")
    before = contents(tmp_path)
    assert main([*command.split(), "--out", "."]) == 2
    assert "out = '.': holds" in capsys.readouterr().err and contents(tmp_path) == before


def test_the_newest_run_of_a_configuration_is_found(tmp_path):
    """Whatever number of epochs it was to have; other configurations, other seeds and damaged folders are passed
    over."""
    config = hand_made.config()

    def leave(name: str, seconds: int, config=config, seeds=(0, 1)) -> Path:
        (tmp_path / name).mkdir()
        configuration.write(tmp_path / name, Description(config, list(seeds), "rooms", {}, "cpu"))
        os.utime(tmp_path / name / "config.json", (seconds, seconds))
        return tmp_path / name

    assert newest_run(tmp_path, config, [0, 1]) is None
    leave("old", 1000)
    new = leave("new", 2000, config=hand_made.config(num_epochs=40))
    leave("other", 3000, config=hand_made.config(batch_size=64))
    leave("seeds", 4000, seeds=(2, 3))
    (leave("damaged", 5000) / "config.json").write_text("{")
    assert newest_run(tmp_path, config, range(2)) == new


def test_a_run_is_known_by_its_data_wherever_they_lie(tmp_path, monkeypatch):
    """Named as they are seen from the folder that the run was started in, and found from any other; moved, they are
    the same data, as others in the same place are not."""
    for name in ("started/photographs", "run"):
        (tmp_path / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "started")
    environment = hand_made.environment()
    config = hand_made.config(env=dataclasses.replace(hand_made.config().env, dataset="photographs"))
    configuration.write(tmp_path / "run", started := describe(config, environment, [0]))
    monkeypatch.chdir(tmp_path)
    about = configuration.read(tmp_path / "run")
    assert about.config.env.dataset == str(tmp_path / "started" / "photographs")
    assert newest_run(tmp_path, about.config, [0]) == tmp_path / "run"

    def of(dataset: str, data: str = started.data) -> Description:
        moved = dataclasses.replace(config, env=dataclasses.replace(config.env, dataset=dataset))
        return dataclasses.replace(describe(moved, environment, [0]), data=data)

    checkpoint.check_same(tmp_path, about, of(str(tmp_path / "elsewhere")))
    with pytest.raises(UserError, match="data was .*, now 'other photographs'"):
        checkpoint.check_same(tmp_path, about, of("started/photographs", "other photographs"))


def test_a_run_is_loaded_with_its_data_elsewhere(tmp_path, monkeypatch):
    """As a packed one is on another machine; never with other data."""
    configuration.write(tmp_path, Description(hand_made.config(), [0], "rooms", {}, "cpu"))

    def train(config, env=None):
        source = "rooms" if config.env.dataset == "moved" else "a street"
        return SimpleNamespace(env=env or SimpleNamespace(source=source, recorded_checksum=""))

    monkeypatch.setattr(runs, "make_train", train)
    assert load_run(tmp_path, dataset="moved").config.env.dataset == "moved"
    with pytest.raises(UserError, match="dataset = 'a street': the run's data were rooms"):
        load_run(tmp_path, dataset="elsewhere")
    with pytest.raises(UserError, match="room = 'x': is no place of the task's data. Known: dataset, .*, split"):
        load_run(tmp_path, room="x")
    # What lies in the place that config.json names is other data by now, or what is given in its place.
    with pytest.raises(UserError, match="data = 'a street': the run's data were rooms"):
        load_run(tmp_path).env  # noqa: B018
    with pytest.raises(UserError, match="data = 'a lake': the run's data were rooms"):
        load_run(tmp_path).train_in(SimpleNamespace(source="a lake", recorded_checksum=""))


FILES = {
    "train": killed_run.FILES,
    "tune": ("checkpoint", "config.json", "trials.jsonl"),
    "final": ("checkpoint", "config.json", "trials.jsonl"),
}
LONGEST = 900
"""Seconds for a run on a busy machine."""
LASTING = (killed_run.TRAINING, killed_run.WRITING)
"""Moments that come again and again, from the first chunk to the last."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """For a kind: a run that was left alone, once everything is compiled, and the seconds that it took."""
    found = {}

    def run(kind: str) -> tuple[Path, float]:
        if kind not in found:
            folder = tmp_path_factory.mktemp(kind)
            for name in ("first", "second"):
                started = time.monotonic()
                process, _ = killed_run.start(kind, folder / name)
                process.join(LONGEST)
                assert process.exitcode == 0
            found[kind] = folder / "second", time.monotonic() - started
        return found[kind]

    return run


def check_same(kind: str, folder: Path, other: Path) -> None:
    """Assert that two runs left the same bits and the same files."""
    assert {path.name for path in folder.iterdir()} == {path.name for path in other.iterdir()}
    assert not list(folder.rglob(".*"))
    for name in FILES[kind]:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name


def wait_for(process, moment_of, wanted: str, seconds: float) -> None:
    """Return when a process, or a part of it that is drawn, is at the moment that is wanted, or has ended."""
    if wanted in LASTING:
        process.join(random.uniform(0.0, seconds))
    deadline = time.monotonic() + LONGEST
    while moment_of() != wanted and process.is_alive():
        assert time.monotonic() < deadline
        time.sleep(0.0002)
    time.sleep(random.choice([0.0, 0.001, 0.01]))


def end_at_random(kind: str, whole, folder: Path, number: int, times: int) -> Counter:
    """Send a signal to runs at random moments of each kind and go on after each; those that finish are compared and
    followed by new ones. Returns how often each moment was hit; at least `times` in all, and each once."""
    other, seconds = whole(kind)
    moments = killed_run.MOMENTS if kind == "train" else killed_run.MOMENTS[:-1]  # A search draws nothing.
    hit, finished = Counter(), 0
    while (missing := set(moments) - set(hit)) or hit.total() < times or finished == 0:
        process, moment_of = killed_run.start(kind, folder / str(finished))
        last, started = not missing and hit.total() >= times, time.monotonic()
        if last:
            process.join(LONGEST)
        else:
            wait_for(process, moment_of, random.choice(sorted(missing) or moments), seconds)
        if process.is_alive():
            assert not last
            hit[moment_of()] += 1
            os.kill(process.pid, number)
            process.join(LONGEST)
            if number == signal.SIGTERM:
                # Finished if the signal came after the last chunk; killed by it if before the first import's end.
                assert process.exitcode in (0, killed_run.STOPPED, -signal.SIGTERM), process.exitcode
        if process.exitcode == 0:
            check_same(kind, folder / str(finished), other)
            finished += 1
            seconds = min(seconds, time.monotonic() - started)  # The machine may be less busy than before.
        else:
            assert process.exitcode != killed_run.REFUSED
    print(f"{kind}: hit {dict(hit)}, {finished} finished")
    return hit


@pytest.mark.long
@pytest.mark.parametrize(("kind", "kills"), [("train", 24), ("tune", 13), ("final", 13)])
def test_killed_at_random_moments_it_ends_with_the_same_bits(kind, kills, whole, tmp_path):
    assert end_at_random(kind, whole, tmp_path, signal.SIGKILL, kills).total() >= kills


@pytest.mark.long
@pytest.mark.parametrize(("kind", "times"), [("train", 10), ("tune", 5), ("final", 5)])
def test_stopped_at_random_moments_it_ends_with_the_same_bits(kind, times, whole, tmp_path):
    assert end_at_random(kind, whole, tmp_path, signal.SIGTERM, times).total() >= times


@pytest.mark.long  # That a second writer is refused, of its own process and of another, is above.
@pytest.mark.parametrize("races", [50])
def test_of_two_writers_one_is_refused_and_the_other_s_run_is_whole(races, tmp_path):
    for race in range(races):
        folder = tmp_path / str(race)
        processes = [killed_run.start("short", folder)[0] for _ in range(2)]
        for process in processes:
            process.join(LONGEST)
        assert sorted(process.exitcode for process in processes) == [0, killed_run.REFUSED]
        assert [(row["seed"], row["epoch"]) for row in read_table(folder, "epochs")] == [(0, 1)]
        assert not list(folder.glob(".*"))
