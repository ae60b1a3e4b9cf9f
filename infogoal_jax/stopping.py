"""Ctrl-C, TERM, HUP and USR1: asked once, a command stops where nothing is lost; asked twice, it stops at once.

One request may come as several signals: `timeout` sends TERM to the command and to its group, and a shell passes on
what its group got already. What follows within `ECHO` seconds is the same request.

A process that stops at once, as a killed one, leaves files that are whole: they are written beside and renamed. What
was being written beside goes with `temporary`.
"""

import contextlib
import os
import shutil
import signal
import stat
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
"""What asks to stop: Ctrl-C, the system or a scheduler, a closed terminal, a scheduler before its limit of time."""
STATUS = 130
"""Exit status of a command that was stopped."""
ECHO = 0.5
"""Seconds after a signal that counted within which others ask for nothing new."""
NOTHING = "no file is half written"
temporaries: set[Path] = set()
"""Files and folders that are there while something is done, and must not stay."""


class Stopped(KeyboardInterrupt):
    """A command was asked to stop, and stops. Its text says what is on disk and how to go on."""


class StopRequest:
    """Whether the command was asked to stop.

    advice: what is on disk and how to go on, if it stopped now; finishing: what a loop that looks at `requested`
    finishes before it stops by itself, or empty where there is no such loop.
    """

    def __init__(self, at_once: Callable[["StopRequest"], None]):
        self.advice, self.finishing, self.requested, self.at_once = NOTHING, "", False, at_once
        self.counted = -float("inf")

    def __call__(self, number: int, frame) -> None:
        """Handle a signal."""
        if number == signal.SIGHUP:
            forget_terminal()
        now = time.monotonic()
        if now - self.counted < ECHO:
            return
        self.counted = now
        if self.requested or not self.finishing:
            self.requested = True
            self.at_once(self)
        else:
            self.requested = True
            say(f"Stopping after {self.finishing}. Press Ctrl-C again to stop at once.")

    def check(self) -> None:
        """Raise `Stopped` if the command was asked to stop."""
        if self.requested:
            raise Stopped(self.advice)


watching: list[StopRequest] = []
"""The request of this process, while there is one."""


@contextlib.contextmanager
def stop_on_signal(at_once: Callable[[StopRequest], None] | None = None) -> Iterator[StopRequest]:
    """Turn signals into a request. A nested call gives the outer request; outside of the main thread no signal arrives.

    at_once: what is done where no loop stops by itself, and at a second signal; None: the first is only noted, the
    second raises `Stopped`. Signals that are ignored, as `nohup` has it, stay so.
    """
    if watching:
        yield watching[0]
        return
    request, before = StopRequest(at_once or note_then_raise()), {}
    try:
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, request)
    except ValueError:  # Not the main thread: Python keeps signals there.
        yield request
        return
    watching.append(request)
    try:
        yield request
    finally:
        watching.remove(request)
        for number, handler in before.items():
            signal.signal(number, handler)


def note_then_raise() -> Callable[[StopRequest], None]:
    """For calls from Python, the second signal alone raises: the library that runs at the moment may swallow an
    exception."""
    noted = []

    def at_once(request: StopRequest) -> None:
        if noted or request.finishing:
            raise Stopped(request.advice)
        noted.append(True)
        say("Stopping as soon as this step is done. Press Ctrl-C again to stop at once.")

    return at_once


def leave(request: StopRequest) -> None:
    """End the process, wherever its threads are, and say what is on disk."""
    say(f"infogoal: stopped; {request.advice}")
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        if sys.stdout.isatty():
            os.write(1, b"\x1b[?25h")  # A progress bar hides the cursor.
    with contextlib.suppress(OSError), open(os.devnull, "w") as nowhere:
        for stream in (1, 2):  # What another thread misses from now on is no news.
            os.dup2(nowhere.fileno(), stream)
    remove_temporaries()
    os._exit(STATUS)


def say(words: str) -> None:
    """Write a line to stderr, also while another thread is writing there; nothing if nobody can read it."""
    with contextlib.suppress(OSError):
        os.write(2, f"\n{at_words(words)}\n".encode())


def forget_terminal() -> None:
    """Discard what is written to a terminal that was closed: it would be an error."""
    with open(os.devnull, "w") as nowhere:
        for stream in (1, 2):
            with contextlib.suppress(OSError):
                if stat.S_ISCHR(os.fstat(stream).st_mode):  # A closed terminal says that it is none.
                    os.dup2(nowhere.fileno(), stream)


@contextlib.contextmanager
def temporary(path: Path) -> Iterator[None]:
    """Delete a file or a folder at the end of the block, unless it was renamed by then."""
    temporaries.add(path)
    try:
        yield
    finally:
        remove(path)
        temporaries.discard(path)


def remove(path: Path) -> None:
    """Delete a file, or a folder with its content. Errors are passed over: they would hide the one that led here."""
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            gone = path.rename(path.with_name(f"{path.name}.gone"))  # Another thread may still be writing into it.
            shutil.rmtree(gone, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def remove_temporaries() -> None:
    """Delete all that `temporary` guards, for a process that ends at once."""
    for path in list(temporaries):
        remove(path)


def at_words(line: str) -> str:
    """The line as it is; for errors on a terminal that is narrower, broken between words."""
    if sys.stderr is None or sys.stderr.closed or not sys.stderr.isatty():
        return line
    width = shutil.get_terminal_size().columns
    return textwrap.fill(line, width, break_long_words=False, break_on_hyphens=False, replace_whitespace=False)
