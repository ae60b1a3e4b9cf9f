"""Before the take-off: questions, policies, libraries and ports that cannot be used are refused. And what a flight
leaves behind: recordings that `infogoal data import` takes, and the policy that explores."""

import json
import os
import signal
import socket
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from infogoal_drone import link, mission
from infogoal_drone.envelope import MOVES, Whereabouts
from infogoal_drone.records import TABLE, Explorer, Recorder
from infogoal_drone.vision import Picture
from infogoal_jax.cli.main import main
from infogoal_jax.data import frames, frames_import, splits, text
from infogoal_jax.errors import UserError
from infogoal_jax.policy_file import ExportedPolicy

sys.path.insert(0, str(ROOT / "benchmarks" / "fidelity"))
import drone_faults as faults


@pytest.fixture
def policy(tmp_path) -> ExportedPolicy:
    """A policy that knows one question."""
    return ExportedPolicy(faults.write_policy(tmp_path / "policy.npz", objects=["mug"]))


def test_a_question_of_the_policy(policy):
    """Case and white space make no difference."""
    asked = mission.read_question(policy, f" {faults.QUESTION.upper()}")
    assert asked.object == "mug"
    np.testing.assert_array_equal(asked.goal, policy.goals[0])


def test_a_question_of_the_shipped_embeddings(policy):
    shipped = text.load(splits.SHIPPED_EMBEDDINGS)
    asked = mission.read_question(policy, shipped.texts[0], "mug", str(splits.SHIPPED_EMBEDDINGS))
    np.testing.assert_allclose(asked.goal, shipped.vectors[0] * np.sqrt(384), rtol=1e-6)


def test_a_question_without_an_object(policy):
    with pytest.raises(UserError, match="object"):
        mission.read_question(policy, "What is this?")


def test_a_question_that_cannot_be_embedded(policy, monkeypatch):
    from infogoal_jax.data import sentence_encoder

    def missing():
        raise UserError("no weights")

    monkeypatch.setattr(sentence_encoder, "load_encoder", missing)
    with pytest.raises(UserError, match="no embedding of the text") as refused:
        mission.read_question(policy, "Where did I leave my keys?", "keys")
    assert "no weights" in str(refused.value) and "infogoal data embed" in str(refused.value)
    assert "give --embeddings my_embeddings.npz" in str(refused.value)


@pytest.mark.parametrize(
    "flags", ["fly policy.npz --question Where? --simulated", "data import a b --out c.npz --size"]
)
@pytest.mark.parametrize(
    ("words", "problem"), [("48", "too few values follow; give 2 whole numbers"), ("48 x", "= '48 x': give 2 whole")]
)
def test_two_numbers_are_asked_for_in_words(flags, words, problem, capsys):
    assert main([*flags.split(), *words.split()]) == 2
    printed = capsys.readouterr().err
    assert problem in printed and printed.count("\n") == 1


