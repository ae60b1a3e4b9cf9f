"""Our offline agents beside OGBench's own, on one dataset in its format and one device: updates a second, and success
in OGBench's environment.

    pip install ogbench distrax ml_collections imageio
    git clone https://github.com/seohongpark/ogbench
    python benchmarks/peers/ogbench_peer.py --collect DATA.npz [--episodes 1000]
    python benchmarks/peers/ogbench_peer.py --data DATA.npz --impls ogbench/impls --out RESULTS.jsonl
        [--agents gcivl gciql qrl crl hiql] [--sides ours theirs] [--seeds 5] [--updates 50000] [--evaluations 3]
        [--side-by-side 1] [--budget 540] [--learners none infogoal] [--held-out 1 2]
    python -m infogoal_paper.ogbench RESULTS.jsonl            # put results into docs/results, and print the tables

`--collect` writes data of our own: a scripted policy goes from cell to cell of OGBench's maze, by a breadth-first
search, to one goal after the other; with `--dataset cube-single-play-v0` OGBench's own scripted policy carries a cube
(`pip install dm_control`). It is not OGBench's file. Whoever has that one gives its path (`--data`), and its name
(`--dataset`), by which floats are read from `impls/hyperparameters.sh`.

RESULTS.jsonl gets a line for every evaluation; what is there already is not run again. So many programs as
`--side-by-side` says share the device. They compile together, then one after the other is timed alone, then they train
together. Once the budget, in seconds, is spent, they stop. `--toy` is a size for a CPU, which checks that everything
runs.

Both sides have OGBench's sizes and floats, its goals (whole states) and its shares of goals. Ours has all seeds in one
program, which draws its batches on the device; theirs one seed a program, as it is made. A row of the table compares
both after the same number of updates, in the tasks of the environment, from the same starts. The best action is taken.

`--learners` puts goal encoders before our agents, and `--held-out` the cells of these tasks' goals out of training.
`--goal-noise` evaluates once more, with goals told wrong by a normal error of this size.

`--image-goals` (our side, pointmaze) shows the goal encoder pictures of goals in place of states; what the agent sees
of itself stays OGBench's state. OGBench renders its pictures by OpenGL. Ours are drawn in the program: from a camera
above the robot that goes with it, walls grey, and the floor coloured by place as in OGBench's visual mazes. Every goal
encoder, `none` too, has the image layers of the Fetch tasks. The second evaluation has a test background of weight 0.4
in each picture; none is seen in training.
"""

import argparse
import dataclasses
import functools
import importlib
import multiprocessing
import os
import random
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

AGENTS = {"gcivl": "gcivl", "gciql": "gciql", "qrl": "qrl", "crl": "offline_crl", "hiql": "hiql"}
"""Ours by OGBench's names."""
LEARNERS = {
    "none": ("none", {}, {}),
    "infogoal": ("infogoal", {}, {}),
    "infogoal, beta 0": ("infogoal", {"learner.beta_step": 0.0}, {}),
    "vae": ("vae", {}, {"vae_beta": 0.01}),
    "cogoal": ("cogoal", {}, {}),
}
"""Goal encoders, each with the floats and fields that it changes; the VAE's beta was chosen on another maze
(docs/research/continuous_goals.md)."""
OF_IMAGES = {"latent_size": 32, "standardise_images": True}
"""Fields of every goal encoder where goals are pictures, in place of those above: as in the Fetch tasks."""
CORRUPTION = 0.4
"""Weight of the backgrounds in goal pictures, the paper's."""
FLOATS = {
    "alpha": "agent.alpha",
    "high_alpha": "agent.high_alpha",
    "low_alpha": "agent.low_alpha",
    "discount": "discount",
}
OF_GOALS = {"actor_p_trajgoal": "actor_future_share", "subgoal_steps": "subgoal_steps"}
"""OGBench's flags as fields of ours."""
NOISE = 0.5
"""Standard deviation of the noise on the actions of the scripted policy."""
MANIPULATED = ("cube", "scene", "puzzle")
"""First words of datasets whose environments need dm_control."""
HALF_CELL = 2.0
PIXELS = 64
"""Along each side of a picture of a goal, as of OGBench's and of the backgrounds."""
PIXELS_PER_UNIT = 4.0
"""A picture shows 16 units, four cells of the maze; OGBench's robot has a radius of 0.7."""
BRIGHTEST, BLUE, WALL, ROBOT = 192.0, 128.0, (153, 153, 153), (179, 128, 77)
"""Colours as in OGBench's visual mazes: red and green of the floor rise to the first along x and y."""
HALF_CUBE = 0.6
"""Six centimetres, as states have lengths."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is trained and evaluated."""

    updates: int
    evaluations: int
    episodes: int = 20
    """Of each task in an evaluation."""
    chunk: int = 500
    """Updates between two looks at the clock, an epoch of ours."""
    timed: int = 1000
    """Updates of a seed whose speed is measured."""
    batch_size: int = 1024
    hidden: tuple[int, ...] = (512, 512, 512)

    def in_words(self) -> str:
        """Batch and layers, where they are not OGBench's."""
        said = [f"batch {self.batch_size}"] if self.batch_size != 1024 else []
        return ", ".join(said + ([f"layers {self.hidden}"] if self.hidden != (512, 512, 512) else []))

    def are_own(self, goals: str) -> bool:
        """Whether a table of these goals, `states` or `images`, has others: with images it says its batch."""
        return self.hidden != Sizes.hidden or (self.batch_size != Sizes.batch_size and goals == "states")


