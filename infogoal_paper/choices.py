"""What was chosen for the runs of Table I, and what each choice saw.

    python -m infogoal_paper.choices [--all]

The rule: a setting is chosen by validation goals of data that no table shows, with as many tries for every method.
Validation goals may be corrupted; backgrounds of tests are others. A choice that saw a test goal, or data that a table
shows, is not clean, nor is one that was made for some methods alone. Every value of a preset belongs to one of
`CHOICES`; the first that fits has it. The command prints those that are not clean, --all all of them; `pages.py
choices` writes the former into docs/research/rules.md.
"""

import argparse
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from infogoal_jax import presets
from infogoal_paper.manifest import FETCH
from infogoal_paper.paper import TASKS
from infogoal_paper.scores import TITLES
from infogoal_paper.table_formats import markdown_lines

HOUSE, CUBE, SHELF = "house 100", "cube 100", "shelf 100"
REACH, PUSH, LIFT = FETCH
ALL, SOME = "every method", "some methods"


class Choice(NamedTuple):
    """Values of presets that were chosen together.

    words: what was chosen.
    tasks, methods, fields: of presets, as patterns; method `-` for what all methods have.
    by: which goals.
    on: which data.
    tries: for which methods.
    clean: whether it keeps the rule.
    """

    words: str
    tasks: tuple[str, ...]
    methods: tuple[str, ...]
    fields: tuple[str, ...]
    by: str
    on: str
    tries: str
    clean: bool


class Value(NamedTuple):
    """A value that a preset sets: task, method or `-`, dotted field, value."""

    task: str
    method: str
    field: str
    value: Any


def values() -> Iterator[Value]:
    """Every value of the presets of Table I's tasks."""
    for task in TASKS:
        preset = presets.registry[task]
        for name in ("env", "learner", "state_encoder", "all_goals", "training", "hyper"):
            yield from (Value(task, "-", f"{name}.{field}", value) for field, value in getattr(preset, name).items())
        for name in ("agents", "relabellings"):
            for part, fields in getattr(preset, name).items():
                yield from (Value(task, "-", f"{name}.{part}.{field}", value) for field, value in fields.items())
        for method, changes in preset.methods.items():
            for name in ("learner", "all_goals", "training", "hyper"):
                own = getattr(changes, name).items()
                yield from (Value(task, method, f"{name}.{field}", value) for field, value in own)


