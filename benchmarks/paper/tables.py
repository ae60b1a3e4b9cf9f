"""Every table that a page shows of a study, written from the study's numbers.

    python benchmarks/paper/tables.py [STUDY ...]

A table stands in README.md or docs/*.md between `<!-- table: STUDY/NAME -->` and `<!-- end -->`; what is between them
is replaced by what docs/results/STUDY/numbers.npz gives, and docs/results/STUDY/study.md is written anew. To show new
numbers, run the study's script with `--out FOLDER`, copy FOLDER/numbers.npz there, and then run this. (A numbers.npz
that lies in FOLDER beforehand is added to.) The trials have a numbers.csv, which `trials.py --merge FOLDER` adds to,
and no study.md.
"""

import argparse
import re
from pathlib import Path

import fetch_study
import frames_study
import house_study
import methods_study
import sb3_her
import study_numbers
import trials
import tuning_study

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
STUDIES = {
    "house_study": house_study,
    "fetch_study": fetch_study,
    "frames_study": frames_study,
    "methods_study": methods_study,
    "tuning": tuning_study,
    "trials": trials,
    "sb3_her": sb3_her,
}
OWN = {"trials": lambda: trials.load(trials.NUMBERS), "sb3_her": sb3_her.load}
"""What reads the numbers of those that have no numbers.npz and no study.md."""
MARKED = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.S)


def load(name: str):
    """The numbers of a study."""
    return OWN[name]() if name in OWN else study_numbers.load(RESULTS / name / study_numbers.FILE)


def written(studies: list[str]) -> dict[Path, str]:
    """What every page and every study.md should be, by its path; tables of other studies stay as they are."""
    results = {name: load(name) for name in studies}
    tables = {
        f"{name}/{table}": text for name in studies for table, text in STUDIES[name].tables(results[name]).items()
    }

    def replace(match: re.Match) -> str:
        before, name, after = match.groups()
        return f"{before}{tables[name]}\n{after}" if name.split("/")[0] in studies else match[0]

    pages = {page: MARKED.sub(replace, page.read_text()) for page in PAGES}
    return pages | {
        RESULTS / name / "study.md": STUDIES[name].report(results[name]) for name in studies if name not in OWN
    }


def main():
    """Write the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=f"{', '.join(STUDIES)}; left out: all")
    arguments = parser.parse_args()
    for path, text in written(arguments.studies or list(STUDIES)).items():
        path.write_text(text)


if __name__ == "__main__":
    main()
