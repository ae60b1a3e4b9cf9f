"""What is kept of the study of noise at test (noise.py), docs/results/noise.csv.xz, one row for every method, data set,
seed, epsilon and code; and the tables and the figure of docs/research/noise_at_test.md.

    task, method, data_set, seed     what was trained; data_set: number of the goal set
    epsilon, code                    probability of a random action at test; codes `sampled` a step, or their `mean`
    train, validation, test          success on these goals, and `corrupted_...` of each; empty where a task has none
    updates                          of each seed
    threshold, accuracy, beta,       of InfoGoal: the threshold; the highest accuracy of an epoch; beta at the end; the
    kl_half, kl                      KL in nats half way and at the end
    machine                          device, versions and date

HELD_OUT is the study of what carries the gain of InfoGoal with the head; a cell of `task` names its protocol too. Its
methods have rows at several updates: tables show the last ones that all of them made. HELD_OUT_FETCH is the same on
Fetch, under HRAC, at the end of the presets. READ has other readings of the paper: of a method
`infogoal+her@listed` the part behind @ is one of `READINGS`.

Two rules make noise equal. *The same for all*: every method at one epsilon. *Each at its own best*: every method at the
epsilon of `EPSILONS` at which it reaches the most validation goals, the smallest of equal ones; test goals have no say.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from infogoal_jax import presets
from infogoal_jax.errors import require
from infogoal_jax.hyperparameters import values_of
from infogoal_jax.report import canvas
from infogoal_jax.report.statistics import Interval, paired_difference
from infogoal_jax.report.summary import is_no_bottleneck
from infogoal_paper import claims, trial_numbers, tuning
from infogoal_paper.manifest import FETCH, RELABELLED
from infogoal_paper.paper import IMAGE_TASKS
from infogoal_paper.paper import METHODS as PAPER_METHODS
from infogoal_paper.scores import over_tasks
from infogoal_paper.table_formats import machines_in_words, markdown_lines, tight
from infogoal_paper.trial_numbers import Row

EPSILONS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
"""Probabilities of a random action at test."""
SEEDS = 5
TASKS = {
    "object_search": (7, 8, 9, tuning.SEED),
    "fetch_reach": (7, 8, 9),
    "embodied_qa": (7, 8, 9),
    "fetch_push": (7, 8, 9),
    "fetch_pick_and_place": (7, 8, 9),
    "object_manipulation": (7, 8, 9),
}
"""The tasks, with their data sets: ones that no choice has seen. Houses have no validation goals, but the one of the
tuning, which is not shown: it stands in for theirs."""
SHOWN = {task: f"{task}+unseen" if task in FETCH else task for task in TASKS}
"""By whose names the rows of presets go on each task; those of Fetch on its shipped goals, which choices have seen, go
by the task's own."""
METHODS = {
    "infogoal": "InfoGoal",
    "infogoal+her": "InfoGoal + HER",
    "her": "HER",
    "infobot": "InfoBot",
    "infobot+her": "InfoBot + HER",
    "cogoal": "COGOAL",
    "vae": "VAE",
    "rad": "RAD",
    "gcb": "GCB",
    "dgrl": "DGRL",
    "none": "bare agent",
    "cher": "CHER",
    "ghrl": "GHRL",
    "infogoal+all_goals": "InfoGoal + head",
    "gcb+her": "GCB + HER",
}
"""The methods, in the order in which they are run."""
HELD_OUT = "object_manipulation+dqn+held_out"
"""The cube under DQN, where test and validation goals never enter training."""
CARRYING = {
    "infogoal+all_goals": "InfoGoal + head",
    "infogoal+all_goals+beta_0": "InfoGoal, beta 0, + head",
    "cogoal+all_goals": "COGOAL + head",
    "vae+all_goals": "VAE + head",
    "all_goals": "plain head",
    "her": "HER",
}
"""What is compared there."""
ON_SHIPPED_GOALS = ("fetch_reach", "fetch_pick_and_place")
"""Fetch with its shipped goals, on which the paper is read in other ways, beside presets, and goals are held out."""
HELD_OUT_FETCH = tuple(f"{task}+hrac+held_out" for task in ON_SHIPPED_GOALS)
"""The same on Fetch, where no test goal is achieved in training."""
HELD_OUT_SHELF, HELD_OUT_HRAC = "embodied_qa+cql+held_out", "object_manipulation+hrac+held_out"
"""The same on the shelf, which recorded flights show, and on the cube under HRAC."""
HELD_OUT_BESIDE = (*HELD_OUT_FETCH, HELD_OUT_SHELF, HELD_OUT_HRAC)
ELSEWHERE = {(task, "infogoal+all_goals") for task in ("fetch_reach", "fetch_pick_and_place", "object_manipulation")}
"""What the studies of held-out goals show instead."""
CUBE_AGAIN = "object_manipulation+again"
"""The cube with settings that were chosen again."""
SEARCHING = "object_search+searching"
"""Object search with a memory, in other lengths of an episode, and InfoBot with other betas."""
FIRST_TRIALS = "object_search+small"
"""Object search with the small preset's floats, for as many epochs."""
CHOSEN_AGAIN = ("infogoal+her", "her", "infobot+her", "infogoal", "ghrl", "cher")
"""Methods whose floats are chosen again on Fetch, in order; on the cube InfoGoal alone stays at the floor."""
READ_METHODS = ("infogoal", "infogoal+her", "infobot+her", "her", "none")
"""Methods of which the paper is read in other ways, in order."""
SEARCHERS = ("none", "her", "infogoal", "infobot", "infogoal+her", "infobot+her")
"""Methods that are given a memory."""
BESIDE = {
    **{
        SHOWN[task]: (
            *(method for method in METHODS if (task, method) not in ELSEWHERE),
            *(f"{method}@clean" for method in CHOSEN_AGAIN),
        )
        for task in FETCH
    },
    **dict.fromkeys(ON_SHIPPED_GOALS, READ_METHODS),
    CUBE_AGAIN: tuple(f"{method}@clean" for method in CHOSEN_AGAIN if method != "infogoal"),
    FIRST_TRIALS: ("infogoal", "her"),
    SEARCHING: (
        *(f"{method}@memory" for method in SEARCHERS),
        *(f"{method}@steps_{steps}" for steps in (50, 300) for method in SEARCHERS[:4]),
        *("infobot@beta_0.001", "infobot@beta_0.01"),
    ),
}
"""The methods of studies that have few, in order."""
READINGS: dict[str, dict[str, Any]] = {
    "desired": {"desired_goals": "all"},
    "distance": {"learner.positives": "distance"},
    "listed": {"learner.positives": "listed"},
    "listed_1": {"learner.positives": "listed", "learner.radius": 0.05},
    "corrupted": {"training_corruption": 0.4},
    "listed_corrupted": {"learner.positives": "listed", "training_corruption": 0.4},
    "prefix": {"relabelling.strategy": "prefix"},
    "updates_100": {"updates_per_epoch": 100},
    "floor": {"hyper.learner.beta_floor": 1e-3},
    "clean": {},
    "memory": {"env.memory": True, "num_epochs": 1000},
    "steps_50": {"env.episode_length": 50},
    "steps_300": {"env.episode_length": 300},
    "beta_0.001": {"hyper.learner.beta": 1e-3},
    "beta_0.01": {"hyper.learner.beta": 1e-2},
}
"""Other readings of the paper, by what they change of the preset: all goals desired in training; similar goals by true
distance, of known goals or of the listed ones, also one step apart; training on corrupted images; the authors'
relabelling; 100 updates an epoch of as many steps. The rest are none: does a least beta mend the seed that collapsed?
What have methods with the floats of `tuning.clean_choices`, trained for as long as the bare agent? And what those of
`SEARCHING`?"""
GOALS_OF_HRAC = 32
"""Known goals of an update of the head there. The cube's preset has 512, for DQN; HRAC's actor acts for each."""
RADII = {"fetch_reach": 0.25, "fetch_pick_and_place": 0.15, "object_manipulation": 0.369}
"""Distances within which goals are similar there: the preset's window times the length of a step, 5 cm or 15 degrees
(in the unit of `goal_positions`)."""
ABOUT_GOALS = ("desired", "distance", "listed", "listed_1", "corrupted", "listed_corrupted")
OF_FETCH = (
    *(f"infogoal{added}@{reading}" for added in ("", "+her") for reading in ABOUT_GOALS),
    *("her@desired", "none@desired", "her@corrupted", "infogoal+her@prefix", "infobot+her@prefix"),
)
CLEAN = tuple(f"{method}@clean" for method in METHODS)
"""Methods with settings that were chosen again."""
READ = {
    "object_search+read": (
        *("infogoal@desired", "infogoal+her@desired", "her@desired", "none@desired"),
        *("infogoal+her@prefix", "infobot+her@prefix", "infogoal@floor"),
        *CLEAN,
    ),
    "fetch_reach+read": OF_FETCH,
    "fetch_pick_and_place+read": OF_FETCH,
    "object_manipulation+read": (
        *("infogoal@desired", "her@desired", "infogoal+her@desired", "none@desired", "infogoal+her@listed"),
        *("infogoal+her@prefix", "infogoal+her@updates_100", "her@updates_100"),
    ),
    "embodied_qa+read": CLEAN,
}
"""Which readings are run on each task, in order."""
NO_BETA, SMALL = {"learner.beta_step": 0.0, "learner.beta_start": 0.0}, {"learner_weight": 0.1}
FLOATS = {
    **{(task, "infogoal+all_goals+beta_0"): NO_BETA for task in (HELD_OUT, *HELD_OUT_BESIDE)},
    **{(task, f"{learner}+all_goals"): SMALL for task in (HELD_OUT, HELD_OUT_HRAC) for learner in ("cogoal", "vae")},
}
"""Floats that differ from the preset. Both small weights reach more validation goals than 1 on the cube of seed 7."""
DATA_SETS = (
    {SHOWN[task]: data_sets for task, data_sets in TASKS.items()}
    | dict.fromkeys(ON_SHIPPED_GOALS, (0,))
    | {HELD_OUT: (8, 9, 10)}
    | dict.fromkeys(HELD_OUT_FETCH, (0,))
    | {CUBE_AGAIN: (7, 8, 9)}
    | dict.fromkeys(READ, (0,))
    | {"object_search+read": TASKS["object_search"], "object_manipulation+read": (7,), "embodied_qa+read": (7, 8, 9)}
    | dict.fromkeys((FIRST_TRIALS, SEARCHING), TASKS["object_search"])
    | {HELD_OUT_SHELF: (7, 8, 9), HELD_OUT_HRAC: (8, 9, 10)}
)
"""All that is run, with its data sets. The cube of seed 7 chose among the weights of `FLOATS`."""


