"""Goal images of Fetch are drawn again as they are shipped, where the renderer and the scene are installed; where they
are not, one line says what to install."""

import importlib.util
import sys

import numpy as np
import pytest

from infogoal_jax import presets
from infogoal_jax.cli.main import main
from infogoal_jax.data.goal_images import GRID, TEST, TRAIN
from infogoal_jax.errors import UserError
from infogoal_paper import goal_rendering


def test_without_gymnasium_robotics_the_builder_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)  # As if it were not installed, where it is.
    with pytest.raises(
        UserError, match=r"gymnasium-robotics = not installed.*pip install 'infogoal-jax\[goal-images\]'"
    ):
        goal_rendering.build("fetch_push")
    assert main(["reproduce", "goal-images", str(tmp_path / "banks")]) == 2
    assert "gymnasium-robotics==1.4.2" in capsys.readouterr().err
    assert not (tmp_path / "banks").exists()


def pretend_scene(folder, files: tuple[str, ...], monkeypatch) -> None:
    """An installed package of that name with these scenes, as far as the builder looks before it draws."""
    monkeypatch.delitem(sys.modules, "gymnasium_robotics", raising=False)
    scenes = folder / "gymnasium_robotics" / "envs" / "assets" / "fetch"
    scenes.mkdir(parents=True)
    (folder / "gymnasium_robotics" / "__init__.py").write_text("raise ImportError('the builder must not import this')")
    for name in files:
        (scenes / name).write_text("<mujoco/>")
    monkeypatch.syspath_prepend(folder)


def test_a_package_without_the_scene_is_named(monkeypatch, tmp_path):
    pretend_scene(tmp_path, ("reach.xml",), monkeypatch)
    with pytest.raises(UserError, match=r"no file push\.xml.*gymnasium-robotics==1\.4\.2"):
        goal_rendering.build("fetch_push")


def test_without_opengl_the_builder_says_what_to_install(monkeypatch, tmp_path):
    pretend_scene(tmp_path, ("push.xml",), monkeypatch)
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    with pytest.raises(
        UserError, match="MUJOCO_GL = 'nonsense': MuJoCo could not open OpenGL .*MUJOCO_GL=egl.*libosmesa6"
    ):
        goal_rendering.build("fetch_push")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("--tasks fetch_push", "push.npz"),
        ("--tasks fetch_slide", "fetch_slide"),
        ("--tasks", "tasks: no value follows"),
        ("--seed -1 --tasks fetch_reach", "seed = -1"),
    ],
)
def test_the_command_refuses_before_it_draws(arguments, expected, monkeypatch, tmp_path, capsys):
    pretend_scene(tmp_path / "package", ("reach.xml", "push.xml"), monkeypatch)
    (tmp_path / "fetch_push.npz").write_text("kept")
    assert main(["reproduce", "goal-images", str(tmp_path), *arguments.split()]) == 2
    assert expected in capsys.readouterr().err
    assert (tmp_path / "fetch_push.npz").read_text() == "kept"


@pytest.mark.parametrize("name", presets.FETCH_TASKS)
def test_drawing_again_gives_the_shipped_images(banks, name, differing_pixels):
    """Up to what another OpenGL does differently at edges."""
    if importlib.util.find_spec("gymnasium_robotics") is None:
        pytest.skip("gymnasium-robotics is not installed; pip install 'infogoal-jax[goal-images]'")
    try:
        goal_rendering.check_opengl()
    except UserError as error:
        pytest.skip(str(error))
    bank = banks[name]
    rows = [0, bank.rows(GRID)[-1], *bank.rows(TRAIN)[:2], bank.rows(TEST)[-1]]
    with goal_rendering.studio(name) as take:
        for row in rows:
            image, error = take(bank.positions[row])
            assert error < 0.005
            assert np.abs(image.astype(int) - bank.images[row]).mean() < 1.0
            assert differing_pixels(image, bank.images[row]) < 40
