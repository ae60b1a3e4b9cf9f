"""Backgrounds corrupt goal images as the paper says; training and test never share one; a damaged or missing source is
named, never half used."""

import functools
import importlib.util
import sys
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made_frames import write_cifar10
from places import ROOT

from infogoal_jax import goals
from infogoal_jax.data import backgrounds
from infogoal_jax.errors import UserError

sys.path.insert(0, str(ROOT / "tools"))
import build_backgrounds as photographs

pytestmark = pytest.mark.usefixtures("nothing_of_the_users")


def images(*shape):
    return np.random.default_rng(3).integers(0, 256, (*shape, 8, 8, 3), np.uint8)


def test_weight_zero_is_the_image_and_one_the_background():
    image, background = images(2, 5)
    np.testing.assert_array_equal(goals.corrupt(image, background, 0.0), image)
    np.testing.assert_array_equal(goals.corrupt(image, background, 1.0), background)


@pytest.mark.parametrize("weight", [0.1, 0.2, 0.4, 0.8])
def test_between_them_the_mixture_is_linear(weight):
    image, background = images(2, 5)
    mixed = goals.corrupt(image, background, weight)
    assert mixed.dtype == jnp.uint8
    np.testing.assert_allclose(mixed, (1 - weight) * image.astype(float) + weight * background, atol=0.5001)


def test_corruption_is_the_same_jitted_over_images_and_weights():
    image, background = images(2, 5)
    weights = jnp.array([0.0, 0.1, 0.4, 0.8, 1.0])
    together = jax.jit(jax.vmap(goals.corrupt))(image, background, weights)
    for row, weight in enumerate(weights):
        np.testing.assert_allclose(
            together[row].astype(int), goals.corrupt(image[row], background[row], weight).astype(int), atol=1
        )


def test_backgrounds_are_drawn_from_all_of_the_bank():
    bank = jnp.arange(6, dtype=jnp.uint8)[:, None, None, None] * jnp.ones((8, 8, 3), jnp.uint8)
    drawn = jax.jit(functools.partial(goals.draw_backgrounds, shape=(20, 10)))(jax.random.key(0), bank)
    assert drawn.shape == (20, 10, 8, 8, 3) and drawn.dtype == jnp.uint8
    assert set(np.unique(drawn)) == set(range(6))
    np.testing.assert_array_equal(drawn, np.broadcast_to(drawn[..., :1, :1, :1], drawn.shape))


def test_shipped_crops_call_themselves_what_they_are():
    shipped = backgrounds.load()
    assert shipped.source == "crops of 12 public-domain and CC0 photographs, stand-in for CIFAR-10"
    for part in (shipped.train, shipped.test):
        assert part.shape == (504, 64, 64, 3) and part.dtype == np.uint8
    assert len(backgrounds.load(count=7).train) == len(backgrounds.load(count=7).test) == 7
    np.testing.assert_array_equal(backgrounds.load(count=7).train, shipped.train[:7])


def test_no_photograph_is_used_to_train_and_to_test():
    with np.load(backgrounds.SHIPPED_CROPS / backgrounds.CROPS_FILE) as crops:
        used = {use: set(crops[f"{use}_photographs"].tolist()) for use in ("train", "test")}
        assert all(len(crops[use]) == len(crops[f"{use}_photographs"]) for use in used)
    assert used == {use: {each.name for each in photographs.PHOTOGRAPHS if each.use == use} for use in used}
    assert not used["train"] & used["test"]


def test_every_shipped_photograph_has_a_licence_that_allows_it():
    assert {each.licence for each in photographs.PHOTOGRAPHS} <= {"CC0", "public domain"}
    assert all(each.author and each.source for each in photographs.PHOTOGRAPHS)
    assert (backgrounds.SHIPPED_CROPS / "LICENCES.md").read_text(encoding="utf-8") == photographs.licences()


def test_shipped_crops_can_be_built_again(tmp_path):
    if importlib.util.find_spec("skimage") is None:
        pytest.skip("needs scikit-image")
    photographs.build_backgrounds(tmp_path / "built")
    built, shipped = backgrounds.load(tmp_path / "built"), backgrounds.load()
    assert built.source == shipped.source
    # Decoders of JPEG may differ by some levels.
    np.testing.assert_allclose(built.train.astype(int), shipped.train, atol=8)
    np.testing.assert_allclose(built.test.astype(int), shipped.test, atol=8)


def test_builder_refuses_a_photograph_that_is_missing_or_another(tmp_path, monkeypatch):
    package = tmp_path / "packages" / "skimage"
    (package / "data").mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "data" / "astronaut.png").write_bytes(b"another one")
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: importlib.machinery.PathFinder.find_spec(name, [str(package.parent)])
    )
    with pytest.raises(UserError, match="astronaut.*not the photograph whose licence is known"):
        photographs.build_backgrounds(tmp_path / "built")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="skimage is not installed; install it with: pip install scikit-image"):
        photographs.build_backgrounds(tmp_path / "built")
    assert not (tmp_path / "built").exists()


def test_crops_that_are_damaged_are_named(tmp_path):
    (tmp_path / "crops").mkdir()
    (tmp_path / "crops" / backgrounds.CROPS_FILE).write_bytes(b"PK no zip file")
    with pytest.raises(UserError, match="photographs.npz.*not an npz"):
        backgrounds.load(tmp_path / "crops")


