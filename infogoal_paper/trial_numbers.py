"""What is kept of the trials: docs/results/trials/numbers.csv.xz, one row for every evaluation of every setting and
seed, the tables made of it, and the probe that says what a code still tells of its goal.

    trial, lane, seed, updates       which of the queue in trials.py, and the updates that one seed had made
    known_goals                      the protocol; empty in older rows, which were all under `visited`
    KIND/success_rate                of each kind of goals
    learner/beta, accuracy, kl       of the epoch before the evaluation, for learners that have them
    KIND/code_error, readout_error   `code_errors`, of the goal by its code: degrees on the cube, metres on Fetch
    seconds                          since the trial began to compile, of all its settings; empty in older rows
    machine                          device, versions and date

A cell is empty where a trial has no such number.

The probe leaves the policy out, whereas success mixes what a code says with what the policy makes of it. From the code
of a goal a goal is guessed, in two ways, and the error is how far the guess lies from the truth, to be held beside the
tolerance of success:

- `code_error`: the goal whose mean code is nearest to a sample of the code. That is the resolution of the code.
- `readout_error`: the goal whose pose is nearest to the one that a linear map reads out of the mean code. The map is
  fitted (ridge regression) to clean images of all goals but the test goals, so for test goals it has to generalise.

Both for clean images, and for images under test backgrounds: `corrupted_...`.
"""

import csv
import io
import itertools
import lzma
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.environment import has_image_goals
from infogoal_jax.envs.object_manipulation import ObjectManipulation
from infogoal_jax.learners.encoding import encode_all
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.runs import disk
from infogoal_jax.train.evaluation import corrupted_images
from infogoal_paper.table_formats import machines_in_words, markdown_lines

FILE = "numbers.csv.xz"
LAST = 3
"""Evaluations over which tables take the mean: a single one of few goals jumps by 0.05 and more."""
FEWEST_SEEDS = 3
"""Seeds from which on an interval is shown: of two it is 12.7 times the standard error, wider than what is measured."""
SUCCESS = {
    "train_goal": "training",
    "validation_goal": "validation",
    "test_goal": "test",
    "corrupted_test_goal": "corrupted test",
}
"""Kinds of goals that tables show: as metrics name them, and in words. The file has more of them."""

PROBED = {
    f"{kind}/{error}": f"{words}, {said}"
    for error, said in {"code_error": "nearest code", "readout_error": "read out"}.items()
    for kind, words in {"test_goal": "test", "corrupted_test_goal": "corrupted test"}.items()
}
"""Columns of the probe's table."""
REACHED = {
    "test_goal": "test success",
    "corrupted_test_goal": "corrupted test success",
    "near_test_goal": "near a training goal",
    "far_test_goal": "far from all",
}
"""And of it, those of success."""

Row = dict[str, str]


def read_text(path: Path) -> str:
    """The text of a file, as it is or compressed."""
    content = path.read_bytes()
    return (lzma.decompress(content) if path.suffix == ".xz" else content).decode()


def write_compressed(path: Path, text: str) -> None:
    """Write a text compressed, the same bytes whenever it is written."""
    disk.write_atomically(path, lambda file: file.write(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME)))


def read(path: Path) -> list[Row]:
    """The rows of a file of trials, CSV as it is or compressed."""
    return list(csv.DictReader(io.StringIO(read_text(path), newline="")))


def write(rows: list[Row], path: Path) -> None:
    """Write these rows compressed, with every column that holds something anywhere, the machine last."""
    columns = [
        column
        for column in dict.fromkeys(column for row in rows for column in row)
        if any(row.get(column) for row in rows)
    ]
    text = io.StringIO(newline="")
    table = csv.DictWriter(
        text, sorted(columns, key="machine".__eq__), restval="", extrasaction="ignore", lineterminator="\n"
    )
    table.writeheader()
    table.writerows(rows)
    write_compressed(path, text.getvalue())


def kept(path: Path) -> list[Row]:
    """The rows of a file; none where it is not there yet."""
    return read(path) if path.exists() else []


def put(new: Iterable[Row], path: Path, key: Callable[[Row], Any], order: Callable[[Row], Any]) -> None:
    """Put these rows into a file, in place of those that it holds of the same `key`, sorted by `order`."""
    new = list(new)
    came = {key(row) for row in new}
    write(sorted([row for row in kept(path) if key(row) not in came] + new, key=order), path)


def merge(folder: Path, path: Path, order: Iterable[str]) -> list[str]:
    """Put the trials of FOLDER/*.csv into the file, in place of what it holds of them. order: of all trials. Returns
    those that came in."""
    new = {found.stem: read(found) for found in sorted(folder.glob("*.csv"))}
    places = {trial: place for place, trial in enumerate(order)}
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = itertools.chain.from_iterable(new.values())
    put(rows, path, itemgetter("trial"), lambda row: places.get(row["trial"], len(places)))
    return list(new)