def methods_of(task: str) -> dict[str, str]:
    """The methods that are run on a task, with their names in words."""
    if task in READ:
        return {method: in_words(method) for method in READ[task]}
    if task in BESIDE:
        return {method: in_words(method) for method in BESIDE[task]}
    if task in (HELD_OUT, *HELD_OUT_BESIDE):
        return CARRYING
    return {method: words for method, words in METHODS.items() if (task, method) not in ELSEWHERE}


def floats_of(task: str, method: str) -> dict[str, float]:
    """Floats that a method has on a task in place of its preset's. Raises `UserError` for a clean choice that was not
    made."""
    plain, _, reading = method.partition("@")
    if task == FIRST_TRIALS:
        return values_of(presets.load("object_search", method, small=True).hyper)
    if reading != "clean":
        return FLOATS.get((task, method), {})
    chosen = tuning.clean_choices(task.partition("+")[0])
    require(plain in chosen, "methods", method, "no clean search is kept; run `infogoal_paper.tuning --clean` first")
    return chosen[plain]


def in_words(method: str) -> str:
    """A method and how the paper was read for it, in words."""
    plain, _, reading = method.partition("@")
    return METHODS[plain] + (f", {READING_WORDS[reading]}" if reading else "")


def settings_of(task: str, method: str) -> dict[str, Any]:
    """What a method changes of its preset on a task, but for floats."""
    settings = dict(READINGS.get(method.partition("@")[2], {}))
    if task == FIRST_TRIALS:
        settings = {"num_epochs": presets.load("object_search", method, small=True).num_epochs}
    if task == HELD_OUT_HRAC and "all_goals" in method:
        settings = {"agent.num_goals": GOALS_OF_HRAC}
    if method.endswith("@clean"):
        settings = {"num_epochs": presets.load(task.partition("+")[0], "none").num_epochs}
    if settings.get("learner.positives"):
        settings = {"learner.radius": RADII[task.partition("+")[0]]} | settings
    return settings