TOY = Sizes(updates=8, evaluations=2, episodes=1, chunk=2, timed=2, batch_size=8, hidden=(16, 16))


@dataclasses.dataclass(frozen=True)
class Job:
    """A program to be run."""

    side: str
    agent: str
    learner: str
    seeds: tuple[int, ...]
    train: bool = True
    """Whether to train and evaluate, or to be timed alone."""

    def key(self) -> tuple:
        """What it is known by in the results."""
        return (self.side, self.agent, self.learner, self.seeds)


# OGBench's environment.


def make_environment(dataset: str, **arguments: Any) -> Any:
    """The environment of a dataset such as `pointmaze-medium-navigate-v0` or `cube-single-play-v0`."""
    os.environ.setdefault("MUJOCO_GL", "disabled")  # States are all that is looked at.
    import gymnasium

    words = dataset.split("-")
    importlib.import_module("ogbench.manipspace" if words[0] in MANIPULATED else "ogbench.locomaze")
    return gymnasium.make("-".join(words[:-2] + words[-1:]), disable_env_checker=True, **arguments)


def directions(free: np.ndarray, goal: tuple[int, int]) -> dict[tuple[int, int], tuple[int, int]]:
    """The next cell on the way to a goal, from each free cell (breadth-first search)."""
    following, front = {goal: goal}, [goal]
    for cell in front:  # It grows.
        for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            other = cell[0] + step[0], cell[1] + step[1]
            if free[other] and other not in following:
                following[other] = cell
                front.append(other)
    return following