def settings_of(rows: list[Row]) -> dict[str, dict[str, tuple[int, int]]]:
    """What was run of each trial: of each of its settings how many seeds, and the updates that each of them has
    made."""
    found: dict[str, dict[str, dict[str, int]]] = {}
    for row in rows:
        seeds = found.setdefault(row["trial"], {}).setdefault(row["lane"], {})
        seeds[row["seed"]] = max(int(row["updates"]), seeds.get(row["seed"], 0))
    return {
        trial: {setting: (len(seeds), min(seeds.values())) for setting, seeds in settings.items()}
        for trial, settings in found.items()
    }


def kinds_of(rows: list[Row]) -> dict[str, str]:
    """The kinds of goals that a table of these rows shows: those that any of them has, and training goals where none
    has test goals."""
    found = {kind: words for kind, words in SUCCESS.items() if any(row.get(f"{kind}/success_rate") for row in rows)}
    if "test_goal" in found:
        found.pop("train_goal", None)
    return found


def seed_means(rows: list[Row], column: str) -> np.ndarray | None:
    """The mean of a column for each seed, or None where these rows have no such number."""
    if not all(row.get(column) for row in rows):
        return None
    return np.array(
        [
            np.mean([float(row[column]) for row in rows if row["seed"] == seed])
            for seed in dict.fromkeys(row["seed"] for row in rows)
        ]
    )


def show(values: np.ndarray | None, decimals: int, interval: bool = False) -> str:
    """The mean over seeds, with the interval if it is asked for and there are seeds enough."""
    if values is None:
        return ""
    return (
        mean_interval(values).show(decimals)
        if interval and len(values) >= FEWEST_SEEDS
        else f"{values.mean():,.{decimals}f}"
    )


def last_of_settings(rows: list[Row]) -> Iterator[tuple[str, list[Row], str]]:
    """Each setting of a trial with its rows of the last evaluations, and the updates at the last of them."""
    last = sorted({int(row["updates"]) for row in rows})[-LAST:]
    for setting in dict.fromkeys(row["lane"] for row in rows):
        shown = [row for row in rows if row["lane"] == setting and int(row["updates"]) in last]
        yield setting, shown, f"{last[-1]:,}"


def table(rows: list[Row], trials: Iterable[str], error: tuple[str, int] | None) -> str:
    """A line for every setting of these trials, which says the protocol of known goals where it is not `visited`.
    error: the unit of the code's error and its decimals; None: the task has none."""
    kinds = kinds_of([row for row in rows if row["trial"] in trials])
    columns = ["trial", "setting", "seeds", "updates", *kinds.values()]
    lines = []
    for trial in trials:
        for setting, shown, updates in last_of_settings([row for row in rows if row["trial"] == trial]):
            known = shown[0].get("known_goals") or "visited"
            words = setting if known == "visited" else f"{setting}, {known}"
            cells = [f"`{trial}`", words, str(len({row["seed"] for row in shown})), updates]
            cells += [show(seed_means(shown, f"{kind}/success_rate"), 2, interval=True) for kind in kinds]
            lines.append(cells + ([show(seed_means(shown, "test_goal/code_error"), error[1])] if error else []))
    columns += [f"code error, {error[0]}"] if error else []
    columns, lines, said = without_constants(columns, lines)
    machines = machines_in_words(row["machine"] for row in rows if row["trial"] in trials)
    return markdown_lines(columns, lines) + f"\n\n{said}{machines}."


def without_constants(columns: list[str], lines: list[list[str]]) -> tuple[list[str], list[list[str]], str]:
    """A table without the columns of seeds and updates in which all lines say the same, and that in words."""
    same = [
        place
        for place, name in enumerate(columns)
        if name in ("seeds", "updates") and len(lines) > 1 and len({line[place] for line in lines}) == 1
    ]
    kept = [place for place in range(len(columns)) if place not in same]
    said = ", ".join(f"{lines[0][place]} {columns[place]}" for place in same)
    shown = [[line[place] for place in kept] for line in lines]
    return [columns[place] for place in kept], shown, f"{said}; " if said else ""


def probe_table(rows: list[Row], units: dict[str, tuple[str, int]]) -> str:
    """A line for every setting that the probe looked at, at its last evaluations. units: the unit of the errors of each
    trial, with its decimals."""
    lines, machines = [], {}
    for trial, (unit, decimals) in units.items():
        own = [row for row in rows if row["trial"] == trial and row.get("test_goal/readout_error")]
        for setting, shown, updates in last_of_settings(own):
            errors = [show(seed_means(shown, column), decimals) for column in PROBED]
            success = [show(seed_means(shown, f"{kind}/success_rate"), 2) for kind in REACHED]
            lines.append([f"`{trial}`", setting, updates, unit, *errors, *success])
            machines |= dict.fromkeys(row["machine"] for row in shown)
    columns = ["trial", "setting", "updates", "errors in", *PROBED.values(), *REACHED.values()]
    return markdown_lines(columns, lines) + f"\n\n{machines_in_words(machines)}."


