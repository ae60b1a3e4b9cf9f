"""Seconds until tasks with continuous goals are solved, compiling included: a line of json for every evaluation of
every seed, whose seeds run beside each other in one program.

    python -m benchmarks.speed.positions --task fetch_push_positions --seeds 5
"""

import argparse
import dataclasses
import json
import time

import jax

from infogoal_jax import make_train, presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.hyperparameters import with_values


def config_of(task: str, method: str, agent: str, settings: list[str]) -> TrainConfig:
    """The preset of a task with these settings: FIELD=JSON, whose floats are named as in hyper.discount=0.95."""
    changes = {field: json.loads(value) for field, _, value in (setting.partition("=") for setting in settings)}
    floats = {field: value for field, value in changes.items() if field.startswith("hyper.")}
    config = presets.load(task, method, agent=agent, **{name: changes[name] for name in changes.keys() - floats.keys()})
    hyper = with_values(config.hyper, {name.removeprefix("hyper."): value for name, value in floats.items()})
    return dataclasses.replace(config, hyper=hyper)


def main() -> None:
    """Train the preset of a task, and print what each evaluation says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="fetch_push_positions")
    parser.add_argument("--method", default="none")
    parser.add_argument("--agent", default="td3")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=JSON", help="in place of the preset's")
    arguments = parser.parse_args()
    began = time.perf_counter()
    config = config_of(arguments.task, arguments.method, arguments.agent, arguments.set)

    def tell(epoch: jax.Array, metrics: dict[str, jax.Array]) -> None:
        """Print one evaluation of one seed."""
        success = {
            name: round(float(value), 3) for name, value in metrics.items() if name.endswith("goal/success_rate")
        }
        line = {"seconds": round(time.perf_counter() - began, 1), "epoch": int(epoch), **success}
        print(json.dumps(line | {"env_steps": int(metrics["env_steps"])}), flush=True)

    train = make_train(config, callback=tell)
    print(json.dumps(vars(arguments) | {"device": jax.devices()[0].device_kind, "jax": jax.__version__}), flush=True)
    sweep = jax.jit(lambda keys, env: jax.vmap(lambda key: train(key, None, env).metrics)(keys))
    jax.block_until_ready(sweep(jax.random.split(jax.random.key(0), arguments.seeds), train.env))
    jax.effects_barrier()


if __name__ == "__main__":
    main()
