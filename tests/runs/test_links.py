"""A folder of a run that somebody else prepared changes nothing outside of itself, and nothing in it makes a reader
wait: links, hard links, pipes and devices in the place of its files are refused in one sentence, before anything is
written."""

import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import hand_made
import pytest
from fuzzing import digest, write_run

from infogoal_jax import files
from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.report import figures
from infogoal_jax.runner import executors
from infogoal_jax.runs import configuration, disk, tables
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.folder import APPENDED, LOCK, RUN, SEARCH, only_writer, remove_abandoned
from infogoal_paper import progress

NAMES = sorted({LOCK, *RUN, *SEARCH})


def link(path: Path, outside: Path) -> None:
    path.symlink_to(outside / "figures" if path.name == "figures" else outside / "file")


def dangling_link(path: Path, outside: Path) -> None:
    path.symlink_to(outside / "new")


def second_name(path: Path, outside: Path) -> None:
    os.link(outside / "file", path)


def pipe(path: Path, outside: Path) -> None:
    os.mkfifo(path)


@pytest.fixture
def outside(tmp_path) -> Path:
    """What must stay as it is."""
    (tmp_path / "outside" / "figures").mkdir(parents=True)
    (tmp_path / "outside" / "file").write_text("kept")
    (tmp_path / "outside" / "figures" / "file").write_text("kept")
    return tmp_path / "outside"


@pytest.fixture
def run(tmp_path) -> Path:
    write_run(tmp_path / "run")
    return tmp_path / "run"


