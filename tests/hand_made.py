"""What is small enough to check by hand: a search task, the training of a learner that reconstructs goals, and rows of
replay for relabellings in hindsight. The task is four rooms, each a corridor of three places, around one crossing;
four headings a place.

  room 1          place 0 is the crossing; room r has places 1 + 3 r, 2 + 3 r, 3 + 3 r from the crossing outwards.
    |             Heading h looks along room h. Each room has two objects, one desired in training and one in the
    test; both are in view
2 --+-- 0         from the two outer places while looking outwards.
    |
  room 3
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax

from infogoal_jax import networks, pairs, presets, replay
from infogoal_jax.config import TrainConfig
from infogoal_jax.data.active_vision import ACTIONS, SearchScenes
from infogoal_jax.data.splits import make_split
from infogoal_jax.envs.object_search import ObjectSearch, ObjectSearchConfig, from_data
from infogoal_jax.hyperparameters import NoHyperparameters
from infogoal_jax.learners.learner import InputSpec, LearnerBatch, NewSteps, Visited
from infogoal_jax.relabelling.relabelling import Achievements, Context
from infogoal_jax.replay import Trajectories
from infogoal_jax.runner import training
from infogoal_jax.train.evaluation import Scores, evaluate, random_policy
from infogoal_jax.train.experience import Experience
from infogoal_jax.train.program import Train

ROOMS, DEPTH = 4, 3
SPLIT = make_split({f"{use}_{room}": (f"room {room}", use) for use in ("train", "test") for room in range(ROOMS)})


def place_ahead(place: int, heading: int) -> int:
    """The place one step along a heading, or the same place where the way is closed."""
    if place == 0:
        return 1 + DEPTH * heading
    room, depth = divmod(place - 1, DEPTH)
    if heading == room:
        return place + 1 if depth + 1 < DEPTH else place
    if heading == (room + 2) % 4:
        return place - 1 if depth else 0
    return place


def scenes(image_size: int = 8) -> SearchScenes:
    """The four rooms as scenes; state 4 * place + heading; each image random but fixed."""
    places = 1 + ROOMS * DEPTH
    turn = {"forward": 0, "left": 1, "backward": 2, "right": 3}
    next_state = np.zeros((4 * places, len(ACTIONS)), np.int32)
    visible = np.zeros((4 * places, 2 * ROOMS), bool)
    for place in range(places):
        for heading in range(4):
            state = 4 * place + heading
            for column, action in enumerate(ACTIONS):
                if action in turn:
                    next_state[state, column] = 4 * place_ahead(place, (heading + turn[action]) % 4) + heading
                else:
                    next_state[state, column] = 4 * place + (heading + (1 if action == "rotate_ccw" else -1)) % 4
            room, depth = divmod(place - 1, DEPTH)
            if place and depth >= 1 and heading == room:
                visible[state, [room, ROOMS + room]] = True
    images = np.random.default_rng(0).integers(0, 256, (4 * places, image_size, image_size), dtype=np.uint8)
    position = np.zeros((4 * places, 3), np.float32)
    scene = np.zeros(4 * places, np.int32)
    return SearchScenes(images, next_state, visible, position, scene, "hand-made graph")


def environment(episode_length: int = 20, memory: bool = False, position: np.ndarray | None = None) -> ObjectSearch:
    """The hand-made task; a goal's input is a random but fixed unit vector of 16 numbers."""
    inputs = np.random.default_rng(1).normal(size=(2 * ROOMS, 16)).astype(np.float32)
    seen = scenes() if position is None else dataclasses.replace(scenes(), position=position)
    return from_data(seen, SPLIT, inputs / np.linalg.norm(inputs, axis=1, keepdims=True), episode_length, memory)


def environment_from_above(**changes) -> ObjectSearch:
    """The hand-made task with its plan: a cross of places 0.6 m apart, room r at r quarter turns."""
    position = np.zeros((4 * (1 + ROOMS * DEPTH), 3), np.float32)
    for state in range(len(position)):
        place, heading = divmod(state, 4)
        room, depth = divmod(place - 1, DEPTH)
        distance, angle = (0.6 * (depth + 1) if place else 0.0), room * math.pi / 2
        position[state] = distance * math.cos(angle), distance * math.sin(angle), heading * math.pi / 2
    return environment(position=position, **changes)


def config(method: str = "infogoal", **changes) -> TrainConfig:
    """A configuration that trains on the hand-made task in seconds."""
    small = {
        "env": ObjectSearchConfig(episode_length=20, image_size=8),
        "num_epochs": 4,
        "epochs_per_evaluation": 2,
        "num_envs": 8,
        "rollout_steps": 40,
        "updates_per_epoch": 10,
        "batch_size": 32,
        "buffer_steps": 2000,
        "evaluation_starts": 3,
    }
    return presets.load("object_search", method, **(small | changes))


