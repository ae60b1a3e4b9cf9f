"""Where the tests find what they read, and numbers of published code."""

from pathlib import Path

import numpy as np

TESTS = Path(__file__).parent
FIXTURES = TESTS / "fixtures"
ROOT = TESTS.parent


def recorded(method: str) -> dict[str, np.ndarray]:
    """The arrays that the code of a method's authors gave, by the names of fixtures/README.md."""
    with np.load(FIXTURES / "authors.npz", allow_pickle=False) as arrays:
        return {name.removeprefix(f"{method}/"): arrays[name] for name in arrays if name.startswith(f"{method}/")}
