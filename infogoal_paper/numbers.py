"""The compact numbers of a reproduction: one file a study, from which every table and figure is drawn again.

    FOLDER/paper.npz, all_goals.npz

Each holds the runs of its study: their success at every evaluation, seed by seed, and the arrays of their pictures.
What the runs have of one name and type lies end to end in one array, which takes less than half of the space of as many
small ones. Equal numbers give equal bytes.
"""

import dataclasses
import json
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from infogoal_jax.config import TrainConfig
from infogoal_jax.data import archives
from infogoal_jax.errors import UserError, require
from infogoal_jax.files import from_json
from infogoal_jax.runs import disk
from infogoal_paper import files, plan
from infogoal_paper.files import Result
from infogoal_paper.manifest import Run

STUDIES = ("paper", "all_goals")
TEXTS = ("names", "about", "shapes")
"""JSON, with an entry for each run."""
REMEDY = "give a folder that `infogoal reproduce merge` wrote"
Results = dict[Run, Result]


def is_kept(metric: str, run: Run) -> bool:
    """Whether a metric is kept in the compact numbers: success in every setting, paths of clean goals, and what the
    learner says of its code. Of a run that the paper does not have paths and mean codes are not shown."""
    is_path = metric.rpartition("/")[2] in ("spl", "episode_length")
    if not run.of_paper:
        return not is_path and "mean_code" not in metric
    plain = "corrupted" not in metric and "mean_code" not in metric and "validation" not in metric
    return not is_path or plain


def compact(result: Result) -> Result:
    """A run with the numbers that tables and figures are made of. Of `first_reached` [seeds, M, starts] that of the
    evaluation at which the run levelled off stays; of the study of all goals at once nothing is made of it."""
    arrays = dict(result.arrays) if result.run.of_paper else {}
    first = arrays.get("first_reached")
    if first is not None and first.ndim == 4:
        last = plan.shown(result.evaluations["train_goal/success_rate"]).stop
        arrays["first_reached"] = first[:, last - 1]
    evaluations = {name: value for name, value in result.evaluations.items() if is_kept(name, result.run)}
    return dataclasses.replace(result, evaluations=evaluations, arrays=arrays)


def of_folder(folder: Path) -> Results:
    """The finished runs in the folder of a reproduction, compact. Raises `UserError` for a damaged file."""
    found = (compact(files.read(path)) for path in sorted(folder.rglob("*.npz")) if path.stem not in STUDIES)
    return of_one_size({result.run: result for result in found}, "out", str(folder))


def has_numbers(folder: Path) -> bool:
    """Whether a folder holds compact numbers of any study."""
    return any((folder / f"{study}.npz").exists() for study in STUDIES)


def load(folder: Path, field: str = "from") -> Results:
    """The runs of the compact numbers in this folder. Raises `UserError`, naming the field, if there are none, or for a
    damaged file."""
    names = [f"{study}.npz" for study in STUDIES]
    paths = [folder / name for name in names if (folder / name).exists()]
    require(bool(paths), field, str(folder), f"holds no {', '.join(names)}; {REMEDY}")
    found: Results = {}
    for path in paths:
        with archives.naming("numbers", path, REMEDY):
            archive = archives.read(path, REMEDY)
            texts = {name: entries(archive, name) for name in TEXTS}
            lengths = {len(text) for text in texts.values()}
            require(len(lengths) == 1, "names", sorted(lengths), f"should be as many as {', '.join(TEXTS)}; {REMEDY}")
            for about, arrays in zip(texts["about"], parted(archive, texts["shapes"]), strict=True):
                result = files.unpacked(arrays | {"about": np.frombuffer(json.dumps(about).encode(), np.uint8)})
                found[result.run] = result
    return of_one_size(found, field, str(folder))


def entries(archive: archives.Archive, name: str) -> list:
    """What one of `TEXTS` has of each run."""
    text = archives.member(archive, name, REMEDY).tobytes()
    try:
        found = from_json(text)
    except ValueError as error:
        raise UserError(f"{name} = unreadable ({error}); {REMEDY}") from error
    require(isinstance(found, list), name, type(found).__name__, f"should be a list; {REMEDY}")
    return found


