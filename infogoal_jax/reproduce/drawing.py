"""What is written of the numbers: tables, figures, the verdict on every claim, and the page that shows all of it.

OUT/tables/NAME.md, .tex, .csv    OUT/figures/NAME.png    OUT/reproduction.md    OUT/index.html
"""

from pathlib import Path

from infogoal_jax.reproduce import tables
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.runs import disk


def draw(studies: tuple[str, ...], results: Results, out: Path) -> list[Path]:
    """Write what these studies show, as far as there are numbers; the paths of the files."""
    paths = []
    disk.make_folder(out / "tables")
    for table in tables.all_tables(results):
        for ending, write in tables.WRITERS.items():
            paths.append(out / "tables" / f"{table.name}.{ending}")
            disk.write_text(paths[-1], write(table))
    return paths
