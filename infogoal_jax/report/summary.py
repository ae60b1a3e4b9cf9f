"""What a run came to, in words and a table: success, path quality and episode length over seeds, where the data is
from, what went wrong."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from infogoal_jax import checks, learners
from infogoal_jax.envs.environment import has_image_goals
from infogoal_jax.errors import counted, counted_each, require
from infogoal_jax.field_types import LARGEST_WHOLE
from infogoal_jax.goal_uses import USES
from infogoal_jax.goals import GoalSpace
from infogoal_jax.presets.loading import run_title
from infogoal_jax.report.runs import Run, RunTable, diverged_seeds, load_run, read_params, table_of
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.runner import memory
from infogoal_jax.runner.compilation import jit
from infogoal_jax.runner.progress import say, working_on
from infogoal_jax.runs import checkpoint
from infogoal_jax.runs.folder import RUN, remove_abandoned
from infogoal_jax.runs.tables import Evaluation, read_timing, write_evaluation
from infogoal_jax.train.contracts import RECORDINGS_ALONE, check_simulated
from infogoal_jax.train.evaluation import evaluate, near_and_far

CODES = {"": "sampled", "_mean_code": "mean"}  # Suffix of a metric's name: how the goal's code is drawn at each step.
GOALS = {
    "train_goal": "training",
    "validation_goal": "validation",
    "test_goal": "test",
    "near_test_goal": "test, near",
    "far_test_goal": "test, far",
    "corrupted_train_goal": "training, corrupted",
    "corrupted_test_goal": "test, corrupted",
}
# Title and decimals.
COLUMNS = {"success_rate": ("success rate", 2), "spl": ("SPL", 2), "episode_length": ("steps", 1)}
TITLES = [title for title, _ in COLUMNS.values()]
LEARNER_NUMBERS = {"beta": ("beta", 4), "accuracy": ("accuracy", 3), "kl": ("KL (nats)", 2)}


def seeds_in_words(*counts: int) -> str:
    """Of so many seeds each number is: `1 seed, no interval`, or `2 to 5 seeds, mean ± 95 % interval`."""
    if max(counts) < 2:
        return "1 seed, no interval" if max(counts) else "no seed is left"
    return f"{counted_each(counts, 'seed')}, mean ± 95 % interval"


def diverged_in_words(diverged: dict[int, int]) -> list[str]:
    """A sentence for each seed that diverged."""
    return [f"seed {seed} diverged at epoch {epoch}; its numbers are left out" for seed, epoch in diverged.items()]


CONTINUOUS = {"collect/diverged", "collect/nothing_achieved"}
"""Metrics of a task with continuous goals."""


def remarks_on(epochs: RunTable, evaluations: RunTable) -> list[str]:
    """A sentence for each thing in the epochs of a run that tells of a mistake in its task. A run may be too short for
    an episode of training to end, and succeed where it is evaluated."""
    found, values = [], epochs.values
    rates = [rate for name, rate in {**values, **evaluations.values}.items() if name.endswith("/success_rate")]
    if "collect/success_rate" in values and not any(rate.any() for rate in rates):
        found.append(
            "no episode of training reached its goal: more steps may be needed, or nothing that is achieved is within "
            "the radius of a desired goal"
        )
    nothing = values["collect/nothing_achieved"].mean() if values.keys() >= CONTINUOUS else 0
    if nothing:
        found.append(f"{nothing:.2%} of the steps of training achieved no goal: `achieved_goal` was NaN")
    steps = int(values["collect/diverged"].sum()) if "collect/diverged" in values else 0
    if steps:
        found.append(f"{counted(steps, 'step')} of training led to numbers that are not finite, and were taken back")
    return found + collapses(epochs)


LEAST_BETA, LEAST_EPOCHS = 1e-4, 20
"""A beta of InfoGoal below it compresses nothing, and by then it has left its first value."""
FALLING = 0.9
"""A KL that is below this share of what it was half way falls: the threshold was reached late, and beta comes back."""


def is_no_bottleneck(beta: np.ndarray, kl_half: np.ndarray, kl: np.ndarray) -> np.ndarray:
    """Whether codes are not compressed: InfoGoal's beta is 0 at the end, and the KL has not fallen since half way.
    Arrays of one shape, or floats."""
    return (beta < LEAST_BETA) & (kl > FALLING * kl_half)


def collapses(epochs: RunTable) -> list[str]:
    """A sentence for the seeds whose codes are no bottleneck (`is_no_bottleneck`)."""
    values = epochs.values
    if not {"infogoal/beta", "infogoal/kl"} <= values.keys() or values["infogoal/kl"].shape[1] < LEAST_EPOCHS:
        return []
    beta, kl = values["infogoal/beta"], values["infogoal/kl"]
    lost = np.flatnonzero(is_no_bottleneck(beta[:, -1], kl[:, kl.shape[1] // 2], kl[:, -1]))
    if not lost.size:
        return []
    named = ", ".join(str(epochs.seeds[place]) for place in lost)
    return [
        f"beta is 0 and the KL does not fall in {counted(lost.size, 'seed')} ({named}): the accuracy stays below "
        "learner.beta_threshold, and codes are not compressed; see --hyper.learner.beta-floor"
    ]


def score_cells(score: Callable[[str], np.ndarray | None]) -> list[str]:
    """The numbers of `COLUMNS`: mean and interval over seeds of score(column) [seeds], empty where that is None."""
    return [
        "" if (values := score(column)) is None else mean_interval(values).show(decimals)
        for column, (_, decimals) in COLUMNS.items()
    ]


def score_table(scores: dict[str, np.ndarray]) -> Table:
    """Success rate, SPL (where the task has one) and episode length of each kind of goals and code, for scores {name:
    [seeds]} with the names of `evaluation.Setting`. A code without noise has one row."""
    codes = CODES
    if any("_mean_code/" in name for name in scores) and all(is_same_of_mean_codes(scores, name) for name in scores):
        codes = {"": ""}
    rows = [
        (goals_title, code, *score_cells(lambda column, kind=goals + suffix: scores.get(f"{kind}/{column}")))
        for goals, goals_title in GOALS.items()
        for suffix, code in codes.items()
        if f"{goals}{suffix}/success_rate" in scores
    ]
    return number_table(("goals", "code", *TITLES), rows, words=2)


def is_same_of_mean_codes(scores: dict[str, np.ndarray], name: str) -> bool:
    """Whether these scores of every seed are the same where policies are given the means of codes, or where there are
    none of those."""
    kind, _, column = name.partition("/")
    of_means = scores.get(f"{kind}_mean_code/{column}")
    return of_means is None or np.array_equal(scores[name], of_means, equal_nan=True)


def number_table(titles: Sequence[str], rows: Sequence[Sequence[str]], words: int = 0) -> Table:
    """Rows below their titles, without columns that are empty. Where the terminal is narrow, titles are broken, and
    what stands in the first columns, so many of words; numbers never."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    columns = [column for column in zip(titles, zip(*rows, strict=True), strict=True) if any(column[1])]
    for place, (title, cells) in enumerate(columns):
        whole, justify = (" ".join(cells).split(), "left") if place < words else (cells, "right")
        table.add_column(title, justify=justify, overflow="fold", min_width=max(map(len, whole)))
    for row in zip(*(cells for _, cells in columns), strict=True):
        table.add_row(*row)
    return table


