"""Which objects of a search task are commanded in training, in validation and in the test, and which room each is in.

The paper (section V, "Train-Test Split") draws two training objects a room and leaves the others for the test;
AUTHORS_SPLIT is the draw that the authors' site shows. Other splits come from a JSON file.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping

from infogoal_jax.data.archives import regular
from infogoal_jax.errors import UserError
from infogoal_jax.goal_uses import USES


@dataclasses.dataclass(frozen=True)
class Split:
    """Objects by use. `rooms` maps every object to the index of its room in `room_names`."""

    room_names: tuple[str, ...]
    rooms: Mapping[str, int] = dataclasses.field(hash=False)
    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]

    @property
    def objects(self) -> tuple[str, ...]:
        """Every object: training first, then validation, then test."""
        return self.train + self.validation + self.test


def make_split(objects: Mapping[str, tuple[str, str]]) -> Split:
    """Split from name -> (room, use); rooms and objects keep the order in which they stand."""
    room_names = tuple(dict.fromkeys(room for room, _ in objects.values()))
    by_use = {use: tuple(name for name, (_, its_use) in objects.items() if its_use == use) for use in USES}
    return Split(room_names, {name: room_names.index(room) for name, (room, _) in objects.items()}, **by_use)


_AUTHORS = {
    "dining": (
        ("nature_valley_sweet_and_salty_nut_cashew", "nature_valley_sweet_and_salty_nut_peanut"),
        (
            "paper_plate",
            "cholula_chipotle_hot_sauce",
            "crystal_hot_sauce",
            "honey_bunches_of_oats_honey_roasted",
            "nature_valley_granola_thins_dark_chocolate",
            "tapatio_hot_sauce",
        ),
    ),
    "kitchen": (
        ("nutrigrain_harvest_blueberry_bliss", "aunt_jemima_original_syrup"),
        (
            "honey_bunches_of_oats_with_almonds",
            "mahatma_rice",
            "quaker_chewy_low_fat_chocolate_chunk",
            "softsoap_clear",
            "nature_valley_sweet_and_salty_nut_roasted_mix_nut",
        ),
    ),
    "living": (
        ("coca_cola_glass_bottle", "spongebob_squarepants_fruit_snaks"),
        ("hersheys_bar", "nature_valley_sweet_and_salty_nut_almond"),
    ),
    "bathroom": (
        ("softsoap_gold", "vo5_tea_therapy_healthful_green_tea_smoothing_shampoo"),
        ("advil_liqui_gels", "listerine_green", "pepto_bismol"),
    ),
}

AUTHORS_SPLIT = make_split(
    {
        name: (room, use)
        for room, (train, test) in _AUTHORS.items()
        for use, names in (("train", train), ("test", test))
        for name in names
    }
)


def load_split(path: str | os.PathLike) -> Split:
    """Split from a JSON file {"objects": {name: {"room": "kitchen", "use": "train" | "validation" | "test"}}}.

    Raises UserError, which names the entry, when the file is not like that or has no training object.
    """
    content = read_json("split", path)
    entries = content.get("objects") if isinstance(content, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise UserError(
            f'split {path}: wants {{"objects": {{name: {{"room": ..., "use": ...}}}}}} with at least one object'
        )
    objects = {}
    for name, entry in entries.items():
        field = f"split {path}: objects[{name!r}]"
        if not isinstance(entry, dict) or set(entry) != {"room", "use"}:
            raise UserError(f'{field} is {entry!r}; it must have exactly "room" and "use"')
        if not isinstance(entry["room"], str) or not entry["room"]:
            raise UserError(f"{field}: room is {entry['room']!r}; it must be the name of a room")
        if entry["use"] not in USES:
            raise UserError(f"{field}: use is {entry['use']!r}; it must be one of {', '.join(USES)}")
        objects[name] = (entry["room"], entry["use"])
    split = make_split(objects)
    if not split.train:
        raise UserError(f"split {path}: no object has use 'train'; at least one must")
    return split


def read_json(what: str, path: str | os.PathLike, remedy: str = "") -> object:
    """The content of a JSON file in which no name is given twice. Raises UserError, which begins with what the file is
    and where."""
    try:
        with open(regular(path), encoding="utf-8") as file:
            return json.load(file, object_pairs_hook=without_repeats)
    except OSError as error:
        raise UserError(f"{what} {path}: {error.strerror or error}; give the path of a readable JSON file") from error
    except ValueError as error:
        raise UserError(f"{what} {path}: not valid JSON ({error}){remedy}") from error


def without_repeats(pairs: list[tuple[str, object]]) -> dict:
    """json keeps the last of two equal keys silently; a name given twice is a mistake here."""
    entries = dict(pairs)
    if len(entries) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"given twice: {', '.join(sorted({name for name in names if names.count(name) > 1}))}")
    return entries