READING_WORDS = {
    "desired": "all goals desired",
    "distance": "similar by distance",
    "listed": "similar by distance, listed goals",
    "listed_1": "listed goals, one step apart",
    "corrupted": "trained on corrupted images",
    "listed_corrupted": "listed goals, corrupted images",
    "prefix": "the authors' relabelling",
    "updates_100": "100 updates an epoch",
    "floor": "beta of at least 0.001",
    "clean": "floats chosen again",
    "memory": "with a memory",
    "steps_50": "episodes of 50 steps",
    "steps_300": "episodes of 300 steps",
    "beta_0.001": "beta 0.001",
    "beta_0.01": "beta 0.01",
}


def missing(
    rows: Sequence[Row], tasks: Iterable[str], methods: Sequence[str] = (), data_sets: Sequence[int] = ()
) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """What is asked for of these tasks and has rows of fewer than `SEEDS` seeds: task, method and data sets. methods,
    data_sets: left out, those of the task."""
    kept: dict[tuple[str, str, int], set[int]] = {}
    for row in rows:
        kept.setdefault(run_key(row), set()).add(int(row["seed"]))
    for task in tasks:
        for method in methods or methods_of(task):
            numbers = data_sets or DATA_SETS[task]
            sets = tuple(number for number in numbers if len(kept.get((task, method, number), ())) < SEEDS)
            if sets:
                yield task, method, sets


TITLES = {
    "object_search": "object search",
    "fetch_reach": "FetchReach",
    "embodied_qa": "questions",
    "fetch_push": "FetchPush",
    "fetch_pick_and_place": "FetchPickAndPlace",
    "object_manipulation": "cube",
    HELD_OUT: "cube, held out",
    HELD_OUT_FETCH[0]: "FetchReach, held out",
    HELD_OUT_FETCH[1]: "FetchPickAndPlace, held out",
}
TITLES |= {task: TITLES[task.partition("+")[0]] for task in (*SHOWN.values(), *READ, CUBE_AGAIN)} | {
    FIRST_TRIALS: "object search, small",
    HELD_OUT_SHELF: "questions, held out",
    HELD_OUT_HRAC: "cube under HRAC, held out",
    SEARCHING: "object search",
}
SAME = 0.1
"""The epsilon that tables show as the same for all."""
PAIRS = (("infogoal", "her"), ("infogoal+her", "her"), ("infogoal+all_goals", "her"))
"""Methods whose difference is shown."""
CLEAN_PAIRS = dict.fromkeys(
    ("fetch_reach", "fetch_pick_and_place"),
    (("infogoal+her", "her"), ("infogoal+her", "infobot+her"), ("infogoal", "her")),
) | {
    "object_search": PAIRS,
    "object_manipulation": (("infogoal+her", "her"), ("infogoal+her", "infobot+her")),
    "embodied_qa": (*PAIRS, ("infogoal", "rad")),
}
"""And where settings were chosen again, on data that no choice has seen; on Push methods with HER are level."""
CARRYING_PAIRS = (
    *(("infogoal+all_goals", method) for method in CARRYING if method != "infogoal+all_goals"),
    ("cogoal+all_goals", "all_goals"),
)
"""And where all of `CARRYING` were run."""
SEARCHING_PAIRS = (("infogoal", "her"), ("infogoal+her", "her"))
"""And with and without a memory."""
LINES = {
    "infogoal": "tab:blue",
    "infogoal+her": "tab:cyan",
    "her": "tab:green",
    "infobot+her": "tab:purple",
    "cogoal": "tab:brown",
    "infogoal+all_goals": "tab:red",
    "none": "tab:orange",
}
"""Methods of the figure, with their colours."""
LEARNED = ("accuracy", "beta", "kl_half", "kl")
"""Columns of InfoGoal."""
NUMBERS = Path(__file__).parents[1] / "docs" / "results" / "noise.csv.xz"


