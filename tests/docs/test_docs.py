"""What the README and the docs name is there: links, files, flags, methods; their Python is Python. The site is built
of them without a warning, and works from a folder, without a server or a network."""

import ast
import contextlib
import dataclasses
import functools
import importlib.util
import io
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import nbformat
import pytest
import words
import yaml
from places import ROOT

import infogoal_jax
from infogoal_jax import exploration, learners, presets, relabelling
from infogoal_jax.cli.choice import ENV
from infogoal_jax.cli.commands import Group
from infogoal_jax.cli.main import BY_TASK, commands, main
from infogoal_jax.envs.named import NamedConfig
from infogoal_jax.imports import FLAG

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*/*.md"))]
# It may name flags and files that are no more; its links lead somewhere all the same.
CHANGELOG = ROOT / "CHANGELOG.md"
LONGEST_README, LONGEST_GUIDE = 120, 150
"""Lines."""
LONGEST_SENTENCE = 25
"""Words, on every page."""
MOST_WORDS = 36_500
"""Of all pages of docs, tables and code included."""
FILES = (".cfg", ".ipynb", ".md", ".png", ".py", ".toml")  # Names that end so are files of the repository.
OTHERS_FLAGS = {
    "--help",
    "--no-deps",
    "--inplace",
    "--requeue",
    "--signal",
}  # Of argparse and tyro, pip, Jupyter, Slurm.
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of this language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.M | re.S)


def flags_in(text: str) -> set[str]:
    """Everything that looks like a long flag of ours; XLA's begin with `--xla_`."""
    return {flag.rstrip(".-") for flag in re.findall(r"(?<![\w-])--(?!xla_)[a-z][\w.-]*", text)}


@functools.cache
def flags_of(words: str) -> set[str]:
    """The flags in the help of these words of the command line."""
    printed = io.StringIO()
    with (
        mock.patch.dict(os.environ, {"COLUMNS": "200"}),
        contextlib.redirect_stdout(printed),
        pytest.raises(SystemExit),
    ):
        main([*words.split(), "--help-all" if words.split()[0] in BY_TASK else "--help"])
    return flags_in(printed.getvalue())


def commands_in(group: Group, path: str = "") -> Iterator[str]:
    """The words of every command."""
    for name, command in group.commands.items():
        if isinstance(command, Group):
            yield from commands_in(command, f"{path}{name} ")
        elif not path and name in BY_TASK:
            yield from commands_in(BY_TASK[name]([]).group, f"{name} ")
        else:
            yield f"{path}{name}"


@functools.cache
def flags_of_all_parts() -> set[str]:
    """The flags of `infogoal train`, of every task and part."""
    chosen = [*presets.TASKS, "object_manipulation --agent dqn"]
    for kind, registry in (("learner", learners), ("relabelling", relabelling), ("explorer", exploration)):
        chosen += [f"object_search --{kind} {name}" for name in registry.registry if name not in ("mixed", "none")]
    return set().union(*(flags_of(f"train {words}") for words in chosen))


@functools.cache
def flags_of_commands() -> dict[str, set[str]]:
    """The flags of every command, by its words; of one that takes parts by name, those of every part. A task has the
    same flags wherever it is named."""
    found = {words: flags_of(words) for words in commands_in(commands()) if not words.startswith("tune ")}
    found |= {words: flags | flags_of_all_parts() for words, flags in found.items() if words.startswith("train ")}
    tuned = {words.replace("train", "tune", 1): flags for words, flags in found.items() if words.startswith("train ")}
    return found | {words: flags | flags_of("tune object_search") for words, flags in tuned.items()}


def benchmark_flags(path: Path) -> set[str]:
    """The flags that a benchmark adds to its parser."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    names = [argument for call in calls if getattr(call.func, "attr", "") == "add_argument" for argument in call.args]
    return {name.value for name in names if isinstance(name, ast.Constant) and name.value.startswith("--")}


@functools.cache
def known_flags() -> set[str]:
    """The flags of all commands and benchmarks."""
    scripts = [*(ROOT / "benchmarks").glob("*/*.py"), *(ROOT / "infogoal_paper").glob("*.py")]
    of_benchmarks = set().union(*(benchmark_flags(path) for path in scripts))
    return OTHERS_FLAGS.union(of_benchmarks, *flags_of_commands().values())


def lines_to_read(path: Path, names: list[str]) -> int:
    """Lines of these classes and functions of a file; of the whole file where none is named."""
    text = path.read_text()
    defined = {node.name: node for node in ast.parse(text).body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    nodes = [defined[name] for name in names]
    first = [min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)]) for node in nodes]
    found = sum(node.end_lineno - start + 1 for node, start in zip(nodes, first, strict=True))
    return found if names else len(text.splitlines())


