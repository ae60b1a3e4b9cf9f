"""Commands that look at what is there: evaluate, report, compare, check-fetch, video. Each is a dataclass whose fields are the flags (tyro)."""

import dataclasses
import os
from pathlib import Path

import tyro

from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.train.compilation import use_compilation_cache


@dataclasses.dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate the last parameters of a run: every goal from several starts."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""
    starts: int = 50
    """Start states for each goal."""
    start_seed: int = 1
    """Seed of the start states; training's own evaluations use others."""
    test_epsilon: float = -1.0
    """Share of random actions; negative: the run's own."""
    corruption: float | None = None
    """Weight of the backgrounds of corrupted goals, from 0 to 1, in tasks with image goals; None: the run's own."""


def evaluate(arguments: list[str]) -> int:
    """`infogoal evaluate RUN`: prints success, SPL and episode length of each kind of goals over the run's seeds."""
    command = tyro.cli(EvaluateCommand, prog="infogoal evaluate", args=arguments)
    use_compilation_cache()
    from infogoal_jax.report.summary import evaluate_run

    evaluate_run(Path(command.run), command.starts, command.start_seed, command.test_epsilon, command.corruption)
    return 0


@dataclasses.dataclass(frozen=True)
class ReportCommand:
    """Draw the figures of a run and print its table."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""


def report(arguments: list[str]) -> int:
    """`infogoal report RUN`."""
    command = tyro.cli(ReportCommand, prog="infogoal report", args=arguments)
    from infogoal_jax.report.figures import draw_figures
    from infogoal_jax.report.summary import print_run

    print_run(Path(command.run))
    for path in draw_figures(Path(command.run)):
        print(f"figure      {path}")
    return 0


@dataclasses.dataclass(frozen=True)
class CompareCommand:
    """Draw the success of several runs of one task in one figure: while training, and by the allowed length of an episode."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of the runs, in the order in which they are named in the figure."""
    out: str
    """File to write; must end in .png."""


def compare(arguments: list[str]) -> int:
    """`infogoal compare RUN RUN ... --out FILE`."""
    command = tyro.cli(CompareCommand, prog="infogoal compare", args=arguments)
    from infogoal_jax.report.comparison_figures import draw_comparison

    print(f"figure      {draw_comparison([Path(run) for run in command.runs], Path(command.out))}")
    return 0


@dataclasses.dataclass(frozen=True)
class CheckFetchCommand:
    """Replay recorded episodes of the reference Fetch tasks here, and print how far grip and object are from where they were recorded."""

    file: tyro.conf.Positional[str]
    """The episodes: an npz as benchmarks/fidelity/record_fetch_reference.py writes it."""
    faithful: bool = False
    """Simulate as finely as the reference does, 20 steps of 2 ms and the whole body; otherwise the fast default."""
    kinds: str = ""
    """Kinds of the first, second, ... episode of each task, repeated over the episodes, to print them apart: random,held,scripted."""
    out: str = ""
    """File to write the numbers to, those of each episode too (json)."""


def check_fetch(arguments: list[str]) -> int:
    """`infogoal check-fetch FILE`: measures and passes no judgement, so it is 0 whatever the numbers."""
    command = tyro.cli(CheckFetchCommand, prog="infogoal check-fetch", args=arguments)
    from infogoal_jax.envs.fetch.recordings import load_recordings
    from infogoal_jax.report.fetch_parity import check_recordings, read_kinds

    kinds, recordings = read_kinds(command.kinds), load_recordings(command.file)
    use_compilation_cache()
    check_recordings(recordings, command.faithful, kinds, Path(command.out) if command.out else None)
    return 0


@dataclasses.dataclass(frozen=True)
class VideoCommand:
    """Draw episodes as an mp4: of a random policy on a Fetch task, or of a run's policy on test goals that are images."""

    subject: tyro.conf.Positional[str]
    """Folder of a run; or fetch_reach, fetch_push, fetch_pick_and_place or fetch_slide for a random policy."""
    out: str
    """File to write; must end in .mp4."""
    episodes: int = 1
    """Episodes, one after the other."""
    seed: int = 0
    """Seed of starts, goals, actions and backgrounds."""
    corruption: float = 0.0
    """Weight of the backgrounds of the goal images that a run's policy sees, from 0 (clean) to 1."""
    height: int = 480
    """Pixels; the width is 4/3 of it."""


def video(arguments: list[str]) -> int:
    """`infogoal video RUN --out FILE`, `infogoal video TASK --out FILE`."""
    command = tyro.cli(VideoCommand, prog="infogoal video", args=arguments)
    size = command.height, command.height * 4 // 3
    use_compilation_cache()
    if command.subject not in TASKS and (Path(command.subject).is_dir() or os.sep in command.subject):
        from infogoal_jax.report.figures import read_subject
        from infogoal_jax.report.image_goal_episodes import policy_video

        run = read_subject(Path(command.subject))
        reached = policy_video(run, command.out, command.episodes, command.seed, command.corruption, size)
        words = f"corrupted with weight {command.corruption:g}" if command.corruption else "clean"
        print(f"{command.out}: {len(reached)} episodes of the policy of seed {run.params_seed} on test goals, {words}; {sum(reached)} reach the goal")
        return 0
    if command.corruption:
        raise UserError(f"corruption = {command.corruption}: a random policy looks at no goal; leave it out, or give the folder of a run")
    import jax

    from infogoal_jax.envs.fetch.environment import make
    from infogoal_jax.report.video import episode_video, random_policy

    env = make(command.subject, FetchConfig(ends_at_goal=False))
    last = episode_video(env, random_policy, jax.random.key(command.seed), command.out, command.episodes, size)
    at_goal = sum(bool(env.reached(env.achieved(state), state.goal)) for state in last)
    print(f"{command.out}: {command.episodes} episodes of a random policy, {at_goal} end at the goal")
    return 0


RUN_COMMANDS = {"evaluate": evaluate, "report": report, "compare": compare, "check-fetch": check_fetch, "video": video}
