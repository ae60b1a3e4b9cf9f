"""What every command has. Its help fits a screen, names what there is, and comes quickly. From the first import to the
last file a signal stops it, and it says what is on disk and how to go on; a second one stops it at once."""

import dataclasses
import errno
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import infogoal_jax
from infogoal_jax import agents, envs, presets, stopping
from infogoal_jax.cli.commands import mistake_of, new_folder
from infogoal_jax.cli.main import commands, main
from infogoal_jax.hyperparameters import floats
from infogoal_jax.presets import load
from infogoal_jax.stopping import Stopped, stop_on_signal

SCREEN = 45
"""Lines."""


@pytest.fixture
def help_of(capsys, monkeypatch):
    """What is printed for these arguments, which ask for a help."""
    monkeypatch.setenv("COLUMNS", "120")

    def printed(arguments: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            main(arguments.split())
        assert stopped.value.code == 0
        return capsys.readouterr().out

    return printed


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("", ["train", "evaluate", "report", "data", "final", "--version"]),
        ("train", [*presets.registry, "--resume"]),
        (
            "train object_search",
            ["--seeds", "--num-epochs", "--method", "--agent", *agents.registry, "--help-all", "default: 100"],
        ),
        ("train fetch_push --method her", ["default: her", "--relabelling", "default: hrac"]),
        ("tune object_search", ["--trials", "--space-seed", "--help-all"]),
        ("data build", ["house", "cube", "shelf"]),
        ("evaluate", ["RUN", "--starts", "default: 50"]),
        ("pretrain fetch_push", ["--seeds", "default: td3", "default: none", "--help-all"]),
    ],
)
def test_help_fits_a_screen_and_names_what_there_is(arguments, expected, help_of):
    text = help_of(f"{arguments} --help")
    assert all(words in text for words in expected) and "--task" not in text
    assert text == help_of(f"{arguments} -h") and len(text.splitlines()) <= SCREEN


def test_the_help_of_all_flags_has_every_field_and_the_interval_of_every_number(help_of):
    text = " ".join(help_of("train object_search --learner vae --agent cql --help-all").replace("│", " ").split())
    config = load("object_search", learner="vae", agent="cql")
    fields = {
        f"{kind}.{field.name}"
        for kind in ("env", "learner", "agent", "state_encoder")
        for field in dataclasses.fields(getattr(config, kind))
    }
    for name in fields:
        assert f"--{name.replace('_', '-')}" in text
    for name, value, number in floats(config.hyper):
        assert f"--hyper.{name.replace('_', '-')} FLOAT" in text
        assert f"(in {number.interval}, default: {value})" in text


def test_a_short_help_has_whole_sentences_and_methods_that_can_be_asked_for(help_of):
    text = " ".join(help_of("train object_search --help").replace("│", " ").split())
    assert "representation learning. (train | held_out | visited | all, default: visited)" in text
    assert f"Table I: {', '.join(presets.METHODS)}." in text


def test_a_task_that_is_registered_later_is_a_subcommand(monkeypatch, help_of):
    monkeypatch.setitem(envs.registry, "mine", envs.registry["object_search"])
    monkeypatch.setitem(
        presets.registry,
        "mine",
        dataclasses.replace(presets.registry["object_search"], description="A task of my own."),
    )
    assert "A task of my own." in help_of("train --help")
    assert "A task of my own." in help_of("train mine --help")


@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_first_help_has_every_command_by_groups(help_of, monkeypatch, width):
    """Those to begin with first, what other packages bring last; within the width of the terminal."""
    monkeypatch.setenv("COLUMNS", str(width))
    lines = help_of("--help").splitlines()
    named = [line.split()[0] for line in lines if re.match(r"  \w", line)]
    assert named[:6] == ["train", "evaluate", "report", "compare", "video", "export"]
    assert sorted(named) == sorted(commands().commands) and named[-1] == "reproduce"
    assert max(map(len, lines)) <= width


