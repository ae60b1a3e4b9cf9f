"""The queue of the trials on all goals at once (docs/research/all_goals.md): what is run by trials.py, and why, in
order of what it would tell."""

from infogoal_paper.trial_queue import (
    COARSE,
    CORRUPTED,
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
    STANDARDISED,
    Trial,
    confirmation,
    each_with,
)

HOUSE_GOALS = HOUSE | {"epochs_per_evaluation": 10}


def weighted(words: str, values: dict[str, float], *weights: float) -> dict[str, dict[str, float]]:
    """Settings with these values, which the words name, and these weights of the learner's loss."""
    return {f"{words}learner weight {weight}": values | {"learner_weight": weight} for weight in weights}


FINE = "threshold 0.999, ", {"learner.beta_threshold": 0.999}
"""A code as fine as the cube and the shelf ask for."""
LEARNER_WEIGHTS, SMALLEST_WEIGHT = weighted("", {}, 1.0, 0.1, 0.01), weighted("", {}, 0.001)
"""The loss under all goals is a mean over goals, nearly all of which are far: it is smaller than that of one goal."""
CONSERVATIVE = {
    f"conservative weight {weight}": {"agent.conservative_weight": weight, "intrinsic_weight": 0.0}
    for weight in (0.002, 0.02, 0.2)
}
CUBE_HEAD = {
    "preset": {},
    "target rate 0.05": {"target_rate": 0.05},
    "target rate 0.05, discount 0.95": {"target_rate": 0.05, "discount": 0.95},
    "target rate 0.05, learning rate 0.0003": {"target_rate": 0.05, "learning_rate": 3e-4},
}
ACHIEVED, NINE_TENTHS, MIXED = (
    {"agent.achieved_share": share, "agent.desired_share": 0.0} for share in (1.0, 0.9, 0.5)
)
"""How many of an update's 512 goals on the cube the batch achieves. Half was the preset's share at first, then all."""
DESIRED = {"agent.achieved_share": 0.9, "agent.desired_share": 0.1}
SAMPLED, MEAN = {"agent.code": "sampled"}, {"agent.code": "mean"}
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
ALL_GOALS = {
    "house_goals": Trial(HOUSE_TASK, "", HOUSE_GOALS),
    "cube_dqn": Trial(CUBE_TASK, "", CUBE, agent="dqn"),
    "shelf_goals": Trial(SHELF_TASK, "", SHELF),
}
"""Trials on all goals at once, by how their names begin, without a method."""


def all_goals_trials(
    name: str,
    settings: dict[str, dict[str, dict[str, float]]],
    protocols: tuple[str, ...] = tuple(PROTOCOLS),
    goals: dict[str, float] | None = None,
) -> dict[str, Trial]:
    """HER, LEO and the all-goals head with each learner, under these protocols. settings: of each of them, else the
    preset; goals: changes of those that learn from all goals."""
    trial = ALL_GOALS[name]
    return {
        f"{name}_{short}{ending}": trial._replace(
            method=method,
            changes=trial.changes
            | PROTOCOLS[ending]
            | PLAIN
            | ({} if method == "her" else goals or {})
            | (SAMPLED if method.endswith("+all_goals") else {}),
            settings=settings.get(short, PRESET),
        )
        for ending in protocols
        for short, method in LEARNING.items()
    }


CARRIES = dict.fromkeys(DATASETS[CUBE_TASK], 7) | {"known_goals": "held_out"}
"""A cube that no choice has seen, where test and validation goals never enter training."""
NO_BETA = {"learner.beta_step": 0.0, "learner.beta_start": 0.0}

