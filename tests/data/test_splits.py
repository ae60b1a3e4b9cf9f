"""Splits of the objects into training, validation and test goals: the authors' own, and files of them. And questions
about objects: the shipped ones with their embeddings, their use as goals, and what a user's file may have wrong."""

import collections
import json
from pathlib import Path

import numpy as np
import pytest

from infogoal_jax.data import splits, text
from infogoal_jax.data.splits import AUTHORS_SPLIT, load_split
from infogoal_jax.errors import UserError
from infogoal_jax.goals import NO_USE
from infogoal_jax.stand_ins import house, shelf_objects


def test_authors_split_has_two_training_objects_a_room_and_sixteen_for_the_test():
    assert len(AUTHORS_SPLIT.train) == 8
    assert len(AUTHORS_SPLIT.test) == 16
    assert AUTHORS_SPLIT.validation == ()
    assert len(set(AUTHORS_SPLIT.objects)) == 24
    assert set(AUTHORS_SPLIT.objects) <= set(house.INSTANCE_IDS)
    rooms = [AUTHORS_SPLIT.rooms[name] for name in AUTHORS_SPLIT.train]
    assert sorted(rooms) == [0, 0, 1, 1, 2, 2, 3, 3]


def test_a_split_file_says_what_the_split_is(tmp_path):
    entries = {"cup": ("kitchen", "train"), "plate": ("living", "test"), "soap": ("kitchen", "validation")}
    path = tmp_path / "split.json"
    path.write_text(
        json.dumps({"objects": {name: {"room": room, "use": use} for name, (room, use) in entries.items()}})
    )
    split = load_split(path)
    assert (split.train, split.validation, split.test) == (("cup",), ("soap",), ("plate",))
    assert split.room_names == ("kitchen", "living")
    assert dict(split.rooms) == {"cup": 0, "plate": 1, "soap": 0}


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("{", "not valid JSON"),
        ("[]", 'give {"objects"'),
        ('{"objects": {}}', "at least one object"),
        ('{"objects": {"cup": {"room": "kitchen"}}}', "objects\\['cup'\\] = .*missing required field use; give"),
        (
            '{"objects": {"cup": {"room": "kitchen", "use": "tset"}}}',
            'use = \'tset\': .*give .*"train", "validation" or "test"',
        ),
        ('{"objects": {"cup": {"room": "", "use": "test"}}}', "room = '': "),
        (
            '{"objects": {"cup": {"room": "a", "use": "train"}, "cup": {"room": "b", "use": "test"}}}',
            "given twice: cup",
        ),
    ],
)
def test_a_split_file_that_is_wrong_is_refused(tmp_path, content, match):
    path = tmp_path / "split.json"
    path.write_text(content)
    with pytest.raises(UserError, match=match):
        load_split(path)


def test_a_split_file_that_is_missing_is_named(tmp_path):
    with pytest.raises(UserError, match="nowhere.json"):
        load_split(tmp_path / "nowhere.json")


def entry(name: str, use: str = "test", room: str = "left", **changes) -> dict:
    """An object as in a file of questions, with five questions of its own."""
    return {
        "room": room,
        "use": use,
        "questions": [f"What is {name} good for, reason {number}?" for number in range(5)],
    } | changes


def good() -> dict:
    return {
        "cup": entry("cup", "test", "right"),
        "book": entry("book", "train", "left"),
        "lamp": entry("lamp", "test", "right"),
    }


def written(folder: Path, content: object) -> Path:
    path = folder / "mine.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def shipped():
    return splits.load_questions(splits.SHIPPED_QUESTIONS)


def test_shipped_questions_are_about_the_objects_of_the_shelf_six_a_room(shipped):
    assert sorted(shipped.objects) == sorted(shelf_objects.DRAWINGS)
    assert shipped.room_names == ("upper left", "upper right", "lower left", "lower right")
    assert collections.Counter(shipped.rooms) == dict.fromkeys(range(4), 6)
    assert sorted(room for room, use in zip(shipped.rooms, shipped.uses, strict=True) if use == "train") == [0, 1, 2, 3]
    assert all(question.endswith("?") for asked in shipped.questions for question in asked)


def test_shipped_goals_are_as_many_as_in_the_paper(shipped):
    goals = shipped.goals()
    assert collections.Counter(goal.use for goal in goals) == {NO_USE: 24, 0: 4, 1: 16, 2: 80}
    assert len({text.spelling(goal.text) for goal in goals}) == len(goals)
    # Objects asked about in the test are asked about in the test only.
    assert not {goal.object for goal in goals if goal.use in (0, 1)} & {goal.object for goal in goals if goal.use == 2}


def test_every_shipped_text_has_an_embedding_of_the_official_weights(shipped):
    embeddings = text.load(splits.SHIPPED_EMBEDDINGS)
    wanted = {*shipped.objects, *(question for asked in shipped.questions for question in asked)}
    assert set(embeddings.texts) == wanted
    assert embeddings.weights_sha256 == text.load_shipped().weights_sha256


def test_questions_are_nearest_to_the_name_of_their_object(shipped):
    embeddings = text.load(splits.SHIPPED_EMBEDDINGS)
    names = text.embed_known(shipped.objects, embeddings)
    # [objects, questions, names]
    cosine = np.stack([text.embed_known(asked, embeddings) @ names.T for asked in shipped.questions])
    own = np.arange(len(names))
    # Names nearer to a question than that of its own object.
    nearer = (cosine > cosine[own, :, own][..., None]).sum(-1)
    assert (nearer == 0).mean() > 0.95
    assert nearer.max() <= 2


