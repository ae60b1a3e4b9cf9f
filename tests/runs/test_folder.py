"""The folder of a run has one writer at a time, holds nobody else's files, and keeps nothing of processes that were
killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import hand_made
import pytest

from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.runs import configuration, disk, folder
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.folder import LOW_LEVEL, RUN, SEARCH, check_new, newest_run, only_writer


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


@pytest.mark.parametrize("names", [RUN, SEARCH, LOW_LEVEL])
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
    for name in ("config.json", "epochs.csv", "evaluations.csv", "evaluations.jsonl", "timing.json", "curve.csv"):
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
