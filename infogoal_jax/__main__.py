"""`python -m infogoal_jax` and `infogoal`: where the command begins.

Signals are taken care of before anything is imported that takes long. The command runs in a thread of its own and the
main thread waits for signals: Python hands them to the main thread alone, and there an exception could be swallowed by
whatever library is called at the moment.
"""

import contextlib
import gc
import io
import os
import sys
import threading

from infogoal_jax import stopping

STACK = 64 * 2**20
"""Bytes; a thread's own default is too small for deep programs on some platforms."""
LISTENING_SECONDS = 0.2
"""After which the main thread looks for signals at the latest."""
GARBAGE = 50_000, 20, 50
"""Python looks for cycles after so many new objects, not after 700: imports and tracing make millions that stay, which
costs a tenth of the time."""


class Stream(io.FileIO):
    """Standard output or errors. What the system refuses to take, as a full disk does, is lost and `refused` says so:
    the work goes on. A reader that has gone is still an error."""

    refused: OSError | None = None

    def write(self, content) -> int | None:
        """Write these bytes."""
        try:
            return super().write(content)
        except BrokenPipeError:
            raise
        except OSError as error:
            self.refused = error
            redirect(self.fileno())
            return len(content)


def redirect(descriptor: int) -> None:
    """Discard what is written to this file descriptor from now on."""
    with contextlib.suppress(OSError), open(os.devnull, "r+b") as nowhere:
        os.dup2(nowhere.fileno(), descriptor)


def open_streams() -> list[Stream]:
    """Make standard input, output and errors what they can be written to and read from, whatever the process was
    started with: one that is closed (`>&-`) is nowhere, or its number would be that of the next file that is opened.
    Returns output and errors."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # It takes the lowest number that is free.
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115 (it stays)
    streams = []
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        before, stream = getattr(sys, name), Stream(descriptor, "wb", closefd=False)
        words = {"encoding": "utf-8"} if before is None else {"encoding": before.encoding, "errors": before.errors}
        lines = name == "stderr" or stream.isatty() or bool(os.environ.get("PYTHONUNBUFFERED"))
        setattr(sys, name, io.TextIOWrapper(io.BufferedWriter(stream), line_buffering=lines, **words))
        streams.append(stream)
    return streams


def main() -> int:
    """Run the command that the process was started with. Returns its exit status."""
    gc.set_threshold(*GARBAGE)
    os.environ["MPLBACKEND"] = "agg"  # No command shows a window, whatever a notebook around it has set.
    output, _ = open_streams()
    status: list[int] = []

    def command() -> None:
        from infogoal_jax.cli.main import main

        try:
            status.append(main())
        except SystemExit as stopped:  # After a help, and for an unknown flag.
            status.append(stopped.code if isinstance(stopped.code, int) else int(stopped.code is not None))
        except stopping.Stopped as stopped:  # Another process of the run was asked to stop, or this one a while ago.
            stopping.say(f"infogoal: stopped; {stopped}")
            status.append(stopping.STATUS)

    with stopping.stop_on_signal(at_once=stopping.leave):
        threading.stack_size(STACK)
        thread = threading.Thread(target=command, name="command")
        thread.start()
        while thread.is_alive():  # A signal just before an endless wait begins would not be heard until it ends.
            thread.join(LISTENING_SECONDS)
        flush()
    if output.refused is not None:
        stopping.say(f"infogoal: what is printed could not be written ({output.refused.strerror})")
        status = [status[0] or 1] if status else []
    gc.freeze()  # Or Python would look for cycles once more as it ends, among all that was imported, for 0.1 s.
    return status[0] if status else 1  # Its traceback was printed.


def flush() -> None:
    """Write out what was printed. Whoever read it may have gone, as `head` does after ten lines."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        redirect(1)


if __name__ == "__main__":
    sys.exit(main())
