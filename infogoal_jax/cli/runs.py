"""Commands that look at what is there: evaluate, report, compare, video, pack."""

import os
from pathlib import Path
from typing import Literal

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction

from infogoal_jax.cli.commands import Words, check_seed, draw, tell
from infogoal_jax.errors import UserError, counted, require
from infogoal_jax.imports import entry_points, load, typed_command


def evaluate(
    run: Positional[str],
    starts: int = 50,
    start_seed: int = 1,
    test_epsilon: float = -1.0,
    corruption: float | None = None,
    goal: UseAppendAction[tuple[tuple[str, ...], ...]] = (),
) -> int:
    """Evaluate the last parameters of a run again, every goal from several starts.

    Args:
        run: Folder of the run, a file of `infogoal pack`, or a shipped policy such as shipped/object_search.
        starts: Start states for each goal.
        start_seed: Seed of the start states; training's own evaluations use others.
        test_epsilon: Probability of a random action; negative: the run's own.
        corruption: Weight of the backgrounds of corrupted goals, from 0 to 1, in tasks with image goals; None: the
            run's own.
        goal: A goal to evaluate in place of the task's: its numbers, or the name of one of a list. Give the flag again
            for another goal.
    """
    from infogoal_jax.report.summary import evaluate_run
    from infogoal_jax.runner.compilation import use_compilation_cache

    use_compilation_cache()
    evaluate_run(Path(run), starts, start_seed, test_epsilon, corruption, goals=goal)
    return 0


def report(
    run: Positional[str],
    format: Literal["png", "pdf", "svg"] = "png",
    captions: FlagCreatePairsOff[bool] = False,
    style: str = "",
) -> int:
    """Draw the figures of a run and print its table; of a flight, its path and its times.

    Args:
        run: Folder of the run, or of a flight of `infogoal fly`.
        format: Of the figures.
        captions: Write what stands above and below a figure into a text beside it, for a paper's captions.
        style: Style sheet of matplotlib that is applied after the package's own.
    """
    # Packages that leave folders of their own name their file and what draws it, as an entry point.
    for point in entry_points("infogoal.reports"):
        if (Path(run) / point.name).exists():
            print(f"figure      {load(point)(Path(run), format, captions, style)}")
            return 0
    from infogoal_jax.report.figures import draw_figures
    from infogoal_jax.report.summary import print_run

    print_run(Path(run))
    draw(draw_figures, Path(run), None, format, captions, style)
    return 0


def compare(
    runs: Positional[tuple[str, ...]],
    out: str,
    metrics: Words = (),
    captions: FlagCreatePairsOff[bool] = False,
    style: str = "",
    labels: Words = (),
) -> int:
    """Draw several runs of one task in one figure: their success, or any metrics; and print their success.

    Args:
        runs: Folders of the runs, in the order in which they are named in the figure.
        out: File to write; must end in .png, .pdf or .svg.
        metrics: Columns of evaluations.csv or epochs.csv, a panel each, such as infogoal/beta agent/value; empty:
            success while training, and by episode length.
        captions: Write what stands above and below the figure into a text beside it, for a paper's caption.
        style: Style sheet of matplotlib that is applied after the package's own.
        labels: What the legend calls each run, in their order; empty: its method, and its folder where two are alike.
    """
    from infogoal_jax.report.comparison_figures import draw_comparison
    from infogoal_jax.report.sweeps import print_comparison

    folders = [Path(run) for run in runs]
    draw(lambda: [draw_comparison(folders, Path(out), None, metrics, captions, style, labels)])
    print_comparison(folders, labels)
    return 0


def pack(run: Positional[str], out: str, seed: int | None = None) -> int:
    """Write one seed of a run as one small file, which commands that look at a run take in place of its folder.

    Args:
        run: Folder of the run.
        out: File to write; must end in .zip.
        seed: Seed of the run; none: its first.
    """
    from infogoal_jax.runs import folder as folders

    evaluations = folders.pack(folders.find_run(run), Path(out), seed)
    # A run of recordings alone has no success, and cannot be evaluated.
    has_success = any(name.endswith("success_rate") for name in evaluations[0])
    example = typed_command("evaluate" if has_success else "compare", out)
    tell(f"{out}: {Path(out).stat().st_size / 1e6:.2f} MB; for example: {example}")
    return 0


def video(
    subject: Positional[str], out: str, episodes: int = 1, seed: int = 0, corruption: float = 0.0, height: int = 480
) -> int:
    """Draw episodes of a run's policy, or of a random one, as an mp4 or a GIF.

    Args:
        subject: Folder of a run of Fetch, of another library's robot, or of a task that draws its states; or
            fetch_reach, fetch_push, fetch_pick_and_place or fetch_slide for a random policy, where there is no run in a
            folder of that name.
        out: File to write; must end in .mp4 or .gif.
        episodes: Episodes, one after the other.
        seed: Seed of starts, goals, actions and backgrounds.
        corruption: Weight of the backgrounds of the goal images that a run's policy sees, from 0 (clean) to 1.
        height: Pixels; the width is 4/3 of it.
    """
    from infogoal_jax.envs.fetch.tasks import TASKS
    from infogoal_jax.report import video as videos
    from infogoal_jax.runner.compilation import use_compilation_cache
    from infogoal_jax.runner.progress import working_on

    videos.check_path(out, "out")
    check_seed(seed)
    require(0 < episodes <= 1000, "episodes", episodes, "give 1 to 1000")
    require(0 < height <= 4320, "height", height, "give 1 to 4320 pixels")
    use_compilation_cache()
    is_run = (Path(subject) / "config.json").exists()
    if is_run or (subject not in TASKS and (Path(subject).exists() or os.sep in subject)):
        from infogoal_jax.report.figures import read_subject

        run = read_subject(Path(subject))
        with working_on("drawing"):
            reached = videos.policy_video(run, out, episodes, seed, corruption, height)
        words = f"goal images corrupted with weight {corruption:g}; " if corruption else ""
        tell(
            f"{out}: {counted(len(reached), 'episode')} of the policy of seed {run.params_seed}; {words}the goal is "
            f"reached in {sum(reached)}"
        )
        return 0
    if corruption:
        raise UserError(
            f"corruption = {corruption}: a random policy looks at no goal; leave it out, or give the folder of a run"
        )
    from infogoal_jax import envs
    from infogoal_jax.envs.fetch.tasks import FetchConfig
    from infogoal_jax.train.evaluation import random_policy

    env = envs.load(f"{subject}_positions", FetchConfig(goals="positions", ends_at_goal=False))
    goals = videos.drawn_goals(env, episodes, seed)
    with working_on("drawing"):
        reached = videos.drawn_video(env, random_policy(env), out, goals, seed, height)
    tell(f"{out}: {counted(episodes, 'episode')} of a random policy; the goal is reached at the end of {sum(reached)}")
    return 0
