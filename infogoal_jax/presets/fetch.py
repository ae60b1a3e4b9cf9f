"""The Fetch tasks with goal images: windows and weights [M] tuned on goal set 1, floats on validation goals of goal set
0, by searches [T] (docs/research/tuning.md) and by trials [M] (docs/research/trials.md)."""

from infogoal_jax.presets import plane
from infogoal_jax.presets.preset import INFOBOT, Changes, Preset

TRAINING = {
    "num_envs": 256,
    "rollout_steps": 50,
    "batch_size": 256,
    "buffer_steps": 400_000,
    "num_epochs": 60,
    "epochs_per_evaluation": 20,
    "evaluation_starts": 5,
}
HYPER = {"discount": 0.99, "epsilon": 0.4, "intrinsic_weight": 0.0}  # [M]
MEASURED = {"infogoal": {"intrinsic_weight": 1.0}, "infobot": INFOBOT, "gcb": {"learner_weight": 0.1}}
"""Floats of learners, also where they stand with a relabelling [M]."""


def preset(description: str, window: int, num_pairs: int, training: dict, found: dict[str, dict[str, float]]) -> Preset:
    """The preset of a task.

    description: the task in a line.
    window, num_pairs: of similar goals [M]; the window's steps lead no farther than the 20 cm that lie at most between
    a test goal and the nearest training goal.
    found: floats of each method that a search [T] or a trial [M] found; those of a learner with a relabelling stand in
      place of what was found for the learner.
    """
    similar = {"window": window, "num_pairs": num_pairs}
    learners = {"infogoal": similar, "cogoal": similar}
    return Preset(
        description=description,
        agent="hrac",  # [P]
        env={"goals": "images"},
        learner={"standardise_images": True},  # For corrupted goals (docs/reference/fetch.md).
        relabellings={"ghrl": {"share": 0.8}},
        all_goals={"num_goals": 32},  # Each takes an action of its own, and with it a pass of actor and critics.
        state_encoder={"features": 128},
        training=training,
        hyper=HYPER,
        methods={
            method: Changes(
                learner=learners.get(method, {}),
                hyper=MEASURED.get(method.partition("+")[0], {}) | found.get(method, {}),
            )
            for method in {**learners, **MEASURED, **found}
        },
    )


FOUND_FOR_REACH = {
    "infogoal": {
        "learning_rate": 1.351e-3,
        "discount": 0.9313,
        "target_rate": 0.04286,
        "learner_weight": 5.164,
        "intrinsic_weight": 3.768,
    },
    "infobot": {
        "learning_rate": 7.555e-4,
        "discount": 0.9493,
        "target_rate": 0.01356,
        "intrinsic_weight": 0.4549,
        "learner.beta": 1.064e-6,
    },
    "cogoal": {"learning_rate": 1.165e-3, "discount": 0.93, "target_rate": 0.02287, "learner_weight": 1.817},
    "vae": {"learning_rate": 1.165e-3, "discount": 0.93, "target_rate": 0.02287, "learner_weight": 1.817},
    "dgrl": {"learning_rate": 1.351e-3, "discount": 0.9313, "target_rate": 0.04286, "learner_weight": 5.164},
    "gcb": {"learning_rate": 1.399e-4, "discount": 0.972, "target_rate": 0.00858, "learner_weight": 1.453e-3},
    "rad": {"learning_rate": 2.614e-3, "discount": 0.9654, "target_rate": 0.05371},
    "her": {"learning_rate": 1.859e-4, "discount": 0.9061, "target_rate": 0.07689},
    "cher": {"learning_rate": 1.859e-4, "discount": 0.9061, "target_rate": 0.07689},
    "ghrl": {"learning_rate": 1.165e-3, "discount": 0.93, "target_rate": 0.02287},
    "none": {"learning_rate": 1.399e-4, "discount": 0.972, "target_rate": 0.00858},
}

HER = {"learning_rate": 1.167e-3, "discount": 0.9479, "target_rate": 0.03919}
"""What searches found for HER on Push and on PickAndPlace [T]."""

WITH_HER = dict.fromkeys(("infobot+her", "gcb+her", "vae+her", "dgrl+her", "rad+her"), HER)
"""Learners with HER: most learn faster with its settings on PickAndPlace, and none is slower that could be told [M],
docs/research/trials.md."""

FOUND_FOR_PUSH = {
    **WITH_HER,
    "infogoal+her": HER | {"learner.beta_threshold": 0.999},  # [M]
    "cogoal": {"learning_rate": 3.765e-4, "discount": 0.9508, "target_rate": 0.08725, "learner_weight": 0.07715},
    "her": HER,
    "ghrl": {"learning_rate": 3.765e-4, "discount": 0.9508, "target_rate": 0.08725},
}

