"""Sweeps: seeds spread over devices or cut into slices are the same seeds; a single run and a sweep agree in
distribution. What watches a run: a log file says that a program is being compiled, that it still is, and how long
everything took; TensorBoard and Weights & Biases get numbers, figures and videos.

What is done to seeds is tested with a small program (`killed_run.small_train`), and among the long tests with a real
one.
"""

import dataclasses
import io
import json
import os
import re
import struct
import subprocess
import sys
import time
import types
from pathlib import Path

import hand_made
import jax
import killed_run
import numpy as np
import pytest
import scipy.stats
from PIL import Image
from places import ROOT, TESTS
from rich.console import Console

from infogoal_jax import make_train
from infogoal_jax.errors import UserError
from infogoal_jax.presets.loading import method_title
from infogoal_jax.runner import memory, progress, training
from infogoal_jax.runner.listeners import advancing, make_listeners
from infogoal_jax.runner.sweep import side_by_side
from infogoal_jax.runner.training import Progress, run

WATCHED = {"agent/loss": 1.0, "agent/gradient_norm": 1.0}

ON_TWO_DEVICES = """
import sys
from pathlib import Path
import jax
import test_host
from infogoal_jax.runner import memory, training
assert len(jax.devices()) == 2
program, epochs, at_once = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
if at_once < 2:
    memory.at_once = lambda *arguments: at_once
seen = []
training.make_train = test_host.PROGRAMS[program]
test_host.train_four(Path(sys.argv[1]), epochs, listeners=(lambda progress: seen.extend(progress.epochs),))
assert [row["seed"] for row in seen] == [0, 1, 2, 3] * epochs
"""
PROGRAMS = {"small": killed_run.small_train, "real": make_train}


def train_four(folder: Path, epochs: int = 1, **options) -> None:
    """Train four seeds."""
    config = hand_made.config("none", num_epochs=epochs, epochs_per_evaluation=1, updates_per_epoch=3)
    training.run(config, [0, 1, 2, 3], folder, env=hand_made.environment(), **options)


def losses_on_one_device(folder: Path) -> list[float]:
    """Losses of four seeds trained side by side on one device."""
    train_four(folder)
    return read_losses(folder)


@pytest.fixture
def small_program(monkeypatch):
    monkeypatch.setattr(training, "make_train", killed_run.small_train)


def read_losses(folder: Path) -> list[float]:
    return [json.loads(line)["agent/loss"] for line in (folder / "epochs.jsonl").read_text().splitlines()]


def train_on_two_devices(folder: Path, program: str, epochs: int, at_once: int) -> None:
    """Train four seeds on two devices, so many of a device's two at once."""
    environment = os.environ | {
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    }
    command = [sys.executable, "-c", ON_TWO_DEVICES, str(folder), program, str(epochs), str(at_once)]
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(TESTS)])
    subprocess.run(command, cwd=TESTS / "runner", env=environment, check=True)


@pytest.mark.long
def test_seeds_spread_over_two_devices_are_the_same_seeds(small_program, tmp_path):
    one_device = losses_on_one_device(tmp_path / "one")
    train_on_two_devices(tmp_path / "two", "small", 1, 2)
    np.testing.assert_allclose(read_losses(tmp_path / "two"), one_device, rtol=1e-6)
    assert len({*one_device}) == 4


def test_a_sweep_cut_into_slices_for_memory_is_the_same_sweep(small_program, tmp_path, monkeypatch):
    one_device = losses_on_one_device(tmp_path / "one")
    monkeypatch.setattr(memory, "at_once", lambda *arguments: 2)
    np.testing.assert_allclose(losses_on_one_device(tmp_path / "slices"), one_device, rtol=1e-6)


@pytest.mark.long
def test_a_sweep_in_slices_on_each_of_two_devices_is_the_same_sweep(tmp_path):
    """The real program. A chunk after the first takes the states from where the first left them."""
    one_device = losses_on_one_device(tmp_path / "one")
    train_on_two_devices(tmp_path / "two", "real", 2, 1)
    losses = read_losses(tmp_path / "two")
    np.testing.assert_allclose(losses[:4], one_device, rtol=1e-3)
    assert len(losses) == 8 and losses[:4] != losses[4:]