def corruption_in_words(scores: dict[str, np.ndarray], weight: float) -> str:
    """What corrupted goals are, with a semicolon before; nothing for a task without them."""
    return (
        f"; corrupted goals: images with a random background of weight {weight:g}"
        if "corrupted_test_goal/success_rate" in scores
        else ""
    )


def goals_in_words(goals: int, starts: int) -> str:
    """What an evaluation asks for: `24 goals x 1 start`."""
    return f"{counted(goals, 'goal')} x {counted(starts, 'start')}"


def print_run(folder: Path, console: Console | None = None) -> None:
    """Print the table of the last evaluation of the run in this folder, then a line for each of the other things to
    know. Raises `UserError` if there is no run, or it has no evaluation yet."""
    run, console = load_run(folder), console or Console()
    diverged = diverged_seeds(run.folder)
    evaluations, epochs = (table_of(run.folder, name, diverged) for name in ("evaluations", "epochs"))
    left, acted = len(evaluations.seeds), "collect/valid" in epochs.values  # Who learns offline collects nothing.
    last_epoch = int(evaluations.epochs[-1]) if len(evaluations.epochs) else 0
    head = f"{run_title(run.config)}: epoch {last_epoch} of {run.config.num_epochs}"
    if left and evaluations.values:
        last = evaluations.last()
        steps = f"{last['env_steps'].mean():,.0f} {'environment' if acted else 'recorded'} steps a seed"
        if "first_reached" in last:
            asked = goals_in_words(*last["first_reached"].shape[1:])
            corrupted = corruption_in_words(last, run.config.test_corruption)
            protocol = f"{asked}{corrupted}; {seeds_in_words(left)}"
            say(console, f"{head}, {steps}\n{protocol}", style="bold")
            console.print(score_table(last))
        else:
            say(console, f"{head}, {steps}\nnot evaluated: {RECORDINGS_ALONE}", style="bold")
    else:
        reason = "every seed diverged" if diverged else "no evaluation is whole"
        say(console, f"{head}: no numbers; {reason}", style="bold")
    for sentence in diverged_in_words(diverged) + remarks_on(epochs, evaluations):
        say(console, sentence, style="bold red")
    known = {
        "train": "training goals",
        "held_out": "goals achieved so far, validation and test goals excepted,",
        "visited": "goals achieved so far",
        "all": "all goals",
    }[run.config.known_goals]
    desired = "only training goals" if run.config.desired_goals == "training" else "all goals, test goals too,"
    protocol = (
        f"{desired} were desired goals in training; {known} could enter the representation "
        f"(known_goals = {run.config.known_goals})"
    )
    if run.config.training_corruption:
        protocol += f"; goal images were corrupted while training too, with weight {run.config.training_corruption:g}"
    lines = {"data": run.data, "protocol": protocol, "device": run.device}
    if numbers := learner_numbers(run, epochs):
        lines[learners.registry.name_of(run.config.learner)] = f"{numbers} (mean of the last epoch)"
    if times := read_timing(run.folder):
        lines["time"] = (
            f"compiling {times.compile_seconds:.0f} s, running {times.run_seconds:.0f} s in the last session: "
            + f"{times.env_steps_per_second:,.0f} environment steps/s, " * acted
            + f"{times.updates_per_second:,.0f} updates/s over all seeds"
        )
    lines["files"] = f"{run.folder}: {', '.join(name for name in RUN if (run.folder / name).exists())}"
    for label, text in lines.items():
        say(console, text, label)


