"""The one error a user is meant to read: what was given, why it cannot be used, and what would be right; and what it is
worded with."""

import contextlib
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

LONGEST = 200
"""Characters of a value in an error."""


class UserError(ValueError):
    """A mistake in what the user gave: a field, a file, a name. The command line prints its text alone."""


def require(condition: bool, field: str, value: object, remedy: str) -> None:
    """Raise `UserError` naming the field, its value and the remedy, unless the condition holds."""
    if not condition:
        raise UserError(f"{field} = {shown(value)}: {remedy}")


def require_known(field: str, name: Any, known: Iterable[str], words: str, more: str = "") -> None:
    """Raise `UserError` for a name that is not among the known ones: these words, the nearest one, all of them, and
    more."""
    names = list(known)
    if not isinstance(name, str) or name not in names:  # The nearest is looked for then alone: it takes a while.
        remedy = "; ".join(filter(None, (f"Known: {', '.join(names)}", more)))
        raise UserError(f"{field} = {shown(name)}: {words}.{nearest(str(name), names)} {remedy}")


@contextlib.contextmanager
def renamed(**fields: str) -> Iterator[None]:
    """Inside, an error about one of these fields names in its place the argument that a user gave for it."""
    try:
        yield
    except UserError as error:
        said = str(error)
        field = re.match(r"\w+\b(?!\.)|", said)[0]  # Not the `env` of `env.id`.
        if field not in fields:
            raise
        raise UserError(fields[field] + said.removeprefix(field)) from error


def shown(value: object) -> str:
    """A value as it is written in Python, in one line, cut where it is long."""
    text = re.sub(r"\s*\n\s*", " ", repr(value))
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def reason(error: BaseException) -> str:
    """What an error of somebody else's code says: `ValueError: ` and the first line of its text, if it has one."""
    try:
        words = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    except Exception:  # Its own text fails.
        words = ""
    return f"{type(error).__name__}: {words}" if words else type(error).__name__


def typed(path: object) -> str:
    """A path as it is typed into a shell."""
    return shlex.quote(str(path))


def a(noun: str) -> str:
    """`an agent`, `a learner`."""
    return f"{'an' if noun[0].lower() in 'aeiou' else 'a'} {noun}"


def counted(count: int, noun: str) -> str:
    """`1 error`, `2 errors`."""
    return f"{count} {noun}{'s' * (count != 1)}"


def counted_each(counts: Sequence[int], noun: str) -> str:
    """Of several counts: `2 seeds` where all are 2, else `2 to 5 seeds`."""
    fewest, most = min(counts), max(counts)
    return counted(most, noun) if fewest == most else f"{fewest} to {counted(most, noun)}"


ALIKE, PART = 0.7, 0.8
"""How much of two names has to agree for one to be taken for a slip of the other, from 0 to 1; and what counts for a
part of a name, such as `push` of `fetch_push`, its beginning, or its letters in another order."""


def nearest(name: str, known: list[str]) -> str:
    """`" Did you mean 'x'?"` for the known name that `name` is a slip or a part of, or an empty string: a poor guess is
    worse than none. Dashes before a flag, case and what joins words do not count."""
    import difflib

    def plain(one: str) -> str:
        return re.sub(r"[\W_]+", " ", one).strip().casefold()

    def likeness(one: str) -> tuple[float, float]:
        there = plain(one)
        begins = min(len(given), len(there)) > 2 and (there.startswith(given) or given.startswith(there))
        part = begins or f" {given} " in f" {there} " or sorted(given) == sorted(there)
        ratio = difflib.SequenceMatcher(None, there, given).ratio()
        return max(ratio, PART * part), ratio

    given = plain(name)
    best = max(known, key=likeness, default="") if given else ""
    return f" Did you mean {best!r}?" if best and likeness(best)[0] >= ALIKE else ""
