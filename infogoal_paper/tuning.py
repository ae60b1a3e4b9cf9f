"""How every method was tuned: `infogoal tune` with one budget for all, on validation goals and on seeds that no result
is reported on.

    python -m infogoal_paper.tuning --out FOLDER [--tasks object_search fetch_reach] [--methods vae ...]
    [--trials 16] [--seeds 2] [--final] [--clean [--goal-images FOLDER]]
    python -m infogoal_paper.tuning --merge FOLDER

Object search is tuned in another house (seed 100). Its training goals are those of every house; nine of the other
objects are given the names of objects that the task does not have, and are the validation goals. The cube and the shelf
are tuned on dataset 100, Fetch on the validation goals of the shipped bank. FOLDER/TASK/METHOD is the folder of a
search (docs/research/tuning.md); what is there is not run again, so that searches may come from several machines and
several processes. With --final the preset and the three best of each search run again with eight other seeds, into
FOLDER/TASK/METHOD/final. --clean makes choices that no preset has a part in, into FOLDER/clean: settings are drawn
alone, the preset runs but is not chosen, and all methods have the same noise at test. Fetch is then tuned on a goal set
of its own, which `infogoal reproduce goal-images FOLDER/100 --seed 100` draws. --merge puts what is finished in
FOLDER into docs/results/tuning.jsonl.xz, a line a search; `pages.py tuning` then writes the tables of
docs/research/tuning.md.
"""

import argparse
import functools
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from infogoal_jax import presets
from infogoal_jax.data.splits import AUTHORS_SPLIT
from infogoal_jax.errors import require
from infogoal_jax.report.statistics import paired_difference
from infogoal_jax.stand_ins.house import build_house
from infogoal_paper import trial_numbers
from infogoal_paper.manifest import FETCH
from infogoal_paper.paper import LEARNERS, METHODS
from infogoal_paper.scores import TITLES
from infogoal_paper.table_formats import markdown_lines, tight

NUMBERS = Path(__file__).parents[1] / "docs" / "results" / "tuning.jsonl.xz"
Search = dict[str, Any]
"""search: TASK/METHOD or TASK/METHOD/final, behind clean/ those of --clean; data, device; seeds; num_epochs: that were
asked for; epochs: of the evaluations; goals: that scores are of; best: number of a trial; trials: each with its number,
values, success [evaluations][seeds] and the seeds that diverged."""
SEED = 100
"""Of the house, the cube and the shelf for tuning: no result is shown on them."""
VALIDATION = {
    "crystal_hot_sauce": "pringles_bbq",
    "paper_plate": "red_cup",
    "mahatma_rice": "bumblebee_albacore",
    "honey_bunches_of_oats_with_almonds": "hunts_sauce",
    "softsoap_clear": "progresso_new_england_clam_chowder",
    "hersheys_bar": "red_bull",
    "nature_valley_sweet_and_salty_nut_almond": "expo_marker_red",
    "advil_liqui_gels": "crest_complete_minty_fresh",
    "listerine_green": "softsoap_white",
}
"""Names of test objects, and those that stand in for them while tuning: of the Active Vision Dataset, but in no split
of the authors."""

DATASETS = {
    "object_manipulation": {"env.generator_seed": SEED, "env.goal_seed": SEED},
    "embodied_qa": {"env.generator_seed": SEED},
}
"""Fields of the cube and the shelf for tuning."""
EPOCHS = {"object_search": (100, 20), "fetch_reach": (60, 20), "object_manipulation": (20, 5)}
"""Epochs of every trial, and from one evaluation to the next; of another task those of the bare agent's preset. The
cube's 120 would take a quarter of an hour of a GPU a search."""
FIELDS = {"infobot": ["learning_rate", "discount", "target_rate", "intrinsic_weight", "learner.beta"]}
"""What is searched of a method, where that is not all that matters to it: InfoBot's beta and the weight of its loss are
one number. `AGENT_FIELDS` has what the agent of a task adds."""
AGENT_FIELDS = {"embodied_qa": ["agent.conservative_weight"]}
WITH_HER = ("object_manipulation",)
"""Tasks on which learners are searched with HER: without it all of them stay at the floor."""
CLEAN = "clean"
"""The folder of clean choices."""
CLEAN_NOISE = 0.1
"""Probability of a random action at test in them: a code that is sampled at every step gains nothing by its noise."""

CLEAN_SPACE = 1
"""Seed of their draws: presets have winners among those of seed 0."""


