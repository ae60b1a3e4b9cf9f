"""What `infogoal fly` and `infogoal record` put together: a policy and a question, the drone or a simulated one, the
envelope, the detector and the log."""

import contextlib
import dataclasses
import ipaddress
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from infogoal_drone.cli import DroneFlags
from infogoal_drone.envelope import MOVES, Envelope, Limits, Signals
from infogoal_drone.flight import Flight, Outcome, Policy
from infogoal_drone.link import Address, Link, check_ports, import_djitellopy
from infogoal_drone.records import Log, Recorder, check_recordings
from infogoal_drone.vision import Detector, check_known, simulated_detector, yolo_detector
from infogoal_jax.data import text
from infogoal_jax.errors import UserError, require
from infogoal_jax.policy_file import ExportedPolicy
from infogoal_jax.runs import disk
from infogoal_jax.runs.disk import Place, decode
from infogoal_jax.runs.folder import find_run
from infogoal_jax.stopping import temporary

SLOWEST, FASTEST = 0.1, 20.0
"""Paces of a simulation: Ctrl-C is seen within a second; packets and images come one after the other."""


class Asked(NamedTuple):
    """A question: the goal encoder's input float32 [384], and the object that answers it."""

    goal: np.ndarray
    object: str


class Flown(NamedTuple):
    """A policy as it flies: its function, the names of its moves, height and width of its pictures, and the content of
    a file to keep beside the log."""

    policy: Policy
    moves: tuple[str, ...]
    size: tuple[int, int]
    file: bytes = b""


@dataclasses.dataclass(frozen=True)
class Settings(DroneFlags):
    """A flight's settings: the flags of the commands, and the shelf."""

    shelf_seed: int = 0
    """Seed of the generated shelf that the simulated drone sees."""
    gathered: bool = False
    """Whether the objects of a region stand together on it."""

    def check(self) -> None:
        """Raise `UserError` for values out of range, and for those that only a simulated or only a real drone has."""
        self.limits().check()
        usable = all(0 < port < 2**16 for port in self.ports) and len(set(self.ports)) == 3
        require(usable, "ports", self.ports, "give three different ones from 1 to 65535")
        require(SLOWEST <= self.speed <= FASTEST, "speed", self.speed, f"give {SLOWEST:g} to {FASTEST:g}")
        if self.simulate:
            from infogoal_jax.stand_ins.shelf import COLUMNS, ROWS

            require(not self.weights, "weights", self.weights, "the simulated drone has a detector; leave it out")
            usable = self.simulated is None or all(0 < port < 2**16 for port in self.simulated)
            require(usable, "simulated", self.simulated, "give two ports from 1 to 65535")
            inside = 0 <= self.start[0] < COLUMNS and 0 <= self.start[1] < ROWS
            require(inside, "start", self.start, f"give 0 to {COLUMNS - 1} and 0 to {ROWS - 1}")
        else:
            require(self.speed == 1, "speed", self.speed, "a real drone has its own; leave it out")
            require(self.simulated is None, "simulated", self.simulated, "goes together with --simulate")
            try:
                ipaddress.ip_address(self.host)
            except ValueError as error:
                raise UserError(f"host = {self.host!r}: give the drone's address in numbers, 192.168.10.1") from error

    def limits(self) -> Limits:
        """What ends the flight, apart from its object."""
        return Limits(self.steps, self.battery_floor, self.confidence)

    def envelope(self) -> Envelope:
        """The envelope: small around a real drone, as far as the shelf goes around a simulated one. Raises `UserError`
        for numbers of steps below 0."""
        given = {name: getattr(self, name) for name in MOVES if getattr(self, name) is not None}
        whole = {}
        if self.simulate:
            from infogoal_jax.stand_ins.shelf import COLUMNS, ROWS

            column, row = self.start
            whole = {"left": column, "right": COLUMNS - 1 - column, "up": ROWS - 1 - row, "down": row}
        envelope = Envelope(**(whole | given))
        envelope.check()
        return envelope


