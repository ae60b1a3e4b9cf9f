"""Our offline agents beside OGBench's own programs: the results of benchmarks/peers/ogbench_peer.py.

    python -m infogoal_paper.ogbench [FILE ...]    # put results into docs/results/ogbench.jsonl.xz, print tables
    python -m infogoal_paper.pages ogbench         # write the tables of docs/research/speed.md

A file has a line for each evaluation of a program; the last line of a program has all before it, and counts. Results
at other sizes than OGBench's are not taken, but for the batch where goals are pictures, which their table says.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from infogoal_jax.errors import UserError
from infogoal_jax.report.statistics import mean_interval
from infogoal_paper import trial_numbers
from infogoal_paper.table_formats import machines_in_words, markdown_lines, tight

NUMBERS = Path(__file__).parents[1] / "docs" / "results" / "ogbench.jsonl.xz"
FIRST = "pointmaze-medium-navigate-v0"
"""The dataset that is shown first."""
NAMES = {"crl": "offline_crl"}
"""Agents that have another name here than in OGBench."""


@dataclasses.dataclass
class Outcome:
    """What a program did so far."""

    side: str
    agent: str
    learner: str
    seeds: list[int]
    data: str
    """Of which kind it was, and its size."""
    machine: str
    rate: float | None
    """Updates of all its seeds a second, alone on the device; None: not measured."""
    compiling: float
    """Seconds to make and compile it, beside the others."""
    updates: list[int]
    """Of a seed, at each evaluation."""
    success: list[list[list[float]]]
    """[seeds][evaluations][tasks]"""
    held_out: list[int]
    """Tasks whose goals' cells were out of training."""
    sizes: str = ""
    """Batch and layers in words, where they are not OGBench's."""
    own_sizes: bool = False
    """Whether it has other layers than the tables, or another batch than those of its goals."""
    noisy: list[list[list[float]]] = dataclasses.field(default_factory=list)
    """As success, where the policy is told its goals with an error, or sees their pictures under backgrounds; empty
    where that was not asked for."""
    noise: float = 0.0
    """Standard deviation of that error, in the units of a goal; or the weight of the backgrounds."""
    dataset: str = FIRST
    """Its name in OGBench, which says the environment."""
    goals: str = "states"
    """How the goal encoder sees goals: `states` or `images`."""

    def program(self) -> tuple:
        """What it is known by in the results."""
        return self.dataset, self.goals, self.side, self.agent, self.learner, tuple(self.seeds), *self.held_out


def read(paths: Iterable[Path]) -> dict[tuple, Outcome]:
    """The last outcome of each program that these files have, with the highest speed that was measured of it: what
    else ran on the device can only have made it slower."""
    found: dict[tuple, Outcome] = {}
    for path in paths:
        for line in trial_numbers.read_text(path).splitlines() if path.exists() else []:
            outcome = Outcome(**json.loads(line))
            before = found.get(outcome.program())
            if before is not None:
                rate = max(before.rate or 0.0, outcome.rate or 0.0) or None
                later = outcome if len(outcome.updates) >= len(before.updates) else before
                outcome = dataclasses.replace(later, rate=rate)
            found[outcome.program()] = outcome
    return found


def line_of(outcome: Outcome) -> str:
    """The line of an outcome."""
    return json.dumps(dataclasses.asdict(outcome)) + "\n"


def append(path: Path, outcome: Outcome) -> None:
    """Write an outcome as a line."""
    with path.open("a") as file:
        file.write(line_of(outcome))


def take(paths: Iterable[Path]) -> dict[tuple, Outcome]:
    """Put these results into the numbers."""
    found = read([NUMBERS, *paths])
    small = sorted({outcome.sizes for outcome in found.values() if outcome.own_sizes})
    if small:
        raise UserError(f"files: results with {small[0]}; give those with OGBench's sizes alone")
    trial_numbers.write_compressed(NUMBERS, "".join(map(line_of, found.values())))
    return found


def success_at(outcomes: Iterable[Outcome], updates: int, kind: str = "success") -> np.ndarray:
    """Success [seeds, tasks] of programs of one side after so many updates. kind: `success` or `noisy`."""
    return np.array(
        [
            seed[each.updates.index(updates)]
            for each in outcomes
            if updates in each.updates
            for seed in getattr(each, kind)
        ]
    )


