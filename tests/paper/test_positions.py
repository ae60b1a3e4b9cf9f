"""The table of Fetch with continuous goals, from runs as they lie on disk."""

import json

from infogoal_paper import positions, trial_numbers


def write_run(folder, agent: str, successes: dict[int, list[float]]) -> None:
    """As much of a run as is read: success of each seed after each of two evaluations."""
    folder.mkdir()
    parts = {"learner": {"name": "none"}, "agent": {"name": agent}}
    config = {"task": "fetch_push_positions"} | parts
    about = {"config": config, "device": "NVIDIA H200", "versions": {"jax": "0.11.2"}}
    (folder / "config.json").write_text(json.dumps(about))
    lines = [
        f"{seed},{epoch},{epoch}00000,{success}"
        for seed, own in successes.items()
        for epoch, success in enumerate(own, start=1)
    ]
    (folder / "evaluations.csv").write_text("\n".join(["seed,epoch,env_steps,train_goal/success_rate", *lines]) + "\n")


def test_runs_are_taken_in_place_of_their_like(tmp_path, monkeypatch):
    """A second run of the same parts takes the first one's place; a seed that never got there is counted."""
    monkeypatch.setattr(positions, "NUMBERS", tmp_path / "positions.csv.xz")
    monkeypatch.setattr(positions, "TRANSFERS", tmp_path / "transfer.jsonl.xz")
    monkeypatch.setattr(positions, "PEERS", tmp_path / "reference.csv.xz")
    assert positions.tables() == {}
    write_run(tmp_path / "first", "sac", {0: [0.1, 0.2], 1: [0.1, 0.2]})
    write_run(tmp_path / "second", "sac", {0: [0.95, 1.0], 1: [0.1, 0.8]})
    write_run(tmp_path / "other", "td3", {0: [0.9, 0.9], 1: [0.0, 0.9]})
    positions.take([tmp_path / "first"])
    positions.take([tmp_path / "second", tmp_path / "other"])
    _, _, sac = positions.tables()["success"].splitlines()
    assert sac == "| Push | SAC | 0.90±1.27 | 0.20 | 0.10 to 0.10 (1 of 2 seeds) |  |"
    assert {row["agent"] for row in trial_numbers.kept(positions.NUMBERS)} == {"sac", "td3"}


def test_seconds_are_those_of_the_log(tmp_path, monkeypatch):
    """From the start of the process to the line of the first evaluation at which the mean over the seeds is enough."""
    monkeypatch.setattr(positions, "NUMBERS", tmp_path / "positions.csv.xz")
    monkeypatch.setattr(positions, "TRANSFERS", tmp_path / "transfer.jsonl.xz")
    monkeypatch.setattr(positions, "PEERS", tmp_path / "reference.csv.xz")
    write_run(tmp_path / "run", "sac", {0: [1.0, 1.0], 1: [0.7, 0.84]})
    (tmp_path / "run" / "log.txt").write_text("0.1 begin\n31.4 epoch 1/2  0:30  train 0.85\n40.6 epoch 2/2  0:39\n")
    positions.take([tmp_path / "run"])
    assert positions.tables()["success"].splitlines()[-1].endswith(" | 41, never |")
    columns = "task,reference,seed,env_steps,cpu_seconds,success_rate,wall_seconds,reached_rate,machine"
    rows = "fetch_push,True,0,2000,30,0.1,40,0.1,on cuda\nfetch_push,True,0,3600,50,0.2,72,1,on cuda\n"
    (tmp_path / "numbers.csv").write_text(f"{columns}\n{rows}")
    for _ in range(2):
        positions.take_peers([tmp_path / "numbers.csv"])
    line = positions.tables()["peer"].splitlines()[-1]
    assert line == "| Push | 1 | 50 | never | 0.20 after 72 s | 5.6 | 41 |"


def test_policies_are_shown_beside_the_reference(tmp_path, monkeypatch):
    monkeypatch.setattr(positions, "NUMBERS", tmp_path / "positions.csv.xz")
    monkeypatch.setattr(positions, "TRANSFERS", tmp_path / "transfer.jsonl.xz")
    monkeypatch.setattr(positions, "PEERS", tmp_path / "reference.csv.xz")
    for seed, (ours, there) in enumerate(((1.0, 0.9), (0.8, 0.9))):
        reached = {"ours": {"mean": ours}, "reference": {"mean": there}, "difference": ours - there}
        row = {"task": "fetch_push_positions", "method": "none", "faithful": False, "episodes": 500}
        row |= {"reached": reached, "at_end": reached}
        (tmp_path / f"push-{seed}.json").write_text(json.dumps(row))
    for _ in range(2):
        positions.take_transfers(sorted(tmp_path.glob("push-*.json")))
    line = positions.tables()["transfer"].splitlines()[-1]
    assert line.startswith("| Push | fast | 2 x 500 | 0.900±")
    assert line.endswith("| 0.900±0.000 | 0.000±1.271 | 0.000±1.271 |")
