"""List every numeral in the prose of the chapters, and where each comes from.

    python book/tools/numerals.py [CHAPTER ...] [--all]

Prose is the text between the cells with its tables, exercises and solutions, and of the cells the
captions and alternative texts. No value is set into a sentence by the build: a chapter prints its
numbers in outputs, and asserts in cells the statements of its sentences. So a numeral is traced to

check
    an assertion that compares with this value, encloses it between two numbers or says it in its
    message, in the same section; or in another one, if it and the sentence share a word
output
    a stored output of the chapter that prints it to the digits given: anywhere if the numeral has
    three digits that count, else in the same section
parameter
    a number of a cell, of a scenario or of a study that the chapter reads, where the name that the
    number is bound to and the sentence share a word (or units are the same, for a scenario)
published
    a value that the paper printed (``data/published``, or a given value of a scenario), in a
    sentence that speaks of the paper
beside
    nothing but the same number of one or two digits in a cell of the section, under a name that the
    sentence does not use: this is no trace, and is counted apart
arithmetic
    a formula of numbers alone, beside its value: worked out here
cited
    a sentence with a citation
known
    a phrase listed in ``numerals.csv`` with a reason, each on its own line

Numerals of other kinds are left out: names, years, numbers of chapters, sections, figures,
equations and lines, formulas that define something (numbers behind the sign of an equation or
inequality at a formula's end count), and **small** ones, which are counted: words and digits up to
twelve, ordinals, halves and doubles without a unit. A small one with a unit, a percent sign or
"times" counts as any other.

A trace shows that the number exists, not that the sentence is about it. How much that is worth is
measured: each traced numeral is replaced by others of its length, and the share of those that would
be traced as well is printed. The tool ends with an error if a numeral has no trace, or a known
phrase is gone.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import csv
import html
import io
import json
import math
import operator
import re
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from common import BOOK, ROOT, SLIDER, VERDICT, chosen

KNOWN = Path(__file__).with_suffix(".csv")
_UPWARDS = (
    "zero",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
    "eleven",
    "twelve",
    "thirteen",
    "fourteen",
    "fifteen",
    "sixteen",
    "seventeen",
    "eighteen",
    "nineteen",
)
_TENS = ("twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety")
ONES = {word: k for k, word in enumerate(_UPWARDS)}
TENS = {word: 20 + 10 * k for k, word in enumerate(_TENS)}
LARGE = {"hundred": 100, "thousand": 1000, "million": 10**6, "billion": 10**9}
PARTS = {
    "half": 2,
    "third": 3,
    "quarter": 4,
    "fifth": 5,
    "sixth": 6,
    "seventh": 7,
    "eighth": 8,
    "ninth": 9,
    "tenth": 10,
    "twelfth": 12,
    "sixteenth": 16,
    "twentieth": 20,
    "fortieth": 40,
    "fiftieth": 50,
    "ninetieth": 90,
    "hundredth": 100,
    "thousandth": 1000,
    "millionth": 10**6,
}
ORDINAL = ("third", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth", "twelfth")
COUNT = "|".join((*ONES, *TENS, *LARGE))
# "three quarters", "half a million", "two hundred and five", "half"
WORDS = re.compile(
    rf"\b(?:(?:an?|{COUNT})(?:[ -](?:{COUNT}))*[ -](?:of an? )?(?:{'|'.join(PARTS)})s?\b"
    rf"|half an?(?= (?:million|thousand|hundred))(?: (?:{'|'.join(LARGE)}))"
    rf"|(?:an? )?(?:{COUNT})(?:[ -](?:{COUNT})| and a half"
    rf"|(?:(?<=hundred)|(?<=thousand)|(?<=million)) and (?:{COUNT}))*\b"
    rf"|(?:half|halves|twice|quarter|third)\b)",
    re.I,
)
# "12", "-1.5e-3", "10 000" with a blank, ".5"; not the digits of a name such as x1
DIGITS = re.compile(
    r"(?<![\w.])[-−]?(?:\d{1,3}(?:[ \u00a0\u2009]\d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?"
    r"(?!\w*[a-zA-Z]\d)"
    r"|(?<![\w.])\.\d+"
)
UNITS = {
    r"%|per ?cent\b": (0.01,),
    r"times\b|-fold\b|fold\b": (),
    r"km\b|kilomet": (1e3, 1e-3),
    r"mm\b|millimet": (1e-3, 1e-6),
    r"m/s\b": (1e-3,),
    r"m²?\b(?!-)|metres?\b": (1e-3, 1e3),
    r"h\b|hours?\b": (3600.0,),
    r"min\b|minutes?\b": (60.0,),
    r"s\b|seconds?\b": (1000.0,),
    r"days?\b": (86400.0, 24.0),
    r"°|degrees?\b": (3.141592653589793 / 180,),
    r"rad\b|radian": (),
    r"nats?\b": (),
    r"arcsec": (),
    r"orders? of": (),
    r"Hz\b": (),
}
"""Units after a number, and factors by which its value may be multiplied in the code."""
LABELS = (
    r"chapters?|figs?\.|figures?|tables?|sections?|equations?|eqs?\.|algorithms?|lines?|steps?"
    r"|items?|agents?|parts?|exercises?|rows?|version|theorems?|pages?|panels?|mixands?|sensors?"
    r"|conditions?|neighbours?|bodies|body|component|column|node|member|lemma|corollary|order"
    r"|degree|tables|level|satellites?|robots?|state|appendix"
)
COMMON = {
    "that",
    "this",
    "with",
    "from",
    "which",
    "than",
    "what",
    "have",
    "more",
    "most",
    "less",
    "least",
    "each",
    "every",
    "both",
    "other",
    "such",
    "they",
    "their",
    "there",
    "then",
    "when",
    "where",
    "here",
    "only",
    "into",
    "over",
    "under",
    "about",
    "after",
    "before",
    "same",
    "some",
    "many",
    "very",
    "does",
    "would",
    "could",
    "should",
    "between",
    "because",
    "number",
    "numbers",
    "times",
    "value",
    "values",
    "first",
    "second",
    "last",
    "name",
    "label",
    "title",
    "size",
    "shape",
    "axis",
    "default",
    "float",
    "array",
    "numpy",
    "list",
    "dict",
    "range",
    "print",
    "text",
    "kwargs",
    "index",
    "color",
    "alpha",
    "marker",
    "style",
    "figure",
    "table",
    "caption",
}


@dataclass
class Numeral:
    """One number of the prose, and where it stands."""

    chapter: str
    line: int
    section: int
    text: str
    value: float
    step: float
    """One unit in the last digit that is given."""
    unit: str
    sentence: str
    kind: str = ""
    """"small", "arithmetic", or "" for one that needs a source."""
    source: str = ""
    words: frozenset[str] = frozenset()


@dataclass
class Fact:
    """A number of a run, or an interval, with the words of its name."""

    kind: str
    low: float
    high: float
    where: str
    section: int = -1
    words: frozenset[str] = field(default_factory=frozenset)
    unit: str = ""
    half: float = 0.0
    """Half a unit in the last digit that an output prints."""


def stems(text: str) -> frozenset[str]:
    """Return the first letters of the words that carry meaning."""
    words = re.findall(
        r"[a-zA-Zε-ω]{3,}", re.sub(r"([a-z])([A-Z])|_", r"\1 \2", text).lower()
    )
    parts = [*words, *re.findall(r"[a-z]+_[a-z_]+", text)]
    return frozenset(
        w if "_" in w else w[:5] for w in parts if w not in COMMON and w not in ONES
    )


def number(text: str) -> float:
    """Return the value of a numeral in words or digits."""
    low = text.lower().replace("-", " ")
    if re.search(r"\d", text):
        return float(re.sub(r"[   \u2009]", "", text.replace("−", "-")))
    if low == "twice":
        return 2.0
    # "three-thousandths": a count of one of the large parts.
    pattern = r"(?:an? )?(\w+)-(hundred|thousand|million)ths?"
    fraction = re.fullmatch(pattern, text.lower())
    if fraction:
        return 1 / (number(fraction[1]) * LARGE[fraction[2]])
    # "two hundred thousand and a half": parts are added, large words multiply.
    total = 0.0
    part = 0.0
    share = 1.0
    for word in low.split():
        single = word.removesuffix("s") if word != "halves" else "half"
        if word in ONES or word in TENS:
            part += {**ONES, **TENS}[word]
        elif word in LARGE:
            part = max(part, 1.0) * LARGE[word] if part != 0.5 else 0.5 * LARGE[word]
            total = total + (part if word != "hundred" else 0)
            part = part * (word == "hundred")
        elif single in PARTS:
            if word == "half" and low.endswith("and a half"):
                return total + part + 0.5
            if word == "half" and "half a" in low:
                part = 0.5
            else:
                share = 1 / PARTS[single]
                return (total + part or 1.0) * share
    return total + part


def digits(text: str) -> int:
    """Return the number of significant digits."""
    return len(re.sub(r"e.*|[^0-9]", "", text).lstrip("0"))


def step_of(text: str, value: float) -> float:
    """Return one unit in the last digit; for words, a fifth of a fraction, else one."""
    if re.search(r"\d", text):
        # 1.20e3 has two decimals, and its last digit is worth 10.
        mantissa, _, power = text.partition("e")
        return 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    return 1.0 if value == int(value) else 0.2 * abs(value)


# --- the prose ----------------------------------------------------------------------------------

CELL = re.compile(
    r"^(`{3,})\{code-cell\}[^\n]*\n(?:---\n(?P<yaml>.*?)^---\n|(?::\w+:[^\n]*\n)+)?(?P<code>.*?)^\1$",
    re.M | re.S,
)


def pieces(text: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, kind ("prose" or "code") and text of the parts of a chapter, in order."""
    text = re.sub(
        r"\A---\n.*?^---\n", lambda m: "\n" * m[0].count("\n"), text, flags=re.M | re.S
    )
    position = 0
    for cell in CELL.finditer(text):
        yield text.count("\n", 0, position) + 1, "prose", text[position : cell.start()]
        line = text.count("\n", 0, cell.start()) + 1
        header = cell["yaml"] or ""
        for option in re.finditer(
            r"^ *(caption|alt): >-\n((?: {6,}.*\n)+)", header, re.M
        ):
            yield line, "prose", f"\n\n{option[2]}\n\n"
        yield line, "code", cell["code"]
        position = cell.end()
    yield text.count("\n", 0, position) + 1, "prose", text[position:]