WITH_HELP = ("", "train", "train object_search", "tune point_maze", "evaluate", "methods", "data", "data build", "fly")


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("words", WITH_HELP)
def test_no_word_of_a_help_is_broken_by_the_terminal(words, width, help_of, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    lines = help_of(f"{words} --help").splitlines()
    assert len(lines) > 5 and not [line for line in lines if len(line) > width]


def test_help_and_the_version_come_without_jax():
    code = """
import sys
from infogoal_jax.cli.main import commands, main
assert main(["--version"]) == 0
for words in ("", "--help", "train --help", "tune -h", "data --help", "evaluate --help", "methods --help"):
    try:
        main(words.split())
    except SystemExit as stopped:
        assert stopped.code == 0
assert not {"jax", "flax", "numpy", "scipy"} & {*sys.modules}
"""
    assert (
        infogoal_jax.__version__
        in subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    )


IMPORTING = """
import sys
from infogoal_jax import __main__ as entry
from infogoal_jax import stopping
real = stopping.stop_on_signal
print("ready", flush=True)
sys.argv = ["infogoal", "train", "object_search"]
sys.exit(entry.main())
"""
COMMAND = """
import sys, threading, time, types
from infogoal_jax import stopping
from infogoal_jax import __main__ as entry

def command():
    with stopping.stop_on_signal() as stop:
        stop.advice = "a checkpoint of epoch 4; go on with: infogoal train --resume RUN"
        stop.finishing = {finishing!r}
        print("ready", flush=True)
        {wait}
        print("files are whole", flush=True)
        return 130

sys.modules["infogoal_jax.cli.main"] = types.SimpleNamespace(main=command)
sys.exit(entry.main())
"""
IN_A_LIBRARY = "threading.Event().wait(60)"
"""As a compiler does: no Python of ours runs, and an exception would come only after it."""
IN_A_CALLBACK = """
        class Callback:
            def __del__(self):
                time.sleep(60)
        Callback()
"""
"""As jax's callback of the garbage collector: an exception in it is printed and swallowed."""
IN_A_LOOP = "[time.sleep(0.01) for _ in iter(lambda: stop.requested, True)]"
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1]


def started(code: str) -> subprocess.Popen:
    """The code in a process of its own, as soon as it says that it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )
    assert process.stdout.readline() == "ready\n"
    return process


def ended(process: subprocess.Popen) -> tuple[int, str, str]:
    """Exit status, and what was printed from then on."""
    printed, errors = process.communicate(timeout=30)
    return process.returncode, printed, errors


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("wait", [IN_A_LIBRARY, IN_A_CALLBACK], ids=["library", "callback"])
def test_where_nothing_would_be_lost_it_stops_at_once_and_says_how_to_go_on(number, wait):
    process = started(COMMAND.format(finishing="", wait=wait))
    process.send_signal(number)
    status, printed, errors = ended(process)
    assert status == 130 and printed == "" and "Traceback" not in errors
    assert "stopped; a checkpoint of epoch 4; go on with: infogoal train --resume RUN" in errors


def test_while_it_is_imported_too():
    process = started(IMPORTING)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    status, _, errors = ended(process)
    assert status == 130 and "infogoal: stopped; no file is half written" in errors and "Traceback" not in errors


def test_a_folder_that_is_being_written_goes_and_the_thread_that_writes_it_says_nothing(tmp_path):
    wait = f"""
        from infogoal_jax.data import archives
        with archives.new_folder({str(tmp_path / "house")!r}, "path") as beside:
            for number in range(10**6):
                (beside / str(number)).write_bytes(bytes(1000))
"""
    process = started(COMMAND.format(finishing="", wait=wait))
    while not list(tmp_path.glob(".house*/9")):
        assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    status, _, errors = ended(process)
    assert status == 130 and "cannot be written" not in errors and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", SIGNALS)
def test_a_loop_finishes_its_chunk_first(number):
    process = started(COMMAND.format(finishing="this chunk, with a checkpoint", wait=IN_A_LOOP))
    process.send_signal(number)
    status, printed, errors = ended(process)
    assert status == 130 and printed == "files are whole\n" and "Stopping after this chunk, with a checkpoint" in errors


def test_a_signal_that_comes_twice_is_one_request():
    """`timeout` sends TERM to the command and to the command's group; the second must not cut off the checkpoint."""
    wait = f"{IN_A_LOOP}; time.sleep({stopping.ECHO})"
    process = started(COMMAND.format(finishing="this chunk, with a checkpoint", wait=wait))
    process.send_signal(signal.SIGTERM)
    assert process.stderr.readline() + process.stderr.readline() == (
        "\nStopping after this chunk, with a checkpoint. Press Ctrl-C again to stop at once.\n"
    )
    process.send_signal(signal.SIGTERM)
    assert ended(process) == (130, "files are whole\n", "")


