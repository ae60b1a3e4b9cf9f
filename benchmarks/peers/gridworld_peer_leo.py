"""LEO on the gridworld of its authors' purejaxgcrl: ours beside theirs, in one run, at equal environment steps and
updates.

    git clone https://github.com/MichaelTMatthews/purejaxgcrl
    pip install gymnax==0.0.9
    python benchmarks/peers/gridworld_peer_leo.py --repository purejaxgcrl [--steps 1e7] [--seeds 5] [--map-size 12]

Their `leo.py` runs as it is, with its own defaults, flat network and sweep's walls. Its imports of wandb and craftax,
which the gridworld does not need, are answered by empty modules. Ours is `--method leo` on a task of one's own
(docs/guides/own_task.md) that is made of their map: the same moves, start, observation (two coordinates), goals (every
free cell), batch, number of environments and updates for each step. What differs: a goal that is reached ends our
episode, and the next one starts at the start; theirs goes on from there. Theirs has a network of four layers of 1,024
and takes targets from the trajectories just collected; ours has `--hidden` and a replay buffer. Both normalise their
layers.

Success is over all goals, from the start, within 200 steps, acting greedily. Seconds are of the second run: compiling
is apart.
"""

import argparse
import ast
import dataclasses
import importlib
import sys
import time
import types
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import compiled, envs, make_train, presets
from infogoal_jax.envs.environment import Environment
from infogoal_jax.goals import GoalSet
from infogoal_jax.registry import Entry
from infogoal_jax.report.statistics import describe_machine, mean_interval

NUM_ENVS, ROLLOUT, BATCH, REUSE = 1024, 32, 512, 2
"""Theirs: environments, steps of each between updates, transitions of an update, and how often each is used."""
EPISODE = 200
TASK = "gridworld"


class Measured(NamedTuple):
    """success: float [seeds, points]; steps: environment steps of a seed at each point; seconds: to run all seeds one
    after the other; compile_seconds."""

    success: np.ndarray
    steps: np.ndarray
    seconds: float
    compile_seconds: float


def authors_module(repository: Path) -> types.ModuleType:
    """Their leo.py."""
    unused = ("wandb", "craftax", "craftax.craftax_env", "craftax.craftax", "craftax.craftax.constants")
    unused += ("craftax.craftax.util", "craftax.craftax.util.game_logic_utils")
    sys.modules |= {name: mock.MagicMock() for name in unused if name not in sys.modules}
    jax.jax = jax  # As their wrappers call it; older versions of JAX had the name.
    sys.path.insert(0, str(repository.resolve()))
    # One of their dataclasses has an array as default, which Python accepts of what can be hashed alone.
    with mock.patch.object(type(jnp.zeros(())), "__hash__", object.__hash__):
        return importlib.import_module("leo")


def authors_settings(module: types.ModuleType, flags: list[str]) -> dict[str, Any]:
    """What their command line makes of these flags: the part of leo.py that parses them, as it stands there."""
    main = ast.parse(Path(module.__file__).read_text()).body[-1]
    assert isinstance(main, ast.If) and isinstance(main.body[-1], ast.Expr)  # Its last line runs LEO.
    scope = dict(vars(module))
    with mock.patch.object(sys, "argv", ["leo.py", *flags]):
        exec(compile(ast.Module(main.body[:-1], type_ignores=[]), module.__file__, "exec"), scope)
    return {name.upper(): value for name, value in vars(scope["args"]).items()}


