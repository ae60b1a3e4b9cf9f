"""A configuration as JSON values, and back; and config.json, what a run is of: written at its start, read by everything
that looks at the run."""

import dataclasses
import os
from collections.abc import Container
from pathlib import Path
from typing import Any

from infogoal_jax import checks, imports, presets
from infogoal_jax.agents.all_goals import RELABELLING, OfAllGoals
from infogoal_jax.agents.dqn import DQNConfig
from infogoal_jax.agents.hrac import HRACConfig
from infogoal_jax.agents.td3 import TD3Config, TD3Hyperparameters
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.envs.embodied_qa import EmbodiedQAConfig
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.envs.goal_task import GoalTaskConfig
from infogoal_jax.envs.named import LIBRARIES
from infogoal_jax.envs.object_manipulation import ObjectManipulationConfig
from infogoal_jax.envs.object_search import ObjectSearchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.field_types import hints_of
from infogoal_jax.files import expanded
from infogoal_jax.learners.gcb import GCBConfig
from infogoal_jax.learners.infobot import InfoBotConfig
from infogoal_jax.learners.infogoal import InfoGoalConfig, InfoGoalHyperparameters
from infogoal_jax.presets.loading import take_library
from infogoal_jax.relabelling.cher import CHERConfig
from infogoal_jax.relabelling.ghrl import GHRLConfig
from infogoal_jax.relabelling.her import HERConfig
from infogoal_jax.runs import disk
from infogoal_jax.runs.disk import Place, Record, built, decode, decode_value, parse, read_bytes

NAME = "config.json"
SWEEP = "sweep.json"
"""What the folder of a sweep holds in its place."""
GIVE_A_RUN = "give the folder of a run of `infogoal train`"
OF_A_SEARCH = "drawn"
"""What the config.json of a search has besides, its trials, and that of a run has not."""
FORMAT = 2
"""Version of the format of saved runs. Runs of another one are refused: the names of 1 were others."""
OF_HEADS = {"bounded": False, "layer_norm": False}
"""Fields of the heads of DQN and HRAC alike, as those of `ADDED`."""
ADDED: dict[type, dict[str, Any]] = {
    DQNConfig: {"head": "concatenated", "head_size": 128} | OF_HEADS,
    HRACConfig: {"critic": "concatenated", "critic_size": 128} | OF_HEADS,
    TrainConfig: {"desired_goals": "training", "bfloat16": False},
    InfoGoalConfig: {"dissimilar_by": "trajectory", "positives": "trajectory", "radius": 0.15},
    InfoGoalHyperparameters: {"beta_margin": 0.005, "beta_floor": 0.0},
    GCBConfig: {"grounded": False},
    InfoBotConfig: {"reward": "rarity"},
    HERConfig: {"skip_reached": False},
    CHERConfig: {"skip_reached": False},
    GHRLConfig: {"choice": "best"},
    OfAllGoals: {"all_goals": False, "num_goals": 0, "achieved_share": 0.5, "desired_share": 0.0, "code": "sampled"},
    ObjectManipulationConfig: {"privileged": False, "joint_range": 180.0},
    ObjectSearchConfig: {"memory": False},
    EmbodiedQAConfig: {"gathered": False},
    FetchConfig: {"held_out": "nothing"},
    GoalTaskConfig: {"dataset": ""},
    TD3Config: {"behaviour": False},
    TD3Hyperparameters: {"behaviour_alpha": 2.5},
}
"""Fields that a record of this format did not have from the beginning, each with the value that says what was done
before. It stays when a default changes. Any other field that a file lacks is refused."""
NOT_READ = Place(Path("a configuration"))
DATA = ("dataset", "text_embeddings", "goal_images", "backgrounds", "split", "questions")
"""Fields of a task that name files whose content the description of the data has a checksum of."""
FILES = {"env": DATA, "agent": ("low_level",)}
"""Fields that name files, of the parts that have them."""


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """The resolved configuration as plain values; each part with its name."""
    values = dataclasses.asdict(config)
    for kind, name in presets.names_of(config).items():
        values[kind] = {"name": name, **values[kind]}
    return {"format": FORMAT, **values}


