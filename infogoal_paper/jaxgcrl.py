"""Our agents beside JaxGCRL's own programs, and with goal encoders before them: the results of
benchmarks/peers/jaxgcrl_peer.py.

    python -m infogoal_paper.jaxgcrl [FILE ...] [--alone FILE ...] [--parts FILE ...]
                                              # put results into docs/results/jaxgcrl.json.xz
    python -m infogoal_paper.pages jaxgcrl    # write the tables of docs/reference/vectors.md

Programs that share a GPU say nothing about speed, which is left out then. `--alone` names results of a few rounds of
each that had the GPU to themselves: their seconds for a round stand in the table. `--parts` names what the benchmark's
`--parts` wrote. What is there already of a program and seed is replaced.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from infogoal_jax.report.canvas import (
    ROOM_COLOURS,
    SHARE,
    draw_curve,
    empty_figure,
    figure_style,
    finish_share_axis,
    save,
)
from infogoal_jax.report.statistics import mean_interval
from infogoal_paper import trial_numbers
from infogoal_paper.table_formats import machines_in_words, markdown_lines, tight

NUMBERS = Path(__file__).parents[1] / "docs" / "results" / "jaxgcrl.json.xz"
SUCCESS = 0.5
"""The success that seconds are counted to."""
LEARNED = 0.1
"""The success from which on a side has learned a task."""
SIDES = ("ours", "theirs")
"""What is compared and drawn; other sides of ours, as `ours+infogoal`, have a goal encoder."""


@dataclasses.dataclass
class Outcome:
    """What a side did: a curve for each seed, [seeds][evaluations]."""

    task: str
    agent: str
    side: str
    machine: str
    seed: int
    """The first of those that ran side by side."""
    steps: list[float]
    """Environment steps of a seed at each evaluation, JaxGCRL's prefill included, which is not in the seconds."""
    seconds: list[float]
    """Seconds of training of the seeds that ran side by side, at each evaluation."""
    success: list[list[float]]
    """Of each seed at each evaluation; of their mean where the seeds are not known apart."""
    side_by_side: int
    """Seeds that shared the seconds."""
    updates: int
    """Of a seed, in all."""
    compiling: float
    """Seconds to trace and compile; NaN where they are not known apart."""

    def program(self) -> tuple[str, str, str]:
        """What ran, without its seed."""
        return self.task, self.agent, self.side

    def key(self) -> tuple:
        """What there is one of among the results."""
        return *self.program(), self.seed

    def steps_per_second(self) -> float:
        """Environment steps of all seeds a second of training, updates included. The first of several rounds is left
        out: it may have a prefill, which is not in its seconds."""
        steps, seconds = self.steps[-1], self.seconds[-1]
        if len(self.steps) > 1:
            steps, seconds = steps - self.steps[0], seconds - self.seconds[0]
        return self.side_by_side * steps / seconds

    def updates_at(self) -> np.ndarray:
        """Updates of a seed until each evaluation [evaluations]: as many for each step after the prefill."""
        learnt = np.cumsum(learnt_in(self))
        return self.updates * learnt / learnt[-1]

    def to_success(self) -> str:
        """Seconds a seed to the first evaluation with a mean success of `SUCCESS`, in words; at most so many where it
        is the first of all."""
        enough = np.flatnonzero(np.mean(self.success, 0) >= SUCCESS)
        if not enough.size:
            return "never"
        return ("" if enough[0] else "at most ") + f"{self.seconds[enough[0]] / self.side_by_side:.1f}"


@dataclasses.dataclass
class Parts:
    """Environment steps a second, of all seeds, of what an epoch of ours is made of."""

    task: str
    agent: str
    seeds: int
    """Side by side in one program."""
    machine: str
    environments: float
    """Of the environments alone, under random actions."""
    collecting: float
    """Of collecting: the environments, the policy and the buffer."""
    everything: float
    """Of an epoch, updates included."""

    def key(self) -> tuple:
        """What there is one of among the results."""
        return self.task, self.agent, self.seeds

    def share_of_updates(self) -> float:
        """The share of an epoch's time that updates take."""
        return 1.0 - self.everything / self.collecting


def joined(outcomes: list[Outcome]) -> Outcome:
    """Seeds that ran one after the other as one outcome, as far as the shortest of them went: seconds are the mean of a
    seed. Between evaluations success and seconds go in straight lines, since a seed may be evaluated at other steps."""
    first, end = max(outcomes, key=lambda each: each.steps[-1]), min(each.steps[-1] for each in outcomes)
    begin = max(each.steps[0] for each in outcomes)
    steps = sorted({begin, *(at for at in first.steps if begin < at < end), end})
    updates = first.updates * np.arange(1, len(first.steps) + 1) / len(first.steps)
    return dataclasses.replace(
        first,
        steps=steps,
        seconds=np.mean([np.interp(steps, each.steps, each.seconds) for each in outcomes], 0).tolist(),
        success=[np.interp(steps, each.steps, curve).tolist() for each in outcomes for curve in each.success],
        updates=round(float(np.interp(end, first.steps, updates))),
        compiling=float(np.mean([each.compiling for each in outcomes])),
    )