QUEUE = {
    # Learning from every transition under all goals at once: LEO, and the head that values a goal through its code.
    **all_goals_trials("house_goals", dict.fromkeys(("infogoal_head", "infobot_head"), LEARNER_WEIGHTS)),
    **all_goals_trials(
        "cube_dqn",
        {
            "leo": CUBE_HEAD,
            "head": CUBE_HEAD,
            "infogoal_head": weighted("target rate 0.05, ", {"target_rate": 0.05} | COARSE, 1.0, 0.1, 0.01),
            "infobot_head": LEARNER_WEIGHTS | SMALLEST_WEIGHT,
        },
        protocols=("",),  # The study itself has the other one.
        goals=MIXED,
    ),
    # The smaller the weight of their loss, the better the head was: one still smaller. And finer codes.
    "house_goals_infogoal_head_finer": Trial(
        HOUSE_TASK, "infogoal+all_goals", HOUSE_GOALS | PLAIN | SAMPLED, SMALLEST_WEIGHT | weighted(*FINE, 1.0, 0.1)
    ),
    # Is it the noise of codes that keeps learners behind a plain head? With their means in its place:
    **{
        f"{name}_{short}_mean": ALL_GOALS[name]._replace(
            method=LEARNING[short], changes=ALL_GOALS[name].changes | PLAIN | MEAN, settings=LEARNER_WEIGHTS
        )
        for name in ("house_goals", "shelf_goals")
        for short in ("infogoal_head", "infobot_head")
    },
    # What of it is the head: the head, trained under one hindsight goal a transition.
    "house_goals_her_product": Trial(
        HOUSE_TASK, "her", HOUSE_GOALS | PLAIN | {"agent.head": "product", "agent.bounded": True}
    ),
    **{
        f"cube_dqn_{short}_{words}": Trial(
            CUBE_TASK, LEARNING[short], CUBE | PLAIN | changes, settings, seeds, agent="dqn"
        )
        for short, words, changes, settings, seeds in (
            # With the preset's weight of 1 InfoGoal's loss makes all of the goal encoder's gradient on the cube.
            ("infogoal_head", "finer", MIXED | SAMPLED, weighted(*FINE, 1.0, 0.1, 0.01, 0.001, 0.0001), 3),
            ("infogoal_head", "mean", MIXED | MEAN, weighted(*FINE, 1.0, 0.01, 0.0001), 2),
            ("infobot_head", "mean", MIXED | MEAN, weighted("", {}, 0.01, 0.001, 0.0001), 2),
            # HER learns from eight steps at once, the head from one, as they say little under goals that were not
            # desired. Is it that what test poses lack?
            ("head", "steps_8", MIXED | {"agent.num_steps": 8}, PRESET, 3),
            ("head", "steps_3", MIXED | {"agent.num_steps": 3}, PRESET, 3),
            ("her", "steps_1", {"agent.num_steps": 1}, PRESET, 3),
            # Or are there too many goals that no transition of the batch achieves? HER's share of achieved ones is 0.8.
            ("head", "achieved", ACHIEVED, PRESET, 3),
            ("head", "achieved_0.9", NINE_TENTHS, PRESET, 3),
            ("infogoal_head", "achieved", ACHIEVED | MEAN, weighted(*FINE, 1.0, 0.01, 0.0001), 2),
            ("infogoal_head", "achieved_sampled", ACHIEVED | SAMPLED, weighted(*FINE, 1.0, 0.01, 0.0001), 2),
            ("infogoal_head", "achieved_finer", ACHIEVED | SAMPLED, weighted(*FINE, 0.1, 0.03, 0.01, 0.003, 0.001), 2),
            ("infobot_head", "achieved", ACHIEVED | MEAN, weighted("", {}, 0.1, 0.01, 0.001), 2),
            ("infobot_head", "achieved_sampled", ACHIEVED | SAMPLED, weighted("", {}, 0.01, 0.001, 0.0001), 2),
            # Larger weights lose training poses alone: is it that a desired goal that is missed is not learned of?
            ("head", "desired", DESIRED, PRESET, 3),
            ("infogoal_head", "desired", DESIRED | SAMPLED, weighted(*FINE, 0.1, 0.01, 0.001), 2),
            ("infobot_head", "desired", DESIRED | SAMPLED, weighted("", {}, 0.01, 0.001), 2),
            ("leo", "achieved", ACHIEVED, PRESET, 3),
            ("leo", "every_goal", {"agent.num_goals": 0}, PRESET, 3),
            ("her", "corruption", CORRUPTED | STANDARDISED, PRESET, 3),
            ("head", "corruption", ACHIEVED | CORRUPTED | STANDARDISED, PRESET, 3),
            ("infogoal_head", "corruption", ACHIEVED | CORRUPTED | STANDARDISED, weighted("", {}, 1e-2, 1e-3), 3),
        )
    },
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
        f"{name}_{short}_norm": ALL_GOALS[name]._replace(
            method=LEARNING[short],
            changes=ALL_GOALS[name].changes | NORMALISED | (SAMPLED if short.startswith("info") else {}),
            settings=LEARNER_WEIGHTS if short.startswith("info") else PRESET,
        )
        for name in ("house_goals", "shelf_goals")
        for short in LEARNING
    },
    # A test question enters no training of the shelf; what is achieved are names of objects, under both protocols.
    **all_goals_trials(
        "shelf_goals",
        dict.fromkeys(("leo", "head", "infobot_head"), CONSERVATIVE)
        | {"infogoal_head": each_with(CONSERVATIVE, COARSE)},
        protocols=("",),
    ),
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