@pytest.mark.long
def test_success_of_a_sweep_and_of_single_runs_agree_in_distribution():
    config = hand_made.config(
        num_epochs=16,
        epochs_per_evaluation=16,
        updates_per_epoch=50,
        batch_size=64,
        buffer_steps=5120,
        evaluation_starts=10,
    )
    train = make_train(config, hand_made.environment())
    keys = jax.random.split(jax.random.key(0), 32)
    together = np.asarray(jax.jit(jax.vmap(train))(keys).metrics["test_goal/success_rate"][:, -1])
    single = jax.jit(train)
    alone = np.asarray([single(key).metrics["test_goal/success_rate"][-1] for key in keys])
    assert together.std() > 0  # Not all at the ceiling: the comparison could fail.
    assert scipy.stats.ks_2samp(together, alone).pvalue > 0.01


def test_a_log_says_what_takes_long(monkeypatch, capsys):
    monkeypatch.setattr(progress, "SIGN_OF_LIFE", 0.05)
    with progress.progress_line("fetch_reach infogoal x 2", 4) as line:
        line.phase("loading")
        line.phase("compiling")
        time.sleep(0.3)
        line.phase("training")
        line.advance(2, "train 0.50", "7 updates/s")
        before = capsys.readouterr().out.splitlines()
        time.sleep(0.2)
        line.advance(4, "train 0.75")
    assert before[0] == "fetch_reach infogoal x 2: compiling, some minutes the first time"
    alive = r"fetch_reach infogoal x 2: still compiling, \d:\d\d"
    assert len(before) > 3 and all(re.fullmatch(alive, words) for words in before[1:-2])
    assert re.match(r"loading \d+\.\d s, compiling \d+\.\d", before[-2])
    assert re.fullmatch(r"epoch 2/4  \d:\d\d  \d:\d\d left  train 0\.50  7 updates/s", before[-1])
    assert re.fullmatch(r"epoch 4/4  \d:\d\d  train 0\.75\n", capsys.readouterr().out)


def shown_line(width, done=3, numbers="train 0.95  test 0.41"):
    """The line of a run that has trained for a minute, in so many letters."""
    line = progress.ProgressLine("object_search infogoal x 16", 8, Console(file=io.StringIO()))
    line.phase("training")
    line.since -= 60.3
    line.advance(done, numbers, "8,192 env steps/s  120 updates/s")
    return line.of_width(width)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_bar_count_time_left_and_success_are_seen_in_a_terminal_of_any_width(width):
    shown = shown_line(width)
    assert len(shown) <= width and "3/8  1:40 left  train 0.95  test 0.41" in shown and "…" not in shown
    filled, empty = shown.count("━"), shown.count("─")
    assert filled + empty >= progress.NARROWEST and abs(filled / (filled + empty) - 3 / 8) < 0.1
    assert ("8,192 env steps/s  120 updates/s" in shown) == (width == 120)  # Where there is room.
    assert "left" not in shown_line(width, done=8)


def test_a_terminal_of_few_letters_keeps_the_numbers_and_loses_the_bar():
    assert shown_line(40) == "3/8  1:40 left  train 0.95  test 0.41"


def test_a_run_that_goes_on_tells_the_time_left_by_its_own_epochs():
    line = progress.ProgressLine("", 8, Console(file=io.StringIO()))
    line.phase("compiling", epoch=6)
    assert "6/8  compiling" in line.of_width(80)  # It does not look like beginning anew.
    line.phase("training", epoch=6)
    line.since -= 10
    line.advance(7, "")
    assert line.left == pytest.approx(10, abs=0.5)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_before_the_first_epoch_the_line_says_what_the_run_is_doing(width):
    line = progress.ProgressLine("object_search infogoal x 16", 8, Console(file=io.StringIO()))
    assert "0/8  loading 0:00" in line.of_width(width)  # From the first letter on.
    line.phase("loading")
    line.since -= 2
    line.phase("tracing")
    line.phase("compiling")
    line.since -= 65
    shown = line.of_width(width)
    assert "0/8  compiling 1:05" in shown and "─" * progress.NARROWEST in shown and len(shown) <= width
    assert ("loading 2.0 s, tracing 0.0 s" in shown) == (width >= 100)


@pytest.mark.long  # It tells of time alone; that members are the same seeds is above.
def test_first_states_are_traced_once_for_all_members():
    """And once more for one member alone, by whose size the memory is shared out."""
    train, traced = make_train(hand_made.config("none"), hand_made.environment()), []
    counted = dataclasses.replace(train, initial=lambda *given: traced.append(0) or train.initial(*given))
    programs = side_by_side(counted, [0, 1])
    assert len(traced) == 2
    programs.states.initial()
    assert len(traced) == 2