def timed_alone(outcome: Outcome, alone: list[Outcome]) -> Outcome:
    """The outcome with the seconds a step of the same program that ran alone: the median of its rounds."""
    found = [each for each in alone if each.program() == outcome.program()]
    rounds = np.concatenate([np.diff(each.seconds, prepend=0.0) / learnt_in(each) for each in found])
    seconds = float(np.median(rounds)) * np.cumsum(learnt_in(outcome))
    return dataclasses.replace(outcome, seconds=seconds.tolist(), machine=found[0].machine)


def learnt_in(outcome: Outcome) -> np.ndarray:
    """Environment steps of each round [evaluations]; the first, which may have a prefill, is as long as the second."""
    later = np.diff(outcome.steps)
    return np.concatenate([later[:1] if len(later) else outcome.steps, later])


def all_are_timed(sides: dict[str, Outcome], alone: list[Outcome]) -> bool:
    """Whether the programs of all these sides ran alone, too."""
    return {each.program() for each in sides.values()} <= {each.program() for each in alone}


def compared(outcomes: Iterable[Outcome], alone: list[Outcome]) -> Iterator[tuple[str, str, dict[str, Outcome]]]:
    """Task, agent and the outcome of each side, in order; with the seconds of those that ran alone where all did."""
    ordered = sorted(outcomes, key=Outcome.key)
    for (task, agent), both in groupby(ordered, key=lambda each: each.program()[:2]):
        sides = {side: joined(list(seeds)) for side, seeds in groupby(both, key=lambda each: each.side)}
        if all_are_timed(sides, alone):
            sides = {side: timed_alone(each, alone) for side, each in sides.items()}
        yield task, agent, sides


def is_learned(sides: dict[str, Outcome]) -> bool:
    """Whether one of these sides learned its task."""
    return max(np.mean(own.success, 0).max() for own in sides.values()) > LEARNED


def unlearned(outcomes: Iterable[Outcome]) -> str:
    """The tasks and agents that no side learned, with the seeds of each, ours first, and the steps that both made."""
    found = []
    for task, agent, sides in compared((each for each in outcomes if each.side in SIDES), []):
        if not is_learned(sides):
            seeds = " and ".join(str(len(own.success)) for own in sides.values())
            found.append(f"{task}, {agent} ({seeds}, {min(own.steps[-1] for own in sides.values()) / 1e6:.1f})")
    return f"Not above {LEARNED}, with seeds and million steps of both: {'; '.join(found)}." if found else ""


def rows(outcomes: Iterable[Outcome], alone: list[Outcome]) -> list[list[str]]:
    """A row for each side of a task and agent that one of them learned. Speed and seconds stand only where both were
    timed alone; behind the speed of ours how many times theirs it is."""
    lines = []
    for task, agent, sides in compared((each for each in outcomes if each.side in SIDES), alone):
        if not is_learned(sides):
            continue
        updates, theirs = min(each.updates for each in sides.values()), sides.get("theirs")
        are_timed = all_are_timed(sides, alone)
        for side, outcome in sides.items():
            curves, steps = np.array(outcome.success), np.array(outcome.steps)
            success = [tight(mean_interval(found)) for found in (curves[:, -1], success_after(outcome, updates))]
            own, other = outcome.steps_per_second(), theirs and theirs.steps_per_second()
            speed = f"{own:,.0f}" + (f" ({own / other:.1f}x)" if other and side != "theirs" else "")
            timed = [speed, outcome.to_success()] if are_timed else ["", ""]
            seeds = max(len(curves), outcome.side_by_side)
            lines.append([f"{task}, {agent}", f"{side}, {seeds}", f"{steps[-1] / 1e6:.2f}", *success, *timed])
    return lines


def success_after(outcome: Outcome, updates: float) -> np.ndarray:
    """Of each seed [seeds], at the evaluation next to so many updates."""
    return np.array(outcome.success)[:, np.abs(outcome.updates_at() - updates).argmin()]


def encoder_success(outcomes: Iterable[Outcome]) -> dict[tuple[str, str], dict[str, np.ndarray]]:
    """Success with each goal encoder, after the updates that all of a task and agent have: {(task, agent): {encoder:
    [seeds]}}, of those that an encoder ran on."""
    found = {}
    for task, agent, sides in compared((each for each in outcomes if each.side != "theirs"), []):
        updates = min(each.updates for each in sides.values())
        if len(sides) > 1:
            found[task, agent] = {
                side.removeprefix("ours").removeprefix("+") or "none": success_after(each, updates)
                for side, each in sides.items()
            }
    return found


