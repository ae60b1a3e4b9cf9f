"""The queue of the trials: what is run by trials.py, and why, in order of what it would tell. all_goals_queue.py has
those on all goals at once."""

from typing import Any, NamedTuple

from infogoal_paper.tuning import DATASETS

PRESET: dict[str, dict[str, float]] = {"preset": {}}
CUBE_TASK, SHELF_TASK, HOUSE_TASK = "object_manipulation", "embodied_qa", "object_search"
REACH, PUSH, PICK_AND_PLACE = "fetch_reach", "fetch_push", "fetch_pick_and_place"


class Trial(NamedTuple):
    """A preset, what is changed in it, and the settings that are trained side by side.

    task: of the preset.
    method: `infogoal`, or with another relabelling `infogoal+her`.
    changes: dotted fields that are changed in the preset.
    settings: names and float hyperparameters of each.
    seeds: of each setting.
    by_name: evaluate embodied question answering with the names of the objects in place of the questions about them.
    agent: another than the task's own.
    """

    task: str
    method: str
    changes: dict[str, Any]
    settings: dict[str, dict[str, float]] = PRESET
    seeds: int = 3
    by_name: bool = False
    agent: str | None = None


PLAIN, NORMALISED = ({"agent.layer_norm": layer_norm} for layer_norm in (False, True))
"""Layers of the agent's values. The first trials had plain ones, also where the preset has normalised ones now."""

CUBE = {
    **DATASETS[CUBE_TASK],
    **PLAIN,
    "env.episode_length": 100,
    "rollout_steps": 100,
    "num_envs": 128,
    "updates_per_epoch": 1000,
    "evaluation_starts": 2,
    "num_epochs": 60,
    "epochs_per_evaluation": 5,
}
"""The cube with episodes long enough for it, and plain layers: 60,000 updates."""

FETCH = {"num_epochs": 200, "epochs_per_evaluation": 20}
"""Fetch with 20,000 updates, on the goals that are shipped: settings are to be compared by their validation goals."""
FETCH_AS_IN_TABLE_1 = FETCH | {"num_epochs": 80}
"""Fetch with 8,000 updates, about the most that a run of Table I has."""

SHELF = DATASETS[SHELF_TASK]

HOUSE = {"num_epochs": 160, "epochs_per_evaluation": 20}
"""Object search in the house of the tuning, with its validation goals: 16,000 updates."""

WINDOW_1, CORRUPTED = {"learner.window": 1}, {"training_corruption": 0.4}
FIRST_OCCURRENCE, BEST_GOAL = ({"relabelling.choice": choice} for choice in ("first_occurrence", "best"))
"""GHRL's choice of goals: the one that presets have, and the original's, which they had before these trials."""
GROUNDED = {"learner.grounded": True}
STANDARDISED = {"learner.standardise_images": True}
THRESHOLDS = {f"threshold {value}": {"learner.beta_threshold": value} for value in (0.96, 0.99, 0.999)}
FINER_THRESHOLDS = {f"threshold {value}": {"learner.beta_threshold": value} for value in (0.98, 0.99, 0.995, 0.998)}
MARGINS = {f"margin {value}": {"learner.beta_margin": value} for value in (0.002, 0.005, 0.02)}
FINEST_MARGIN = {"margin 0.0005": {"learner.beta_margin": 0.0005}}
FINER_MARGINS = FINEST_MARGIN | MARGINS
RELATIVE = {"learner.beta_rule": "relative"}
UNCOMPRESSED = {"no compression": {"learner.beta_step": 0.0, "learner.beta_start": 0.0}}
NO_REWARD = {"no intrinsic reward": {"intrinsic_weight": 0.0, "learner.beta_threshold": 0.99}}
NO_EXPLORER = {"no explorer": {"explorer_weight": 0.0, "bonus_weight": 0.0}}
BONUSES = {f"weight 0.1, bonus {bonus}": {"explorer_weight": 0.1, "bonus_weight": bonus} for bonus in (0.0, 0.01, 0.3)}


