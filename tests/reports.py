"""What tests of reports share: what is printed, and figures that show something."""

import io

from matplotlib.image import imread
from rich.console import Console

EVERY_TASKS_FIGURES = {
    "learning_curves",
    "beta_and_accuracy",
    "representations",
    "success_by_length",
    "success_by_goal",
}


def printed(show, *arguments) -> str:
    """What a function prints on a console of its own."""
    console = Console(file=io.StringIO(), width=120)
    show(*arguments, console=console)
    return console.file.getvalue()


def assert_drawn(paths, folder, names):
    """These figures were drawn, and none is blank."""
    assert {path.stem for path in paths} == names
    for path in paths:
        picture = imread(path)[..., :3]
        assert path.parent == folder / "figures" and min(picture.shape[:2]) > 300
        assert (picture.min(-1) < 0.9).mean() > 0.01, f"{path.name} is blank"
