"""Which runs each table and figure of the paper is made of.

A run is a method on a task and one of its goal sets, with all its seeds. Table I has three variants. In `paper` HER,
CHER and GHRL alone relabel, as in Algorithm 1; in `her` every learner is given HER besides; in `text` those of
`RELABELLED` are, and its rows are rows of the other two. The first and the last are the readings of the paper under
which claims are decided. Beside the paper stands the study of learning from all goals at once
(docs/research/all_goals.md), under two protocols of known goals.
"""

import dataclasses
import functools
from collections.abc import Collection
from typing import Any, NamedTuple

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import require
from infogoal_paper.paper import LEARNERS, METHODS, TASKS

VARIANTS = {
    "paper": "relabelling as in Algorithm 1",
    "her": "every learner with HER",
    "text": "InfoGoal, InfoBot and GCB with HER",
}
RELABELLED = ("infogoal", "infobot", "gcb")
"""Learners that relabel in the reading `text`."""
SETS = {"object_search": (0, 1, 2), "object_manipulation": (0, 1, 2), "embodied_qa": (0, 1, 2)}
"""Goal sets of a task: seeds of the house, of the cube with its poses and of the shelf, none of which was used for
tuning. Fetch has the shipped goal images as set 0, and further ones where a folder of them is given."""
FETCH = presets.FETCH_TASKS
DRAWN = ("infogoal", "infobot", "gcb", "none")
"""Methods whose codes and trajectories Figures 9, 10 and 11 show."""
EXTERNAL = ("external reward alone", (("intrinsic_weight", 0.0),))
"""The setting without intrinsic reward: its name and floats."""
FIXED_BETAS = (1e-4, 1e-3, 1e-2, 1e-1)
PRESET = ("preset", ())
ALL_GOALS = {
    "none": "bare agent",
    "her": "HER",
    "leo": "LEO",
    "all_goals": "all-goals head",
    "infogoal+all_goals": "InfoGoal + head",
    "infobot+all_goals": "InfoBot + head",
}
"""The rows of the study of all goals at once."""
AGENTS = {"object_search": None, "object_manipulation": "dqn", "embodied_qa": None}
"""Its tasks, with the agent where it is not the task's own."""
PROTOCOLS = {"visited": "goals that are achieved may enter", "held_out": "test and validation goals never enter"}
"""Of known goals."""


def fixed(beta: float) -> tuple[str, tuple]:
    """The setting of InfoGoal with this beta from the first update to the last: its name and floats."""
    return f"beta {beta:g}", (("learner.beta_start", beta), ("learner.beta_step", 0.0))


QUICK = {
    "object_search": ("infogoal", "infobot", "gcb", "none", "her"),
    "object_manipulation": ("infogoal", "infobot", "gcb", "none"),
    "fetch_reach": ("infogoal",),
    "fetch_push": ("infogoal",),
    "fetch_pick_and_place": ("infogoal", "none"),
    "embodied_qa": ("infogoal", "infobot", "gcb", "none", "her"),
}
"""Methods of each task at toy size: those that figures show, and a relabelling. Robots compile for minutes."""
QUICK_ALL_GOALS = {
    "object_search": ("her", "leo", "all_goals", "infobot+all_goals", "all_goals+held_out"),
    "object_manipulation": ("leo+dqn", "infogoal+all_goals+dqn"),
    "embodied_qa": ("leo", "all_goals"),
}
"""Of the study of all goals at once, labels of the runs at toy size, on the first goal set."""
QUICK_SEEDS = 2


class Setting(NamedTuple):
    """What a run changes in the float hyperparameters of its preset. values: (dotted name, float)."""

    name: str
    values: tuple[tuple[str, float], ...]


@dataclasses.dataclass(frozen=True)
class Run:
    """A method on a goal set of a task, with its seeds.

    task, method: names.
    relabelling, explorer: other parts than the method's, or None; `all_goals`, which was a relabelling, stands for an
      agent that learns from all goals at once.
    goal_set: number of the goal set.
    setting: a setting of floats.
    seeds: their numbers.
    toy: at a size at which nothing is learned.
    agent: another than the task's own, or None.
    known_goals: which goals may enter training, as in `TrainConfig`.
    """

    task: str
    method: str
    relabelling: str | None
    explorer: str | None
    goal_set: int
    setting: Setting
    seeds: tuple[int, ...]
    toy: bool = False
    agent: str | None = None
    known_goals: str = "visited"

    @property
    def label(self) -> str:
        """The method with what was added to it: `infogoal`, `infogoal+her`, `none+unrelabelled`, `leo+dqn+held_out`."""
        added = {"none": "unrelabelled"}.get(self.relabelling or "", self.relabelling)
        protocol = None if self.known_goals == "visited" else self.known_goals
        return "+".join(part for part in (self.method, added, self.explorer, self.agent, protocol) if part)

    @property
    def name(self) -> str:
        """What tells the run from all others; its folder below the one that is given."""
        words = [self.task, self.label, self.setting.name.replace(" ", "_"), f"set_{self.goal_set}"]
        seeds = f"seeds_{self.seeds[0]}-{self.seeds[-1]}"
        return "/".join([*words, seeds + "_toy" * self.toy])

    @property
    def of_paper(self) -> bool:
        """Whether the paper has such a run. The others are those of the study of all goals at once alone."""
        plain = self.agent is None and self.known_goals == "visited"
        return plain and self.method not in ("leo", "all_goals") and self.relabelling != "all_goals"

    @property
    def row(self) -> tuple:
        """What the runs of a row of a table share: all but the goal set and the seeds."""
        of_method = self.task, self.method, self.relabelling, self.explorer, self.setting.name
        return *of_method, self.agent, self.known_goals

    def preset(self) -> TrainConfig:
        """The preset of the method on the task, before a goal set is chosen."""
        return preset_of(self.task, self.method, self.relabelling, self.explorer, self.agent, self.known_goals)


