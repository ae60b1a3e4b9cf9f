"""Our TD3, SAC and contrastive RL beside JaxGCRL's own programs, on JaxGCRL's environments and on one device: success
against seconds and steps, steps and updates a second.

    pip install --no-deps jaxgcrl
    python benchmarks/peers/jaxgcrl_peer.py --out RESULTS.json [--tasks reacher ant] [--agents td3 sac crl] [--seeds 5]
        [--steps 2000000] [--evaluations 10] [--sides ours theirs ours+infogoal "ours+infogoal, beta 0" ours+vae]
        [--budget 540] [--first-seed 0] [--rounds 10]
    python -m infogoal_paper.jaxgcrl RESULTS.json ...    # the table

RESULTS.json is written after every evaluation. What is in it already is not run again, so that several calls fill one
table. Once the budget, in seconds, is spent no program is begun, and those that run stop at their next evaluation, as
after `--rounds` of them. `--toy` is a size for a CPU, which checks that everything runs.

The environments are JaxGCRL's, with episodes of 1,001 steps. Both sides have batches of 256, an update for every 16
steps, a discount of 0.99 and two hidden layers of 256. JaxGCRL has its own defaults otherwise, with hindsight for TD3
and SAC. Our seeds run side by side in one program; theirs one after the other, as their program is made. The side
ours+infogoal puts InfoGoal's code in place of the goal, the others those of other goal encoders, as `ogbench_peer.py`
sets them. Success is the fraction of episodes in which the goal is reached. For our TD3 and SAC, whose values lie
between 0 and 1, an episode ends there; it goes on for contrastive RL, as for all of theirs. Both are evaluated in 128
episodes, whose starts and goals are drawn anew every time; by its default JaxGCRL's SAC then draws its actions, ours
takes the best.

Seconds are those of training: without compiling, and without evaluations. Of theirs the first round, which compiles, is
counted as long as the median of the others. Programs are kept in the user's cache, so that a later seed of theirs only
reads what the first compiled.
"""

import argparse
import contextlib
import dataclasses
import json
import sys
import time
import types
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from ogbench_peer import LEARNERS

from infogoal_jax import envs, jit, make_train, presets, use_compilation_cache
from infogoal_jax.bridges.brax import brax_training
from infogoal_jax.envs.adapters import JAXGCRL, import_jaxgcrl, jaxgcrl_environment
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.runner.compilation import chunk_of
from infogoal_jax.train.evaluation import evaluate
from infogoal_jax.train.experience import collect_epoch
from infogoal_jax.train.program import Train
from infogoal_jax.train.rollout import restarted
from infogoal_paper.jaxgcrl import Outcome, Parts, load

OURS = presets.JAXGCRL.training
"""Our sizes, which are JaxGCRL's own where it has them."""
SIDES = {"ours" if name == "none" else f"ours+{name}": name for name in LEARNERS}
"""The goal encoder of each side of ours."""
STEPS_PER_UPDATE = OURS["num_envs"] * OURS["rollout_steps"] // OURS["updates_per_epoch"]


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is trained."""

    steps: int
    """Environment steps of a seed, at least."""
    evaluations: int = 10
    rounds: int = 10**9
    """Evaluations after which a program stops, at most."""
    num_envs: int = OURS["num_envs"]
    """Environments of both; ours has longer rows, within which hindsight looks ahead."""
    unroll: int = 62
    """Steps of each before an update, in JaxGCRL's program."""
    episode_length: int = presets.JAXGCRL.env["episode_length"]
    batch_size: int = OURS["batch_size"]
    """Of both. It divides the steps of an episode of all of JaxGCRL's environments, with the last step and without."""
    replay: int = OURS["buffer_steps"] // OURS["num_envs"]
    """Steps that are kept of each environment."""
    prefill: int = 1_000
    """Steps of each before the first update, in JaxGCRL's program."""
    num_eval: int = 128
    """Episodes of an evaluation."""
    our_steps: int = OURS["rollout_steps"]
    """Steps of each environment of ours between updates."""


Keep = Callable[[Outcome], None]
"""Keeps what a program did so far, in place of what it had done before."""

TOY = Sizes(
    steps=400,
    evaluations=2,
    num_envs=4,
    unroll=10,
    episode_length=21,
    batch_size=4,
    replay=80,
    prefill=40,
    num_eval=4,
    our_steps=20,
)


