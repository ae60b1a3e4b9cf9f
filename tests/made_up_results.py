"""Results with made-up numbers. Of a reproduction: every run of the manifest, none of it trained. Of a search over the
hand-made task: trials with given successes, and the search on disk."""

import functools
import zlib
from pathlib import Path

import hand_made
import numpy as np

from infogoal_jax.data.splits import make_split
from infogoal_jax.envs.object_search import from_data
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.search import Trial, TuneResult, write_plan, write_scores
from infogoal_paper import claims
from infogoal_paper.files import Result, command_of, recorded_config
from infogoal_paper.image_goal_figures import WEIGHTS
from infogoal_paper.manifest import FETCH, STUDIES, Choice, Run, runs_of
from infogoal_paper.numbers import Results, compact
from infogoal_paper.paper import IMAGE_TASKS
from infogoal_paper.plan import config_of, is_judged, is_pictured

EVALUATIONS, GOALS, STARTS, LENGTH = 8, 20, 2, 10
SUCCESS = {"infogoal": 0.9, "infobot": 0.7, "her": 0.6, "cher": 0.6, "ghrl": 0.6, "none": 0.2}
"""Of methods on test goals; of the others 0.4."""


@functools.cache
def configuration(run: Run) -> dict:
    """The configuration that a run records."""
    return recorded_config(config_of(run, Path()))


def result_of(run: Run, level: float | None = None, **about) -> Result:
    """A finished run that reaches this share of its goals."""
    draw = np.random.default_rng(zlib.crc32(run.name.encode()))
    level = SUCCESS.get(run.method, 0.4) if level is None else level
    kinds = ["train_goal", "test_goal", "test_goal_mean_code", "validation_goal"]
    kinds += ["corrupted_train_goal", "corrupted_test_goal"] * (run.task in IMAGE_TASKS and run.method != "leo")
    shape = len(run.seeds), EVALUATIONS
    evaluations = {
        f"{kind}/success_rate": np.clip(level + 0.02 * draw.normal(size=shape), 0, 1).round(3) for kind in kinds
    }
    evaluations["train_goal/success_rate"] = np.minimum(1, np.linspace(0.5, 2.5, EVALUATIONS)) * np.ones(shape)
    evaluations |= {f"{kind}_goal/spl": 0.8 * evaluations[f"{kind}_goal/success_rate"] for kind in ("train", "test")}
    evaluations["env_steps"] = 1000.0 * np.arange(1, EVALUATIONS + 1) * np.ones(shape)
    if run.method in ("infogoal", "infobot"):
        evaluations |= {
            f"{run.method}/{name}": value + 0.001 * draw.random(shape)
            for name, value in (("beta", 0.012), ("accuracy", 0.96), ("kl", 20.0))
        }
    uses = np.repeat([0, 2], [GOALS // 2, GOALS // 2]).astype(np.int8)
    first = draw.integers(1, 5, (len(run.seeds), EVALUATIONS, GOALS, STARTS)) + 3 * (run.method == "infobot")
    first = np.where(draw.random(first.shape) < level, first, LENGTH + 1).astype(np.uint8)
    arrays = {"first_reached": first, "uses": uses} | (pictures_of(run, draw) if is_pictured(run) else {})
    arrays |= codes_of(run, draw) if is_judged(run) else {}
    arrays |= {"near": np.arange(GOALS) % 2 == 0} if run.task in FETCH else {}
    known = {
        "config": configuration(run),
        "data": "made up",
        "versions": {"jax": "0"},
        "machine": "a machine, 2026-11-23",
        "updates": 100,
        "diverged": [],
        "learner": run.method,
        "learner_share": 0.3,
        "measuring_failed": "",
        "episode_length": LENGTH,
        "program": {"runs": [run.name], "lanes": 5, "compile_seconds": 10, "run_seconds": 20, "spans": [[0, 60]]},
        "measure_seconds": 1,
        "command": " ".join(command_of(run)),
    }
    return Result(
        run,
        known | about,
        {name: value.astype(np.float32).astype(float) for name, value in evaluations.items()},
        arrays,
    )


def codes_of(run: Run, draw: np.random.Generator) -> dict[str, np.ndarray]:
    """What claims say of a run's codes: those of InfoGoal lie together."""
    views, level = 1 + len(WEIGHTS) * (run.task in IMAGE_TASKS), 0.6 if run.method == "infogoal" else 0.1
    found = {"closeness": level + 0.02 * draw.normal(size=(len(run.seeds), views))}
    if run.method == "infogoal" and run.task not in IMAGE_TASKS:
        found["reward"] = 0.5 + 0.02 * draw.normal(size=len(run.seeds))
    return {f"codes/{name}": value.astype(np.float32) for name, value in found.items()}


def pictures_of(run: Run, draw: np.random.Generator) -> dict[str, np.ndarray]:
    """The arrays of a run's pictures."""
    images = run.task in IMAGE_TASKS
    views, ways, regions = 1 + len(WEIGHTS) if images else 1, len(WEIGHTS) if images else 1, np.arange(GOALS) % 4
    centres = draw.normal(size=(4, 32))[regions]
    found = {
        "code_mean": (centres + 0.2 * draw.normal(size=(views, GOALS, 32))).astype(np.float16),
        "code_region": regions.astype(np.int16),
        "code_use": np.repeat([0, 2], GOALS // 2).astype(np.int8),
    }
    if run.method in ("infogoal", "infobot"):
        found["code_std"] = np.full((views, GOALS, 32), 0.3, np.float16)

    def ways_named(name):
        path = np.cumsum(draw.normal(size=(ways, 4, LENGTH + 1, 2)), axis=2).astype(np.float32)
        return {
            name: path,
            f"{name}_success": draw.random((ways, 4)) < 0.5,
            f"{name}_region": np.arange(4, dtype=np.int16),
            f"{name}_goal": path[0, :, -1],
        }

    found |= ways_named("way")
    if not images:
        found["place"] = draw.normal(size=(40, 2)).astype(np.float32)
        if run.method == "infogoal":
            found |= ways_named("reward_way") | {"reward": -draw.random((4, 40)).astype(np.float16)}
    return {f"picture/{name}": value for name, value in found.items()}


def results(seeds: int = 2, studies: tuple[str, ...] = tuple(STUDIES), **chosen) -> Results:
    """Every run of these studies, compact, with so many seeds; chosen: further fields of the choice."""
    runs = runs_of(studies, Choice(**({"variants": ("paper", "her"), "seeds": seeds} | chosen)))
    return {run: compact(result_of(run)) for run in runs}


def verdict(results, name: str) -> str:
    """The verdict on the claim of this name."""
    (claim,) = (claim for claim in claims.CLAIMS if claim.name == name)
    return claim.find(results).verdict


USES = ("train",) * 4 + ("validation",) * 2 + ("test",) * 2


def environment():
    """The hand-made task, with two of its test goals for validation."""
    split = make_split(
        {
            name: (f"room {hand_made.SPLIT.rooms[name]}", use)
            for name, use in zip(hand_made.SPLIT.objects, USES, strict=True)
        }
    )
    return from_data(hand_made.scenes(), split, np.eye(8, 16, dtype=np.float32), 20)


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
    return TuneResult(Description(config, [1000], "made up", {}, "cpu"), "train", trials)


def save(found: TuneResult, folder: Path) -> None:
    """Leave a search on disk as the command does."""
    folder.mkdir()
    write_plan(folder, found)
    write_scores(folder, found)
