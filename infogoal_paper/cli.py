"""`infogoal reproduce ...`: the paper's tables and figures, from goal images and training to the finished page."""

import dataclasses
import os
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, Positional

from infogoal_jax.cli.commands import Group, WholeNumbers, Words, check_seed, named
from infogoal_jax.errors import UserError, require
from infogoal_paper.paper import DESCRIPTIONS

HELP = "Train what a table or figure of the paper needs, and draw it; or a study beside the paper."
BESIDE = {"all_goals": "Beside the paper: LEO and the all-goals head against HER, under both protocols of known goals"}
TITLES = DESCRIPTIONS | {"all": "All tables and figures of the paper, and the verdict on every claim"} | BESIDE


@dataclasses.dataclass(frozen=True)
class Flags:
    """What is asked for of a table or figure."""

    name: tyro.conf.Suppress[tyro.conf.Fixed[str]] = "all"
    """Of the table or figure."""
    tasks: Words = ()
    """Tasks; empty: all."""
    methods: Words = ()
    """Rows of Table I, or of the table of all_goals (none, her, leo, all_goals, infogoal+all_goals, infobot+all_goals);
    empty: all."""
    variants: Words = ("paper", "her")
    """Of Table I: paper, in which HER, CHER and GHRL alone relabel; her, in which every learner has HER too; text, in
    which InfoGoal, InfoBot and GCB have it."""
    sets: WholeNumbers = ()
    """Goal sets; empty: all of each task."""
    seeds: int = 5
    """Seeds of each run, from 0 on."""
    out: str = "runs/reproduction"
    """Folder of the runs, tables and figures; processes that have the same folder share the work."""
    minutes: float = 0.0
    """Stop in time for this many minutes, with a checkpoint of what is not finished; 0: no limit."""
    retry: FlagCreatePairsOff[bool] = False
    """Run again what failed."""
    quick: FlagCreatePairsOff[bool] = False
    """At a size at which nothing is learned, a few runs of each kind."""
    list_runs: Annotated[FlagCreatePairsOff[bool], tyro.conf.arg(name="list")] = False
    """Print the runs, the programs that train them and how far they are, and train nothing."""
    goal_images: str = ""
    """Folder of further goal sets of Fetch: NUMBER/TASK.npz (infogoal reproduce goal-images)."""
    known: str = ""
    """Folder of compact numbers, such as docs/results: runs that it holds are not trained."""
    vmap_size: int = 64
    """Seeds, settings and goal sets that one program trains side by side (`jax.vmap`) at most."""
    from_: Annotated[str, tyro.conf.arg(name="from")] = ""
    """Folder of compact numbers, such as docs/results: draw from them and train nothing."""
    page: str = ""
    """File that the verdicts are written to; empty: reproduction.md in the folder."""
    processes: int = 0
    """How many work on the folder side by side; 0: one, here, or of a cluster one on each device."""
    gpus: int = 0
    """GPUs over which the processes are spread; 0: each sees all devices."""
    engine: Literal["processes", "ray"] = "processes"
    """processes, which run here; ray, workers of a Ray cluster."""
    ray_address: str = ""
    """The cluster: HOST:PORT of one that this machine belongs to, auto for the one that runs here, ray://HOST:10001
    from outside; empty: one of this machine alone, which ends with the command."""
    draw: bool = True
    """Draw what there are numbers for at the end."""
    format: Literal["png", "pdf", "svg"] = "png"
    """Of the figures; PNG is written besides, for the pages."""
    known_goals: Words = ()
    """Protocols of all_goals: visited, in which goals that are achieved may enter; held_out, in which test and
    validation goals never do; empty: both."""


def study(flags: Annotated[Flags, tyro.conf.arg(name="")] = Flags()) -> int:
    """A table or figure.

    Returns:
        0 when all is done; 1 when a run failed; 130 when there is more to do.
    """
    from infogoal_paper import command

    out = Path(flags.out)
    for path in (out, *out.parents):
        require(not os.path.isfile(path), "out", flags.out, f"{path} is a file; give a folder")
    given = {name: Path(getattr(flags, name)) for name in command.PATHS if getattr(flags, name)}
    paths = dict.fromkeys(command.PATHS) | given | {"out": out}
    return command.reproduce(command.Asked(**vars(flags) | paths))


def merge(folders: Positional[tuple[str, ...]], into: str = "docs/results") -> int:
    """Put the finished runs of several folders into the compact numbers.

    Args:
        folders: Folders of `infogoal reproduce`, or copies of them; of a run that several have, the last one's counts.
        into: Folder of the compact numbers, which is added to.
    """
    from infogoal_paper import command

    return command.merge([Path(folder) for folder in folders], Path(into))


def goal_images(
    path: Positional[str], seed: int = 0, tasks: Words = ("fetch_reach", "fetch_push", "fetch_pick_and_place")
) -> int:
    """Draw goal sets of Fetch (needs `pip install 'infogoal-jax[goal-images]'` and OpenGL;
    docs/reference/goal_inputs.md).

    Args:
        path: Folder to write to, one file a task; files that are there already are never overwritten.
        seed: Seed of the goals for training, validation and tests; 0: the shipped ones.
        tasks: The tasks.
    """
    check_seed(seed)
    from rich.progress import track

    from infogoal_jax.data.goal_images import save
    from infogoal_paper import goal_rendering

    files = {name: Path(path) / f"{name}.npz" for name in tasks}
    for file in files.values():
        if os.path.lexists(file):
            raise UserError(f"path = {str(file)!r}: is there already; give a new folder")
    goal_rendering.check(tuple(files), seed)
    for name, file in files.items():
        start = time.perf_counter()
        bank = goal_rendering.build(name, seed, lambda goals, name: track(goals, name, disable=not sys.stdout.isatty()))
        save(file, bank)
        seconds = time.perf_counter() - start
        print(f"{file}: {len(bank.images)} images, {file.stat().st_size / 1e6:.2f} MB, built in {seconds:.0f} s")
        for field, words in bank.about.items():
            print(f"  {field}: {words}")
    return 0


COMMANDS = {name: named(study, f"{title}.", flags=Flags(name)) for name, title in TITLES.items()}
REPRODUCE = Group(HELP, COMMANDS | {"goal-images": goal_images, "merge": merge})