def tuning_house(folder: Path) -> list[str]:
    """Build the house for tuning and its split, unless it is there. Returns the flags that train on it."""
    if not (folder / "house").exists():
        folder.mkdir(parents=True, exist_ok=True)
        dataset = Path(tempfile.mkdtemp(dir=folder))
        build_house(dataset, seed=SEED)
        for path in (dataset / "all_instance_id_map.txt", dataset / "instance_id_map.txt"):
            identifier = dict(line.split() for line in path.read_text().splitlines())
            for old, new in VALIDATION.items():
                identifier[old], identifier[new] = identifier[new], identifier[old]
            path.write_text("".join(f"{name} {number}\n" for name, number in identifier.items()))
        for path in dataset.glob("*/present_instance_names.txt"):
            path.write_text("".join(f"{VALIDATION.get(name, name)}\n" for name in path.read_text().split()))
        uses = dict.fromkeys(AUTHORS_SPLIT.train, "train") | dict.fromkeys(VALIDATION, "validation")
        room = {name: AUTHORS_SPLIT.room_names[AUTHORS_SPLIT.rooms[name]] for name in uses}
        objects = {VALIDATION.get(name, name): {"room": room[name], "use": use} for name, use in uses.items()}
        (dataset / "split.json").write_text(json.dumps({"objects": objects}, indent=1) + "\n")
        try:
            dataset.rename(folder / "house")
        except OSError:  # Another process was faster, and its house is the same.
            shutil.rmtree(dataset)
    return ["--env.dataset", str(folder / "house"), "--env.split", str(folder / "house" / "split.json")]


def flags(fields: dict[str, int]) -> list[str]:
    """Dotted fields as flags of the command line."""
    return [word for name, value in fields.items() for word in (f"--{name.replace('_', '-')}", str(value))]


def data_of(task: str, folder: Path, clean: bool, goal_images: Path | None) -> list[str]:
    """The flags of the data that a task is tuned on; goal_images: folder of further goal sets of Fetch, for clean
    choices."""
    if task == "object_search":
        return tuning_house(folder)
    if clean and task in FETCH:
        require(goal_images is not None, "goal_images", None, f"give the folder that holds goal set {SEED} of Fetch")
        return ["--env.goal-images", str(goal_images / str(SEED) / f"{task}.npz")]
    return flags(DATASETS.get(task, {}))


def search(
    task: str, method: str, trials: int, seeds: int, folder: Path, clean: bool = False, goal_images: Path | None = None
) -> Path:
    """One search by the command line, into FOLDER/TASK/METHOD, a clean one into FOLDER/clean/TASK/METHOD. One that was
    stopped goes on. Returns its folder."""
    out = folder / CLEAN / task / method if clean else folder / task / method
    if out.exists():
        go_on("tune", out)
        return out
    command = ["tune", task, "--method", method, "--out", str(out), *data_of(task, folder, clean, goal_images)]
    command += ["--trials", str(trials), "--seeds", str(seeds)]
    if task in EPOCHS:
        epochs, between = map(str, EPOCHS[task])
        command += ["--num-epochs", epochs, "--epochs-per-evaluation", between]
    if (learner := method.partition("+")[0]) in FIELDS:
        command += ["--fields", *FIELDS[learner], *AGENT_FIELDS.get(task, [])]
    if task in WITH_HER and method in LEARNERS:
        command += ["--relabelling", "her"]
    if clean:
        command += ["--hyper.test-epsilon", str(CLEAN_NOISE), "--space-seed", str(CLEAN_SPACE)]
    infogoal(*command)
    return out


def final(search: Path) -> None:
    """The final of the search in this folder, into its folder `final`. One that was stopped goes on."""
    out = search / "final"
    if out.exists():
        go_on("final", out)
    else:
        infogoal("final", str(search), "--out", str(out))


def go_on(command: str, folder: Path) -> None:
    """Go on with the search or the final in this folder, unless it is finished."""
    if not is_finished(folder):
        infogoal(command, "--resume", str(folder))


def infogoal(*words: str) -> None:
    """Run a command. Raises `CalledProcessError` where it fails."""
    subprocess.run([sys.executable, "-m", "infogoal_jax", *words], check=True)


def is_finished(folder: Path) -> bool:
    """Whether a search or a final came to its end: what it has found so far is written after every evaluation."""
    best = folder / "best.json"
    return best.exists() and json.loads(best.read_text())["finished"]


def read_search(folder: Path, name: str) -> Search:
    """The finished search or final in this folder."""
    about, best = (json.loads((folder / file).read_text()) for file in ("config.json", "best.json"))
    trials = [json.loads(line) for line in (folder / "trials.jsonl").read_text().splitlines()]
    return {
        "search": name,
        "data": about["data"],
        "device": about["device"],
        "num_epochs": about["config"]["num_epochs"],
        "seeds": about["seeds"],
        "epochs": trials[0]["epochs"],
        "goals": best["goals"],
        "best": best["trial"],
        "trials": [{key: trial[key] for key in ("trial", "values", "success", "diverged")} for trial in trials],
    }


def load(path: Path) -> dict[str, Search]:
    """The searches of a file, by name."""
    return {search["search"]: search for search in map(json.loads, trial_numbers.read_text(path).splitlines())}


def merge(folder: Path, path: Path) -> list[str]:
    """Put the finished searches of a folder into the file, in place of what it holds of them. Returns their names."""
    ended = [found.parent for found in sorted(folder.rglob("best.json")) if is_finished(found.parent)]
    names = {str(found.relative_to(folder)): found for found in ended}
    new = {name: read_search(found, name) for name, found in names.items()}
    searches = (load(path) if path.exists() else {}) | new
    lines = "".join(json.dumps(searches[name], separators=(",", ":")) + "\n" for name in sorted(searches))
    trial_numbers.write_compressed(path, lines)
    return list(new)


