"""What is shown of a run while it runs: one line on a terminal or in a notebook, and lines in a log file.

A line has the bar, how many epochs are done, the time left and the success, at any width; what is known beside them is
shown where there is room. Before the first epoch it says in which phase the run is.
"""

import contextlib
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.text import Text

SIGN_OF_LIFE = 60.0
"""Seconds after which a log file gets another line while a program is compiled."""
REFRESHED = 0.5
"""Seconds between two pictures of the line on a terminal or in a notebook."""
COMPILING = "some minutes the first time"
NARROWEST, WIDEST = 8, 40
"""Letters of the bar. It is left out where there is less room, and what is not needed goes first."""


def clock(seconds: float) -> str:
    """A duration as 1:05, or 2:01:05."""
    minutes, seconds = divmod(max(int(seconds), 0), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}" if minutes >= 60 else f"{minutes}:{seconds:02d}"


def short_time(seconds: float) -> str:
    """A duration in words: 0.4 s, 12 s, or 2:05."""
    return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s" if seconds < 99.5 else clock(seconds)


def say(console: Console, text: str, label: str = "", style: str | None = None) -> None:
    """Print a text, and what it is about before it. On a terminal lines are broken between words, below the text's
    beginning; a word that is longer than a line, such as a path, stays whole. In a file each stays one line."""
    line = f"{label:<11} {text}" if label else text
    if console.is_terminal:
        indent = " " * 12 if label else ""
        line = "\n".join(
            textwrap.fill(part, console.width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
            for part in line.splitlines()
        )
    console.print(line, style=style, soft_wrap=True, highlight=False, markup=False)


class ProgressLine:
    """What is shown of a run, or of several programs that are trained one after another.

    words: what is run; total: epochs, of all programs; console: where; say: prints a line, where several programs share
    a log: each line then begins with the words.

    Phases follow each other: loading, tracing, compiling, training. `times` has the seconds of those that are over.
    """

    def __init__(self, words: str, total: int, console: Console | None, say: Callable[[str], None] | None = None):
        self.words, self.total, self.console, self.say = words, total, console, say
        self.started = time.monotonic()
        self.left: float | None = None
        self.told = 0.0  # When the last numbers came.
        self.over = threading.Event()
        self.begin(words)

    def begin(self, words: str, before: int = 0) -> None:
        """A program begins. before: epochs of other programs that are done."""
        self.words, self.before = words, before
        self.since = time.monotonic()
        self.times: dict[str, float] = {}
        self.name = "loading"  # Modules at first.
        self.epoch = self.first = before
        self.numbers, self.rates = "", ""
        self.over.clear()

    @property
    def is_live(self) -> bool:
        """Whether one line is drawn again and again; False: lines of a log."""
        return self.console is not None and (self.console.is_terminal or self.console.is_jupyter)

    def phase(self, name: str, epoch: int = 0) -> None:
        """Begin a phase, which ends the one before. epoch: how many of the program's are done."""
        now = time.monotonic()
        if self.name:
            self.times[self.name] = self.times.get(self.name, 0.0) + now - self.since
        self.name, self.since = name, now
        self.epoch = self.first = self.before + epoch
        if name == "training":
            self.over.set()
            if self.times:
                self.print(self.phases_in_words())
        elif name == "compiling" and not self.is_live:
            self.print(f"{self.words}: compiling, {COMPILING}")
            threading.Thread(target=self.repeat, daemon=True).start()

    def compiling(self) -> None:
        """The program is compiled now."""
        self.phase("compiling", self.epoch - self.before)

    def repeat(self) -> None:
        """Say that the program is still being compiled until it is not."""
        while not self.over.wait(SIGN_OF_LIFE):
            if not self.over.is_set():  # It may have been set while the line was being made.
                self.print(f"{self.words}: still compiling, {self.elapsed()}")

    def advance(self, epoch: int, numbers: str, rates: str = "") -> None:
        """Show that so many epochs of the program are done and what came of them, numbers that matter and rates that
        are shown where there is room."""
        if self.name != "training":
            self.phase("training", self.epoch - self.before)
        self.told = time.monotonic()
        self.epoch, self.numbers, self.rates = self.before + epoch, numbers, rates
        done = self.epoch - self.first
        self.left = (self.total - self.epoch) * (self.told - self.since) / done if done > 0 else None
        if not self.is_live:
            left = f"{clock(self.left)} left  " if self.left else ""
            shown = f"{numbers}  {rates}".rstrip()
            self.print(f"epoch {self.epoch}/{self.total}  {self.elapsed()}  {left}{shown}")

    def finish(self) -> None:
        """End the last phase."""
        self.over.set()
        if self.name:
            self.times[self.name] = self.times.get(self.name, 0.0) + time.monotonic() - self.since
            self.name = ""

    def elapsed(self) -> str:
        return clock(time.monotonic() - self.started)

    def phases_in_words(self) -> str:
        """What each phase so far took."""
        return ", ".join(f"{name} {short_time(seconds)}" for name, seconds in self.times.items())

    def print(self, words: str) -> None:
        """Write a line, above the one that moves."""
        if self.say is not None:
            self.say(words if words.startswith(self.words) else f"{self.words}: {words}")
        elif self.console.is_jupyter:
            print(words)
        else:
            say(self.console, words)

    def of_width(self, width: int) -> str:
        """The line in so many letters. Count, time left and numbers come first, then the bar, then the rest."""
        now = time.monotonic()
        needed = [f"{self.epoch}/{self.total}"]
        if self.left is not None and self.epoch < self.total:
            needed.append(f"{clock(self.left - (now - self.told))} left")
        if self.name in ("training", ""):
            needed += filter(None, [self.numbers or self.name])
            rest = [self.elapsed(), *filter(None, [self.rates])]
        else:
            needed.append(f"{self.name} {clock(now - self.since)}")
            rest = [COMPILING] * (self.name == "compiling") + [self.phases_in_words()] * bool(self.times)
        room = width - len("  ".join(needed))
        for words in rest:
            if room - 2 - len(words) >= NARROWEST + 2:
                needed.append(words)
                room -= 2 + len(words)
        length = min(room - 2, WIDEST)
        if length >= NARROWEST:
            filled = length * self.epoch // max(self.total, 1)
            needed.insert(0, "━" * filled + "─" * (length - filled))
        line = "  ".join(needed)
        return line if len(line) <= width else line[: max(width - 1, 0)] + "…"

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self.of_width(options.max_width), no_wrap=True, overflow="crop")


