"""Write the policy of a run as one file that runs with NumPy alone (`infogoal_jax.policy_file`), and as StableHLO.

The policy is traced once and its operations are written down as they are, so that every learner and every agent can be
exported, those of a user too; of HRAC both levels together.
"""

import enum
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from infogoal_jax import policy_file, presets
from infogoal_jax.agents.agent import Exploration
from infogoal_jax.envs.environment import one_observation
from infogoal_jax.envs.target_states import SubgoalEnv
from infogoal_jax.errors import UserError, reason, require, shown
from infogoal_jax.learners.learner import conditioned
from infogoal_jax.report.runs import Run, diverged_seeds
from infogoal_jax.runs import disk
from infogoal_jax.train.parts import tests_on_means
from infogoal_jax.train.program import Train

WITHIN, DRAWS = 1e-3, 4
"""Of what a file gives and JAX does: how far they differ at most, as a fraction of the largest number where it is
greater than 1, since it is for numbers of any size; and for how many drawn arguments that is looked at."""
CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}
"""Primitives that hold a program of their own, and the name of the setting that it is."""


NUMBERS = {np.dtype(kind).name for kind in np.typecodes["AllInteger"] + np.typecodes["Float"] + "?"}
"""Types that NumPy has by itself: bfloat16 is none."""


def export(run: Run, out: Path, seed: int | None = None, stablehlo: Path | None = None) -> policy_file.ExportedPolicy:
    """Write the greedy policy of a seed of a run, of its first where none is named, and return it as read back.

    Raises `UserError` for a seed that the run does not have or that diverged, or a disk that refuses.
    """
    seed = run.seed_of(seed)
    require(seed not in diverged_seeds(run.folder), "seed", seed, "diverged in training: give another one")
    params = run.params(seed)
    about = {"seed": seed, "data": run.data, "versions": run.versions}
    return export_params(run.train, params, out, about, stablehlo)


def export_params(
    train: Train, params: Any, out: Path, about: dict[str, Any], stablehlo: Path | None = None
) -> policy_file.ExportedPolicy:
    """Write the greedy policy of these parameters, and return it as read back. about: what else the file shall say.

    Of the actions it says: discrete, whether the policy gives their values; moves, whether each is the number of a
    move, also where a low level makes them; action_size, how many there are, or the size of a vector; actions, names.
    Where goals are vectors goal_low and goal_high are their corners, and the policy takes any between these.

    Raises `UserError` for a policy that NumPy does not run as JAX does.
    """
    config, env = train.parts.config, train.env
    function, examples = action_values(train, params) if env.discrete else driving(train, params)
    program, constants = trace(function, examples)
    check_alike(function, examples, program, constants)
    listed = env.goals.finite and env.goals.inputs.dtype == jnp.float32
    acted = env.env if isinstance(env, SubgoalEnv) else env
    about = about | {
        "format_version": policy_file.FORMAT,
        "task": config.task,
        "method": presets.name_of(config),
        "action_size": int(acted.action_size),
        "actions": list(getattr(acted, "action_names", ())),
        "episode_length": int(env.episode_length),
        "code_size": int(examples[2].shape[0]),
        "samples_code": not tests_on_means(train.parts),
        "discrete": bool(env.discrete),
        "moves": bool(acted.discrete),
        "interval": interval_of(env),
        "generator_seed": getattr(config.env, "generator_seed", 0),
        "gathered": getattr(config.env, "gathered", False),
        "goal_names": list(env.goals.names) if listed else [],
        "goal_objects": list(getattr(env, "goal_objects", ())) if listed else [],
    }
    if not env.goals.finite:
        about |= {"goal_low": np.asarray(env.goals.low).tolist(), "goal_high": np.asarray(env.goals.high).tolist()}
    members = {f"constant_{index}": value for index, value in enumerate(constants)}
    members |= {"about": np.array(json.dumps(about)), "program": np.array(json.dumps(program))}
    if listed:
        members["goals"] = np.asarray(env.goals.inputs_of(jnp.arange(env.goals.num_goals)))
    portable = None if stablehlo is None else as_stablehlo(stablehlo, function, examples)
    disk.make_folder(out.parent)
    disk.write_atomically(out, lambda file: np.savez_compressed(file, **members))
    if portable is not None:
        disk.make_folder(stablehlo.parent)
        disk.write_atomically(stablehlo, lambda file: file.write(portable))
    return policy_file.ExportedPolicy(out)


def as_stablehlo(path: Path, function, examples) -> bytes:
    """A function for arguments of these shapes as StableHLO, for every kind of device: `jax.export.deserialize` reads
    it.

    Raises `UserError`, naming the file that it is for, where the library that JAX writes it by is missing.
    """
    exported = jax.export.export(jax.jit(function), platforms=("cpu", "cuda", "tpu"))(*examples)
    try:
        return exported.serialize()
    except ImportError as error:
        raise UserError(
            f"stablehlo = {str(path)!r}: JAX needs flatbuffers to write it: pip install flatbuffers"
        ) from error


