"""The report of a flight says what its log says, and is drawn also where the program was killed."""

import json
import os
import re

import pytest

from infogoal_jax.cli.main import main
from infogoal_jax.drone.records import NAME
from infogoal_jax.report import flight_figures

SETTINGS = {
    "event": "settings",
    "target": "mug",
    "host": "127.0.0.1",
    "simulated": True,
    "envelope": {"left": 3, "right": 3, "up": 2, "down": 1},
}
STEPS = [
    {"event": "step", "move": "right", "outcome": "made", "low": [1, 0], "high": [1, 0], "latency": 0.010},
    {"event": "step", "move": "up", "outcome": "unanswered", "low": [1, 0], "high": [1, 1], "latency": 0.030},
    {"event": "step", "move": "left", "outcome": "refused", "low": [1, 0], "high": [1, 1], "latency": 0.020},
]
TIMES = [{"event": "image"}, {"event": "state"}, {"event": "command"}, {"event": "answer", "outcome": "made"}]
END = [
    {"event": "landing", "reason": "found mug"},
    {"event": "end", "reason": "found mug", "found": True, "landed": True, "steps": 3},
]


def write_log(folder, events, last: str = "") -> None:
    """A log of these events, half a second apart."""
    lines = [json.dumps({"time": 0.5 * number, **event}) for number, event in enumerate(events)]
    (folder / NAME).write_text("\n".join([*lines, last]))


def test_a_flight_is_summarised_and_drawn(tmp_path, capsys):
    write_log(tmp_path, [{"event": "start"}, SETTINGS, *TIMES, *STEPS, *END])
    assert main(["report", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "found mug; on the ground" in printed and "3: 1 made, 1 refused, 1 unanswered" in printed
    assert "20 ms in the median, 30 ms" in printed
    assert (tmp_path / "figures" / "flight.png").stat().st_size > 10_000


def test_a_program_that_was_killed(tmp_path, capsys):
    """Its log has no end, and perhaps half a line."""
    write_log(tmp_path, [{"event": "start"}, SETTINGS, *TIMES, STEPS[0]], '{"time": 9.0, "eve')
    assert flight_figures.report_flight(tmp_path).exists()
    assert "was killed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"words\nwords\n", "line 1: .*not JSON"),
        (b"[1]\n", "line 1: .*should be an object"),
        (b"\xff\xfe\n", "line 1: .*not UTF-8"),
        (b"", "it holds no event"),
        (b'{"time": 1}\n', "event is missing"),
        (b'{"time": "late", "event": "image"}\n', "time = 'late'"),
        (b'{"time": 1, "event": "end", "reason": "r", "found": 3, "landed": true}\n', "found = 3"),
        (b'{"time": 1, "event": "step", "outcome": "lost"}\n', "outcome = 'lost': give one of 'made', 'refused'"),
    ],
    ids=lambda value: value[:20] if isinstance(value, bytes) else "",
)
def test_a_file_that_is_no_log_is_named_with_line_and_field(content, message, tmp_path, capsys):
    (tmp_path / NAME).write_bytes(content)
    assert main(["report", str(tmp_path)]) == 2
    assert re.search(f"{NAME}.*{message}", capsys.readouterr().err) and len(list(tmp_path.iterdir())) == 1


def test_a_pipe_in_its_place_is_not_read(tmp_path, capsys):
    os.mkfifo(tmp_path / NAME)
    assert main(["report", str(tmp_path)]) == 2 and "no regular file" in capsys.readouterr().err
