"""How far the reference parts from itself: recorded episodes replayed on C MuJoCo with the object's start moved by a
micrometre (or `--micrometres`).

What a micrometre changes is chaos, and no simulator can follow a recording closer than that; what 0.1 mm changes is how
far the small differences of another simulator are amplified. `fetch_parity.py` is read beside these numbers. Runs
where the reference does:

    python3.11 -m venv scratch && scratch/bin/pip install mujoco==3.3.7 gymnasium-robotics==1.4.2
    scratch/bin/python benchmarks/fidelity/fetch_chaos.py tests/fixtures/fetch_gymnasium_v4.npz --kinds scripted held
    --out chaos.json

Each episode is replayed once from its recorded start, which must give the recording again, and once from each of
`--directions` places on a circle around it.
"""

import argparse
import importlib.util
import json
import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "peers"))
from fetch_peer_mujoco import Peer

KINDS = ("random", "held", "scripted")
"""Kinds of the episodes of a recording, in turn (record_fetch_reference.py)."""
OFF_TABLE, ON_TABLE = 0.3, 0.42
"""An object that ends lower than the first height (m) has fallen off the table, one that ends above the second stands
on it or is held."""


def installed_assets() -> Path:
    """The model files of the installed gymnasium-robotics; found without importing it, which prints a notice."""
    package = importlib.util.find_spec("gymnasium_robotics")
    if package is None:
        raise SystemExit("gymnasium-robotics is not installed here: run this in the scratch environment (see --help)")
    return Path(package.origin).parent / "envs" / "assets" / "fetch"


def replay(peer: Peer, place: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Grip and object [T + 1, 2, 3] (m) under actions [T, 4], the object starting at a place [2] (m)."""
    mujoco.mj_resetData(peer.model, peer.data)
    peer.data.qpos[:], peer.data.qvel[:] = peer.start
    peer.data.joint("object0:joint").qpos[:2] = place
    mujoco.mj_forward(peer.model, peer.data)
    observations = [peer.observation()] + [peer.step(action)[0] for action in actions]
    return np.stack(observations)[:, :6].reshape(-1, 2, 3)


def spread(ends: np.ndarray, center: np.ndarray) -> dict[str, float]:
    """Median and largest distance (mm) of positions [K, 3] from a position [3], both in m."""
    apart = 1000 * np.linalg.norm(ends - center, axis=-1)
    return {"median_mm": float(np.median(apart)), "largest_mm": float(apart.max())}


def fate(height: float) -> str:
    """What became of an object that ends at this height (m)."""
    return (
        "fell off" if height < OFF_TABLE else "stayed" if height > ON_TABLE else "was tipping over the edge at the end"
    )


def measure(peer: Peer, recorded: np.ndarray, actions: np.ndarray, offset: float, directions: int) -> dict:
    """One episode: recorded observations [T + 1, 25], actions [T, 4], the object's start moved by `offset` m in each
    direction."""
    place = recorded[0, 3:5].astype(float)
    angles = 2 * np.pi * np.arange(directions) / directions
    same = replay(peer, place, actions)
    moved = np.stack(
        [replay(peer, place + offset * np.array([np.cos(angle), np.sin(angle)]), actions) for angle in angles]
    )
    positions = recorded[:, :6].reshape(-1, 2, 3)
    return {
        "recorded_end": positions[-1, 1].tolist(),
        "fate": fate(positions[-1, 1, 2]),
        "same_fate": int(sum(fate(height) == fate(positions[-1, 1, 2]) for height in moved[:, -1, 1, 2])),
        "unmoved_largest_mm": float(1000 * np.linalg.norm(same - positions, axis=-1).max()),
        "object_end": spread(moved[:, -1, 1], same[-1, 1]),
        "grip": spread(moved[:, 1:, 0], same[1:, 0]),
    }


def main():
    """Measure the episodes that the arguments name and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="npz of episodes, as record_fetch_reference.py writes it")
    parser.add_argument("--task", default="fetch_push", choices=("fetch_push", "fetch_pick_and_place", "fetch_slide"))
    parser.add_argument("--kinds", nargs="+", default=["scripted", "held"], choices=KINDS)
    parser.add_argument("--micrometres", type=float, default=1.0, help="how far the object's start is moved")
    parser.add_argument("--directions", type=int, default=16, help="replays an episode, their starts on a circle")
    parser.add_argument(
        "--assets", type=Path, help="folder of gymnasium_robotics/envs/assets/fetch; else that of the installed package"
    )
    parser.add_argument("--out", type=Path, help="json to write")
    arguments = parser.parse_args()
    with np.load(arguments.recording, allow_pickle=False) as recording:
        observations, actions = recording[f"{arguments.task}/observation"], recording[f"{arguments.task}/action"]
    peer = Peer(arguments.assets or installed_assets(), arguments.task)
    offset = 1e-6 * arguments.micrometres
    print(f"C MuJoCo {mujoco.__version__}, {arguments.task} of {arguments.recording}")
    print(f"{arguments.directions} starts of the object, {arguments.micrometres:g} um from the recorded one")
    print("mm from the replay of the recorded start; unmoved: that replay itself from the recording\n")
    print(
        "| episode | kind | unmoved | object's end: median | max | grip: max | recorded end (m) | object | same fate |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    rows = []
    for episode in range(len(actions)):
        kind = KINDS[episode % len(KINDS)]
        if kind not in arguments.kinds:
            continue
        row = {
            "episode": episode,
            "kind": kind,
            **measure(peer, observations[episode], actions[episode], offset, arguments.directions),
        }
        rows.append(row)
        end, thing = ", ".join(f"{value:.3f}" for value in row["recorded_end"]), row["object_end"]
        print(
            f"| {episode} | {kind} | {row['unmoved_largest_mm']:.4f} | {thing['median_mm']:.3f} | "
            f"{thing['largest_mm']:.3f} "
            f"| {row['grip']['largest_mm']:.3f} | {end} | {row['fate']} | {row['same_fate']} of {arguments.directions} "
            "|",
            flush=True,
        )
    print()
    for kind, became in dict.fromkeys((row["kind"], row["fate"]) for row in rows):
        chosen = [row["object_end"] for row in rows if (row["kind"], row["fate"]) == (kind, became)]
        medians, largest = ([end[name] for end in chosen] for name in ("median_mm", "largest_mm"))
        print(
            f"{kind}, object {became}, {len(chosen)} episodes: medians {np.mean(medians):.3f} on average and "
            f"{max(medians):.3f} at most; "
            f"max {np.mean(largest):.3f} on average and {max(largest):.3f} at most; over 1 mm in "
            f"{sum(value > 1 for value in largest)}"
        )
    if arguments.out:
        measured = {
            "mujoco": mujoco.__version__,
            "task": arguments.task,
            "recording": str(arguments.recording),
            "micrometres": arguments.micrometres,
            "directions": arguments.directions,
            "episodes": rows,
        }
        arguments.out.write_text(json.dumps(measured, indent=1) + "\n")


if __name__ == "__main__":
    main()