@dataclasses.dataclass(frozen=True)
class About:
    """What is read of what a policy's file says of it (`infogoal_jax.report.export`)."""

    method: str
    actions: tuple[str, ...]
    code_size: int
    samples_code: bool
    generator_seed: int
    goal_names: tuple[str, ...]
    goal_objects: tuple[str, ...]
    gathered: bool = False


def load_policy(path: str) -> tuple[ExportedPolicy, bytes]:
    """The exported policy at this path, or that of a run's folder, which is exported now; and the file's content, where
    it is new and to be kept.

    Raises `UserError` for a file that holds no policy, and for a policy that does not move left, right, up and down by
    what a camera sees.
    """
    found = find_run(path)
    if not found.is_dir():
        return read_policy(found, path), b""
    from infogoal_jax.report.export import export
    from infogoal_jax.report.runs import load_run

    run = load_run(found)
    with tempfile.TemporaryDirectory() as elsewhere, temporary(Path(elsewhere)):
        file = Path(elsewhere) / "policy.npz"
        export(run, file, run.seeds[0])
        return read_policy(file, path), file.read_bytes()


def read_policy(file: Path, given: str) -> ExportedPolicy:
    """The exported policy of this file. given: how the user named it. Raises `UserError` as `load_policy` does."""
    try:
        policy = ExportedPolicy(file)
        about = decode(About, policy.about, Place(file, remedy="export the policy again"))
        (shape, kind), outputs = policy.program["inputs"][1][0], policy.program["outputs"]
        rows = 0 if policy.goals is None else len(policy.goals) if policy.goals.ndim else -1
        if not rows == len(about.goal_names) == len(about.goal_objects):
            raise ValueError(f"{rows} goals, {len(about.goal_names)} names and {len(about.goal_objects)} objects")
    except (OSError, ValueError) as error:
        raise UserError(
            f"policy = {given!r}: is no file of `infogoal export` ({error}); give one, or a run's folder"
        ) from error
    sees = len(shape) == 3 and shape[-1] == 3 and kind == "uint8"
    fits = set(about.actions) == set(MOVES) and len(outputs) == 1 and sees
    require(fits, "policy", given, f"cannot fly: it needs the moves {', '.join(MOVES)} and colour images")
    return policy


def read_question(policy: ExportedPolicy, question: str, object: str = "", embeddings: str = "") -> Asked:
    """The goal of a question. Raises `UserError` for one that cannot be embedded, or whose object is not known."""
    names = [text.spelling(name) for name in policy.about["goal_names"]]
    if not embeddings and text.spelling(question) in names:
        row = names.index(text.spelling(question))
        return Asked(policy.goals[row], object or policy.about["goal_objects"][row])
    remedy = f"name the object that answers {question!r}, whose detection ends the flight"
    require(object != "", "object", object, remedy)
    return Asked(text.as_goal_inputs(embedded(question, embeddings))[0], object)


def embedded(question: str, embeddings: str) -> np.ndarray:
    """The embedding of a question float32 [1, 384]: looked up, or by the sentence encoder where it is installed."""
    known = text.load(embeddings) if embeddings else None
    try:
        return text.embed_known([question], known, "--embeddings")
    except UserError as unknown:
        if embeddings:
            raise
        from infogoal_jax.data import sentence_encoder

        try:
            return sentence_encoder.encode(sentence_encoder.load_encoder(), [question])
        except UserError as missing:
            raise UserError(f"{unknown}\nand the sentence encoder cannot be used: {missing}") from missing


def flown_policy(policy: ExportedPolicy, asked: Asked, seed: int) -> Flown:
    """The exported policy with this goal; its code is drawn anew at every step, as in the evaluation. Raises
    `UserError` for a program that does not come to an end with a value for every move: better now than in the air."""
    # The simulated drone draws from the streams 0 to 2 of a seed, the explorer from 4.
    random, sampled = np.random.default_rng([seed, 3]), policy.about["samples_code"]

    def act(picture: np.ndarray, mask: np.ndarray) -> int:
        noise = random.normal(size=policy.about["code_size"]).astype(np.float32) if sampled else None
        return policy.act(picture, asked.goal, mask, noise)

    height, width, _ = shape = policy.program["inputs"][1][0][0]
    try:
        values = policy.values(np.zeros(shape, np.uint8), asked.goal)
        require(values.shape == (len(policy.about["actions"]),), "values", values.shape, "one for each move is needed")
    except Exception as error:  # A file can hold any program, and NumPy raises whatever it comes to.
        raise UserError(
            f"policy: its program cannot be run for this goal ({error}); export the policy again"
        ) from error
    return Flown(act, tuple(policy.about["actions"]), (height, width))


