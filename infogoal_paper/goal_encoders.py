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
    rows, notes = [], []
    for (task, agent), cells in jaxgcrl.encoder_cells(online).items():
        rows.append([f"{task}, `{agent}`", *(cells.get(encoder, "") for encoder in ENCODERS)])
    if rows:
        notes.append(f"JaxGCRL's: {jaxgcrl.foot(online)}")
    for name, outcomes in ogbench.groups(offline, held_out=True).items():
        own, foot = ogbench.encoder_cells(outcomes)
        for agent, cells in own.items():
            rows.append([f"{name}, `{agent}`", *(cells.get(encoder, "") for encoder in ENCODERS)])
        notes.append(f"{name}: {foot}")
    listed = "\n".join(f"- {note}" for note in notes)
    return f"{markdown_lines(['task, agent', *ENCODERS.values()], rows)}\n\n{listed}"


def tables() -> dict[str, str]:
    """The table of the page; none without numbers."""
    online, offline = jaxgcrl.read()["beside"], list(ogbench.read([ogbench.NUMBERS]).values())
    return {"success": table(online, offline)} if online or offline else {}
