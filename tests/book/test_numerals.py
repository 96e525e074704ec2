"""The tool that looks for numerals: right ones are shown, wrong ones are found."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest

import numerals
from execute import read

CODE = """n_members = 40
gain = 0.25
agreeing = 2 / 3
print("error 3.62 m, failed 7% of runs, evidence 1.7e-06")"""
PAGE = """# A page

A filter with {members} members has a gain of {gain}. {share} of the members agree.

```{{code-cell}} ipython3
---
mystnb:
  figure:
    caption: |
      An error of {error} m.
    name: fig-error
  image:
    alt: A line that falls to {low}.
---
{code}
```

The filter failed in {failed}% of runs, its evidence is ${mantissa}\\cdot10^{{{power}}}$,
and $2\\cdot3+1={total}$.
"""
RIGHT = {
    "members": "forty",
    "gain": "0.25",
    "share": "Two thirds",
    "error": "3.62",
    "low": "1.85",
    "failed": "7",
    "mantissa": "1.7",
    "power": "-6",
    "total": "7",
}
DIGEST = "axes 1: 1 line\nline 1 y: 9 values, 1.852..77.4, mean 20.3, projection 55.55"


def unseen(folder: Path, **changes: str) -> list[str]:
    """Return the numerals of the page that are shown nowhere, with some of them changed."""
    source = folder / "page.md"
    source.write_text(PAGE.format(code=CODE, **RIGHT | changes), encoding="utf-8")
    notebook = read(source)
    (cell,) = (c for c in notebook.cells if c.cell_type == "code")
    printed = "error 3.62 m, failed 7% of runs, evidence 1.7e-06\n"
    picture = {"image/png": "", "text/plain": DIGEST}
    cell.outputs = [
        nbformat.v4.new_output("stream", text=printed),
        nbformat.v4.new_output("display_data", data=picture),
    ]
    nbformat.write(notebook, source.with_suffix(".ipynb"))
    found, shown = numerals.read_chapter(source)
    numbers = numerals.Numbers(shown)
    sources = [n.source or numbers.source_of(n) for n in found]
    return [n.text for n, text in zip(found, sources, strict=True) if not text]


def test_every_right_numeral_is_shown(tmp_path: Path) -> None:
    assert unseen(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("members", "fifty"),
        ("gain", "0.35"),
        ("share", "Three fifths"),
        ("error", "3.72"),
        ("low", "1.95"),
        ("failed", "9"),
        ("mantissa", "1.9"),
        ("power", "-4"),
        ("total", "13"),
    ],
)
def test_a_wrong_numeral_is_found(tmp_path: Path, name: str, wrong: str) -> None:
    assert len(unseen(tmp_path, **{name: wrong})) == 1


SECTIONS = """# A page

(sec-runs)=
## Runs

```{code-cell} ipython3
n_runs = 48
start = 0.37
```

## Results

{sentence}
"""


@pytest.mark.parametrize(
    ("sentence", "expected"),
    [
        # A number of another section needs its name, or the section's.
        ("The error is 0.37 m.", ["0.37"]),
        ("The start is 0.37 m.", []),
        ("By {ref}`the runs <sec-runs>` the error is 0.37 m.", []),
        ("It is 48 in all.", ["48"]),
        ("There are 48 runs.", []),
        # A formula is worked out, whatever the cells show.
        ("It is $6\\cdot7=42$.", []),
        ("It is $6\\cdot7=43$.", ["43"]),
    ],
)
def test_a_number_belongs_to_its_section(
    tmp_path: Path, sentence: str, expected: list[str]
) -> None:
    source = tmp_path / "page.md"
    source.write_text(SECTIONS.replace("{sentence}", sentence), encoding="utf-8")
    nbformat.write(read(source), source.with_suffix(".ipynb"))
    found, shown = numerals.read_chapter(source)
    numbers = numerals.Numbers(shown)
    sources = [n.source or numbers.source_of(n) for n in found]
    assert [n.text for n, s in zip(found, sources, strict=True) if not s] == expected


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("twice", 2),
        ("half a million", 500_000),
        ("two and a half", 2.5),
        ("three quarters", 0.75),
        ("a three-hundredth", 1 / 300),
        ("three hundredths", 0.03),
        ("two hundred and five", 205),
        ("twenty-five", 25),
        ("10 000", 10_000),
        ("−1.5e-3", -0.0015),
    ],
)
def test_numerals_in_words_and_digits(text: str, value: float) -> None:
    assert numerals.value_of(text) == pytest.approx(value)


def test_a_formula_is_worked_out() -> None:
    assert numerals.evaluate(r"\tfrac12\sqrt{16}+2^{3}") == 10
    # A name makes it a definition, which is no arithmetic.
    assert numerals.evaluate(r"2x+1") is None
