"""Where jobs run: the same files in this process, in several, and on a Ray cluster; nothing is lost with a worker and
nothing is trained twice; what a worker sends stays in its folder; who asks for no engine needs no Ray."""

import dataclasses
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
from two_machines import cluster_of_two

import infogoal_jax
from infogoal_jax.errors import UserError
from infogoal_jax.runner import executors
from infogoal_jax.runner.executors import Mailbox, Message, Outcome, Place, run_here, run_on_ray, write
from infogoal_jax.runs.folder import BeingWrittenError, locked

STEPS = 5


@dataclasses.dataclass(frozen=True)
class Counting:
    """A job that counts to `STEPS`, with a file after each step. seconds: of a step; ends: what it does at its third
    step when it has none behind it: nothing, `fails`, `dies` with its process, or `waits` until it is to stop."""

    name: str
    seconds: float = 0.0
    ends: str = ""

    @property
    def members(self):
        return (self.name,)

    def without(self, members):
        return dataclasses.replace(self, name="") if self.name in members else self

    def path(self, folder: Path) -> Path:
        return folder / "counts" / self.name

    def claim(self, place, claims, whole):
        if not self.name or self.is_done(place.folder):
            return None
        place.folder.mkdir(exist_ok=True)
        try:
            claims.enter_context(locked(place.folder / f"{self.name}.lock", place.folder))
        except BeingWrittenError:
            return None
        return self

    def files(self, folder):
        return [path for path in [self.path(folder)] if path.exists()]

    def done(self, folder) -> int:
        return int(self.path(folder).read_text()) if self.path(folder).exists() else 0

    def is_done(self, folder) -> bool:
        return self.done(folder) >= STEPS

    def train(self, place):
        first = self.done(place.folder)
        self.path(place.folder).parent.mkdir(exist_ok=True)
        place.say(f"{self.name} begins at {first}")
        for step in range(first, STEPS):
            if place.left() < 0:
                return
            time.sleep(self.seconds)
            if step == 2 and self.ends == "fails":
                raise ValueError("out of luck")
            if step == 2 and self.ends == "dies":
                os._exit(1)
            while step == 2 and self.ends == "waits":
                if place.left() < 0:
                    return
                time.sleep(0.1)
            self.path(place.folder).write_text(str(step + 1))

    def fail(self, place, error):
        place.folder.joinpath(f"{self.name}.failed").write_text(str(error))

    def outcome(self, folder):
        if self.is_done(folder):
            return Outcome(finished=[self.name])
        return Outcome(failed=[self.name] if folder.joinpath(f"{self.name}.failed").exists() else [])

    def tidy(self, folder):
        pass


def jobs(count: int = 3, **named) -> list[Counting]:
    return [Counting(f"job{number}", **named) for number in range(count)]


def test_jobs_are_done_once(tmp_path):
    said = []
    place = Place(tmp_path, say=said.append)
    assert run_here(jobs(), place) == Outcome(["job0", "job1", "job2"])
    assert run_here(jobs(), place) == Outcome() and sum("begins" in words for words in said) == 3


def test_what_another_process_has_is_left_to_it(tmp_path):
    with locked(tmp_path / "job1.lock", tmp_path):
        assert run_here(jobs(), Place(tmp_path)).finished == ["job0", "job2"]
    assert run_here(jobs(), Place(tmp_path)).finished == ["job1"]


def test_the_clock_stops_it_and_it_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(executors, "BEGINNING", 0.0)
    outcome = run_here(jobs(seconds=0.2), Place(tmp_path, time.time() + 0.5))
    assert outcome.stopped and not outcome.finished and 0 < Counting("job0").done(tmp_path) < STEPS
    assert run_here(jobs(), Place(tmp_path)).finished == ["job0", "job1", "job2"]


