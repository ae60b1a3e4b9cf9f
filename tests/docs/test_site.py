"""The documentation site is built without a warning, and works from a folder, without a server or a network."""

import importlib.util
import json
import os
import re
import subprocess
import sys

import pytest
import yaml
from places import ROOT

import infogoal_jax

PAGES = {path.name for path in (ROOT / "docs").glob("*.md")}


class Configuration(yaml.SafeLoader):
    """YAML of mkdocs, whose tags name functions."""


Configuration.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda loader, suffix, node: suffix)


def configuration() -> dict:
    """mkdocs.yml as it is written."""
    return yaml.load((ROOT / "mkdocs.yml").read_text(), Configuration)


def test_every_page_and_every_notebook_is_in_the_navigation():
    named = re.findall(r"[\w/]+\.md", json.dumps(configuration()["nav"]))
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert sorted(named) == sorted(PAGES | notebooks | {"index.md", "contributing.md", "changelog.md"})


def test_the_api_has_everything_that_the_package_exports():
    page = (ROOT / "docs" / "api.md").read_text()
    named = {line.rsplit(".", 1)[1] for line in page.splitlines() if line.startswith(":::")}
    assert set(infogoal_jax.__all__) - {"envs", "presets"} <= named


def test_the_citation_names_this_version_and_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == infogoal_jax.__version__
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
    equations = (site / "infogoal.html").read_text()
    assert equations.count("<math") > 10 and "$$" not in equations and "<!-- lines" not in equations
    assert "remove_similar" in equations and "next_beta" in equations
    assert "make_train" in (site / "api.html").read_text()
    assert len(list((site / "notebooks").glob("quickstart_*.png"))) == 5


@pytest.mark.long
def test_search_works_without_a_server(site):
    """The index is a script that a page can load from a folder, and nothing is asked from the web."""
    index = (site / "search" / "search_index.js").read_text()
    assert "dissimilar" in index and "infogoal_jax/learners/infogoal.py" in index
    home = (site / "index.html").read_text()
    assert "search_without_server.js" in home and (site / "search_without_server.js").exists()
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=\"?https?://", home)
