"""Settings and seeds as jobs, wherever they run: each setting is a run in a folder of its own, trained in parts of at
most so many seeds, which make one run when all have come to their end.

FOLDER/sweep.json               what is to be run: config, settings, seeds, and seeds side by side
FOLDER[/SETTING]                a run, as `infogoal train` leaves it
FOLDER[/SETTING]/parts/FIRST-LAST   a part of it, a run of its own until all parts are done

A part is trained by one program of its own, whoever trains it: so its bits are the same in this process, in several and
on a Ray cluster.
"""

import contextlib
import dataclasses
import itertools
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import flax.serialization
import jax
import numpy as np
from rich.console import Console

from infogoal_jax.config import TrainConfig
from infogoal_jax.envs.environment import data_of
from infogoal_jax.errors import UserError, counted, nearest, require, shown
from infogoal_jax.hyperparameters import values_of, with_values
from infogoal_jax.imports import checksums, typed_command
from infogoal_jax.loading import load_environment
from infogoal_jax.runner import training
from infogoal_jax.runner.executors import LOSSES, Outcome, Place, run_here
from infogoal_jax.runner.listeners import advancing
from infogoal_jax.runner.progress import ProgressLine, moving
from infogoal_jax.runs import checkpoint, configuration, disk, tables
from infogoal_jax.runs.configuration import to_dict
from infogoal_jax.runs.disk import Place as File
from infogoal_jax.runs.disk import decode, decode_value, parse, read_bytes
from infogoal_jax.runs.folder import RUN, BeingWrittenError, check_new, locked
from infogoal_jax.runs.tables import Timing
from infogoal_jax.stopping import Stopped

