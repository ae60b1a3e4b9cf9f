"""Detectors: boxes that are cut off, YOLO's results, and libraries and files that are missing."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from infogoal_jax.drone import detection
from infogoal_jax.drone.detection import Detection
from infogoal_jax.errors import UserError

IMAGE = np.zeros((72, 96, 3), np.uint8)


class Boxes(list):
    """A column of YOLO's results."""

    def tolist(self):
        return list(self)


class StubYOLO:
    """What is used of ultralytics' class: names, and predict on BGR images."""

    def __init__(self, weights):
        self.names = {0: "mug", 1: "clock"}

    def predict(self, image, device, verbose):
        assert device == "cpu" and image[0, 0].tolist() == [3, 2, 1], "ultralytics takes BGR"
        boxes = SimpleNamespace(
            cls=Boxes([1.0, 0.0]), xyxy=Boxes([[5, 5, 20, 20], [0, 5, 20, 20]]), conf=Boxes([0.9, 0.8])
        )
        return [SimpleNamespace(boxes=boxes, names=self.names)]


@pytest.fixture
def weights(tmp_path):
    """A file that stands for weights."""
    (tmp_path / "best.pt").write_bytes(b"weights")
    return tmp_path / "best.pt"


def test_what_counts_as_seen():
    found = [
        Detection("mug", (5, 5, 20, 20), 0.9),
        Detection("clock", (5, 5, 95.5, 20), 0.9),
        Detection("vase", (5, 5, 20, 20), 0.3),
    ]
    assert detection.seen(found, IMAGE, 0.5) == {"mug"}


def test_yolo(monkeypatch, weights):
    """Its classes, boxes and confidences; the image in the order of colours that it takes."""
    monkeypatch.setitem(sys.modules, "ultralytics", SimpleNamespace(YOLO=StubYOLO))
    detect = detection.yolo_detector(weights)
    found = detect(np.broadcast_to(np.array([1, 2, 3], np.uint8), IMAGE.shape))
    assert found == [Detection("clock", (5, 5, 20, 20), 0.9), Detection("mug", (0, 5, 20, 20), 0.8)]
    assert detection.seen(found, IMAGE, 0.5) == {"clock"}
    detection.check_known("mug", detect)
    with pytest.raises(UserError, match="Did you mean 'mug'"):
        detection.check_known("mgu", detect)


def test_missing_weights_and_missing_ultralytics(monkeypatch, tmp_path, weights):
    with pytest.raises(UserError, match="no such file"):
        detection.yolo_detector(tmp_path / "none.pt")
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    with pytest.raises(UserError, match="yolo"):
        detection.yolo_detector(weights)