FORMER = {"learning_rate": 1e-3, "discount": 0.99, "target_rate": 0.01}
"""Floats that methods with HER had on Push and PickAndPlace before HER was searched."""
FORMER_ON_CUBE = FORMER | {"discount": 0.98}
COARSE = {"learner.beta_threshold": 0.96}
"""The authors' threshold, which InfoGoal had in the first trials of every task."""
HER_SETTINGS = {
    "preset": FORMER,
    "HER's settings": {"learning_rate": 1.167e-3, "discount": 0.9479, "target_rate": 0.03919},
}
"""What the search found for HER on Push and PickAndPlace, beside what was there before."""
SEARCH_TRIAL_9 = {"learning_rate": 1.497e-3, "discount": 0.9605, "target_rate": 7.239e-3}
SEARCH_TRIAL_3 = {"learning_rate": 1.161e-3, "discount": 0.9127, "target_rate": 0.05128}
"""Floats of these numbers of the searches: methods that share a field try the same values of it."""
FOUND_ON_CUBE = {
    "her": SEARCH_TRIAL_9,
    "infogoal+her": SEARCH_TRIAL_9 | {"learner_weight": 9.346, "intrinsic_weight": 7.265},
    "cogoal+her": SEARCH_TRIAL_9 | {"learner_weight": 9.346},
    "gcb+her": {"learning_rate": 3.489e-4, "discount": 0.9813, "target_rate": 7.352e-3, "learner_weight": 0.01187},
    "vae+her": SEARCH_TRIAL_3 | {"learner_weight": 0.143},
    "dgrl+her": SEARCH_TRIAL_3 | {"learner_weight": 0.143},
}
"""Winners of the finals on the cube, after 20,000 updates, that are clear of their presets
(docs/research/tuning.md)."""
FORMER_PRESETS: dict[tuple[str, str], dict[str, float]] = {
    (PICK_AND_PLACE, "her"): FORMER,
    **{(task, "infogoal+her"): FORMER | COARSE for task in (PUSH, PICK_AND_PLACE)},
    (CUBE_TASK, "infogoal+her"): FORMER_ON_CUBE | {"learner_weight": 1.0, "intrinsic_weight": 3.0},
    (CUBE_TASK, "gcb+her"): FORMER_ON_CUBE | {"learner_weight": 0.1},
    **{(CUBE_TASK, f"{learner}+her"): FORMER_ON_CUBE | {"learner_weight": 1.0} for learner in ("vae", "dgrl")},
}
"""What presets had when the trials were made, of tasks and methods for which trials found better: every setting of
theirs has it, unless it says otherwise."""
LEARNER_SHARES = {f"learner weight {weight}": {"learner_weight": weight} for weight in (0.0015, 0.05, 1.0)}


def chosen(settings: dict[str, dict[str, float]], *thresholds: float) -> dict[str, dict[str, float]]:
    """The settings of these thresholds."""
    return {name: values for name, values in settings.items() if values["learner.beta_threshold"] in thresholds}


def each_with(settings: dict[str, dict[str, float]], values: dict[str, float]) -> dict[str, dict[str, float]]:
    """The settings, each with these values where it has none of its own."""
    return {name: values | own for name, own in settings.items()}


def searching(weights: tuple[float, ...], betas: tuple[float, ...]) -> dict[str, dict[str, float]]:
    """Settings of InfoBot: weights of its reward with each of these betas."""
    return {
        f"reward {weight}, beta {beta:.0e}": {"intrinsic_weight": weight, "learner.beta": beta}
        for weight in weights
        for beta in betas
    }


def confirmation(dataset: int) -> dict[str, Any]:
    """The cube with 120,000 updates, on a dataset that results are shown on."""
    return CUBE | dict.fromkeys(DATASETS[CUBE_TASK], dataset) | {"num_epochs": 120, "epochs_per_evaluation": 10}