@contextmanager
def progress_line(words: str, total: int) -> Iterator[ProgressLine]:
    """What shows how far a run is, until the end of the block."""
    line = ProgressLine(words, total, Console())
    with contextlib.ExitStack() as showing:
        showing.callback(line.finish)
        if line.is_live:
            line.print(words)
            showing.enter_context(moving(line))
        yield line


def moving(line: ProgressLine) -> contextlib.AbstractContextManager[None]:
    """Draw a live line again and again, until the end of the block."""
    return notebook_line(line) if line.console.is_jupyter else on_terminal(line)


@contextmanager
def on_terminal(line: ProgressLine) -> Iterator[None]:
    """Draw the line again and again at the lower end of the terminal."""
    with Live(line, console=line.console, refresh_per_second=1 / REFRESHED):
        yield


@contextmanager
def notebook_line(line: ProgressLine) -> Iterator[None]:
    """Draw the line again and again below the cell of a notebook, by what IPython has itself: no widgets."""
    from IPython.display import display

    shown, over = display(Plain(line), display_id=True), threading.Event()

    def redraw() -> None:
        while not over.wait(REFRESHED):
            shown.update(Plain(line))

    thread = threading.Thread(target=redraw, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        shown.update(Plain(line))


class Plain:
    """A line for IPython: text alone, of a width that a notebook's page has."""

    WIDTH = 80

    def __init__(self, line: ProgressLine):
        self.text = line.of_width(self.WIDTH)

    def __repr__(self) -> str:
        return self.text


@contextmanager
def working_on(words: str, console: Console | None = None) -> Iterator[None]:
    """Say on a terminal what is being done, with a clock; on leaving it is gone, and a line says how long it took."""
    console, started = console or Console(), time.monotonic()
    with console.status(words) if console.is_terminal else contextlib.nullcontext():
        yield
    console.print(f"{words:<11} {short_time(time.monotonic() - started)}", highlight=False, markup=False)
