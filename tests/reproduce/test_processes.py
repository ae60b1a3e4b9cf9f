"""Several processes on one folder: each has its GPU and its share of the memory, and what was asked for."""

from pathlib import Path

import pytest

from infogoal_jax.cli.main import main
from infogoal_jax.reproduce import files, processes
from infogoal_jax.reproduce.command import Asked
from infogoal_jax.reproduce.figures import FIGURES


def test_processes_are_spread_over_gpus(monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    found = [processes.environment(number, 5, 2) for number in range(5)]
    assert [each["CUDA_VISIBLE_DEVICES"] for each in found] == ["0", "1", "0", "1", "0"]
    assert {each["XLA_PYTHON_CLIENT_MEM_FRACTION"] for each in found} == {"0.300"}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,7")
    assert processes.environment(1, 2, 2)["CUDA_VISIBLE_DEVICES"] == "7"
    assert "XLA_PYTHON_CLIENT_MEM_FRACTION" not in processes.environment(0, 2, 0)


def test_a_process_is_asked_for_the_same(capsys, tmp_path):
    """The arguments are those of the command line: the same runs are listed."""
    asked = Asked("fig15", ("fetch_push",), ("infogoal",), ("paper",), (0,), 3, tmp_path, quick=True, retry=True)
    words = processes.arguments_of(asked, 9.0)
    assert {"--retry", "--quick", "--no-draw"} <= set(words) and words[words.index("--minutes") + 1] == "9.0"
    assert main([*words, "--list"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("seeds_0-1_toy: left") == len(asked.runs()) == 6


@pytest.mark.long
def test_two_processes_train_what_one_would(tmp_path, capsys):
    flags = [
        "--quick",
        "--tasks",
        "object_search",
        "--methods",
        "none",
        "her",
        "--ways",
        "paper",
        "--out",
        str(tmp_path),
    ]
    assert main(["reproduce", "table1", *flags, "--processes", "2"]) == 0
    printed = capsys.readouterr().out
    assert "2 runs: 2 done" in printed and "0: object_search" in printed and "1: object_search" in printed
    names = {files.read(path).run.label for path in Path(tmp_path).rglob("runs/**/*.npz")}
    assert names == {"none", "her"} and (tmp_path / "index.html").exists()


@pytest.mark.long
def test_the_quick_way_does_all_of_it(tmp_path):
    """Every table and figure from training to the page, at a size at which nothing is learned."""
    assert main(["reproduce", "all", "--quick", "--out", str(tmp_path), "--processes", "2"]) == 0
    assert {path.stem for path in tmp_path.glob("figures/*.png")} == set(FIGURES)
    made = [files.read(path) for path in Path(tmp_path).rglob("runs/**/*.npz")]
    assert [result.run.name for result in made if result.missing() or result.about["measuring_failed"]] == []
    assert {"table1_paper", "table1_her", "table2", "costs"} <= {path.stem for path in tmp_path.glob("tables/*.md")}
    assert (tmp_path / "reproduction.md").exists() and (tmp_path / "index.html").exists()