def trial_of(search: Search, number: int) -> dict[str, Any]:
    """The trial of this number."""
    return next(trial for trial in search["trials"] if trial["trial"] == number)


def drawn_best(search: Search) -> dict[str, Any]:
    """The best trial of a search or final but for the preset, compared as `infogoal_jax.runner.search` does: seeds that
    did not diverge, success at the end, success before."""
    drawn = [trial for trial in search["trials"] if trial["trial"]]
    return max(
        drawn,
        key=lambda trial: (
            -len(trial["diverged"]),
            np.mean(trial["success"][-1]),
            np.mean(trial["success"]),
            -trial["trial"],
        ),
    )


@functools.cache
def clean_choices(task: str, path: Path = NUMBERS) -> dict[str, dict[str, float]]:
    """What clean searches chose on a task, {method: {dotted float: value}}; of methods that have a final it is the
    final's."""
    start, found = f"{CLEAN}/{task}/", {}
    for name, search in load(path).items():
        if name.startswith(start):
            found.setdefault(name.removeprefix(start).removesuffix("/final"), {})[name.endswith("/final")] = search
    return {method: drawn_best(own[max(own)])["values"] for method, own in found.items()}


def tables(searches: dict[str, Search]) -> dict[str, str]:
    """The table that docs/research/tuning.md shows: a line for each method, and a column for each task, of its finals
    or of the searches where there are none; what they were made on below. The values of every trial are in the file."""
    shown = {}
    for task in presets.TASKS:
        ran_final = any(search.startswith(f"{task}/") and search.endswith("/final") for search in searches)
        ending = "/final" if ran_final else ""
        names = {method: f"{task}/{method}{ending}" for method in METHODS}
        found = {method: searches[name] for method, name in names.items() if name in searches}
        if found:
            shown[task] = found
    rows = [
        [title, *(cell(found[method]) if method in found else "" for found in shown.values())]
        for method, title in METHODS.items()
        if any(method in found for found in shown.values())
    ]
    lines = markdown_lines(["method", *(TITLES[task] for task in shown)], rows)
    alike: dict[str, list[str]] = {}
    for task, found in shown.items():
        alike.setdefault(made_on(found), []).append(TITLES[task])
    said = "; ".join(f"{', '.join(titles)}: {words}" for words, titles in alike.items())
    return {"searches": f"{lines}\n\n{said}."}


def cell(search: Search) -> str:
    """`0.72, 0.07±0.13`: the score of the preset, and how far the best trial is above it; the interval over the seeds
    where there are more than two. Of a preset that is the best its score alone."""
    trials = {trial["trial"]: trial for trial in search["trials"]}
    score, best = (trials[number]["success"][-1] for number in (0, search["best"]))
    if search["best"] == 0:
        return f"{np.mean(score):.2f}"
    gain = f"{np.mean(best) - np.mean(score):.2f}" if len(score) < 3 else tight(paired_difference(best, score))
    return f"{np.mean(score):.2f}, {gain}"


def made_on(found: dict[str, Search]) -> str:
    """Goals, epochs, trials, seeds and devices of the searches of a task."""
    one = next(iter(found.values()))
    devices = " and ".join(dict.fromkeys(search["device"] for search in found.values()))
    return (
        f"{one['goals']} goals, {one['epochs'][-1]} epochs, {len(one['trials'])} trials, seeds "
        f"{one['seeds'][0]}-{one['seeds'][-1]}, {devices.removesuffix(' 80GB HBM3')}"
    )


def main():
    """Search what is not there yet, or keep what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--merge", type=Path, metavar="FOLDER", help=f"put what is finished there into {NUMBERS.name}")
    parser.add_argument("--tasks", nargs="*", default=["object_search", "fetch_reach"], choices=presets.TASKS)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), help="such as infogoal or infogoal+her")
    parser.add_argument("--trials", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument(
        "--final", action="store_true", help="run the best of each search again, with more and other seeds"
    )
    parser.add_argument(
        "--clean", action="store_true", help="choose from settings that are drawn, with the same noise at test for all"
    )
    parser.add_argument(
        "--goal-images", type=Path, metavar="FOLDER", help=f"holds goal set {SEED} of Fetch; for --clean"
    )
    arguments = parser.parse_args()
    if arguments.merge is not None:
        print(f"{NUMBERS.name}: {', '.join(merge(arguments.merge, NUMBERS))}")
        return
    if arguments.out is None:
        parser.error("give --out or --merge")
    for task in arguments.tasks:
        for method in arguments.methods:
            numbers = arguments.trials, arguments.seeds
            found = search(task, method, *numbers, arguments.out, arguments.clean, arguments.goal_images)
            if arguments.final:
                final(found)


if __name__ == "__main__":
    main()
