"""Signals that end a flight: Ctrl-C, the end of the terminal, a polite kill."""

import contextlib

from infogoal_jax import stopping


class Interrupted(Exception):  # noqa: N818, it is no error
    """A signal asks the program to land."""


class Signals:
    """Within, every signal that asks the command to stop is noted and does nothing else: not even the second one may
    end a program whose drone is in the air. The flight looks at `count` wherever it waits."""

    def __init__(self):
        self.count, self.landing = 0, False

    def __enter__(self) -> "Signals":
        self.stack = contextlib.ExitStack()
        self.request = self.stack.enter_context(stopping.stop_on_signal(at_once=self.note))
        self.before = self.request.at_once, self.request.finishing
        self.request.at_once, self.request.finishing = self.note, ""
        return self

    def __exit__(self, *raised) -> None:
        self.request.at_once, self.request.finishing = self.before
        self.stack.close()

    def note(self, request: stopping.StopRequest) -> None:
        """Count a signal."""
        self.count += 1
        stopping.say("Landing. The propellers still turn.")

    def asked(self) -> bool:
        """Whether a signal came and the landing has not begun: what is waited for is not worth it any more."""
        return self.count > 0 and not self.landing

    def check(self) -> None:
        """Raise `Interrupted` if a signal came and the landing has not begun."""
        if self.asked():
            raise Interrupted