FOUND_FOR_PICK_AND_PLACE = {
    **WITH_HER,
    "infogoal+her": HER | {"learner.beta_threshold": 0.99},  # [M]
    "cogoal+her": HER,  # [M]
    "her": HER,
    "cher": HER,
    "ghrl": {"learning_rate": 1.161e-3, "discount": 0.9127, "target_rate": 0.05128},
}

PRESETS = {
    # Sizes for two cores.
    "fetch_reach": preset(
        "A robot arm moves its gripper to where an image shows it.",
        5,
        128,
        TRAINING | {"num_envs": 64, "batch_size": 128, "buffer_steps": 200_000},
        FOUND_FOR_REACH,
    ),
    "fetch_push": preset("A robot arm pushes a cube to where an image shows it.", 3, 128, TRAINING, FOUND_FOR_PUSH),
    "fetch_pick_and_place": preset(
        "A robot arm carries a cube to where an image shows it, in the air too.",
        3,
        256,
        TRAINING,
        FOUND_FOR_PICK_AND_PLACE,
    ),
}


POSITIONS = {
    "num_envs": 1024,
    "rollout_steps": 50,
    "updates_per_epoch": 400,
    "batch_size": 1024,
    "buffer_steps": 2_000_000,
    "num_epochs": 40,
    "epochs_per_evaluation": 4,
    "evaluation_starts": 5,
}
BOUNDED = {"hidden": (256, 256, 256), "layer_norm": True, "bounded": True}
CONTINUOUS = {
    "learning_rate": 1e-3,
    "discount": 0.95,
    "target_rate": 0.05,
    "epsilon": 0.3,
    "noise": 0.2,
    "intrinsic_weight": 0.0,
}
"""Floats of the tasks whose goals are positions, and of target states."""


def preset_of_positions(description: str, training: dict) -> Preset:
    """The preset of a task whose goals are positions, with actions of the gripper as in the reference. On Push TD3 does
    not learn, and SAC late or not at all where HER also gives goals that are reached already [M]."""
    return Preset(
        description=description,
        agent="sac",
        relabelling="her",
        relabellings={"her": {"skip_reached": True}},
        agents={"td3": BOUNDED, "sac": BOUNDED},
        state_encoder={"features": 256},
        training=POSITIONS | training,
        hyper=CONTINUOUS,
        methods={"infogoal": plane.INFOGOAL, "cogoal": Changes(learner=plane.SIMILAR)},
    )


POSITION_PRESETS = {
    "fetch_reach_positions": preset_of_positions(
        "A robot arm moves its gripper to a position, as in Gymnasium-Robotics.",
        {"num_envs": 64, "updates_per_epoch": 100, "batch_size": 256, "buffer_steps": 200_000, "num_epochs": 20},
    ),
    "fetch_push_positions": preset_of_positions(
        "A robot arm pushes a cube to a position, as in Gymnasium-Robotics.", {}
    ),
    "fetch_pick_and_place_positions": preset_of_positions(
        "A robot arm carries a cube to a position, as in Gymnasium-Robotics.", {"num_epochs": 80}
    ),
    "fetch_slide_positions": preset_of_positions(
        "A robot arm hits a puck so that it slides to a position out of reach, as in Gymnasium-Robotics.",
        {"num_epochs": 80},
    ),
}


def preset_of_targets(description: str, training: dict, hidden: tuple[int, ...]) -> Preset:
    """The preset of target states, on which a low level of HRAC is trained by TD3 with hindsight. Rewards are those of
    HER's own code plus 1: 1 for each step at the target."""
    return Preset(
        description=description,
        agent="td3",
        relabelling="her",
        agents={"td3": {"hidden": hidden, "huber": False}},
        state_encoder={"features": 256},
        training={
            "num_envs": 1024,
            "rollout_steps": 50,
            "updates_per_epoch": 1000,
            "batch_size": 2048,
            "buffer_steps": 1_024_000,
            "num_epochs": 60,
            "epochs_per_evaluation": 5,
            "evaluation_starts": 16,
        }
        | training,
        hyper=CONTINUOUS | {"agent.target_noise": 0.1, "agent.action_cost": 1.0},
        methods={},
    )


TARGET_PRESETS = {
    "fetch_reach_targets": preset_of_targets(
        "The low level of HRAC for fetch_reach: a robot arm moves its gripper to target states.",
        {"num_envs": 128, "updates_per_epoch": 200, "batch_size": 256, "buffer_steps": 128_000, "num_epochs": 20},
        (128, 128),
    ),
    "fetch_push_targets": preset_of_targets(
        "The low level of HRAC for fetch_push: a robot arm brings gripper and cube to target states.",
        {},
        (256, 256, 256),
    ),
    "fetch_pick_and_place_targets": preset_of_targets(
        "The low level of HRAC for fetch_pick_and_place: a robot arm brings gripper and cube to target states.",
        {},
        (256, 256, 256),
    ),
}
