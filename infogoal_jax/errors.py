"""The one error a user is meant to read: what was given, why it cannot be used, and what would be right; and what it is
worded with."""

import re
import shlex
from collections.abc import Iterable
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


def nearest(name: str, known: list[str]) -> str:
    """`" Did you mean 'x'?"` for the known name closest to `name`, or an empty string."""
    import difflib

    close = difflib.get_close_matches(name, known, n=1, cutoff=0.4) if name else []
    return f" Did you mean {close[0]!r}?" if close else ""