def test_policies_that_cannot_fly(tmp_path):
    (tmp_path / "words.npz").write_text("words")
    os.mkfifo(tmp_path / "pipe.npz")
    whole = faults.write_policy(tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    np.savez(tmp_path / "list.npz", about=np.array("[]"), program=np.array("5"))
    np.savez(tmp_path / "few.npz", about=np.array('{"actions": 3}'), program=np.array('{"constants": 0}'))
    members = dict(np.load(tmp_path / "whole.npz"))
    members["program"] = np.array(str(members["program"]).replace("outputs", "output"))
    np.savez(tmp_path / "earlier.npz", **members)
    paths = [tmp_path / f"{name}.npz" for name in ("words", "nothing", "pipe", "cut", "list", "few", "earlier")]
    for path in (*paths, splits.SHIPPED_EMBEDDINGS):
        with pytest.raises(UserError, match="no file of `infogoal export`"):
            mission.load_policy(str(path))
    with pytest.raises(UserError, match="cannot fly"):
        grey = faults.write_policy(tmp_path / "grey.npz")
        members = dict(np.load(grey))
        members["program"] = np.array(str(members["program"]).replace("64, 3]", "64, 1]"))
        np.savez(grey, **members)
        mission.load_policy(str(grey))


def test_without_the_libraries(tmp_path, monkeypatch, capsys):
    """The refusal says what to install; nothing is started."""
    monkeypatch.setitem(sys.modules, "djitellopy", None)
    policy = faults.write_policy(tmp_path / "policy.npz")
    words = ["fly", str(policy), "--question", faults.QUESTION, "--simulate", "--out", str(tmp_path / "flight")]
    assert main(words) == 2
    assert "pip install" in capsys.readouterr().err
    assert not (tmp_path / "flight").exists()


def test_no_take_off_without_a_yes(tmp_path, monkeypatch, capsys):
    policy = faults.write_policy(tmp_path / "policy.npz")
    monkeypatch.setattr("builtins.input", lambda prompt: "no")
    monkeypatch.setattr(mission, "real_detector", lambda weights, target: None)
    words = ["fly", str(policy), "--question", faults.QUESTION, "--out", str(tmp_path / "flight")]
    assert main([*words, "--ports", *map(str, faults.free_ports())]) == 2
    printed = capsys.readouterr()
    assert "Before the propellers turn" in printed.out and "no take-off" in printed.err


REFUSED = {
    "steps": ("--steps=0", "--simulate"),
    "battery_floor": ("--battery-floor=5", "--simulate"),
    "confidence": ("--confidence=2", "--simulate"),
    "battery_floor = 91": ("--battery-floor=91", "--simulate"),
    "left": ("--left=-1", "--simulate"),
    "left = 20000": ("--left=20000", "--simulate"),
    "start = (99, 0)": ("--start", "99", "0", "--simulate"),
    "seed = -1": ("--seed=-1", "--simulate"),
    "speed": ("--speed=2",),
    "speed = inf": ("--speed=inf", "--simulate"),
    "speed = 0.01": ("--speed=0.01", "--simulate"),
    "simulated": ("--simulated", "1", "2"),
    "simulated = (99999, 5)": ("--simulated", "99999", "5", "--simulate"),
    "weights": ("--weights=best.pt", "--simulate"),
    "weights = ''": (),
    "host": ("--host=drone.local", "--yes"),
    "ports": ("--ports", "1", "2", "70000", "--simulate"),
    "Did you mean 'soccer ball'": ("--object=soccerball", "--simulate"),
}


@pytest.mark.parametrize("words", REFUSED)
def test_settings_that_cannot_be_flown_are_refused_before_anybody_is_asked(tmp_path, monkeypatch, capsys, words):
    monkeypatch.setattr("builtins.input", lambda prompt: pytest.fail("asked for a take-off"))
    policy = faults.write_policy(tmp_path / "policy.npz")
    out = tmp_path / "flight"
    assert main(["fly", str(policy), "--question", faults.QUESTION, "--out", str(out), *REFUSED[words]]) == 2
    assert words in capsys.readouterr().err and not out.exists()


def test_a_policy_flies_before_the_shelf_that_it_learned_with(tmp_path, monkeypatch):
    """A file of an earlier version says nothing of gathered objects: they were not."""
    given = []

    def run_mission(folder, flown, target, settings, *more):
        given.append((settings.shelf_seed, settings.gathered))
        return types.SimpleNamespace(reason="", steps=0, landed=True, found=True)

    monkeypatch.setattr(mission, "run_mission", run_mission)
    policy = faults.write_policy(tmp_path / "policy.npz")
    members = dict(np.load(policy))
    about = json.loads(str(members["about"])) | {"generator_seed": 5, "gathered": True}
    np.savez(tmp_path / "gathered.npz", **members | {"about": np.array(json.dumps(about))})
    for file in (policy, tmp_path / "gathered.npz"):
        words = ["fly", str(file), "--question", faults.QUESTION, "--simulate", "--out", str(tmp_path / file.stem)]
        assert main(words) == 0
    assert given == [(0, False), (5, True)]


def test_what_is_drawn_by_one_seed_is_not_the_same_twice(policy):
    """The drift of the simulated drone, the noise of a policy's code, and the moves that explore."""
    policy.about["samples_code"], noise = True, []
    flown = mission.flown_policy(policy, mission.Asked(policy.goals[0], "mug"), 7)
    policy.act = lambda picture, goal, mask, code: noise.append(code) or 0
    flown.policy(np.zeros((48, 64, 3), np.uint8), np.ones(4, bool))
    drawn = [noise[0][0], *(np.random.default_rng([7, stream]).normal() for stream in range(3))]
    assert len({round(float(value), 6) for value in drawn}) == 4
    explored = Explorer(7).random.normal()
    assert not np.isclose(explored, drawn).any()


def test_a_real_drone_needs_a_detector():
    with pytest.raises(UserError, match="weights"):
        mission.real_detector("", "mug")
    assert mission.real_detector("", "")(np.zeros((4, 4, 3), np.uint8)) == []


def test_a_port_that_is_taken():
    """By another program that flies the drone."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        with pytest.raises(UserError, match="another program"):
            link.check_ports((other.getsockname()[1],))


@pytest.mark.parametrize("words", [["--help"], ["fly", "--help"]])
def test_nothing_is_imported_that_is_not_needed(words):
    """Neither the drone's libraries nor what flies it."""
    code = (
        "import sys; from infogoal_jax.cli.main import main\n"
        f"try: main({words})\nexcept SystemExit: pass\n"
        "heavy = {'djitellopy', 'av', 'ultralytics', 'infogoal_drone.mission', 'infogoal_drone.link'}\n"
        "found = heavy & set(sys.modules)\n"
        "assert not found, found"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def record(folder, name: str, moves, origin=(0, 0), seen_from: int = 1) -> int:
    """A recorded flight of (move, answer) from the first place, and a picture after the last. seen_from: column from
    which the mug is seen."""
    recorder, place, random = Recorder(folder, name, origin), Whereabouts(), np.random.default_rng(len(moves))
    for move, answer in [*moves, ("", "")]:
        image = random.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        recorder.visit(Picture(0.0, image, image), place, {"red mug"} if place.low[0] >= seen_from else set(), move)
        place = place.after(move, answer) if move else place
    return recorder.close()


def imported(folder) -> frames.FrameDataset:
    """The dataset of all recordings."""
    return frames_import.import_folder(folder, folder / TABLE, folder.parent / "mine.npz")


def test_two_flights_make_a_dataset(tmp_path):
    folder = tmp_path / "recordings"
    assert record(folder, "monday", [("right", "made"), ("up", "made")]) == 2
    assert record(folder, "tuesday", [("left", "made")], origin=(2, 0)) == 1
    data = imported(folder)
    assert (len(data.frames), len(data.frame), data.objects) == (5, 3, ("red mug",))
    assert data.state[1] == data.state[4] and data.num_states == 4, "both flights saw the place (1, 0)"
    np.testing.assert_allclose(data.position[:3, :2], [[0, 0], [0.2, 0], [0.2, 0.2]], atol=1e-6)
    assert data.detected[:, 0].tolist() == [False, True, True, False, False]
    frames.next_state(data)


def test_a_table_that_an_editor_saved_is_added_to(tmp_path):
    """Without an end of its last line, and with a mark before its first."""
    folder = tmp_path / "recordings"
    record(folder, "monday", [("right", "made")])
    table = folder / TABLE
    table.write_bytes(b"\xef\xbb\xbf" + table.read_bytes().rstrip(b"\r\n"))
    record(folder, "tuesday", [("left", "made")], origin=(2, 0))
    assert len(imported(folder).frames) == 4


@pytest.mark.parametrize(("words", "origin"), [((), (3, 1)), (("--simulate",), (17, 4))])
def test_a_flight_is_recorded_from_where_it_begins(words, origin, tmp_path, monkeypatch, capsys):
    """Places of all flights are in one frame: a drone in the air is told where it is, and a simulated one knows."""
    begun = []

    def run_mission(folder, flown, target, settings, record, origin, confirm):
        begun.append(origin)
        return types.SimpleNamespace(reason="", steps=0, landed=True, found=True)

    monkeypatch.setattr(mission, "run_mission", run_mission)
    policy, place = faults.write_policy(tmp_path / "policy.npz"), ("--origin", "3", "1", "--start", "17", "4")
    for command in (["fly", str(policy), "--question", faults.QUESTION], ["record", str(tmp_path)]):
        assert main([*command, "--out", str(tmp_path / command[0]), *place, *words]) == 0
    assert begun == [origin, origin]


def test_refused_moves_are_left_out(tmp_path):
    folder = tmp_path / "recordings"
    assert record(folder, "monday", [("right", "refused"), ("up", "made"), ("up", "refused")], seen_from=0) == 1
    data = imported(folder)
    assert [data.actions[action] for action in data.action] == ["up"] and len(data.frames) == 2


def test_an_answer_that_is_missing_ends_the_recording(tmp_path):
    folder = tmp_path / "recordings"
    assert record(folder, "monday", [("right", "made"), ("up", "unanswered"), ("left", "made")]) == 1
    assert len(imported(folder).frames) == 2


def test_a_flight_without_a_move_leaves_no_rows(tmp_path):
    assert record(tmp_path, "monday", []) == 0
    assert not (tmp_path / TABLE).exists()


def test_the_explorer_stays_within_what_is_allowed():
    explorer, random = Explorer(0), np.random.default_rng(0)
    taken = []
    for _ in range(300):
        mask = random.random(len(MOVES)) < 0.6
        mask[random.integers(len(MOVES))] = True
        taken.append(explorer(None, mask))
        assert mask[taken[-1]]
    assert set(taken) == set(range(len(MOVES)))


def test_a_name_is_not_used_twice(tmp_path):
    record(tmp_path, "monday", [("right", "made")])
    with pytest.raises(UserError, match="holds monday already; give another folder"):
        Recorder(tmp_path, "monday")


def test_a_flight_that_was_refused_on_the_ground_can_be_tried_again(tmp_path):
    """Its folder goes; that of a program that was killed there is empty, and is taken."""
    assert Recorder(tmp_path, "monday").close() == 0
    assert not (tmp_path / "monday").exists()
    (tmp_path / "monday").mkdir()
    assert record(tmp_path, "monday", [("right", "made")]) == 1


@pytest.mark.parametrize("name", ["", TABLE, " monday", "mon\nday", "mon\udcffday"])
def test_names_that_no_recorded_flight_can_have(tmp_path, name):
    with pytest.raises(UserError, match="out = .*cannot be the name of a recorded flight"):
        Recorder(tmp_path, name)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def flown_at(tmp_path, monkeypatch):
    """Runs a recorded flight of one move over no link: `flight` and `close` stand for what it and its end do."""

    def fly(flight=lambda: None, close=lambda: None, out="monday"):
        def begin(link, policy, moves, detect, target, envelope, limits, log, visit):
            def fly():
                image = np.zeros((48, 64, 3), np.uint8)
                visit(Picture(0.0, image, image), Whereabouts(), {"mug"}, "right")
                visit(Picture(0.0, image, image), Whereabouts().after("right", "made"), set(), "")
                return flight()

            return types.SimpleNamespace(fly=fly)

        monkeypatch.setattr(mission, "Flight", begin)
        monkeypatch.setattr(mission, "Link", lambda *given: types.SimpleNamespace(close=close))
        monkeypatch.setattr(mission, "import_djitellopy", lambda: None)
        monkeypatch.setattr(mission, "check_ports", lambda ports: None)
        flown = mission.Flown(lambda picture, mask: 0, tuple(MOVES), (48, 64))
        return mission.run_mission(Path(out), flown, "", mission.Settings(), str(tmp_path / "recordings"))

    monkeypatch.chdir(tmp_path)
    return fly


def test_signals_after_the_landing_lose_nothing(tmp_path, flown_at):
    """While the video is turned off and the log is closed."""
    before = signal.getsignal(signal.SIGINT)
    flown_at(close=lambda: os.kill(os.getpid(), signal.SIGINT))
    assert len(imported(tmp_path / "recordings").frames) == 2
    assert signal.getsignal(signal.SIGINT) is before


def test_a_fault_of_the_link_when_it_is_closed_loses_nothing(tmp_path, flown_at):
    def fail():
        assert (tmp_path / "recordings" / TABLE).exists(), "the recording is written first"
        raise OSError("the network is gone")

    with pytest.raises(OSError, match="the network is gone"):
        flown_at(close=fail)
    assert len(imported(tmp_path / "recordings").frames) == 2


def test_an_error_in_the_air_loses_nothing(tmp_path, flown_at):
    with pytest.raises(ZeroDivisionError):
        flown_at(flight=lambda: 1 / 0)
    assert len(imported(tmp_path / "recordings").frames) == 2


def test_a_recorded_flight_has_the_name_of_its_folder(tmp_path, flown_at, monkeypatch):
    """Also where that is the working directory."""
    (tmp_path / "monday").mkdir()
    monkeypatch.chdir(tmp_path / "monday")
    flown_at(out=".")
    rows = (tmp_path / "recordings" / TABLE).read_text().splitlines()
    assert [row.split(",")[:2] for row in rows[1:]] == [[f"monday/000{n}.png", "monday"] for n in range(2)]


def test_a_table_of_others_is_not_added_to(tmp_path):
    (tmp_path / TABLE).write_text("my,own,columns\n1,2,3\n")
    with pytest.raises(UserError, match=f"its {TABLE} has other columns than image,trajectory"):
        Recorder(tmp_path, "monday")
    assert [path.name for path in tmp_path.iterdir()] == [TABLE]


def test_a_picture_that_the_disk_refuses_is_an_error_that_ends_the_flight(tmp_path):
    recorder, image = Recorder(tmp_path, "monday"), np.zeros((48, 64, 3), np.uint8)
    recorder.visit(Picture(0.0, image, image), Whereabouts(), set(), "right")
    (tmp_path / "monday").rename(tmp_path / "gone")
    with pytest.raises(UserError, match="record = .*monday/0001.png was refused.*free some space"):
        recorder.visit(Picture(0.0, image, image), Whereabouts().after("right", "made"), set(), "up")


def test_a_disk_that_is_full_leaves_no_half_row(tmp_path, monkeypatch):
    """It takes half of what it is given."""
    assert record(tmp_path, "monday", [("right", "made")]) == 1
    before, write = (tmp_path / TABLE).read_bytes(), os.write

    def half(descriptor, content):
        if len(content) < 50:
            raise OSError(28, "No space left on device")
        return write(descriptor, content[: len(content) // 2])

    monkeypatch.setattr(os, "write", half)
    with pytest.raises(UserError, match="record = .*cannot be written .No space left"):
        record(tmp_path, "tuesday", [("right", "made")])
    assert (tmp_path / TABLE).read_bytes() == before
