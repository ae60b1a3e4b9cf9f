"""What several test files share: programs on disk, a run with image goals, a tiny house, the shipped goal images,
made-up numbers of every run, and a reproduction whose clock runs out; and the order of the files."""

import contextlib
import ctypes
import gc
import json
import os
import shutil
import signal
import tempfile
from pathlib import Path

import numpy as np
import pytest

from infogoal_jax.__main__ import GARBAGE

# The process that hands out the tests imports this module too: what it does not need is imported where it is used.

os.environ.setdefault("RAY_memory_monitor_refresh_ms", "0")  # Else Ray kills workers for the memory that others hold.
MEMORY_MAPS = Path("/proc/self/maps")
MANY_MAPS = 30_000
"""A large program lies in thousands of memory maps on a CPU. Linux allows a process 65,530, and LLVM aborts it at the
next."""
MUCH_MEMORY = 4.0
"""GB that a worker holds; two of the long tests held 7 each at their end, most of it freed and not given back."""
LONGEST_FIRST = (
    "training",
    "own_contracts",
    "import",
    "report",
    "detection_walks",
    "reconstruction",
    "adapters",
    "offline",
    "every_method",
    "jobs",
    "replay",
    "all_goals",
    "relabelling",
    "drawing",
    "goal_task",
    "vectors",
    "work",
    "image_goals",
    "export",
    "command_line",
    "hrac_losses",
    "resume",
    "infobot",
    "cher",
    "hrac",
    "dqn",
    "public",
    "ghrl",
    "sse_db",
    "object_manipulation",
    "live",
    "gcb",
    "parity",
    "recordings_alone",
    "host",
    "multibody",
    "every_command",
    "environment",
    "physics",
    "sac",
    "batches",
    "gymnasium",
    "episodes",
    "gymnasium_tasks",
    "methods_command",
    "infogoal",
    "gymnasium_vectors",
    "goal_spaces",
    "rad",
    "house",
    "comparison_figures",
    "active_vision",
    "readings",
    "cogoal",
    "goal_images",
    "tables",
    "dissimilar",
    "goal_box",
    "settings",
)
"""Files that are begun first: what is short fills the gap that is left at the end, and both processes are done at about
the same time."""
KEPT = "INFOGOAL_TEST_PROGRAMS"
"""Where `make test` keeps compiled programs for the next session; unset, they go with the session."""
MOST_KEPT = 4e9
"""Bytes of them, of code that is long gone: with more, the next session begins anew."""
ON_DISK = {
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",
}
"""Small programs too: a file of tests has hundreds, and reading one takes a fraction of the time of compiling it. XLA's
own caches would make the path of the folder, another in each session, a part of what programs are found by."""


def pytest_configure(config):
    """Keep compiled programs in a folder that this session's processes share: the workers, and those that tests start;
    nobody's own cache is used. A program is found by all that it is made of, so that one that is kept is never another.

    The command line looks for them below XDG_CACHE_HOME, everything else at JAX_COMPILATION_CACHE_DIR: here both are
    the same folder.
    """
    gc.set_threshold(*GARBAGE)
    if not hasattr(config, "workerinput"):
        folder = Path(tempfile.mkdtemp(prefix="infogoal_tests_"))
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
        programs = folder / "infogoal" / "jax"
        if os.environ.get(KEPT):
            link_kept(Path(os.environ[KEPT]).absolute(), programs)
        os.environ.update(ON_DISK | {"XDG_CACHE_HOME": str(folder), "JAX_COMPILATION_CACHE_DIR": str(programs)})
    if not hasattr(config, "workerinput") and getattr(config.option, "numprocesses", None):
        return  # It hands out the tests, and runs none.
    import jax

    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    for name, value in ON_DISK.items():
        jax.config.update(name.lower(), value if name.endswith("XLA_CACHES") else int(value))


def link_kept(kept: Path, programs: Path) -> None:
    """Let the session's programs be those that are kept."""
    if kept.exists() and sum(file.stat().st_size for file in kept.iterdir()) > MOST_KEPT:
        shutil.rmtree(kept)
    kept.mkdir(parents=True, exist_ok=True)
    programs.parent.mkdir()
    programs.symlink_to(kept, target_is_directory=True)