def merge(folder: Path) -> list[str]:
    """Put the files of FOLDER into the numbers, in place of what they hold of the same tasks, methods and data sets.
    Returns the names of those that came in."""
    new = {found.stem: trial_numbers.read(found) for found in sorted(folder.glob("*.csv"))}
    pairs = [(task, method) for task in DATA_SETS for method in methods_of(task)]
    places = {pair: place for place, pair in enumerate(pairs)}
    rows = itertools.chain.from_iterable(new.values())
    trial_numbers.put(rows, NUMBERS, run_key, lambda row: places[row["task"], row["method"]])
    return list(new)


def run_key(row: Row) -> tuple[str, str, int]:
    """The task, method and data set of a row."""
    return row["task"], row["method"], int(row["data_set"])


def read() -> list[Row]:
    """The rows; none where nothing was run yet."""
    return trial_numbers.kept(NUMBERS)


def is_development(task: str, data_set: int) -> bool:
    """Whether a data set is there for its validation goals alone, and is not shown."""
    return task.partition("+")[0] == "object_search" and data_set == tuning.SEED


def at_shared_updates(rows: Sequence[Row]) -> list[Row]:
    """The rows without those of the held-out cube that are not at the last updates that all its runs made."""
    made: dict[tuple, set[int]] = {}
    for row in rows:
        if row["task"] == HELD_OUT:
            made.setdefault((row["method"], row["data_set"]), set()).add(int(row["updates"]))
    shared = max(set.intersection(*made.values()), default=None) if made else None
    return [row for row in rows if row["task"] != HELD_OUT or int(row["updates"]) == shared]


class Numbers:
    """The rows by what they are of. values: {(task, method, epsilon, code): {(data set, seed): row}}."""

    def __init__(self, rows: Sequence[Row]):
        self.values: dict[tuple, dict[tuple[int, int], Row]] = {}
        for row in at_shared_updates(rows):
            key = row["task"], row["method"], float(row["epsilon"]), row["code"]
            self.values.setdefault(key, {})[int(row["data_set"]), int(row["seed"])] = row

    def has(self, task: str, method: str) -> bool:
        """Whether the method was run on the task."""
        return (task, method, EPSILONS[0], "sampled") in self.values

    def success(
        self, task: str, method: str, epsilon: float, code: str = "sampled", kind: str = "test"
    ) -> dict[tuple[int, int], float]:
        """Success by data set and seed, of data sets that are shown; nothing for goals that a task does not have."""
        rows = self.values[task, method, epsilon, code]
        return {
            place: float(row[kind])
            for place, row in sorted(rows.items())
            if row.get(kind) and not is_development(task, place[0])
        }

    @functools.cached_property
    def shared_sets(self) -> dict[str, set[int]]:
        """The data sets of each task on which every method of it was run."""
        ran: dict[str, list[set[int]]] = {}
        for (task, *_), rows in self.values.items():
            ran.setdefault(task, []).append({data_set for data_set, _ in rows})
        return {task: set.intersection(*sets) for task, sets in ran.items()}

    def on_shared_sets(
        self, task: str, method: str, epsilon: float, code: str = "sampled", kind: str = "test"
    ) -> dict[tuple[int, int], float]:
        """`success` on `shared_sets`, so that means can be compared."""
        shared, found = self.shared_sets[task], self.success(task, method, epsilon, code, kind)
        return {place: value for place, value in found.items() if place[0] in shared}

    def best(self, task: str, method: str) -> float:
        """The epsilon at which the method reaches the most validation goals of `shared_sets`, sampled codes."""
        shared = self.shared_sets[task]

        def reached(epsilon: float) -> float:
            rows = self.values[task, method, epsilon, "sampled"].items()
            found = [float(row["validation"]) for (own, _), row in rows if own in shared and row["validation"]]
            return float(np.mean(found))

        return max(EPSILONS, key=lambda epsilon: (round(reached(epsilon), 6), -epsilon))


def success_table(numbers: Numbers) -> str:
    """A row for each method, a column for each task and kind of goals: success greedy, at `SAME`, at its own best."""
    images = [task for task in TASKS if task in IMAGE_TASKS]
    columns = [(task, "test") for task in TASKS] + [(task, "corrupted_test") for task in images]

    rows = [
        [title, *(three_of(numbers, SHOWN[task], kind, method) for task, kind in columns)]
        for method, title in METHODS.items()
    ]
    return markdown_lines(["method", *(goals_of(task, kind) for task, kind in columns)], rows)


def goals_of(task: str, kind: str) -> str:
    """Test goals of a task in words."""
    return TITLES[task] + ", corrupted" * (kind != "test")


def difference(numbers: Numbers, task: str, pair: tuple[str, str], kind: str, rule: str, code: str = "sampled"):
    """The paired difference of two methods, `Interval` of `paired_by_set`. rule: `best`, or an epsilon in words.
    None for goals that a task does not have."""
    values = []
    for method in pair:
        epsilon = numbers.best(task, method) if rule == "best" else float(rule)
        values.append(numbers.success(task, method, epsilon, code, kind))
    return paired_by_set(*values) if values[0].keys() & values[1].keys() else None


def mean_by_set(values: dict[tuple[int, int], float]) -> Interval:
    """The mean by (data set, seed), with the interval of `paired_by_set`."""
    return paired_by_set(values, dict.fromkeys(values, 0.0))


def paired_by_set(first: dict[tuple[int, int], float], second: dict[tuple[int, int], float]) -> Interval:
    """The mean difference of two methods by (data set, seed), with its interval over seeds or over data sets, whichever
    is wider."""
    differences: dict[int, list[float]] = {}
    for data_set, seed in sorted(first.keys() & second.keys()):
        differences.setdefault(data_set, []).append(first[data_set, seed] - second[data_set, seed])
    found = over_tasks([[np.array(each) for each in differences.values()]])
    return Interval(found.value, found.value - found.low, sum(map(len, differences.values())))