VALIDATION, TEST, TRAINING = "validation goals", "validation and test goals", "training goals"
CHOICES = (
    Choice(
        "fineness of InfoGoal's code (validation prefers 0.99)",
        ("embodied_qa",),
        ("infogoal",),
        ("hyper.learner.beta_threshold",),
        TEST,
        SHELF,
        SOME,
        False,
    ),
    Choice(
        "conservative weights",
        ("embodied_qa",),
        ("-", "infogoal"),
        ("hyper.agent.conservative_weight",),
        TEST,
        SHELF,
        SOME,
        False,
    ),
    Choice(
        "fineness of InfoGoal's code with HER (validation prefers 0.999; corrupted test goals decided)",
        (LIFT,),
        ("infogoal+her",),
        ("hyper.learner.beta_threshold",),
        TEST,
        "goal set 0, shown",
        SOME,
        False,
    ),
    Choice(
        "fineness of InfoGoal's code with HER",
        (PUSH,),
        ("infogoal+her",),
        ("hyper.learner.beta_threshold",),
        VALIDATION,
        "goal set 0, shown",
        SOME,
        False,
    ),
    Choice("windows and pairs", FETCH, ("infogoal", "cogoal"), ("learner.*",), TEST, "goal set 1, shown", ALL, False),
    Choice(
        "weights of intrinsic rewards and of GCB's loss",
        FETCH,
        ("infogoal*", "infobot*", "gcb*"),
        ("hyper.intrinsic_weight", "hyper.learner.beta", "hyper.learner_weight"),
        TEST,
        "goal set 1, shown",
        SOME,
        False,
    ),
    Choice(
        "window and fineness of InfoGoal's code; COGOAL's window was never varied",
        ("object_manipulation",),
        ("infogoal*", "cogoal"),
        ("learner.*", "hyper.learner.beta_threshold", "hyper.intrinsic_weight"),
        VALIDATION,
        CUBE,
        SOME,
        False,
    ),
    Choice(
        "InfoGoal's and DQN's floats, by hand",
        ("object_search",),
        ("-", "infogoal*"),
        ("hyper.*", "all_goals.*", "training.*"),
        TEST,
        "houses 100 and 101, which have the names of the test goals",
        SOME,
        False,
    ),
    Choice(
        "InfoBot's weights",
        TASKS,
        ("infobot*",),
        ("hyper.intrinsic_weight", "hyper.learner.beta", "hyper.learner_weight"),
        VALIDATION,
        "data of the tuning",
        ALL,
        True,
    ),
    Choice(
        "floats of searches and trials on Fetch",
        FETCH,
        ("*",),
        ("hyper.*",),
        VALIDATION,
        "goal set 0, shown",
        ALL,
        False,
    ),
    Choice("floats of searches and trials", TASKS, ("*",), ("hyper.*",), VALIDATION, "data of the tuning", ALL, True),
    Choice(
        "sizes, budgets and agents, the same for all",
        TASKS,
        ("-",),
        ("env.*", "learner.*", "state_encoder.*", "training.*", "agents.*", "relabellings.*", "all_goals.*"),
        TRAINING,
        "data of the tuning",
        ALL,
        True,
    ),
    Choice(
        "windows and variances on the shelf",
        ("embodied_qa",),
        ("infogoal", "cogoal", "vae", "dgrl"),
        ("learner.*",),
        VALIDATION,
        SHELF,
        ALL,
        True,
    ),
)
"""Specific ones first."""


def fits(choice: Choice, value: Value) -> bool:
    """Whether a value of a preset belongs to a choice."""
    return value.task in choice.tasks and all(
        any(fnmatchcase(own, pattern) for pattern in patterns)
        for own, patterns in ((value.method, choice.methods), (value.field, choice.fields))
    )


def chosen() -> dict[Choice, list[Value]]:
    """The values of the presets by the choice that they belong to."""
    found: dict[Choice, list[Value]] = {choice: [] for choice in CHOICES}
    for value in values():
        found[next(choice for choice in CHOICES if fits(choice, value))].append(value)
    return found


def table(every: bool = False) -> str:
    """The choices that are not clean, or all, with what they saw and the values that presets have."""
    rows = []
    for choice, own in chosen().items():
        if every or not choice.clean:
            titles = [title for task, title in TITLES.items() if task in {value.task for value in own}]
            tasks = "all tasks" if len(titles) == len(TASKS) else ", ".join(titles)
            rows.append([choice.words, tasks, str(len(own)), choice.by, choice.on, choice.tries])
            if every:
                rows[-1].append("yes" if choice.clean else "no")
    head = ["chosen", "tasks", "values", "saw", "of", "tried for"] + ["clean"] * every
    return markdown_lines(head, rows)


def summary() -> str:
    """How many values of presets are clean."""
    found = chosen()
    clean = sum(len(own) for choice, own in found.items() if choice.clean)
    return (
        f"{clean} of {sum(map(len, found.values()))} values of presets keep the rule. Sizes of networks, steps of a "
        "return and the batch, which presets leave as they are, were tuned with InfoGoal on object search alone."
    )


def tables() -> dict[str, str]:
    """The table of docs/research/rules.md."""
    return {"unclean": f"{table()}\n\n{summary()}"}


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="print clean choices too")
    print(f"{table(parser.parse_args().all)}\n\n{summary()}")


if __name__ == "__main__":
    main()