def pytest_collection_modifyitems(items):
    """Files in the order of `LONGEST_FIRST`, the others after them as they were."""
    rank = {f"test_{name}.py": number for number, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


@pytest.fixture(scope="session", autouse=True)
def as_from_a_terminal():
    """Let signals reach the tests and what they start: a shell begins its background jobs with SIGINT ignored, `nohup`
    its command with SIGHUP, and processes inherit that. A handler they do not inherit, so that with one for SIGHUP the
    tests themselves still outlive their terminal."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)


@pytest.fixture(autouse=True, scope="module")
def nothing_of_other_files():
    """What a file registers or imports, other files do not know: which of them share a process changes."""
    from places import forgotten

    with forgotten():
        yield


@pytest.fixture(autouse=True)
def nothing_of_other_tests():
    """What a test registers or imports, the next one does not know."""
    from places import forgotten

    with forgotten():
        yield


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Forget compiled programs between files when they are many or large; what is needed again is compiled again."""
    yield
    import jax

    if MEMORY_MAPS.exists() and (MEMORY_MAPS.read_bytes().count(b"\n") > MANY_MAPS or memory() > MUCH_MEMORY):
        jax.clear_caches()
        gc.collect()
        with contextlib.suppress(AttributeError):  # The C library is another one than glibc.
            ctypes.CDLL(None).malloc_trim(0)


def memory() -> float:
    """GB of memory that this process holds, on Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e9


@pytest.fixture
def nothing_of_the_users(tmp_path, monkeypatch):
    """A cache and a working folder of the test's own; no proxy between the test and its server."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def reach_run(tmp_path_factory):
    """Two seeds of FetchReach with image goals, trained for two epochs on episodes of 10 steps: nothing is learned,
    everything is there. A `training.RunResult`."""
    from infogoal_jax import presets
    from infogoal_jax.envs.fetch.tasks import FetchConfig
    from infogoal_jax.runner import training

    config = presets.load(
        "fetch_reach",
        env=FetchConfig(goals="images", episode_length=10),
        num_epochs=2,
        epochs_per_evaluation=1,
        num_envs=8,
        rollout_steps=10,
        updates_per_epoch=2,
        batch_size=16,
        buffer_steps=160,
        evaluation_starts=1,
    )
    return training.run(config, [0, 1], tmp_path_factory.mktemp("reach") / "run")


@pytest.fixture(scope="session")
def tiny_house(tmp_path_factory) -> Path:
    """Folder of a tiny synthetic house: 64 x 36 pixels, nodes 1.2 m apart. Nobody changes it."""
    from hand_made_frames import TINY_HOUSE

    from infogoal_jax.stand_ins import house

    root = tmp_path_factory.mktemp("tiny_house")
    house.build_house(root, seed=3, **TINY_HOUSE)
    return root


@pytest.fixture(scope="session")
def annotations(tiny_house) -> dict[str, dict]:
    """What the images of the tiny house show."""
    return json.loads((tiny_house / "Home_101_1" / "annotations.json").read_text())


@pytest.fixture(scope="module")
def banks():
    """The shipped banks of goal images, `GoalImages` by the name of the task."""
    from infogoal_jax import presets
    from infogoal_jax.data import goal_images

    return {name: goal_images.load(goal_images.shipped(name), name) for name in presets.FETCH_TASKS}


@pytest.fixture(scope="session")
def differing_pixels():
    """In how many pixels images [..., H, W, 3] differ by more than 16 of 255 in some colour."""

    def count(images, others):
        difference = np.maximum(images, others) - np.minimum(images, others)  # Of bytes, without going below 0.
        return (difference.max(-1) > 16).sum((-1, -2))

    return count


@pytest.fixture(scope="session")
def results():
    """Made-up numbers of every run, of three seeds; nobody changes them."""
    import made_up_results

    return made_up_results.results(seeds=3)


@pytest.fixture
def evaluations(monkeypatch) -> list[int]:
    """The number of each evaluation as it comes. The third one that this test makes seems to take so long that the
    clock, where there is one, leaves no time for another."""
    from infogoal_jax.runner import sweep

    advance, count = sweep.advance, []

    def slow(members):
        advance(members)
        count.append(members.evaluations)
        members.last_seconds = 1e8 if len(count) == 3 else 1e-3

    monkeypatch.setattr(sweep, "advance", slow)
    return count
