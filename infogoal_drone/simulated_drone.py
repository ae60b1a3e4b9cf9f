"""The simulated drone: its body and firmware (where it is, what it does, what it answers to a command), and its video
(what its camera sees of the shelf, as H.264 in the packets of a Tello's stream).

It hovers in front of the generated shelf. Times are seconds of the simulation, lengths metres in the shelf's frame (x
to the right from its left end, y up from its lowest line). The answers are those of the Tello SDK 2.0.
"""

import dataclasses
from fractions import Fraction

import av
import numpy as np

from infogoal_jax.stand_ins import shelf

FLOOR = -0.5
"""Height of the floor in the shelf's frame. The drone takes off from a stand below its first place, which is then taken
away."""
TAKEOFF_HEIGHT = 0.8
"""Where a Tello hovers after it took off."""
TAKEOFF_SECONDS, LATENCY, SPEED, SETTLING, DESCENT = 4.0, 0.1, 0.4, 0.5, 0.4
"""Of a take-off; from a command to the motion; of a move (m/s); of coming to rest; of a landing (m/s)."""
DRIFT_SECONDS = 2.0
"""Correlation time of the hover's drift, whose spread is that of the generated dataset."""
MOVE_ERROR = 0.01
"""Standard deviation of where a move ends; errors add up over a flight."""
SILENCE = 15.0
"""The firmware lands when no command came for so long."""
FULL_BATTERY_SECONDS = 780.0
LOWEST_FOR_TAKEOFF, LOWEST_IN_AIR = 10.0, 5.0
"""Per cent of the battery below which it does not take off, and below which it lands by itself."""
DIRECTIONS = {"left": (-1, 0), "right": (1, 0), "up": (0, 1), "down": (0, -1), "forward": (0, 0), "back": (0, 0)}
QUERIES = ("battery?", "speed?", "time?", "height?", "temp?", "attitude?", "baro?", "tof?", "wifi?", "sdk?", "sn?")
NO_SIGN_OF_LIFE = ("battery?",)
"""Commands after which the firmware counts its seconds of silence on."""
PACKET = 1460
"""Bytes of a packet of the stream; the last packet of an image is shorter."""
BIT_RATE, KEY_FRAME_SECONDS = 4_000_000, 1


@dataclasses.dataclass
class Motion:
    """A smooth motion between two points [2] and two times, and the phase that follows it."""

    start: np.ndarray
    end: np.ndarray
    begins: float
    ends: float
    following: str

    def at(self, now: float) -> np.ndarray:
        """The place at this time."""
        share = np.clip((now - self.begins) / max(self.ends - self.begins, 1e-6), 0, 1)
        return self.start + (self.end - self.start) * share**2 * (3 - 2 * share)


