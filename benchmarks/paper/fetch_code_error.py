"""How far corruption moves the codes of goals, in metres: where the grid goal lies whose mean code is nearest to that
of a corrupted training goal.

    python benchmarks/paper/fetch_code_error.py RUN [RUN ...] [--weight 0.4]

For each seed of a run: the mean distance between a training goal and that grid goal, over 20 test backgrounds for each
goal, with the image clean, under uniform grey of the same weight (less contrast, no clutter), corrupted, and corrupted
but given the clean image's mean and contrast back.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import presets
from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.learners.learner import encode_all
from infogoal_jax.report.machine import describe_machine
from infogoal_jax.report.runs import load_run, read_params
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.train.program import make_train

BACKGROUNDS = 20
GREY = 128


def contrast_of(images: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Images [B, H, W, C] with the mean and the standard deviation of others, each of its own."""
    axes = (1, 2, 3)
    centred = (images - images.mean(axes, keepdims=True)) / images.std(axes, keepdims=True)
    return np.clip(centred * like.std(axes, keepdims=True) + like.mean(axes, keepdims=True), 0, 255).astype(np.uint8)


def errors(path: Path, weight: float) -> dict[str, np.ndarray]:
    """Mean distance in m of each kind of image, [seeds]."""
    run = load_run(path)
    train = make_train(run.config)
    env, learner = train.env, train.parts.learner
    goals = np.repeat(np.asarray(env.goals.commanded), BACKGROUNDS)
    clean = np.asarray(env.goals.inputs)[goals]
    backgrounds = draw_backgrounds(jax.random.key(0), env.test_backgrounds, goals.shape)
    corrupted = np.asarray(corrupt(clean, backgrounds, weight))
    images = {
        "clean": clean,
        "grey": np.asarray(corrupt(clean, jnp.full_like(clean, GREY), weight)),
        "corrupted": corrupted,
        "corrupted, contrast restored": contrast_of(corrupted.astype(float), clean.astype(float)),
    }
    grid, positions = int(np.prod(env.unwrapped.grid_shape)), np.asarray(env.unwrapped.positions)
    found = {name: [] for name in images}
    for seed in range(len(run.seeds)):
        params = jax.tree.map(lambda leaf, seed=seed: jnp.asarray(leaf[seed]), read_params(run, train)["goal"])
        table = np.asarray(jax.jit(lambda params, goals: encode_all(learner, params, goals).mean)(params, env.goals))[
            :grid
        ]
        for name, batch in images.items():
            codes = np.asarray(jax.jit(lambda params, batch: learner.encode(params, batch).mean)(params, batch))
            nearest = np.abs(codes[:, None] - table).mean(-1).argmin(1)
            found[name].append(np.linalg.norm(positions[nearest] - positions[goals], axis=1).mean())
    return {name: np.array(values) for name, values in found.items()}


def main():
    """Print a table with a row for each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--weight", type=float, default=0.4)
    arguments = parser.parse_args()
    for number, path in enumerate(arguments.runs):
        found = errors(path, arguments.weight)
        if not number:
            print(f"| run | {' | '.join(found)} |\n{'|---' * (len(found) + 1)}|")
        run = load_run(path)
        shown = " | ".join(mean_interval(values).show(3) for values in found.values())
        print(f"| {run.config.task}, {presets.name_of(run.config)} | {shown} |", flush=True)
    print(f"\nDistances in m, weight {arguments.weight}; {describe_machine()}")


if __name__ == "__main__":
    main()