FIRST = tuple(
    (task, kind)
    for kind, tasks in (("test_goal", tuple(TASKS)), ("corrupted_test_goal", IMAGE_TASKS))
    for task in TASKS
    if task in tasks and (kind, task) not in claims.NOT_FIRST
)
"""Tasks and kinds of goals on which the paper has InfoGoal before every other method."""


def is_first(numbers: Numbers, task: str, kind: str, reading: str, rule: str) -> claims.Finding:
    """What is found of InfoGoal's place before every other method of Table I, as a claim is decided: seeds and data
    sets are paired, and the weakest difference decides. reading: a variant of Table I; rule: as in `difference`."""
    own = {
        method: f"{method}+her" if reading == "text" and method in RELABELLED else method for method in PAPER_METHODS
    }
    found, shown = [], SHOWN[task]
    for method, label in own.items():
        if method == "infogoal":
            continue
        if not (numbers.has(shown, label) and numbers.has(shown, own["infogoal"])):
            found.append(claims.Finding(None, f"{PAPER_METHODS[method]} not run"))
            continue
        first, second = (
            numbers.success(
                shown,
                each,
                numbers.best(shown, each) if rule == "best" else float(rule),
                kind=kind.removesuffix("_goal"),
            )
            for each in (own["infogoal"], label)
        )
        pairs: claims.Paired = {}
        for data_set, seed in first.keys() & second.keys():
            pairs.setdefault(data_set, {})[seed] = first[data_set, seed] - second[data_set, seed]
        found.append(dataclasses.replace(claims.finding({task: pairs}, ""), words=PAPER_METHODS[method]))
    return claims.weakest(found)


def first_table(numbers: Numbers) -> str:
    """A row for each task and kind of goals: whether InfoGoal is before every other method, under both readings of the
    paper and each way of making noise equal, with the least certain difference and to which method it is."""
    rows = []
    for task, kind in FIRST:
        row = [goals_of(task, kind.removesuffix("_goal"))]
        for reading in claims.READINGS:
            for rule in (str(SAME), "best"):
                found = is_first(numbers, task, kind, reading, rule)
                effect = "" if found.effect is None else f" {found.effect.value:+.2f}"
                row.append(f"{IS_FIRST[found.verdict]}{effect} {found.details}")
        rows.append(row)
    heads = [f"{words}, {rule}" for words in READING_NAMES for rule in (f"ε {SAME}", "own best")]
    return markdown_lines(["goals of", *heads], rows)


IS_FIRST = {"holds": "first", "fails": "**behind**", "cannot be told": "open"}
READING_NAMES = ("Algorithm 1", "text")
"""Of the readings `claims.READINGS`."""


def signed(interval: Interval) -> str:
    """A difference with its interval, bold where this excludes 0."""
    text = f"{interval.mean:+.2f}±{interval.half_width:.2f}"
    return f"**{text}**" if interval.low > 0 or interval.high < 0 else text


RULES = {
    "greedy": ("0", "sampled"),
    f"ε {SAME} for both": (str(SAME), "sampled"),
    "each at its own best": ("best", "sampled"),
    f"ε {SAME}, mean codes": (str(SAME), "mean"),
}
"""Columns of differences: the rule, and the codes."""


def difference_table(numbers: Numbers, tasks: Sequence[str], pairs: Sequence[tuple[str, str]]) -> str:
    """A row for each task, kind of goals and pair of methods: the difference by each of `RULES`."""
    rows = []
    for task, kind, pair in itertools.product(tasks, ("test", "corrupted_test"), pairs):
        if not all(numbers.has(task, method) for method in pair):
            continue
        found = [difference(numbers, task, pair, kind, *rule) for rule in RULES.values()]
        if None not in found:
            named = " - ".join(methods_of(task)[method].replace(" + ", "+") for method in pair)
            rows.append([goals_of(task, kind), named, *map(signed, found)])
    return markdown_lines(["test goals of", "difference", *RULES], rows)


FLOOR = "0.40"
"""Success on validation goals below which a method has no row in tables of clean choices."""


def finals_of(task: str, searches: dict[str, tuning.Search]) -> dict[str, tuning.Search]:
    """The finals of clean searches on a task by method."""
    named = {method: f"{tuning.CLEAN}/{task}/{method}/final" for method in METHODS}
    return {method: searches[name] for method, name in named.items() if name in searches}


CHOSEN_OF = SHOWN | {
    "object_search": "object_search+read",
    "embodied_qa": "embodied_qa+read",
    "object_manipulation": CUBE_AGAIN,
}
"""By whose names the rows go of floats that were chosen again, on each task."""
ENDINGS = {
    "object_search": "",
    "fetch_reach": "_reach",
    "fetch_push": "_push",
    "fetch_pick_and_place": "_pick_and_place",
    "object_manipulation": "_cube",
    "embodied_qa": "_questions",
}
"""Of the names of the tables of each task."""


def again(task: str, method: str) -> tuple[str, str]:
    """The task and method by whose names the rows of a clean choice go."""
    return CHOSEN_OF[task], f"{method}@clean"


def on_both(rows: Sequence[Row], numbers: Numbers, task: str) -> list[Row]:
    """The rows of presets and of clean choices on a task, of data sets on which all of both were run."""
    names = SHOWN[task], CHOSEN_OF[task]
    data_sets = set.intersection(*(numbers.shared_sets[name] for name in names))
    return [row for row in rows if row["task"] in names and int(row["data_set"]) in data_sets]


