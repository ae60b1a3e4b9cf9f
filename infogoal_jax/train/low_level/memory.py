"""What training a low level needs of a device's memory, before anything is compiled: all seeds run side by side."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from infogoal_jax.errors import UserError
from infogoal_jax.train import memory
from infogoal_jax.train.low_level.presets import make_agent, preset
from infogoal_jax.train.low_level.trainer import PretrainConfig, TargetAgent, make_trainer


def check_fits(agent: TargetAgent, num_seeds: int) -> None:
    """Raise `UserError`, naming the field that is to blame, if the seeds need more memory than there is."""
    needed, room = num_seeds * seed_bytes(agent), memory.device_memory(jax.devices()[0])
    if needed <= room:
        return
    config = agent.config
    fields = [
        memory.Larger(
            name, value, usual, lambda name=name, usual=usual: num_seeds * bytes_with_usual(config, name, usual)
        )
        for name, value, usual in memory.larger_fields(config, preset(config.task))
    ]
    if num_seeds > 1:
        fields.insert(0, memory.Larger("seeds", num_seeds, 1, lambda: seed_bytes(agent)))
    needs = f"training the low level needs {needed / memory.GIB:,.1f} GiB at least"
    raise memory.refusal(fields, config.task, room, needs)


def seed_bytes(agent: TargetAgent) -> int:
    """Bytes that a seed needs at least: what is carried, and an epoch's episodes or its updates."""
    trainer, hyper, key = make_trainer(agent), agent.config.hyper, jax.random.key(0)
    state = jax.eval_shape(trainer.initial, key, hyper)
    low_level = jax.eval_shape(trainer.policy, state)
    run = jax.jit(agent.run).trace(low_level, key, jnp.bool(True), hyper)
    rows = jax.eval_shape(agent.run, low_level, key, jnp.bool(True), hyper)[0]
    learn = jax.jit(trainer.learn).trace(state, rows, jnp.int32(0), hyper)
    running = max(memory.peak_bytes(run.jaxpr), memory.bytes_of(rows) + memory.peak_bytes(learn.jaxpr))
    return memory.bytes_of(state) + running


def bytes_with_usual(config: PretrainConfig, name: str, usual: Any) -> float:
    """Bytes that a seed would need with the usual value of a field; none could be more where that makes no program."""
    try:
        return seed_bytes(make_agent(memory.with_field(config, name, usual)))
    except UserError:
        return math.inf