FORMULA = re.compile(r"\$([^$]+)\$")


def evaluate(text: str) -> float | None:
    """Return the value of a formula of numbers only, or None."""
    # TeX becomes Python: \frac12, \frac{1}{2}, \sqrt{2}, |x|, e^x, \cdot, 2\pi.
    text = re.sub(r"\\[td]?frac(\d)(\d)", r"(\1/\2)", text)
    text = re.sub(r"\\[td]?frac\{([^{}]*)\}\{([^{}]*)\}", r"((\1)/(\2))", text)
    text = re.sub(r"\\(sqrt|log)\s*\{?(\d+)\}?", r"\1(\2)", text)
    text = (
        re.sub(r"\|([^|]+)\|", r"abs(\1)", text)
        .replace("\\pi", "(pi)")
        .replace("e^", "exp^")
    )
    text = (
        re.sub(r"\\cdot|\\times", "*", text)
        .replace("^", "**")
        .replace("exp**", "(2.718281828)**")
    )
    text = re.sub(r"\\[,; ]|[\s{}]", "", text)
    text = re.sub(r"(?<=[\d)])(?=[a-z(])", "*", text)
    # With any other name it is a definition, not arithmetic.
    if not re.fullmatch(r"(?:sqrt|log|abs|pi|[-+*/().\d])+", text) or not re.search(
        r"[-+*/a-z]", text
    ):
        return None
    names = {"sqrt": math.sqrt, "log": math.log, "abs": abs, "pi": math.pi}
    try:
        return float(eval(text, {"__builtins__": {}}, names))
    except (SyntaxError, ArithmeticError, TypeError, ValueError):
        return None