def test_one_method_is_read_in_as_many_lines_as_the_page_says():
    """Names in backticks are what is to be read of a file."""
    text = (ROOT / "docs" / "reference" / "architecture.md").read_text()
    rows = re.findall(r"^\| \d+ \| `([^`]+)` \| (.*) \|$", text, re.M)
    lines = sum(lines_to_read(ROOT / path, re.findall(r"`(\w+)`", words)) for path, words in rows)
    whole = sum(len((ROOT / path).read_text().splitlines()) for path, _ in rows)
    said = re.search(r"ten files of some ([\d,]+) lines. Where .*?: some ([\d,]+)\s+lines", text)
    assert len(rows) == 10 and lines <= 1600
    for count, written in zip((whole, lines), said.groups(), strict=True):
        assert abs(count - int(written.replace(",", ""))) <= 50


@pytest.mark.parametrize("page", [*PAGES, CHANGELOG], ids=lambda page: page.name)
def test_every_relative_link_leads_somewhere_in_the_repository(page):
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()) if not re.match(r"[a-z]+:|#", link)]
    places = {link: (page.parent / link.split("#")[0]).resolve() for link in links}
    assert not [link for link, place in places.items() if not (place.exists() and place.is_relative_to(ROOT))]


def test_every_page_can_be_reached_from_the_readme():
    """By two links: the README has the kinds, the first page of a kind has its pages."""
    linked = links_of(PAGES[0])
    linked |= set().union(*(links_of(page) for page in linked if page.name == "index.md"))
    assert {page.resolve() for page in (*PAGES[1:], CHANGELOG)} <= linked


def links_of(page: Path) -> set[Path]:
    """The files that a page links to."""
    return {(page.parent / link.split("#")[0]).resolve() for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text())}


def test_the_readme_and_guides_are_short():
    """`python tests/words.py` prints how long every page is."""
    assert len(words.README.read_text().splitlines()) <= LONGEST_README
    assert not [page for page in words.pages("guides") if len(page.read_text().splitlines()) > LONGEST_GUIDE]


@pytest.mark.parametrize("page", [words.README, *words.pages()], ids=lambda page: f"{page.parent.name}/{page.name}")
def test_sentences_are_short(page):
    assert not [sentence for sentence in words.sentences(page) if words.length(sentence) > LONGEST_SENTENCE]


def test_a_guide_begins_with_its_end_and_with_lines_to_type():
    """Within the first screen; a guide whose lines are a program has its first block further down."""
    for page in set(words.pages("guides")) - {words.DOCS / "guides" / "index.md"}:
        lines = page.read_text().splitlines()
        assert lines[2].startswith("At the end "), page.name
        assert any(line.startswith("```") for line in lines[:20]), page.name


def test_pages_have_few_words():
    total = sum(map(words.words, words.pages()))
    print(f"words of all pages of docs: {total:,}")
    assert total <= MOST_WORDS


@each_page
def test_every_file_that_is_named_is_there(page):
    """A path that begins with a folder of the repository or of the package, and every name with the ending of a source
    file; the marks of written tables are no paths, and `my_task.py` and its like are the reader's own files."""
    text = re.sub(r"https?://\S+|<!-- table: \S+ -->|\bmy_(?:task|learner|agent)\.py\b", "", page.read_text())
    places = (
        ROOT,
        ROOT / "infogoal_jax",
        page.parent,
        *(path for folder in ("infogoal_jax", "docs") for path in (ROOT / folder).iterdir() if path.is_dir()),
    )
    folders = {path.name for place in places[:2] for path in place.iterdir() if path.is_dir() and path.name != "runs"}
    names = {name.rstrip("./") for name in re.findall(r"(?<![\w./*~$-])[A-Za-z_][\w.-]*(?:/[\w.*-]+)*/?", text)}
    named = {
        name
        for name in names
        if name.endswith(FILES) or name == "constraints.txt" or ("/" in name and name.split("/")[0] in folders)
    }
    assert not [name for name in sorted(named) if not any(any(place.glob(name)) for place in places)]


@each_page
def test_every_flag_is_a_flag(page):
    places = {f"--env.{field.name.replace('_', '-')}" for field in dataclasses.fields(NamedConfig)}
    assert flags_in(page.read_text()) <= {FLAG, ENV, *places, *known_flags()}