def parted(archive: archives.Archive, shapes: list[dict[str, list]]) -> Iterator[dict[str, np.ndarray]]:
    """The arrays of each run out of those that lie end to end. shapes: of each run by name [type, *shape]."""
    joined = {name: archives.member(archive, name, REMEDY) for name in archive.sizes if name not in TEXTS}
    for name, array in joined.items():
        require(array.ndim == 1, name, array.shape, f"should lie end to end; {REMEDY}")
    taken = dict.fromkeys(joined, 0)
    for own in shapes:
        arrays = {}
        try:
            for name, (kind, *shape) in own.items():
                if not all(type(size) is int and size >= 0 for size in shape):
                    raise ValueError(f"{name} has a shape that is none")
                whole, first = f"{name}.{kind}", taken[f"{name}.{kind}"]
                taken[whole] += math.prod(shape)
                arrays[name] = joined[whole][first : taken[whole]].reshape(shape)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise UserError(f"shapes = not those of the arrays ({error}); {REMEDY}") from error
        yield arrays
    for whole, array in joined.items():
        require(taken[whole] == len(array), whole, len(array), f"numbers, {taken[whole]} of them of runs; {REMEDY}")


def holds(results: Results, run: Run, config: TrainConfig, measured: bool = False) -> bool:
    """Whether these numbers have the run, with the settings of the configuration and trained to its end. measured:
    whether it has to be measured, too."""
    found = results.get(run)
    return found is not None and files.is_current(found, config) and not (measured and found.missing())


def of_one_size(results: Results, field: str, value: str) -> Results:
    """The results. Raises `UserError` where some are at toy size and others of full size, which no table may mix."""
    toy = [run.name for run in results if run.toy]
    full = next((run.name for run in results if not run.toy), "")
    if toy and full:
        raise UserError(
            f"{field} = {value!r}: {toy[0]} is at toy size and {full} of full size; keep them in folders of their own"
        )
    return results


def save(results: Results, folder: Path) -> list[Path]:
    """Write the compact numbers of these runs, a file a study. Returns the files."""
    disk.make_folder(folder)
    paths = []
    for study in STUDIES:
        of_study = (result for run, result in results.items() if run.of_paper == (study == "paper"))
        own = sorted(of_study, key=lambda each: each.run.name)
        if not own:
            continue
        abouts, shapes, parts = [], [], {}
        for result in own:
            packed = files.packed(result)
            abouts.append(json.loads(packed.pop("about").tobytes()))
            shapes.append({name: [array.dtype.name, *array.shape] for name, array in packed.items()})
            for name, array in packed.items():
                parts.setdefault(f"{name}.{array.dtype.name}", []).append(array.ravel())
        texts = zip(TEXTS, ([result.run.name for result in own], abouts, shapes), strict=True)
        members = {name: np.frombuffer(json.dumps(value).encode(), np.uint8) for name, value in texts}
        members |= {name: np.concatenate(arrays) for name, arrays in sorted(parts.items())}
        paths.append(folder / f"{study}.npz")
        try:
            archives.write(paths[-1], members, zipfile.ZIP_LZMA)
        except OSError as error:
            raise disk.disk_error(paths[-1], error) from error
    return paths


def is_superseded(before: Result, after: Result) -> bool:
    """Whether a run takes the place of one that was made before it with the settings of today: not if it ended on the
    floor, and that one still rose and was trained for longer. What looks level on the floor may rise late."""
    earlier, later = (result.evaluations["train_goal/success_rate"] for result in (before, after))
    longer = plan.still_rises(earlier) and earlier.shape[1] > later.shape[1]
    on_floor = later[:, plan.shown(later)].mean() < plan.FLOOR
    return not (longer and on_floor) or before.has_former_settings


def merged(before: Results, folders: list[Path]) -> Results:
    """These runs, with those of the folders, of which the last one counts that `is_superseded` lets in. Raises
    `UserError` for a folder that is missing or holds neither runs nor numbers."""
    found = before
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"folders = {str(folder)!r}: there is no such folder; give folders of infogoal reproduce")
        runs = folder / "runs"
        parts = [load(folder, "folders")] if has_numbers(folder) else []
        if runs.is_dir() or not parts:
            parts.append(of_folder(runs if runs.is_dir() else folder))
        require(any(parts), "folders", str(folder), "holds no finished run")
        for new in parts:
            newer = {run: one for run, one in new.items() if run not in found or is_superseded(found[run], one)}
            found = of_one_size(found | newer, "folders", str(folder))
    return found