def of_formula(match: re.Match[str]) -> str:
    """Return the text that replaces a formula: a blank, or the number at its end."""
    formula = (
        match[1].replace("{,}", "").replace("\\,", " ").replace("\\%", "%").strip()
    )
    # "2 + 3 = 5": the number at the end is checked here, if the rest is numbers only.
    parts = re.split(r"(=|\\approx)", formula)
    if len(parts) > 2 and re.fullmatch(r" ?-?\d+(?:\.\d+)? ?", parts[-1]):
        value = float(parts[-1])
        exact = evaluate(parts[-3])
        loose = 0.02 * abs(value) if "approx" in parts[-2] else 0.0
        if exact is not None and abs(exact - value) <= max(
            loose, 0.5001 * step_of(parts[-1].strip(), value)
        ):
            return f" {parts[-1].strip()} ≗ "
    # "2 · 10^3" is one number.
    power = re.fullmatch(r"(?:(.*)\\(?:cdot|times) ?)?10\^\{?(-?\d+)\}?", formula)
    if power and re.fullmatch(r"[\d.]*", power[1] or ""):
        return f" {float(power[1] or 1) * 10.0 ** int(power[2]):g} "
    if re.fullmatch(r"\\?(?:pm)?[-\d. %]+", formula):
        return f" {formula.removeprefix(chr(92) + 'pm')} "
    # "x = 3.5": the number at the end is a statement, but 0 and 1 are mostly
    # definitions.
    last = re.search(
        r"(?:=|\\approx|<|>|\\leq?|\\geq?|\\pm) ?(-?\d+(?:\.\d+)?)(?:\\?[ ,;]*)$",
        formula,
    )
    return f" ({last[1]}) = " if last and float(last[1]) not in (0, 1) else " "


def plain(text: str) -> str:
    """Return prose without code, roles, addresses, comments and definitions, with its lines."""
    # A part that is removed leaves its line breaks, so that line numbers stay right.
    keep = lambda m: "\n" * m[0].count("\n")  # noqa: E731
    text = re.sub(
        r"^(`{3,})\{(?:math|include|eval-rst)\}.*?^\1$", keep, text, flags=re.M | re.S
    )
    text = re.sub(r"^(`{3,}|:{3,}).*$|^:\w+:.*$|^%.*$|^\(.*\)=$", "", text, flags=re.M)
    text = re.sub(r"\$\$.*?\$\$", keep, text, flags=re.S)
    # A mark stands for a citation, which `trace` accepts as a source.
    text = re.sub(r"\{cite:\w\}`[^`]*`", " ⸢cited⸣ ", text)
    text = re.sub(r"\{[\w:]+\}`[^`]*`", " ", text)
    text = re.sub(r"`([^`]*)`", lambda m: " " + re.sub(r"[^A-Za-z_]+", " ", m[1]), text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = FORMULA.sub(lambda m: of_formula(m) + "\n" * m[0].count("\n"), text)
    # The number of a table's row, and of a list's item
    text = re.sub(r"^\| *\d+ *\|", "|", text, flags=re.M)
    text = re.sub(r"^( *)\d+\. ", r"\1", text, flags=re.M)
    return text


def structure(sentence: str) -> str:
    """Blank out numbers of figures, equations and the like in a sentence, without moving text."""
    blank = lambda m: re.sub(r"\S", "_", m[0])  # noqa: E731
    number_list = r"\d+[a-z]?(?:(?:, | and | to | or |-|–|/)\d+[a-z]?)*\b(?!\.\d| ?%)"
    roman = r"[IVX]+\b(?:(?:, | and | to )[IVX]+\b)*"
    text = re.sub(
        rf"\b(?:{LABELS})\s+(?:{number_list}|{roman})", blank, sentence, flags=re.I
    )
    # References such as (12), names such as x1 or 2-D, "12, 2003)" of a citation
    text = re.sub(r"\((?!\d+\) =)\d{1,2}[a-z]?\)(?:-\(\d+\))?", blank, text)
    text = re.sub(r"\b[A-Za-z]+\d[\w.]*|\b\d+-D\b|\b\d+[a-zA-Z]\w*-", blank, text)
    text = re.sub(r"\b\d+, (?:19|20)\d\d\)", blank, text)
    return re.sub(
        r"(?<![\d.] )(?<![\d.])\b(?:19|20)\d\d\b(?! ?(?:m|s|km|runs|draws|points)\b|\.\d)",
        blank,
        text,
    )


def numerals_of(piece: str, chapter: str, line: int, section: int) -> Iterator[Numeral]:
    """Yield the numerals of one piece of prose."""
    for block in re.finditer(r"(?:[^\n]+\n?)+", plain(piece)):
        start = line + piece_line(plain(piece), block.start())
        text = block[0]
        # A sentence ends at a full stop and a blank, but not after "Fig." or "Eq.".
        for match in re.finditer(
            r"(?s).+?(?:(?<!Fig)(?<!Figs)(?<!Eq)(?<!Prop)(?<!cf)[.!?:](?=\s)|\|\n|$)",
            text,
        ):
            sentence = " ".join(match[0].split())
            clean = structure(sentence)
            spans: list[tuple[int, int]] = []
            for shape in (DIGITS, WORDS):
                for hit in shape.finditer(clean):
                    # "2 hundred" is matched by digits and by words: the first match
                    # counts.
                    if any(a < hit.end() and hit.start() < b for a, b in spans):
                        continue
                    spans.append(hit.span())
                    yield from one(
                        hit,
                        clean,
                        sentence,
                        chapter,
                        start + text[: match.start()].count("\n"),
                        section,
                    )


def piece_line(text: str, at: int) -> int:
    return text.count("\n", 0, at)


def one(
    hit: re.Match[str], clean: str, sentence: str, chapter: str, line: int, section: int
) -> Iterator[Numeral]:
    """Yield the numeral of one match, with its unit and whether it is a small one."""
    text = hit[0].strip()
    # The unit follows the number, after a blank or a hyphen.
    after = clean[hit.end() :].lstrip(" -)")
    value = number(text)
    unit = next((u for u in UNITS if re.match(u, after)), "")
    # "A third filter" and "a second one" count things, they measure nothing.
    if text.lower() in ("third", "quarter", "a second") and not unit:
        return
    is_integer = value == int(value)
    tiny = (is_integer and abs(value) <= 12) or value == 0.5
    ordinal = text.lower().removeprefix("a ") in ORDINAL and not re.match(
        r"of\b", after
    )
    # An article, or "one" as a pronoun, is no numeral.
    if re.fullmatch(r"(?:an?|one)", text, re.I):
        return
    if after.startswith("≗"):
        yield Numeral(
            chapter, line, section, text, value, 0.0, "", sentence, "arithmetic"
        )
        return
    # "2 to 3 s": the unit of the second number is that of the first one too.
    interval = re.match(
        rf"(?:to|and|or|–) (?:{DIGITS.pattern}|{COUNT}) ?({'|'.join(UNITS)})", after
    )
    if interval and not unit:
        unit = next(u for u in UNITS if re.match(u, interval[1]))
    # Small numbers without a unit need no source.
    kind = "small" if (tiny and not unit) or ordinal else ""
    if text.lower() in ("one", "two") and unit.startswith(("s", "m", "day")):
        kind = "small"
    yield Numeral(
        chapter,
        line,
        section,
        text,
        value,
        step_of(text, value),
        unit,
        sentence,
        kind,
        words=stems(sentence),
    )


# --- the numbers of the code and its outputs ------------------------------------------------------


ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}


