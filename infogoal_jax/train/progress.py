"""How far a command is: a moving bar on a terminal, lines in a log file; both say how long it has taken."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

SIGN_OF_LIFE = 60.0
"""Seconds after which a log file gets another line while a program is compiled."""
COMPILING = "compiling, some minutes the first time"


class ProgressLine:
    """What is shown of a run. words: what is run; total: its epochs."""

    def __init__(self, words: str, total: int, bar: Progress):
        self.words, self.total, self.bar, self.started = words, total, bar, time.monotonic()
        self.line = bar.add_task(words, total=total, numbers="preparing")
        self.compiled = threading.Event()

    def compiling(self) -> None:
        """Say that the program is compiled now, and in a log file once a minute that it still is."""
        self.bar.update(self.line, numbers=COMPILING)
        if not self.bar.console.is_terminal:
            self.print(f"{self.words}: {COMPILING}")
            threading.Thread(target=self.repeat, daemon=True).start()

    def repeat(self) -> None:
        """Say that the program is still being compiled until it is not."""
        while not self.compiled.wait(SIGN_OF_LIFE):
            self.print(f"{self.words}: still compiling, {self.elapsed()}")

    def advance(self, epoch: int, numbers: str) -> None:
        """Show that so many epochs are done, and what came of them."""
        self.compiled.set()
        self.bar.update(self.line, completed=epoch, numbers=numbers)
        if not self.bar.console.is_terminal:
            self.print(f"epoch {epoch}/{self.total}  {self.elapsed()}  {numbers}")

    def elapsed(self) -> str:
        """Hours, minutes and seconds since the start."""
        minutes, seconds = divmod(int(time.monotonic() - self.started), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"

    def print(self, words: str) -> None:
        """Write a line to a log file."""
        self.bar.console.print(words, soft_wrap=True, highlight=False, markup=False)


@contextmanager
def progress_line(words: str, total: int) -> Iterator[ProgressLine]:
    """What shows how far a run is, until the end of the block."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[numbers]}"),
        console=(console := Console()),
        refresh_per_second=2,
        disable=not console.is_terminal,
    )
    line = ProgressLine(words, total, bar)
    try:
        with bar:
            yield line
    finally:
        line.compiled.set()