@pytest.mark.parametrize("above", [False, True])
def test_cifar10_is_read_in_its_own_format(tmp_path, above):
    batches = tmp_path / "data" / backgrounds.CIFAR10_FOLDER
    first = write_cifar10(batches)
    read = backgrounds.load(tmp_path / "data" if above else batches)
    assert read.train.shape == (15, 64, 64, 3) and read.test.shape == (3, 64, 64, 3)
    assert "CIFAR-10" in read.source and "stand-in" not in read.source
    enlarged = [cv2.resize(picture, (64, 64), interpolation=cv2.INTER_LINEAR) for picture in first]
    assert all(any(np.array_equal(one, other) for other in read.train) for one in enlarged)
    assert not any(np.array_equal(one, other) for one in read.test for other in read.train)
    np.testing.assert_array_equal(backgrounds.load(batches, count=4).train, read.train[:4])


def test_cifar10_in_the_cache_has_a_name(tmp_path):
    with pytest.raises(UserError, match="backgrounds = 'cifar10'.*infogoal data download cifar10"):
        backgrounds.load("cifar10")
    write_cifar10(backgrounds.user_cache() / backgrounds.CIFAR10_FOLDER)
    assert tmp_path in backgrounds.user_cache().parents
    assert len(backgrounds.load("cifar10").test) == 3


def write_images(folder: Path, names: list[str]) -> None:
    """Images of one colour each, of different shapes: red is ten times the number of the image."""
    folder.mkdir()
    for number, name in enumerate(names):
        picture = np.full((20 + 90 * (number % 2), 40 + number, 3), (10 * number, 100, 200), np.uint8)
        assert cv2.imwrite(str(folder / name), picture[..., ::-1])


def test_images_of_a_folder_are_split_by_file(tmp_path):
    write_images(tmp_path / "mine", ["a.png", "b.PNG", "c.bmp", "d.jpg", "e.jpeg"])
    (tmp_path / "mine" / "notes.txt").write_text("no image")
    (tmp_path / "mine" / "._a.png").write_bytes(b"what another system leaves behind")
    read = backgrounds.load(tmp_path / "mine")
    assert read.train.shape == (3, 64, 64, 3) and read.test.shape == (2, 64, 64, 3) and "mine" in read.source
    np.testing.assert_allclose(np.sort(read.train[:, 32, 32, 0].astype(int)), [0, 20, 40], atol=3)
    np.testing.assert_allclose(np.sort(read.test[:, 32, 32, 0].astype(int)), [10, 30], atol=3)
    np.testing.assert_allclose(read.train[:, 32, 32, 1:].astype(int), [[100, 200]] * 3, atol=3)


def missing(folder: Path) -> None:
    """Nothing is there."""


def a_file(folder: Path) -> None:
    folder.write_text("no folder")


def an_empty_folder(folder: Path) -> None:
    folder.mkdir()


def no_images(folder: Path) -> None:
    folder.mkdir()
    (folder / "data_batch_1").write_text("a pickle")


def one_image(folder: Path) -> None:
    write_images(folder, ["a.png"])


def an_undecodable_image(folder: Path) -> None:
    write_images(folder, ["a.png", "b.png"])
    (folder / "a.png").write_bytes((folder / "a.png").read_bytes()[:20])


def an_image_without_bytes(folder: Path) -> None:
    write_images(folder, ["a.png", "b.png"])
    (folder / "b.png").write_bytes(b"")


def a_truncated_batch(folder: Path) -> None:
    write_cifar10(folder)
    (folder / "data_batch_2.bin").write_bytes((folder / "data_batch_2.bin").read_bytes()[:-1])


def an_empty_batch(folder: Path) -> None:
    write_cifar10(folder)
    (folder / "test_batch.bin").write_bytes(b"")


def a_batch_of_something_else(folder: Path) -> None:
    write_cifar10(folder)
    (folder / "test_batch.bin").write_bytes(b"\xff" * 3073)


def batches_missing(folder: Path) -> None:
    write_cifar10(folder / backgrounds.CIFAR10_FOLDER)
    for name in ("data_batch_4.bin", "test_batch.bin"):
        (folder / backgrounds.CIFAR10_FOLDER / name).unlink()


FAULTS = [
    (missing, "no such folder"),
    (a_file, "is a file; give the folder"),
    (an_empty_folder, "is empty"),
    (no_images, "neither images .png, jpg.* nor CIFAR-10's binary version"),
    (one_image, "one image only, a.png; give at least 2"),
    (an_undecodable_image, "a.png cannot be decoded"),
    (an_image_without_bytes, "b.png cannot be decoded"),
    (a_truncated_batch, "data_batch_2.bin has 9218 bytes, not a multiple of 3073"),
    (an_empty_batch, "test_batch.bin has 0 bytes"),
    (a_batch_of_something_else, "test_batch.bin has labels above 9"),
    (batches_missing, "without data_batch_4.bin, test_batch.bin"),
]


@pytest.mark.parametrize("fault, message", FAULTS, ids=lambda part: part.__name__ if callable(part) else "")
def test_what_is_wrong_is_named_with_its_place(tmp_path, fault, message):
    fault(tmp_path / "place")
    with pytest.raises(UserError, match=f"backgrounds = '.*place.*{message}"):
        backgrounds.load(tmp_path / "place")


def test_a_count_below_one_is_refused():
    with pytest.raises(UserError, match="count = 0"):
        backgrounds.load(count=0)


@pytest.mark.parametrize(("of", "reading"), [(Path, "iterdir"), (backgrounds, "read_bytes")])
def test_what_may_not_be_read_is_named(tmp_path, monkeypatch, of, reading):
    """Simulated: nothing is forbidden to root, as whom tests often run."""
    write_images(tmp_path / "locked", ["a.png", "b.png"])

    def forbid(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(of, reading, forbid)
    with pytest.raises(UserError, match="backgrounds = '.*locked'.*cannot be read: Permission denied"):
        backgrounds.load(tmp_path / "locked")
