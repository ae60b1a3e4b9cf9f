"""Object manipulation: an arm turns a cube to the pose of an image."""

import math

from infogoal_jax.config import StateEncoderConfig
from infogoal_jax.presets.preset import INFOBOT, Changes, Preset

SIMILAR = {"window": 3, "num_pairs": 256}
"""Which goals count as similar [M]: what turns in a few steps by less than what lies between test and training
goals."""

PRESET = Preset(
    description="An arm turns a cube to the pose that an image shows; --agent dqn does without subgoals.",
    agent="hrac",  # [P]
    agents={"hrac": {"interval": 3, "subgoal_scale": math.pi / 4, "cell": math.pi / 6}},  # [M]
    relabellings={"all_goals": {"num_goals": 512}},  # [M]
    training={
        "num_envs": 256,
        "rollout_steps": 30,
        "batch_size": 256,
        "buffer_steps": 400_000,
        "num_epochs": 200,
        "epochs_per_evaluation": 20,
        "evaluation_starts": 5,
        "state_encoder": StateEncoderConfig(features=256),
    },
    hyper={"discount": 0.98, "epsilon": 0.3, "intrinsic_weight": 0.0},  # [M]
    methods={
        "infogoal": Changes(learner=SIMILAR, hyper={"intrinsic_weight": 3.0}),  # [M]
        "infobot": Changes(hyper=INFOBOT),
        "cogoal": Changes(learner=SIMILAR),
        "gcb": Changes(hyper={"learner_weight": 0.1}),  # [M]
    },
)
