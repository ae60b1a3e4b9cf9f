"""Object manipulation: an arm turns a cube to the pose of an image."""

import math

from infogoal_jax.presets.preset import INFOBOT, Changes, Preset

SIMILAR = {"window": 3, "num_pairs": 256}
"""Which goals count as similar [M]: those at most 3 steps apart, so 45 degrees; a test goal may lie 90 degrees from the
nearest training goal."""
FINE_CODE = Changes(learner=SIMILAR | {"window": 1}, hyper={"intrinsic_weight": 3.0, "learner.beta_threshold": 0.999})
"""InfoGoal with a code that is finer than the 10 degrees of success [M], docs/research/trials.md."""
FAST_TARGETS = {"learning_rate": 1.161e-3, "discount": 0.9127, "target_rate": 0.05128, "learner_weight": 0.143}
"""What the search found for VAE and DGRL with HER: a short horizon, and targets that follow fast [T]. Like all that was
found for learners with HER on the cube, under HRAC; under DQN it was not tried."""

PRESET = Preset(
    description="An arm turns a cube to the pose that an image shows; --agent dqn does without subgoals.",
    agent="hrac",  # [P]
    env={"episode_length": 100},  # With 30 every method stays at the floor [M].
    agents={  # [M]; layers are normalised by docs/research/trials.md and, for DQN, docs/research/all_goals.md.
        "hrac": {"interval": 3, "subgoal_scale": math.pi / 4, "cell": math.pi / 6, "layer_norm": True},
        "dqn": {"layer_norm": True},
    },
    all_goals={"num_goals": 512, "achieved_share": 0.9, "desired_share": 0.1},  # [M]
    state_encoder={"features": 256},
    training={
        "num_envs": 128,
        "rollout_steps": 100,
        "updates_per_epoch": 1000,
        "batch_size": 256,
        "buffer_steps": 400_000,
        "num_epochs": 120,
        "epochs_per_evaluation": 10,
        "evaluation_starts": 5,
    },
    hyper={"discount": 0.98, "epsilon": 0.3, "intrinsic_weight": 0.0},  # [M]
    methods={
        "infogoal": FINE_CODE,
        "infogoal+her": Changes(  # [T]
            hyper=FINE_CODE.hyper
            | {
                "learning_rate": 1.497e-3,
                "discount": 0.9605,
                "target_rate": 7.239e-3,
                "learner_weight": 9.346,
                "intrinsic_weight": 7.265,
            }
        ),
        "infobot": Changes(hyper=INFOBOT),
        "infobot+all_goals": Changes(hyper=INFOBOT | {"learner_weight": 0.001}),  # [M]
        "cogoal": Changes(learner=SIMILAR),
        "gcb": Changes(hyper={"learner_weight": 0.1}),  # [M]
        "gcb+her": Changes(  # [T]
            hyper={"learning_rate": 3.489e-4, "discount": 0.9813, "target_rate": 7.352e-3, "learner_weight": 0.01187}
        ),
        "vae+her": Changes(hyper=FAST_TARGETS),  # [T]
        "dgrl+her": Changes(hyper=FAST_TARGETS),  # [T]
    },
)

TARGET_PRESET = Preset(
    description="The low level of HRAC for object_manipulation: an arm turns its joints to target states.",
    agent="dqn",
    relabelling="her",
    agents={"dqn": {"hidden": (128, 128), "num_steps": 1, "huber": False}},
    state_encoder={"features": 128},
    training={
        "num_envs": 128,
        "rollout_steps": 20,
        "updates_per_epoch": 500,
        "batch_size": 512,
        "buffer_steps": 400_000,
        "num_epochs": 30,
        "epochs_per_evaluation": 5,
        "evaluation_starts": 32,
    },
    hyper={"learning_rate": 1e-3, "discount": 0.9, "target_rate": 0.02, "epsilon": 0.5, "intrinsic_weight": 0.0},
    methods={},
)
