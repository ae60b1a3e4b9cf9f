"""What the README and the docs name is there: links, files, flags, methods; their Python is Python."""

import ast
import dataclasses
import re
from pathlib import Path

import pytest

from infogoal_jax import envs, learners, presets
from infogoal_jax.train import command_line, data_commands, run_commands
from infogoal_jax.train.pretrain import PretrainConfig, preset
from infogoal_jax.train.pretrain_host import PretrainCommand
from infogoal_jax.train.pretrain_joints import JointPretrainConfig

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FILES = (".cfg", ".ipynb", ".md", ".png", ".py", ".toml")  # Names that end so are files of the repository.
OTHERS_FLAGS = {"--help", "--no-deps"}  # Of argparse and tyro; of pip.
COMMANDS = {  # Words after `infogoal`, and the dataclass whose fields are the flags.
    "evaluate": run_commands.EvaluateCommand, "report": run_commands.ReportCommand, "data check": data_commands.CheckCommand,
    "data build house": data_commands.BuildHouseCommand, "data embed": data_commands.EmbedCommand,
    "pretrain": PretrainCommand(config=preset("fetch_push")), "video": run_commands.VideoCommand, "data build fetch": data_commands.BuildFetchCommand,
    "data build backgrounds": data_commands.BuildBackgroundsCommand, "data download cifar10": data_commands.DownloadCifar10Command,
    "data build cube": data_commands.BuildCubeCommand, "data build shelf": data_commands.BuildShelfCommand,
    "data import": data_commands.ImportCommand, "data export-minari": data_commands.ExportMinariCommand,
    "pretrain object_manipulation": JointPretrainConfig(), "methods": command_line.MethodsCommand,
    "compare": run_commands.CompareCommand,
    "tune": command_line.TuneCommand(config=presets.load("object_search")), "final": command_line.FinalCommand,
}

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of this language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.M | re.S)


def flags_of(record, prefix: str = "") -> set[str]:
    """The flags that tyro makes of a configuration record, or of a dataclass that holds plain values only."""
    found = set()
    for field in dataclasses.fields(record):
        value = getattr(record, field.name, None)
        name = field.name.replace("_", "-")
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            inlined = isinstance(value, command_line.TrainConfig | command_line.Selection | PretrainConfig)
            found |= flags_of(value, "" if inlined else f"{prefix}{name}.")
        else:
            found |= {f"--{prefix}{name}", f"--{prefix}no-{name}"} if isinstance(value, bool) else {f"--{prefix}{name}"}
    return found


def train_flags() -> set[str]:
    """The flags of `infogoal train`, of every task and method."""
    configs = [presets.load(task, method, relabelling="her") for task in presets.TASKS for method in learners.registry]
    configs += [presets.load("object_search", method) for method in presets.METHODS]
    configs.append(presets.load("object_manipulation", agent="dqn"))
    return set().union(*(flags_of(command_line.TrainCommand(config=config)) for config in configs))


def benchmark_flags(path: Path) -> set[str]:
    """The flags that a benchmark adds to its parser."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    names = [argument for call in calls if getattr(call.func, "attr", "") == "add_argument" for argument in call.args]
    return {name.value for name in names if isinstance(name, ast.Constant) and name.value.startswith("--")}


def flags_in(text: str) -> set[str]:
    """Everything that looks like a long flag."""
    return {flag.rstrip(".-") for flag in re.findall(r"(?<![\w-])--[a-z][\w.-]*", text)}


def known_flags() -> set[str]:
    """The flags of all commands and benchmarks."""
    of_benchmarks = set().union(*(benchmark_flags(path) for path in (ROOT / "benchmarks").glob("*/*.py")))
    return train_flags().union(of_benchmarks, OTHERS_FLAGS, *(flags_of(command) for command in COMMANDS.values()))


@each_page
def test_every_relative_link_leads_somewhere(page):
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    missing = [link for link in links if not re.match(r"[a-z]+:|#", link) and not (page.parent / link.split("#")[0]).exists()]
    assert not missing


def test_every_page_can_be_reached_from_the_readme():
    linked = {(ROOT / link.split("#")[0]).resolve() for link in re.findall(r"\]\(([^)\s]+)\)", PAGES[0].read_text())}
    assert {page.resolve() for page in PAGES[1:]} <= linked


@each_page
def test_every_file_that_is_named_is_there(page):
    """A path that begins with a folder of the repository or of the package, and every name with the ending of a source file."""
    text = re.sub(r"https?://\S+", "", page.read_text())
    places = (ROOT, ROOT / "infogoal_jax", page.parent, *(path for path in (ROOT / "infogoal_jax").iterdir() if path.is_dir()))
    folders = {path.name for place in places[:2] for path in place.iterdir() if path.is_dir() and path.name != "runs"}
    names = {name.rstrip("./") for name in re.findall(r"(?<![\w./*~$-])[A-Za-z_][\w.-]*(?:/[\w.*-]+)*/?", text)}
    named = {name for name in names if name.endswith(FILES) or name == "constraints.txt" or ("/" in name and name.split("/")[0] in folders)}
    assert not [name for name in sorted(named) if not any(any(place.glob(name)) for place in places)]


@each_page
def test_every_flag_is_a_flag(page):
    assert flags_in(page.read_text()) <= known_flags()


@each_page
def test_flags_stand_behind_their_own_command(page):
    """In every line of a console block that calls `infogoal` or a benchmark."""
    for line in "".join(blocks(page, "console")).splitlines():
        command, _, _ = line.partition("#")
        words = command.split()
        if words[:2] in (["infogoal", "train"], ["infogoal", "tune"]):
            own = flags_of(COMMANDS["tune"]) if words[1] == "tune" else set()
            assert words[2] in envs.registry and flags_in(command) <= train_flags() | own, line
        elif words[:1] == ["infogoal"]:
            name = max((name for name in COMMANDS if " ".join(words[1:]).startswith(name)), key=len, default=None)
            assert name and flags_in(command) <= flags_of(COMMANDS[name]), line
        elif words[:1] == ["python"]:
            assert flags_in(command) <= benchmark_flags(ROOT / words[1]), line


@each_page
def test_methods_that_are_named_on_a_command_line_exist(page):
    named = set(re.findall(r"--method ([a-z]\w*)", page.read_text())) - {"my_method"}
    assert named <= set(presets.METHODS)


@each_page
def test_python_blocks_compile(page):
    for block in blocks(page, "python"):
        ast.parse(block)


def test_flags_of_a_command_are_those_that_tyro_makes(capsys, monkeypatch):
    """`flags_of` against the help text of the command itself."""
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        command_line.main(["train", "object_search", "--help"])
    assert flags_in(capsys.readouterr().out) == flags_of(command_line.TrainCommand(config=presets.load("object_search"))) | {"--help"}