def constant(node: ast.AST) -> float | None:
    """Return the value of an expression of constants, or None."""
    # `type` instead of isinstance, since True is an int.
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return float(node.value)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        operand = constant(node.operand)
        return None if operand is None else -operand
    if isinstance(node, ast.BinOp):
        a = constant(node.left)
        b = constant(node.right)
        if a is not None and b is not None:
            with contextlib.suppress(KeyError, ArithmeticError, TypeError):
                return float(ARITHMETIC[type(node.op)](a, b))
    return None


def numbers_compared_with(node: ast.AST) -> Iterator[float]:
    """Yield the numbers of one side of a comparison: alone, in a list, as a factor or a term."""
    value = constant(node)
    if value is not None:
        yield value
    elif isinstance(node, ast.List | ast.Tuple):
        for item in node.elts:
            yield from numbers_compared_with(item)
    elif isinstance(node, ast.Dict):
        for item in (*node.keys, *node.values):
            if item is not None:
                yield from numbers_compared_with(item)
    # 0.5 * x: the factor 0.5 is compared with.
    elif isinstance(node, ast.BinOp):
        yield from numbers_compared_with(node.left)
        yield from numbers_compared_with(node.right)
    elif isinstance(node, ast.Call) and node.args:
        # abs(x - 3) and log(2) compare with 3 and 2.
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if name in ("abs", "array", "log", "sqrt", "log10", "deg2rad"):
            yield from numbers_compared_with(node.args[0])


def checks(node: ast.Assert, section: int, where: str) -> Iterator[Fact]:
    """Yield the numbers of an assertion's comparisons and of its message."""
    words = stems(ast.unparse(node))
    values = set()
    for part in ast.walk(node.test):
        if isinstance(part, ast.Compare):
            sides = [part.left, *part.comparators]
            ends = [constant(s) for s in sides]
            # 0.1 < x < 0.3 encloses the numerals between both ends.
            if len(sides) == 3 and ends[0] is not None and ends[2] is not None:
                low, high = sorted((ends[0], ends[2]))
                yield Fact("check", low, high, where, section, words)
            for side in sides:
                values.update(numbers_compared_with(side))
        elif isinstance(part, ast.Call):
            name = getattr(part.func, "attr", getattr(part.func, "id", ""))
            if name in ("isclose", "allclose", "array_equal"):
                for side in part.args[:2]:
                    values.update(numbers_compared_with(side))
    for value in values:
        yield Fact("check", value, value, where, section, words)
    message = node.msg.value if isinstance(node.msg, ast.Constant) else ""
    for numeral in numerals_of(str(message) + "\n", "", 0, 0):
        yield Fact(
            "check",
            numeral.value,
            numeral.value,
            where,
            section,
            words,
            numeral.unit or "no unit",
        )


