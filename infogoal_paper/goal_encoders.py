"""Success with each goal encoder on other people's benchmarks, of what jaxgcrl.py and ogbench.py keep; and where
InfoGoal's differs clearly from that without an encoder.

python -m infogoal_paper.pages goal_encoders    # write both tables into docs/research/continuous_goals.md
"""

import numpy as np

from infogoal_jax.report.statistics import mean_interval
from infogoal_paper import jaxgcrl, ogbench
from infogoal_paper.table_formats import machines_in_words, markdown_lines, tight

ENCODERS = {
    "none": "none",
    "infogoal": "InfoGoal",
    "infogoal, beta 0": "InfoGoal, beta 0",
    "vae": "VAE",
    "cogoal": "COGOAL",
}
"""The columns, with their names in words."""


Success = dict[tuple[str, str], dict[str, dict[str, np.ndarray]]]
"""{(task, agent): {encoder: {goals: [seeds]}}}"""


def success_table(online: list[jaxgcrl.Outcome], offline: list[ogbench.Outcome]) -> str:
    """A row for each task and agent, those of JaxGCRL first; below it how success was measured on each."""
    cells: dict[tuple[str, str], dict[str, str]] = {
        place: {encoder: tight(mean_interval(success)) for encoder, success in own.items()}
        for place, own in jaxgcrl.encoder_success(online).items()
    }
    notes = {"JaxGCRL's": jaxgcrl.foot(online)} if cells else {}
    tasks = ogbench.groups(offline, held_out=True)
    shown = [outcome for outcomes in tasks.values() for outcome in outcomes]
    usual = max((len(outcome.seeds) for outcome in shown), default=0)
    marks: set[int] = set()
    data: dict[str, str] = {}
    for task, outcomes in tasks.items():
        own, found = ogbench.encoder_cells(outcomes, usual)
        cells |= {(task, agent): each for agent, each in own.items() if len(each) > 1}
        marks |= found
        data[task] = "; ".join(filter(None, [*ogbench.data_in_words(outcomes), ogbench.corruption_in_words(outcomes)]))
    if shown:
        after, machines = ogbench.updates_in_words(marks), machines_in_words(outcome.machine for outcome in shown)
        notes["OGBench's"] = f"after {after}, {usual} seeds; {machines}. Goals as in training, held out, corrupted."
    rows = [
        [f"{task}, `{agent}`", *(own.get(encoder, "") for encoder in ENCODERS)] for (task, agent), own in cells.items()
    ]
    listed = "\n".join(f"- {name}: {note}" for name, note in (notes | data).items())
    return f"{markdown_lines(['task, agent', *ENCODERS.values()], rows)}\n\n{listed}"


def all_success(online: list[jaxgcrl.Outcome], offline: list[ogbench.Outcome]) -> Success:
    """Success on both benchmarks."""
    found: Success = {
        place: {encoder: {"": success} for encoder, success in own.items()}
        for place, own in jaxgcrl.encoder_success(online).items()
    }
    for task, outcomes in ogbench.groups(offline, held_out=True).items():
        found |= {(task, agent): own for agent, own in ogbench.encoder_success(outcomes)[0].items()}
    return found


def clear_table(success: Success) -> str:
    """InfoGoal minus each other encoder, paired by seed, where it differs clearly from none: where the 95 % interval of
    that difference leaves out 0. Below it, of how many comparisons these are, and how many of those come by chance."""
    others = [encoder for encoder in ENCODERS if encoder != "infogoal"]
    rows, compared = [], 0
    for (task, agent), own in success.items():
        for goals, found in own.get("infogoal", {}).items():
            differences = {
                other: mean_interval(found - own[other][goals]) for other in others if goals in own.get(other, {})
            }
            against_none = differences.get("none")
            if against_none is None or not np.isfinite(against_none.half_width):
                continue
            compared += 1
            if against_none.low > 0 or against_none.high < 0:
                cells = (tight(differences[other]) if other in differences else "" for other in others)
                rows.append([", ".join(filter(None, (task, f"`{agent}`", goals))), *cells])
    head = ["task, agent, goals", *(f"- {ENCODERS[other]}" for other in others)]
    counts = f"{len(rows)} of {compared} comparisons with none; {0.05 * compared:.1f} come by chance."
    return f"{markdown_lines(head, rows)}\n\n{counts}"


def tables() -> dict[str, str]:
    """The tables of the page; none without numbers."""
    online, offline = jaxgcrl.read()["beside"], list(ogbench.read([ogbench.NUMBERS]).values())
    if not online and not offline:
        return {}
    return {"success": success_table(online, offline), "clear": clear_table(all_success(online, offline))}