@each_page
def test_flags_stand_behind_their_own_command(page):
    """In every line of a console block that calls `infogoal` or a benchmark."""
    for line in "".join(blocks(page, "console")).splitlines():
        command, _, _ = line.partition("#")
        words = command.split()
        if words[:1] == ["infogoal"]:
            known = flags_of_commands()
            name = max(
                (name for name in known if f"{' '.join(words[1:])} ".startswith(f"{name} ")), key=len, default=None
            )
            # A run to resume, or an environment of another library: they stand in place of the task.
            another = known["train object_search"] | {ENV} if words[2:3] in (["--resume"], [ENV]) else None
            assert name or another, line
            assert flags_in(command) <= (another or known[name]), line
        elif words[:1] == ["python"]:
            script = f"{words[2].replace('.', '/')}.py" if words[1] == "-m" else words[1]
            assert flags_in(command) <= benchmark_flags(ROOT / script), line


@each_page
def test_methods_that_are_named_on_a_command_line_exist(page):
    named = set(re.findall(r"--method ([a-z]\w*)", page.read_text())) - {
        "my_method",
        "mine",
    }  # Those that a reader makes.
    assert named <= set(presets.METHODS)


@each_page
def test_python_blocks_compile(page):
    for block in blocks(page, "python"):
        ast.parse(block)


class Configuration(yaml.SafeLoader):
    """YAML of mkdocs, whose tags name functions."""


Configuration.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda loader, suffix, node: suffix)


def configuration() -> dict:
    """mkdocs.yml as it is written."""
    return yaml.load((ROOT / "mkdocs.yml").read_text(), Configuration)


def test_every_page_and_every_notebook_is_in_the_navigation():
    named = re.findall(r"[\w/]+\.md", json.dumps(configuration()["nav"]))
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert sorted(named) == sorted(
        {page.relative_to(ROOT / "docs").as_posix() for page in PAGES[2:]}
        | notebooks
        | {"index.md", "contributing.md", "changelog.md"}
    )