def shown(success: np.ndarray) -> str:
    """Mean over tasks with the interval over seeds; nothing where there is none."""
    return tight(mean_interval(success.mean(-1))) if success.size else ""


def sides_of(outcomes: Iterable[Outcome]) -> dict[tuple[str, str], dict[str, list[Outcome]]]:
    """The programs of both sides, by agent and goal encoder."""
    found: dict[tuple[str, str], dict[str, list[Outcome]]] = {}
    for outcome in outcomes:
        found.setdefault((outcome.agent, outcome.learner), {"ours": [], "theirs": []})[outcome.side].append(outcome)
    return found


def last_common(sides: dict[str, list[Outcome]]) -> int:
    """The most updates after which every side that was evaluated was; 0 where none was."""
    marks = [
        {mark for each in of_side for mark in each.updates}
        for of_side in sides.values()
        if any(each.updates for each in of_side)
    ]
    return max(set.intersection(*marks), default=0) if marks else 0


def foot(outcomes: list[Outcome], marks: set[int]) -> str:
    """The line below a table: after how many updates, on which data, where and when."""
    found = "; ".join([*data_in_words(outcomes), machines_in_words(outcome.machine for outcome in outcomes)])
    return f"{found[:1].upper()}{found[1:]}." + (f" Success after {updates_in_words(marks)}." if marks else "")


def updates_in_words(marks: set[int]) -> str:
    """`15,000 updates`."""
    return f"{' or '.join(f'{mark:,}' for mark in sorted(marks))} updates"


def data_in_words(outcomes: list[Outcome]) -> list[str]:
    """What was learned from, and with which sizes where they are not OGBench's."""
    return sorted({word for outcome in outcomes for word in (outcome.data, outcome.sizes) if word})


def with_seeds(success: np.ndarray, usual: int) -> str:
    """As `shown`, with the number of seeds behind it where it is not the usual one."""
    return shown(success) + (f" ({len(success)})" if len(success) not in (0, usual) else "")


def of_seeds(usual: int, rows: list[list[str]]) -> str:
    """How many seeds success is of, behind `foot`."""
    others = any(cell.endswith(")") for row in rows for cell in row[-2:])
    return f" {usual} seeds" + (", or as in brackets." if others else ".")


def peers(outcomes: list[Outcome]) -> str:
    """Success of both sides after equal updates with 95 % intervals, and updates a second; behind ours stands how many
    times OGBench's they are."""
    sides = {key: found for key, found in sides_of(outcomes).items() if found["theirs"]}
    usual = max(len(outcome.seeds) for outcome in outcomes)
    rows, marks = [], set()
    for (agent, learner), found in sides.items():
        theirs = next((each.rate for each in found["theirs"] if each.rate), None)
        rates = [
            next((each.rate for each in found["ours"] if (len(each.seeds) > 1) == several and each.rate), None)
            for several in (True, False)
        ]
        speeds = [
            (f"{rate:,.0f}" if rate else "") + (f" ({rate / theirs:.1f}x)" if rate and theirs else "") for rate in rates
        ]
        last = last_common(found)
        marks |= {last} if last else set()
        success = [with_seeds(success_at(found[side], last), usual) for side in ("ours", "theirs")]
        name = f"`{NAMES.get(agent, agent)}`" + ("" if learner == "none" else f", {learner}")
        rows.append([name, *speeds, f"{theirs:,.0f}" if theirs else "", *success])
    head = ["agent", f"updates/s, {usual} seeds", "one seed", "OGBench's", "success", "OGBench's"]
    return f"{markdown_lines(head, rows)}\n\n{foot(outcomes, marks)}{of_seeds(usual, rows) if marks else ''}"


