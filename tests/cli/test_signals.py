"""From the first import to the last file a signal stops the command, which says what is on disk and how to go on; a
second one stops it at once."""

import os
import pty
import signal
import subprocess
import sys
import time

import pytest

from infogoal_jax import stopping
from infogoal_jax.stopping import Stopped, stop_on_signal

IMPORTING = """
import sys
from infogoal_jax.cli import entry
from infogoal_jax import stopping
real = stopping.stop_on_signal
print("ready", flush=True)
sys.argv = ["infogoal", "train", "object_search"]
sys.exit(entry.main())
"""
COMMAND = """
import sys, threading, time, types
from infogoal_jax import stopping
from infogoal_jax.cli import entry

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


def test_no_signal_ends_a_flight_before_the_landing():
    """Not even the second one: signals are noted, and the flight lands."""
    wait = """
        from infogoal_jax.drone.envelope import Signals
        with Signals() as signals:
            print("in the air", flush=True)
            [time.sleep(0.01) for _ in iter(lambda: signals.count == 2, True)]
            print("landed", flush=True)
"""
    process = started(COMMAND.format(finishing="", wait=wait))
    assert process.stdout.readline() == "in the air\n"
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    status, printed, _ = ended(process)
    assert (status, printed) == (130, "landed\nfiles are whole\n")


def test_a_second_signal_stops_at_once():
    process = started(COMMAND.format(finishing="this chunk", wait=IN_A_LIBRARY))
    process.send_signal(signal.SIGINT)
    assert process.stderr.readline() + process.stderr.readline() == (
        "\nStopping after this chunk. Press Ctrl-C again to stop at once.\n"
    )
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
        with pytest.raises(Stopped, match="nothing yet"):
            signal.raise_signal(signal.SIGTERM)
    assert "as soon as this step is done" in capfd.readouterr().err and not stopping.watching


def test_a_reader_that_goes_away_is_no_error():
    """`infogoal --help | head -1`."""
    command = f"{sys.executable} -m infogoal_jax --help | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=os.environ)
    assert done.stderr == "" and len(done.stdout.splitlines()) == 1
