"""Which goals of a search task are for training, for validation and for the test: objects, and questions about objects.

Objects of object search: the paper (section V, "Train-Test Split") draws two training objects a room and leaves the
others for the test; AUTHORS_SPLIT is the draw that the authors' site shows. Other splits come from a JSON file.

Questions, the goals of embodied question answering (Sec. V-A.4 and V-B.1): every object has those that a language model
printed for "5 questions about [object]". A question is answered where its object is in view. The names of all objects
are known while training; the questions about a few objects are training goals, and those about the others are the test.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from infogoal_jax.data import text
from infogoal_jax.errors import UserError, require, shown
from infogoal_jax.files import from_json, read_text
from infogoal_jax.goal_uses import NO_USE, TEST, TRAINING, USES, VALIDATION

SHIPPED_QUESTIONS = Path(__file__).parent / "files" / "shelf" / "questions.json"
SHIPPED_EMBEDDINGS = SHIPPED_QUESTIONS.with_name("embeddings.npz")

QUESTIONS_OF_TEST_OBJECT = 4  # Sec. V-B.1: 20 test objects with four questions each.

_FORM = '{"room": ..., "use": "train" or "test", "questions": [five questions]}'
Room = Annotated[str, msgspec.Meta(pattern=r"\S")]


class Placed(msgspec.Struct, forbid_unknown_fields=True):
    """An object of a file of a split."""

    room: Room
    use: Literal["train", "validation", "test"]


class Asked(msgspec.Struct, forbid_unknown_fields=True):
    """An object of a file of questions."""

    room: Room
    use: Literal["train", "test"]
    questions: tuple[str, str, str, str, str]


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

    Raises UserError, which names every entry that is wrong, when the file is not like that or has no training object.
    """
    objects = read_objects("split", path, Placed, '{"room": ..., "use": "train", "validation" or "test"}')
    return make_split({name: (entry.room, entry.use) for name, entry in objects.items()})


def read_objects(what: str, path: str | os.PathLike, record: type, form: str) -> dict[str, Any]:
    """The objects of a JSON file {"objects": {name: record}}, of which one at least is for training. Raises UserError,
    which begins with what the file is and where. form: of a record, in words."""
    file, form = f"{what} {path}", f'{{"objects": {{name: {form}}}}}'
    try:
        content = from_json(read_text(path), object_pairs_hook=without_repeats)
    except OSError as error:
        raise UserError(f"{file}: {error.strerror or error}; give the path of a readable JSON file") from error
    except ValueError as error:
        raise UserError(f"{file}: not valid JSON ({error}); give {form}") from error
    entries = content["objects"] if isinstance(content, dict) and [*content] == ["objects"] else None
    if not isinstance(entries, dict) or not entries:
        raise UserError(f"{file}: give {form} and nothing else, with at least one object")
    objects, faults = {}, []
    for name, entry in entries.items():
        try:
            objects[name] = msgspec.convert(entry, record)
        except msgspec.ValidationError as error:
            problem, _, field = str(error).replace("`", "").partition(" - at $")
            value = entry[field[1:].partition("[")[0]] if field else entry
            faults.append(f"{file}: objects[{name!r}]{field} = {shown(value)}: {problem}; give {form}")
    if faults:
        raise UserError("\n".join(faults))
    if all(entry.use != "train" for entry in objects.values()):
        raise UserError(f"{file}: no object has use 'train'; at least one must, or there is nothing to train on")
    return objects


def without_repeats(pairs: list[tuple[str, object]]) -> dict:
    """json keeps the last of two equal keys silently; a name given twice is a mistake here."""
    entries = dict(pairs)
    if len(entries) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"given twice: {', '.join(sorted({name for name in names if names.count(name) > 1}))}")
    return entries


class AskedGoal(NamedTuple):
    """A goal given as text: the name of an object or a question about it."""

    text: str
    object: str
    use: int
    """Position in `USES`, or `NO_USE`."""
    room: int
    """Position in `Questions.room_names`."""


@dataclasses.dataclass(frozen=True)
class Questions:
    """N objects, each with its room, its use and five questions; all in the order of the file.

    room_names: of R rooms.
    objects: N names.
    rooms: N positions in `room_names`.
    uses: N of "train" and "test".
    questions: N times five texts.
    """

    room_names: tuple[str, ...]
    objects: tuple[str, ...]
    rooms: tuple[int, ...]
    uses: tuple[str, ...]
    questions: tuple[tuple[str, ...], ...]

    def goals(self) -> list[AskedGoal]:
        """Names of all objects (`NO_USE`: known while training, never desired), then questions about training objects,
        then about test objects.

        Of a training object the first question is a training goal and the other four are for validation; of a
        test object four are for the test (Sec. V-B.1).
        """
        objects = list(zip(self.objects, self.rooms, self.uses, self.questions, strict=True))
        names = [AskedGoal(name, name, NO_USE, room) for name, room, _, _ in objects]
        train = [
            AskedGoal(question, name, VALIDATION if position else TRAINING, room)
            for name, room, use, questions in objects
            if use == "train"
            for position, question in enumerate(questions)
        ]
        test = [
            AskedGoal(question, name, TEST, room)
            for name, room, use, questions in objects
            if use == "test"
            for question in questions[:QUESTIONS_OF_TEST_OBJECT]
        ]
        return names + train + test


def load_questions(path: str | os.PathLike) -> Questions:
    """Questions from a JSON file {"objects": {name: {"room": "upper left", "use": "train" | "test", "questions": [five
    questions]}}}.

    Raises UserError, which names the file, the object and the field, for a file that is not like that, has no training
    object, or gives a text twice: two texts are the same if the sentence encoder cannot tell them apart
    (`text.spelling`).
    """
    objects = read_objects("questions", path, Asked, _FORM)
    owners: dict[str, str] = {}
    for name in objects:
        _claim(owners, name, f"questions {path}: objects[{name!r}]", "the name")
    for name, entry in objects.items():
        for position, question in enumerate(entry.questions):
            _claim(owners, question, f"questions {path}: objects[{name!r}].questions[{position}]", "the question")
    room_names = tuple(dict.fromkeys(entry.room for entry in objects.values()))
    return Questions(
        room_names=room_names,
        objects=tuple(objects),
        rooms=tuple(room_names.index(entry.room) for entry in objects.values()),
        uses=tuple(entry.use for entry in objects.values()),
        questions=tuple(entry.questions for entry in objects.values()),
    )


def _claim(owners: dict[str, str], given: str, field: str, kind: str) -> None:
    """Notes that this text is given here. Raises UserError where it is empty, or given before. owners: spelling ->
    where it was given."""
    require(text.spelling(given) != "", field, given, f"{kind} must not be empty")
    first = owners.setdefault(text.spelling(given), field)
    require(
        first == field, field, given, f"given before, by {first.split(': ', 1)[1]}; reword or remove one of the two"
    )
