"""config.json: what a run is of. Written at its start, read by everything that looks at the run."""

import dataclasses
from pathlib import Path
from typing import Any

from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError
from infogoal_jax.runs import disk
from infogoal_jax.runs.configuration import from_dict, to_dict
from infogoal_jax.runs.decoding import Place, decode, parse, read_bytes

NAME = "config.json"
MOST_SEEDS = 2**32


@dataclasses.dataclass(frozen=True)
class Written:
    """The fields of config.json."""

    config: dict[str, Any]
    seeds: list[int]
    data: str
    versions: dict[str, str]
    device: str


@dataclasses.dataclass(frozen=True)
class Description:
    """What a run is of. data: what the dataset was, in words (a stand-in is called one); versions: of this package,
    jax, numpy and Python; device: its kind."""

    config: TrainConfig
    seeds: list[int]
    data: str
    versions: dict[str, str]
    device: str

    def values(self) -> dict[str, Any]:
        """The description as JSON values."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(Written)}
        return fields | {"config": to_dict(self.config)}


def write(folder: Path, description: Description, **more: Any) -> None:
    """Write config.json, with more JSON values where a search has more to say."""
    disk.write_json(folder / NAME, description.values() | more, indent=2)


def read(folder: Path) -> Description:
    """The description of the run in this folder. Raises `UserError` if there is none, or it is not one."""
    place = Place(folder / NAME)
    missing = f"run = {str(folder)!r}: holds no config.json; give the folder of a run of `infogoal train`"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"run = {str(folder)!r}: could not be read (Not a directory); give the folder of a run")
    return from_values(parse(read_bytes(place, missing), place), place)


def from_values(values: Any, place: Place) -> Description:
    """The description that these values are of, in config.json or in the header of a checkpoint."""
    written = decode(Written, values, place)
    if not written.seeds or len(set(written.seeds)) < len(written.seeds):
        raise place.wrong("seeds", written.seeds, "should be different numbers")
    if min(written.seeds) < 0 or max(written.seeds) >= MOST_SEEDS:
        raise place.wrong("seeds", written.seeds, f"should lie from 0 to below {MOST_SEEDS}")
    config = from_dict(written.config, place.within("config"))
    return Description(config, written.seeds, written.data, written.versions, written.device)