def test_who_presses_again_and_again_is_heard(monkeypatch):
    """However fast: what counts is the time since the first press, not since the last."""
    stopped, clock = [], iter([0.0, 0.4, 0.8])
    monkeypatch.setattr(stopping.time, "monotonic", lambda: next(clock))
    request = stopping.StopRequest(stopped.append)
    request.finishing = "this chunk"
    for _ in range(3):
        request(signal.SIGINT, None)
    assert stopped == [request]


def test_no_signal_ends_a_flight_before_the_landing():
    """Not even the second one: signals are noted, and the flight lands."""
    wait = """
        from infogoal_drone.envelope import Signals
        with Signals() as signals:
            print("in the air", flush=True)
            [time.sleep(0.01) for _ in iter(lambda: signals.count == 2, True)]
            print("landed", flush=True)
"""
    process = started(COMMAND.format(finishing="", wait=wait))
    assert process.stdout.readline() == "in the air\n"
    process.send_signal(signal.SIGINT)
    time.sleep(stopping.ECHO + 0.1)
    process.send_signal(signal.SIGTERM)
    status, printed, _ = ended(process)
    assert (status, printed) == (130, "landed\nfiles are whole\n")


def test_a_second_signal_stops_at_once():
    process = started(COMMAND.format(finishing="this chunk", wait=IN_A_LIBRARY))
    process.send_signal(signal.SIGINT)
    assert process.stderr.readline() + process.stderr.readline() == (
        "\nStopping after this chunk. Press Ctrl-C again to stop at once.\n"
    )
    time.sleep(stopping.ECHO + 0.1)
    process.send_signal(signal.SIGTERM)
    status, printed, errors = ended(process)
    assert status == 130 and printed == "" and "go on with: infogoal train --resume RUN" in errors


def test_a_terminal_that_was_closed_is_no_error():
    """What the loop prints to it goes nowhere, and the files are written."""
    terminal, ours = pty.openpty()
    code = COMMAND.format(finishing="this chunk", wait=f"{IN_A_LOOP}; print('to nobody', flush=True)")
    process = subprocess.Popen([sys.executable, "-c", code], stdout=ours, stderr=ours, env=os.environ)
    os.close(ours)
    seen = b""
    while not seen.endswith(b"\n"):  # The whole line: what is still being written would be an error.
        seen += os.read(terminal, 100)
    os.close(terminal)
    process.send_signal(signal.SIGHUP)
    assert process.wait(timeout=30) == 130


def test_on_a_narrow_terminal_what_a_signal_says_is_broken_between_words():
    terminal, ours = pty.openpty()
    code = COMMAND.format(finishing="this chunk of epochs, with a checkpoint", wait=IN_A_LOOP)
    environment = os.environ | {"COLUMNS": "60"}
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=ours, env=environment)
    os.close(ours)
    assert process.stdout.readline() == b"ready\n"
    process.send_signal(signal.SIGINT)
    seen = b""
    while not seen.endswith(b"at once.\r\n"):
        seen += os.read(terminal, 1000)
    os.close(terminal)
    assert process.communicate(timeout=30)[0] == b"files are whole\n" and process.returncode == 130
    lines = seen.decode().split("\r\n")
    assert max(map(len, lines)) <= 60 and "with a checkpoint. Press Ctrl-C again to stop at once." in " ".join(lines)


