"""The tool that traces numerals: wrong ones are found, right ones have their source."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest

import numerals
from execute import read

CODE = '''n_members = 40
gain = 0.25
print("error 3.62 m, failed 7% of runs, evidence 1.7e-06")
assert gain < 0.5, "two thirds of the members agree"'''
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


def untraced(folder: Path, **changes: str) -> list[str]:
    """Return the numerals without a source of the page, with some of them changed."""
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
    found, facts = numerals.read_chapter(source)
    sources = [n.source or numerals.trace(n, numerals.Facts(facts)) for n in found]
    return [n.text for n, text in zip(found, sources, strict=True) if not text]


def test_every_right_numeral_has_a_source(tmp_path: Path) -> None:
    assert untraced(tmp_path) == []


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
    assert len(untraced(tmp_path, **{name: wrong})) == 1


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