def clean_table(numbers: Numbers, task: str, searches: dict[str, tuning.Search]) -> str:
    """A row for each method whose settings were chosen again on a task: success of the preset and of what was chosen,
    on validation goals in the final, and on test goals, each at its own best noise. Methods on the floor with both are
    named below."""
    rows, low = [], {}
    for method, final in finals_of(task, searches).items():
        both = tuning.trial_of(final, 0), tuning.drawn_best(final)
        validation = [f"{np.mean(trial['success'][-1]):.2f}" for trial in both]
        if max(validation) < FLOOR:
            low[METHODS[method]] = max(validation)
            continue
        runs = [run for run in ((SHOWN[task], method), again(task, method)) if numbers.has(*run)]
        cells = [
            "→".join(f"{np.mean(found):.2f}" for run in runs if (found := reached_at_best(numbers, *run, kind)))
            for kind in kinds_of(task)
        ]
        rows.append([METHODS[method], "→".join(validation), *cells])
    below = f"{', '.join(low)}: at most {max(low.values())} of validation goals with either." if low else ""
    heads = [kind.replace("_", " ") for kind in kinds_of(task)]
    return f"{markdown_lines(['method', 'validation', *heads], rows)}\n\n{below}".rstrip()


def kinds_of(task: str) -> tuple[str, ...]:
    """The kinds of test goals that a task has."""
    return ("test", "corrupted_test") if task in IMAGE_TASKS else ("test",)


def reached_at_best(numbers: Numbers, task: str, method: str, kind: str) -> list[float]:
    """Success of a method at its own best noise, on data sets that all methods have."""
    return [*numbers.on_shared_sets(task, method, numbers.best(task, method), kind=kind).values()]


def clean_differences(numbers: Numbers, task: str, searches: dict[str, tuning.Search]) -> str:
    """A row for each pair of methods that was searched again on a task: the difference on validation goals in the
    finals, seeds paired, on test goals at `SAME` and at their own best, and on corrupted ones at the latter, as presets
    and with what was chosen."""
    rows, found = [], finals_of(task, searches)
    shown = {f"test, ε {SAME}": ("test", str(SAME)), "test, own best": ("test", "best")}
    if task in IMAGE_TASKS:
        shown["corrupted, own best"] = "corrupted_test", "best"
    for pair in CLEAN_PAIRS[task]:
        chosen = [again(task, method) for method in pair]
        if not (found.keys() >= set(pair) and all(numbers.has(*run) for run in chosen)):
            continue
        row = [" - ".join(METHODS[method].replace(" + ", "+") for method in pair)]
        for take in (lambda final: tuning.trial_of(final, 0), tuning.drawn_best):
            row.append(signed(paired_difference(*(take(found[method])["success"][-1] for method in pair))))
        for kind_and_rule in shown.values():
            row.append(signed(difference(numbers, SHOWN[task], pair, *kind_and_rule)))
            row.append(signed(difference(numbers, chosen[0][0], (chosen[0][1], chosen[1][1]), *kind_and_rule)))
        rows.append(row)
    heads = [f"{words}, {whose}" for words in ("validation", *shown) for whose in ("presets", "chosen")]
    return markdown_lines(["difference", *heads], rows)


def carries_differences(numbers: Numbers) -> str:
    """A column for each of `CARRYING_PAIRS`, a row for each task and kind of goals: own best noise/`SAME` on mean
    codes."""
    rows = []
    for task in (HELD_OUT, HELD_OUT_HRAC, HELD_OUT_SHELF):
        pairs = [pair if all(numbers.has(task, method) for method in pair) else None for pair in CARRYING_PAIRS]
        for kind in kinds_of(task.partition("+")[0]) if any(pairs) else ():
            rules = (("best", "sampled"), (str(SAME), "mean"))
            cells = (
                [signed(difference(numbers, task, pair, kind, *rule)) if pair else "" for pair in pairs]
                for rule in rules
            )
            rows.append([goals_of(task, kind), *("/".join(both) for both in zip(*cells, strict=True))])
    titles = (" - ".join(CARRYING[method].replace(" + ", "+") for method in pair) for pair in CARRYING_PAIRS)
    return markdown_lines(["test goals of", *titles], rows)


def carries_beside(numbers: Numbers) -> str:
    """A row for each method with and without the head on tasks of `HELD_OUT_BESIDE` that were run: success greedy, at
    `SAME` and at its own best."""
    tasks = [task for task in HELD_OUT_BESIDE if any(numbers.has(task, method) for method in CARRYING)]
    columns = [(task, kind) for task in tasks for kind in kinds_of(task.partition("+")[0])]
    rows = []
    for method, title in CARRYING.items():
        ran = [numbers.has(task, method) for task in tasks]
        if any(ran):
            rows.append([title, *(three_of(numbers, task, kind, method) for task, kind in columns)])
    return (
        markdown_lines(["method", *(goals_of(task, kind) for task, kind in columns)], rows) if rows else "Not run yet."
    )