@pytest.mark.parametrize("before", ["", "https://github.com/nobody/a.b"])
def test_one_line_points_all_files_at_the_address(before, tmp_path):
    """Whatever address they had: pages, the site, and the notebooks with their links to Colab."""
    for name in ("README.md", "mkdocs.yml", "docs/start", "notebooks"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        (tmp_path / name).parent.mkdir(exist_ok=True)
        copy(ROOT / name, tmp_path / name)
    write = runpy.run_path(str(ROOT / "tools" / "address.py"))["write"]
    for address in filter(None, (before, "https://github.com/somebody/infogoal-jax")):
        write(tmp_path, address)
    assert yaml.load((tmp_path / "mkdocs.yml").read_text(), Configuration)["repo_url"] == address
    for page in ("README.md", "docs/start/install.md"):
        assert (tmp_path / page).read_text().count(f"\nREPOSITORY={address} ") == 1
    colab = "https://colab.research.google.com/github/somebody/infogoal-jax/blob/main/notebooks"
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(tmp_path / "notebooks" / path.name, as_version=4)
        nbformat.validate(notebook)
        title, install = notebook.cells[:2]
        assert title.source.splitlines()[2:4] == [f"[Open in Colab]({colab}/{path.name})", ""]
        assert f'SOURCE = "git+{address}"' in install.source
        saved = nbformat.read(path, as_version=4)
        assert title.source.splitlines()[4:] == saved.cells[0].source.splitlines()[2:]
        assert notebook.cells[2:] == saved.cells[2:] and "nobody" not in title.source


def test_no_file_has_an_address_that_the_others_have_not():
    """The site's, where there is one, is the pages' and the notebooks'."""
    address = configuration().get("repo_url", "...")
    for page in ("README.md", "docs/start/install.md"):
        assert f"\nREPOSITORY={address} " in (ROOT / page).read_text()
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        assert f'SOURCE = \\"git+{address}\\"' in path.read_text()


def test_the_api_has_everything_that_the_package_exports():
    page = (ROOT / "docs" / "reference" / "api.md").read_text()
    named = {line.rsplit(".", 1)[1] for line in page.splitlines() if line.startswith(":::")}
    assert set(infogoal_jax.__all__) - {"envs", "presets"} <= named
    exported = page[page.index("`infogoal_jax` itself") : page.index("\n## ")]
    assert set(re.findall(r"`(\w+)`", exported)) == {"infogoal_jax", *infogoal_jax.__all__}


def test_every_extra_is_on_the_page_of_the_installation():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    rows = re.findall(r"^\| (`.*?`) \|", (ROOT / "docs" / "start" / "install.md").read_text(), re.M)
    assert sorted(re.findall(r"`(.*?)`", " ".join(rows))) == sorted(extras)


def test_the_changelog_begins_with_this_version():
    first = re.search("^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1]
    version, dot, _ = infogoal_jax.__version__.partition(".dev")
    assert first == f"{version}, unreleased" if dot else re.fullmatch(rf"{version}, \d{{4}}-\d\d-\d\d", first)


def test_the_citation_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["preferred-citation"]["title"] in (ROOT / "README.md").read_text()


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site. Warnings and broken links fail the build (mkdocs.yml, docs/site.py)."""
    if not importlib.util.find_spec("mkdocstrings"):
        pytest.skip("needs the extra docs, which `make test-long` and `make docs` install")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", folder]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stderr
    return folder


@pytest.mark.long
def test_pages_hold_what_they_are_for(site):
    """Equations with their code, the API with signatures, notebooks with pictures."""
    equations = (site / "reference" / "infogoal.html").read_text()
    assert equations.count("<math") > 10 and "$$" not in equations and "<!-- lines" not in equations
    assert "remove_similar" in equations and "next_beta" in equations
    assert "make_train" in (site / "reference" / "api.html").read_text()
    assert len(list((site / "notebooks").glob("quickstart_*.png"))) == 5


@pytest.mark.long
def test_search_works_without_a_server(site):
    """The index is a script that a page can load from a folder, and nothing is asked from the web."""
    index = (site / "search" / "search_index.js").read_text()
    assert "dissimilar" in index and "infogoal_jax/learners/infogoal.py" in index
    home = (site / "index.html").read_text()
    assert "search_without_server.js" in home and (site / "search_without_server.js").exists()
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=\"?https?://", home)


SEARCHED = {
    "own environment": "guides/own_task.html",
    "custom task": "guides/own_task.html",
    "mjx": "guides/own_task.html",
    "resume": "guides/training.html",
    "GPU memory": "guides/training.html",
    "seeds": "guides/training.html",
    "image goals": "reference/goal_inputs.html",
    "export": "guides/policies.html",
    "plot": "guides/results.html",
    "figures": "guides/results.html",
    "video": "guides/results.html",
    "wandb": "guides/results.html",
    "install": "start/install.html",
    "learning rate": "guides/sweeps.html",
    "gymnasium": "guides/bridges.html",
    "own learner": "guides/own_parts.html",
    "custom learner": "guides/own_parts.html",
    "custom agent": "guides/own_agent.html",
    "hyperparameter tuning": "guides/tuning.html",
    "learning rate sweep": "guides/sweeps.html",
    "evaluate": "guides/results.html",
    "save policy": "guides/policies.html",
    "deploy": "guides/policies.html",
    "pretrained": "guides/policies.html",
    "getting started": "start/first_run.html",
    "jupyter": "start/first_run.html",
    "progress": "guides/results.html",
    "multiple GPUs": "guides/sweeps.html",
    "slurm": "guides/training.html",
}
"""What a stranger looks for, and the page that says how: the first that the search shows."""
LOOKED_UP = {
    "HER": "reference/methods.html",
    "hindsight": "reference/methods.html",
    "offline": "reference/datasets.html",
    "continuous goals": "reference/vectors.html",
    "command line flags": "reference/flags.html",
    "speed": "research/speed.html",
}
"""The same of what is, not of what to do."""
ASK = """
const fs = require("fs"), vm = require("vm"), [site, ...questions] = process.argv.slice(1);
const worker = fs.readdirSync(`${site}/assets/javascripts/workers`).find((name) => name.endsWith(".js"));
const index = JSON.parse(fs.readFileSync(`${site}/search/search_index.json`));
let listen, answer;
Object.assign(globalThis, {
  self: globalThis,
  importScripts: () => {},
  addEventListener: (kind, listener) => { listen = listener; },
  postMessage: (message) => answer(message),
});
vm.runInThisContext(fs.readFileSync(`${site}/assets/javascripts/workers/${worker}`));
const ask = (type, data) => new Promise((done) => { answer = done; listen({ data: { type, data } }); });
(async () => {
  await ask(0, { ...index, options: { suggest: false } });
  for (const question of questions) {
    const { data } = await ask(2, question);
    console.log(data.items[0][0].location.split("#")[0]);
  }
})();
"""
"""Asks the site's own search, without a browser."""


@pytest.mark.long
@pytest.mark.skipif(not shutil.which("node"), reason="needs node, which runs the search of the site")
def test_a_stranger_s_search_leads_to_the_page_that_says_how(site):
    questions = SEARCHED | LOOKED_UP
    command = ["node", "-e", ASK, str(site), *questions]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert dict(zip(questions, found, strict=True)) == questions


@pytest.mark.long
def test_pages_for_doing_come_first_in_the_search(site):
    """Where the search itself cannot be run: each question is in a title of its page, or that page counts more."""
    index = json.loads((site / "search" / "search_index.json").read_text())["docs"]
    boosts = {entry["location"].split("#")[0]: entry.get("boost", 1) for entry in index}
    assert all(boosts[page] > 1 for page in SEARCHED.values())
    assert boosts["research/speed.html"] < 1 and boosts["notebooks/quickstart.html"] == 1
