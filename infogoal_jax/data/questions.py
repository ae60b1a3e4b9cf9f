"""Questions about objects, the goals of embodied question answering (paper, Sec. V-A.4 and V-B.1).

Every object has the questions that a language model printed for "5 questions about [object]". A question is answered
where its object is in view. The names of all objects are known while training; questions are commanded of a few objects
only, and those of the others are the test.
"""

import dataclasses
import os
from pathlib import Path
from typing import NamedTuple

from infogoal_jax.data import text
from infogoal_jax.data.splits import read_json
from infogoal_jax.errors import UserError, require
from infogoal_jax.goal_uses import NO_USE, USES

SHIPPED = Path(__file__).parent / "files" / "shelf" / "questions.json"
SHIPPED_EMBEDDINGS = SHIPPED.with_name("embeddings.npz")

QUESTIONS_PER_OBJECT = 5
QUESTIONS_OF_TEST_OBJECT = 4  # Sec. V-B.1: 20 test objects with four questions each.

_TRAIN, _VALIDATION, _TEST = (USES.index(use) for use in ("train", "validation", "test"))
_OBJECT_USES = ("train", "test")
_FORM = '{"objects": {name: {"room": ..., "use": "train" or "test", "questions": [five questions]}}}'


class AskedGoal(NamedTuple):
    """A goal given as text: the name of an object or a question about it."""

    text: str
    object: str
    use: int
    """Position in `goal_uses.USES`, or `goal_uses.NO_USE`."""
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
        """Names of all objects (`NO_USE`: known while training, never commanded), then questions of training objects,
        then of test objects.

        Of a training object the first question is commanded while training and the other four are for validation; of a
        test object four are for the test (Sec. V-B.1).
        """
        objects = list(zip(self.objects, self.rooms, self.uses, self.questions, strict=True))
        names = [AskedGoal(name, name, NO_USE, room) for name, room, _, _ in objects]
        train = [
            AskedGoal(question, name, _VALIDATION if position else _TRAIN, room)
            for name, room, use, questions in objects
            if use == "train"
            for position, question in enumerate(questions)
        ]
        test = [
            AskedGoal(question, name, _TEST, room)
            for name, room, use, questions in objects
            if use == "test"
            for question in questions[:QUESTIONS_OF_TEST_OBJECT]
        ]
        return names + train + test


def load(path: str | os.PathLike) -> Questions:
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