class CodeNumbers:
    """Walk over code and yield its numbers with the names that they are bound to."""

    def __init__(self, code: str, where: str, section: int, kind: str) -> None:
        self.where = where
        self.section = section
        self.kind = kind
        self.tree = ast.parse(code)
        self.comments: dict[int, str] = {}
        for token in tokenize.generate_tokens(io.StringIO(code).readline):
            if token.type == tokenize.COMMENT:
                self.comments[token.start[0]] = token.string
        # The first entry that fits a node says how its names are found.
        self.visitors: list[tuple[Any, Callable[..., Iterator[Fact]]]] = [
            (ast.Assign | ast.AnnAssign, self.visit_assignment),
            (ast.Call, self.visit_call),
            (ast.Dict, self.visit_dict),
            (ast.FunctionDef, self.visit_function),
            (ast.For, self.visit_loop),
            (ast.BinOp | ast.Compare, self.visit_operation),
        ]

    def visit(self, node: ast.AST, names: tuple[str, ...]) -> Iterator[Fact]:
        """Yield the numbers below a node; those of assertions are checks, not parameters."""
        if isinstance(node, ast.Assert):
            return
        value = constant(node) if isinstance(node, ast.expr) else None
        if value is not None:
            yield self.fact(node, value, names)
            # The terms of a sum or product of constants count as well.
            if not isinstance(node, ast.BinOp):
                return
        for kind, visitor in self.visitors:
            if isinstance(node, kind):
                yield from visitor(node, names)
                return
        yield from self.visit_all(ast.iter_child_nodes(node), names)

    def visit_all(
        self, nodes: Iterable[ast.AST], names: tuple[str, ...]
    ) -> Iterator[Fact]:
        """Yield the numbers below several nodes."""
        for node in nodes:
            yield from self.visit(node, names)

    def fact(self, node: Any, value: float, names: tuple[str, ...]) -> Fact:
        """Return one number with the words of its names and of the comment beside it."""
        # The nearest names say most; those further out name whole functions.
        words = stems(" ".join((*names[-3:], self.comments.get(node.lineno, ""))))
        where = f"{self.where}: {'.'.join(names[-2:])}"
        return Fact(self.kind, value, value, where, self.section, words)

    def visit_assignment(self, node: Any, names: tuple[str, ...]) -> Iterator[Fact]:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        target = " ".join(ast.unparse(t) for t in targets)
        if node.value is not None:
            yield from self.visit(node.value, (*names, target))

    def visit_call(self, node: ast.Call, names: tuple[str, ...]) -> Iterator[Fact]:
        call = (*names, ast.unparse(node.func)[-40:])
        yield from self.visit_all(node.args, call)
        for word in node.keywords:
            yield from self.visit(word.value, (*call, word.arg or ""))
        yield from self.visit(node.func, names)

    def visit_dict(self, node: ast.Dict, names: tuple[str, ...]) -> Iterator[Fact]:
        for key, item in zip(node.keys, node.values, strict=True):
            # A text as a key is a name of its value; any other key may hold numbers.
            label = str(key.value) if isinstance(key, ast.Constant) else ""
            if key is not None and not label:
                yield from self.visit(key, names)
            yield from self.visit(item, (*names, label))

    def visit_function(
        self, node: ast.FunctionDef, names: tuple[str, ...]
    ) -> Iterator[Fact]:
        spec = node.args
        # Defaults belong to the last positional arguments, so both are read from the end.
        pairs = [
            *zip(spec.args[::-1], spec.defaults[::-1], strict=False),
            *zip(spec.kwonlyargs, spec.kw_defaults, strict=True),
        ]
        for argument, default in pairs:
            if default is not None:
                yield from self.visit(default, (*names, node.name, argument.arg))
        # Inside a function its own name counts, not those around its definition.
        yield from self.visit_all(node.body, (node.name,))

    def visit_loop(self, node: ast.For, names: tuple[str, ...]) -> Iterator[Fact]:
        yield from self.visit(node.iter, (*names, ast.unparse(node.target)))
        yield from self.visit_all([*node.body, *node.orelse], names)

    def visit_operation(self, node: ast.AST, names: tuple[str, ...]) -> Iterator[Fact]:
        operands = " ".join(re.findall(r"[A-Za-z_]{3,}", ast.unparse(node)))[:80]
        yield from self.visit_all(ast.iter_child_nodes(node), (*names, operands))


def parameters(
    code: str, where: str, section: int = -1, kind: str = "parameter"
) -> Iterator[Fact]:
    """Yield the numbers of some code with their names and the comments beside them."""
    numbers = CodeNumbers(code, where, section, kind)
    yield from numbers.visit(numbers.tree, ())


NUMBER = re.compile(
    r"(?<![\w.])[-−]?(?:\d{1,3}(?: \d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\d)"
)


def rows_of(page: str) -> Iterator[tuple[str, str]]:
    """Yield the rows of the tables of HTML, each with the words of its caption and header."""
    bare = lambda t: html.unescape(re.sub(r"<[^>]+>", " ", t))  # noqa: E731
    page = re.sub(r"<style.*?</style>", "", page, flags=re.S)
    for block in re.split(r"(?=<table)", page):
        rows = re.split(r"(?=<tr)", block)
        # A number of a table is named by the caption and the head of its column.
        head = bare(
            " ".join(
                re.findall(r"<caption.*?</caption>|<thead.*?</thead>", block, re.S)
            )
        )
        for row in rows:
            yield bare(row), head


def output_facts(cell: Any, section: int, where: str) -> Iterator[Fact]:
    """Yield the numbers that a cell's stored outputs print, without digests of pictures."""
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        page = "".join(data.get("text/html", ""))
        # The text of a picture is a digest, whose digits prove nothing.
        if SLIDER in page or any(mime.startswith("image/") for mime in data):
            continue
        verdict = [(str(v), "") for v in data.get(VERDICT, {}).values()]
        plain_text_of_output = "" if page else "".join(data.get("text/plain", ""))
        lines = [
            (line, "")
            for line in (
                "".join(output.get("text", "")) + plain_text_of_output
            ).splitlines()
        ]
        for row, head in (*rows_of(page), *verdict, *lines):
            words = stems(f"{row} {head}")
            for match in NUMBER.finditer(f"{row}\n{head}"):
                value = number(match[0])
                yield Fact(
                    "output",
                    value,
                    value,
                    where,
                    section,
                    words,
                    half=0.5 * step_of(match[0], value),
                )


