"""What is measured of a run beside its success: known without training, and without JAX."""

from collections.abc import Iterable

from infogoal_jax.reproduce.manifest import DRAWN, PRESET, WITH_LOSS, Run

PICTURED = ("object_search", "embodied_qa", "fetch_pick_and_place", "object_manipulation")
"""Tasks whose codes and trajectories are drawn."""
JUDGED = ("infogoal", "none")
"""Methods whose codes a claim compares."""
NO_TIME = "no time was left to measure it"


def has_share(run: Run) -> bool:
    """Whether the share of the method's own loss in the gradient of the goal encoder is to be measured."""
    return run.method in WITH_LOSS


def is_pictured(run: Run) -> bool:
    """Whether a figure shows codes or trajectories of this run."""
    return run.goal_set == 0 and run.task in PICTURED and run.method in DRAWN and run.relabelling != "her"


def is_judged(run: Run) -> bool:
    """Whether a claim compares the codes of this run: of all its seeds, on every goal set."""
    plain = run.lane.name == PRESET[0] and run.explorer is None and run.relabelling != "her"
    return run.task in PICTURED and run.method in JUDGED and plain


def missing(run: Run, share: float | None, arrays: Iterable[str]) -> list[str]:
    """What is to be measured of a run and was not: share, codes, pictures. share: None where it was not measured;
    arrays: names of those that there are."""
    lacking = {
        "share": has_share(run) and share is None,
        "codes": is_judged(run) and "codes/closeness" not in arrays,
        "pictures": is_pictured(run) and "picture/code_mean" not in arrays,
    }
    return [name for name, lacks in lacking.items() if lacks]
