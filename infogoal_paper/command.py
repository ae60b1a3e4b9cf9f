"""What `infogoal reproduce` does: plan, train what is left, then draw what was asked for."""

import dataclasses
import functools
import time
from pathlib import Path

from infogoal_jax.errors import counted, require, typed
from infogoal_jax.runner.compilation import use_compilation_cache
from infogoal_jax.runner.executors import check_flags, run_in_processes, run_on_ray
from infogoal_jax.runs import disk
from infogoal_paper import numbers, progress
from infogoal_paper.cli import Flags
from infogoal_paper.manifest import BESIDE, SETS, STUDIES, Choice, Run, runs_of
from infogoal_paper.numbers import Results
from infogoal_paper.paper import TASKS
from infogoal_paper.plan import config_of, fetch_sets, programs_of
from infogoal_paper.work import Work, work_on

DONE, FAILED, MORE = 0, 1, 130
DRAWING = 60.0
"""Seconds that have to be left for drawing."""


PATHS = ("goal_images", "known", "from_", "page")
"""Flags that name a file or a folder, and are empty for none."""


@dataclasses.dataclass(frozen=True)
class Asked(Flags):
    """The flags of the command line, with paths in place of words; None where none is given."""

    out: Path = Path("runs/reproduction")
    goal_images: Path | None = None
    known: Path | None = None
    from_: Path | None = None
    page: Path | None = None

    @property
    def studies(self) -> tuple[str, ...]:
        """The tables and figures that were asked for; all are those of the paper."""
        return tuple(STUDIES) if self.name == "all" else (self.name,)

    def choice(self) -> Choice:
        """What was asked for, as the manifest takes it."""
        return Choice(
            self.tasks, self.methods, self.variants, self.sets or None, self.seeds, self.quick, self.known_goals
        )

    def runs(self) -> list[Run]:
        """The runs that are needed. Raises `UserError` where there are none."""
        choice, images = self.choice(), fetch_sets(self.goal_images)
        all_sets = {number for task in self.tasks or TASKS for number in SETS.get(task, images)}
        for number in self.sets or ():
            require(number in all_sets, "sets", number, f"there are {', '.join(map(str, sorted(all_sets)))}")
        runs = runs_of(self.studies, choice, images)
        given = next((name for name in ("tasks", "methods", "variants", "sets") if getattr(self, name)), "name")
        require(bool(runs), given, getattr(self, given), f"{self.name} has no such run; name others")
        if self.known is None:
            return runs
        known = self.known_results
        return [
            run for run in runs if not numbers.holds(known, run, config_of(run, self.goal_images), measured=self.retry)
        ]

    @functools.cached_property
    def known_results(self) -> Results:
        """The runs of the folder of known numbers; none without one. They are read once."""
        return {} if self.known is None else numbers.load(self.known, "known")


def reproduce(asked: Asked) -> int:
    """Train what is left, and draw. Returns the exit status."""
    require(asked.minutes >= 0, "minutes", asked.minutes, "give 0 for no limit, or more")
    require(asked.vmap_size > 0, "vmap_size", asked.vmap_size, "give at least 1")
    check_flags(asked.engine, asked.processes, asked.gpus, asked.ray_address)
    paper = "the paper's runs let goals enter that are achieved; leave it out, or reproduce all_goals"
    require(asked.name in BESIDE or not asked.known_goals, "known_goals", asked.known_goals, paper)
    verdicts = "is that of the verdicts on the paper; leave it out: OUT/all_goals.md has tables and figure"
    require(asked.name not in BESIDE or asked.page is None, "page", str(asked.page), verdicts)
    if asked.page is not None:
        disk.check_out(asked.page, "page")
    deadline = time.time() + 60 * asked.minutes if asked.minutes else float("inf")
    if asked.from_ is not None:
        draw(asked, numbers.load(asked.from_))
        return DONE
    check_size(asked)
    runs = asked.runs()
    if not runs:
        print(f"{asked.known} holds all of these runs")
        return DONE
    if asked.list_runs:
        list_programs(asked, runs)
        return DONE
    ENGINES[asked.engine](asked, runs, deadline)
    config = functools.partial(config_of, goal_images=asked.goal_images)
    states = {run: progress.sound_state_of(asked.out, run, config) for run in runs}
    print(progress.summary(asked.out, runs, states), flush=True)
    for run, state in states.items():
        if state.kind in ("failed", "not measured"):
            print(f"{state.kind}: {run.name}: {state.words[:300]} (--retry runs it again)")
    kinds = {state.kind for state in states.values()}
    if asked.draw and "left" not in kinds and kinds & {"done", "not measured"}:
        if deadline - time.time() > DRAWING:
            draw(asked, asked.known_results | numbers.of_folder(asked.out / "runs"))
        else:
            print("no time was left to draw; the same command draws")
    return FAILED if "failed" in kinds else DONE if kinds <= {"done", "not measured"} else MORE


