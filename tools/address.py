"""Write the address of the repository into all that names it: the README and the page of the installation, the
notebooks, which get a link that opens them in Colab, and the documentation site.

    python tools/address.py https://github.com/OWNER/infogoal-jax

Another address takes the place of the one before.
"""

import argparse
import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
GITHUB = re.compile(r"https://github\.com/([\w.-]+/[\w.-]+)")
COLAB = "https://colab.research.google.com/github"
BADGE = re.compile(rf"\[Open in Colab\]\({COLAB}\S*\)")


def in_notebook(text: str, name: str, address: str) -> str:
    """The file of a notebook that installs from this address, with a link to Colab below its title."""
    notebook = json.loads(text)
    title, install = notebook["cells"][:2]
    source = "".join(install["source"])
    install["source"] = re.sub(r'SOURCE = "git\+.*"', f'SOURCE = "git+{address}"', source).splitlines(keepends=True)
    badge = f"[Open in Colab]({COLAB}/{GITHUB.fullmatch(address)[1]}/blob/main/notebooks/{name})"
    first, _, rest = "".join(title["source"]).partition("\n")
    rest = BADGE.sub("", rest).lstrip("\n")
    title["source"] = f"{first}\n\n{badge}\n\n{rest}".splitlines(keepends=True)
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


def write(root: Path, address: str) -> None:
    """Write the address into the files below a checkout."""
    for page in (root / "README.md", root / "docs" / "start" / "install.md"):
        page.write_text(re.sub(r"(?m)^REPOSITORY=\S+", f"REPOSITORY={address}", page.read_text()))
    site = root / "mkdocs.yml"
    site.write_text(re.sub(r"(?m)^(?:# )?repo_url: \S+", f"repo_url: {address}", site.read_text()))
    for path in sorted((root / "notebooks").glob("*.ipynb")):
        path.write_text(in_notebook(path.read_text(), path.name, address))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", help="https://github.com/OWNER/NAME")
    address = parser.parse_args().address.removesuffix("/").removesuffix(".git")
    if not GITHUB.fullmatch(address):
        parser.error(f"address = {address!r}: give https://github.com/OWNER/NAME, where Colab opens notebooks from")
    write(ROOT, address)