def flat(value: Any) -> Iterator[float]:
    """Yield the numbers of a nested list, and the lengths of its parts."""
    if isinstance(value, list):
        yield float(len(value))
        for item in value:
            yield from flat(item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield float(value)


def entry_facts(
    name: str, entry: dict[str, Any], title: str, file: str
) -> Iterator[Fact]:
    """Yield the numbers of one parameter or note of a scenario, and those of its reason."""
    kind = "published" if entry.get("source") == "given" else "parameter"
    texts = [str(entry.get(key, "")) for key in ("unit", "where", "reason", "note")]
    reason = " ".join(texts)
    words = stems(f"{name} {title}")
    where = f"{file}: {name}"
    for value in flat(entry["value"]):
        # A value that the paper gives counts as published and as a parameter.
        for k in {kind, "parameter"}:
            unit = str(entry["unit"])
            yield Fact(k, value, value, where, words=words, unit=unit)
    for match in NUMBER.finditer(reason):
        # One digit in a reason would match too many sentences.
        if digits(match[0]) > 1:
            value = number(match[0])
            words_of_reason = stems(f"{name} {reason}")
            yield Fact("parameter", value, value, where, words=words_of_reason)


def row_facts(key: str, row: dict[str, Any], file: str) -> Iterator[Fact]:
    """Yield the numbers of one row of a scenario's table."""
    for name, cell in row.items():
        words = stems(f"{key} {name}")
        for value in flat(cell):
            where = f"{file}: {key}.{name}"
            yield Fact("parameter", value, value, where, words=words)


@cache
def scenario_facts(path: Path) -> tuple[Fact, ...]:
    """Return the numbers of a scenario; a given value counts as published by the paper."""
    facts: list[Fact] = []
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    file = f"{path.stem}.toml"
    title = data.get("title", "")
    entries = [*data.get("parameters", {}).items(), *data.get("notes", {}).items()]
    for name, entry in entries:
        facts += entry_facts(name, entry, title, file)
    for key, rows in data.items():
        for row in rows if isinstance(rows, list) else ():
            facts += row_facts(key, row, file)
    return tuple(facts)


@cache
def study_facts(name: str) -> tuple[Fact, ...]:
    """Return the numbers of a study's script and its imports, and its number of stored rows."""
    path = BOOK / "studies" / f"{name.replace('-', '_')}.py"
    if not path.is_file():
        return ()
    code = path.read_text(encoding="utf-8")
    facts = list(parameters(code, path.name))
    # A study that imports another script uses its numbers too.
    for other in re.findall(
        r"^(?:import|from) (\w+)|script\(\"([\w-]+)\"\)", code, re.M
    ):
        facts += study_facts(other[0] or other[1])
    label = re.search(r'^NAME.*?"([\w-]+)"', code, re.M)
    for stored in (ROOT / "data" / "studies").glob(
        f"*/{label[1] if label else name}.csv"
    ):
        rows = [
            r for r in stored.read_text(encoding="utf-8").splitlines() if r[:1] != "#"
        ]
        # The number of stored trials is the size of the study.
        facts.append(
            Fact(
                "parameter",
                len(rows) - 1,
                len(rows) - 1,
                f"rows of {stored.name}",
                words=stems("runs seeds pairs study stored trials times draws"),
            )
        )
    return tuple(facts)


@cache
def defaults() -> dict[str, tuple[Fact, ...]]:
    """Return the default values of the library's functions, by function."""
    facts: dict[str, tuple[Fact, ...]] = {}
    files = [
        *(ROOT / "distfilt").rglob("*.py"),
        *(BOOK / "kit" / "bookkit").rglob("*.py"),
    ]
    for path in sorted(files):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                # Only the head of a function, with an empty body: its defaults.
                signature = ast.FunctionDef(node.name, node.args, [ast.Pass()], [])
                code = ast.unparse(ast.fix_missing_locations(signature))
                facts[node.name] = (
                    *facts.get(node.name, ()),
                    *parameters(code, node.name),
                )
    return facts


@cache
def paper_facts(paper: str) -> tuple[Fact, ...]:
    """Return the numbers that a paper prints, as stored."""
    facts = []
    for path in sorted((ROOT / "data" / "published" / paper).iterdir()):
        for match in NUMBER.finditer(path.read_text(encoding="utf-8")):
            value = number(match[0])
            facts.append(
                Fact("published", value, value, f"published/{paper}/{path.name}")
            )
    return tuple(facts)


# --- the trace -----------------------------------------------------------------------------------

PAPERS_OF = {
    "01": "grange",
    "02": "grange",
    "04": "grange",
    "03": "grange",
    "05": "das",
    "06": "das",
    "07": "semeraro",
    "08": "semeraro",
    "09": "zheng",
    "10": "zheng",
}
SPEAKS = re.compile(
    r"paper|print|publish|\btable|\bfig|algorithm|section|title|caption|\(\d+\)", re.I
)


def factors(unit: str) -> tuple[float, ...]:
    return (1.0, *(UNITS[unit] if unit else ()))


def nearby(facts: list[Fact]) -> Callable[[Numeral], list[Fact]]:
    """Return a function that preselects the facts that a numeral may refer to, for `trace`."""
    # Arrays of all facts, since `trace` is called for thousands of replacements.
    low, high = np.array([(f.low, f.high) for f in facts], dtype=float).reshape(-1, 2).T

    def find(n: Numeral) -> list[Fact]:
        scale = np.array(factors(n.unit))
        values = n.value * scale
        half = 0.501 * n.step * scale
        with np.errstate(divide="ignore"):
            # A numeral may be written as x, 1/x ("a fifth" for 5), 1 + x or 1 - x
            # (percents).
            targets = np.concatenate([values, 1 / values, 1 + values, 1 - values])[
                :, None
            ]
        printed = np.pad(half, (0, 3 * len(half)))[:, None]
        reach = 1e-9 + 1e-6 * abs(targets) + printed
        narrow = high - low <= 0.41 * abs(values).max()
        inside = (low - reach <= targets) & (targets <= high + reach) & narrow
        meets = inside | (abs(abs(low) - abs(targets)) <= reach)
        return [facts[k] for k in np.flatnonzero(meets.any(axis=0))]

    return find


def is_small(n: Numeral) -> bool:
    """Return whether a numeral is a whole number of one or two digits."""
    return n.value == int(n.value) and digits(n.text) < 3


def is_long(n: Numeral) -> bool:
    """Return whether a numeral has three digits that count: it is hardly there by chance."""
    return digits(n.text) > 2


def slack(value: float) -> float:
    """Return by how much two equal numbers may differ by rounding."""
    return 1e-9 + 1e-6 * abs(value)


def matches_check(n: Numeral, f: Fact, factor: float) -> bool:
    """Return whether an assertion compares with the numeral, or encloses it."""
    value = n.value * factor
    nearby_section = f.section == n.section
    shared = bool(n.words & f.words)
    if f.unit:  # said by the assertion's message
        equal = f.low == value and f.unit == (n.unit or "no unit")
        return factor == 1 and equal and (nearby_section or shared)
    as_written = n.value >= 1 or re.search(r"\d", n.text)
    # "a fifth" in words may be the number 5 of an assertion.
    targets = [value] if as_written else [value, 1 / value]
    if n.unit.startswith("%") and factor < 1:
        targets += [1 + value, 1 - value]
    margin = slack(value)
    enclosed = any(f.low - margin <= t <= f.high + margin for t in targets)
    # A wide interval encloses anything: it is no trace.
    if not enclosed or f.high - f.low > 0.41 * abs(value):
        return False
    in_section = nearby_section and (shared or not is_small(n))
    return in_section or (shared and is_long(n))


def matches_output(n: Numeral, f: Fact, factor: float) -> bool:
    """Return whether an output prints the numeral to the digits given."""
    half = 0.5001 * n.step * factor
    # The output must be as precise as the sentence, or more.
    if abs(abs(n.value * factor) - abs(f.low)) > half or f.half > half:
        return False
    shared = bool(n.words & f.words)
    in_section = f.section == n.section and (shared or not is_small(n))
    return is_long(n) or in_section


def matches_published(n: Numeral, f: Fact, factor: float) -> bool:
    """Return whether the paper printed the numeral and the sentence speaks of the paper."""
    value = n.value * factor
    if abs(abs(value) - abs(f.low)) > slack(value) or not SPEAKS.search(n.sentence):
        return False
    if not f.words:
        return not is_small(n)
    return bool(n.words & f.words)


def matches_parameter(n: Numeral, f: Fact, factor: float) -> bool:
    """Return whether a parameter has the value, under a name or unit of the sentence."""
    value = n.value * factor
    if abs(abs(value) - abs(f.low)) > slack(value):
        return False
    two_units = f.unit and n.unit
    # With two units they must agree; a shared word is not enough.
    if two_units and re.search(rf"(?:^|[ ,])(?:{n.unit})", f.unit):
        return True
    if n.words & f.words and not two_units:
        return True
    return f.section == n.section and not is_small(n)


MATCHERS = {
    "check": matches_check,
    "output": matches_output,
    "published": matches_published,
    "parameter": matches_parameter,
}


def trace(n: Numeral, facts: list[Fact]) -> str:
    """Return where a numeral comes from, or ''; the strongest trace first."""
    best: dict[str, str] = {}
    for f in sorted(facts, key=lambda f: f.section != n.section):
        if f.kind not in best:
            matches = MATCHERS[f.kind]
            if any(matches(n, f, factor) for factor in factors(n.unit)):
                best[f.kind] = f.where
    # The strongest kind of trace is named.
    for kind in ("check", "parameter", "output", "published"):
        if kind in best:
            return f"{kind}: {best[kind]}"
    if "⸢cited⸣" in n.sentence:
        return "cited: by the sentence"
    return trace_beside(n, facts)


def trace_beside(n: Numeral, facts: list[Fact]) -> str:
    """Return the same small number in a cell of the section, whatever its name, or ''."""
    if not is_small(n):
        return ""
    values = [n.value * k for k in factors(n.unit)]
    for f in facts:
        in_code = f.section == n.section and f.kind != "output"
        if in_code and f.low == f.high and abs(f.low) in values:
            return f"beside: {f.where}"
    return ""


def others(n: Numeral) -> Iterator[Numeral]:
    """Yield the same sentence with other numbers of the same length."""
    if re.search(r"\d", n.text) or n.value == int(n.value):
        n_digits = (
            max(digits(n.text), 1)
            if re.search(r"\d", n.text)
            else len(str(int(n.value)))
        )
        unit = (
            n.step
            if re.search(r"\d", n.text)
            else 10.0 ** (len(str(int(n.value)).rstrip("0")) < n_digits)
        )
        # Numbers with as many digits, spread by a multiple of a prime: no random draw.
        low = 10 ** (n_digits - 1)
        high = 10**n_digits
        for k in range(16):
            digits_of_value = low + (7919 * (k + 1) + int(abs(n.value))) % (high - low)
            value = digits_of_value * (n.step if re.search(r"\d", n.text) else 1.0)
            if abs(value - abs(n.value)) > 0.5 * unit * 1e-9:
                yield replace(n, value=value)
    else:
        for k in (3, 4, 5, 7, 8, 9, 12, 15, 20, 30):
            if abs(1 / k - n.value) > 1e-9:
                yield replace(n, value=1 / k, step=0.2 / k)


def prose_numerals(
    piece: str, chapter: str, line: int, section: int
) -> tuple[list[Numeral], int]:
    """Return the numerals of a piece of prose, and the number of the section it ends in."""
    numerals: list[Numeral] = []
    for part in re.split(r"^(?=#+ )", piece, flags=re.M):
        # Every heading starts a section, to which cells after it belong.
        section += part.startswith("#")
        numerals += numerals_of(part, chapter, line, section)
        line += part.count("\n")
    return numerals, section


def code_facts(piece: str, where: str, section: int) -> list[Fact]:
    """Return the numbers of a cell's code: its assertions, then its parameters."""
    facts: list[Fact] = []
    for node in ast.walk(ast.parse(piece)):
        if isinstance(node, ast.Assert):
            facts += checks(node, section, where)
    facts += parameters(piece, where, section)
    return facts


def alternative_texts(piece: str) -> Iterator[str]:
    """Yield the texts that a cell's code gives for readers who do not see a picture."""
    for node in ast.walk(ast.parse(piece)):
        if isinstance(node, ast.keyword) and node.arg == "alt":
            yield ast.unparse(node.value).strip("'\"") + "\n"


def facts_of_sources(source: Path, code: str) -> list[Fact]:
    """Return the numbers of the studies, functions, scenarios and papers of a chapter."""
    facts: list[Fact] = []
    studies = re.findall(r"(?:script\(|stored\(\s*\"\w+\",\s*)\"([\w-]+)\"", code)
    for name in sorted(set(studies)):
        facts += study_facts(name)
    for name in sorted(set(re.findall(r"\b([a-z]\w+)\(", code))):
        facts += defaults().get(name, ())
    # The first page shows results of chapter 4, so it may use its numbers.
    if source.stem == "index":
        for other in chosen(["04", "04b"]):
            facts += [replace(f, section=-1) for f in read(other)[1]]
    paper = PAPERS_OF.get(source.stem[:2])
    if paper:
        for path in sorted((ROOT / "data" / "scenarios" / paper).glob("*.toml")):
            facts += scenario_facts(path)
        facts += paper_facts(paper)
    return facts


def read(source: Path) -> tuple[list[Numeral], list[Fact]]:
    """Return the numerals of a chapter and the numbers of its run."""
    chapter = source.stem
    notebook = json.loads(source.with_suffix(".ipynb").read_text(encoding="utf-8"))
    cells = [c for c in notebook["cells"] if c["cell_type"] == "code"]
    numerals: list[Numeral] = []
    facts: list[Fact] = []
    codes: list[str] = []
    section = 0
    for line, kind, piece in pieces(source.read_text(encoding="utf-8")):
        if kind == "prose":
            more, section = prose_numerals(piece, chapter, line, section)
            numerals += more
            continue
        # Cells of the Markdown and of the notebook are in the same order.
        where = f"cell {len(codes) + 1}"
        for text in alternative_texts(piece):
            numerals += numerals_of(text, chapter, line, section)
        facts += code_facts(piece, where, section)
        facts += output_facts(cells[len(codes)], section, where)
        codes.append(piece)
    return numerals, facts + facts_of_sources(source, "".join(codes))


def main() -> int:
    parser = argparse.ArgumentParser(
        description="List the numerals of the prose and their sources."
    )
    parser.add_argument("chapters", nargs="*", help="names or numbers; all without one")
    parser.add_argument("--all", action="store_true", help="list the traced ones too")
    options = parser.parse_args()
    with KNOWN.open(encoding="utf-8", newline="") as file:
        known_phrases = list(csv.DictReader(file))
    problems = 0
    for source in chosen(options.chapters):
        numerals, facts = read(source)
        text = " ".join(source.read_text(encoding="utf-8").split())
        phrases = [row for row in known_phrases if row["chapter"] == source.stem]
        counts = Counter[str]()
        n_traced = 0
        n_replaced = 0
        find = nearby(facts)
        for n in numerals:
            if n.kind:
                n.source = n.kind
            else:
                n.source = trace(n, find(n))
                # How often would a wrong number have been traced as well?
                if n.source and not n.source.startswith("beside"):
                    replacements = list(others(n))
                    n_replaced += len(replacements)
                    traces = [trace(other, find(other)) for other in replacements]
                    n_traced += sum(bool(f) and f[:6] != "beside" for f in traces)
                elif not n.source:
                    listed = (
                        r
                        for r in phrases
                        if r["phrase"] in n.sentence and n.text in r["phrase"]
                    )
                    n.source = next((f"known: {r['reason']}" for r in listed), "")
            counts[n.source.split(":")[0] or "untraced"] += 1
            if options.all or not n.source:
                print(
                    f"{n.chapter}:{n.line}: {n.text!r}: {n.source or 'UNTRACED'} | {n.sentence}"
                )
        problems += counts["untraced"]
        for row in phrases:
            if " ".join(row["phrase"].split()) not in plain_text(text):
                print(
                    f"{source.stem}: numerals.csv lists a phrase that is gone: {row['phrase']}"
                )
                problems += 1
        summary = ", ".join(f"{v} {k}" for k, v in counts.most_common())
        print(
            f"{source.stem}: {len(numerals)} numerals: {summary}; "
            f"of others in their place {100 * n_traced / max(n_replaced, 1):.0f}% would be traced"
        )
    return int(bool(problems))


def plain_text(text: str) -> str:
    """Prose in one line, as sentences are listed."""
    return " ".join(plain(text).split())


if __name__ == "__main__":
    sys.exit(main())
