"""A log file says that a program is being compiled, that it still is, and how long everything took."""

import time

import hand_made
import pytest

from infogoal_jax.train import progress
from infogoal_jax.train.host import Progress
from infogoal_jax.train.listeners import make_listeners


def test_a_log_says_what_takes_long(monkeypatch, capsys):
    monkeypatch.setattr(progress, "SIGN_OF_LIFE", 0.05)
    with progress.progress_line("fetch_reach infogoal x 2", 4) as line:
        line.compiling()
        time.sleep(0.3)
        line.advance(2, "train 0.50")
        before = capsys.readouterr().out.splitlines()
        time.sleep(0.2)
        line.advance(4, "train 0.75")
    assert before[0] == "fetch_reach infogoal x 2: compiling, some minutes the first time"
    assert len(before) > 2 and all(
        words == "fetch_reach infogoal x 2: still compiling, 0:00:00" for words in before[1:-1]
    )
    assert before[-1] == "epoch 2/4  0:00:00  train 0.50"
    assert capsys.readouterr().out == "epoch 4/4  0:00:00  train 0.75\n"


@pytest.mark.parametrize(("rate", "shown"), [(1000.0, True), (0.0, False)])
def test_who_learns_offline_has_no_rate_of_steps(rate, shown, tmp_path, capsys):
    row = {"seed": 0, "epoch": 2, "train_goal/success_rate": 0.5}
    with make_listeners(tmp_path, hand_made.config(), 1) as listeners:
        for listen in listeners.progress:
            listen(Progress(2, 4, 1.0, 1.0, rate, 7.0, [row], [row]))
    printed = capsys.readouterr().out
    assert ("1,000 env steps/s" in printed) == ("env steps" in printed) == shown and "7 updates/s" in printed