def foot(outcomes: Iterable[Outcome]) -> str:
    """How success with goal encoders was measured, where and when."""
    own = [each for each in outcomes if each.side != "theirs"]
    seeds = max(each.side_by_side for each in own)
    return f"after equal updates, {seeds} seeds; {machines_in_words(each.machine for each in own)}."


HEAD = [
    "task",
    "program, seeds",
    "million steps",
    "success",
    "at equal updates",
    "steps/s",
    f"GPU s a seed to {SUCCESS}",
]


KINDS = {"beside": Outcome, "alone": Outcome, "parts": Parts}
"""What is kept: results of programs beside each other, and alone on the device, and the parts of an epoch."""


def load(paths: Iterable[Path], kind: type = Outcome) -> list[Any]:
    """The results of this kind that these files hold; none where there is no file."""
    return [kind(**each) for path in paths if path.exists() for each in json.loads(path.read_text())]


def read() -> dict[str, list[Any]]:
    """What is kept of each of `KINDS`."""
    kept = json.loads(trial_numbers.read_text(NUMBERS)) if NUMBERS.exists() else {}
    return {name: [kind(**each) for each in kept.get(name, [])] for name, kind in KINDS.items()}


def take(files: dict[str, list[Path]]) -> None:
    """Put the results of these files, by kind, into the numbers."""
    kept = read()
    for name, paths in files.items():
        own = {each.key(): each for each in [*kept[name], *load(paths, KINDS[name])]}
        kept[name] = [own[key] for key in sorted(own)]
    plain = {name: [dataclasses.asdict(each) for each in results] for name, results in kept.items()}
    trial_numbers.write_compressed(NUMBERS, json.dumps(plain))


def tables() -> dict[str, str]:
    """The tables of the page; none without numbers."""
    kept = read()
    if not kept["beside"]:
        return {}
    peers = [markdown_lines(HEAD, rows(kept["beside"], kept["alone"])), unlearned(kept["beside"])]
    return {
        "peers": "\n\n".join(filter(None, peers)),
        "parts": markdown_lines(HEAD_OF_PARTS, parts_rows(kept["parts"])),
    }


HEAD_OF_PARTS = ["task, agent, seeds", "environments", "collecting", "everything", "updates' share"]


def parts_rows(parts: Iterable[Parts]) -> list[list[str]]:
    """A row for each number of seeds."""
    return [
        [
            f"{each.task}, {each.agent}, {each.seeds}",
            *(f"{rate:,.0f}" for rate in (each.environments, each.collecting, each.everything)),
            f"{each.share_of_updates():.2f}",
        ]
        for each in parts
    ]


def draw(outcomes: Iterable[Outcome], alone: list[Outcome], path: Path) -> None:
    """Draw success against environment steps, and, where both sides were timed alone, against seconds of training a
    seed; a column for each task and agent that both sides ran, and one of them learned."""
    drawn = (each for each in outcomes if each.side in SIDES)
    columns = [each for each in compared(drawn, alone) if len(each[2]) > 1 and is_learned(each[2])]
    with figure_style():
        below = ("Mean over seeds, every seed a thin line; from three seeds on the 95 % interval.",)
        figure = empty_figure("Beside JaxGCRL", below, (2.3 * len(columns), 4.2))
        panels = figure.subplots(2, len(columns), squeeze=False, sharey=True)
        for (upper, lower), (task, agent, sides) in zip(panels.T, columns, strict=True):
            are_timed = all_are_timed(sides, alone)
            for side, outcome in sides.items():
                curves, colour = np.array(outcome.success), ROOM_COLOURS[SIDES.index(side)]
                draw_curve(upper, np.array(outcome.steps) / 1e6, curves, colour, side, SHARE)
                if are_timed:
                    draw_curve(lower, np.array(outcome.seconds) / outcome.side_by_side, curves, colour, side, SHARE)
            upper.set(title=f"{task}, {agent}", xlabel="million steps")
            lower.set(xlabel="GPU seconds a seed")
            lower.set_visible(are_timed)
            for axes in (upper, lower):
                finish_share_axis(axes, "success" if axes in panels[:, 0] else "")
        lines = {line.get_label(): line for axes in panels[0] for line in axes.get_lines()}
        shown = [side for side in SIDES if side in lines]
        panels[0, 0].legend([lines[side] for side in shown], shown, fontsize="x-small")
        save(figure, path)


def main() -> None:
    """Take what is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    parser.add_argument("--alone", nargs="*", type=Path, default=[], metavar="FILE")
    parser.add_argument("--parts", nargs="*", type=Path, default=[], metavar="FILE")
    words = parser.parse_args()
    take({"beside": words.files, "alone": words.alone, "parts": words.parts})
    print("\n\n".join(tables().values()))


if __name__ == "__main__":
    main()
