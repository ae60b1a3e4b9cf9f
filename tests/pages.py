"""Scripts that stand in the pages of docs, run as they are: the parts that they register are gone again afterwards."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import hand_made
import pytest
from places import ROOT

import infogoal_jax
from infogoal_jax import presets
from infogoal_jax.train.program import make_train

DOCS = ROOT / "docs"
CHAPTER = r"^## ([^\n]+)\n(.*?)(?=^## |\Z)"


def block_of(page: str) -> str:
    """The one block of Python of a page, or of a chapter of it: PAGE.md#its-title."""
    name, _, chapter = page.partition("#")
    text = (DOCS / name).read_text()
    if chapter:
        chapters = {title.lower().replace(" ", "-"): words for title, words in re.findall(CHAPTER, text, re.M | re.S)}
        text = chapters[chapter]
    (found,) = re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)
    return found


def lines_of(block: str) -> int:
    """How many of its lines are not empty."""
    return len([line for line in block.splitlines() if line.strip()])


@contextmanager
def run(
    block: str, name: str, *registries: dict, prepare: Callable[[pytest.MonkeyPatch], None] = lambda patch: None
) -> Iterator[dict]:
    """The names that the block leaves behind, for as long as what it registers under this name is there.

    prepare: sets what is other than it is for a user, while the block runs.
    """
    names, before = {"__name__": "page"}, [registry.get(name) for registry in registries]
    with pytest.MonkeyPatch.context() as kept:
        for registry in registries:
            kept.setitem(registry, name, None)  # The script sets it.
        with pytest.MonkeyPatch.context() as patch:
            prepare(patch)
            exec(compile(block, "page", "exec"), names)
        yield names
    assert [registry.get(name) for registry in registries] == before


def in_hand_made_rooms(**sizes) -> Callable[[pytest.MonkeyPatch], None]:
    """Presets of these sizes, trained in the hand-made rooms instead of a house, and nothing else changed."""
    load, fields = presets.load, hand_made.sizes(**sizes)

    def prepare(patch: pytest.MonkeyPatch) -> None:
        patch.setattr(presets, "load", lambda task, method, **parts: load(task, method, **parts, **fields))
        patch.setattr(infogoal_jax, "make_train", lambda config: make_train(config, hand_made.environment()))

    return prepare