def encoder_success(outcomes: Iterable[Outcome]) -> tuple[dict[str, dict[str, dict[str, np.ndarray]]], set[int]]:
    """Success of goal encoders, {agent: {encoder: {goals: [seeds]}}}, and after how many updates. Goals are those as in
    training, those held out, and all where the policy is told its goals wrong, or sees their pictures under
    backgrounds."""
    found: dict[str, dict[str, dict[str, np.ndarray]]] = {}
    marks = set()
    for (agent, learner), sides in sides_of(outcomes).items():
        own = sides["ours"]
        last = max((mark for each in own for mark in each.updates), default=0)
        success, noisy = (success_at(own, last, kind) for kind in ("success", "noisy"))
        if len(success):
            marks.add(last)
            out = np.isin(np.arange(success.shape[1]) + 1, own[0].held_out)
            corrupted = "under backgrounds" if own[0].goals == "images" else "told wrong"
            parts = {"as in training": success[:, ~out], "held out": success[:, out], corrupted: noisy}
            means = {goals: each.mean(-1) for goals, each in parts.items() if each.size}
            found.setdefault(NAMES.get(agent, agent), {})[learner] = means
    return found, marks


def encoder_cells(outcomes: list[Outcome], usual: int) -> tuple[dict[str, dict[str, str]], set[int]]:
    """Success with goal encoders, {agent: {encoder: cell}}, and after how many updates. A cell has a number for each
    kind of goals of `encoder_success`, and how many seeds it is of where that is not the usual number."""
    found, marks = encoder_success(outcomes)
    cells: dict[str, dict[str, str]] = {}
    for agent, learners in found.items():
        for learner, parts in learners.items():
            seeds = len(next(iter(parts.values())))
            number = f" ({seeds})" if seeds != usual else ""
            cells.setdefault(agent, {})[learner] = (
                ", ".join(tight(mean_interval(each)) for each in parts.values()) + number
            )
    return cells, marks


def corruption_in_words(outcomes: list[Outcome]) -> str:
    """How goals are corrupted at test; empty where they are not."""
    noise = ", ".join(sorted({f"{outcome.noise:g}" for outcome in outcomes if outcome.noisy}))
    if outcomes[0].goals == "images":
        return f"with a background of weight {noise}"
    return f"told wrong by {noise} (standard deviation)" if noise else ""


def encoders(outcomes: list[Outcome]) -> str:
    """Success of goal encoders over several agents, and how it was measured."""
    usual = max(len(outcome.seeds) for outcome in outcomes)
    cells, marks = encoder_cells(outcomes, usual)
    told = corruption_in_words(outcomes)
    goals = "goals as in training, held out" + (f", all {told}" if told else "")
    said = f"{foot(outcomes, marks)} {usual} seeds. A cell: {goals}."
    learners = dict.fromkeys(learner for own in cells.values() for learner in own)
    rows = [[learner, *(own.get(learner, "") for own in cells.values())] for learner in learners]
    return f"{markdown_lines(['goal encoder', *(f'`{agent}`' for agent in cells)], rows)}\n\n{said}"


def groups(outcomes: Iterable[Outcome], held_out: bool) -> dict[str, list[Outcome]]:
    """The outcomes with goals held out of training, or without any, by their dataset and by what goals are, in words;
    `FIRST` first."""
    found: dict[str, list[Outcome]] = {}
    for each in sorted(outcomes, key=lambda each: (each.goals == "images", each.dataset != FIRST, each.dataset)):
        if bool(each.held_out) == held_out and (each.updates or not held_out):
            name = "-".join(each.dataset.split("-")[:2]) + (", pictures" if each.goals == "images" else "")
            found.setdefault(name, []).append(each)
    return found


def tables() -> dict[str, str]:
    """The tables of the page, one for each dataset; none without numbers."""
    found = groups(read([NUMBERS]).values(), held_out=False)
    return {name.replace("-", "_"): peers(outcomes) for name, outcomes in found.items()}


def in_words(outcomes: Iterable[Outcome]) -> str:
    """All tables, those of goals that are held out last."""
    found = [
        f"{name}\n\n{words(own)}"
        for held_out, words in ((False, peers), (True, encoders))
        for name, own in groups(outcomes, held_out).items()
    ]
    return "\n\n".join(found)


def main() -> None:
    """Take what is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    try:
        found = take(arguments.files) if arguments.files else read([NUMBERS])
    except UserError as error:
        parser.error(str(error))
    print(in_words(found.values()))


if __name__ == "__main__":
    main()
