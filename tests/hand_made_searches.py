"""Searches over the hand-made task: small configurations, results with given successes, and searches on disk."""

from pathlib import Path

import hand_made
import numpy as np

from infogoal_jax.data.splits import make_split
from infogoal_jax.envs.object_search import lay_out
from infogoal_jax.report import tuning
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.search import Trial, TuneResult, write_plan
from infogoal_jax.train.lanes import plan_of

USES = ("train",) * 4 + ("validation",) * 2 + ("test",) * 2


def environment():
    """The hand-made task, with two of its test goals for validation."""
    split = make_split(
        {
            name: (f"room {hand_made.SPLIT.rooms[name]}", use)
            for name, use in zip(hand_made.SPLIT.objects, USES, strict=True)
        }
    )
    return lay_out(hand_made.scenes(), split, np.eye(8, 16, dtype=np.float32), 20)


def small(method: str = "none", **changes):
    sizes = {
        "num_epochs": 2,
        "epochs_per_evaluation": 1,
        "updates_per_epoch": 3,
        "batch_size": 16,
        "num_envs": 4,
        "rollout_steps": 20,
    }
    return hand_made.config(method, **(sizes | changes))


def made(config, successes, diverged=()) -> TuneResult:
    """A search of one field that came to these successes [trials][evaluations] of one seed."""
    trials = [
        Trial(
            number,
            {"learning_rate": 1e-3 / (number + 1)},
            [[value] for value in each],
            [[0.0]] * len(each),
            [1000] * (number in diverged),
        )
        for number, each in enumerate(successes)
    ]
    return TuneResult(
        config,
        "train",
        ("learning_rate",),
        [1000],
        list(range(1, len(successes[0]) + 1)),
        trials,
        0.0,
        0.0,
        Description(config, [1000], "made up", {}, "cpu"),
    )


def save(found: TuneResult, folder: Path) -> None:
    """Leave a search on disk as the command does."""
    folder.mkdir()
    write_plan(folder, found.about, plan_of(found))
    tuning.save(found, folder)
