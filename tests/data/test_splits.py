"""Splits of the objects into training, validation and test goals: the authors' own, and files of them."""

import json

import pytest

from infogoal_jax.data.splits import AUTHORS_SPLIT, load_split
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import house


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
        ("[]", "wants"),
        ('{"objects": {}}', "at least one object"),
        ('{"objects": {"cup": {"room": "kitchen"}}}', "objects\\['cup'\\].*exactly"),
        ('{"objects": {"cup": {"room": "kitchen", "use": "tset"}}}', "use is 'tset'.*train, validation, test"),
        ('{"objects": {"cup": {"room": "", "use": "test"}}}', "room is ''"),
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