def test_goals_are_names_then_training_then_test_questions(tmp_path):
    asked = splits.load_questions(written(tmp_path, {"objects": good()}))
    assert asked.room_names == ("right", "left") and asked.rooms == (0, 1, 0)
    goals = asked.goals()
    assert goals[:3] == [("cup", "cup", NO_USE, 0), ("book", "book", NO_USE, 1), ("lamp", "lamp", NO_USE, 0)]
    assert [(goal.object, goal.use, goal.room) for goal in goals[3:]] == [
        ("book", 0, 1),
        *[("book", 1, 1)] * 4,
        *[("cup", 2, 0)] * 4,
        *[("lamp", 2, 0)] * 4,
    ]
    assert [goal.text for goal in goals[3:8]] == good()["book"]["questions"]
    assert [goal.text for goal in goals[8:12]] == good()["cup"]["questions"][:4]


ENTRY_MISTAKES = {
    "no dictionary": (["cup"], r"'cup'\] = \['cup'\]: Expected object, got array; give"),
    "unknown key": (entry("cup", colour="red"), r"'cup'\] = .*unknown field colour; give"),
    "missing key": ({"room": "left", "use": "test"}, r"'cup'\] = .*missing required field questions"),
    "room is a number": (entry("cup", room=3), r"'cup'\].room = 3: Expected str, got int"),
    "empty room": (entry("cup", room=" "), r"'cup'\].room = ' '"),
    "unknown use": (entry("cup", use="validation"), r"'cup'\].use = 'validation': .*give .*\"train\" or \"test\""),
    "use is a list": (entry("cup", use=["test"]), r"'cup'\].use = \['test'\]"),
    "questions are one text": (
        entry("cup", questions="What?"),
        r"'cup'\].questions = 'What\?': Expected array.*five questions",
    ),
    "four questions": (
        entry("cup", questions=entry("cup")["questions"][:4]),
        r"'cup'\].questions = .*length 5, got 4.*five",
    ),
    "a number as question": (
        entry("cup", questions=[*entry("cup")["questions"][:4], 7]),
        r"'cup'\].questions\[4\] = .*, 7\]: Expected str, got int",
    ),
    "empty question": (
        entry("cup", questions=[*entry("cup")["questions"][:4], " _ "]),
        r"'cup'\].questions\[4\].*not be empty",
    ),
    "question twice": (
        entry("cup", questions=["What?", *entry("cup")["questions"][:3], "what?  "]),
        r"questions\[4\].*'cup'\].questions\[0\]",
    ),
    "question of another": (
        entry("book"),
        r"'book'\].questions\[0\].*given before, by objects\['cup'\].questions\[0\]",
    ),
    "name as question": (
        entry("cup", questions=["Lamp", *entry("cup")["questions"][:4]]),
        r"'cup'\].questions\[0\].*by objects\['lamp'\]",
    ),
}


@pytest.mark.parametrize("mistake", ENTRY_MISTAKES)
def test_a_mistake_in_an_object_is_named(tmp_path, mistake):
    cup, message = ENTRY_MISTAKES[mistake]
    with pytest.raises(UserError, match=f"mine.json: .*{message}"):
        splits.load_questions(written(tmp_path, {"objects": good() | {"cup": cup}}))


def test_every_object_that_is_wrong_is_named_in_one_pass(tmp_path):
    wrong = {"cup": entry("cup", room=3), "lamp": ["lamp"]}
    with pytest.raises(UserError) as refused:
        splits.load_questions(written(tmp_path, {"objects": good() | wrong}))
    first, second = str(refused.value).splitlines()
    assert "mine.json: objects['cup'].room = 3" in first and "mine.json: objects['lamp'] = ['lamp']" in second


FILE_MISTAKES = {
    "not JSON": ("cup: what is it?", "not valid JSON"),
    "name twice": ('{"objects": {"cup": {}, "cup": {}}}', "given twice: cup"),
    "name in two spellings": (
        {"objects": good() | {"Cup": entry("mug")}},
        r"objects\['Cup'\].*given before, by objects\['cup'\]",
    ),
    "empty name": ({"objects": good() | {"": entry("nothing")}}, r"objects\[''\].*the name must not be empty"),
    "a list": ([], 'give {"objects"'),
    "other key": ({"objects": good(), "rooms": []}, "and nothing else"),
    "no objects": ({"objects": {}}, "at least one object"),
    "no training object": ({"objects": good() | {"book": entry("book")}}, "no object has use 'train'"),
}


@pytest.mark.parametrize("mistake", FILE_MISTAKES)
def test_a_mistake_in_the_file_is_named(tmp_path, mistake):
    content, message = FILE_MISTAKES[mistake]
    with pytest.raises(UserError, match=f"mine.json: .*{message}"):
        splits.load_questions(written(tmp_path, content))


def test_a_missing_or_unreadable_file_is_named(tmp_path):
    with pytest.raises(UserError, match="nowhere.json: No such file.*give the path"):
        splits.load_questions(tmp_path / "nowhere.json")
    (tmp_path / "mine.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="mine.json: not valid JSON"):
        splits.load_questions(tmp_path / "mine.json")