def our_train(task: str, agent: str, side: str, sizes: Sizes) -> tuple[Train, int]:
    """The training function of one of our agents, and its epochs between evaluations."""
    task_env = envs.from_jaxgcrl(task, episode_length=sizes.episode_length, ends_at_goal=agent != "crl")
    name = f"jaxgcrl_{task}"
    presets.register(name, task_env, presets.JAXGCRL)
    collected = sizes.num_envs * sizes.our_steps
    per_evaluation = -(-sizes.steps // (sizes.evaluations * collected))
    method, floats, fields = LEARNERS[SIDES[side]]
    config = presets.load(
        name,
        method,
        agent=agent,
        num_epochs=sizes.evaluations * per_evaluation,
        epochs_per_evaluation=per_evaluation,
        num_envs=sizes.num_envs,
        rollout_steps=sizes.our_steps,
        updates_per_epoch=collected // STEPS_PER_UPDATE,
        batch_size=sizes.batch_size,
        buffer_steps=max(sizes.replay * sizes.num_envs, collected),
    )
    floats = floats | ({"epsilon": 0.1} if agent == "td3" else {})
    learner = dataclasses.replace(config.learner, **fields)
    config = dataclasses.replace(config, hyper=with_values(config.hyper, floats), learner=learner)
    return make_train(config, task_env), per_evaluation


def keys_of(seeds: int) -> jax.Array:
    """The keys of the first seeds."""
    return jax.vmap(jax.random.key)(jnp.arange(seeds, dtype=jnp.uint32))


def evaluated_anew(train: Train, num_eval: int) -> Callable:
    """An evaluation as JaxGCRL's: (state, hyper, env) -> of so many episodes, each with a start and a goal that the
    environment draws together, whether the goal was reached at any time, bool [num_eval]. Another evaluation draws
    others."""

    def evaluation(state, hyper, env):
        key = jax.random.fold_in(state.key, state.env_steps)
        starts = jax.vmap(env.reset)(jax.random.split(key, num_eval))
        goals, starts = starts.desired_goal, jax.tree.map(lambda leaf: leaf[:, None], starts)
        scores = evaluate(train.policy(state.params, hyper, env), env, goals, starts)
        return (scores.first <= env.episode_length)[:, 0]

    return evaluation


def ours(task: str, agent: str, side: str, sizes: Sizes, seeds: int, deadline: float, keep: Keep) -> None:
    """Train so many seeds of one of our agents side by side, compiled as `infogoal train` does, until their end or the
    first evaluation after the deadline, in seconds of `time.perf_counter`."""
    train, per_evaluation = our_train(task, agent, side, sizes)
    config, keys = train.config, keys_of(seeds)

    started = time.perf_counter()
    shared = (config.hyper, train.env)
    initial = jit(jax.vmap(train.initial, (0, None, None)))
    numbers = jnp.arange(config.num_epochs, dtype=jnp.int32).reshape(-1, per_evaluation)
    evaluation = jax.vmap(evaluated_anew(train, sizes.num_eval), (0, None, None))
    chunk = chunk_of(jax.vmap(train.epochs, (0, None, None, None)), evaluation)
    traced = chunk.trace(jax.eval_shape(initial, keys, *shared), numbers[0], *shared)
    with ThreadPoolExecutor() as pool:
        programs = [pool.submit(lambda program: program.lower().compile(), program) for program in traced]
        state = jax.block_until_ready(initial(keys, *shared))
    advance, measure = (program.result() for program in programs)
    compiling = time.perf_counter() - started

    seconds, steps, success = [0.0], [], []
    report(side, task, agent, 0, compiling, float("nan"))
    for epochs in numbers[: sizes.rounds]:
        started = time.perf_counter()
        state, _ = jax.block_until_ready(advance(state, epochs, *shared))
        seconds.append(seconds[-1] + time.perf_counter() - started)
        steps.append(float(state.env_steps.mean()))
        success.append(np.asarray(measure(state, *shared)).mean(1).tolist())
        report(side, task, agent, steps[-1], seconds[-1], np.mean(success[-1]))
        updates = len(steps) * per_evaluation * config.updates_per_epoch
        curves = np.transpose(success).tolist()
        keep(Outcome(task, agent, side, describe_machine(), 0, steps, seconds[1:], curves, seeds, updates, compiling))
        if time.perf_counter() > deadline:
            break


@contextlib.contextmanager
def changed_for_today(env_class: type) -> Iterator[None]:
    """Let JaxGCRL's programs run with today's brax and jax inside this block, on environments of any class of its own.

    brax calls a function that jax has no longer (`brax_training`). The evaluation of its contrastive RL reads measures
    that not every environment has; these are 0 here. Places of the goal are static arguments, which today's jax takes
    of NumPy alone. brax's evaluation has an argument more, the memory of the last one (`with_memory`).
    """
    measures = ("success_easy", "distance_from_origin", "dist")
    own_reset, own_init = env_class.reset, env_class.__init__

    def reset(self, rng):
        state = own_reset(self, rng)
        return state.replace(metrics=dict.fromkeys(measures, jnp.zeros(())) | state.metrics)

    def init(self, *arguments, **named):
        own_init(self, *arguments, **named)
        self.goal_indices = np.asarray(self.goal_indices)

    env_class.reset, env_class.__init__ = reset, init
    programs = [sys.modules[f"jaxgcrl.agents.{name}.{name}"] for name in ("td3", "sac")]
    own_evaluator = programs[0].Evaluator
    for program in programs:
        program.Evaluator = with_memory(own_evaluator)
    try:
        with brax_training(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        env_class.reset, env_class.__init__ = own_reset, own_init
        for program in programs:
            program.Evaluator = own_evaluator


def with_memory(evaluator: type) -> type:
    """JaxGCRL's evaluator, which gives brax 0.14's the state of the last evaluation to write over."""

    class Remembering(evaluator):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            unroll = self._generate_eval_unroll

            def remembering(params, key):
                self._eval_state_to_donate = unroll(self._eval_state_to_donate, params, key)
                return self._eval_state_to_donate

            self._generate_eval_unroll = remembering

    return Remembering


class BudgetSpentError(Exception):
    """Stops JaxGCRL's program at an evaluation."""


def theirs(task: str, agent: str, sizes: Sizes, seed: int, deadline: float, keep: Keep) -> None:
    """Train one seed of one of JaxGCRL's agents by its own program, until its end or the first evaluation after the
    deadline, in seconds of `time.perf_counter`."""
    agents = import_jaxgcrl("jaxgcrl.agents")
    env_class, given = jaxgcrl_environment(task)
    more = {"crl": {"min_replay_size": sizes.prefill}, "td3": {"use_her": True}, "sac": {"use_her": True}}[agent]
    made = getattr(agents, agent.upper())(
        batch_size=sizes.batch_size,
        discounting=0.99,
        unroll_length=sizes.unroll,
        max_replay_size=sizes.replay,
        **({"min_replay_size": sizes.prefill} | more),
    )
    per_round = sizes.num_envs * sizes.unroll
    # Its prefill is counted in steps of each environment, and in whole rounds.
    rounds = -(-sizes.steps // (sizes.evaluations * per_round))
    settings = types.SimpleNamespace(
        env=task,
        total_env_steps=sizes.prefill * sizes.num_envs + sizes.evaluations * rounds * per_round,
        episode_length=sizes.episode_length,
        num_envs=sizes.num_envs,
        num_eval_envs=sizes.num_eval,
        action_repeat=1,
        num_evals=sizes.evaluations + (agent != "crl"),  # The others evaluate before they train, too.
        seed=seed,
        visualization_interval=sizes.evaluations + 1,
        checkpoint_logdir=None,
        max_devices_per_host=1,
    )
    # Every round has as many updates as make an epoch of its replayed episodes, whose last steps have no later goal.
    learned = sizes.num_envs * (sizes.episode_length - (agent == "crl"))
    steps, walls, success = [], [], []

    def heard(num_steps, metrics, *rest, **more):
        if num_steps == 0:
            return
        steps.append(float(num_steps))
        walls.append(float(metrics["training/walltime"]))
        success.append(float(metrics["eval/episode_success_any"]))
        report("theirs", task, agent, steps[-1], walls[-1], success[-1])
        if len(steps) < 2:  # The second round is the first that does not compile.
            return
        seconds = np.median(np.diff(walls)) * np.arange(1, len(walls) + 1)
        updates = len(steps) * rounds * (learned // sizes.batch_size)
        compiling = time.perf_counter() - started - float(seconds[-1])
        machine = describe_machine()
        keep(Outcome(task, agent, "theirs", machine, seed, steps, seconds.tolist(), [success], 1, updates, compiling))
        if time.perf_counter() > deadline or len(steps) >= sizes.rounds:
            raise BudgetSpentError

    started = time.perf_counter()
    with changed_for_today(env_class):
        try:
            made.train_fn(settings, env_class(**given), env_class(**given), progress_fn=heard)
        except BudgetSpentError:
            pass
        except (AssertionError, UnboundLocalError):
            # At the end it counts other steps than it plans by, and returns parameters that it keeps in files alone.
            if len(steps) < sizes.evaluations:
                raise


def parts(task: str, agent: str, sizes: Sizes, seeds: int, epochs: int = 3) -> Parts:
    """Measure what an epoch of ours is made of, over so many epochs of each part."""
    train, _ = our_train(task, agent, "ours", sizes)
    config, env = train.config, train.env
    state = jit(jax.vmap(train.initial, (0, None, None)))(keys_of(seeds), config.hyper, env)

    def step(states, step_key):
        finished = states.terminated | states.truncated
        actions = jax.random.uniform(step_key, (config.num_envs, env.action_size), minval=-1.0, maxval=1.0)
        keys = jax.random.split(step_key, config.num_envs)
        return restarted(env, finished, jax.vmap(env.step)(states, actions), keys), None

    def environments(state, number):
        keys = jax.random.split(jax.random.fold_in(state.key, number), config.rollout_steps)
        return state.replace(env_states=jax.lax.scan(step, state.env_states, keys)[0])

    def collecting(state, number):
        return collect_epoch(train.setup(), state, number)[0]

    def everything(state, number):
        return train.epochs(state, number[None], config.hyper, env)[0]

    def rate(part: Callable, state: Any, steps: int) -> float:
        program = jit(part)
        jax.block_until_ready(program(state, jnp.int32(0)))
        started = time.perf_counter()
        for number in range(1, epochs + 1):
            state = program(state, jnp.int32(number))
        jax.block_until_ready(state)
        return epochs * steps / (time.perf_counter() - started)

    of_epoch = config.num_envs * config.rollout_steps
    return Parts(
        task,
        agent,
        seeds,
        describe_machine(),
        *(rate(jax.vmap(part, (0, None)), state, seeds * of_epoch) for part in (environments, collecting, everything)),
    )


def report(side: str, task: str, agent: str, steps: float, seconds: float, success: float) -> None:
    """Say how far a side is."""
    print(
        f"{side} {task} {agent}: {steps:,.0f} steps, {seconds:.1f} s, success {success:.2f}",
        file=sys.stderr,
        flush=True,
    )


def main() -> None:
    """Run what is asked for and is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", default=["reacher", "ant"], choices=list(JAXGCRL))
    parser.add_argument("--agents", nargs="+", default=["crl", "sac", "td3"], choices=["crl", "sac", "td3"])
    parser.add_argument("--sides", nargs="+", default=["ours", "theirs"], choices=[*SIDES, "theirs"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0, help="of theirs; ours begin with 0")
    parser.add_argument("--rounds", type=int, default=Sizes.rounds, help="evaluations of a program, at most")
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--evaluations", type=int, default=10)
    parser.add_argument("--budget", type=float, default=float("inf"))
    parser.add_argument("--parts", action="store_true")
    parser.add_argument("--toy", action="store_true")
    words = parser.parse_args()
    use_compilation_cache()
    sizes = TOY if words.toy else Sizes(words.steps, words.evaluations)
    sizes = dataclasses.replace(sizes, rounds=words.rounds)
    if words.parts:
        measured = [
            dataclasses.asdict(parts(task, agent, sizes, seeds))
            for task in words.tasks
            for agent in words.agents
            for seeds in sorted({1, words.seeds})
        ]
        words.out.write_text(json.dumps(measured))
        print(words.out.read_text())
        return
    deadline = time.perf_counter() + words.budget
    done = {each.key(): each for each in load([words.out])}

    def keep(outcome: Outcome) -> None:
        """Write what is done, with this."""
        done[outcome.key()] = outcome
        words.out.write_text(json.dumps([dataclasses.asdict(each) for each in done.values()]))

    def runs() -> Iterator[tuple[str, str, str, int]]:
        """Ours first, then a seed of each of theirs, so that what the budget leaves out are seeds."""
        for task in words.tasks:
            for agent in words.agents:
                yield from ((task, agent, side, 0) for side in SIDES if side in words.sides)
        for seed in range(words.first_seed, words.first_seed + (words.seeds if "theirs" in words.sides else 0)):
            for task in words.tasks:
                for agent in words.agents:
                    yield task, agent, "theirs", seed

    for task, agent, side, seed in runs():
        if (task, agent, side, seed) in done:
            continue
        if time.perf_counter() > deadline:
            print("the budget is spent; the same command goes on", file=sys.stderr)
            break
        try:
            if side in SIDES:
                ours(task, agent, side, sizes, words.seeds, deadline, keep)
            else:
                theirs(task, agent, sizes, seed, deadline, keep)
        except UserError as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