def interval_of(env: Any) -> int:
    """Steps between two looks at the goal: those of a high level, or 1."""
    return int(env.interval) if isinstance(env, SubgoalEnv) else 1


def seen_through(train: Train, params: Any):
    """The function (observation, goal, noise [d]) -> (features [1, F], code [1, d]) of these parameters, and its
    arguments' shapes.

    A vector is given as the environment has it, an observation and a goal alike: the program scales it. An image, or a
    text, is given as the network sees it.
    """
    parts, env = train.parts, train.env
    stored = one_observation(env)
    is_vector = isinstance(stored, jax.ShapeDtypeStruct) and stored.dtype == jnp.float32
    render = env.render if is_vector else (lambda observation: observation)
    observation = stored if is_vector else jax.eval_shape(env.render, stored)
    finite = env.goals.finite
    inputs_of = (lambda goal: goal) if finite else env.goals.inputs_of
    value = jax.ShapeDtypeStruct(env.goals.shape, env.goals.dtype)
    goal = jax.eval_shape(env.goals.inputs_of, value) if finite else value

    def encoded(observation, goal):
        features = parts.state_encoder.apply(params["state"], render(observation)[None])
        code = parts.learner.encode(params["goal"], inputs_of(goal)[None])
        return features, conditioned(parts.learner, params["goal"], code, features)

    def see(observation, goal, noise):
        features, found = encoded(observation, goal)
        return features, found.mean if found.std is None else found.mean + found.std * noise

    code = jax.eval_shape(lambda *given: encoded(*given)[1].mean, observation, goal)
    return see, (observation, goal, jax.ShapeDtypeStruct(code.shape[1:], jnp.float32))


def action_values(train: Train, params: Any):
    """The function (observation, goal input, noise [d]) -> float32 [A] of these parameters, and its arguments' shapes.

    The contract of an agent gives the value of the greedy action. That of an action is the value where no other is
    legal.
    """
    (see, examples), parts, count = seen_through(train, params), train.parts, train.env.action_size

    def values(observation, goal, noise):
        features, drawn = (jnp.repeat(one, count, axis=0) for one in see(observation, goal, noise))
        return parts.agent.value(params["agent"], features, drawn, jnp.asarray(np.eye(count, dtype=bool)))

    return values, examples


