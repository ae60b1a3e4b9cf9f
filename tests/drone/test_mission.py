"""Before the take-off: questions, policies, libraries and ports that cannot be used are refused."""

import os
import socket
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT

from infogoal_jax.cli.main import main
from infogoal_jax.data import splits, text
from infogoal_jax.drone import link, mission
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
    "left": ("--left=-1", "--simulate"),
    "speed": ("--speed=2",),
    "simulated": ("--simulated", "1", "2"),
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


@pytest.mark.parametrize("words", [["--help"], ["fly", "--help"], ["methods"]])
def test_nothing_is_imported_that_is_not_needed(words):
    """Neither the drone's libraries nor its modules."""
    code = (
        "import sys; from infogoal_jax.cli.main import main\n"
        f"try: main({words})\nexcept SystemExit: pass\n"
        "found = {'djitellopy', 'av', 'ultralytics', 'infogoal_jax.drone'} & set(sys.modules)\n"
        "assert not found, found"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
