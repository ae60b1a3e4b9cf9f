"""Success with each goal encoder on other people's benchmarks, in one table: what jaxgcrl.py and ogbench.py keep.

python -m infogoal_paper.pages goal_encoders    # write it into docs/research/continuous_goals.md
"""

from infogoal_paper import jaxgcrl, ogbench
from infogoal_paper.table_formats import markdown_lines

ENCODERS = {
    "none": "none",
    "infogoal": "InfoGoal",
    "infogoal, beta 0": "InfoGoal, beta 0",
    "vae": "VAE",
    "cogoal": "COGOAL",
}
"""The columns, with their names in words."""


def table(online: list[jaxgcrl.Outcome], offline: list[ogbench.Outcome]) -> str:
    """A row for each task and agent, those of JaxGCRL first; below it how success was measured on each."""
    cells = jaxgcrl.encoder_cells(online)
    notes = {"JaxGCRL's": jaxgcrl.foot(online)} if cells else {}
    for task, outcomes in ogbench.groups(offline, held_out=True).items():
        own, notes[task] = ogbench.encoder_cells(outcomes)
        cells |= {(task, agent): found for agent, found in own.items()}
    rows = [
        [f"{task}, `{agent}`", *(own.get(encoder, "") for encoder in ENCODERS)] for (task, agent), own in cells.items()
    ]
    listed = "\n".join(f"- {name}: {note}" for name, note in notes.items())
    return f"{markdown_lines(['task, agent', *ENCODERS.values()], rows)}\n\n{listed}"


def tables() -> dict[str, str]:
    """The table of the page; none without numbers."""
    online, offline = jaxgcrl.read()["beside"], list(ogbench.read([ogbench.NUMBERS]).values())
    return {"success": table(online, offline)} if online or offline else {}