def sizes(**changes) -> dict:
    """The fields of `TrainConfig` that make a preset this small, parts and floats apart: for a script that loads its
    preset itself."""
    small = config(**changes)
    own = (*presets.REGISTRIES, "task", "hyper")
    return {field.name: getattr(small, field.name) for field in dataclasses.fields(small) if field.name not in own}


def initial(part, key, *given):
    """What `init` of a learner, an agent or an explorer makes of a key and the rest, by one program: operation by
    operation it is dozens, each of which is compiled."""
    return jax.jit(lambda key: part.init(key, *given))(key)


def example(inputs, features: int = 4, num_cells: int = 3) -> InputSpec:
    """What a learner's networks are made for: these goal inputs, and states of so many features."""
    return InputSpec(jnp.asarray(inputs), jnp.zeros(features), num_cells)


def new_steps(cell, valid) -> NewSteps:
    """Steps of an epoch that led to these cells [R, T]; nothing was achieved."""
    cell = jnp.asarray(cell)
    return NewSteps(jnp.zeros_like(cell), jnp.full((*cell.shape, 1), -1), cell, jnp.asarray(valid))


def visited(desired_goal: int, achieved, mask) -> Visited:
    """One transition towards a goal: achieved [1, n, K] and mask [1, n], all in one cell."""
    return Visited(jnp.asarray([desired_goal]), achieved, jnp.zeros(mask.shape, jnp.int32), mask)


def learner_batch(
    encode, inputs=None, pairs=None, goals=None, desired_goal=None, transitions=None, features=None
) -> LearnerBatch:
    """What a learner's loss may look at, of which a test needs only a part. inputs: [N, ...] of all goals; features:
    [N, F] of the observations that they are."""
    features_of = None if features is None else lambda indices: features[indices]
    return LearnerBatch(encode, lambda indices: inputs[indices], pairs, goals, desired_goal, transitions, features_of)


def untrained(train: Train) -> Train:
    """Training without an update: parameters stay as they begin, and every number of an epoch grows with it. Its
    program compiles in a part of the time."""

    def epochs(state, numbers, hyper, env):
        _, shapes = jax.eval_shape(train.epochs, state, numbers, hyper, env)

        def of(shape):
            growing = 0.5 + 0.1 * numbers.reshape(-1, *(1,) * (len(shape.shape) - 1))
            return jnp.broadcast_to(growing, shape.shape).astype(shape.dtype)

        return state, jax.tree.map(of, shapes)

    return dataclasses.replace(train, epochs=epochs)


def plain(tree):
    """A pytree of numpy arrays, typed keys as their data, so that bits can be compared."""
    is_key = jax.dtypes.prng_key
    return jax.tree.map(
        lambda leaf: np.asarray(jax.random.key_data(leaf) if jax.dtypes.issubdtype(leaf.dtype, is_key) else leaf), tree
    )


def assert_same_bits(first, second) -> None:
    """Of two pytrees."""
    jax.tree.map(np.testing.assert_array_equal, plain(first), plain(second))


def leave_out_updates(patch) -> None:
    """Let what runs while this `MonkeyPatch` holds be `untrained`."""
    make_train = training.make_train
    patch.setattr(training, "make_train", lambda *given: untrained(make_train(*given)))


SMALL = {"hidden": (32, 32), "latent_size": 8, "num_goals": 16}


def begun(learner, inputs):
    """Parameters and state of the learner for these inputs as they begin."""
    return jax.jit(lambda key: learner.init(key, example(inputs), NoHyperparameters()))(jax.random.key(0))


@functools.partial(jax.jit, static_argnums=0)
def loss_of(learner, inputs, params, state, key, goals=None):
    """The learner's loss on goals of these inputs, all of them or those asked for: (loss, (metrics, state))."""
    goals = jnp.arange(len(inputs)) if goals is None else goals
    batch = learner_batch(lambda goals: learner.encode(params, inputs[goals]), inputs=inputs, goals=goals)
    loss, metrics, state = learner.loss(params, state, batch, NoHyperparameters(), key)
    return loss, (metrics, state)


