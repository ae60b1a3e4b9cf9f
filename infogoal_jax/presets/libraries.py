"""Environments and recordings of other libraries: their own sizes and floats, where they have them, else those of the
tasks in the plane."""

import dataclasses

from infogoal_jax.presets.plane import AGENTS, HYPER, INFOGOAL, SIMILAR, TRAINING, preset
from infogoal_jax.presets.preset import Changes, Preset

AS_THEY_ARE = {
    "state_encoder": {"features": 0},
    "methods": {"none": Changes(learner={"latent_size": 0}), "infogoal": INFOGOAL, "cogoal": Changes(learner=SIMILAR)},
}
"""Fields of a preset: states are seen as they are, and goals where no learner is asked for (`none`)."""

OGBENCH = Preset(
    description="Recorded episodes of OGBench's kind, with its own sizes and floats.",
    agent="gciql",
    relabelling="mixed",
    agents={"qrl": {"goals": "states"}},
    training={
        "num_epochs": 1000,
        "epochs_per_evaluation": 100,
        "updates_per_epoch": 1000,
        "batch_size": 1024,
        "evaluation_starts": 5,
    },
    hyper={
        "learning_rate": 3e-4,
        "discount": 0.99,
        "target_rate": 0.005,
        "max_gradient_norm": 1e9,
        "intrinsic_weight": 0.0,
    },
    **AS_THEY_ARE,
)
"""For a task of one's own with recordings, `register(name, task, OGBENCH)`: every agent of OGBench is its own, but for
the alpha, which OGBench chooses for each dataset (`impls/hyperparameters.sh`)."""


LIVE = {
    "agents": {"td3": AGENTS["td3"] | {"hidden": (256, 256, 256)}, "sac": AGENTS["sac"] | {"hidden": (256, 256, 256)}},
    "relabellings": {"her": {"skip_reached": True}},
    "state_encoder": {"features": 256},
    "training": TRAINING
    | {"num_epochs": 30, "num_envs": 16, "rollout_steps": 50, "epochs_per_evaluation": 5, "evaluation_starts": 1},
    "hyper": HYPER | {"discount": 0.95, "target_rate": 0.05, "epsilon": 0.3},
}
"""Of live environments: sizes and floats of the Fetch tasks, but few steps and many updates, for a step of a live
simulator takes about a millisecond."""


JAXGCRL = Preset(
    description="An environment of JaxGCRL, by its name: --env jaxgcrl:NAME.",
    agent="crl",
    relabelling="her",
    env={"episode_length": 1001, "ends_at_goal": False},
    agents=AGENTS | {"crl": {"layer_norm": False}},
    training={
        "num_envs": 256,
        "rollout_steps": 250,
        "updates_per_epoch": 4000,
        "batch_size": 256,
        "buffer_steps": 2_560_000,
        "num_epochs": 160,
        "epochs_per_evaluation": 8,
        "evaluation_starts": 2,
    },
    hyper={
        "learning_rate": 3e-4,
        "discount": 0.99,
        "target_rate": 0.005,
        "epsilon": 0.0,
        "noise": 0.2,
        "intrinsic_weight": 0.0,
    },
    **AS_THEY_ARE,
)
"""JaxGCRL's batches, layers, replay and discount, and its update for every 16 steps; losses, exploration and hindsight
are ours. `AS_THEY_ARE`, since encoders in front of contrastive RL, which its critic alone trains, keep it from learning
ant: chosen by success on training goals while collecting, 0.16 and 0.05 (three seeds, 9 million steps) [M]. No layer
norm for `crl`, as there: on states as they are it hides how far from the origin they lie, and places of the maze on one
line through it look alike. TD3 and SAC keep theirs, with which SAC learns that maze faster (0.81 and 0.53 of its goals
after a million steps, three seeds) [M]."""


OWN = {"jaxgcrl": JAXGCRL, "ogbench": dataclasses.replace(OGBENCH, description="Recordings: --env ogbench:DATASET.")}


def of_library(task: str) -> Preset:
    """The preset of another library's environments (`envs/named.py`)."""
    if task in OWN:
        return OWN[task]
    words = {"brax": "brax", "playground": "MuJoCo Playground", "gymnasium": "Gymnasium"}
    of_task = preset(f"An environment of {words[task]}, by its name: --env {task}:NAME.", 100)
    return dataclasses.replace(of_task, **LIVE) if task == "gymnasium" else of_task