def test_signals_that_are_ignored_stay_so():
    """As `nohup` has it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signal() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.requested
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_from_python_the_first_is_noted_and_the_second_raises(capfd):
    with stop_on_signal() as stop:
        stop.advice = "nothing yet"
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(Stopped, match="nothing yet"):
            stop.check()
        signal.raise_signal(signal.SIGTERM)  # The same request, passed on.
        time.sleep(stopping.ECHO + 0.1)
        with pytest.raises(Stopped, match="nothing yet"):
            signal.raise_signal(signal.SIGTERM)
    assert "as soon as this step is done" in capfd.readouterr().err and not stopping.watching


def test_a_reader_that_goes_away_is_no_error():
    """`infogoal --help | head -1`."""
    command = f"{sys.executable} -m infogoal_jax --help | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=os.environ)
    assert done.stderr == "" and len(done.stdout.splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "status", "to"),
    [
        ("train --help", 0, "/dev/full"),
        pytest.param("train --help", 0, "&-", marks=pytest.mark.long),
        pytest.param("nonsense", 2, "/dev/full", marks=pytest.mark.long),
        ("nonsense", 2, "&-"),
    ],
)
def test_output_that_nobody_takes_is_said_in_a_line(words, status, to):
    """On a disk that is full the command has failed, as those of a shell have; what is closed was not wanted. Errors
    too may be closed, and all three together."""
    lost = status or int(to == "/dev/full")
    for more, said in (("", True), (" 2>&- <&-", False), (" 2>/dev/full", False)):
        command = f"{sys.executable} -m infogoal_jax {words} >{to}{more}"
        done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=os.environ)
        assert (done.returncode, done.stdout) == (lost, ""), command
        assert "Traceback" not in done.stderr and done.stderr.strip().count("\n") == 0
        assert bool(done.stderr) == (said and lost > 0)


def test_what_is_closed_is_no_file_of_the_run(tmp_path):
    """A file that is opened next would have the number of standard output, and what is printed would stand in it."""
    code = (
        "import sys, types; from infogoal_jax import __main__ as entry\n"
        "def command():\n"
        f"    with open({str(tmp_path / 'file')!r}, 'w') as file: print('printed', flush=True); file.write('written')\n"
        "    return 0\n"
        "sys.modules['infogoal_jax.cli.main'] = types.SimpleNamespace(main=command); sys.exit(entry.main())"
    )
    command = f"{sys.executable} -c {shlex.quote(code)} >&- 2>&-"
    assert subprocess.run(["bash", "-c", command], env=os.environ).returncode == 0
    assert (tmp_path / "file").read_text() == "written"


@pytest.mark.parametrize("platforms", ["cuda", pytest.param("nowhere", marks=pytest.mark.long)])
def test_devices_that_are_not_there_are_named_with_the_extra(platforms):
    code = "import sys, jax; from infogoal_jax.cli import main as cli\n"
    code += "cli.run = lambda arguments: jax.devices()\nsys.exit(cli.main([]))"
    environment = os.environ | {"JAX_PLATFORMS": platforms}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 2 and f"JAX_PLATFORMS = '{platforms}': jax starts no such device" in done.stderr
    assert len(done.stderr.splitlines()) == 1 and ("infogoal-jax[cuda]" in done.stderr) == (platforms == "cuda")


BACKENDS = ["module://matplotlib_inline.backend_inline", "inline", "module://nowhere", "no_such", "tkagg", "qtagg"]


@pytest.mark.long
@pytest.mark.parametrize("backend", BACKENDS)
def test_figures_are_drawn_whatever_backend_is_set(backend, tmp_path):
    """By a script; the command sets its own."""
    code = "from infogoal_jax.report import canvas\nfrom pathlib import Path\nimport os\n"
    code += "figure = canvas.empty_figure('a', (), (2, 2)); figure.add_subplot().plot([1, 2])\n"
    code += "[canvas.save(figure, Path(f'figure.{name}')) for name in canvas.FORMATS]\n"
    code += f"assert os.environ['MPLBACKEND'] == {backend!r}"
    environment = os.environ | {"MPLBACKEND": backend}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, env=environment)
    assert {path.suffix for path in tmp_path.iterdir()} == {".png", ".pdf", ".svg"}


def test_processes_of_one_second_have_folders_of_their_own(monkeypatch):
    monkeypatch.setattr(time, "strftime", lambda words: "20261127-120000")
    folders = {new_folder("object_search", "infogoal") for _ in range(1000)}
    assert len(folders) == 1000
    assert all(path.parent == Path("runs") and "infogoal-20261127-120000-" in path.name for path in folders)


def test_what_the_system_refuses_is_a_mistake_only_where_the_path_was_given():
    words = ["train", "object_search", "--out", "runs/a", "--env.dataset=house"]
    refused = {name: OSError(errno.EACCES, "Permission denied", name) for name in ("runs/a/x", "house", "runs/ab")}
    assert str(mistake_of(refused["runs/a/x"], words)).startswith("out = 'runs/a': Permission denied; give a path that")
    assert str(mistake_of(refused["house"], words)).startswith("env.dataset = 'house'")
    assert mistake_of(refused["runs/ab"], words) is None and mistake_of(OSError("no path"), words) is None