class MazeWalk:
    """Goes from cell to cell of a maze, by a breadth-first search, to one goal after the other."""

    def __init__(self, dataset: str):
        self.env = make_environment(dataset)
        self.world = self.env.unwrapped
        self.world._terminate_at_goal = False
        free = self.world.maze_map == 0
        self.cells = [tuple(map(int, cell)) for cell in np.argwhere(free)]
        self.ways = {goal: directions(free, goal) for goal in self.cells}

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode; its first observation."""
        start, self.goal = (self.cells[np.random.randint(len(self.cells))] for _ in range(2))
        options = {"task_info": {"init_ij": start, "goal_ij": self.goal}}
        return self.env.reset(seed=seed, options=options)[0]

    def action(self) -> np.ndarray:
        """Towards the next cell."""
        world, place = self.world, self.world.get_xy()
        cell = world.xy_to_ij(place)
        following = self.ways[self.goal].get(cell, cell)
        aim = np.array(world.cur_goal_xy if cell == self.goal else world.ij_to_xy(following)) - place
        return np.clip(aim / (np.linalg.norm(aim) + 1e-6) + np.random.normal(0.0, NOISE, 2), -1.0, 1.0)

    def step(self, action: np.ndarray) -> np.ndarray:
        """Act; the next observation. A goal that is reached is followed by another."""
        observation, _, _, _, info = self.world.step(action)
        if info["success"]:
            self.goal = self.cells[np.random.randint(len(self.cells))]
            self.world.set_goal(self.goal)
            self.world.cur_goal_xy = np.array(self.world.cur_goal_xy)
        return observation


class CubePlay:
    """Carries cubes from place to place: OGBench's own scripted policy, as its `generate_manipspace.py` runs it."""

    def __init__(self, dataset: str):
        from ogbench.manipspace.oracles.plan.cube_plan import CubePlanOracle

        self.env = make_environment(dataset, terminate_at_goal=False, mode="data_collection")
        self.world, self.stacked = self.env.unwrapped, STACKED[dataset.split("-")[1]]
        self.oracle = CubePlanOracle(env=self.env, noise=0.1, noise_smoothing=0.5)

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode; its first observation."""
        self.share = np.random.uniform(*self.stacked)
        self.seen = self.env.reset(seed=seed)
        self.oracle.reset(*self.seen)
        return self.seen[0]

    def action(self) -> np.ndarray:
        """Along the plan."""
        return np.clip(self.oracle.select_action(*self.seen), -1.0, 1.0)

    def step(self, action: np.ndarray) -> np.ndarray:
        """Act; the next observation. A plan that is over is followed by another."""
        observation, _, _, _, info = self.world.step(action)
        self.seen = observation, info
        if self.oracle.done:
            self.oracle.reset(*self.world.set_new_target(p_stack=self.share))
        return observation


POLICIES = {"pointmaze": MazeWalk, "cube": CubePlay}
"""What collects, by the first word of a dataset's name."""
STACKED = {"single": (0.0, 0.0), "double": (0.0, 0.25), "triple": (0.05, 0.35), "quadruple": (0.1, 0.5)}
"""Between which the probability is drawn, for each episode, that a cube is put onto another."""


def collect(dataset: str, steps: int, seeds: list[int]) -> dict[str, np.ndarray]:
    """An episode of the scripted policy for each seed, of so many observations, in OGBench's layout."""
    policy = POLICIES[dataset.split("-")[0]](dataset)
    found: dict[str, list] = {"observations": [], "actions": [], "terminals": []}
    for seed in seeds:
        np.random.seed(seed)  # OGBench draws from here, too.
        policy.env.action_space.seed(seed)
        observation = policy.reset(seed)
        for step in range(steps):
            action = policy.action()
            found["observations"].append(observation)
            found["actions"].append(action)
            found["terminals"].append(step == steps - 1)
            observation = policy.step(action)
    return {name: np.asarray(values, np.float32) for name, values in found.items()}


