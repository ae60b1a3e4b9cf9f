"""How long the pages are, and their sentences: `python tests/words.py` prints the words of every page, and the longest
sentence of each that is for doing."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = ROOT / "README.md"


def pages(*kinds: str) -> list[Path]:
    """The pages of these kinds, which are folders of docs; of all without any."""
    return sorted(page for kind in kinds or ("*",) for page in DOCS.glob(f"{kind}/*.md"))


def words(page: Path) -> int:
    """Everything between spaces, as `wc -w` counts: tables, code and the marks of Markdown too."""
    return len(page.read_text().split())


def sentences(page: Path) -> Iterator[str]:
    """The sentences of a page, without code blocks, written tables and the lines below them, other tables, headings,
    pictures and the addresses of links."""
    text = re.sub(r"^```.*?^```$|<!-- table:.*?<!-- end -->|<!--.*?-->", "\n\n", page.read_text(), flags=re.M | re.S)
    text = re.sub(r"!\[.*?\]\(.*?\)", "", text, flags=re.S)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"^(\||#).*$", "\n", text, flags=re.M)
    for paragraph in re.split(r"\n\s*\n|^\s*(?:[-*]|\d+\.) ", text, flags=re.M):
        for sentence in re.split(r"(?<=[.!?])[*)\"”]*\s+", " ".join(paragraph.split())):
            if sentence:
                yield sentence


def length(sentence: str) -> int:
    """Its words: what has a letter or a digit."""
    return sum(bool(re.search(r"\w", word)) for word in sentence.split())


def longest(page: Path) -> str:
    """The longest sentence of a page."""
    return max(sentences(page), key=length, default="")


def main() -> None:
    """Print words, lines and the longest sentence of each page, and the sum of the words."""
    for page in [README, *pages()]:
        sentence = longest(page)
        shown = f"  {length(sentence):3}: {sentence}" if "-v" in sys.argv else f"  {length(sentence):3}"
        print(f"{page.relative_to(ROOT)!s:44} {words(page):6}{shown}")
    print(f"{'all pages of docs':44} {sum(map(words, pages())):6}")


if __name__ == "__main__":
    main()