class Body:
    """The simulated drone. `position` is where it truly is, drift included."""

    def __init__(self, first: np.ndarray, random: np.random.Generator, battery: float = 87.0):
        """first: where it hovers after it took off, m [2]; battery: per cent."""
        self.random, self.battery = random, battery
        self.stand_top = max(float(first[1]) - TAKEOFF_HEIGHT, FLOOR)
        self.ground = self.stand_top
        self.first = np.array(first, float)
        self.nominal = np.array([first[0], self.stand_top])
        self.drift, self.roll, self.velocity = np.zeros(2), 0.0, np.zeros(2)
        self.phase, self.motion, self.time = "ground", None, 0.0
        self.last_command, self.flight_seconds = 0.0, 0.0
        self.why_landed, self.crashed = "", False
        self.refusals: list[str] = []
        self.farthest = np.zeros(2)
        """Largest distance from `first` in each direction while it hovered or moved, m [2]."""

    @property
    def position(self) -> np.ndarray:
        """m [2]."""
        return self.nominal + self.drift

    @property
    def in_air(self) -> bool:
        """Whether the motors turn."""
        return self.phase != "ground"

    def advance(self, now: float) -> None:
        """Let the time pass until `now`."""
        passed = max(now - self.time, 0.0)
        self.time = now
        before = self.nominal
        if self.motion is not None:
            self.nominal = self.motion.at(now)
            if now >= self.motion.ends:
                self.phase, self.motion = self.motion.following, None
                if self.phase == "hovering":  # A take-off that was broken off ends on the stand.
                    self.ground = FLOOR
        self.velocity = (self.nominal - before) / passed if passed > 0 else self.velocity
        if not self.in_air:
            self.drift, self.roll = np.zeros(2), 0.0
            return
        keep = np.exp(-passed / DRIFT_SECONDS)
        spread = np.sqrt(1 - keep**2)
        self.drift = keep * self.drift + spread * self.random.normal(0, shelf.DRIFT, 2)
        self.roll = keep * self.roll + spread * self.random.normal(0, shelf.ROLL)
        self.flight_seconds += passed
        self.battery = max(self.battery - 100 * passed / FULL_BATTERY_SECONDS, 0.0)
        if self.phase in ("hovering", "moving"):
            self.farthest = np.maximum(self.farthest, np.abs(self.position - self.first))
        if self.phase != "landing" and self.battery < LOWEST_IN_AIR:
            self.land(now, "battery empty")
        if self.phase == "hovering" and now - self.last_command > SILENCE:
            self.land(now, "no command for 15 s")

    def land(self, now: float, why: str) -> None:
        """Begin to land."""
        below = np.array([self.nominal[0], self.ground])
        seconds = LATENCY + abs(self.nominal[1] - self.ground) / DESCENT
        self.phase, self.motion, self.why_landed = (
            "landing",
            Motion(self.nominal, below, now, now + seconds, "ground"),
            why,
        )

    def obey(self, command: str, now: float) -> str:
        """Begin what a command asks for. Returns the answer, or "" where it comes when the motion has ended."""
        if command not in NO_SIGN_OF_LIFE:
            self.last_command = now
        word, *values = command.split()
        if word in DIRECTIONS and self.refusals:
            return self.refusals.pop(0)
        if command in QUERIES:
            return self.read(command)
        if word == "takeoff":
            if self.in_air or self.battery < LOWEST_FOR_TAKEOFF:
                return "error"
            end = np.array([self.nominal[0], self.stand_top + TAKEOFF_HEIGHT])
            self.phase = "taking off"
            self.motion = Motion(self.nominal, end, now + LATENCY, now + TAKEOFF_SECONDS, "hovering")
            return ""
        if word == "land":
            if not self.in_air:
                return "error"
            if self.phase != "landing":
                self.land(now, "command land")
            return ""
        if word == "emergency":
            self.crashed = self.in_air
            self.nominal = np.array([self.nominal[0], self.ground])
            self.phase, self.motion, self.why_landed = "ground", None, "command emergency"
            return "ok"
        if word in DIRECTIONS:
            return self.move(word, values, now)
        if word in ("command", "streamon", "streamoff", "speed", "port", "setfps", "setbitrate", "setresolution"):
            return "ok"
        if word == "stop":
            return "ok"
        return f"unknown command: {command}"

    def move(self, word: str, values: list[str], now: float) -> str:
        """Begin a move. Returns the answer to one that cannot be made."""
        if len(values) != 1 or not values[0].isdigit() or not 20 <= int(values[0]) <= 500:
            return "out of range"
        if self.phase == "ground":
            return "error Motor stop"
        if self.phase == "landing":
            return "error Auto land"
        if self.phase != "hovering":
            return "error Not joystick"
        length = int(values[0]) / 100
        end = self.nominal + length * np.array(DIRECTIONS[word]) + self.random.normal(0, MOVE_ERROR, 2)
        end[1] = max(end[1], self.ground + 0.1)
        self.last_command = now + LATENCY + length / SPEED + SETTLING  # Silence counts from where it has been executed.
        self.phase, self.motion = "moving", Motion(self.nominal, end, now + LATENCY, self.last_command, "hovering")
        return ""

    def read(self, query: str) -> str:
        """The answer to a query."""
        height = self.nominal[1] - self.stand_top
        return {
            "battery?": f"{self.battery:.0f}",
            "speed?": f"{100 * SPEED:.1f}",
            "time?": f"{self.flight_seconds:.0f}s",
            "height?": f"{10 * height:.0f}dm",
            "temp?": "61~63C",
            "attitude?": "pitch:0;roll:0;yaw:0;",
            "baro?": "47.66",
            "tof?": f"{self.tof() * 10:.0f}mm",
            "wifi?": "90",
            "sdk?": "20",
            "sn?": "0TQZSIMULATED0",
        }[query]

    def tof(self) -> int:
        """Distance to what is below in cm, as the sensor says it: 10 on the ground."""
        return max(10, round(100 * (self.position[1] - self.ground)))

    def state(self) -> str:
        """The state packet of the SDK."""
        speed_x, speed_z = (round(10 * float(speed)) for speed in self.velocity)
        height = 10 * round(10 * float(self.nominal[1] - self.stand_top))
        return (
            f"pitch:0;roll:{round(np.rad2deg(self.roll))};yaw:0;vgx:0;vgy:{speed_x};vgz:{-speed_z};templ:61;temph:63;"
            f"tof:{self.tof()};h:{height};bat:{round(self.battery)};baro:47.66;time:{round(self.flight_seconds)};"
            "agx:0.00;agy:0.00;agz:-999.00;\r\n"
        )


class Camera:
    """The camera before the shelf of this seed."""

    def __init__(self, seed: int, random: np.random.Generator, gathered: bool = False):
        """gathered: whether the objects of a region stand together."""
        furnishing = np.random.default_rng([seed, shelf.GENERATOR_VERSION])
        self.wall, self.places = shelf.furnished_wall(furnishing, gathered)
        self.random = random

    def view(self, position: np.ndarray, roll: float) -> np.ndarray:
        """The map [2, 3] from the wall to the image, for a camera at this place (m [2])."""
        return shelf.camera(position, roll)

    def see(self, position: np.ndarray, roll: float, moving: bool) -> np.ndarray:
        """What it sees, uint8 RGB [720, 960, 3]. moving: the propellers turn, and images are blurred."""
        blur = self.random.normal(0, shelf.BLUR, 2) if moving else None
        return shelf.see(self.wall, self.view(position, roll), shelf.STREAM, blur)

    def boxes(self, position: np.ndarray, roll: float) -> dict[str, list[float]]:
        """The box of every object that lies in the image with all its corners: left, top, right and bottom, pixels."""
        view, found = self.view(position, roll), {}
        for name, box in zip(self.places, shelf.boxes(self.places), strict=True):
            if shelf.in_view(view, box):
                corners = shelf.pixel_of(box) @ view[:, :2].T + view[:, 2]
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
