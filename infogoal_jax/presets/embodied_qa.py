"""Embodied question answering: a drone learns from recorded flights; goals are texts."""

from infogoal_jax.presets.preset import INFOBOT, Changes, Preset

SIMILAR = {"window": 0, "num_pairs": 128}
"""Which goals count as similar [M]: those that are seen at the same moment."""
SHARES = {"future_share": 0.6, "random_share": 0.2}
"""Goals that the flight sees later, and any known ones: failures, which a recorded flight never shows [M]."""
UNIT_VARIANCE = {"vector_std": 1.0}
"""Of what is reconstructed: text embeddings are scaled to numbers of the order of 1."""

PRESET = Preset(
    description="Offline: a drone learns from recorded flights to find what a question asks about.",
    agent="cql",  # [P]
    relabelling="her",  # [P]
    relabellings={"her": SHARES, "cher": SHARES, "ghrl": {"share": 0.6, "random_share": 0.2}},
    state_encoder={"features": 128},
    training={
        "updates_per_epoch": 500,
        "batch_size": 256,
        "num_epochs": 60,
        "epochs_per_evaluation": 10,
        "evaluation_starts": 5,
    },
    hyper={"discount": 0.95, "intrinsic_weight": 0.0, "agent.conservative_weight": 0.02},  # [M]
    methods={
        "infogoal": Changes(  # [M], the threshold in docs/research/trials.md
            learner=SIMILAR,
            hyper={"intrinsic_weight": 1.0, "agent.conservative_weight": 0.01, "learner.beta_threshold": 0.999},
        ),
        "infobot": Changes(hyper=INFOBOT),
        "cogoal": Changes(learner=SIMILAR),
        "gcb": Changes(  # [T]
            hyper={
                "learning_rate": 1.161e-3,
                "discount": 0.9127,
                "target_rate": 0.05128,
                "learner_weight": 0.143,
                "agent.conservative_weight": 0.02033,
            }
        ),
        "vae": Changes(learner=UNIT_VARIANCE),
        "rad": Changes(  # [T]
            hyper={
                "learning_rate": 3.765e-4,
                "discount": 0.9508,
                "target_rate": 0.08725,
                "agent.conservative_weight": 0.007225,
            }
        ),
        "dgrl": Changes(
            learner=UNIT_VARIANCE,
            hyper={  # [T]
                "learning_rate": 1.548e-3,
                "discount": 0.9839,
                "target_rate": 0.07479,
                "learner_weight": 0.1129,
                "agent.conservative_weight": 0.003694,
            },
        ),
    },
)