def test_a_run_tells_its_phases_in_order(small_program, tmp_path):
    told = []
    config = dataclasses.replace(hand_made.config(), num_epochs=2)
    run(
        config, [0], tmp_path / "run", env=hand_made.environment(), phase=lambda name, epoch: told.append((name, epoch))
    )
    assert told == [("loading", 0), ("tracing", 0), ("compiling", 0), ("training", 0)]
    longer = dataclasses.replace(config, num_epochs=4)
    del told[:]
    run(longer, [0], tmp_path / "run", True, env=hand_made.environment(), phase=lambda *phase: told.append(phase))
    assert told == [(name, 2) for name in ("loading", "tracing", "compiling", "training")]


def test_a_notebook_has_one_line_that_moves(monkeypatch):
    """By IPython's own display, as a cell shows it: nothing has to be installed for it."""
    shown = []

    class Handle:
        def update(self, line):
            shown.append(repr(line))

    def display(line, display_id):
        shown.append(repr(line))
        return Handle()

    monkeypatch.setitem(sys.modules, "IPython.display", types.SimpleNamespace(display=display))
    monkeypatch.setattr(progress, "Console", lambda: Console(force_jupyter=True))
    monkeypatch.setattr(progress, "REFRESHED", 0.01)
    with progress.progress_line("rooms", 2) as line:
        line.phase("compiling")
        time.sleep(0.1)
        line.advance(2, "train 0.95")
    assert any("compiling" in line for line in shown) and "2/2  train 0.95" in shown[-1] and len(shown) > 2


@pytest.mark.parametrize(("rate", "shown"), [(1000.0, True), (0.0, False)])
def test_who_learns_offline_has_no_rate_of_steps(rate, shown, tmp_path, capsys):
    row = WATCHED | {"seed": 0, "epoch": 2, "train_goal/success_rate": 0.5}
    with make_listeners(tmp_path, hand_made.config(), 1) as listeners:
        for listen in listeners.progress:
            listen(training.Progress(2, 4, 1.0, 1.0, rate, 7.0, [row], [row]))
    printed = capsys.readouterr().out
    assert ("1,000 env steps/s" in printed) == ("env steps" in printed) == shown and "7 updates/s" in printed


def test_success_on_the_line_is_that_of_the_seeds_that_did_not_diverge():
    """As that of the table at the end."""
    line = progress.ProgressLine("", 4, Console(file=io.StringIO()))
    told, lost = advancing(line), {"agent/loss": float("nan")}
    for epoch, losses, words in ((2, [{}, lost], "train 1.00"), (4, [lost, {}], "every seed diverged")):
        rows = [WATCHED | own | {"seed": seed, "epoch": epoch} for seed, own in enumerate(losses)]
        success = [{"seed": seed, "epoch": epoch, "train_goal/success_rate": 1.0 - seed} for seed in (0, 1)]
        told(Progress(epoch, 4, 1.0, 1.0, 0.0, 7.0, rows, success))
        assert line.numbers == words