def located(config: TrainConfig) -> TrainConfig:
    """The configuration with absolute names of files, which can be found from any folder. What is no file here, such as
    the name of shipped data, stays as it is."""
    parts = {}
    for kind, fields in FILES.items():
        part = getattr(config, kind)
        given = {name: getattr(part, name, None) for name in fields}
        paths = {name: expanded(path) for name, path in given.items() if isinstance(path, str) and path}
        found = {name: os.path.abspath(path) for name, path in paths.items() if os.path.exists(path)}
        parts[kind] = dataclasses.replace(part, **found) if found else part
    return dataclasses.replace(config, **parts)


def from_dict(values: Any, place: Place = NOT_READ) -> TrainConfig:
    """The configuration that `to_dict` made. Raises `UserError` for another format, and for fields that are missing,
    unknown or of another type or range; place: where the values were read."""
    if not isinstance(values, dict):
        raise place.refusal(f"{place.prefix.rstrip('.')} should be an object")
    found = values.get("format", 1)
    if found != FORMAT:
        raise UserError(
            f"{place.path}: {place.prefix}format = {found!r}: this version of infogoal-jax reads runs of format "
            f"{FORMAT}; use the version that wrote the run"
        )
    hints, values = hints_of(TrainConfig), with_all_goals_of_agent(with_added(TrainConfig, values))
    unknown = sorted(values.keys() - hints.keys() - {"format"})
    if unknown:
        raise place.wrong(unknown[0], values[unknown[0]], f"no such field. Known: {', '.join(hints)}")
    missing = [name for name in hints if name not in values]
    if missing:
        raise place.refusal(f"{place.prefix}{missing[0]} is missing")
    names = {kind: name_of_part(values[kind], kind, place) for kind in presets.REGISTRIES}
    task = decode_value(str, values["task"], "task", place)
    take_library(task)
    if task not in presets.registry:
        raise UserError(
            f"{place.path}: {place.prefix}task = {task!r}: no such task here; import the file that "
            f"registers it first (--import FILE). Known: {', '.join(presets.registry)}"
        )
    base = built(place, lambda: presets.load(task, **names))
    records = {
        name: decode_record(type(getattr(base, name)), without_name(values[name]), place.within(name))
        for name in (*presets.REGISTRIES, "env", "state_encoder")
    }
    records["hyper"] = hyper_of(values["hyper"], base.hyper, place.within("hyper"))
    plain = {name: decode_value(hint, values[name], name, place) for name, hint in hints.items() if name not in records}
    return built(place, lambda: TrainConfig(**plain, **records))


def with_all_goals_of_agent(values: dict[str, Any]) -> dict[str, Any]:
    """The values with what a former relabelling `all_goals` said among the agent's, and LEO's learner under its name of
    today."""
    learner, relabelled, agent = (values.get(kind) for kind in ("learner", "relabelling", "agent"))
    if isinstance(learner, dict) and learner.get("name") == "index":
        values = values | {"learner": learner | {"name": "leo"}}
    if isinstance(relabelled, dict) and relabelled.get("name") == "all_goals" and isinstance(agent, dict):
        agent = agent | without_name(relabelled) | {"all_goals": True}
        values = values | {"agent": agent, "relabelling": {"name": RELABELLING}}
    return values


def name_of_part(values: Any, kind: str, place: Place) -> str:
    """The name that a part's record has."""
    if not isinstance(values, dict) or "name" not in values:
        raise place.refusal(f"{place.prefix}{kind} should be an object with a name")
    return decode_value(str, values["name"], "name", place.within(kind))


def without_name(values: Any) -> Any:
    """The fields of a part's record."""
    return {name: value for name, value in values.items() if name != "name"} if isinstance(values, dict) else values


def decode_record(record: type[Record], values: Any, place: Place) -> Record:
    """The record of a part, from a file with all its fields, or all but those that were added since."""
    return decode(record, with_added(record, values), place, all_fields=True)


def with_added(record: type, values: Any) -> Any:
    """The values with the fields of a record, and of those that it extends, that were added since."""
    if isinstance(values, dict):
        for kind in record.__mro__:
            values = ADDED.get(kind, {}) | values
    return values


def hyper_of(values: Any, base: Hyperparameters, place: Place) -> Hyperparameters:
    """The float hyperparameters, with those of the same parts as `base` has."""
    if not isinstance(values, dict):
        raise place.refusal("config.hyper should be an object")
    inner = {
        kind: decode_record(type(getattr(base, kind)), values.get(kind), place.within(kind))
        for kind in ("learner", "agent")
    }
    own = decode_record(Hyperparameters, values | dict.fromkeys(inner), place)
    return own.replace(**inner)