def searching_table(numbers: Numbers) -> str:
    """Of object search as it is, and of each change of `SEARCHERS`, a column: success on test goals greedy/at `SAME`, a
    row for each method, and with a memory training goals at `SAME`. Then differences by both rules, seeds paired; bold:
    without 0. Below, InfoBot with other betas."""
    changes = ("memory", "steps_50", "steps_300")
    changes = [change for change in changes if numbers.has(SEARCHING, f"her@{change}")]
    columns = [("", "test")]
    columns += [(change, kind) for change in changes for kind in ("test", "train")[: 1 + (change == "memory")]]

    def reached(method: str, change: str, kind: str) -> list[dict[tuple[int, int], float]]:
        run = (SEARCHING, f"{method}@{change}") if change else ("object_search", method)
        epsilons = (0.0, SAME) if kind == "test" else (SAME,)
        return [numbers.success(*run, epsilon, kind=kind) for epsilon in epsilons] if numbers.has(*run) else []

    def means(method: str, change: str, kind: str) -> str:
        return "/".join(f"{np.mean(list(found.values())):.2f}" for found in reached(method, change, kind))

    def differences(pair: tuple[str, str], change: str, kind: str) -> str:
        both = zip(*(reached(method, change, kind) for method in pair), strict=False)
        return "/".join(signed(paired_by_set(*found)) for found in both) if kind == "test" else ""

    rows = [[METHODS[method], *(means(method, *column) for column in columns)] for method in SEARCHERS]
    rows += [
        [
            " - ".join(METHODS[method].replace(" + ", "+") for method in pair),
            *(differences(pair, *column) for column in columns),
        ]
        for pair in SEARCHING_PAIRS
    ]
    heads = [
        "its training goals" if kind == "train" else READING_WORDS.get(change, "preset") for change, kind in columns
    ]
    said = [
        f"InfoBot, {READING_WORDS[beta]}: {means('infobot', beta, 'test')}, {means('infobot', beta, 'train')} of its "
        "training goals."
        for beta in ("beta_0.001", "beta_0.01")
        if reached("infobot", beta, "test")
    ]
    return f"{markdown_lines(['', *heads], rows)}\n\n{' '.join(said)}".rstrip()


def three_of(numbers: Numbers, task: str, kind: str, method: str) -> str:
    """Success greedy, at `SAME` and at a method's own best, `0.80/0.82/0.83`; nothing where it was not run."""
    if not numbers.has(task, method):
        return ""
    epsilons = 0.0, SAME, numbers.best(task, method)
    values = [[*numbers.on_shared_sets(task, method, epsilon, kind=kind).values()] for epsilon in epsilons]
    return "/".join(f"{np.mean(each):.2f}" for each in values) if all(values) else ""


def readings_table(numbers: Numbers) -> str:
    """A row for each reading, a column for each task and kind of goals, in a cell the methods `READ_METHODS`, each at
    its own best noise: success, bold where it differs from that of the preset on the same seeds and data sets for sure,
    `-` where it was not run."""
    columns = [(task, "test") for task in READ if any(numbers.has(task, method) for method in READ[task])]
    columns += [(task, "corrupted_test") for task, _ in columns if task.partition("+")[0] in IMAGE_TASKS]

    def reached(task: str, method: str, kind: str) -> dict[tuple[int, int], float]:
        return numbers.success(task, method, numbers.best(task, method), kind=kind)

    def of_method(task: str, method: str, kind: str, reading: str) -> str:
        names = [name for name in READINGS if numbers.has(task, f"{method}@{name}")]
        preset = reached(task.partition("+")[0], method, kind) if names else {}
        if names and not reading:  # On the data sets on which there is something to compare it with.
            places = set().union(*(reached(task, f"{method}@{name}", kind) for name in names))
            return f"{np.mean([preset[place] for place in places & preset.keys()]):.2f}"
        if reading not in names:
            return "-"
        found = reached(task, f"{method}@{reading}", kind)
        gain = paired_by_set(found, preset)
        text = f"{np.mean([found[place] for place in found.keys() & preset.keys()]):.2f}"
        return f"**{text}**" if gain.low > 0 or gain.high < 0 else text

    rows = []
    for reading in ("", *READINGS):
        cells = [[of_method(*column[:1], method, column[1], reading) for method in READ_METHODS] for column in columns]
        cells = ["/".join(cell) if {*cell} != {"-"} else "" for cell in cells]
        if any(cells):
            rows.append([READING_WORDS.get(reading, "preset"), *cells])
    return markdown_lines(["reading", *(goals_of(task, kind) for task, kind in columns)], rows)


def carries_table(numbers: Numbers) -> str:
    """A row for each method on the held-out cube: validation, test and corrupted test goals greedy, at `SAME` and at
    its own best, and test goals on mean codes at `SAME`."""
    ran = [method for method in CARRYING if numbers.has(HELD_OUT, method)]
    if not ran:
        return "Not run yet."

    def shown(method: str, epsilon: float, kind: str, code: str = "sampled") -> str:
        return f"{np.mean(list(numbers.success(HELD_OUT, method, epsilon, code, kind).values())):.2f}"

    rows = []
    for method in ran:
        epsilons = 0.0, SAME, numbers.best(HELD_OUT, method)
        kinds = ("validation", "test", "corrupted_test")
        cells = ["/".join(shown(method, epsilon, kind) for epsilon in epsilons) for kind in kinds]
        rows.append([CARRYING[method], f"{epsilons[-1]:g}", *cells, shown(method, SAME, "test", "mean")])
    head = ["method", "best ε", "validation", "test", "corrupted test", f"test, ε {SAME}, mean code"]
    runs = {method: numbers.values[HELD_OUT, method, EPSILONS[0], "sampled"] for method in ran}
    (updates,) = {int(row["updates"]) for own in runs.values() for row in own.values()}
    cubes = {method: sorted({data_set for data_set, _ in own}) for method, own in runs.items()}
    most = max(cubes.values(), key=len)
    said = f"{len(runs[ran[0]]) // len(cubes[ran[0]])} seeds on each of the cubes {', '.join(map(str, most))}"
    fewer = [f"{CARRYING[method]} on {', '.join(map(str, own))}" for method, own in cubes.items() if own != most]
    said += "".join(f"; {words} alone" for words in fewer) + f". {updates:,} updates."
    return f"{markdown_lines(head, rows)}\n\n{said}"


