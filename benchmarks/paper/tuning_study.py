"""How every method was tuned: `infogoal tune` with one budget for all, on validation goals and on seeds that no result
is reported on.

    python benchmarks/paper/tuning_study.py --out FOLDER [--tasks object_search fetch_reach] [--methods vae ...]
    [--trials 16] [--seeds 2] [--final]

Object search is tuned in another house (seed 100). Its training goals are those of every house; nine of the other
objects are given the names of objects that the task does not have, and are the validation goals. Fetch is tuned on the
validation goals of the shipped bank. FOLDER/TASK/METHOD is the folder of a search (docs/tuning.md); what is there is
not run again, so that searches may come from several machines and several processes. With --final the preset and the
three best of each search run again with eight other seeds, into FOLDER/TASK/METHOD/final. FOLDER/numbers.npz holds
every trial of all that is there (study_numbers.py: a search is a run whose metrics are `trial_N/success_rate`),
FOLDER/study.md the table.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import study
import study_numbers
from study import METHODS
from study_numbers import Study, StudyRun

from infogoal_jax import presets
from infogoal_jax.data.splits import AUTHORS_SPLIT
from infogoal_jax.report.tables import Table
from infogoal_jax.stand_ins.house import build_house

HOUSE = 100
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

EPOCHS = {"object_search": 100, "fetch_reach": 60}
"""Epochs of every trial; of another task those of the bare agent's preset."""
FIELDS = {"infobot": ["learning_rate", "discount", "target_rate", "intrinsic_weight", "fixed_beta"]}
"""What is searched of a method, where that is not all that matters to it: InfoBot's beta and the weight of its loss are
one number."""


def tuning_house(folder: Path) -> list[str]:
    """Build the house for tuning and its split, unless it is there. Returns the flags that train on it."""
    if not (folder / "house").exists():
        folder.mkdir(parents=True, exist_ok=True)
        dataset = Path(tempfile.mkdtemp(dir=folder))
        build_house(dataset, seed=HOUSE)
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


def search(task: str, method: str, trials: int, seeds: int, folder: Path) -> None:
    """One search by the command line, into FOLDER/TASK/METHOD. One that was stopped stays as it is: delete its folder
    to search again."""
    out = folder / task / method
    if (out / "best.json").exists():
        return
    data = tuning_house(folder) if task == "object_search" else []
    command = [
        "tune",
        task,
        "--method",
        method,
        "--trials",
        str(trials),
        "--seeds",
        str(seeds),
        "--out",
        str(out),
        *data,
    ]
    command += ["--num-epochs", str(EPOCHS[task]), "--epochs-per-evaluation", "20"] if task in EPOCHS else []
    command += ["--fields", *FIELDS[method]] if method in FIELDS else []
    subprocess.run([sys.executable, "-m", "infogoal_jax", *command], check=True)


def final(task: str, method: str, folder: Path) -> None:
    """The final of a search that is there, into FOLDER/TASK/METHOD/final. One that was stopped stays as it is: delete
    its folder to run it again."""
    out = folder / task / method / "final"
    if not (out / "best.json").exists():
        command = ["final", str(out.parent), "--out", str(out)]
        subprocess.run([sys.executable, "-m", "infogoal_jax", *command], check=True)


def read_search(folder: Path) -> StudyRun:
    """A search or final: its trials' values, the best trial, and the success of every trial, seed and evaluation."""
    about, best = (json.loads((folder / name).read_text()) for name in ("config.json", "best.json"))
    trials = [json.loads(line) for line in (folder / "trials.jsonl").read_text().splitlines()]
    success = {f"trial_{trial['trial']}/success_rate": np.asarray(trial["success"], float).T for trial in trials}
    result = {
        "best": best["trial"],
        "goals": best["goals"],
        "values": {str(trial["trial"]): trial["values"] for trial in trials},
        "diverged": {str(trial["trial"]): trial["diverged"] for trial in trials if trial["diverged"]},
        "compile_seconds": best["compile_seconds"],
        "run_seconds": best["run_seconds"],
    }
    return StudyRun(about | {"result": result}, Table(about["seeds"], np.asarray(trials[0]["epochs"], int), success))


def collect(folder: Path) -> Study:
    """The study in this folder: what its numbers.npz holds already, and every search and final below it."""
    known = study_numbers.load(folder / study_numbers.FILE).runs if (folder / study_numbers.FILE).exists() else {}
    return Study(
        known
        | {str(path.parent.relative_to(folder)): read_search(path.parent) for path in sorted(folder.rglob("best.json"))}
    )


def report(results: Study) -> str:
    """The searches and finals as Markdown: for each task and method the preset's score, the best one's and its values,
    and how far they came."""
    lines = []
    for task in presets.TASKS:
        found = results.finished(task, METHODS)
        finals = {
            name.removesuffix("/final"): run
            for name, run in results.finished(task, [f"{method}/final" for method in METHODS]).items()
        }
        lines += [f"### {task}", "", *table(found, task)] if found else []
        lines += ["Finals, of the preset and the best of each search:", "", *table(finals, task)] if finals else []
    return "\n".join(lines)


def tables(results: Study) -> dict[str, str]:
    """The tables that pages show: none."""
    return {}


def table(found: dict[str, StudyRun], task: str) -> list[str]:
    """Rows of Markdown for these searches or finals, by method, and what they were made on."""
    rows, footers = [], {}
    for method, run in found.items():
        result, final = run.about["result"], run.evaluations.last()
        scores = [f"{final[f'trial_{trial}/success_rate'].mean():.2f}" for trial in (0, result["best"])]
        values = ", ".join(f"{name} {value:.3g}" for name, value in result["values"][str(result["best"])].items())
        epochs = f"{run.evaluations.epochs[-1]} of {run.about['config']['num_epochs']}"
        rows.append([study.title_of(method, task), *scores, str(result["best"]), values, epochs])
        seeds = ", ".join(map(str, run.evaluations.seeds))
        lanes = f"{len(result['values'])} trials, of which 0 is the preset, with the seeds {seeds}"
        footer = (
            f"Success on {result['goals']} goals at the last of these epochs; {lanes}; {run.about['device']}. "
            f"{run.about['data']}"
        )
        footers.setdefault(footer, []).append(study.title_of(method, task))
    lines = [study.markdown(["method", "preset of that time", "best", "trial", "its values", "epochs"], rows), ""]
    for footer, methods in footers.items():
        lines += [footer if len(footers) == 1 else f"{', '.join(methods)}: {footer}", ""]
    return lines


def main():
    """Search what is not there yet, then write the table of all that is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="*", default=["object_search", "fetch_reach"], choices=presets.TASKS)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--trials", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument(
        "--final", action="store_true", help="run the best of each search again, with more and other seeds"
    )
    arguments = parser.parse_args()
    for task in arguments.tasks:
        for method in arguments.methods:
            search(task, method, arguments.trials, arguments.seeds, arguments.out)
            if arguments.final:
                final(task, method, arguments.out)
    study.finish(arguments.out, report, collect)


if __name__ == "__main__":
    main()
