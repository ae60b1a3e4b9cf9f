"""What was chosen, and what it saw: the list leaves out no value of a preset and names none that is not there."""

from infogoal_paper import choices


def test_every_value_of_a_preset_belongs_to_a_choice_and_every_choice_has_values():
    """A new value in a preset makes `chosen` fail until the list says what it saw."""
    found = choices.chosen()
    assert all(found.values()), [choice.words for choice, own in found.items() if not own]
    assert sum(map(len, found.values())) == len(list(choices.values()))


def test_a_choice_that_saw_test_goals_or_what_a_table_shows_is_not_clean():
    for choice in choices.CHOICES:
        saw = choice.by == choices.TEST or "shown" in choice.on or choice.tries == choices.SOME
        assert choice.clean is not saw, choice.words


def test_the_table_has_those_that_are_not_clean_and_all_when_asked():
    short, every = choices.table().splitlines(), choices.table(every=True).splitlines()
    unclean = sum(not choice.clean for choice in choices.CHOICES)
    assert len(short) == 2 + unclean and len(every) == 2 + len(choices.CHOICES)
