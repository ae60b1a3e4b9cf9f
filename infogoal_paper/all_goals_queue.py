"""The queue of the trials on all goals at once (docs/research/all_goals.md): what is run by trials.py, and why, in
order of what it would tell."""

from infogoal_paper.trial_queue import (
    CUBE,
    CUBE_TASK,
    DATASETS,
    HOUSE,
    HOUSE_TASK,
    NORMALISED,
    PLAIN,
    PRESET,
    SHELF,
    SHELF_TASK,
    Trial,
    confirmation,
)

HOUSE_GOALS = HOUSE | {"epochs_per_evaluation": 10}


def weighted(words: str, values: dict[str, float], *weights: float) -> dict[str, dict[str, float]]:
    """Settings with these values, which the words name, and these weights of the learner's loss."""
    return {f"{words}learner weight {weight}": values | {"learner_weight": weight} for weight in weights}


FINE = "threshold 0.999, ", {"learner.beta_threshold": 0.999}
"""A code as fine as the cube and the shelf ask for."""
LEARNER_WEIGHTS, SMALLEST_WEIGHT = weighted("", {}, 1.0, 0.1, 0.01), weighted("", {}, 0.001)
"""The loss under all goals is a mean over goals, nearly all of which are far: it is smaller than that of one goal."""
ACHIEVED = {"agent.achieved_share": 1.0, "agent.desired_share": 0.0}
"""All goals of an update on the cube are achieved by the batch."""
DESIRED = {"agent.achieved_share": 0.9, "agent.desired_share": 0.1}
SAMPLED, MEAN = ({"agent.code": code} for code in ("sampled", "mean"))
"""How the head sees codes; a plain encoder has no noise."""
FEW_GOALS = SAMPLED | {"agent.num_goals": 32}
PROTOCOLS = {"": {}, "_held_out": {"known_goals": "held_out"}}
"""Endings of the trials on all goals at once, and what they change: test and validation goals enter once they are
achieved, or never."""


LEARNING = {
    "her": "her",
    "leo": "leo",
    "head": "all_goals",
    "infogoal_head": "infogoal+all_goals",
    "infobot_head": "infobot+all_goals",
}
"""What learns in trials on all goals at once, and the name of the method."""
CARRIES = dict.fromkeys(DATASETS[CUBE_TASK], 7) | {"known_goals": "held_out"}
"""A cube that no choice has seen, where test and validation goals never enter training."""
NO_BETA = {"learner.beta_step": 0.0, "learner.beta_start": 0.0}

QUEUE = {
    # Learning from every transition under all goals at once: LEO, and the head that values a goal through its code.
    **{
        f"house_goals_{short}{ending}": Trial(
            HOUSE_TASK,
            method,
            HOUSE_GOALS | known | PLAIN | (SAMPLED if method.endswith("+all_goals") else {}),
            LEARNER_WEIGHTS if short.startswith("info") else PRESET,
        )
        for ending, known in PROTOCOLS.items()
        for short, method in LEARNING.items()
    },
    # The smaller the weight of their loss, the better the head was: one still smaller. And finer codes.
    "house_goals_infogoal_head_finer": Trial(
        HOUSE_TASK, "infogoal+all_goals", HOUSE_GOALS | PLAIN | SAMPLED, SMALLEST_WEIGHT | weighted(*FINE, 1.0, 0.1)
    ),
    # Is it the noise of codes that keeps learners behind a plain head? With their means in its place:
    **{
        f"house_goals_{short}_mean": Trial(HOUSE_TASK, LEARNING[short], HOUSE_GOALS | PLAIN | MEAN, LEARNER_WEIGHTS)
        for short in ("infogoal_head", "infobot_head")
    },
    # What of it is the head: the head, trained under one hindsight goal a transition.
    "house_goals_her_product": Trial(
        HOUSE_TASK, "her", HOUSE_GOALS | PLAIN | {"agent.head": "product", "agent.bounded": True}
    ),
    # In some seeds nothing was learned, whatever the weight: all values fall at first, and units die. Do normalised
    # layers keep them alive, and do they help HER as well?
    **{
        f"cube_dqn_{short}_norm": Trial(CUBE_TASK, LEARNING[short], CUBE | NORMALISED | goals, settings, agent="dqn")
        for short, goals, settings in (
            ("head", DESIRED, PRESET),
            ("infogoal_head", DESIRED | SAMPLED, LEARNER_WEIGHTS),
            ("infobot_head", DESIRED | SAMPLED, weighted("", {}, 0.1, 0.01, 0.001)),
            ("leo", DESIRED, PRESET),
            ("her", {}, PRESET),
        )
    },
    # The same where fewer goals are known and nothing died, and with the noise of InfoGoal's codes.
    **{
        f"{name}_{short}_norm": Trial(
            task,
            method,
            changes | NORMALISED | (SAMPLED if short.startswith("info") else {}),
            LEARNER_WEIGHTS if short.startswith("info") else PRESET,
        )
        for name, task, changes in (("house_goals", HOUSE_TASK, HOUSE_GOALS), ("shelf_goals", SHELF_TASK, SHELF))
        for short, method in LEARNING.items()
    },
    # The head under HRAC, the task's own agent. A target action for each goal: 32 goals in place of 512. Does a pose
    # that is desired and missed have to be among them?
    **{
        f"cube_hrac_{short}{ending}": Trial(CUBE_TASK, LEARNING[short], CUBE | FEW_GOALS | goals, settings, seeds)
        for short, ending, goals, settings, seeds in (
            ("head", "", PLAIN | DESIRED, PRESET, 3),
            ("infogoal_head", "", PLAIN | DESIRED, LEARNER_WEIGHTS, 2),
            ("infogoal_head", "_achieved", PLAIN | ACHIEVED, LEARNER_WEIGHTS, 2),
            ("infobot_head", "", PLAIN | DESIRED, LEARNER_WEIGHTS, 2),
            ("infogoal_head", "_norm", NORMALISED | DESIRED, LEARNER_WEIGHTS, 3),
        )
    },
    # What was found on dataset 100 has to hold on others, with five seeds and for longer.
    **{
        f"cube_hrac_{dataset}_infogoal_head": Trial(
            CUBE_TASK,
            "infogoal+all_goals",
            confirmation(dataset) | FEW_GOALS | PLAIN | DESIRED,
            weighted("", {}, 0.1),
            seeds=5,
        )
        for dataset in (0, 1, 2)
    },
    # What of InfoGoal carries its gain over the plain head on the held-out cube: compression, the intrinsic reward, or
    # any contrastive or generative code?
    **{
        f"cube_carries_{short}": Trial(CUBE_TASK, method, CARRIES, settings, seeds=5, agent="dqn")
        for short, method, settings in (
            ("infogoal", "infogoal+all_goals", {"preset": {}, "beta 0": NO_BETA}),
            (
                "infogoal_no_reward",
                "infogoal+all_goals",
                {"no reward": {"intrinsic_weight": 0.0}, "beta 0, no reward": NO_BETA | {"intrinsic_weight": 0.0}},
            ),
            ("cogoal", "cogoal+all_goals", weighted("", {}, 1.0, 0.1)),
            ("vae", "vae+all_goals", weighted("", {}, 1.0, 0.1)),
            ("head", "all_goals", PRESET),
        )
    },
}
"""What is run, in order. Settings are looked for on dataset 100 of the cube and the shelf, in house 100: results are
shown on others."""
