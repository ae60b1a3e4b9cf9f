"""The video of the simulated drone: what its camera sees of the shelf, as H.264 in the packets of a Tello's stream."""

from fractions import Fraction

import av
import numpy as np

from infogoal_jax.stand_ins import shelf

PACKET = 1460
"""Bytes of a packet of the stream; the last packet of an image is shorter."""
BIT_RATE, KEY_FRAME_SECONDS = 4_000_000, 1


class Camera:
    """The camera before the shelf of this seed."""

    def __init__(self, seed: int, random: np.random.Generator):
        self.wall, self.places = shelf.furnished_wall(np.random.default_rng([seed, shelf.GENERATOR_VERSION]))
        self.random = random

    def view(self, position: np.ndarray, roll: float) -> np.ndarray:
        """The map [2, 3] from the wall to the image, for a camera at this place (m [2])."""
        return shelf.camera(position, roll, shelf.SIZE)

    def see(self, position: np.ndarray, roll: float, moving: bool) -> np.ndarray:
        """What it sees, uint8 RGB [720, 960, 3]. moving: the propellers turn, and images are blurred."""
        blur = self.random.normal(0, shelf.BLUR, 2) if moving else None
        return shelf.see(self.wall, self.view(position, roll), shelf.STREAM, blur)

    def boxes(self, position: np.ndarray, roll: float) -> dict[str, list[float]]:
        """The box of every object that lies in the image with all its corners: left, top, right and bottom, pixels."""
        view, found = self.view(position, roll), {}
        for name, box in zip(self.places, shelf.boxes(self.places), strict=True):
            if shelf.in_view(view, box):
                corners = shelf.pixel_of(box, shelf.SIZE) @ view[:, :2].T + view[:, 2]
                found[name] = [float(value) for value in (*corners.min(0), *corners.max(0))]
        return found


class Encoder:
    """H.264 as the Tello streams it: baseline profile, without B-frames, parameters again before every key frame."""

    def __init__(self, frames_per_second: int):
        self.context = av.CodecContext.create("libx264", "w")
        self.context.height, self.context.width = shelf.STREAM
        self.context.pix_fmt, self.context.bit_rate = "yuv420p", BIT_RATE
        self.context.framerate, self.context.time_base = frames_per_second, Fraction(1, frames_per_second)
        key_frames = frames_per_second * KEY_FRAME_SECONDS
        self.context.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "profile": "baseline",
            "x264-params": f"repeat-headers=1:keyint={key_frames}:threads=1",
        }
        self.count = 0

    def packets(self, image: np.ndarray) -> list[bytes]:
        """The packets of one image, uint8 RGB [720, 960, 3]."""
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts = self.count
        self.count += 1
        stream = b"".join(bytes(packet) for packet in self.context.encode(frame))
        return [stream[start : start + PACKET] for start in range(0, len(stream), PACKET)]


class VideoFaults:
    """What may be wrong with a video: black, frozen, torn or stopped images."""

    def __init__(self):
        self.kind, self.until = "", 0.0
        self.last: np.ndarray | None = None
        self.count = 0

    def spoil(self, image: np.ndarray, now: float) -> np.ndarray | None:
        """The image as it is streamed; None for none."""
        if not self.kind or now > self.until:
            self.last = image
            return image
        self.count += 1
        if self.kind == "stopped":
            return None
        if self.kind == "black":
            return np.zeros_like(image)
        if self.kind == "torn":  # Part of another image, at a row that changes, as lost slices leave it.
            torn, row = image.copy(), 120 + 37 * self.count % 480
            torn[row:] = np.roll(image[row:], 53 * (1 + self.count % 7), axis=1)[::-1]
            return torn
        return image if self.last is None else self.last
