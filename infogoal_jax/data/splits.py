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
from typing import NamedTuple

from infogoal_jax.data import text
from infogoal_jax.errors import UserError, require
from infogoal_jax.files import from_json, read_text
from infogoal_jax.goal_uses import NO_USE, TEST, TRAINING, USES, VALIDATION

SHIPPED_QUESTIONS = Path(__file__).parent / "files" / "shelf" / "questions.json"
SHIPPED_EMBEDDINGS = SHIPPED_QUESTIONS.with_name("embeddings.npz")

QUESTIONS_PER_OBJECT = 5
QUESTIONS_OF_TEST_OBJECT = 4  # Sec. V-B.1: 20 test objects with four questions each.

_OBJECT_USES = ("train", "test")
_FORM = '{"objects": {name: {"room": ..., "use": "train" or "test", "questions": [five questions]}}}'


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
        return from_json(read_text(path), object_pairs_hook=without_repeats)
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

    room_names: of R rooms. objects: N names. rooms: N positions in `room_names`. uses: N of "train" and "test".
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
    content = read_json("questions", path, f"; it must be {_FORM}")
    entries = content.get("objects") if isinstance(content, dict) and set(content) == {"objects"} else None
    if not isinstance(entries, dict) or not entries:
        raise UserError(f"questions {path}: wants {_FORM} and nothing else, with at least one object")
    owners = {}
    for name in entries:
        _claim(owners, name, f"questions {path}: objects[{name!r}]", "the name")
    for name, entry in entries.items():
        _check_entry(f"questions {path}: objects[{name!r}]", entry, owners)
    if all(entry["use"] != "train" for entry in entries.values()):
        raise UserError(
            f"questions {path}: no object has use 'train'; at least one must, or there is nothing to train on"
        )
    room_names = tuple(dict.fromkeys(entry["room"] for entry in entries.values()))
    return Questions(
        room_names=room_names,
        objects=tuple(entries),
        rooms=tuple(room_names.index(entry["room"]) for entry in entries.values()),
        uses=tuple(entry["use"] for entry in entries.values()),
        questions=tuple(tuple(entry["questions"]) for entry in entries.values()),
    )


def _check_entry(field: str, entry: object, owners: dict[str, str]) -> None:
    """Raises UserError unless this is a room, a use and five questions that no one has asked yet. owners: spelling ->
    where it was given."""
    keys = ("room", "use", "questions")
    if not isinstance(entry, dict) or set(entry) != set(keys):
        given = sorted(entry) if isinstance(entry, dict) else entry
        raise UserError(f'{field} has {given!r}; it must have exactly "room", "use" and "questions"')
    room, use, questions = (entry[key] for key in keys)
    require(isinstance(room, str) and room.strip() != "", f"{field}: room", room, "it must be the name of a room")
    require(use in _OBJECT_USES, f"{field}: use", use, f"it must be one of {', '.join(_OBJECT_USES)}")
    is_list = isinstance(questions, list) and len(questions) == QUESTIONS_PER_OBJECT
    require(is_list, f"{field}: questions", questions, f"it must be a list of {QUESTIONS_PER_OBJECT} questions")
    for position, question in enumerate(questions):
        _claim(owners, question, f"{field}: questions[{position}]", "the question")


def _claim(owners: dict[str, str], given: object, field: str, kind: str) -> None:
    """Notes that this text is given here. Raises UserError where it is no text, or empty, or given before."""
    require(isinstance(given, str) and text.spelling(given) != "", field, given, f"{kind} must be a text and not empty")
    first = owners.setdefault(text.spelling(given), field)
    require(
        first == field, field, given, f"given before, by {first.split(': ', 1)[1]}; reword or remove one of the two"
    )