def small_table(numbers: Numbers) -> str:
    """A row for each method with the small preset, and their difference, seeds paired: success at `SAME` on validation
    goals of the house of the tuning, and on test goals of houses that no choice has seen where they were run."""
    methods, columns = methods_of(FIRST_TRIALS), {}
    rows = {method: numbers.values[FIRST_TRIALS, method, SAME, "sampled"] for method in methods}
    for kind in ("validation", "test"):
        found = [
            {
                place: float(row[kind])
                for place, row in rows[method].items()
                if row[kind] and is_development(FIRST_TRIALS, place[0]) == (kind == "validation")
            }
            for method in methods
        ]
        if all(found):
            houses = sorted({number for number, _ in found[0]})
            cells = [*(tight(mean_by_set(own)) for own in found), signed(paired_by_set(*found))]
            columns[f"{kind} goals, house {', '.join(map(str, houses))}"] = cells
    heads = [*(f"{title}, `--small`" for title in methods.values()), " - ".join(methods.values())]
    lines = zip(heads, *columns.values(), strict=True)
    first = next(iter(rows["her"].values()))
    seeds = len({seed for _, seed in rows["her"]})
    said = f"{seeds} seeds, {int(first['updates']):,} updates, ε {SAME}; {first['machine']}."
    return f"{markdown_lines(['', *columns], [*map(list, lines)])}\n\n{said}"


def is_collapsed(row: Row) -> bool:
    """Whether the codes of a seed are no bottleneck."""
    return bool(is_no_bottleneck(*(float(row[name]) for name in ("beta", "kl_half", "kl"))))


def collapse_line(numbers: Numbers) -> str:
    """How many seeds of InfoGoal collapsed, and what came of each."""
    rows = [
        row
        for (_, method, epsilon, code), found in numbers.values.items()
        if method.startswith("infogoal") and "beta_0" not in method and (epsilon, code) == (SAME, "sampled")
        for row in found.values()
    ]
    said = [
        f"{TITLES[row['task']]}, {methods_of(row['task'])[row['method']]}, data set {row['data_set']}, "
        f"seed {row['seed']}: beta {float(row['beta']):.0e}, KL {float(row['kl']):,.0f} nats, "
        f"{float(row['train']):.2f} of the training goals"
        for row in filter(is_collapsed, rows)
    ]
    return f"{len(said)} of {len(rows)} seeds: {'; '.join(said)}."


def tables(rows: Sequence[Row]) -> dict[str, str]:
    """The tables of docs/research/noise_at_test.md by name, and that of the small preset, which has no part in the
    others; none before the study was run."""
    if not rows:
        return {}
    first_trials = [row for row in rows if row["task"] == FIRST_TRIALS]
    rows = [row for row in rows if row["task"] != FIRST_TRIALS]
    numbers = Numbers(rows)
    machines = machines_in_words(sorted({row["machine"] for row in rows}))
    ran, beside = {row["task"] for row in rows}, {"small": small_table(Numbers(first_trials))} if first_trials else {}
    if ran & READ.keys():
        beside |= {"readings": readings_table(numbers)}
    if ran & set(HELD_OUT_BESIDE):
        beside |= {"carries_beside": carries_beside(numbers)}
    if SEARCHING in ran:
        beside |= {"searching": searching_table(numbers)}
    searches = tuning.load(tuning.NUMBERS)
    for task, ending in ENDINGS.items():
        if any(numbers.has(*again(task, method)) for method in finals_of(task, searches)):
            shown = Numbers(on_both(rows, numbers, task)), task, searches
            beside[f"clean{ending}"] = clean_table(*shown)
            if task in CLEAN_PAIRS:
                beside[f"clean{ending}_differences"] = clean_differences(*shown)
    return beside | {
        "differences": difference_table(numbers, list(SHOWN.values()), PAIRS),
        "first": first_table(numbers),
        "carries": carries_table(numbers),
        "carries_differences": carries_differences(numbers),
        "success": success_table(numbers),
        "collapse": collapse_line(numbers),
        "machine": f"Measured on {machines}.",
    }


def figure(rows: Sequence[Row]) -> Figure:
    """Success on test goals against epsilon, a panel a task: mean over seeds and data sets with its 95 % band; dashed:
    on mean codes."""
    numbers = Numbers(rows)
    words = "mean over seeds and data sets with its 95 % interval, over seeds or over data sets, whichever is wider"
    below = (f"Lines: sampled codes, {words}. Dashed: mean codes.",)
    drawn = canvas.empty_figure("Test goals reached, by the probability of a random action at test", below, (15, 3.8))
    panels = drawn.subplots(1, len(TASKS), sharey=True)
    for axes, task in zip(panels, TASKS, strict=True):
        for method, colour in LINES.items():
            if not numbers.has(SHOWN[task], method):
                continue
            for code, style in (("sampled", "-"), ("mean", "--")):
                found = [mean_by_set(numbers.on_shared_sets(SHOWN[task], method, each, code)) for each in EPSILONS]
                label = METHODS[method] if code == "sampled" else ""
                axes.plot(EPSILONS, [each.mean for each in found], color=colour, linestyle=style, label=label)
                if code == "sampled":
                    band = [each.low for each in found], [each.high for each in found]
                    axes.fill_between(EPSILONS, *band, color=colour, alpha=0.15, linewidth=0)
        axes.set_title(TITLES[task])
        axes.set_xlabel("probability of a random action")
        canvas.finish_share_axis(axes, "")
    panels[0].set_ylabel("success on test goals")
    drawn.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")
    return drawn