WORLDS = {
    f"calibration_{degrees}_degrees_{steps}_steps": {"env.joint_range": float(degrees), "env.episode_length": steps}
    for degrees in (45, 60, 90, 180)
    for steps in (100, 300, 1000)
}
"""Cubes from easy to hard: ranges of the joints, and lengths of an episode."""
TRIALS = {
    "cube_her": Trial(CUBE_TASK, "her", CUBE, seeds=4),
    **{
        f"cube_infogoal_her_window_{window}": Trial(
            CUBE_TASK, "infogoal+her", CUBE | {"learner.window": window}, THRESHOLDS | UNCOMPRESSED | NO_REWARD, seeds=2
        )
        for window in (1, 0, 3)
    },
    "cube_infogoal_her_small_subgoals": Trial(
        CUBE_TASK, "infogoal+her", CUBE | WINDOW_1 | {"agent.subgoal_scale": 0.2618}, THRESHOLDS | UNCOMPRESSED, seeds=2
    ),
    # Does it take HER and corrupted training goals together, and InfoGoal? A window of 1 lets a code be compressed.
    **{
        f"{short}_{words}": Trial(task, method, FETCH | changes, settings)
        for short, task in (("pick_and_place", PICK_AND_PLACE), ("reach", REACH))
        for words, method, changes, settings in (
            ("her", "her", {}, PRESET),
            ("her_corruption", "her", CORRUPTED, PRESET),
            ("infogoal", "infogoal", {}, THRESHOLDS),
            ("infogoal_window_1", "infogoal", WINDOW_1, FINER_THRESHOLDS),
            ("infogoal_her", "infogoal+her", {}, THRESHOLDS),
            ("infogoal_her_corruption", "infogoal+her", CORRUPTED, THRESHOLDS),
            ("infogoal_her_window_1", "infogoal+her", WINDOW_1, THRESHOLDS),
        )
    },
    "reach_infogoal_corruption": Trial(REACH, "infogoal", FETCH | CORRUPTED, THRESHOLDS),
    "reach_infogoal_her_window_1_corruption": Trial(REACH, "infogoal+her", FETCH | CORRUPTED | WINDOW_1, THRESHOLDS),
    "reach_infogoal_her_window_1_relative": Trial(REACH, "infogoal+her", FETCH | RELATIVE | WINDOW_1, FINER_MARGINS),
    "reach_infogoal_her_window_1_thresholds": Trial(REACH, "infogoal+her", FETCH | WINDOW_1, FINER_THRESHOLDS),
    # GCB's loss was tuned to 0.0015 of the agent's on Reach, 0.06 of the goal encoder's gradient: does more help?
    "reach_gcb": Trial(REACH, "gcb", FETCH, LEARNER_SHARES),
    "house_gcb": Trial(HOUSE_TASK, "gcb", HOUSE, LEARNER_SHARES),
    # What was found on the cube's dataset 100 with two seeds has to hold on others, with five and for longer.
    **{
        f"cube_{dataset}_{words}": Trial(CUBE_TASK, method, confirmation(dataset) | changes, settings, seeds=5)
        for words, method, changes, settings in (
            ("her", "her", {}, PRESET),
            ("infogoal_her_window_1", "infogoal+her", WINDOW_1, chosen(THRESHOLDS, 0.999)),
        )
        for dataset in (0, 1, 2)
    },
    # The same without HER, as in the paper: is it the code or the relabelling that test poses need?
    "cube_infogoal_window_1": Trial(CUBE_TASK, "infogoal", CUBE | WINDOW_1, THRESHOLDS, seeds=2),
    # Test questions of the shelf: is the loss in the way from a question to its object, or in the policy? Commanding
    # names leaves only the policy.
    "shelf_infogoal": Trial(SHELF_TASK, "infogoal", SHELF, THRESHOLDS | UNCOMPRESSED),
    "shelf_infogoal_by_name": Trial(SHELF_TASK, "infogoal", SHELF, THRESHOLDS | UNCOMPRESSED, by_name=True),
    "shelf_cql": Trial(SHELF_TASK, "none", SHELF),
    "shelf_cql_by_name": Trial(SHELF_TASK, "none", SHELF, by_name=True),
    # What is seen together counts as similar. Does it help where an image shows several objects of a region?
    **{
        f"shelf_{short}_gathered": Trial(SHELF_TASK, method, SHELF | {"env.gathered": True}, settings, seeds=5)
        for short, method, settings in (("infogoal", "infogoal", THRESHOLDS), ("cql", "none", PRESET))
    },
    # A threshold of 0.999 was best on shelf 100: five seeds on the shelves that results are shown on.
    **{
        f"shelf_{dataset}_{name}": Trial(SHELF_TASK, method, {"env.generator_seed": dataset}, settings, seeds=5)
        for dataset in (0, 1, 2)
        for name, method, settings in (
            ("infogoal", "infogoal", chosen(THRESHOLDS, 0.99, 0.999)),
            ("cql", "none", PRESET),
        )
    },
    "reach_preset_infobot_her": Trial(REACH, "infobot+her", {}, seeds=5),
    "reach_preset_gcb_her": Trial(REACH, "gcb+her", {}, seeds=5),
    # The best threshold lies just below the accuracy that can be had without compression: does following that do on
    # every task what a threshold of its own does on each?
    "reach_infogoal_her_relative": Trial(REACH, "infogoal+her", FETCH | RELATIVE, MARGINS),
    "pick_and_place_infogoal_her_relative": Trial(PICK_AND_PLACE, "infogoal+her", FETCH | RELATIVE, FINER_MARGINS),
    "cube_infogoal_her_window_1_relative": Trial(
        CUBE_TASK, "infogoal+her", CUBE | RELATIVE | WINDOW_1, FINER_MARGINS, seeds=2
    ),
    "shelf_infogoal_relative": Trial(SHELF_TASK, "infogoal", SHELF | RELATIVE, MARGINS),
    # On PickAndPlace and the cube the smallest margin is the best one; here it was not among those that ran.
    "reach_infogoal_her_relative_finest": Trial(REACH, "infogoal+her", FETCH | RELATIVE, FINEST_MARGIN),
    "shelf_infogoal_relative_finest": Trial(SHELF_TASK, "infogoal", SHELF | RELATIVE, FINEST_MARGIN),
    # InfoBot's reward is to lead to where decisions are made. Its authors' beta of 0.01 is beside rewards of 10.
    "house_infobot": Trial(HOUSE_TASK, "infobot", HOUSE, searching((0.0, 0.1, 1.0), (3e-5, 1e-3, 1e-2)), seeds=2),
    # The maze of InfoGoal's authors rewards goals first seen in an episode, which does not fade with training.
    "house_infobot_first_seen": Trial(
        HOUSE_TASK, "infobot", HOUSE | {"learner.reward": "first_seen"}, searching((0.1, 1.0, 10.0), (3e-5, 3e-4))
    ),
    # The original GHRL gives an episode the goal that it demonstrates best, InfoGoal's authors any goal that it
    # achieved, at its first occurrence. Which reaches more validation goals?
    **{
        f"{short}_ghrl{words}": Trial(task, "ghrl", base | changes, seeds=seeds)
        for short, task, base, seeds in (
            ("house", HOUSE_TASK, HOUSE, 3),
            ("reach", REACH, FETCH_AS_IN_TABLE_1, 5),
            ("push", PUSH, FETCH_AS_IN_TABLE_1, 5),
            ("pick_and_place", PICK_AND_PLACE, FETCH_AS_IN_TABLE_1, 5),
            ("cube", CUBE_TASK, CUBE | NORMALISED, 5),
        )
        for words, changes in (("_first_occurrence", FIRST_OCCURRENCE), ("", BEST_GOAL))
    },
    # SSE-DB changes nothing with the preset's weights (loss 0.01, bonus 0.05). Does more help, and is it loss or bonus?
    "house_sse_db": Trial(HOUSE_TASK, "sse_db", HOUSE, PRESET | NO_EXPLORER | BONUSES, seeds=2),
    # Under DQN normalised layers lift HER and save seeds of the head (docs/research/all_goals.md). And under HRAC?
    **{
        f"cube_{short}_norm": Trial(CUBE_TASK, method, CUBE | changes | NORMALISED, settings)
        for short, method, changes, settings in (
            ("her", "her", {}, PRESET),
            ("infogoal_her", "infogoal+her", WINDOW_1, chosen(THRESHOLDS, 0.999)),
            ("infogoal", "infogoal", WINDOW_1, chosen(THRESHOLDS, 0.999)),
            ("infobot_her", "infobot+her", {}, PRESET),
        )
    },
    # Searches of learners without HER found nothing better than their presets, on Push and PickAndPlace, but for COGOAL
    # on Push, which has all test goals with HER. Is it the discount and the target rate, which HER's search found too?
    **{
        f"{short}_{learner}_her_settings": Trial(task, f"{learner}+her", FETCH, HER_SETTINGS)
        for short, task in (("push", PUSH), ("pick_and_place", PICK_AND_PLACE))
        for learner in ("infogoal", "infobot", "gcb")
    },
    # GCB has as many goals with either in the end, and with HER's settings long before: where runs of Table I end, at
    # 4,000 to 9,000 updates, they would decide. And for the others, and for InfoGoal with its finer code?
    **{
        f"{short}_{learner}_her_settings": Trial(task, f"{learner}+her", FETCH_AS_IN_TABLE_1, HER_SETTINGS)
        for short, task, learners in (
            ("push", PUSH, ("vae", "dgrl", "rad")),
            ("pick_and_place", PICK_AND_PLACE, ("cogoal", "vae", "dgrl", "rad")),
        )
        for learner in learners
    },
    **{
        f"{short}_infogoal_finer_her_settings": Trial(
            task, "infogoal+her", FETCH_AS_IN_TABLE_1, each_with(HER_SETTINGS, {"learner.beta_threshold": threshold})
        )
        for short, task, threshold in (("push", PUSH, 0.999), ("pick_and_place", PICK_AND_PLACE, 0.99))
    },
    # Is what the searches of the cube found for the start of training better in the end, too?
    **{
        f"cube_{method.replace('+', '_')}_found": Trial(
            CUBE_TASK, method, CUBE | NORMALISED, PRESET | {"found": values}, seeds=5
        )
        for method, values in FOUND_ON_CUBE.items()
    },
    # Is it perception or control that keeps test poses of the cube from being reached? Poses in place of images are the
    # upper end of the former.
    **{
        f"cube_{short}_privileged": Trial(CUBE_TASK, method, CUBE | NORMALISED | {"env.privileged": True}, seeds=5)
        for short, method in (
            ("none", "none"),
            ("infogoal", "infogoal"),
            ("her", "her"),
            ("infogoal_her", "infogoal+her"),
        )
    },
    # GCB's authors subtract phi(g, g), which exists where goals are observations. Does it help on the cube?
    **{
        f"cube_{words}": Trial(CUBE_TASK, method, CUBE | NORMALISED | changes, settings, seeds=5)
        for words, method, changes, settings in (
            ("gcb", "gcb", {}, PRESET),
            ("gcb_grounded", "gcb", GROUNDED, PRESET),
            ("gcb_her_grounded", "gcb+her", GROUNDED, {"found": FOUND_ON_CUBE["gcb+her"]}),
        )
    },
    # Known goals in place of those that were desired, none by hindsight: does the intrinsic reward (Eq. 16) alone
    # explain the paper's 0.92 on the cube? Floats are InfoGoal's own.
    "cube_infogoal_known_goals": Trial(
        CUBE_TASK,
        "infogoal+her",
        CUBE | NORMALISED | {"relabelling.future_share": 0.0, "relabelling.random_share": 0.5},
        PRESET | {"no intrinsic reward": {"intrinsic_weight": 0.0}},
        seeds=5,
    ),
    # Is there a cube on which the bare agent has the paper's 0.40 of the test poses?
    **{
        name: Trial(CUBE_TASK, "none", CUBE | NORMALISED | {"num_epochs": 30} | changes)
        for name, changes in WORLDS.items()
    },
    # With HER InfoGoal was the last of the learners on Push. Was its code too coarse there, as on PickAndPlace?
    **{
        f"push_{short}": Trial(PUSH, method, FETCH, THRESHOLDS)
        for short, method in (("infogoal", "infogoal"), ("infogoal_her", "infogoal+her"))
    },
}
"""The trials, in which settings have what they change of the presets of that time."""
QUEUE = {
    name: trial._replace(settings=each_with(trial.settings, FORMER_PRESETS.get((trial.task, trial.method), {})))
    for name, trial in TRIALS.items()
}
"""What is run, in order. Settings are looked for on dataset 100 of the cube and the shelf, in house 100: results are
shown on others."""