@pytest.fixture
def pictures(tmp_path):
    """A figure and a video, as training leaves them."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    grey = [Image.new("RGB", (40, 20), (shade,) * 3) for shade in (0, 120, 240)]
    grey[1].save(folder / "curves.png")
    grey[0].save(folder / "episode.gif", save_all=True, append_images=grey[1:])
    return [folder / "curves.png", folder / "episode.gif"]


def tell(listeners, pictures, seeds=(0,)):
    """What a run tells its listeners: two chunks, and pictures at the end."""
    for epoch in (2, 4):
        rows = [
            WATCHED | {"seed": seed, "epoch": epoch, "train_goal/success_rate": epoch / 4, "first_reached": [[1]]}
            for seed in seeds
        ]
        for listen in listeners.progress:
            listen(Progress(epoch, 4, 1.0, 1.0, 1000.0, 7.0, rows, rows))
    listeners.end_progress()
    listeners.pictures(pictures)


def test_tensorboard_has_every_number_the_figures_and_the_video(pictures, tmp_path):
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    with make_listeners(tmp_path / "run", hand_made.config(), 1, tensorboard=True) as listeners:
        tell(listeners, pictures)
    (path,) = (tmp_path / "run").glob("events.out.tfevents*")
    content, found = path.read_bytes(), {}
    while content:  # Records of TensorFlow: length, checksum, content, checksum.
        (length,) = struct.unpack("<Q", content[:8])
        for value in event_pb2.Event.FromString(content[12 : 12 + length]).summary.value:
            found.setdefault(value.tag, []).append(value)
        content = content[16 + length :]
    assert [value.simple_value for value in found["seed_0/train_goal/success_rate"]] == [0.5, 0.5, 1.0, 1.0]
    for picture in pictures:
        (value,) = found[f"figures/{picture.stem}"]
        assert value.image.encoded_image_string == picture.read_bytes()
        assert (value.image.width, value.image.height) == (40, 20)


@pytest.mark.long
def test_weights_and_biases_keeps_numbers_figures_and_the_video_offline(pictures, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    for name, value in {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "HOME": str(tmp_path)}.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "runs").mkdir()
    with make_listeners(tmp_path / "runs" / "mine", hand_made.config(), 2, wandb="project") as listeners:
        tell(listeners, pictures, seeds=(3, 4))
    folders = sorted((tmp_path / "runs" / "wandb").glob("offline-run-*"))
    logs = [log for folder in folders for log in folder.glob("*.wandb")]
    assert len(logs) == 2  # A run for each seed, in the group of the folder.
    for _ in range(300):  # Its service writes the last of it when the runs are over.
        written = [log.read_bytes() for log in logs]
        if any(b"episode" in text for text in written) and all(b"mine-seed-" in text for text in written):
            break
        time.sleep(0.1)
    for seed in (3, 4):
        (own,) = (log.read_bytes() for log in logs if f"mine-seed-{seed}".encode() in log.read_bytes())
        assert b"train_goal/success_rate" in own and own.count(b"mine") > own.count(b"mine-seed-")
        assert b'"learning_rate"' in own  # The whole configuration, to filter by.
    kept = {path.suffix: path.read_bytes() for folder in folders for path in (folder / "files").glob("media/**/*.*")}
    assert kept == {picture.suffix: picture.read_bytes() for picture in pictures}


def test_weights_and_biases_gets_every_epoch_of_a_chunk_at_its_step(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    logged = []

    def init(config, name, **_):
        assert config["method"] == method_title(hand_made.config()) and config["hyper"]["learning_rate"] > 0
        return types.SimpleNamespace(
            log=lambda numbers, step: logged.append((config["seed"], step, sorted(numbers))),
            finish=lambda: logged.append((config["seed"], "finished")),
        )

    monkeypatch.setattr(wandb, "init", init)
    epochs = [WATCHED | {"seed": seed, "epoch": epoch} for epoch in (1, 2) for seed in (0, 1)]
    evaluations = [{"seed": seed, "epoch": 2, "success": 0.5} for seed in (0, 1)]
    with make_listeners(tmp_path / "run", hand_made.config(), 2, wandb="project") as listeners:
        for listen in listeners.progress:
            listen(Progress(2, 2, 1.0, 1.0, 1000.0, 7.0, epochs, evaluations))
    first = sorted(WATCHED)
    last = [*first, "success"]
    assert logged[:4] == [(0, 1, first), (1, 1, first), (0, 2, last), (1, 2, last)]
    assert logged[4:] == [(0, "finished"), (1, "finished")]


@pytest.mark.parametrize(
    ("key", "reason"), [("", "No API key configured"), ("short", "API key must have 40. characters")]
)
def test_a_missing_login_is_named_before_anything_is_run(key, reason, tmp_path, monkeypatch):
    """Where nobody can be asked for a key, as pytest's stdin is no terminal."""
    wandb = pytest.importorskip("wandb")
    wandb.teardown()  # It reads the variables once a process.
    for name in ("WANDB_MODE", "WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE"):
        monkeypatch.delenv(name, raising=False)
    if key:
        monkeypatch.setenv("WANDB_API_KEY", key)
    for name in ("HOME", "NETRC", "WANDB_CONFIG_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    with (
        pytest.raises(UserError, match=rf"wandb = 'project': .*{reason}.*`wandb login`.* WANDB_MODE=offline"),
        make_listeners(tmp_path / "run", hand_made.config(), 1, wandb="project"),
    ):
        pass
    wandb.teardown()
    assert not (tmp_path / "run").exists() and not (tmp_path / "wandb").exists()


def test_listeners_that_are_not_installed_are_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with (
        pytest.raises(UserError, match="pip install wandb"),
        make_listeners(tmp_path, hand_made.config(), 1, wandb="x"),
    ):
        pass
