"""`infogoal reproduce ...`: the paper's tables and figures, from training to the finished page."""

import os
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, Positional

from infogoal_jax.cli.commands import Group, named
from infogoal_jax.errors import require
from infogoal_paper.paper import DESCRIPTIONS

HELP = "Train what a table or figure of the paper needs, and draw it; or a study beside the paper."
BESIDE = {"all_goals": "Beside the paper: LEO and the all-goals head against HER, under both protocols of known goals"}
TITLES = DESCRIPTIONS | {"all": "All tables and figures of the paper, and the verdict on every claim"} | BESIDE


def study(
    name: tyro.conf.Suppress[tyro.conf.Fixed[str]] = "all",
    tasks: tuple[str, ...] = (),
    methods: tuple[str, ...] = (),
    variants: tuple[str, ...] = ("paper", "her"),
    sets: tuple[int, ...] = (),
    seeds: int = 5,
    out: str = "runs/reproduction",
    minutes: float = 0.0,
    retry: FlagCreatePairsOff[bool] = False,
    quick: FlagCreatePairsOff[bool] = False,
    list_runs: Annotated[FlagCreatePairsOff[bool], tyro.conf.arg(name="list")] = False,
    goal_images: str = "",
    known: str = "",
    vmap_size: int = 64,
    from_: Annotated[str, tyro.conf.arg(name="from")] = "",
    page: str = "",
    processes: int = 0,
    gpus: int = 0,
    engine: Literal["processes", "ray"] = "processes",
    ray_address: str = "",
    draw: bool = True,
    format: Literal["png", "pdf", "svg"] = "png",
    known_goals: tuple[str, ...] = (),
) -> int:
    """A table or figure.

    Args:
        name: Of the table or figure.
        tasks: Tasks; empty: all.
        methods: Rows of Table I, or of the table of all_goals (none, her, leo, all_goals, infogoal+all_goals,
            infobot+all_goals); empty: all.
        variants: Of Table I: paper, in which HER, CHER and GHRL alone relabel; her, in which every learner has HER too.
        sets: Goal sets; empty: all of each task.
        seeds: Seeds of each run, from 0 on.
        out: Folder of the runs, tables and figures; processes that have the same folder share the work.
        minutes: Stop in time for this many minutes, with a checkpoint of what is not finished; 0: no limit.
        retry: Run again what failed.
        quick: At a size at which nothing is learned, a few runs of each kind.
        list_runs: Print the runs, the programs that train them and how far they are, and train nothing.
        goal_images: Folder of further goal sets of Fetch: NUMBER/TASK.npz, as `infogoal data build fetch` makes them.
        known: Folder of compact numbers, such as docs/results: runs that it holds are not trained.
        vmap_size: Seeds, settings and goal sets that one program trains side by side (`jax.vmap`) at most.
        from_: Folder of compact numbers, such as docs/results: draw from them and train nothing.
        page: File that the verdicts are written to; empty: reproduction.md in the folder.
        processes: How many work on the folder side by side; 0: one, here, or of a cluster one on each device.
        gpus: GPUs over which the processes are spread; 0: each sees all devices.
        engine: processes, which run here; ray, workers of a Ray cluster.
        ray_address: The cluster: HOST:PORT of one that this machine belongs to, auto for the one that runs here,
            ray://HOST:10001 from outside; empty: one of this machine alone, which ends with the command.
        draw: Draw what there are numbers for at the end.
        format: Of the figures; PNG is written besides, for the pages.
        known_goals: Protocols of all_goals: visited, in which goals that are achieved may enter; held_out, in which
            test and validation goals never do; empty: both.

    Returns:
        0 when all is done; 1 when a run failed; 130 when there is more to do.
    """
    from infogoal_paper import command

    for path in (Path(out), *Path(out).parents):
        require(not os.path.isfile(path), "out", out, f"{path} is a file; give a folder")
    return command.reproduce(
        command.Asked(
            name,
            tasks,
            methods,
            variants,
            sets,
            seeds,
            Path(out),
            minutes,
            retry,
            quick,
            list_runs,
            Path(goal_images) if goal_images else None,
            Path(known) if known else None,
            vmap_size,
            Path(from_) if from_ else None,
            Path(page) if page else None,
            processes,
            gpus,
            engine,
            ray_address,
            draw,
            format,
            known_goals,
        )
    )


def merge(folders: Positional[tuple[str, ...]], into: str = "docs/results") -> int:
    """Put the finished runs of several folders into the compact numbers.

    Args:
        folders: Folders of `infogoal reproduce`, or copies of them; of a run that several have, the last one's counts.
        into: Folder of the compact numbers, which is added to.
    """
    from infogoal_paper import command

    return command.merge([Path(folder) for folder in folders], Path(into))


COMMANDS = {name: named(study, f"{title}.", name=name) for name, title in TITLES.items()}
REPRODUCE = Group(HELP, COMMANDS | {"merge": merge})
