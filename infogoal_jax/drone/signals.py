"""Signals that end a flight: Ctrl-C, the end of the terminal, a polite kill."""

import signal
import threading


class Interrupted(Exception):  # noqa: N818, it is no error
    """A signal asks the program to end; its text is the signal's name."""


class Signals:
    """Ctrl-C, the end of the terminal and a polite kill. The first raises `Interrupted`; once it lands they are only
    noted.

    A handler may run within any line of the program, so that it neither prints nor writes.
    """

    def __init__(self):
        self.landing, self.names = False, []

    def __enter__(self) -> "Signals":
        numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
        in_main = threading.current_thread() is threading.main_thread()  # Others get no signals.
        self.before = {number: signal.signal(number, self.receive) for number in numbers if in_main}
        return self

    def __exit__(self, *raised) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def receive(self, number: int, frame) -> None:
        """Note a signal, and raise it if it is the first and nothing else ended the flight before."""
        self.names.append(signal.Signals(number).name)
        if not self.landing:
            self.landing = True
            raise Interrupted(self.names[-1])
