"""What the paper shows (Zou and Suzuki, IEEE TNNLS): its tables and figures in words, and Table I in numbers, the
success rates of every method. All tables that show the paper's numbers take them from here. Known without JAX."""

DESCRIPTIONS = {
    "table1": "Table I: success of every method on every task",
    "table2": "Table II: beta and accuracy that InfoGoal converges to",
    "fig8": "Fig. 8: sample efficiency and optimality with and without SSE-DB",
    "fig9": "Fig. 9: codes and trajectories under corruption, external rewards alone",
    "fig10": "Fig. 10: codes and trajectories on object search",
    "fig11": "Fig. 11: codes and flights on embodied question answering",
    "fig12": "Fig. 12: the intrinsic reward over states",
    "fig13": "Fig. 13: beta and accuracy while training",
    "fig14": "Fig. 14: codes under fixed beta",
    "fig15": "Fig. 15: success under fixed beta and under the adaptive one",
}

METHODS = {
    "infogoal": "InfoGoal",
    "infobot": "InfoBot",
    "cogoal": "COGOAL",
    "gcb": "GCB",
    "vae": "VAE",
    "dgrl": "DGRL",
    "rad": "RAD",
    "none": "DQN/HRAC/CQL",
    "her": "HER",
    "cher": "CHER",
    "ghrl": "GHRL",
}
"""The rows of Table I, in its order."""
BARE_AGENTS = {"object_search": "DQN", "embodied_qa": "CQL"}
"""The bare agent of a task; of the others it is HRAC."""
LEARNERS = ("infogoal", "infobot", "cogoal", "gcb", "vae", "dgrl", "rad")
WITH_LOSS = tuple(method for method in LEARNERS if method != "rad")
"""Methods with a loss of their own for the goal encoder; RAD augments what the agent's sees."""
TASKS = ("object_search", "object_manipulation", "fetch_reach", "fetch_push", "fetch_pick_and_place", "embodied_qa")
IMAGE_TASKS = TASKS[1:5]
"""Tasks with goals that are images: only they have corrupted goals."""

SENTENCES = {
    "infogoal": "“Since our InfoGoal adopts the idea of HER, in particular, we compare it to HER-based methods.”",
    "infobot": "none",
    "gcb": "none",
}
"""What the paper says of relabelling in learners that relabel in the reading `text`."""
AGAINST = "Algorithm 1 relabels nothing; its buffer has each transition with the goal that was desired"
"""What speaks for the reading `paper`."""

TEST = {
    "infogoal": (0.93, 0.92, 0.91, 0.84, 0.90, 1.0),
    "infobot": (0.85, 0.84, 0.70, 0.95, 0.72, 1.0),
    "cogoal": (0.45, 0.42, 0.34, 0.52, 0.17, None),
    "gcb": (0.41, 0.53, 0.59, 0.78, 0.61, 0.15),
    "vae": (0.21, 0.27, 0.22, 0.61, 0.37, None),
    "dgrl": (0.33, 0.41, 0.38, 0.70, 0.38, None),
    "rad": (0.19, 0.63, 0.33, 0.65, 0.33, None),
    "none": (0.18, 0.40, 0.06, 0.48, 0.19, 0.05),
    "her": (0.51, 0.88, 0.59, 0.75, 0.71, None),
    "cher": (0.53, 0.83, 0.48, 0.76, 0.67, None),
    "ghrl": (0.55, 0.84, 0.61, 0.81, 0.68, 0.65),
}
"""Test goals, by method, in the order of `TASKS`; None where the paper has a slash."""

CORRUPTED_TEST = {
    "infogoal": (0.95, 0.84, 0.74, 0.82),
    "infobot": (0.79, 0.80, 0.94, 0.76),
    "cogoal": (0.18, 0.0, 0.17, 0.0),
    "gcb": (0.35, 0.10, 0.28, 0.25),
    "vae": (0.19, 0.14, 0.51, 0.24),
    "dgrl": (0.25, 0.33, 0.50, 0.31),
    "rad": (0.44, 0.16, 0.46, 0.15),
    "none": (0.30, 0.09, 0.25, 0.23),
    "her": (0.52, 0.23, 0.48, 0.38),
    "cher": (0.50, 0.21, 0.52, 0.35),
    "ghrl": (0.48, 0.22, 0.48, 0.32),
}
"""Corrupted test goals, in the order of `IMAGE_TASKS`."""

CORRUPTED_TRAINING = {
    "infogoal": (1.0, 0.91, 0.88, 0.82),
    "infobot": (0.88, 0.76, 0.92, 0.69),
    "cogoal": (0.48, 0.12, 0.31, 0.17),
    "gcb": (0.75, 0.13, 0.38, 0.53),
    "vae": (1.0, 0.84, 1.0, 0.91),
    "dgrl": (1.0, 0.90, 0.98, 0.95),
    "rad": (0.66, 0.62, 0.62, 0.46),
    "none": (0.75, 0.67, 0.56, 0.62),
    "her": (0.69, 0.44, 0.53, 0.44),
    "cher": (0.69, 0.34, 0.59, 0.50),
    "ghrl": (0.72, 0.42, 0.78, 0.41),
}
"""Corrupted training goals, in the order of `IMAGE_TASKS`."""

TABLE = {
    "test_goal": (TASKS, TEST),
    "corrupted_test_goal": (IMAGE_TASKS, CORRUPTED_TEST),
    "corrupted_train_goal": (IMAGE_TASKS, CORRUPTED_TRAINING),
}
"""By kind of goals, which are named as in our metrics. The paper reports nothing for training goals."""


def reported(task: str, kind: str, method: str) -> str:
    """The paper's number with two decimals, or nothing where its table has none."""
    tasks, rows = TABLE.get(kind, ((), {}))
    value = dict(zip(tasks, rows.get(method, ()), strict=False)).get(task)
    return "" if value is None else f"{value:.2f}"


def title_of(task: str, method: str) -> str:
    """The name of a method where one task is shown: the bare agent has that of its agent."""
    return BARE_AGENTS.get(task, "HRAC") if method == "none" else METHODS[method]
