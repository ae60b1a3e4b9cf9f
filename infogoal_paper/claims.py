"""The paper's claims, each with the test that decides it; the tests stand in evidence.py (Table I) and in
figure_evidence.py."""

import dataclasses
from collections.abc import Callable

from infogoal_paper.evidence import COMPARABLE, RELABELLINGS, Finding, compare, first_of_task, infobot_paths
from infogoal_paper.figure_evidence import (
    CORRUPTION,
    beta_gain,
    fixed_against_adaptive,
    grouped,
    less_information,
    less_than_infogoal,
    more_efficient,
    near,
    paths_not_shorter,
    reward_near_goal,
)
from infogoal_paper.numbers import Results
from infogoal_paper.paper import IMAGE_TASKS, TASKS
from infogoal_paper.scores import KINDS, TITLES


@dataclasses.dataclass(frozen=True)
class Claim:
    """name: short; says: the claim; where: in the paper; test: what decides it, in words; find: what decides it."""

    name: str
    says: str
    where: str
    test: str
    find: Callable[[Results], Finding]


FIRST = "difference to the other row of which it is least certain"
NOT_FIRST = {("test_goal", "fetch_push"), ("corrupted_test_goal", "fetch_push"), ("test_goal", "embodied_qa")}
"""Where InfoGoal is not first in the paper's own table: InfoBot is on Push, and as good on the shelf."""
ONLINE = TASKS[:-1]
BARE = "difference to the bare agent, mean over tasks but EQA, where it alone does not relabel"
CLAIMS = (
    *(
        Claim(
            f"first-{kind.removesuffix('_goal').replace('_', '-')}-{TITLES[task]}",
            f"InfoGoal reaches more {KINDS[kind]} goals than every other method on {TITLES[task]}",
            "Table I, Sec. V-D",
            FIRST,
            first_of_task(task, kind),
        )
        for kind, tasks in (("test_goal", TASKS), ("corrupted_test_goal", IMAGE_TASKS))
        for task in tasks
        if (kind, task) not in NOT_FIRST
    ),
    Claim(
        "relabelling-helps",
        "HER, CHER and GHRL reach more test goals than the bare agents",
        "Sec. V-D",
        "difference to the bare agent, of each, mean over tasks",
        compare([(method, "none") for method in RELABELLINGS], "test_goal", TASKS),
    ),
    Claim(
        "relabelling-overfits",
        "HER, CHER and GHRL reach far fewer goals when these are corrupted",
        "Sec. V-D",
        f"clean minus corrupted test goals, of each, mean over tasks; above {COMPARABLE}",
        compare(
            [(method, method) for method in RELABELLINGS],
            "test_goal",
            IMAGE_TASKS,
            COMPARABLE,
            other="corrupted_test_goal",
        ),
    ),
    Claim(
        "relabelling-below-infogoal",
        "HER, CHER and GHRL lie below InfoGoal on test goals",
        "Table I",
        "InfoGoal minus each of them, mean over tasks",
        compare([("infogoal", method) for method in RELABELLINGS], "test_goal", TASKS),
    ),
    Claim(
        "reconstruction-corrupted-training",
        "VAE and DGRL reach more corrupted training goals than the bare agent",
        "Sec. V-D",
        "difference to the bare agent, of each, mean over tasks",
        compare([("vae", "none"), ("dgrl", "none")], "corrupted_train_goal", IMAGE_TASKS),
    ),
    Claim(
        "infobot-helps",
        "InfoBot reaches many more test goals than the bare agent",
        "Sec. V-E",
        f"{BARE}; above {COMPARABLE}",
        compare([("infobot", "none")], "test_goal", ONLINE, COMPARABLE),
    ),
    Claim(
        "infobot-paths",
        "InfoBot takes longer paths than InfoGoal",
        "Sec. V-E, Fig. 8",
        "by which share InfoBot's paths to test goals are longer on object search, in episodes that both reach",
        infobot_paths,
    ),
    Claim(
        "gcb-helps",
        "GCB, which groups similar goals, reaches more test goals than the bare agent",
        "Table I, Sec. V-E",
        BARE,
        compare([("gcb", "none")], "test_goal", ONLINE),
    ),
    Claim(
        "sse-db-efficiency",
        "SSE-DB makes DQN, InfoBot and InfoGoal more sample-efficient",
        "Fig. 8, left",
        "difference of the area under the curve of success on training goals",
        more_efficient("none", "infobot", "infogoal"),
    ),
    Claim(
        "sse-db-test",
        "DQN with SSE-DB reaches fewer test goals than InfoGoal",
        "Fig. 8, bottom left",
        "InfoGoal minus DQN with SSE-DB",
        less_than_infogoal,
    ),
    Claim(
        "sse-db-optimality",
        "SSE-DB does not shorten InfoBot's paths",
        "Fig. 8, right",
        f"by which share paths to test goals are longer with SSE-DB, in episodes that both reach, above -{COMPARABLE}",
        paths_not_shorter,
    ),
    Claim(
        "beta",
        "Beta converges to about 0.013 on FetchPickAndPlace",
        "Sec. V-F, Fig. 13",
        "within a factor of two",
        near("beta", 0.013, 2.0, ratio=True),
    ),
    Claim(
        "accuracy",
        "The accuracy stays at about 0.96 on FetchPickAndPlace",
        "Sec. V-F, Fig. 13",
        "within 0.01; beta is steered towards it (Eq. 15)",
        near("accuracy", 0.96, 0.01),
    ),
    Claim(
        "beta-too-low",
        "A fixed beta of 0.01 is better than one of 0.0001",
        "Sec. V-F, Fig. 15",
        "difference on corrupted test goals of the three Fetch tasks",
        beta_gain(1e-2, 1e-4),
    ),
    Claim(
        "beta-too-high",
        "A fixed beta of 0.01 is better than one of 0.1",
        "Sec. V-F, Fig. 15",
        "difference on corrupted test goals of the three Fetch tasks",
        beta_gain(1e-2, 1e-1),
    ),
    Claim(
        "beta-adaptive",
        "The adaptive beta is comparable with the best fixed one",
        "Sec. V-F, Fig. 15",
        f"difference to the best fixed beta above -{COMPARABLE}",
        fixed_against_adaptive,
    ),
    Claim(
        "beta-prior",
        "Under a high fixed beta codes hold less information than under the adaptive one",
        "Sec. V-F, Fig. 14",
        "log ratio of the KL, adaptive to 0.1",
        less_information,
    ),
    Claim(
        "codes-grouped",
        "InfoGoal's codes of near goals lie together, more than the bare agent's",
        "Sec. V-E, Figs. 9 to 11",
        "difference of the silhouette by region",
        grouped(),
    ),
    Claim(
        "codes-corrupted",
        "InfoGoal's codes of near goals lie together when goals are corrupted, more than the bare agent's",
        "Sec. V-E, Fig. 9",
        "difference of the silhouette by region, backgrounds of weight 0.4",
        grouped(CORRUPTION),
    ),
    Claim(
        "reward-near-goal",
        "The intrinsic reward is high where the goal is",
        "Sec. V-E, Fig. 12",
        "minus the rank correlation with the distance to the goal",
        reward_near_goal,
    ),
)


def verdicts(results: Results) -> list[tuple[Claim, Finding]]:
    """Every claim with what the numbers say about it."""
    return [(claim, claim.find(results)) for claim in CLAIMS]
