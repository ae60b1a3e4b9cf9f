"""The learner that docs/own_learner.md makes is complete, short, and trains as it says."""

import hand_made
import numpy as np
import pytest
from pages import block_of, in_hand_made_rooms, lines_of, run

import infogoal_jax
from infogoal_jax import learners, presets

SMALL = {"num_epochs": 3, "epochs_per_evaluation": 3, "updates_per_epoch": 40, "batch_size": 16, "evaluation_starts": 1}


@pytest.fixture(scope="module")
def block() -> str:
    """The page's one block of Python."""
    return block_of("own_learner.md")


@pytest.fixture(scope="module")
def script(block) -> dict:
    """The names that the block leaves behind, run on the hand-made rooms instead of a house, with nothing else
    changed."""
    with run(block, "mine", learners.registry, prepare=in_hand_made_rooms(**SMALL)) as names:
        yield names


def test_it_takes_at_most_forty_lines(block):
    assert lines_of(block) <= 40


def test_its_loss_is_reported_under_its_name_and_falls(script):
    pull, floor = (np.asarray(script["result"].epochs[f"mine/{name}"]) for name in ("pull", "floor"))
    assert np.isfinite(pull).all() and pull.shape == (SMALL["num_epochs"],)
    assert (pull + floor)[-1] < 0.1 * (pull + floor)[0]


def test_goals_of_one_room_come_to_lie_together(script):
    """Goals in view together are pulled together; the floor keeps the rooms apart. Under the agent's loss alone they
    lie about equally far."""
    result, train, config = script["result"], script["train"], script["config"]
    assert presets.names_of(config)["learner"] == train.parts.name == "mine"
    codes = np.asarray(
        script["make"](script["MineConfig"]()).encode(result.params["goal"], train.env.goals.inputs).mean
    )
    room = np.asarray(train.env.goals.regions)
    distance = np.linalg.norm(codes[:, None] - codes[None], axis=-1)
    same = room[:, None] == room[None]
    within, between = distance[same & ~np.eye(len(room), dtype=bool)], distance[~same]
    assert within.mean() < 0.1 * between.mean()


def test_a_window_that_makes_no_sense_is_refused(script):
    with pytest.raises(infogoal_jax.UserError, match="learner.window"):
        hand_made.config("none", learner=script["MineConfig"](window=-1))
