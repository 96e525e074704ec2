"""List the public names that the book never uses: a warning in ``make style``, never a failure.

    python -m tests.tools.reach

A name counts as used if the code of a page, a study or an example contains it, if a page's text has
it in backticks, or if a public function is annotated to return it.
"""

from __future__ import annotations

import re
from pathlib import Path

from tests.tools.calls import public_names, subpackages

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^(`{3,}).*?^\1", re.S | re.M)
INLINE = re.compile(r"`[^`]+`")
RETURNED = re.compile(r"-> .*?:\n", re.S)


def code_of_pages() -> str:
    """Return the code of the book: cells, words in backticks, studies and examples."""
    book = ROOT / "book"
    pages = [page.read_text(encoding="utf-8") for page in book.glob("*.md")]
    text = "\n".join(pages)
    pieces = [match[0] for match in BLOCK.finditer(text)]
    pieces += INLINE.findall(BLOCK.sub("", text))
    for folder in ("studies", "examples"):
        scripts = (book / folder).glob("*.py")
        pieces += [script.read_text(encoding="utf-8") for script in scripts]
    return "\n".join(pieces)


def return_annotations() -> str:
    """Return the return annotations of the library; a caller meets these types without import."""
    annotations: list[str] = []
    for path in (ROOT / "distfilt").rglob("*.py"):
        annotations += RETURNED.findall(path.read_text(encoding="utf-8"))
    return "\n".join(annotations)


def unused_names(code: str) -> list[str]:
    """Return the public callables of the library whose names `code` does not contain."""
    # The last part of a name is enough: `filters.run` is used as `run`.
    words = set(re.findall(r"\w+", code))
    unused = []
    for subpackage in subpackages():
        for name, value in public_names(subpackage).items():
            if callable(value) and name.rpartition(".")[2] not in words:
                unused.append(name)
    return sorted(set(unused))


def main() -> None:
    """Print a line for each name, or nothing."""
    for name in unused_names(code_of_pages() + return_annotations()):
        print(f"warning: no page, study or example uses distfilt.{name}")


if __name__ == "__main__":
    main()