NAME, PARTS, JOINED = configuration.SWEEP, "parts", "joined-parts"


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is to be run.

    settings: of each run, the floats by dotted name that differ from the configuration's; one without any is a plain
        run.
    seeds: of every run.
    seeds_at_once: in one program at most; 0: all.
    """

    settings: list[dict[str, float]]
    seeds: list[int]
    seeds_at_once: int

    @property
    def names(self) -> list[str]:
        """The folders of the runs, below that of the sweep."""
        return [",".join(f"{name}={value}" for name, value in words.items()) for words in self.in_words()]

    def in_words(self) -> list[dict[str, str]]:
        """The settings with their values as they are shown: six digits, or as many as tell them apart."""
        written: dict[str, dict[float, str]] = {}
        for name in {name for setting in self.settings for name in setting}:
            values = {setting[name] for setting in self.settings if name in setting}
            each = ({value: f"{value:.{digits}g}" for value in values} for digits in range(6, 18))
            written[name] = next(words for words in each if len(set(words.values())) == len(values))
        return [{name: written[name][value] for name, value in setting.items()} for setting in self.settings]


@dataclasses.dataclass(frozen=True)
class RunJob:
    """Some seeds of one setting, as a job.

    config: with the floats of the setting.
    path: of the run's folder, below that of the sweep; empty: the folder itself.
    """

    config: TrainConfig
    seeds: tuple[int, ...]
    path: str

    @property
    def name(self) -> str:
        """The task, the setting and the seeds."""
        words = self.path.replace(f"{PARTS}/", "").strip("/")
        return f"{self.config.task} {words or counted(len(self.seeds), 'seed')}"

    @property
    def members(self) -> tuple[str, ...]:
        """Itself."""
        return (self.path,)

    def without(self, members: set[Any]) -> "RunJob":
        """Itself, or a job of no seeds."""
        return dataclasses.replace(self, seeds=()) if self.path in members else self

    def folder(self, folder: Path) -> Path:
        """Of its run."""
        return disk.below(folder, self.path)

    def is_done(self, folder: Path) -> bool:
        """Whether it is trained to its end, or was and is in the run that its part was joined to."""
        own = self.folder(folder)
        return is_trained(own, self.config) or (own.parent.name == PARTS and is_trained(own.parent.parent, self.config))

    def claim(self, place: Place, claims: contextlib.ExitStack, whole: bool) -> "RunJob | None":
        """Itself, locked until `claims` is closed; None if it is done, or another process has it."""
        if not self.seeds or self.is_done(place.folder):
            return None
        try:
            path = place.folder / f"{self.path.replace('/', '+') or 'run'}.lock"
            claims.enter_context(locked(path, place.folder))
        except BeingWrittenError:
            return None
        return None if self.is_done(place.folder) else self

    def files(self, folder: Path) -> list[Path]:
        """What there is of its run."""
        return [path for name in RUN if (path := self.folder(folder) / name).is_file()]

    def train(self, place: Place) -> None:
        """Train its seeds to their end, or until a signal or the clock says stop."""
        folder = self.folder(place.folder)
        resume = (folder / configuration.NAME).exists()

        line = place.show(self) if place.show else ProgressLine(self.name, self.config.num_epochs, None, place.say)
        try:
            listeners, onward = (advancing(line),), typed_command("train", "--resume", place.folder)
            asked = {"phase": line.phase, "left": place.left, "onward": onward}
            training.run(self.config, self.seeds, folder, resume, listeners, **asked)
            if line.is_live and line.numbers:
                line.print(f"{self.name}: {line.numbers}")  # It stays above the line, which goes on with the next.
        except Stopped:
            if place.left() > 0:
                raise  # By a signal to this process, and not by the clock before its first epoch.
        finally:
            line.finish()

    def fail(self, place: Place, error: Exception) -> None:
        """Let the user know: what ends one part would end the others."""
        if isinstance(error, UserError):
            raise error
        raise UserError(f"{self.name}: failed, or its worker was lost {LOSSES} times: {error}") from error

    def outcome(self, folder: Path) -> Outcome:
        """Whether it is finished."""
        return Outcome(finished=[self.path] if self.is_done(folder) else [])

    def tidy(self, folder: Path) -> None:
        """Its run is its own."""


def is_trained(folder: Path, config: TrainConfig) -> bool:
    """Whether the run in this folder came to its end: the policy is what is written last."""
    path = folder / "policy"
    if not path.exists():
        return False
    return checkpoint.read_header(path)[0]["epoch"] >= config.num_epochs


def combinations(values: dict[str, Sequence[float]]) -> list[dict[str, float]]:
    """Every combination of the values of these floats; one without any where there are none."""
    return [
        dict(zip(values, map(float, combination), strict=True)) for combination in itertools.product(*values.values())
    ]


def jobs_of(config: TrainConfig, plan: Plan) -> list[RunJob]:
    """The parts of all runs."""
    size, found = plan.seeds_at_once or len(plan.seeds), []
    for name, setting in zip(plan.names, plan.settings, strict=True):
        own = dataclasses.replace(config, hyper=with_values(config.hyper, setting))
        for first in range(0, len(plan.seeds), size):
            seeds = tuple(plan.seeds[first : first + size])
            part = "" if len(seeds) == len(plan.seeds) else f"{PARTS}/{seeds[0]}-{seeds[-1]}"
            found.append(RunJob(own, seeds, "/".join(filter(None, (name, part)))))
    return found


def check(config: TrainConfig, plan: Plan) -> None:
    """Raise `UserError` for what cannot be run, before anything is written."""
    training.checked_seeds(plan.seeds)
    require(plan.seeds_at_once >= 0, "vmap_size", plan.seeds_at_once, "give 0 for all seeds at once, or more")
    known = values_of(config.hyper)
    for setting in plan.settings:
        for name in setting:
            require(
                name in known, "sweep", name, f"no such float.{nearest(name, list(known))} Known: {', '.join(known)}"
            )
        dataclasses.replace(config, hyper=with_values(config.hyper, setting))  # Its own check says what is allowed.
    require(len(set(plan.names)) == len(plan.names), "sweep", plan.settings, "give each setting once")


def run_plan(
    config: TrainConfig,
    plan: Plan,
    folder: Path,
    resume: bool = False,
    execute: Callable[..., Outcome] = run_here,
    say: Callable[[str], None] | None = None,
) -> Outcome:
    """Train what is left of a plan by an executor, (jobs, place) -> outcome, and make one run of the parts of each
    setting that is finished.

    resume: go on in the folder, whose plan this is; say: prints a line; None: programs that are trained in this process
    share one line of progress on a terminal or in a notebook. Raises `UserError`, without a change on the disk, for a
    folder that holds something else, and for what cannot be run.
    """
    if resume:
        check(config, plan)
    else:
        start(config, plan, folder)
    config = configuration.located(config)  # Workers may be in other folders.
    jobs = jobs_of(config, plan)
    if resume and ((folder / NAME).exists() or not all(job.is_done(folder) for job in jobs)):
        take_up(config, plan, folder)
    with showing(jobs, folder, say) as place:
        outcome = execute(jobs, place)
    if all(job.is_done(folder) for job in jobs):
        with contextlib.suppress(BeingWrittenError), locked(folder / "join.lock", folder):
            for name in plan.names:
                join(folder / name if name else folder, plan.seeds)
            if plan.settings == [{}]:
                (folder / NAME).unlink(missing_ok=True)  # It is a run as any other now.
    return outcome


@contextlib.contextmanager
def showing(jobs: Sequence[RunJob], folder: Path, say: Callable[[str], None] | None) -> Iterator[Place]:
    """Where jobs of this process work, and what shows how far all of them are until the end of the block: without
    `say`, one line on a terminal or in a notebook, from the first program on that is trained here."""
    line = ProgressLine("", sum(job.config.num_epochs for job in jobs), Console())
    place = Place(folder, say=say or line.print)
    with contextlib.ExitStack() as shown:
        begun = False

        def show(job: RunJob) -> ProgressLine:
            nonlocal begun
            line.begin(job.name, sum(other.config.num_epochs for other in jobs if other.is_done(folder)))
            if not begun:
                begun = True
                shown.enter_context(moving(line))
            return line

        if say is None and line.is_live:
            place.show = show
        yield place


def start(config: TrainConfig, plan: Plan, folder: Path) -> None:
    """Write what is to be run into a new folder. Raises `UserError`, without a change on the disk, for a folder that
    holds something else, and for what cannot be run."""
    check(config, plan)
    check_new(folder, (*RUN, NAME, PARTS))
    disk.make_folder(folder)
    write_plan(config, plan, folder)


def write_plan(config: TrainConfig, plan: Plan, folder: Path) -> None:
    """Write what is to be run, which is to be found again from any folder."""
    made_with = {"imports": files} if (files := checksums()) else {}
    configuration.keep_imports(folder, files)
    values = {"config": to_dict(configuration.located(config)), **dataclasses.asdict(plan), **made_with}
    disk.write_json(folder / NAME, values, indent=2)


def read_plan(folder: Path) -> tuple[TrainConfig, Plan]:
    """The configuration and the plan of a folder. Raises `UserError` if it holds none."""
    place = File(folder / NAME)
    values = parse(read_bytes(place, f"resume = {str(folder)!r}: holds no {NAME}"), place)
    if not isinstance(values, dict) or "config" not in values:
        raise place.refusal("config is missing")
    files = decode_value(dict[str, str], values.get("imports", {}), "imports", place)
    return configuration.made_with(files, values["config"], place), decode(Plan, values, place)


def take_up(config: TrainConfig, plan: Plan, folder: Path) -> None:
    """Go on with the plan of a folder. Data may lie elsewhere by now: their place is noted, in the runs that are done
    too. Raises `UserError`, naming what differs, for another plan or other data."""
    planned, then = read_plan(folder)
    checkpoint.check_same_config(folder / NAME, planned, config)
    for field in dataclasses.fields(Plan):
        before, now = getattr(then, field.name), getattr(plan, field.name)
        require(before == now, field.name, now, f"{folder / NAME} has {shown(before)}; give the same, or a new folder")
    config = configuration.located(config)
    has_moved, all_jobs = config != configuration.located(planned), jobs_of(config, plan)
    if not has_moved and all(job.is_done(folder) for job in all_jobs):
        return
    runs = {folder / name for name in plan.names} | {job.folder(folder) for job in all_jobs}
    begun = {run: configuration.read(run) for run in runs if (run / configuration.NAME).exists()}
    if begun:
        source = data_of(load_environment(config))
        for run, about in begun.items():
            require(source == about.data, "data", source, f"{run} has {about.data!r}; give the same data")
    if not has_moved:
        return
    for run, about in begun.items():
        moved = dataclasses.replace(about.config, env=config.env, agent=config.agent)
        configuration.write(run, dataclasses.replace(about, config=moved))
    write_plan(config, plan, folder)


def join(folder: Path, seeds: list[int]) -> None:
    """Make one run of the parts in this folder, which then go. Nothing is lost if it is stopped on the way: the parts
    go last, under another name, since some of them make no run."""
    if (folder / JOINED).exists():
        shutil.rmtree(folder / JOINED)
    if not (folder / PARTS).exists():
        return
    found = list((folder / PARTS).iterdir())
    others = sorted(path.name for path in found if not re.fullmatch(r"[0-9]+-[0-9]+", path.name))
    require(not others, str(folder / PARTS), others, "is of no part and would be lost; take it elsewhere")
    parts = sorted(found, key=lambda path: int(path.name.partition("-")[0]))
    about = dataclasses.replace(configuration.read(parts[0]), seeds=seeds)
    configuration.write(folder, about)
    for table in tables.TABLES:
        rows = {(row["epoch"], row["seed"]): row for part in parts for row in tables.read_table(part, table)}
        epochs = sorted({epoch for epoch, _ in rows})
        tables.replace_table(folder, table, [rows[epoch, seed] for epoch in epochs for seed in seeds])
    for name in ("checkpoint", "policy"):
        read = [checkpoint.read_header(part / name) for part in parts]
        trees = [flax.serialization.msgpack_restore(payload) for _, payload in read]
        whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *trees)
        checkpoint.save(folder / name, {"epoch": read[0][0]["epoch"], **about.values()}, whole)
    timings = [timing for part in parts if (timing := tables.read_timing(part))]
    seconds = sum(timing.run_seconds for timing in timings)
    if timings and seconds:
        rates = {
            name: sum(getattr(timing, name) * timing.run_seconds for timing in timings) / seconds
            for name in ("env_steps_per_second", "updates_per_second")
        }
        tables.write_timing(folder, Timing(sum(timing.compile_seconds for timing in timings), seconds, **rates))
    (folder / PARTS).rename(folder / JOINED)
    shutil.rmtree(folder / JOINED)