@functools.cache
def preset_of(task: str, method: str, relabelling: Any, explorer: Any, agent: Any, known_goals: str) -> TrainConfig:
    """`Run.preset`, which tables and claims ask for thousands of times; a process has one set of presets."""
    named = f"{method}+{relabelling}" if relabelling else method
    return presets.load(task, named, explorer=explorer, agent=agent, known_goals=known_goals)


class Choice(NamedTuple):
    """What was asked for. Empty or None: all. seeds: how many; toy: a few runs of each kind, at a size at which nothing
    is learned. variants are those of Table I, known_goals those of the study of all goals at once."""

    tasks: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    variants: tuple[str, ...] = ("paper",)
    sets: tuple[int, ...] | None = None
    seeds: int = 5
    toy: bool = False
    known_goals: tuple[str, ...] = ()

    def check(self, tasks: Collection[str], methods: Collection[str]) -> None:
        """Raise `UserError` for names that are none, or not among these tasks and methods."""
        known = {"tasks": tasks, "methods": methods, "variants": VARIANTS, "known_goals": PROTOCOLS}
        for field, names in known.items():
            for name in getattr(self, field):
                require(name in names, field, name, f"give some of {', '.join(names)}")
        require(0 < self.seeds <= 1000, "seeds", self.seeds, "give 1 to 1000")
        for number in self.sets or ():
            require(number >= 0, "sets", number, "give 0 or more")

    def sets_of(self, task: str, fetch_sets: tuple[int, ...] = (0,)) -> tuple[int, ...]:
        """The goal sets of a task that are asked for. fetch_sets: those that there are images of."""
        there = SETS.get(task, fetch_sets)
        return there if self.sets is None else tuple(number for number in there if number in self.sets)


def parts_of(variant: str, task: str, method: str) -> tuple[str | None, str | None] | None:
    """(method's relabelling, explorer) of a row of Table I; None where the variant has no such row.

    The shelf's preset relabels every method with the names of objects. In the paper's variant the bare agent does not.
    """
    own = presets.registry[task].relabelling
    if variant == "text":
        variant = "her" if method in RELABELLED else "paper"
    if variant == "paper":
        return ("none", None) if method == "none" and own != "none" else (None, None)
    if method in LEARNERS:
        return (None if own == "her" else "her"), None
    return (None, None) if method == "her" else None


def table1(choice: Choice, fetch_sets: tuple[int, ...] = (0,)) -> list[Run]:
    """Table I: every method on every goal set of every task."""
    return [
        Run(task, method, *parts, goal_set, Setting(*PRESET), tuple(range(choice.seeds)), choice.toy)
        for task in choice.tasks or TASKS
        for variant in choice.variants
        for method in choice.methods or METHODS
        if (parts := parts_of(variant, task, method)) is not None
        for goal_set in choice.sets_of(task, fetch_sets)
    ]


def of_methods(
    choice: Choice, tasks: tuple[str, ...], methods: tuple[str, ...], setting=PRESET, explorer=None, seeds: int = 0
) -> list[Run]:
    """The runs of some methods on the first goal set of some tasks, those that were asked for. seeds: how many, 0: as
    many as were asked for."""
    numbers = tuple(range(seeds or choice.seeds))
    return [
        Run(task, method, parts_of("paper", task, method)[0], explorer, 0, Setting(*setting), numbers, choice.toy)
        for task in tasks
        if task in (choice.tasks or TASKS)
        for method in methods
        if method in (choice.methods or METHODS)
    ]


def fig8(choice: Choice) -> list[Run]:
    """Fig. 8: sample efficiency and optimality with and without SSE-DB, on object search."""
    return [
        run
        for explorer in (None, "sse_db")
        for run in of_methods(choice, ("object_search",), ("none", "infobot", "infogoal"), explorer=explorer)
    ]