def learner_numbers(run: Run, epochs: RunTable) -> str:
    """Beta, accuracy and KL of the last epoch, for the methods that have them."""
    if not epochs.values or not epochs.seeds:
        return ""
    last, names = (
        epochs.last(),
        {f"{learners.registry.name_of(run.config.learner)}/{name}": shown for name, shown in LEARNER_NUMBERS.items()},
    )
    return ", ".join(
        f"{title} {mean_interval(last[name]).show(decimals)}"
        for name, (title, decimals) in names.items()
        if name in last
    )


def typed_goal(space: GoalSpace, words: Sequence[str]) -> np.ndarray:
    """The goal of a space that a user typed: the number or the name of one of a finite set, or the numbers of a vector.

    Raises `UserError` for one that the space does not have.
    """
    typed = " ".join(words)
    if space.finite:
        is_number = typed not in space.names and re.fullmatch(r"-?[0-9]{1,18}", typed)
        return np.asarray(space.checked(int(typed) if is_number else typed, "goal", axes=0))
    (size,) = space.shape
    spans = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in zip(space.low, space.high, strict=True))
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.zeros(0)
    require(len(numbers) == size, "goal", typed, f"give {counted(size, 'number')}: {spans}")
    return space.checked(numbers, "goal", axes=0)


def title_of(space: GoalSpace, goal: np.ndarray) -> str:
    """A goal [*shape] in words: its name, or its numbers."""
    return space.names[int(goal)] if space.finite else ", ".join(f"{number:.4g}" for number in goal)


def use_of(space: GoalSpace, goal: np.ndarray) -> str:
    """What a goal [*shape] is used for, in words."""
    if space.finite:
        uses = [use for use in USES if getattr(space, f"{use}_mask")[int(goal)]]
    else:
        uses = [USES[int(space.use(jnp.asarray(goal)))]]
    return GOALS[f"{uses[0]}_goal"] if uses else "none"


def goal_table(space: GoalSpace, goals: np.ndarray, scores: dict[str, np.ndarray]) -> Table:
    """A row for each goal [M, *shape], of scores {name: [seeds, M]}."""
    of_goals = [{column: values[:, place] for column, values in scores.items()} for place in range(len(goals))]
    rows = [
        (title_of(space, goal), use_of(space, goal), *score_cells(own.get))
        for goal, own in zip(goals, of_goals, strict=True)
    ]
    return number_table(("goal", "use", *TITLES), rows, words=2)


