"""What the documentation site has beside the pages of docs/ (a hook of mkdocs, see mkdocs.yml).

The README is the home page; CONTRIBUTING, CHANGELOG and the notebooks are pages; a file of the repository that a page
links to becomes a page with its text. Equations are written as MathML, and the lines that implement them are put in
from the package. After the build every link between the files of the site is followed.
"""

import ast
import base64
import html.parser
import json
import os
import re
import textwrap
from pathlib import Path
from urllib.parse import unquote

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Pages outside of docs/, and their names on the site."""
LINK = re.compile(r"(?<=\]\()([^)\s#]+)?(#[^)\s]*)?(?=\))")
STYLE = """.md-grid { max-width: 76rem; }
.md-typeset pre > code { font-size: 0.68rem; }
math[display="block"] { margin: 1em 0; font-size: 1.1em; }
.equation { overflow-x: auto; }
.md-typeset table:not([class]) th { min-width: 0; }
.md-typeset table code { white-space: nowrap; }
.md-typeset table:not([class]) :is(th, td) { padding: 0.5em 0.7em; }
.md-typeset img[src$=".svg"] { display: block; max-width: min(100%, 700px); }
"""
"""Room for lines of 120 letters, for tables of many columns, and for equations that are wider than a telephone."""
SEARCH_WITHOUT_SERVER = """if (location.protocol === "file:") {
  window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.appendChild(this.frame);
      const inside = this.frame.contentDocument;
      inside.open();
      inside.write(`<html><body><script>
        postMessage = (data) => parent.postMessage(data, "*");
        importScripts = (...urls) => urls.reduce((before, url) => before.then(() => new Promise((done, failed) => {
          const script = document.createElement("script");
          Object.assign(script, { src: url, onload: done, onerror: failed });
          document.body.appendChild(script);
        })), Promise.resolve());
        </${"script"}><script src="${url}"></${"script"}></body></html>`);
      inside.close();
      window.addEventListener("message", (event) => {
        if (event.source !== this.frame.contentWindow) return;
        const answer = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(answer);
        if (this.onmessage) this.onmessage(answer);
      });
    }
    postMessage(data) {
      const send = () => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data }));
      if (this.frame.contentDocument.readyState === "complete") send();
      else this.frame.contentWindow.addEventListener("load", send, { once: true });
    }
    terminate() { this.frame.remove(); }
  };
  window.Worker = window.IFrameWorker;
}
"""
"""The search runs in a worker, which browsers refuse to a page that was opened from a folder. There, and only there,
this runs it in a hidden frame that answers in the same way. The worker looks for the name IFrameWorker to find its
files."""
SEARCHED_FIRST = {
    "start": 4,
    "guides": 4,
    "reference/goal_inputs.md": 4,
    "reference/api.md": 0.5,
    "research": 0.5,
    "changelog.md": 0.5,
    "contributing.md": 0.5,
}
"""How much more a word counts in the search on pages of these folders, or on these pages: who searches wants to do
something."""
LANGUAGES = {".py": "python", ".json": "json", ".md": "markdown", ".yml": "yaml", ".toml": "toml", ".xml": "xml"}


def place_on_site(path: Path) -> str | None:
    """Where a file of the repository lies on the site; None for a folder."""
    name = path.relative_to(ROOT).as_posix()
    if path.is_dir():
        return None
    if name.startswith("docs/"):
        return name.removeprefix("docs/")
    if path.suffix == ".ipynb":
        return name.replace(".ipynb", ".md")
    return PAGES.get(name, f"source/{name}.md")


def source_of(uri: str) -> Path:
    """The file of the repository behind a page of the site."""
    names = {page: name for name, page in PAGES.items()}
    return ROOT / (names.get(uri) or (uri if uri.startswith("notebooks/") else f"docs/{uri}"))


def fenced(text: str, language: str) -> str:
    """A block of code that may hold fences itself."""
    return f"``````{language}\n{text.rstrip()}\n``````\n"


def listing(path: Path) -> str:
    """The page of a source file. The search leaves it out."""
    name = path.relative_to(ROOT).as_posix()
    head = f"---\nsearch:\n  exclude: true\n---\n\n# {name}\n\n"
    return head + fenced(path.read_text(), LANGUAGES.get(path.suffix, "text"))


def linked_files(path: Path) -> set[Path]:
    """Files of the repository that a page links to."""
    text = re.sub(r"```.*?```", "", path.read_text(), flags=re.S)
    targets = [found for found, _ in LINK.findall(text) if found and not re.match(r"[a-z]+:", found)]
    return {file for file in ((path.parent / target).resolve() for target in targets) if file.is_file()}


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its pictures by name."""
    parts, pictures = [], {}
    for cell in json.loads(path.read_text())["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else fenced(source, "python"))
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            kind = next((kind for kind in data if kind.startswith("image/")), None)
            if kind:
                name = f"{path.stem}_{cell['id']}.{kind.removeprefix('image/')}"
                pictures[name] = base64.b64decode("".join(data[kind]))
                parts.append(f"![{cell['id']}]({name})")
            elif "text/html" in data:  # Without an empty line, which would end it in Markdown.
                parts.append(re.sub(r"\n\s*\n", "\n", "".join(data["text/html"])))
            else:
                parts.append(fenced("".join(output.get("text") or data.get("text/plain", "")), "text"))
    return "\n\n".join(parts), pictures


def on_files(files, config):
    """Add the pages that lie outside of docs/."""
    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text()))
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text, pictures = notebook_page(notebook)
        files.append(File.generated(config, place_on_site(notebook), content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    files.append(File.generated(config, "site.css", content=STYLE))
    files.append(File.generated(config, "search_without_server.js", content=SEARCH_WITHOUT_SERVER))
    pages = [ROOT / name for name in PAGES] + sorted((ROOT / "docs").glob("**/*.md"))
    for path in sorted(set().union(*map(linked_files, pages))):
        page = place_on_site(path)
        if page.startswith("source/"):
            files.append(File.generated(config, page, content=listing(path)))
    return files


def on_page_markdown(markdown: str, page, config, files) -> str:
    """Turn links to files of the repository into links of the site, LaTeX into MathML, and put in lines of code."""
    uri = page.file.src_uri
    if uri.startswith("source/"):
        return markdown
    origin = source_of(uri).parent
    boost = SEARCHED_FIRST.get(uri) or SEARCHED_FIRST.get(uri.partition("/")[0])
    if boost:
        page.meta["search"] = {"boost": boost}

    def link(found: re.Match) -> str:
        target, anchor = found[1] or "", found[2] or ""
        if not target or re.match(r"[a-z]+:", target) or (uri.startswith("notebooks/") and "/" not in target):
            return found[0]  # The last are pictures of a notebook.
        to = place_on_site((origin / target).resolve())
        return (os.path.relpath(to, os.path.dirname(uri) or ".") if to else "#") + anchor

    blocks = re.split(r"(^```.*?^```$)", markdown, flags=re.S | re.M)
    for number in range(0, len(blocks), 2):
        blocks[number] = prose(LINK.sub(link, blocks[number]))
    return "".join(blocks)


def prose(text: str) -> str:
    """Text with its equations as MathML and the code that it asks for."""
    text = re.sub(r"\$\$(.+?)\$\$", lambda found: equation(found[1]), text, flags=re.S)
    text = re.sub(r"\$`(.+?)`\$", lambda found: convert(found[1]), text)
    return re.sub(
        r"<!-- lines: (\S+) (\S+)(?: from (.+?) to (.+?))? -->", lambda found: lines_of(*found.groups()), text
    )


def equation(latex: str) -> str:
    """An equation on lines of its own."""
    return f'<div class="equation">{convert(latex.strip(), display="block")}</div>'


def lines_of(file: str, name: str, first: str | None = None, last: str | None = None) -> str:
    """A function or class of the package, which may stand inside of a function (`make.loss`), as code; from a line that
    holds one text to a line that holds another, if they are given."""
    path, node = ROOT / "infogoal_jax" / file, None
    text = path.read_text()
    inside = ast.parse(text).body
    for part in name.split("."):
        node = next((one for one in inside if getattr(one, "name", None) == part), None)
        if node is None:
            raise PluginError(f"{file} has no {name}: mend the page that asks for its lines")
        inside = node.body
    lines = text.splitlines()[node.lineno - 1 : node.end_lineno]
    if first:
        start = next((number for number, line in enumerate(lines) if first in line), None)
        end = next((number for number, line in enumerate(lines) if last in line), None)
        if start is None or end is None or end < start:
            raise PluginError(
                f"{file}: {name} has no lines from {first!r} to {last!r}: mend the page that asks for them"
            )
        lines = lines[start : end + 1]
    return fenced(textwrap.dedent("\n".join(lines)), "python")


def on_post_page(output: str, page, config) -> str:
    """Load what the search needs without a server from the site, not from the web."""
    own = os.path.relpath("search_without_server.js", os.path.dirname(page.file.dest_uri) or ".")
    return output.replace("https://unpkg.com/iframe-worker/shim", own)


class Links(html.parser.HTMLParser):
    """What a page links to, and the anchors that it has."""

    def __init__(self, text: str):
        super().__init__()
        self.targets, self.loaded, self.anchors = [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Note links, pictures and anchors."""
        attrs = dict(attrs)
        self.targets += [attrs[name] for name in ("href", "src") if attrs.get(name)]
        if attrs.get("src") or (tag == "link" and attrs.get("rel") == "stylesheet"):
            self.loaded.append(attrs.get("src") or attrs["href"])
        self.anchors |= {attrs[name] for name in ("id", "name") if attrs.get(name)}


def on_post_build(config) -> None:
    """Fail if a link between files of the site leads nowhere, or a page loads anything from elsewhere."""
    site = Path(config.site_dir)
    pages = {path: Links(path.read_text()) for path in site.glob("**/*.html") if path.name != "404.html"}
    broken = []
    for path, page in pages.items():
        broken += [
            f"{path.relative_to(site)} loads {source}"
            for source in page.loaded
            if "//" in source and not source.startswith("data:")
        ]
        for target in page.targets:
            if re.match(r"[a-z]+:|//", target):
                continue
            name, _, anchor = target.partition("#")
            to = (path.parent / unquote(name)).resolve() if name else path
            if not to.is_file() or (anchor and to in pages and unquote(anchor) not in pages[to].anchors):
                broken.append(f"{path.relative_to(site)}: {target}")
    if broken:
        raise PluginError("links that lead nowhere, or files from other places:\n" + "\n".join(sorted(broken)))
