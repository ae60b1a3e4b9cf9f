"""The envelope: which moves are allowed, and what is known of the place after answers that did not come."""

import itertools

import numpy as np
import pytest

from infogoal_jax.drone.envelope import MOVES, Envelope, Whereabouts, allowed
from infogoal_jax.errors import UserError

NAMES = tuple(MOVES)
SMALL = Envelope(left=1, right=2, up=1, down=0)


def possible(envelope: Envelope, answers) -> set[tuple[int, int]]:
    """Every place at which the drone may be after moves with these answers, each allowed when it was made."""
    known, places = Whereabouts(), {(0, 0)}
    for choice, answer in answers:
        legal = np.flatnonzero(allowed(envelope, known, NAMES))
        if not len(legal):
            break
        move = NAMES[legal[choice % len(legal)]]
        moved = {(x + MOVES[move][0], y + MOVES[move][1]) for x, y in places}
        places = {"made": moved, "refused": places, "unanswered": places | moved}[answer]
        known = known.after(move, answer)
        assert all(known.low[0] <= x <= known.high[0] and known.low[1] <= y <= known.high[1] for x, y in places)
    return places


def test_no_sequence_of_answers_leads_outside():
    """All sequences of three moves with all answers, and long ones at random."""
    one = list(itertools.product(range(4), ("made", "refused", "unanswered")))
    random = np.random.default_rng(0)
    long = [[one[index] for index in random.integers(len(one), size=30)] for _ in range(200)]
    for answers in [*itertools.product(one, repeat=3), *long]:
        for x, y in possible(SMALL, answers):
            assert -SMALL.left <= x <= SMALL.right and -SMALL.down <= y <= SMALL.up


def test_moves_at_the_edge():
    at_edge = Whereabouts((2, 0), (2, 0))
    assert dict(zip(NAMES, allowed(SMALL, at_edge, NAMES), strict=True)) == {
        "left": True,
        "right": False,
        "up": True,
        "down": False,
    }


def test_nothing_leads_down_onto_what_is_below():
    roomy = Envelope(3, 3, 3, 3)
    assert allowed(roomy, Whereabouts(), ("down",), below=80)[0]
    assert not allowed(roomy, Whereabouts(), ("down",), below=50)[0]
    assert allowed(roomy, Whereabouts(), ("left",), below=50)[0]


def test_negative_steps_are_refused():
    with pytest.raises(UserError, match="up = -1"):
        Envelope(up=-1).check()