def evaluate_run(
    folder: Path,
    starts: int,
    start_seed: int,
    test_epsilon: float,
    corruption: float | None = None,
    env: Any = None,
    console: Console | None = None,
    goals: Sequence[Sequence[str]] = (),
) -> dict[str, np.ndarray]:
    """Evaluate the last parameters of every seed again, print the table and leave the numbers in RUN/evaluation.json.

    starts: start states for each goal; start_seed: their seed, and that of the noise; test_epsilon: probability of a
    random action, negative for the run's own; corruption: weight of the backgrounds of corrupted goals, None for the
    run's own; env: the environment if it is loaded already; goals: those to evaluate, each as `typed_goal` takes it,
    none for those of the task. Returns {name: [seeds]} of the seeds that did not diverge, for typed goals
    {name: [seeds, M]}. Raises `UserError` for values out of range, a corruption of goals that are not images or of
    typed goals, a goal that the task does not have, a folder without a run, or damaged parameters.
    """
    starts = checks.whole(starts, "starts", 1, LARGEST_WHOLE, f"give 1 to {LARGEST_WHOLE}, such as 50")
    last = checks.MOST_SEEDS - 3
    start_seed = checks.whole(start_seed, "start_seed", 0, last, "give a seed from 0 to below 2^32 - 2")
    remedy = "give a probability from 0 to 1, or a negative number for the run's own"
    test_epsilon = checks.number(test_epsilon, "test_epsilon", high=1, remedy=remedy)
    if corruption is not None:
        corruption = checks.number(corruption, "corruption", 0, 1, "give a weight from 0 to 1, for example 0.4")
    run, console = load_run(folder), console or Console()
    folder = run.folder
    train, diverged = run.train_in(env), diverged_seeds(folder)
    check_simulated(train.env, "run", run.name)
    has_images = has_image_goals(train.env)
    require(
        corruption is None or has_images,
        "corruption",
        corruption,
        f"goals of {run.config.task} are not images; leave it out",
    )
    require(
        corruption is None or not goals, "corruption", corruption, "goals that are typed are shown clean; leave it out"
    )
    space = train.env.goals
    typed = np.stack([typed_goal(space, words) for words in goals]) if goals else None
    weight = run.config.test_corruption if corruption is None else corruption
    params = read_params(run, train)
    epoch = checkpoint.read_header(folder / "policy")[0]["epoch"]
    epsilon = run.config.hyper.test_epsilon if test_epsilon < 0 else test_epsilon

    def evaluate_seed(params, env):
        hyper = run.config.hyper.replace(test_epsilon=epsilon)
        if typed is None:
            return train.evaluate(params, hyper, env, starts, weight, start_seed)
        scores = evaluate(train.policy(params, hyper, env), env, typed, starts, start_seed)
        return {name: value.mean(-1, dtype=jnp.float32) for name, value in scores.by_name().items()}

    program = jit(jax.vmap(evaluate_seed, in_axes=(0, None))).trace(params, train.env)
    room = memory.device_memory(jax.devices()[0])
    asked = len(space.evaluated if typed is None else typed)
    episodes = memory.episode_bytes(train, starts) * asked // len(space.evaluated)
    needed = memory.largest_array(program.jaxpr) + episodes * len(run.seeds)
    require(
        needed <= room,
        "starts",
        starts,
        f"evaluating {len(run.seeds)} seeds needs {needed / memory.GIB:,.1f} GiB at least, "
        f"{memory.room_in_words(room)}: give fewer, such as {run.config.evaluation_starts}",
    )
    with working_on("evaluating", console):
        metrics = jax.device_get(program.lower().compile()(params, train.env))
    kept = [index for index, seed in enumerate(run.seeds) if seed not in diverged]
    seeds = [run.seeds[index] for index in kept]
    scores = {name: value[kept] for name, value in metrics.items()}
    if typed is None:
        scores |= near_and_far(train.env, scores["first_reached"])
    found = Evaluation(
        epoch=epoch,
        starts=starts,
        start_seed=start_seed,
        test_epsilon=float(epsilon),
        corruption=weight if has_images and typed is None else None,
        seeds=seeds,
        diverged=diverged,
        data=run.data,
        metrics={name: value.tolist() for name, value in scores.items()},
        goals=None if typed is None else typed.tolist(),
    )
    protocol = f"{goals_in_words(asked, starts)} of seed {start_seed}, {epsilon:.0%} of the actions random"
    protocol += corruption_in_words(scores, weight)
    if "near_test_goal/success_rate" in scores:
        protocol += "; near: test goals that count as reached from a training goal"
    head = f"{run_title(run.config)}: epoch {epoch} of {run.config.num_epochs}"
    say(console, f"{head}\n{protocol}; {seeds_in_words(len(kept))}", style="bold")
    console.print(score_table(scores) if typed is None else goal_table(space, typed, scores))
    for sentence in diverged_in_words(diverged):
        say(console, sentence, style="bold red")
    say(console, run.data, "data")
    remove_abandoned(folder)
    write_evaluation(folder, found)  # After the table: a disk that refuses should not cost the numbers.
    say(console, str(folder / "evaluation.json"), "file")
    return {name: value for name, value in scores.items() if name != "first_reached"}
