"""Our agents beside JaxGCRL's own programs, and with goal encoders before them: the results of
benchmarks/peers/jaxgcrl_peer.py.

    python -m infogoal_paper.jaxgcrl [FILE ...] [--alone FILE ...]    # put results into docs/results/jaxgcrl.json.xz
    python -m infogoal_paper.pages jaxgcrl                            # write the table of docs/reference/vectors.md

Programs that share a GPU say nothing about speed. `--alone` names results of a few rounds of each that had the GPU to
themselves: their seconds for a round stand in the table. What is there already of a program and seed is replaced.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

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

    def steps_per_second(self) -> float:
        """Environment steps of all seeds a second of training, updates included."""
        steps, seconds = self.steps[-1], self.seconds[-1]
        if len(self.steps) > 1:  # The first round may have a prefill, which is not in its seconds.
            steps, seconds = steps - self.steps[0], seconds - self.seconds[0]
        return self.side_by_side * steps / seconds

    def updates_per_second(self) -> float:
        """Updates of all seeds a second of training, environment steps included."""
        return self.side_by_side * self.updates / self.seconds[-1]

    def seconds_to_success(self) -> float:
        """Seconds a seed to the first evaluation with a mean success of `SUCCESS`; NaN if there is none."""
        enough = np.flatnonzero(np.mean(self.success, 0) >= SUCCESS)
        return self.seconds[enough[0]] / self.side_by_side if enough.size else float("nan")


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
    """The outcome with the seconds a step of the same program that ran alone, where it did: the median of its
    rounds."""
    found = [each for each in alone if each.program() == outcome.program()]
    if not found:
        return outcome
    rounds = np.concatenate([np.diff(each.seconds, prepend=0.0) / learnt_in(each) for each in found])
    seconds = float(np.median(rounds)) * np.cumsum(learnt_in(outcome))
    return dataclasses.replace(outcome, seconds=seconds.tolist(), machine=found[0].machine)


def learnt_in(outcome: Outcome) -> np.ndarray:
    """Environment steps of each round [evaluations]; the first, which may have a prefill, is as long as the second."""
    later = np.diff(outcome.steps)
    return np.concatenate([later[:1] if len(later) else outcome.steps, later])


def compared(outcomes: Iterable[Outcome], alone: list[Outcome]) -> Iterator[tuple[str, str, dict[str, Outcome]]]:
    """Task, agent and the outcome of each side, in order."""
    ordered = sorted(outcomes, key=lambda each: (*each.program(), each.seed))
    for (task, agent), both in groupby(ordered, key=lambda each: each.program()[:2]):
        own = {side: list(seeds) for side, seeds in groupby(both, key=lambda each: each.side)}
        yield task, agent, {side: timed_alone(joined(seeds), alone) for side, seeds in own.items()}


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
    """A row for each side of a task and agent that one of them learned; behind the speeds of ours stands how many times
    theirs they are, where both were timed alone."""
    lines, timed = [], {each.program() for each in alone}
    for task, agent, sides in compared((each for each in outcomes if each.side in SIDES), alone):
        if not is_learned(sides):
            continue
        reached, theirs = min(each.steps[-1] for each in sides.values()), sides.get("theirs")
        for side, outcome in sides.items():
            curves, steps = np.array(outcome.success), np.array(outcome.steps)
            alone_both = {(task, agent, side), (task, agent, "theirs")} <= timed
            success = [tight(mean_interval(found)) for found in (curves[:, -1], success_at(outcome, reached))]
            speeds = [
                f"{own:,.0f}" + (f" ({own / other:.1f}x)" if other and alone_both and side != "theirs" else "")
                for own, other in (
                    (outcome.steps_per_second(), theirs and theirs.steps_per_second()),
                    (outcome.updates_per_second(), theirs and theirs.updates_per_second()),
                )
            ]
            seconds = outcome.seconds_to_success()
            half = "never" if np.isnan(seconds) else f"{seconds:.1f}"
            seeds = max(len(curves), outcome.side_by_side)
            lines.append([f"{task}, {agent}", f"{side}, {seeds}", f"{steps[-1] / 1e6:.2f}", *success, *speeds, half])
    return lines


def success_at(outcome: Outcome, steps: float) -> np.ndarray:
    """Of each seed [seeds], at the evaluation next to so many steps."""
    return np.array(outcome.success)[:, np.abs(np.array(outcome.steps) - steps).argmin()]


def encoder_success(outcomes: Iterable[Outcome]) -> dict[tuple[str, str], dict[str, np.ndarray]]:
    """Success with each goal encoder, after the steps that all of a task and agent have: {(task, agent): {encoder:
    [seeds]}}, of those that an encoder ran on."""
    found = {}
    for task, agent, sides in compared((each for each in outcomes if each.side != "theirs"), []):
        reached = min(each.steps[-1] for each in sides.values())
        if len(sides) > 1:
            found[task, agent] = {
                side.removeprefix("ours").removeprefix("+") or "none": success_at(each, reached)
                for side, each in sides.items()
            }
    return found


def foot(outcomes: Iterable[Outcome]) -> str:
    """How success with goal encoders was measured, where and when."""
    own = [each for each in outcomes if each.side != "theirs"]
    seeds = max(each.side_by_side for each in own)
    return f"after equal steps, {seeds} seeds; {machines_in_words(each.machine for each in own)}."


HEAD = ["task", "program, seeds", "million steps", "success", "at equal steps"]
HEAD += ["steps/s", "updates/s", f"GPU s a seed to {SUCCESS}"]


def load(paths: Iterable[Path]) -> list[Outcome]:
    """The outcomes that these files hold; none where there is no file."""
    return [Outcome(**each) for path in paths if path.exists() for each in json.loads(path.read_text())]


def read() -> dict[str, list[Outcome]]:
    """What is kept: `beside` each other, and `alone`."""
    kept = json.loads(trial_numbers.read_text(NUMBERS)) if NUMBERS.exists() else {"beside": [], "alone": []}
    return {name: [Outcome(**each) for each in outcomes] for name, outcomes in kept.items()}


def take(beside: list[Path], alone: list[Path]) -> None:
    """Put these results into the numbers."""
    kept = read()
    for name, files in (("beside", beside), ("alone", alone)):
        own = {(*each.program(), each.seed): each for each in [*kept[name], *load(files)]}
        kept[name] = [own[key] for key in sorted(own)]
    plain = {name: [dataclasses.asdict(each) for each in outcomes] for name, outcomes in kept.items()}
    trial_numbers.write_compressed(NUMBERS, json.dumps(plain))


def tables() -> dict[str, str]:
    """The table of the page; none without numbers."""
    kept = read()
    lines = [markdown_lines(HEAD, rows(kept["beside"], kept["alone"])), unlearned(kept["beside"])]
    return {"peers": "\n\n".join(filter(None, lines))} if kept["beside"] else {}


def draw(outcomes: Iterable[Outcome], alone: list[Outcome], path: Path) -> None:
    """Draw success against environment steps, and against seconds of training a seed; a column for each task and agent
    that both sides ran, and one of them learned."""
    drawn = (each for each in outcomes if each.side in SIDES)
    columns = [each for each in compared(drawn, alone) if len(each[2]) > 1 and is_learned(each[2])]
    with figure_style():
        below = ("Mean over seeds, every seed a thin line; from three seeds on the 95 % interval.",)
        figure = empty_figure("Beside JaxGCRL", below, (2.3 * len(columns), 4.2))
        panels = figure.subplots(2, len(columns), squeeze=False, sharey=True)
        for (upper, lower), (task, agent, sides) in zip(panels.T, columns, strict=True):
            for side, outcome in sides.items():
                curves, colour = np.array(outcome.success), ROOM_COLOURS[SIDES.index(side)]
                draw_curve(upper, np.array(outcome.steps) / 1e6, curves, colour, side, SHARE)
                draw_curve(lower, np.array(outcome.seconds) / outcome.side_by_side, curves, colour, side, SHARE)
            upper.set(title=f"{task}, {agent}", xlabel="million steps")
            lower.set(xlabel="GPU seconds a seed")
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
    arguments = parser.parse_args()
    take(arguments.files, arguments.alone)
    print("\n\n".join(tables().values()))


if __name__ == "__main__":
    main()