def run_theirs(module: types.ModuleType, settings: dict[str, Any], seeds: int) -> Measured:
    """Train theirs, one seed after the other."""
    keys = jax.random.split(jax.random.key(0), seeds)
    started = time.perf_counter()
    train = jax.jit(module.make_train(settings)).lower(keys[0]).compile()
    compile_seconds = time.perf_counter() - started
    jax.block_until_ready(train(keys[0]))
    started = time.perf_counter()
    metrics = [jax.block_until_ready(train(key)["metrics"]) for key in keys]
    seconds = time.perf_counter() - started
    success = np.stack([np.asarray(metric["holdout_goal_ratios/all"]) for metric in metrics])
    steps = (1 + np.arange(success.shape[1])) * settings["NUM_STEPS"] * settings["NUM_ENVS"]
    interval = int(settings["NUM_UPDATES"] * settings["TEST_INTERVAL"])
    tested = [point for point in range(success.shape[1]) if (point + 1) % interval == 0]
    return Measured(success[:, tested], steps[tested], seconds, compile_seconds)


@dataclasses.dataclass(frozen=True)
class GridworldConfig:
    """Their gridworld."""

    walls: tuple[tuple[bool, ...], ...] = ()
    """Their map, row by row."""
    episode_length: int = EPISODE

    def check(self, config) -> None:
        """Nothing to validate beyond the types."""


@flax.struct.dataclass
class State:
    """One episode: cell and desired goal are int32, time counts steps."""

    cell: jax.Array
    desired_goal: jax.Array
    time: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    diverged: jax.Array


@flax.struct.dataclass
class Gridworld(Environment):
    """next_cell: int32 [cells, 4]; place: float32 [cells, 2], coordinates in cells; start: the cell where episodes
    start."""

    next_cell: jax.Array
    place: jax.Array
    goals: GoalSet
    start: int = flax.struct.field(pytree_node=False)
    episode_length: int = flax.struct.field(pytree_node=False)
    action_size = 4
    source = "the gridworld of purejaxgcrl"
    num_observations = num_cells = property(lambda self: len(self.place))

    def reset(self, key):
        return self.reset_to(key, jax.random.choice(key, self.goals.training_goals))

    def reset_to(self, key, goal):
        zero, false = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        return State(jnp.full((), self.start), jnp.asarray(goal, jnp.int32), zero, false, false, false)

    def step(self, state, action):
        cell, time = self.next_cell[state.cell, action], state.time + 1
        terminated = cell == state.desired_goal
        truncated = (time >= self.episode_length) & ~terminated
        return state.replace(cell=cell, time=time, terminated=terminated, truncated=truncated)

    def observe(self, state):
        return state.cell

    def achieved(self, state):
        return state.cell

    def reached(self, record, goal):
        return record == goal

    def goals_of(self, record):
        return record[..., None]

    def cell_of(self, record):
        return record

    def render(self, observation):
        return self.place[observation]