@dataclasses.dataclass(frozen=True)
class Written:
    """The fields of config.json.

    data: what the dataset was, in words (a stand-in is called one).
    versions: of this package, jax, numpy and Python.
    device: its kind.
    imports: SHA-256 of each file of `--import` that it was made with, by its name.
    """

    config: Any
    seeds: list[int]
    data: str
    versions: dict[str, str]
    device: str
    imports: dict[str, str] = dataclasses.field(default_factory=dict, kw_only=True)


@dataclasses.dataclass(frozen=True)
class Description(Written):
    """What a run is of: the fields of its config.json, with its `TrainConfig`."""

    config: TrainConfig

    def values(self) -> dict[str, Any]:
        """The description as JSON values."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(Written)}
        if not self.imports:
            del fields["imports"]  # A run without them reads the same in versions that do not know the field.
        return fields | {"config": to_dict(self.config)}


def write(folder: Path, description: Description, **more: Any) -> None:
    """Write config.json, with more JSON values where a search has more to say."""
    keep_imports(folder, description.imports)
    disk.write_json(folder / NAME, description.values() | more, indent=2)


def keep_imports(folder: Path, names: Container[str]) -> None:
    """Write a copy of each file of `--import` of these names, as it was when it ran."""
    for name, content in imports.contents().items():
        if name in names:
            disk.make_folder(folder / imports.COPIES)
            disk.write_atomically(folder / imports.COPIES / name, lambda file, content=content: file.write(content))


def read(folder: Path, field: str = "run", remedy: str = GIVE_A_RUN) -> Description:
    """The description of the run in this folder. Raises `UserError`, naming the field and what to give, if there is
    none, or it is not one."""
    values, place = read_values(folder, field, remedy)
    if field in ("run", "resume") and isinstance(values, dict) and OF_A_SEARCH in values:
        given = f"{field} = {str(folder)!r}"
        raise UserError(f"{given}: is of a search, which `infogoal tune --resume` goes on with; {remedy}")
    return from_values(values, place)


def read_values(folder: Path, field: str, remedy: str) -> tuple[Any, Place]:
    """The JSON values of the config.json in this folder, and where they are. Raises `UserError` as `read` does."""
    place, given = Place(folder / NAME), f"{field} = {str(folder)!r}"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{given}: could not be read (Not a directory); {remedy}")
    if (folder / SWEEP).exists() and not place.path.exists():
        own = sorted(path.parent for path in folder.glob(f"*/{NAME}"))
        such = f", such as {own[0]}; `infogoal compare` takes all of them, {folder}/*=*/" if own else ""
        raise UserError(f"{given}: is of a sweep; give one of its runs{such}")
    missing = "holds no config.json" if folder.exists() else "there is no such folder"
    return parse(read_bytes(place, f"{given}: {missing}; {remedy}"), place), place


def made_with(files: dict[str, str], config: Any, place: Place) -> TrainConfig:
    """The configuration of what was made with these files of `--import`, {name: SHA-256}. Raises `UserError`, naming
    the file, where it cannot be read and one of them is not imported, or is another now."""
    imports.check_unchanged(files, place.path)
    needed = imports.missing(files, place.path)
    needs_files = imports.OtherImportsError(f"{place.path}: {needed}")
    try:
        made = from_dict(config, place.within("config"))
    except UserError as error:
        if needed:
            raise needs_files from error
        raise
    if needed and made.task in LIBRARIES:  # Its environment may be one that a file registers with the library.
        raise needs_files
    return made


def from_values(values: Any, place: Place) -> Description:
    """The description that these values are of, in config.json or in the header of a checkpoint."""
    written = decode(Written, values, place)
    if not written.seeds or len(set(written.seeds)) < len(written.seeds):
        raise place.wrong("seeds", written.seeds, "should be different numbers")
    if min(written.seeds) < 0 or max(written.seeds) >= checks.MOST_SEEDS:
        raise place.wrong("seeds", written.seeds, f"should lie from 0 to below {checks.MOST_SEEDS}")
    return Description(**vars(written) | {"config": made_with(written.imports, written.config, place)})
