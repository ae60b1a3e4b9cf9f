"""Learners over TD3 and HER on continuous goals: success on goals that training never asks for, and how precise codes
are. A study is a list of settings; its file holds every seed, and settings that it holds already are left out.

    python -m benchmarks.goals.continuous causes --out causes.json        # what of InfoGoal costs success, in the maze
    python -m benchmarks.goals.continuous methods --out methods.json      # InfoGoal, VAE, COGOAL and no learner
    python -m benchmarks.goals.continuous negatives --out negatives.json  # three ways to find dissimilar goals
    python -m benchmarks.goals.continuous --show negatives.json

`python -m infogoal_paper.continuous FILE ...` puts them into docs/results, for docs/research/continuous_goals.md.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from infogoal_jax import envs, make_train, presets
from infogoal_jax.envs import plane
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.report.statistics import describe_machine, mean_interval
from infogoal_jax.train.experience import make_experience
from infogoal_jax.train.update import sample_pairs, updates

GROUPS = ("train", "validation", "test")


@dataclasses.dataclass(frozen=True)
class Setting:
    """A preset with changes."""

    name: str
    task: str
    method: str
    learner: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of the learner."""
    hyper: dict[str, float] = dataclasses.field(default_factory=dict)
    """Floats by dotted name. Settings that differ in these alone are trained side by side."""
    env: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of the environment."""

    def config(self, num_epochs: int | None):
        """Its configuration; num_epochs: in place of the preset's."""
        config = presets.load(self.task, self.method, agent="td3")
        epochs = num_epochs or config.num_epochs
        return dataclasses.replace(
            config,
            env=dataclasses.replace(config.env, **self.env),
            learner=dataclasses.replace(config.learner, **self.learner),
            hyper=with_values(config.hyper, self.hyper),
            num_epochs=epochs,
            epochs_per_evaluation=max(1, epochs // 4) if epochs % 4 == 0 else epochs,
        )


def studies() -> dict[str, list[Setting]]:
    """The settings of each study."""
    held_out = {"point_maze": {}, "reacher": {}, "fetch_reach_positions": {"held_out": "octant"}}
    rules = {f"alpha {alpha}": {"learner.beta_threshold": alpha} for alpha in (0.96, 0.99, 0.997)}
    rules["beta 0"] = {"learner.beta_step": 0.0}
    weighed = [(name, 1.0) for name in rules] + [("alpha 0.96", 0.1), ("beta 0", 0.1)]
    settings = {f"{name}, weight {weight}": rules[name] | {"learner_weight": weight} for name, weight in weighed}
    causes = []
    for task, env in held_out.items():
        causes.append(Setting(f"{task} none", task, "none", env=env))
        for window in (1, 5):
            causes += [
                Setting(
                    f"{task} infogoal, window {window}, {setting}",
                    task,
                    "infogoal",
                    {"window": window, "beta_rule": "linear"},
                    hyper,
                    env,
                )
                for setting, hyper in settings.items()
            ]
            following = {"window": window, "beta_rule": "relative"}
            causes += [
                Setting(
                    f"{task} infogoal, window {window}, margin {margin}, weight {weight}",
                    task,
                    "infogoal",
                    following,
                    {"learner.beta_margin": margin, "learner_weight": weight},
                    env,
                )
                for margin, weight in ((0.005, 1.0), (0.02, 1.0), (0.005, 0.1))
            ]
    methods = []
    for task in ("point_maze", "fetch_reach_positions"):
        methods.append(Setting(f"{task} none", task, "none", env=held_out[task]))
        fields = [("infogoal", {})]
        fields += [("vae", {"vae_beta": weight}) for weight in (1.0, 0.1, 0.01)]
        fields += [("cogoal", {"window": window}) for window in (1, 5)]
        methods += [
            Setting(
                f"{task} {method} {json.dumps(learner)}, weight {weight}",
                task,
                method,
                learner,
                {"learner_weight": weight},
                held_out[task],
            )
            for method, learner in fields
            for weight in (1.0, 0.1)
        ]
    negatives = [
        Setting(f"dissimilar by {rule}", "point_maze", "infogoal", {"dissimilar_by": rule})
        for rule in ("trajectory", "cells", "classifier")
    ]
    return {"causes": causes, "methods": methods, "negatives": negatives}


def error_of_a_code(train, params) -> jax.Array:
    """How far off the best unbiased guess of a goal is that sees one sampled code, float32 [] in units of goals: the
    Cramér-Rao bound, its median over the evaluated goals."""

    def error(goal):
        def code(goal):
            return train.parts.learner.encode(params["goal"], train.env.goals.inputs_of(goal[None]))

        slopes = jax.jacobian(lambda goal: code(goal).mean[0])(goal) / code(goal).std[0][:, None]
        information = slopes.T @ slopes + 1e-9 * jnp.eye(goal.shape[0])
        return jnp.sqrt(jnp.trace(jnp.linalg.inv(information)))

    return jnp.median(jax.vmap(error)(train.env.goals.evaluated))


def run(settings: list[Setting], seeds: int, num_epochs: int | None, is_about_negatives: bool) -> list[dict]:
    """Train settings that differ in their floats alone side by side: what is kept of each."""
    began, configs = time.perf_counter(), [setting.config(num_epochs) for setting in settings]
    train, keys = make_train(configs[0]), jax.random.split(jax.random.key(0), seeds)
    has_noise = settings[0].method in ("infogoal", "vae")

    def one(key, hyper, env):
        result = train(key, hyper, env)
        found = {"metrics": result.metrics, "epochs": result.epochs}
        if has_noise:
            found["error_of_a_code"] = error_of_a_code(train, result.params)
        return found | ({"state": result.state} if is_about_negatives else {})

    hyper = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(config.hyper for config in configs))
    sweep = jax.jit(jax.vmap(jax.vmap(one, (0, None, None)), (None, 0, None)))
    results = jax.block_until_ready(sweep(keys, hyper, train.env))
    seconds = time.perf_counter() - began
    found = []
    for place, setting in enumerate(settings):
        result = member(results, place)
        kept = dataclasses.asdict(setting) | {"seconds": round(seconds, 1), "together": len(settings), "seeds": seeds}
        kept["env_steps"] = int(result["metrics"]["env_steps"][0, -1])
        for group in GROUPS:
            for suffix in ("", "_mean_code"):
                name = f"{group}_goal{suffix}/success_rate"
                if name in result["metrics"] and (has_noise or not suffix):
                    kept[group + suffix] = rounded(result["metrics"][name])
        for name, values in result["epochs"].items():
            if name.split("/")[-1] in ("beta", "kl", "accuracy", "no_negative", "td_error", "value", "classifier_loss"):
                count = values.shape[1]
                kept[name] = rounded(values[:, [count // 10, count // 4, count // 2, count - 1]], 5)
        if has_noise:
            kept["error_of_a_code"] = rounded(result["error_of_a_code"])
        if is_about_negatives:
            kept |= of_negatives(train, configs[place], result["state"])
        found.append(kept)
    return found


def member(tree: Any, place: int) -> Any:
    """The leaves [N, ...] at one place."""
    return jax.tree.map(lambda leaf: leaf[place], tree)


def rounded(values: jax.Array, decimals: int = 3) -> list:
    """The numbers, as short as a file needs them."""
    return np.round(np.asarray(values, float), decimals).tolist()


HOP = 0.05
"""Side of the squares that the maze is walked in, half of a step."""


def squares_apart(window: int) -> np.ndarray:
    """Squares of the maze between which the point can get within `window` steps: bool [N, N], by the shortest path over
    the squares, row by row from below."""
    count = round(plane.ROOMS / HOP)
    middles = (np.stack(np.meshgrid(*[np.arange(count)] * 2), -1).reshape(-1, 2) + 0.5) * HOP
    maze, links = envs.load("point_maze"), []
    move = jax.jit(jax.vmap(maze.move, (0, None)))
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):
            after = np.asarray(move(jnp.asarray(middles, jnp.float32), jnp.asarray([x, y], jnp.float32) * HOP / 0.1))
            column, row = np.clip((after / HOP).astype(int), 0, count - 1).T
            links.append(row * count + column)
    start = np.tile(np.arange(count**2), len(links))
    graph = csr_matrix((np.ones(len(start)), (start, np.concatenate(links))), shape=(count**2,) * 2)
    hops = round(window * 0.1 / HOP)
    return dijkstra(graph, unweighted=True, limit=hops) <= hops


def of_negatives(train, config, states) -> dict[str, Any]:
    """Of the goals called dissimilar at the end of training, the share that the point can reach within the window, for
    each seed; the share of pairs without a negative; and the time of an update of one seed."""
    window, pairs_drawn, count = config.learner.window, 4096, round(plane.ROOMS / HOP)
    within, last = squares_apart(window), jnp.int32(config.num_epochs - 1)
    spec = train.parts.learner.sample_spec._replace(num_pairs=pairs_drawn)
    parts = train.parts._replace(learner=train.parts.learner._replace(sample_spec=spec))

    @jax.jit
    def draw(state, key, env):
        setup = train.setup(config.hyper, env)
        experience, _ = make_experience(setup, state, last)
        return sample_pairs(setup._replace(parts=parts), experience, key)

    def square(goals):
        column, row = np.moveaxis(np.clip((np.asarray(goals) / HOP).astype(int), 0, count - 1), -1, 0)
        return row * count + column

    wrong, none, near = [], [], []
    num_seeds = jax.tree.leaves(states)[0].shape[0]
    for seed in range(num_seeds):
        state = member(states, seed)
        drawn = draw(state, jax.random.key(seed), train.env)
        found = np.asarray(drawn.negative_weight[:, 0] * drawn.positive_weight) > 0
        first, second = square(drawn.contrast[:, 0]), square(drawn.negative[:, 0])
        wrong.append(within[first, second][found].mean())
        none.append(1 - found.mean())
        near.append(np.linalg.norm(np.asarray(drawn.contrast - drawn.negative)[:, 0], axis=-1)[found].min())

    @jax.jit
    def some_updates(state, env):
        setup = train.setup(config.hyper, env)
        experience, state = make_experience(setup, state, last)
        return updates(setup, experience, state, state.key, config.updates_per_epoch)

    state = member(states, 0)
    jax.block_until_ready(some_updates(state, train.env))
    times = []
    for _ in range(3):
        began = time.perf_counter()
        jax.block_until_ready(some_updates(state, train.env))
        times.append((time.perf_counter() - began) / config.updates_per_epoch * 1e3)
    return {
        "false_negatives": rounded(np.array(wrong), 5),
        "without_negative": rounded(np.array(none), 5),
        "nearest_negative": rounded(np.array(near)),
        "ms_an_update": round(min(times), 3),
    }


def show(path: Path) -> None:
    """Print the table of a study: means over seeds with 95 % intervals, after the last evaluation."""
    study = json.loads(path.read_text())
    scores = [*GROUPS, *(f"{group}_mean_code" for group in GROUPS)]
    others = ("error_of_a_code", "false_negatives", "without_negative", "nearest_negative")
    columns = [name for name in (*scores, *others) if any(name in each for each in study["settings"])]
    last = [name for name in ("infogoal/beta", "infogoal/kl", "infogoal/accuracy")]
    last = [name for name in last if any(name in each for each in study["settings"])]
    print(f"\n{path.stem}: {study['machine']}\n")
    print("| setting | " + " | ".join([*columns, *last, "ms an update", "s"]) + " |")
    print("|---" * (len(columns) + len(last) + 3) + "|")
    for each in study["settings"]:
        cells = []
        for name in columns:
            values = np.asarray(each.get(name, []), float)
            values = values[:, -1] if values.ndim == 2 else values
            cells.append(mean_interval(values).show(3 if name in others else 2) if len(values) else "")
        cells += [f"{np.mean(each[name], 0)[-1]:.4g}" if name in each else "" for name in last]
        cells += [str(each.get("ms_an_update", "")), f"{each['seconds']:.0f} / {each['together']}"]
        print(f"| {each['name']} | " + " | ".join(cells) + " |")


def main() -> None:
    """Train what a study lacks, or print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", nargs="?", choices=tuple(studies()))
    parser.add_argument("--out", type=Path, help="the file of the study")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--num-epochs", type=int, help="in place of the presets'")
    parser.add_argument("--only", default="", help="settings whose names hold this alone")
    parser.add_argument("--show", type=Path, nargs="+", default=[], help="print the tables of these files")
    arguments = parser.parse_args()
    for path in arguments.show:
        show(path)
    if arguments.study is None:
        return
    if arguments.out is None:
        parser.error("give --out, the file of the study")
    kept = json.loads(arguments.out.read_text())["settings"] if arguments.out.exists() else []
    groups: dict[str, list[Setting]] = {}
    for setting in studies()[arguments.study]:
        if arguments.only in setting.name and setting.name not in [each["name"] for each in kept]:
            same = json.dumps([setting.task, setting.method, setting.learner, setting.env])
            groups.setdefault(same, []).append(setting)
    for settings in groups.values():
        kept += run(settings, arguments.seeds, arguments.num_epochs, arguments.study == "negatives")
        lines = ",\n".join(json.dumps(each) for each in kept)
        head = f'"study": "{arguments.study}", "machine": "{describe_machine()}"'
        arguments.out.write_text(f'{{{head}, "settings": [\n{lines}\n]}}\n')
        print(f"{settings[0].name} ...: {len(settings)} settings, {kept[-1]['seconds']} s", flush=True)
    show(arguments.out)


if __name__ == "__main__":
    main()
