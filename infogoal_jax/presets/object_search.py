"""Object search, tuned on houses of other seeds than those that results are shown on."""

import dataclasses

from infogoal_jax.presets.preset import INFOBOT, MEAN, Changes, Preset

FULL = Preset(
    description="A robot searches a house, image by image, until the object named by the goal is in view.",
    agent="dqn",  # [P]
    # Without the intrinsic reward, success on training goals takes longer to level off [M].
    training={"num_epochs": 160},
    hyper={"learning_rate": 1e-3, "target_rate": 0.05, "discount": 0.98, "intrinsic_weight": 0.0},  # [M]
    methods={
        # [M]
        "infogoal": Changes(hyper={"learning_rate": 5e-4, "intrinsic_weight": 3.0}, training={"num_epochs": 100}),
        "infobot": Changes(hyper=INFOBOT),
        "infogoal+all_goals": Changes(  # [M], docs/research/all_goals.md
            all_goals=MEAN, hyper={"learning_rate": 5e-4, "learner_weight": 0.01}, training={"num_epochs": 100}
        ),
        "infobot+all_goals": Changes(hyper=INFOBOT | {"learner_weight": 0.01}),  # [M]
        # [T]
        "cogoal": Changes(
            hyper={"learning_rate": 1.057e-3, "discount": 0.9866, "target_rate": 0.07083, "learner_weight": 0.2341}
        ),
        "gcb": Changes(hyper={"learner_weight": 0.03}),  # [M]
        "vae": Changes(hyper={"learner_weight": 0.1}),  # [M]
    },
)

AFTER_40_EPOCHS = {  # [T]
    "learning_rate": 1.044e-3,
    "discount": 0.991,
    "target_rate": 0.04305,
    "learner_weight": 0.2062,
    "intrinsic_weight": 1.36,
}
"""InfoGoal's floats with most validation goals after 40 epochs, of 13 in the search among clean choices. Of HER none
was better by a tenth than the preset."""
SMALL = dataclasses.replace(
    FULL,
    training={"num_epochs": 40},
    methods={name: dataclasses.replace(changes, training={}) for name, changes in FULL.methods.items()}
    | {"infogoal": Changes(hyper=AFTER_40_EPOCHS)},
)
PRESET = dataclasses.replace(FULL, small=SMALL)