def differences(rows: list[Row], pairs: Iterable[tuple[tuple[str, str], tuple[str, str]]]) -> str:
    """A line for each pair of (trial, setting): success of the first minus that of the second, seed by seed, over the
    last evaluations that both have."""
    lines, machines = [], {}
    kinds = kinds_of([row for pair in pairs for row in rows if (row["trial"], row["lane"]) in pair])
    for pair in pairs:
        first, second = ([row for row in rows if (row["trial"], row["lane"]) == own] for own in pair)
        last = sorted({row["updates"] for row in first} & {row["updates"] for row in second}, key=int)[-LAST:]
        if not last:  # One was stopped before an evaluation of the other.
            continue
        shown = [[row for row in own if row["updates"] in last] for own in (first, second)]
        cells = [difference_in_words(*pair), f"{int(last[-1]):,}"]
        for kind in kinds:
            values = [seed_means(own, f"{kind}/success_rate") for own in shown]
            cells.append("" if any(value is None for value in values) else paired_difference(*values).show(2))
        lines.append(cells)
        machines |= dict.fromkeys(row["machine"] for own in shown for row in own)
    columns, lines, said = without_constants(["difference", "updates", *kinds.values()], lines)
    return markdown_lines(columns, lines) + f"\n\n{said}{machines_in_words(machines)}."


def difference_in_words(first: tuple[str, str], second: tuple[str, str]) -> str:
    """Two settings (trial, setting) that are subtracted: the trial once where it is the same, settings where they
    differ."""
    (trial, setting), (other, other_setting) = first, second
    if trial == other:
        return f"`{trial}`: {setting} minus {other_setting}"
    if setting == other_setting:
        return f"`{trial}` minus `{other}`"
    return f"`{trial}`, {setting}, minus `{other}`"


RIDGE = 1e-3
"""Of the mean squared entry of the codes, which are standardised."""


def poses(env) -> jax.Array:
    """What is to be read out of each goal's code float32 [num_goals, D]: positions in metres on Fetch; on the cube the
    products of the quaternion's entries, which do not see its sign."""
    if not isinstance(env.unwrapped, ObjectManipulation):
        return env.goal_positions
    quaternion = env.unwrapped.goal_quaternion
    return (quaternion[:, :, None] * quaternion[:, None, :]).reshape(len(quaternion), -1)


def distances(env, goals: jax.Array, guesses: jax.Array) -> jax.Array:
    """How far these goals [M] lie from the guessed ones [M], in degrees or metres."""
    if not isinstance(env.unwrapped, ObjectManipulation):
        return jnp.linalg.norm(env.goal_positions[goals] - env.goal_positions[guesses], axis=-1)
    quaternion = env.unwrapped.goal_quaternion
    cosine_of_half = jnp.abs((quaternion[goals] * quaternion[guesses]).sum(-1))
    return jnp.degrees(2 * jnp.arccos(jnp.minimum(cosine_of_half, 1.0)))


def nearest(table: jax.Array, points: jax.Array) -> jax.Array:
    """The row of `table` [N, D] that is nearest to each of `points` [M, D], by the mean absolute difference."""
    return jax.lax.map(lambda point: jnp.abs(table - point).mean(-1).argmin(), points)


def fit(codes: jax.Array, targets: jax.Array, shown: jax.Array):
    """Ridge regression of targets [N, D] on codes [N, L], over the rows of `shown` bool [N]. Returns the map, codes
    [M, L] -> targets [M, D]."""
    weight = shown[:, None] / shown.sum()
    mean, target_mean = (weight * codes).sum(0), (weight * targets).sum(0)
    spread = jnp.sqrt((weight * (codes - mean) ** 2).sum(0)) + 1e-6
    scaled = (codes - mean) / spread
    moments = scaled.T @ (weight * scaled) + RIDGE * jnp.eye(codes.shape[-1])
    slopes = jnp.linalg.solve(moments, scaled.T @ (weight * (targets - target_mean)))
    return lambda new: target_mean + (new - mean) / spread @ slopes


def code_errors(train, params, goals: jax.Array) -> dict[str, jax.Array]:
    """The errors named at the top of this file for goals int32 [M], each float32 [M]."""
    env, learner = train.env, train.parts.learner
    table, targets = encode_all(learner, params["goal"], env.goals).mean, poses(env)
    read_out = fit(table, targets, ~env.goals.test_mask)
    weight = train.parts.config.test_corruption
    pictures = {"": env.goals.inputs_of(goals)}
    if has_image_goals(env):
        pictures["corrupted_"] = corrupted_images(env, goals, 1, weight)[:, 0]
    errors = {}
    for prefix, images in pictures.items():
        code = learner.encode(params["goal"], images)
        guesses = {"code_error": nearest(table, code.sample(jax.random.key(0)))}
        guesses["readout_error"] = nearest(targets, read_out(code.mean))
        errors |= {prefix + name: distances(env, goals, guess) for name, guess in guesses.items()}
    return errors