def run_mission(
    folder: Path,
    flown: Flown,
    target: str,
    settings: Settings,
    record: str = "",
    origin: tuple[int, int] = (0, 0),
    confirm: Callable[[Envelope], None] = lambda envelope: None,
) -> Outcome:
    """Fly, on a simulated drone that is started for it if `simulate` is set, and leave the log in `folder`.

    target: object that ends the flight, "" for none; confirm: is called before a real drone is, and raises `UserError`
    for no take-off. Raises `UserError` for what is found before the take-off.
    """
    settings.check()
    envelope, folder = settings.envelope(), folder.resolve()  # Its name is that of the recorded flight, also for ".".
    if record:
        check_recordings(Path(record), folder.name)
    import_djitellopy()
    if not settings.simulate:
        detect, address = real_detector(settings.weights, target), Address(settings.host, 8889, settings.ports)
        check_ports(address.local_ports)
        confirm(envelope)
        return fly_at(folder, address, detect, flown, target, envelope, settings, record, origin)
    if target:
        check_known(target, simulated_detector(0))
    with simulated_drone(settings) as (port, truth_port):
        detect, address = simulated_detector(truth_port), Address("127.0.0.1", port, settings.ports)
        return fly_at(folder, address, detect, flown, target, envelope, settings, record, origin)


@contextlib.contextmanager
def simulated_drone(settings: Settings) -> Iterator[tuple[int, int]]:
    """The ports of a simulated drone, for commands and for questions: one that runs already, or one for this flight."""
    if settings.simulated is not None:
        yield settings.simulated
        return
    from infogoal_drone import simulated_tello
    from infogoal_jax.stand_ins import shelf

    _, state_port, video_port = settings.ports
    started = simulated_tello.start(
        simulated_tello.SimulatedTello(
            first=tuple((shelf.FIRST + shelf.STEP * np.array(settings.start)).tolist()),
            shelf_seed=settings.shelf_seed,
            gathered=settings.gathered,
            seed=settings.seed,
            speed=settings.speed,
            state_port=state_port,
            video_port=video_port,
        )
    )
    try:
        yield started.port, started.truth_port
    finally:
        started.stop()


def real_detector(weights: str, target: str) -> Detector:
    """The detector of a real drone; without weights one that sees nothing, which only a recording can do with. Raises
    `UserError`."""
    if not weights:
        require(not target, "weights", weights, "give the weights of a YOLO network that detects the object")
        return lambda image: []
    detect = yolo_detector(Path(weights))
    if target:
        check_known(target, detect)
    return detect


def fly_at(folder, address: Address, detect, flown: Flown, target, envelope, settings, record, origin) -> Outcome:
    """Fly a drone at this address."""
    log, limits = Log(folder), settings.limits()
    if flown.file:
        disk.write_atomically(folder / "policy.npz", lambda file: file.write(flown.file))
    recorder = Recorder(Path(record), folder.name, origin) if record else None
    log.write(
        "settings", target=target, host=address.host, simulated=settings.simulate, speed=settings.speed,
        start=settings.start, envelope=dataclasses.asdict(envelope), centimetres=envelope.centimetres(),
        limits=dataclasses.asdict(limits),
    )  # fmt: skip
    link = Link(address, flown.size, log, settings.speed)
    visit = recorder.visit if recorder is not None else None
    flight = Flight(link, flown.policy, flown.moves, detect, target, envelope, limits, log, visit)
    # Signals after the landing lose nothing either. What is named last is closed first, whatever the others raise.
    with Signals("Writing what was recorded."), contextlib.ExitStack() as closing:
        closing.callback(log.close)
        closing.callback(link.close)
        if recorder is not None:
            closing.callback(recorder.close)
        return flight.fly()