def make(config: GridworldConfig) -> Gridworld:
    """The environment: every free cell is a goal that is desired in training."""
    walls = np.array(config.walls)
    places = np.argwhere(~walls)
    number = np.full(walls.shape, -1)
    number[tuple(places.T)] = np.arange(len(places))
    directions = np.array([[0, -1], [0, 1], [-1, 0], [1, 0]])
    reached = np.clip(places[:, None] + directions, 0, len(walls) - 1)
    landed = number[reached[..., 0], reached[..., 1]]
    next_cell = np.where(landed < 0, np.arange(len(places))[:, None], landed)
    scaled = (2 * places / len(walls) - 1).astype(np.float32)
    uses, regions = np.zeros(len(places), int), np.zeros(len(places), int)
    goals = GoalSet.of(scaled, regions, uses, tuple(f"{x}-{y}" for x, y in places), ("map",))
    start = int(number[len(walls) // 2, len(walls) // 2])
    return Gridworld(jnp.asarray(next_cell, jnp.int32), jnp.asarray(scaled), goals, start, config.episode_length)


def run_ours(walls: np.ndarray, total_steps: int, hidden: tuple[int, ...], points: int, seeds: int) -> Measured:
    """Train ours, one seed after the other as theirs."""
    envs.registry[TASK] = Entry(GridworldConfig, make)
    epochs = total_steps // (NUM_ENVS * ROLLOUT)
    presets.registry[TASK] = presets.Preset(
        agent="dqn",
        env={"walls": tuple(map(tuple, walls.tolist()))},
        agents={"dqn": {"hidden": hidden, "num_steps": 1}},
        training={
            "num_envs": NUM_ENVS,
            "rollout_steps": ROLLOUT,
            "batch_size": BATCH,
            "updates_per_epoch": NUM_ENVS * ROLLOUT * REUSE // BATCH,
            "buffer_steps": 500_000,
            "num_epochs": epochs // points * points,
            "epochs_per_evaluation": epochs // points,
            "evaluation_starts": 1,
        },
        state_encoder={"features": hidden[0]},
        hyper={"discount": 0.99, "epsilon": 0.1},
        methods={},
    )
    train = make_train(presets.load(TASK, "leo"))
    keys = jax.random.split(jax.random.key(0), seeds)
    started = time.perf_counter()
    program = compiled(train, keys[0], None, train.env)
    compile_seconds = time.perf_counter() - started
    jax.block_until_ready(program(keys[0], None, train.env).metrics)
    started = time.perf_counter()
    metrics = [jax.block_until_ready(program(key, None, train.env).metrics) for key in keys]
    seconds = time.perf_counter() - started
    success = np.stack([np.ravel(np.asarray(metric["train_goal/success_rate"])) for metric in metrics])
    steps = (1 + np.arange(success.shape[1])) * train.config.epochs_per_evaluation * NUM_ENVS * ROLLOUT
    return Measured(success, steps, seconds, compile_seconds)


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repository", type=Path, required=True)
    parser.add_argument("--steps", type=lambda text: int(float(text)), default=10_000_000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--map-size", type=int, default=12)
    parser.add_argument("--hidden", type=int, nargs="+", default=[512, 512])
    parser.add_argument("--points", type=int, default=10, help="measurements of success on the way")
    parser.add_argument(
        "--theirs", nargs="*", default=[], metavar="FLAG=VALUE", help="further flags of their leo.py, without dashes"
    )
    arguments = parser.parse_args()
    module = authors_module(arguments.repository)
    flags = f"--env_name Gridworld-v1 --network_type symbolic_flat --total_timesteps {arguments.steps} --seed 0"
    flags += f" --gridworld_map_size {arguments.map_size} --gridworld_wall_threshold 0.2 --no_use_wandb"
    flags += f" --test_during_training --test_interval {1 / arguments.points} --test_num_steps {EPISODE}"
    flags += f" --test_num_repeats 1 --num_envs {NUM_ENVS} --num_steps {ROLLOUT} --minibatch_size {BATCH}"
    settings = authors_settings(
        module, [*flags.split(), f"--num_epochs={REUSE}", *(f"--{flag}" for flag in arguments.theirs)]
    )
    world = module.create_env(settings)[2]
    theirs = run_theirs(module, settings, arguments.seeds)
    ours = run_ours(
        np.asarray(world.grid_map, bool), arguments.steps, tuple(arguments.hidden), arguments.points, arguments.seeds
    )
    print(f"{arguments.seeds} seeds, one after the other; {describe_machine()}\n")
    print(
        "| | compile s | environment steps/s | success at the end | environment steps: success |\n|---|---|---|---|---|"
    )
    for name, found in {"purejaxgcrl": theirs, "infogoal-jax": ours}.items():
        curve = ", ".join(
            f"{steps / 1e6:.1f} M: {value:.2f}" for steps, value in zip(found.steps, found.success.mean(0), strict=True)
        )
        rate = arguments.seeds * found.steps[-1] / found.seconds
        end = mean_interval(found.success[:, -1]).show(2)
        print(f"| {name} | {found.compile_seconds:.1f} | {rate:,.0f} | {end} | {curve} |")
    ratio = theirs.seconds / theirs.steps[-1] * ours.steps[-1] / ours.seconds
    print(f"\nOurs makes {ratio:.2f} times their environment steps a second.")


if __name__ == "__main__":
    main()