def put(make, path: Path, outside: Path) -> None:
    """Put this in the place of a file."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    make(path, outside)


@pytest.mark.parametrize("make", [link, dangling_link, pipe])
@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_written_in_a_folder_that_leads_elsewhere(name, make, run, outside):
    put(make, run / name, outside)
    before = digest(outside), sorted(run.iterdir())
    with pytest.raises(UserError, match=f"{name}: is (a link|no regular file).*copy"), only_writer(run):
        pass
    assert (digest(outside), sorted(run.iterdir())) == before


@pytest.mark.parametrize("name", sorted(APPENDED))
def test_a_file_that_is_changed_in_place_has_no_second_name(name, run, outside):
    put(second_name, run / name, outside)
    with pytest.raises(UserError, match=f"{name}: has a second name elsewhere.*cp -r"), only_writer(run):
        pass
    assert (outside / "file").read_text() == "kept"


@pytest.mark.parametrize("make", [link, dangling_link, second_name, pipe])
def test_each_way_of_writing_keeps_to_its_file(make, tmp_path, outside):
    """Without a look at the folder before: appending, replacing, locking. A second name is left behind by what
    replaces."""
    path, before = tmp_path / "epochs.csv", digest(outside)
    for write in (
        lambda: files.append(path, b"more"),
        lambda: disk.write_text(path, "other"),
        lambda: files.open_lock(path).close(),
    ):
        put(make, path, outside)
        try:
            write()
        except (OSError, UserError):
            pass
        else:
            assert make is second_name and path.read_text() == "other"
        assert digest(outside) == before


def test_what_was_prepared_where_a_file_is_written_beside_is_not_followed(tmp_path, outside, monkeypatch):
    """Even if its name were guessed."""
    monkeypatch.setattr(files.secrets, "token_hex", lambda count: "guessed")
    (tmp_path / ".config.json.guessed.partial").symlink_to(outside / "file")
    with pytest.raises(UserError, match="could not be written"):
        disk.write_text(tmp_path / "config.json", "{}")
    assert (outside / "file").read_text() == "kept" and not (tmp_path / "config.json").exists()


def test_what_looks_abandoned_and_is_a_link_stays(run, outside):
    (run / ".checkpoint.1.partial").symlink_to(outside / "file")
    os.mkfifo(run / ".policy.1.partial")
    remove_abandoned(run)
    assert (outside / "file").read_text() == "kept"


def test_figures_are_not_drawn_through_a_link(run, outside, monkeypatch):
    put(link, run / "figures", outside)
    monkeypatch.setattr(figures, "learning_curves", None)
    train = SimpleNamespace(env=SimpleNamespace(goals=SimpleNamespace(finite=True), simulated=True))
    subject = SimpleNamespace(evaluations=SimpleNamespace(values={"a": 1}), train=train)
    for name in ("beta_and_accuracy", "success_by_length", "success_by_goal", "representations", "learning_curves"):
        monkeypatch.setattr(figures, name, type(name, (), {"__new__": lambda kind, subject: None}))
    monkeypatch.setattr(figures, "draw_of_task", lambda subject: {})
    before = digest(outside)
    with pytest.raises(UserError, match="figures: is a link"):
        figures.draw_all(subject, run, "png", False)
    assert digest(outside) == before


COMMANDS = {
    "pack": "pack run --out {}.zip",
    "export": "export run --out {}.npz",
    "compare": "compare run --out {}.png",
    "style": "compare run --out new.png --style {}",
    "evaluate": "evaluate {}.zip",
    "fly": "fly {}.npz --question where --simulate",
    "data check": "data check {}.npz",
    "report": "report {}",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_pipe_is_refused_at_once_and_stays(command, run, monkeypatch, capsys):
    monkeypatch.chdir(run.parent)
    configuration.write(run, Description(hand_made.config(), [1000, 1001], "rooms", {}, "cpu"))  # Not of a search.
    line = COMMANDS[command].format("pipe")
    path = next(Path(word) for word in line.split() if word.startswith("pipe"))
    os.mkfifo(path)
    assert main(line.split()) in (1, 2)
    printed = capsys.readouterr()
    assert str(path) in printed.err + printed.out and path.is_fifo()


def test_times_of_a_reproduction_are_not_added_through_a_link(tmp_path, outside):
    (tmp_path / progress.TIMES).symlink_to(outside)
    with pytest.raises(UserError, match="times: is a link"):
        progress.keep_times(tmp_path, "fetch_push", 2, 3.0)
    assert {path.name for path in outside.iterdir()} == {"file", "figures"}


@pytest.mark.parametrize("path", ["../file", "/tmp/file", "runs/../../file", "runs/..", ""])
@pytest.mark.parametrize("content", [b"mine", None])
def test_a_worker_names_files_of_the_folder_alone(path, content, tmp_path):
    with pytest.raises(UserError, match="lies outside of|names no file"):
        executors.write(tmp_path / "folder", path, content)
    assert not list(tmp_path.rglob("*"))


def test_a_worker_writes_through_no_link(tmp_path, outside):
    folder = tmp_path / "folder"
    (folder / "runs").mkdir(parents=True)
    (folder / "runs" / "task").symlink_to(outside)
    (folder / "runs" / "file").symlink_to(outside / "file")
    for path in ("runs/task/file", "runs/file"):
        for content in (b"mine", None):
            with pytest.raises(UserError, match="is a link, through which nothing is written"):
                executors.write(folder, path, content)
    executors.write(folder, "runs/mine/a.npz", b"mine")
    assert (outside / "file").read_text() == "kept" and (folder / "runs/mine/a.npz").read_bytes() == b"mine"


def test_an_append_that_the_disk_refuses_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    """Half of it is taken, and the message says what is so."""
    rows = [{"seed": 0, "epoch": 1, "loss": 0.5}]
    tables.append_rows(tmp_path, "epochs", rows)
    before, write = (tmp_path / "epochs.csv").read_bytes(), os.write
    refusals = iter([False, True])

    def half(descriptor, content):
        if next(refusals):
            raise OSError(28, "No space left on device")
        return write(descriptor, content[: len(content) // 2])

    monkeypatch.setattr(os, "write", half)
    with pytest.raises(UserError, match="epochs.csv: could not be written.*free some space. This file is as it was"):
        tables.append_rows(tmp_path, "epochs", rows)
    assert (tmp_path / "epochs.csv").read_bytes() == before