def driving(train: Train, params: Any):
    """The function (observation, goal input, noise [d], body, target, decides) -> (action, target) of these parameters,
    and its arguments' shapes.

    body: the floats of the stored observation, which tell where the robot is; where these are not one array, the
    observation, which then tells nothing of that. target: the state that the low level is on its way to; decides: bool,
    whether the high level chooses another one. Without levels the target is the action.
    """
    (see, examples), parts, env = seen_through(train, params), train.parts, train.env
    steered = isinstance(env, SubgoalEnv)
    stored = one_observation(env)
    leaves, tree = jax.tree.flatten(stored)
    places = [number for number, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    told = len(places) == 1
    others = [np.zeros(leaf.shape, leaf.dtype) for leaf in leaves]

    def drive(observation, goal, noise, body, target, decides):
        features, code = see(observation, goal, noise)
        whole = jax.tree.unflatten(
            tree, [body if told and number in places else one for number, one in enumerate(others)]
        )
        masks, key = env.action_mask(whole)[None], jax.random.key(0)
        (asked,) = parts.agent.act(params["agent"], features, code, masks, key, Exploration(0.0, 0.0))
        if not steered:
            return env.own_action(asked), asked
        asked = env.space.from_subgoal(whole, asked, env.subgoal_scale)
        target = jnp.where(decides, asked, target)
        return env.low_level.act(whole, target), target

    target = jax.ShapeDtypeStruct((int(env.action_size),), jnp.float32)
    body = leaves[places[0]] if told else examples[0]
    return drive, (*examples, body, target, jax.ShapeDtypeStruct((), jnp.bool_))


def trace(function, examples) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The operations of a function for arguments of these shapes, as `policy_file` runs them, and its constants. It
    returns an array, or several.

    What does not depend on an argument is computed now and becomes a constant. Raises `UserError` for an operation that
    the reader does not know.
    """
    closed = jax.make_jaxpr(function)(*examples)
    steps: list[tuple[str, list[int], list[int], dict]] = []
    fixed: dict[int, Any] = {}
    places: dict[Any, int] = {}
    count = iter(range(10**9))

    def place_of(variable, inside):
        if isinstance(variable, Literal):
            place = next(count)
            fixed[place] = np.asarray(variable.val)
            return place
        return inside[variable]

    def walk(jaxpr, constants, inputs):
        inside = dict(zip(jaxpr.invars, inputs, strict=True))
        for variable, value in zip(jaxpr.constvars, constants, strict=True):
            inside[variable] = next(count)
            fixed[inside[variable]] = value
        for equation in jaxpr.eqns:
            name, given = equation.primitive.name, [place_of(one, inside) for one in equation.invars]
            if name in CALLS:
                called = equation.params[CALLS[name]]
                results = walk(called.jaxpr, called.consts, given)
            elif name == "optimization_barrier":  # For a compiler: what comes out went in.
                results = given
            elif name == "platform_index":  # Of the form that is for any device, as NumPy has it.
                results = [next(count)]
                fixed[results[0]] = equation.params["platforms"].index(None)
            elif name == "cond" and given[0] in fixed:
                chosen = equation.params["branches"][fixed[given[0]]]
                results = walk(chosen.jaxpr, chosen.consts, given[1:])
            else:
                results = [next(count) for _ in equation.outvars]
                if all(place in fixed for place in given):
                    known = equation.primitive.bind(*(fixed[place] for place in given), **equation.params)
                    several = equation.primitive.multiple_results
                    fixed.update(zip(results, known if several else [known], strict=True))
                else:
                    for kind in (str(one.aval.dtype) for one in equation.outvars):
                        require(
                            kind in NUMBERS, "policy", kind, "give float32 numbers: NumPy alone does not have these"
                        )
                    step(name, given, results, equation.params)
            inside |= dict(zip(equation.outvars, results, strict=True))
        return [place_of(one, inside) for one in jaxpr.outvars]

    def step(name, given, results, params):
        require(
            name in policy_file.OPERATIONS,
            "policy",
            name,
            "an operation that policy_file.py does not know; add it to OPERATIONS there",
        )
        settings = {key: plain(value) for key, value in params.items() if plain(value) is not None}
        steps.append((name, given, results, settings))

    arguments = [next(count) for _ in closed.jaxpr.invars]
    outputs = walk(closed.jaxpr, closed.consts, arguments)
    used = sorted({*outputs, *(place for _, given, _, _ in steps for place in given)} & set(fixed))
    order = [*used, *arguments, *(place for _, _, results, _ in steps for place in results)]
    places = {place: index for index, place in enumerate(order)}
    kinds = [[list(one.shape), str(np.dtype(one.dtype))] for one in examples]
    program = {
        "constants": len(used),
        "inputs": [[places[place] for place in arguments], kinds],
        "operations": [
            [name, [places[place] for place in given], [places[place] for place in results], settings]
            for name, given, results, settings in steps
        ],
        "outputs": [places[output] for output in outputs],
    }
    return program, [np.asarray(fixed[place], order="C") for place in used]


def check_alike(function, examples, program: dict[str, Any], constants: list[np.ndarray]) -> None:
    """Raise `UserError` unless a program, as its file has it, gives with NumPy what the function gives with JAX, for
    arguments that are drawn."""
    generator, written = np.random.default_rng(0), json.loads(json.dumps(program))
    names = ", ".join(sorted({operation[0] for operation in written["operations"]}))
    remedy = f"mend in policy_file.py the one of these operations that it runs in another way: {names}"
    in_jax = jax.jit(function)
    for _ in range(DRAWS):
        arguments = [drawn(example, generator) for example in examples]
        with jax.default_matmul_precision("highest"):
            expected = jax.tree.map(np.asarray, jax.tree.leaves(in_jax(*arguments)))
        try:
            with np.errstate(all="ignore"):
                found = policy_file.run_program(written, constants, arguments)
        except Exception as error:
            raise UserError(f"policy: NumPy raised {reason(error)}; {remedy}") from error
        for one, other in zip(map(np.asarray, found), expected, strict=True):
            largest = np.abs(other, where=np.isfinite(other), out=np.zeros_like(other)).max(initial=1)
            near = one.shape == other.shape and np.allclose(one, other, rtol=0, atol=WITHIN * largest, equal_nan=True)
            require(near, "policy", one.tolist(), f"NumPy gives this, and JAX {shown(other.tolist())}; {remedy}")


def drawn(example: jax.ShapeDtypeStruct, generator: np.random.Generator) -> np.ndarray:
    """An array of this shape and type: standard normal numbers, flags, or whole numbers that a byte has."""
    kind = np.dtype(example.dtype).kind
    values = generator.normal(size=example.shape) if kind == "f" else generator.integers(256, size=example.shape)
    return np.asarray(values % 2 if kind == "b" else values, example.dtype)


def plain(value: Any) -> Any:
    """A setting of an operation as JSON has it; None for what only a compiler needs."""
    if isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, np.integer | np.floating):
        return value.item()
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, (tuple, list)):
        inside = [plain(one) for one in value]
        return None if any(one is None for one in inside) else inside
    if isinstance(value, np.dtype) or (isinstance(value, type) and issubclass(value, np.generic)):
        return str(np.dtype(value))
    return None
