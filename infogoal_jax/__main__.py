"""`python -m infogoal_jax` and `infogoal`: where the command begins.

Signals are taken care of before anything is imported that takes long. The command runs in a thread of its own and the
main thread waits for signals: Python hands them to the main thread alone, and there an exception could be swallowed by
whatever library is called at the moment.
"""

import contextlib
import gc
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


def main() -> int:
    """Run the command that the process was started with. Returns its exit status."""
    gc.set_threshold(*GARBAGE)
    status: list[int] = []

    def command() -> None:
        from infogoal_jax.cli.main import main

        try:
            status.append(main())
        except SystemExit as stopped:  # After a help, and for a flag that is none.
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
    gc.freeze()  # Or Python would look for cycles once more, among all that was imported: a tenth of a second.
    return status[0] if status else 1  # Its traceback was printed.


def flush() -> None:
    """Write out what was printed. Whoever read it may have gone, as `head` does after ten lines."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        with contextlib.suppress(OSError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)


if __name__ == "__main__":
    sys.exit(main())