def test_processes_are_spread_over_gpus(monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    found = [executors.environment(number, 5, 2) for number in range(5)]
    assert [each["CUDA_VISIBLE_DEVICES"] for each in found] == ["0", "1", "0", "1", "0"]
    assert {each["XLA_PYTHON_CLIENT_MEM_FRACTION"] for each in found} == {"0.300"}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,7")
    assert executors.environment(1, 2, 2)["CUDA_VISIBLE_DEVICES"] == "7"
    executors.check_flags("local", 2, 2, "")
    with pytest.raises(UserError, match="gpus = 3: give at most 2: CUDA_VISIBLE_DEVICES is 3,7"):
        executors.check_flags("local", 6, 3, "")
    assert "XLA_PYTHON_CLIENT_MEM_FRACTION" not in executors.environment(0, 2, 0)


def test_what_lets_processes_compute_at_the_same_time_is_named_once_it_is_missed(tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not executors.take_turns(2, 1), "this machine does not have it"
    (tmp_path / executors.MPS).touch(0o700)
    assert executors.take_turns(2, 1) and not executors.take_turns(2, 2) and not executors.take_turns(2, 0)
    (tmp_path / "control").touch()
    assert not executors.take_turns(2, 1), "it runs"


@pytest.mark.parametrize("path", ["../beside", "/tmp/elsewhere", "a/../../beside"])
def test_a_worker_writes_nowhere_else(path, tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match="lies outside"):
        write(tmp_path / "folder", path, b"anything")
    assert [each.name for each in tmp_path.iterdir()] == ["folder"]


def test_a_link_in_the_folder_leads_a_worker_nowhere(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "folder" / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="link: is a link"):
        write(tmp_path / "folder", "link/file", b"anything")


def test_a_job_that_is_begun_anew_has_what_was_sent_of_it():
    mailbox = Mailbox()
    assert not mailbox.put(Message("job", ["begun"], {"checkpoint": b"one", "log": b"a"}))
    mailbox.stop()
    assert mailbox.put(Message("job", [], {"checkpoint": b"two", "log": None}))
    assert mailbox.files_of("job") == {"checkpoint": b"two"} and mailbox.files_of("other") == {}
    assert [message.said for message in mailbox.take()] == [["begun"], []] and mailbox.take() == []
    mailbox.forget("job")
    assert mailbox.files_of("job") == {}


@pytest.fixture(scope="module")
def cluster():
    """A cluster whose workers are as they come."""
    with cluster_of_two() as (found, _):
        yield found


def ray_jobs(count: int = 3, **named) -> list:
    """Jobs as a worker can import them."""
    import test_executors

    return [test_executors.Counting(f"job{number}", **named) for number in range(count)]


pytestmark = pytest.mark.filterwarnings("ignore:os.fork")  # Ray starts its processes so, and they begin anew at once.


@pytest.mark.long
def test_a_cluster_does_what_this_process_does(cluster, tmp_path):
    said = []
    failing = dataclasses.replace(ray_jobs(4)[3], ends="fails")
    outcome = run_on_ray([*ray_jobs(), failing], Place(tmp_path, say=said.append))
    assert sorted(outcome.finished) == ["job0", "job1", "job2"] and outcome.failed == ["job3"]
    assert "out of luck" in (tmp_path / "job3.failed").read_text() and not list(tmp_path.rglob("*.lock"))
    assert run_on_ray(ray_jobs(), Place(tmp_path, say=said.append)) == Outcome()


@pytest.mark.long
def test_a_job_whose_workers_die_goes_on_where_it_was_and_is_given_up_at_last(cluster, tmp_path):
    said = []
    deadly = dataclasses.replace(ray_jobs(1)[0], ends="dies", seconds=1.0)
    outcome = run_on_ray([deadly, *ray_jobs(3)[1:]], Place(tmp_path, say=said.append))
    assert sorted(outcome.finished) == ["job1", "job2"] and outcome.failed == ["job0"]
    assert next(words for words in said if "job0 begins" in words).endswith("begins at 0")
    assert any("job0 begins at 2" in words for words in said) and (tmp_path / "counts" / "job0").read_text() == "2"


@pytest.mark.long
def test_a_signal_leaves_what_goes_on(cluster, tmp_path):
    def listen(words: str) -> None:
        if "begins" in words:
            threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM)).start()

    outcome = run_on_ray(ray_jobs(1, ends="waits"), Place(tmp_path, say=listen))
    assert outcome.stopped and not outcome.finished and not list(tmp_path.rglob("*.lock"))
    assert (tmp_path / "counts" / "job0").read_text() == "2"
    assert run_on_ray(ray_jobs(1), Place(tmp_path)).finished == ["job0"]


@pytest.mark.long
def test_a_disk_that_refuses_ends_it_with_an_error_and_other_jobs_are_kept(cluster, tmp_path, monkeypatch):
    whole = executors.write

    def refusing(folder, path, content):
        if path.endswith("job0"):
            raise UserError("out = full")
        whole(folder, path, content)

    monkeypatch.setattr(executors, "write", refusing)
    with pytest.raises(UserError, match="out = full"):
        run_on_ray([*ray_jobs(1), dataclasses.replace(ray_jobs(2)[1], seconds=0.5)], Place(tmp_path))
    assert not list(tmp_path.rglob("*.lock"))


def test_without_an_engine_there_is_no_ray(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)  # An import of it fails.
    run_here(jobs(), Place(tmp_path))
    with pytest.raises(UserError, match=r"pip install 'infogoal-jax\[ray\]'"):
        run_on_ray(jobs(), Place(tmp_path))


@pytest.mark.long
def test_another_version_of_the_package_says_so(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(infogoal_jax, "__version__", "0.0.1")
    assert run_on_ray(ray_jobs(1), Place(tmp_path)).failed == ["job0"]
    assert "install the same everywhere" in (tmp_path / "job0.failed").read_text()
