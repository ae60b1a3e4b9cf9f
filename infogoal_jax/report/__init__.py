"""Tables and figures, made from what a run left on disk."""

import contextlib
import os
import sys


def import_without_display() -> None:
    """Import matplotlib also where MPLBACKEND names what it does not know here, as a notebook's own does outside of it.
    What is drawn in this package needs none; a backend that is usable stays that of the user's pyplot."""
    named = os.environ.get("MPLBACKEND")
    if named is None or "matplotlib" in sys.modules:
        return
    del os.environ["MPLBACKEND"]
    try:
        import matplotlib
    finally:
        os.environ["MPLBACKEND"] = named
    with contextlib.suppress(ValueError):
        matplotlib.rcParams["backend"] = named


import_without_display()