def collect_all(path: Path, dataset: str, episodes: int, steps: int) -> None:
    """Write a file of episodes, collected by as many processes as there are cores."""
    shares = [share.tolist() for share in np.array_split(np.arange(episodes), min(os.cpu_count() or 1, episodes))]
    with multiprocessing.get_context("spawn").Pool(len(shares)) as pool:
        parts = pool.starmap(collect, [(dataset, steps, share) for share in shares])
    np.savez_compressed(path, **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


AT_ONCE, AT_ONCE_OF_POINTS = 2, 20
"""Episodes of a task that are stepped side by side: an environment of the cubes takes 170 MB, of the point mazes 2."""


def serve(connection: Any, dataset: str, episodes: list[tuple[int, int]]) -> None:
    """Step environments in a process of their own: "begin" begins all episodes (task, number), of numbers from the one
    given on, "step" steps those that have not ended. An episode begins alike whenever it does."""
    made = [make_environment(dataset) for _ in episodes]
    while True:
        word, given = connection.recv()
        if word == "end":
            return
        if word == "begin":
            ended, reached, seen, goals = np.zeros(len(made), bool), np.zeros(len(made)), [], []
            for env, (task, number) in zip(made, episodes, strict=True):
                seed = 1000 * task + given + number
                np.random.seed(seed)
                env.action_space.seed(seed)
                observation, info = env.reset(seed=seed, options={"task_id": task})
                seen.append(observation)
                goals.append(info["goal"])
            connection.send((np.array(seen, np.float32), np.array(goals, np.float32)))
            continue
        for number, env in enumerate(made):
            if not ended[number]:
                seen[number], _, terminated, truncated, info = env.step(given[number])
                ended[number], reached[number] = terminated or truncated, info["success"]
        connection.send((np.array(seen, np.float32), ended, reached))


class Environments:
    """Episodes of all tasks for several seeds, a few at a time side by side in several processes."""

    def __init__(self, dataset: str, seeds: int, episodes: int, processes: int):
        context = multiprocessing.get_context("spawn")
        tasks = len(make_environment(dataset).unwrapped.task_infos)
        at_once = AT_ONCE_OF_POINTS if dataset.startswith("pointmaze") else AT_ONCE
        self.shape, self.count = (seeds, tasks, min(at_once, episodes)), episodes
        each = [(task, number) for task in range(1, tasks + 1) for number in range(self.shape[2])] * seeds
        self.shares = np.array_split(np.arange(len(each)), min(processes, len(each)))
        self.connections, self.processes = [], []
        for share in self.shares:
            own, other = context.Pipe()
            process = context.Process(
                target=serve, args=(other, dataset, [each[number] for number in share]), daemon=True
            )
            process.start()
            self.connections.append(own)
            self.processes.append(process)

    def run(self, act: Callable[[np.ndarray, Any], np.ndarray], tell: Callable[[np.ndarray, int], Any]) -> np.ndarray:
        """The fraction of episodes that ended in success [S, tasks], by act(observations [E, F], told) -> actions
        [E, A] for episodes of one seed after another. tell: (goals [E, G], number of the first episode) -> what `act`
        is told of them, which stays for the episode."""
        found = [self.run_from(first, act, tell) for first in range(0, self.count, self.shape[2])]
        return np.concatenate(found, -1)[..., : self.count].mean(-1)

    def run_from(
        self, first: int, act: Callable[[np.ndarray, Any], np.ndarray], tell: Callable[[np.ndarray, int], Any]
    ) -> np.ndarray:
        """Which episodes of each task ended in success [S, tasks, N], from this number on."""
        for connection in self.connections:
            connection.send(("begin", first))
        seen, goals = map(np.concatenate, zip(*(connection.recv() for connection in self.connections), strict=True))
        told = tell(goals, first)
        while True:
            actions = np.asarray(act(seen, told))
            for connection, share in zip(self.connections, self.shares, strict=True):
                connection.send(("step", actions[share]))
            answers = [connection.recv() for connection in self.connections]
            seen, ended, reached = map(np.concatenate, zip(*answers, strict=True))
            if ended.all():
                return reached.reshape(self.shape)

    def close(self) -> None:
        """End the processes."""
        for connection in self.connections:
            connection.send(("end", None))
        for process in self.processes:
            process.join()


def wrong_by(noise: float) -> Callable[[np.ndarray, int], np.ndarray]:
    """Tells goals with a normal error of this standard deviation."""

    def tell(goals: np.ndarray, first: int) -> np.ndarray:
        return goals + np.float32(noise) * np.random.default_rng(first).standard_normal(goals.shape, np.float32)

    return tell


# The two sides: each makes a program, which has a function that trains and one that acts.


@dataclasses.dataclass
class Program:
    """A side's agent for some seeds, compiled."""

    advance: Callable[[int], None]
    """Train by so many updates, to their end."""
    act: Callable[[np.ndarray, Any], np.ndarray]
    """Best actions for observations [S * E, F] and goals, or what `show` makes of these, seed after seed."""
    show: Callable[[np.ndarray, int, float], Any] | None = None
    """Of goals [S * E, G] the codes of their pictures, under backgrounds drawn by this number and of this weight."""


def flags_of(impls: Path, dataset: str, agent: str) -> dict[str, float]:
    """What OGBench changes of an agent for a dataset."""
    text = (impls / "hyperparameters.sh").read_text()
    lines = re.findall(rf"--env_name={re.escape(dataset)} .*--agent=agents/{agent}\.py.*", text)
    if len(lines) != 1:
        raise SystemExit(f"--dataset: {dataset}: hyperparameters.sh has {len(lines)} lines for {agent}; give another")
    pairs = re.findall(r"--agent\.(\w+)=(\S+)", lines[0])
    return {name: int(value) if name == "subgoal_steps" else float(value) for name, value in pairs}


def our_task(data: Path, dataset: str, held_out: list[int], image_goals: bool) -> Any:
    """A task to learn offline whose goals are whole states. held_out: tasks; no goal near theirs is learned from.
    image_goals: whether pictures are shown of goals."""
    import jax.numpy as jnp

    from infogoal_jax import envs

    seen = draw_places(dataset) if image_goals else None
    if not held_out:
        return envs.from_recordings(data, seen=seen)
    places, centres, distance = places_of(dataset, held_out)

    def is_near(goal):
        return (jnp.abs(goal[places] - centres) < distance).all(-1).any()

    task = envs.from_recordings(data, held_out=is_near, seen=seen)
    # Without `seen` states are shown from -1 to 1 along each axis.
    return task if image_goals else task.replace(goals=task.goals.replace(seen=None))


def draw_places(dataset: str) -> Callable[[Any], Any]:
    """What draws places in a maze, float32 [..., 2] to pictures uint8 [..., P, P, 3]."""
    import jax.numpy as jnp

    world = make_environment(dataset).unwrapped
    walls = np.asarray(world.maze_map) != 0
    centre, next_centre = (np.array(world.ij_to_xy(cell), np.float32) for cell in ((0, 0), (1, 1)))
    side, size = next_centre - centre, np.array(walls.shape[::-1], np.float32)  # Of a cell; cells along x and y.
    ahead = (np.arange(PIXELS, dtype=np.float32) + 0.5 - PIXELS / 2) / PIXELS_PER_UNIT
    robot = np.hypot(ahead, ahead[:, None]) < 0.7

    def draw(goals):
        x, y = (
            jnp.clip((goals[..., axis, None] + ahead - centre[axis]) / side[axis] + 0.5, 0.0, size[axis] - 1e-3)
            for axis in (0, 1)
        )  # In cells, of each column and of each row of pixels.
        is_wall = jnp.asarray(walls)[y.astype(jnp.int32)[..., :, None], x.astype(jnp.int32)[..., None, :]]
        red, green = BRIGHTEST * x[..., None, :] / size[0], BRIGHTEST * y[..., :, None] / size[1]
        floor = jnp.stack(jnp.broadcast_arrays(red, green, jnp.float32(BLUE)), -1).astype(jnp.uint8)
        picture = jnp.where(is_wall[..., None], jnp.array(WALL, jnp.uint8), floor)
        return jnp.where(robot[..., None], jnp.array(ROBOT, jnp.uint8), picture)

    return draw


def places_of(dataset: str, tasks: list[int]) -> tuple[slice, np.ndarray, float]:
    """Where the goals of these tasks lie: which numbers of a state say where, those numbers [T, 2], and the distance
    along each up to which a goal counts as there."""
    infos = [make_environment(dataset).unwrapped.task_infos[task - 1] for task in tasks]
    if dataset.startswith("cube"):  # The first cube, as `compute_observation` of OGBench's cubes shows it.
        cubes = np.array([info["goal_xyzs"][0, :2] for info in infos], np.float32)
        return slice(19, 21), 10 * (cubes - np.array([0.425, 0.0], np.float32)), HALF_CUBE
    return slice(0, 2), np.array([info["goal_xy"] for info in infos], np.float32), HALF_CELL


def ours(job: Job, words: argparse.Namespace, sizes: Sizes) -> Program:
    """Seeds of one of our agents in one program."""
    import jax
    import jax.numpy as jnp

    from infogoal_jax import compiled, jit, make_train, presets, use_compilation_cache
    from infogoal_jax.data import backgrounds
    from infogoal_jax.goals import corrupt, draw_backgrounds
    from infogoal_jax.hyperparameters import with_values

    use_compilation_cache()
    flags = flags_of(words.impls, words.dataset, job.agent)
    task = our_task(words.data, words.dataset, words.held_out, words.image_goals)
    presets.register("ogbench_recorded", task, presets.OGBENCH)
    method, floats, fields = LEARNERS[job.learner]
    config = presets.load(
        "ogbench_recorded",
        method,
        agent=AGENTS[job.agent],
        updates_per_epoch=sizes.chunk,
        batch_size=sizes.batch_size,
        known_goals="held_out" if words.held_out else "visited",
    )
    goals = {OF_GOALS[name]: value for name, value in flags.items() if name in OF_GOALS}
    floats = floats | {FLOATS[name]: value for name, value in flags.items() if name in FLOATS}
    config = dataclasses.replace(
        config,
        hyper=with_values(config.hyper, floats),
        learner=dataclasses.replace(config.learner, **OF_IMAGES if words.image_goals else fields),
        relabelling=dataclasses.replace(config.relabelling, **goals),
        agent=dataclasses.replace(config.agent, hidden=sizes.hidden),
    )
    train = make_train(config, task)
    keys = jax.vmap(jax.random.key)(jnp.asarray(job.seeds, jnp.uint32))
    state = jit(jax.vmap(train.initial, (0, None, None)))(keys, config.hyper, train.env)
    one = jnp.zeros(1, jnp.int32)
    epochs = jax.vmap(train.epochs, (0, None, None, None))
    advance = compiled(epochs, state, one, config.hyper, train.env, donate_argnums=0)
    held = {"state": state, "epoch": 0}

    def go_on(updates: int) -> None:
        for _ in range(updates // sizes.chunk):
            held["state"], _ = advance(held["state"], one + held["epoch"], config.hyper, train.env)
            held["epoch"] += 1
        jax.block_until_ready(held["state"].params)

    @jit
    def best(params, env, seen, goals, key):
        def of_seed(params, seen, goals):
            return train.policy(params, config.hyper, env)(seen, goals, key)

        return jax.vmap(of_seed)(params, seen, goals)

    def by_seed(each):
        return each.reshape(len(job.seeds), -1, each.shape[-1])

    def act(seen: np.ndarray, told: Any) -> np.ndarray:
        held["acted"] = held.get("acted", 0) + 1
        told = by_seed(told) if isinstance(told, np.ndarray) else told
        key = jax.random.key(held["acted"])
        return np.asarray(best(held["state"].params, train.env, by_seed(seen), told, key)).reshape(len(seen), -1)

    if not words.image_goals:
        return Program(go_on, act)
    behind = jnp.asarray(backgrounds.load().test)

    @jit
    def codes(params, env, behind, goals, key, weight):
        images = env.goals.inputs_of(goals)
        images = corrupt(images, draw_backgrounds(key, behind, goals.shape[:-1]), weight)
        return jax.vmap(lambda params, images: train.parts.learner.encode(params["goal"], images))(params, images)

    def show(goals: np.ndarray, number: int, weight: float) -> Any:
        return codes(held["state"].params, train.env, behind, by_seed(goals), jax.random.key(number), weight)

    return Program(go_on, act, show)


def theirs(job: Job, words: argparse.Namespace, sizes: Sizes) -> Program:
    """One seed of one of OGBench's agents, by its own classes and the loop of its `main.py`."""
    sys.path.insert(0, str(words.impls))
    import jax
    from ogbench.utils import load_dataset

    from infogoal_jax import use_compilation_cache

    use_compilation_cache()
    agents, datasets = importlib.import_module("agents"), importlib.import_module("utils.datasets")
    config = importlib.import_module(f"agents.{job.agent}").get_config()
    layers = dict.fromkeys(("actor_hidden_dims", "value_hidden_dims"), sizes.hidden)
    config.update(flags_of(words.impls, words.dataset, job.agent) | {"batch_size": sizes.batch_size} | layers)
    arrays = load_dataset(str(words.data), compact_dataset=True)
    dataset = getattr(datasets, config["dataset_class"])(datasets.Dataset.create(**arrays), config)
    (seed,) = job.seeds
    random.seed(seed)
    np.random.seed(seed)
    example = dataset.sample(1)
    held = {"agent": agents.agents[job.agent].create(seed, example["observations"], example["actions"], config)}

    def go_on(updates: int) -> None:
        for _ in range(updates):
            batch = dataset.sample(config["batch_size"])
            held["agent"], _ = held["agent"].update(batch)
        jax.block_until_ready(held["agent"].network.params)

    def act(seen: np.ndarray, goals: np.ndarray) -> np.ndarray:
        best = held["agent"].sample_actions(observations=seen, goals=goals, seed=jax.random.PRNGKey(0), temperature=0.0)
        return np.asarray(best)

    start = held["agent"]
    go_on(sizes.chunk if sizes.chunk < 10 else 10)  # It compiles.
    held["agent"] = start
    return Program(go_on, act)


class Meeting:
    """Where programs side by side wait for each other, twice: until all are compiled, and until all are timed. One
    that has ended is not waited for, and none at all once a share of the time is over."""

    def __init__(self, context: Any, count: int):
        self.arrived, self.gates = context.Array("i", 2 * count), (context.Event(), context.Event())
        self.turn, self.count = context.Lock(), count

    def wait(self, number: int, stage: int) -> None:
        """Program of this number: wait for the others."""
        self.arrived[stage * self.count + number] = 1
        self.gates[stage].wait()

    def watch(self, processes: list, patience: float) -> None:
        """Open the gates when it is time, until all processes have ended."""
        latest = time.time() + patience
        while any(process.exitcode is None for process in processes):
            ended = [process.exitcode is not None for process in processes]
            for stage, gate in enumerate(self.gates):
                here = self.arrived[stage * self.count : (stage + 1) * self.count]
                if all(map(max, ended, here)) or time.time() > latest:
                    gate.set()
            time.sleep(0.1)


def run(job: Job, number: int, words: argparse.Namespace, sizes: Sizes, meeting: Meeting, deadline: float) -> None:
    """A process: make the program, be timed alone, train and evaluate, and write what came of it."""
    started = time.perf_counter()
    program = (ours if job.side == "ours" else theirs)(job, words, sizes)
    from infogoal_jax.report.statistics import describe_machine
    from infogoal_paper.ogbench import Outcome, append

    compiling = time.perf_counter() - started

    meeting.wait(number, 0)
    rate = None
    done = 0
    if job.side == "ours" or job.seeds == (0,):
        with meeting.turn:
            program.advance(sizes.chunk)
            started = time.perf_counter()
            program.advance(sizes.timed)
            rate = len(job.seeds) * sizes.timed / (time.perf_counter() - started)
            done = sizes.chunk + sizes.timed  # They are part of training.
            print(f"{' '.join(map(str, job.key()))}: {rate:,.0f} updates/s", file=sys.stderr, flush=True)
    meeting.wait(number, 1)
    outcome = Outcome(
        side=job.side,
        agent=job.agent,
        learner=job.learner,
        seeds=list(job.seeds),
        data=words.about or words.data.name,
        machine=describe_machine(),
        rate=rate,
        compiling=compiling,
        updates=[],
        success=[[] for _ in job.seeds],
        noisy=[[] for _ in job.seeds] if words.goal_noise or words.image_goals else [],
        noise=CORRUPTION if words.image_goals else words.goal_noise,
        held_out=words.held_out,
        dataset=words.dataset,
        goals=goals_of(words),
        sizes=sizes.in_words(),
        own_sizes=sizes.are_own(goals_of(words)),
    )
    tell = {"clean": lambda goals, first: goals, "noisy": wrong_by(words.goal_noise)}
    if program.show is not None:
        weights = {"clean": 0.0, "noisy": CORRUPTION}
        tell = {kind: functools.partial(program.show, weight=weight) for kind, weight in weights.items()}
    if rate is not None:
        append(words.out, outcome)
    if not job.train:
        return
    environments = None
    for mark in [sizes.updates * (place + 1) // sizes.evaluations for place in range(sizes.evaluations)]:
        while done < mark and time.time() < deadline:
            program.advance(min(sizes.chunk, mark - done))
            done += min(sizes.chunk, mark - done)
        if done < mark:
            break
        if environments is None:
            processes = max(1, len(job.seeds) * (os.cpu_count() or 1) // words.programs)
            environments = Environments(words.dataset, len(job.seeds), sizes.episodes, processes)
        reached = environments.run(program.act, tell["clean"])
        outcome.updates.append(done)
        for of_seed, found in zip(outcome.success, reached.tolist(), strict=True):
            of_seed.append(found)
        if outcome.noisy:
            noisy = environments.run(program.act, tell["noisy"])
            for of_seed, found in zip(outcome.noisy, noisy.tolist(), strict=True):
                of_seed.append(found)
        append(words.out, outcome)
        shown = " ".join(f"{value:.2f}" for value in reached.mean(0))
        print(
            f"{' '.join(map(str, job.key()))}: {done:,} updates, {time.perf_counter() - started:.0f} s, "
            f"success {reached.mean():.2f} ({shown})",
            file=sys.stderr,
            flush=True,
        )
    if environments is not None:
        environments.close()


def jobs_of(words: argparse.Namespace) -> Iterator[Job]:
    """What is asked for: ours with all seeds, and with one to be timed; then theirs, a seed each."""
    seeds = tuple(range(words.seeds))
    if "ours" in words.sides:
        for learner in words.learners:
            for agent in words.agents:
                yield Job("ours", agent, learner, seeds)
                if learner == "none" and words.seeds > 1 and "theirs" in words.sides:
                    yield Job("ours", agent, learner, (0,), train=False)
    if "theirs" in words.sides:
        for seed in seeds[: words.their_seeds]:
            for agent in words.agents:
                yield Job("theirs", agent, "none", (seed,))


def goals_of(words: argparse.Namespace) -> str:
    """How goals are shown, as the results call it."""
    return "images" if words.image_goals else "states"


def is_done(job: Job, found: dict[tuple, Any], sizes: Sizes, words: argparse.Namespace) -> bool:
    """Whether the results have all of a program."""
    outcome = found.get((words.dataset, goals_of(words), *job.key(), *words.held_out))
    return outcome is not None and (not job.train or sizes.updates in outcome.updates)


def main() -> None:
    """Do what is asked for and is not there yet."""
    from infogoal_paper.ogbench import in_words, read  # Not by the processes that step environments.

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--collect", type=Path)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--episode-steps", type=int, default=1001)
    parser.add_argument("--dataset", default="pointmaze-medium-navigate-v0")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--impls", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--about", help="what the data is, for the table; left out: the name of its file")
    parser.add_argument("--agents", nargs="+", default=list(AGENTS), choices=list(AGENTS))
    parser.add_argument("--sides", nargs="+", default=["ours", "theirs"], choices=["ours", "theirs"])
    parser.add_argument("--learners", nargs="+", default=["none"], choices=list(LEARNERS))
    parser.add_argument("--held-out", type=int, nargs="+", default=[])
    parser.add_argument("--goal-noise", type=float, default=0.0)
    parser.add_argument("--image-goals", action="store_true")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--their-seeds", type=int, help="of OGBench's side, each a program; as many as ours where none")
    parser.add_argument("--updates", type=int, default=50_000)
    parser.add_argument("--evaluations", type=int, default=3)
    parser.add_argument("--tries", type=int, default=20, help="episodes of each task in an evaluation")
    parser.add_argument("--batch-size", type=int, default=1024)
    parser.add_argument("--hidden", type=int, nargs="+", default=[512, 512, 512])
    parser.add_argument("--side-by-side", type=int, default=1)
    parser.add_argument("--budget", type=float, default=float("inf"))
    parser.add_argument("--toy", action="store_true")
    words = parser.parse_args()
    if words.collect is not None:
        collect_all(words.collect, words.dataset, words.episodes, words.episode_steps)
        return
    missing = [f"--{name}" for name in ("data", "impls", "out") if getattr(words, name) is None]
    if missing:
        parser.error(f"{', '.join(missing)}: give the file of the data, the folder impls of OGBench, and the results")
    if words.image_goals and words.sides != ["ours"]:
        parser.error("--image-goals: OGBench's side sees states; give --sides ours")
    if words.image_goals and not words.dataset.startswith("pointmaze"):
        parser.error(f"--image-goals: there are no pictures of {words.dataset}; give a pointmaze")
    if words.image_goals and words.goal_noise:
        parser.error("--goal-noise: pictures of goals are evaluated under backgrounds; leave it out")
    own = {"episodes": words.tries, "batch_size": words.batch_size, "hidden": tuple(words.hidden)}
    sizes = TOY if words.toy else Sizes(words.updates, words.evaluations, **own)
    deadline = min(time.time() + words.budget, time.time() + 1e7)
    found = read([words.out])
    jobs = [job for job in jobs_of(words) if not is_done(job, found, sizes, words)]
    context = multiprocessing.get_context("spawn")
    for first in range(0, len(jobs), words.side_by_side):
        if time.time() > deadline:
            print("the budget is spent; the same command goes on", file=sys.stderr)
            break
        together = jobs[first : first + words.side_by_side]
        words.programs = len(together)
        meeting = Meeting(context, len(together))
        processes = [
            context.Process(target=run, args=(job, number, words, sizes, meeting, deadline))
            for number, job in enumerate(together)
        ]
        for process in processes:
            process.start()
        meeting.watch(processes, 0.5 * (deadline - time.time()))
    print(in_words(read([words.out]).values()))


if __name__ == "__main__":
    main()