def check_size(asked: Asked) -> None:
    """Raise `UserError` where the folder, or the known numbers, hold runs at toy size and runs of full size are asked
    for, or the other way round: they would be drawn in one table."""
    known = [run.name for run in asked.known_results]
    for flag, folder, names in (
        ("out", asked.out, (path.name.partition(".")[0] for path in (asked.out / "runs").rglob("seeds_*"))),
        ("known", asked.known, known),
    ):
        for name in names:
            toy = name.endswith("_toy")
            held, remedy = ("at toy size", "with") if toy else ("of full size", "without")
            require(
                toy == asked.quick,
                "quick",
                asked.quick,
                f"the folder of --{flag}, {folder}, holds runs {held}; give another folder, or go on {remedy} --quick",
            )


def work_of(asked: Asked, deadline: float) -> Work:
    """The work on the folder that was asked for."""
    say = lambda words: print(words, flush=True)  # noqa: E731
    settings = {"retry": asked.retry, "goal_images": asked.goal_images, "most_members": asked.vmap_size}
    return Work(asked.out, deadline, say, **settings)


def work_here(asked: Asked, runs: list[Run], deadline: float) -> None:
    """Train what is left in this process, or in several. The exit status of one of several says nothing of the others:
    whether there is more to do is seen in the folder when all have ended."""
    if asked.processes <= 1:
        use_compilation_cache()
        work_on(runs, work_of(asked, deadline))
        return
    minutes = 0.0 if deadline == float("inf") else max(0.01, (deadline - time.time()) / 60)
    statuses = run_in_processes(arguments_of(asked, round(minutes, 2)), asked.processes, asked.gpus)
    for number, status in enumerate(statuses):
        if status not in (DONE, FAILED, MORE):
            print(f"process {number} ended with status {status}; what it had begun is left", flush=True)


def arguments_of(asked: Asked, minutes: float) -> list[str]:
    """The arguments of one process: what was asked for, without drawing, for so many minutes."""
    words = ["reproduce", asked.name, "--no-draw", "--out", str(asked.out), "--seeds", str(asked.seeds)]
    words += ["--vmap-size", str(asked.vmap_size), "--minutes", str(minutes)]
    for flag, values in (
        ("tasks", asked.tasks),
        ("methods", asked.methods),
        ("variants", asked.variants),
        ("sets", asked.sets),
        ("known-goals", asked.known_goals),
    ):
        words += [f"--{flag}", *map(str, values)] if values else []
    words += ["--known", str(asked.known)] if asked.known else []
    words += ["--goal-images", str(asked.goal_images)] if asked.goal_images else []
    return words + ["--retry"] * asked.retry + ["--quick"] * asked.quick


def work_by_ray(asked: Asked, runs: list[Run], deadline: float) -> None:
    """Train what is left on a Ray cluster."""
    work = work_of(asked, deadline)
    say = work.say

    def said(words: str) -> None:
        say(words)
        progress.write(asked.out, runs)

    work.say = said
    work_on(runs, work, functools.partial(run_on_ray, workers=asked.processes, address=asked.ray_address))


ENGINES = {"processes": work_here, "ray": work_by_ray}
"""Who trains, by the name of `--engine`: (asked, runs, deadline)."""


def list_programs(asked: Asked, runs: list[Run]) -> None:
    """Print every program with its runs and how far they are."""
    for program in programs_of(runs, asked.goal_images):
        print(f"{program.name}: {sum(len(run.seeds) for run in program.runs)} seeds")
        for run in program.runs:
            print(f"    {run.name}: {progress.state_of(asked.out, run).kind}")
    print(progress.summary(asked.out, runs))


def merge(folders: list[Path], into: Path) -> int:
    """Put the finished runs of these folders into the compact numbers. Returns the exit status."""
    require(bool(folders), "folders", "", "give folders of infogoal reproduce")
    before = numbers.load(into, "into") if numbers.has_numbers(into) else {}
    results = numbers.merged(before, folders)
    for path in numbers.save(results, into):
        print(f"{path}: {path.stat().st_size:,} bytes")
    others = [run.name for run, result in results.items() if result.has_former_settings]
    if others:
        words = ", ".join(others[:3]) + (f" and {len(others) - 3} more" if len(others) > 3 else "")
        print(f"{counted(len(others), 'run')} made with other settings than the presets have now: {words}")
    for run, result in before.items():
        lost = [name for name in results[run].missing() if name not in result.missing()]
        if lost:
            print(f"{run.name} had {', '.join(lost)}, which the run in its place was not measured for")
    print(f"{len(results)} runs; draw them: infogoal reproduce all --from {typed(into)} --out FOLDER")
    if any(not run.of_paper for run in results):
        print(f"and beside the paper: infogoal reproduce all_goals --from {typed(into)} --out FOLDER")
    return DONE


def draw(asked: Asked, results: numbers.Results) -> None:
    """Write the tables, figures, verdicts and the page of what was asked for."""
    from infogoal_paper import all_goals, drawing

    if asked.name in BESIDE:
        paths = all_goals.draw(results, asked.out, asked.format)
    else:
        paths = drawing.draw(asked.studies, results, asked.out, asked.page, asked.format)
    for path in paths:
        print(path)
