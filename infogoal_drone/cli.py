"""Commands of the drone: export, fly, record (docs/guides/drone.md)."""

import dataclasses
import sys
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional

from infogoal_jax.cli.commands import Pair, check_seed, empty_folder, new_folder
from infogoal_jax.errors import UserError, counted, require, typed

CHECKS = """Before the propellers turn:
  1. Guards on the propellers, nobody within 2 m of the drone and the shelf, no children or animals in the room.
  2. Even light, a floor with a pattern below (the drone holds its place by looking at it), no draught.
  3. The drone stands 1 m before the shelf and looks at it squarely; {space}.
  4. Battery {battery} % or more; this machine is on the drone's Wi-Fi and on no other network.
  5. One hand at Ctrl-C: it lands at once. Whatever happens, do not reach for the drone."""


@dataclasses.dataclass(frozen=True)
class DroneFlags:
    """The drone, the envelope and the detector."""

    simulate: FlagCreatePairsOff[bool] = False
    """Fly a simulated drone, a process of its own on this machine, in front of the generated shelf."""
    simulated: Pair = None
    """Ports for commands and for questions of a simulated drone that runs already; None: start one."""
    start: tuple[int, int] = (17, 4)
    """Column (0 to 35) and row (0 to 8) of the place of the generated shelf before which the simulated drone takes
    off."""
    speed: float = 1.0
    """Simulated seconds in a second, 0.1 to 20."""
    seed: int = 0
    """Seed of the simulated drone's drift, and of what the policy draws."""
    host: str = "192.168.10.1"
    """Address of the drone."""
    ports: tuple[int, int, int] = (8889, 8890, 11111)
    """Ports of this machine for answers, state and video; a Tello knows no others."""
    left: int | None = None
    """Steps of 20 cm that it may go to the left of where it hovers first; None: 3, in the simulation to the end of the
    shelf."""
    right: int | None = None
    """Steps to the right; None: 3, in the simulation to the end of the shelf."""
    up: int | None = None
    """Steps up; None: 2, in the simulation to the end of the shelf."""
    down: int | None = None
    """Steps down; None: 1, in the simulation to the end of the shelf."""
    steps: int = 50
    """Moves at most."""
    battery_floor: int = 25
    """Per cent of the battery at which it lands."""
    weights: str = ""
    """File of the weights of a YOLO network, which detects the objects; the simulated drone has a detector of its
    own."""
    confidence: float = 0.5
    """Of the detector, from which an object counts as seen."""
    yes: FlagCreatePairsOff[bool] = False
    """Take off without asking."""


Flags = Annotated[DroneFlags, OmitArgPrefixes]


def fly(
    policy: Positional[str],
    question: str,
    object: str = "",
    embeddings: str = "",
    record: str = "",
    origin: tuple[int, int] = (0, 0),
    out: str = "",
    drone: Flags = DroneFlags(),
) -> int:
    """Fly a policy of embodied question answering on a Tello, or on a simulated one (docs/guides/drone.md).

    Args:
        policy: File of `infogoal export`, or folder of a run, whose first policy is exported.
        question: Question to answer.
        object: Object whose detection ends the flight; empty: the one that the policy's file has for the question.
        embeddings: Sentence embeddings, an npz of `infogoal data embed`; empty: those of the policy, those that the
            project ships, or the sentence encoder.
        record: Folder to record the flight in for `infogoal data import`; empty: none.
        origin: Column and row of the place where it hovers first, in steps of 20 cm, in the frame of all recordings.
        out: Folder of the log; empty: a new one under runs/.
        drone: The drone.

    Returns:
        0 if the object was found and the drone has landed, else 1.
    """
    from infogoal_drone.mission import flown_policy, load_policy, read_question

    check_seed(drone.seed)
    folder = empty_folder(out, "out") if out else new_folder("flight")
    exported, new = load_policy(policy)
    asked = read_question(exported, question, object, embeddings)
    print(f"question    {question}\nobject      {asked.object}\npolicy      {exported.about['method']}, {policy}")
    flown = flown_policy(exported, asked, drone.seed)._replace(file=new)
    return depart(folder, flown, asked.object, drone, record, origin, exported)


def record(
    folder: Positional[str],
    origin: tuple[int, int] = (0, 0),
    size: tuple[int, int] = (48, 64),
    out: str = "",
    drone: Flags = DroneFlags(),
) -> int:
    """Fly to and fro and record pictures and moves for `infogoal data import` (docs/guides/drone.md).

    Args:
        folder: Folder of the recordings; every flight adds a folder of images, and rows to its moves.csv.
        origin: Column and row of the place where it hovers first, in steps of 20 cm, in the frame of all recordings.
        size: Height and width in pixels that pictures are checked at.
        out: Folder of the log; empty: a new one under runs/.
        drone: The drone.

    Returns:
        0 if the drone has landed, else 1.
    """
    from infogoal_drone.envelope import MOVES
    from infogoal_drone.mission import Flown
    from infogoal_drone.records import Explorer

    check_seed(drone.seed)
    sharp = all(8 <= pixels <= 1080 for pixels in size)
    require(sharp, "size", size, "give a height and a width from 8 to 1080 pixels, such as 48 64")
    log_folder = empty_folder(out, "out") if out else new_folder("recording")
    flown = Flown(Explorer(drone.seed), tuple(MOVES), size)
    return depart(log_folder, flown, "", drone, folder, origin, None)


def depart(folder, flown, target: str, drone: DroneFlags, record: str, origin: tuple[int, int], exported) -> int:
    """Ask, fly and say how it ended. origin: where it hovers first; a simulated drone knows that by itself."""
    from infogoal_drone.envelope import Envelope
    from infogoal_drone.mission import Settings, run_mission

    def confirm(envelope: Envelope) -> None:
        if not drone.yes:
            ask_to_take_off(envelope, drone.battery_floor)

    about = exported.about if exported is not None else {}
    shelf_seed, gathered = about.get("generator_seed", 0), about.get("gathered", False)
    settings = Settings(**vars(drone), shelf_seed=shelf_seed, gathered=gathered)
    outcome = run_mission(folder, flown, target, settings, record, drone.start if drone.simulate else origin, confirm)
    print(f"ended       {outcome.reason}, after {counted(outcome.steps, 'move')}")
    print(f"log         {folder / 'flight.jsonl'}; `infogoal report {typed(folder)}` draws it")
    if not outcome.landed:
        print(
            "The drone did not say that it landed: its firmware does so 15 s after the last command.", file=sys.stderr
        )
    return 0 if outcome.landed and (outcome.found or not target) else 1


def ask_to_take_off(envelope, battery_floor: int) -> None:
    """Show what a person must check, and wait for a yes. envelope: of `infogoal_drone.envelope`; battery_floor: per
    cent. Raises `UserError` for anything else."""
    from infogoal_drone.envelope import TAKEOFF_RESERVE

    space = ", ".join(f"{far} cm free {where}" for where, far in envelope.centimetres().items())
    print(CHECKS.format(space=space, battery=battery_floor + TAKEOFF_RESERVE))
    try:
        answer = input("Type fly to take off: ")
    except EOFError:
        answer = ""
    if answer.strip() != "fly":
        raise UserError(f"answer = {answer!r}: no take-off; type fly, or give --yes")
