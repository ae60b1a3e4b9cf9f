"""Where the tests find what they read: numbers of published code, scripts that stand in the pages of docs, what is
printed, and figures that show something."""

import io
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

import hand_made
import numpy as np
import pytest
from matplotlib.image import imread

import infogoal_jax
from infogoal_jax import agents, envs, exploration, imports, learners, presets, relabelling
from infogoal_jax.loading import make_train
from infogoal_jax.report import task_figures

TESTS = Path(__file__).parent
FIXTURES = TESTS / "fixtures"
ROOT = TESTS.parent
DOCS = ROOT / "docs"
TINY = (
    "--num-epochs 2 --epochs-per-evaluation 1 --updates-per-epoch 2 --num-envs 4 --rollout-steps 10 --batch-size 16 "
    "--buffer-steps 100 --evaluation-starts 1 --agent.num-steps 2 --state-encoder.features 16 --agent.hidden 16"
)
"""Flags of a run in a house that takes seconds."""
REGISTRIES = (
    envs.registry,
    presets.registry,
    agents.registry,
    learners.registry,
    relabelling.registry,
    exploration.registry,
    task_figures.registry,
)


def recorded(method: str) -> dict[str, np.ndarray]:
    """The arrays that the code of a method's authors gave, by the names of fixtures/README.md."""
    with np.load(FIXTURES / "authors.npz", allow_pickle=False) as arrays:
        return {name.removeprefix(f"{method}/"): arrays[name] for name in arrays if name.startswith(f"{method}/")}


def assert_relatively_close(found, recorded):
    """To 1e-5 of the largest number recorded."""
    np.testing.assert_allclose(found, recorded, rtol=1e-5, atol=1e-5 * np.abs(recorded).max())


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
def forgotten() -> Iterator[None]:
    """What registers tasks and parts, and imports a user's files, as a process of its own."""
    before = [dict(registry) for registry in REGISTRIES]
    files = dict(imports.imported)
    try:
        yield
    finally:
        for registry, known in zip(REGISTRIES, before, strict=True):
            if dict(registry) != known:
                registry.clear()
                registry.update(known)
        for name in imports.imported.keys() - files.keys():
            sys.modules.pop(Path(name).stem, None)
        imports.imported.clear()
        imports.imported.update(files)


@contextmanager
def run(
    block: str, prepare: Callable[[pytest.MonkeyPatch], None] = lambda patch: None, name_of_module: str = "page"
) -> Iterator[dict]:
    """The names that the block leaves behind, for as long as what it registers is there.

    prepare: sets what is other than it is for a user, while the block runs. name_of_module: `__main__` for what a
    script does on its own.
    """
    names = {"__name__": name_of_module}
    with forgotten():
        with pytest.MonkeyPatch.context() as patch:
            prepare(patch)
            exec(compile(block, "page", "exec"), names)
        yield names


def in_hand_made_rooms(**sizes) -> Callable[[pytest.MonkeyPatch], None]:
    """Presets of these sizes, trained in the hand-made rooms instead of a house, and nothing else changed."""
    load, fields = presets.load, hand_made.sizes(**sizes)

    def prepare(patch: pytest.MonkeyPatch) -> None:
        patch.setattr(presets, "load", lambda task, method, **parts: load(task, method, **parts, **fields))
        patch.setattr(
            infogoal_jax,
            "make_train",
            lambda config, callback=None: make_train(config, hand_made.environment(), callback),
        )

    return prepare


EVERY_TASKS_FIGURES = {
    "learning_curves",
    "beta_and_accuracy",
    "representations",
    "success_by_length",
    "success_by_goal",
}


def printed(show, *arguments) -> str:
    """What a function prints on a terminal of 120 columns."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as stream:
        patch.setenv("COLUMNS", "120")
        show(*arguments)
    return stream.getvalue()


def assert_drawn(paths, folder, names):
    """These figures were drawn, and none is blank."""
    assert {path.stem for path in paths} == names
    for path in paths:
        picture = imread(path)[..., :3]
        assert path.parent == folder / "figures" and min(picture.shape[:2]) > 300
        assert (picture.min(-1) < 0.9).mean() > 0.01, f"{path.name} is blank"
