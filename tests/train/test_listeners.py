"""TensorBoard and Weights & Biases get numbers, figures and videos."""

import struct
import sys
import time

import hand_made
import pytest
from PIL import Image

from infogoal_jax.errors import UserError
from infogoal_jax.train.host import Progress
from infogoal_jax.train.listeners import make_listeners


@pytest.fixture
def pictures(tmp_path):
    """A figure and a video, as training leaves them."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    grey = [Image.new("RGB", (40, 20), (shade,) * 3) for shade in (0, 120, 240)]
    grey[1].save(folder / "curves.png")
    grey[0].save(folder / "episode.gif", save_all=True, append_images=grey[1:])
    return [folder / "curves.png", folder / "episode.gif"]


def tell(listeners, pictures):
    """What a run of one seed tells its listeners: two chunks, and pictures at the end."""
    for epoch in (2, 4):
        row = {"seed": 0, "epoch": epoch, "train_goal/success_rate": epoch / 4, "first_reached": [[1]]}
        for listen in listeners.progress:
            listen(Progress(epoch, 4, 1.0, 1.0, 1000.0, 7.0, [row], [row]))
    listeners.end_progress()
    listeners.pictures(pictures)


def test_tensorboard_has_every_number_the_figures_and_the_video(pictures, tmp_path):
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    with make_listeners(tmp_path / "run", hand_made.config(), 1, tensorboard=True) as listeners:
        tell(listeners, pictures)
    (path,) = (tmp_path / "run").glob("events.out.tfevents*")
    content, found = path.read_bytes(), {}
    while content:  # Records of TensorFlow: length, checksum, content, checksum.
        (length,) = struct.unpack("<Q", content[:8])
        for value in event_pb2.Event.FromString(content[12 : 12 + length]).summary.value:
            found.setdefault(value.tag, []).append(value)
        content = content[16 + length :]
    assert [value.simple_value for value in found["seed_0/train_goal/success_rate"]] == [0.5, 0.5, 1.0, 1.0]
    for picture in pictures:
        (value,) = found[f"figures/{picture.stem}"]
        assert value.image.encoded_image_string == picture.read_bytes()
        assert (value.image.width, value.image.height) == (40, 20)


def test_weights_and_biases_keeps_numbers_figures_and_the_video_offline(pictures, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    for name, value in {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "HOME": str(tmp_path)}.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "runs").mkdir()
    with make_listeners(tmp_path / "runs" / "mine", hand_made.config(), 1, wandb="project") as listeners:
        tell(listeners, pictures)
    (folder,) = (tmp_path / "runs" / "wandb").glob("offline-run-*")
    (log,) = folder.glob("*.wandb")
    for _ in range(300):  # Its service writes the last of it when the run is over.
        if b"episode" in log.read_bytes():
            break
        time.sleep(0.1)
    assert b"train_goal/success_rate" in log.read_bytes()
    kept = {path.suffix: path.read_bytes() for path in (folder / "files" / "media").rglob("*.*")}
    assert kept == {picture.suffix: picture.read_bytes() for picture in pictures}


def test_listeners_that_are_not_installed_are_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with (
        pytest.raises(UserError, match="pip install wandb"),
        make_listeners(tmp_path, hand_made.config(), 1, wandb="x"),
    ):
        pass