def trained(learner, inputs, updates, params=None, rate=3e-3, part=None):
    """Parameters, state, and metrics {name: [updates]} after updates on goals drawn at random. params: to begin with;
    part: all that changes."""
    start, state = begun(learner, inputs)
    params, optimizer = start if params is None else params, optax.adam(rate)

    def step(carry, key):
        params, state, optimizer_state = carry
        goals = jax.random.randint(key, (learner.sample_spec.num_goals,), 0, len(inputs))
        gradient, (metrics, state) = jax.grad(
            lambda params: loss_of(learner, inputs, params, state, key, goals), has_aux=True
        )(params)
        gradient = {
            name: leaf if part in (None, name) else jax.tree.map(jnp.zeros_like, leaf)
            for name, leaf in gradient.items()
        }
        change, optimizer_state = optimizer.update(gradient, optimizer_state)
        return (optax.apply_updates(params, change), state, optimizer_state), metrics

    carry = params, state, optimizer.init(params)
    (params, state, _), metrics = jax.jit(
        lambda carry: jax.lax.scan(step, carry, jax.random.split(jax.random.key(1), updates))
    )(carry)
    return params, state, metrics


def constant_error(inputs, standardise=False):
    """Mean squared error of the best constant, for each input number."""
    seen = networks.as_encoded(inputs, standardise)
    return ((seen - seen.mean(0)) ** 2).mean()


ROWS, STEPS, GOALS = 6, 12, 9


def rows_of(valid, achieved) -> Trajectories:
    """Rows of these valid transitions [R, T] and goals achieved [R, T + 1, K], padded with -1, which are observed too;
    goal 0 is desired."""
    valid, achieved = jnp.asarray(valid, bool), jnp.asarray(achieved)
    zero, nothing = (jnp.asarray(np.zeros(valid.shape, kind)) for kind in (np.int32, bool))
    return Trajectories(achieved, achieved, zero, zero, valid, nothing, nothing, valid)


def experience(rows: Trajectories, achieved, known, dissimilarity=None, **changes) -> Experience:
    """What updates sample from, of which the steps `achieved` [R, T + 1] achieve a known goal."""
    decisions = replay.running_count(rows.valid & rows.decided)
    fields = {"dissimilarity": dissimilarity, "codes": None} | changes
    return Experience(rows, decisions, achieved, replay.running_count(achieved), known, **fields)


def random_rows(several: int = 1) -> Trajectories:
    """Rows of several episodes, with up to `several` different goals achieved at each step, never goal 0."""
    random = np.random.default_rng(0)
    valid = random.random((ROWS, STEPS)) < 0.85
    goals = 1 + random.random((ROWS, STEPS + 1, GOALS - 1)).argsort(-1)[..., :several]
    return rows_of(valid, np.where(random.random(goals.shape) < 0.6, goals, -1))


def context(rows: Trajectories, num_goals: int = GOALS, known=None, **changes) -> Context:
    """What a relabelling may look at of these rows, all of them written, before the first update."""
    known = pairs.KnownGoals(jnp.ones(num_goals, bool) if known is None else known)
    achieved = Achievements(
        rows.record, replay.running_count((rows.record >= 0).any(-1)), replay.steps_left(rows.valid), known
    )
    plain = {
        "rows": rows,
        "written": jnp.ones(rows.valid.shape[0], bool),
        "achievements": achieved,
        "discount": 0.9,
        "updates": 0,
        "goal_positions": jnp.arange(float(num_goals))[:, None],
        "goal_codes": None,
        "value": lambda observation, goal: jnp.zeros(goal.shape),
        "reached": lambda record, goal: (record == goal[..., None]).any(-1),
    }
    return Context(**(plain | changes))


def episodes(rows: Trajectories) -> list[tuple[int, int, int]]:
    """Row, first and last observation of each episode that has transitions."""
    found = []
    for row, valid in enumerate(np.asarray(rows.valid)):
        first = 0
        for step, going_on in enumerate([*valid, False]):
            if not going_on:
                found += [(row, first, step)] if step > first else []
                first = step + 1
    return found


def later_goals(rows: Trajectories, row: int, step: int) -> set[int]:
    """Goals achieved after this step in its episode."""
    found = set()
    while step < rows.valid.shape[1] and rows.valid[row, step]:
        step += 1
        found |= set(rows.record[row, step].tolist())
    return found - {-1}


def shortest_path_policy(env):
    """A shortest path to the goal, known only to the simulator."""
    return lambda observation, goal, key: (
        env.distance[env.place[goal][:, None], env.next_node[env.node_of(observation)]].argmin(-1).astype(jnp.int32)
    )


def shortest_and_random(env, num_starts: int) -> list[Scores]:
    """How the oracle of `shortest_path_policy` and a random policy do on all test goals, from so many starts each."""
    goals = jnp.flatnonzero(env.goals.test_mask)
    return [
        jax.jit(lambda env, policy=policy: evaluate(policy(env), env, goals, num_starts))(env)
        for policy in (shortest_path_policy, random_policy)
    ]