def fig9(choice: Choice) -> list[Run]:
    """Fig. 9: codes and trajectories under corruption, with external rewards alone. Methods without an intrinsic reward
    are as in Table I."""
    tasks = fetch, cube = ("fetch_pick_and_place", "object_manipulation")
    return [
        *of_methods(choice, (fetch,), ("infogoal",), EXTERNAL),  # With all seeds: Fig. 15 has them too.
        *of_methods(choice, (fetch,), ("infobot",), EXTERNAL, seeds=1),
        *of_methods(choice, (cube,), ("infogoal", "infobot"), EXTERNAL, seeds=1),
        *of_methods(choice, tasks, ("gcb", "none")),
    ]


def fixed_betas(choice: Choice, tasks: tuple[str, ...], betas: tuple[float, ...]) -> list[Run]:
    """InfoGoal as it is, and under fixed betas."""
    settings = (PRESET, *(fixed(beta) for beta in betas))
    return [run for setting in settings for run in of_methods(choice, tasks, ("infogoal",), setting=setting)]


STUDIES = {
    "table1": table1,
    "table2": lambda choice, fetch_sets=(0,): table1(
        choice._replace(methods=("infogoal",), variants=("paper",)), fetch_sets
    ),
    "fig8": fig8,
    "fig9": fig9,
    "fig10": lambda choice: of_methods(choice, ("object_search",), DRAWN),
    "fig11": lambda choice: of_methods(choice, ("embodied_qa",), DRAWN),
    "fig12": lambda choice: of_methods(choice, ("object_search", "embodied_qa"), ("infogoal",)),
    "fig13": lambda choice: of_methods(choice, ("fetch_pick_and_place",), ("infogoal",)),
    "fig14": lambda choice: fixed_betas(choice, ("fetch_pick_and_place",), (1e-4, 1e-2, 1e-1)),
    "fig15": lambda choice: (
        fixed_betas(choice, FETCH, FIXED_BETAS) + of_methods(choice, FETCH, ("infogoal",), EXTERNAL)
    ),
}
"""The runs of each table and figure of the paper."""


def protocol_of(task: str, method: str, protocol: str) -> str:
    """The protocol under which a row of the study is trained to show it under this one. Both are the same, number for
    number, for the bare agent, which learns of desired goals alone, and on the shelf, whose recorded flights achieve no
    test or validation question."""
    return "visited" if method == "none" or task == "embodied_qa" else protocol


def all_goals_run(task: str, method: str, protocol: str, goal_set: int, seeds: tuple[int, ...], toy: bool) -> Run:
    """A run of the study of all goals at once. The bare agent is the paper's, which does not relabel on the shelf."""
    learner, _, relabelling = method.partition("+")
    parts = relabelling or parts_of("paper", task, learner)[0], None
    known = protocol_of(task, method, protocol)
    return Run(task, learner, *parts, goal_set, Setting(*PRESET), seeds, toy, AGENTS[task], known)


def all_goals(choice: Choice) -> list[Run]:
    """Learning from all goals at once, beside the bare agent and HER: every row under both protocols, on every goal
    set."""
    return [
        all_goals_run(task, method, protocol, goal_set, tuple(range(choice.seeds)), choice.toy)
        for task in choice.tasks or AGENTS
        for protocol in choice.known_goals or PROTOCOLS
        for method in choice.methods or ALL_GOALS
        for goal_set in choice.sets_of(task)
    ]


BESIDE = {"all_goals": all_goals}
"""The runs of a study beside the paper."""


def runs_of(studies: tuple[str, ...], choice: Choice, fetch_sets: tuple[int, ...] = (0,)) -> list[Run]:
    """The runs that these tables and figures need, each once, in order. Raises `UserError` for names that are none."""
    if choice.toy:
        choice = choice._replace(seeds=min(choice.seeds, QUICK_SEEDS))
    found: dict[Run, None] = {}
    for study in studies:
        known: dict[str, Any] = STUDIES | BESIDE
        require(study in known, "study", study, f"give some of {', '.join(known)}")
        choice.check(*((AGENTS, ALL_GOALS) if study in BESIDE else (TASKS, METHODS)))
        make = known[study]
        runs = make(choice, fetch_sets) if study in ("table1", "table2") else make(choice)
        found |= dict.fromkeys(run for run in runs if (is_quick(run) or not choice.toy) and is_allowed(run))
    return list(found)


def is_quick(run: Run) -> bool:
    """Whether a run is one of the few at toy size: with HER, InfoGoal on object search alone; a second goal set on the
    shelf alone; of the study of all goals at once those of `QUICK_ALL_GOALS`."""
    if not run.of_paper:
        return run.goal_set == 0 and run.label in QUICK_ALL_GOALS[run.task]
    sets = (0, 1) if run.task == "embodied_qa" else (0,)
    with_her = run.relabelling == "her" and (run.task, run.method) != ("object_search", "infogoal")
    return run.method in QUICK[run.task] and run.goal_set in sets and not with_her


def is_allowed(run: Run) -> bool:
    """Whether the task takes the method; SSE-DB's bonus is kept for each observation, which few tasks list."""
    from infogoal_jax.loading import reasons_against

    return not reasons_against(run.preset())
