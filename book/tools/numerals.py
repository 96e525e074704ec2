"""List every numeral in the prose of the chapters, and where each comes from.

    python book/tools/numerals.py [CHAPTER ...] [--all]

Prose is the text between the cells with its tables, exercises and solutions, and of the cells the
captions and alternative texts. No value is set into a sentence by the build: a chapter prints its
numbers in outputs and asserts beside a cell what its sentences say. So a numeral is traced to

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
    a value that the paper printed (``data/published``, or what a scenario calls given), in a
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

What is a numeral of another kind is left out: names, years, numbers of chapters, sections, figures,
equations and lines, formulas that define something (numbers behind the sign of an equation or
inequality at a formula's end count), and **small** ones, which are counted: words and digits up to
twelve, ordinals, halves and doubles without a unit. A small one with a unit, a percent sign or
"times" counts as any other.

A trace says that the number is there, not that the sentence is about it. What that is worth is
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
from collections.abc import Callable, Iterator
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
WORDS = re.compile(
    rf"\b(?:(?:an?|{COUNT})(?:[ -](?:{COUNT}))*[ -](?:of an? )?(?:{'|'.join(PARTS)})s?\b"
    rf"|half an?(?= (?:million|thousand|hundred))(?: (?:{'|'.join(LARGE)}))"
    rf"|(?:an? )?(?:{COUNT})(?:[ -](?:{COUNT})| and a half"
    rf"|(?:(?<=hundred)|(?<=thousand)|(?<=million)) and (?:{COUNT}))*\b"
    rf"|(?:half|halves|twice|quarter|third)\b)",
    re.I,
)
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
"""What follows a number, and what its value may be multiplied by in the code."""
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
    """A number that a run has, between two ends, with the words that go with it."""

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
    """Beginnings of the words that mean something."""
    words = re.findall(
        r"[a-zA-Zε-ω]{3,}", re.sub(r"([a-z])([A-Z])|_", r"\1 \2", text).lower()
    )
    found = [*words, *re.findall(r"[a-z]+_[a-z_]+", text)]
    return frozenset(
        w if "_" in w else w[:5] for w in found if w not in COMMON and w not in ONES
    )


def number(text: str) -> float:
    """The value of a numeral in words or digits."""
    low = text.lower().replace("-", " ")
    if re.search(r"\d", text):
        return float(re.sub(r"[   \u2009]", "", text.replace("−", "-")))
    if low == "twice":
        return 2.0
    if found := re.fullmatch(
        r"(?:an? )?(\w+)-(hundred|thousand|million)ths?", text.lower()
    ):
        return 1 / (number(found[1]) * LARGE[found[2]])
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
    """How many digits of a numeral count."""
    return len(re.sub(r"e.*|[^0-9]", "", text).lstrip("0"))


def step_of(text: str, value: float) -> float:
    """One unit in the last digit given; of words, an eighth of a fraction, else one."""
    if re.search(r"\d", text):
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
    at = 0
    for cell in CELL.finditer(text):
        yield text.count("\n", 0, at) + 1, "prose", text[at : cell.start()]
        line = text.count("\n", 0, cell.start()) + 1
        header = cell["yaml"] or ""
        for found in re.finditer(
            r"^ *(caption|alt): >-\n((?: {6,}.*\n)+)", header, re.M
        ):
            yield line, "prose", f"\n\n{found[2]}\n\n"
        yield line, "code", cell["code"]
        at = cell.end()
    yield text.count("\n", 0, at) + 1, "prose", text[at:]


FORMULA = re.compile(r"\$([^$]+)\$")


def evaluated(text: str) -> float | None:
    """The value of a formula of numbers alone, or None."""
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
    if not re.fullmatch(r"(?:sqrt|log|abs|pi|[-+*/().\d])+", text) or not re.search(
        r"[-+*/a-z]", text
    ):
        return None
    names = {"sqrt": math.sqrt, "log": math.log, "abs": abs, "pi": math.pi}
    try:
        return float(eval(text, {"__builtins__": {}}, names))
    except (SyntaxError, ArithmeticError, TypeError, ValueError):
        return None


def of_formula(found: re.Match[str]) -> str:
    """What a formula leaves in the sentence: nothing, or the number that it ends in."""
    inside = found[1].replace("{,}", "").replace("\\,", " ").replace("\\%", "%").strip()
    parts = re.split(r"(=|\\approx)", inside)
    if len(parts) > 2 and re.fullmatch(r" ?-?\d+(?:\.\d+)? ?", parts[-1]):
        given = float(parts[-1])
        exact = evaluated(parts[-3])
        loose = 0.02 * abs(given) if "approx" in parts[-2] else 0.0
        if exact is not None and abs(exact - given) <= max(
            loose, 0.5001 * step_of(parts[-1].strip(), given)
        ):
            return f" {parts[-1].strip()} ≗ "
    power = re.fullmatch(r"(?:(.*)\\(?:cdot|times) ?)?10\^\{?(-?\d+)\}?", inside)
    if power and re.fullmatch(r"[\d.]*", power[1] or ""):
        return f" {float(power[1] or 1) * 10.0 ** int(power[2]):g} "
    if re.fullmatch(r"\\?(?:pm)?[-\d. %]+", inside):
        return f" {inside.removeprefix(chr(92) + 'pm')} "
    last = re.search(
        r"(?:=|\\approx|<|>|\\leq?|\\geq?|\\pm) ?(-?\d+(?:\.\d+)?)(?:\\?[ ,;]*)$",
        inside,
    )
    return f" ({last[1]}) = " if last and float(last[1]) not in (0, 1) else " "


def plain(text: str) -> str:
    """Prose without code, roles, addresses, comments and what defines something; lines kept."""
    keep = lambda m: "\n" * m[0].count("\n")  # noqa: E731
    text = re.sub(
        r"^(`{3,})\{(?:math|include|eval-rst)\}.*?^\1$", keep, text, flags=re.M | re.S
    )
    text = re.sub(r"^(`{3,}|:{3,}).*$|^:\w+:.*$|^%.*$|^\(.*\)=$", "", text, flags=re.M)
    text = re.sub(r"\$\$.*?\$\$", keep, text, flags=re.S)
    text = re.sub(r"\{cite:\w\}`[^`]*`", " ⸢cited⸣ ", text)
    text = re.sub(r"\{[\w:]+\}`[^`]*`", " ", text)
    text = re.sub(r"`([^`]*)`", lambda m: " " + re.sub(r"[^A-Za-z_]+", " ", m[1]), text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = FORMULA.sub(lambda m: of_formula(m) + "\n" * m[0].count("\n"), text)
    text = re.sub(r"^\| *\d+ *\|", "|", text, flags=re.M)
    text = re.sub(r"^( *)\d+\. ", r"\1", text, flags=re.M)
    return text


def structure(sentence: str) -> str:
    """The sentence without numbers of figures, equations and the like, as long as before."""
    blank = lambda m: re.sub(r"\S", "_", m[0])  # noqa: E731
    number_list = r"\d+[a-z]?(?:(?:, | and | to | or |-|–|/)\d+[a-z]?)*\b(?!\.\d| ?%)"
    roman = r"[IVX]+\b(?:(?:, | and | to )[IVX]+\b)*"
    out = re.sub(
        rf"\b(?:{LABELS})\s+(?:{number_list}|{roman})", blank, sentence, flags=re.I
    )
    out = re.sub(r"\((?!\d+\) =)\d{1,2}[a-z]?\)(?:-\(\d+\))?", blank, out)
    out = re.sub(r"\b[A-Za-z]+\d[\w.]*|\b\d+-D\b|\b\d+[a-zA-Z]\w*-", blank, out)
    out = re.sub(r"\b\d+, (?:19|20)\d\d\)", blank, out)
    return re.sub(
        r"(?<![\d.] )(?<![\d.])\b(?:19|20)\d\d\b(?! ?(?:m|s|km|runs|draws|points)\b|\.\d)",
        blank,
        out,
    )


def numerals_of(piece: str, chapter: str, line: int, section: int) -> Iterator[Numeral]:
    """Yield the numerals of one piece of prose."""
    for block in re.finditer(r"(?:[^\n]+\n?)+", plain(piece)):
        start = line + piece_line(plain(piece), block.start())
        text = block[0]
        for found in re.finditer(
            r"(?s).+?(?:(?<!Fig)(?<!Figs)(?<!Eq)(?<!Prop)(?<!cf)[.!?:](?=\s)|\|\n|$)",
            text,
        ):
            sentence = " ".join(found[0].split())
            clean = structure(sentence)
            taken: list[tuple[int, int]] = []
            for shape in (DIGITS, WORDS):
                for hit in shape.finditer(clean):
                    if any(a < hit.end() and hit.start() < b for a, b in taken):
                        continue
                    taken.append(hit.span())
                    yield from one(
                        hit,
                        clean,
                        sentence,
                        chapter,
                        start + text[: found.start()].count("\n"),
                        section,
                    )


def piece_line(text: str, at: int) -> int:
    return text.count("\n", 0, at)


def one(
    hit: re.Match[str], clean: str, sentence: str, chapter: str, line: int, section: int
) -> Iterator[Numeral]:
    """The numeral of one hit, with its unit and whether it is a small one."""
    text = hit[0].strip()
    after = clean[hit.end() :].lstrip(" -)")
    value = number(text)
    unit = next((u for u in UNITS if re.match(u, after)), "")
    if text.lower() in ("third", "quarter", "a second") and not unit:
        return
    whole = value == int(value)
    tiny = (whole and abs(value) <= 12) or value == 0.5
    ordinal = text.lower().removeprefix("a ") in ORDINAL and not re.match(
        r"of\b", after
    )
    if re.fullmatch(r"(?:an?|one)", text, re.I):
        return
    if after.startswith("≗"):
        yield Numeral(
            chapter, line, section, text, value, 0.0, "", sentence, "arithmetic"
        )
        return
    spread = re.match(
        rf"(?:to|and|or|–) (?:{DIGITS.pattern}|{COUNT}) ?({'|'.join(UNITS)})", after
    )
    if spread and not unit:
        unit = next(u for u in UNITS if re.match(u, spread[1]))
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


# --- what the run has ----------------------------------------------------------------------------


ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}


def constant(node: ast.AST) -> float | None:
    """The number that an expression of constants is, or None."""
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return float(node.value)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        inner = constant(node.operand)
        return None if inner is None else -inner
    if isinstance(node, ast.BinOp):
        a = constant(node.left)
        b = constant(node.right)
        if a is not None and b is not None:
            with contextlib.suppress(KeyError, ArithmeticError, TypeError):
                return float(ARITHMETIC[type(node.op)](a, b))
    return None


def compared(node: ast.AST) -> Iterator[float]:
    """Numbers that take part in a comparison by themselves, in a list, as a factor or a term."""
    value = constant(node)
    if value is not None:
        yield value
    elif isinstance(node, ast.List | ast.Tuple):
        for item in node.elts:
            yield from compared(item)
    elif isinstance(node, ast.Dict):
        for item in (*node.keys, *node.values):
            if item is not None:
                yield from compared(item)
    elif isinstance(node, ast.BinOp):
        yield from compared(node.left)
        yield from compared(node.right)
    elif isinstance(node, ast.Call) and node.args:
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if name in ("abs", "array", "log", "sqrt", "log10", "deg2rad"):
            yield from compared(node.args[0])


def checks(node: ast.Assert, section: int, where: str) -> Iterator[Fact]:
    """What an assertion compares with, and what its message says."""
    words = stems(ast.unparse(node))
    seen = set()
    for part in ast.walk(node.test):
        if isinstance(part, ast.Compare):
            sides = [part.left, *part.comparators]
            ends = [constant(s) for s in sides]
            if len(sides) == 3 and ends[0] is not None and ends[2] is not None:
                low, high = sorted((ends[0], ends[2]))
                yield Fact("check", low, high, where, section, words)
            for side in sides:
                seen.update(compared(side))
        elif isinstance(part, ast.Call):
            name = getattr(part.func, "attr", getattr(part.func, "id", ""))
            if name in ("isclose", "allclose", "array_equal"):
                for side in part.args[:2]:
                    seen.update(compared(side))
    for value in seen:
        yield Fact("check", value, value, where, section, words)
    message = node.msg.value if isinstance(node.msg, ast.Constant) else ""
    for said in numerals_of(str(message) + "\n", "", 0, 0):
        yield Fact(
            "check", said.value, said.value, where, section, words, said.unit or "said"
        )


def parameters(
    code: str, where: str, section: int = -1, kind: str = "parameter"
) -> Iterator[Fact]:
    """The numbers of some code with the names that they are bound to and comments beside them."""
    comments: dict[int, str] = {}
    for token in tokenize.generate_tokens(io.StringIO(code).readline):
        if token.type == tokenize.COMMENT:
            comments[token.start[0]] = token.string
    tree = ast.parse(code)

    def walk(node: ast.AST, names: tuple[str, ...]) -> Iterator[Fact]:
        if isinstance(node, ast.Assert):
            return
        value = constant(node) if isinstance(node, ast.expr) else None
        if value is not None:
            said = " ".join((*names[-3:], comments.get(node.lineno, "")))
            yield Fact(
                kind,
                value,
                value,
                f"{where}: {'.'.join(names[-2:])}",
                section,
                stems(said),
            )
            if not isinstance(node, ast.BinOp):
                return
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (*names, " ".join(ast.unparse(t) for t in targets))
            if node.value is not None:
                yield from walk(node.value, names)
            return
        if isinstance(node, ast.Call):
            call = (*names, ast.unparse(node.func)[-40:])
            for item in node.args:
                yield from walk(item, call)
            for word in node.keywords:
                yield from walk(word.value, (*call, word.arg or ""))
            yield from walk(node.func, names)
            return
        if isinstance(node, ast.Dict):
            for key, item in zip(node.keys, node.values, strict=True):
                said = str(key.value) if isinstance(key, ast.Constant) else ""
                if key is not None and not said:
                    yield from walk(key, names)
                yield from walk(item, (*names, said))
            return
        if isinstance(node, ast.FunctionDef):
            spec = node.args
            pairs = [
                *zip(spec.args[::-1], spec.defaults[::-1], strict=False),
                *zip(spec.kwonlyargs, spec.kw_defaults, strict=True),
            ]
            for arg, default in pairs:
                if default is not None:
                    yield from walk(default, (*names, node.name, arg.arg))
            for item in node.body:
                yield from walk(item, (node.name,))
            return
        if isinstance(node, ast.For):
            yield from walk(node.iter, (*names, ast.unparse(node.target)))
            for item in (*node.body, *node.orelse):
                yield from walk(item, names)
            return
        if isinstance(node, ast.BinOp | ast.Compare):
            near = " ".join(re.findall(r"[A-Za-z_]{3,}", ast.unparse(node)))[:80]
            names = (*names, near)
        for child in ast.iter_child_nodes(node):
            yield from walk(child, names)

    yield from walk(tree, ())


NUMBER = re.compile(
    r"(?<![\w.])[-−]?(?:\d{1,3}(?: \d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\d)"
)


def rows_of(page: str) -> Iterator[tuple[str, str]]:
    """The rows of the tables of some HTML, each with the words of its caption and header."""
    bare = lambda t: html.unescape(re.sub(r"<[^>]+>", " ", t))  # noqa: E731
    page = re.sub(r"<style.*?</style>", "", page, flags=re.S)
    for block in re.split(r"(?=<table)", page):
        rows = re.split(r"(?=<tr)", block)
        head = bare(
            " ".join(
                re.findall(r"<caption.*?</caption>|<thead.*?</thead>", block, re.S)
            )
        )
        for row in rows:
            yield bare(row), head


def printed(cell: Any, section: int, where: str) -> Iterator[Fact]:
    """The numbers that a cell's stored outputs print; pictures' digests are left out."""
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        page = "".join(data.get("text/html", ""))
        if SLIDER in page or any(mime.startswith("image/") for mime in data):
            continue
        verdict = [(str(v), "") for v in data.get(VERDICT, {}).values()]
        plainly = "" if page else "".join(data.get("text/plain", ""))
        lines = [
            (line, "")
            for line in ("".join(output.get("text", "")) + plainly).splitlines()
        ]
        for row, head in (*rows_of(page), *verdict, *lines):
            words = stems(f"{row} {head}")
            for found in NUMBER.finditer(f"{row}\n{head}"):
                value = number(found[0])
                yield Fact(
                    "output",
                    value,
                    value,
                    where,
                    section,
                    words,
                    half=0.5 * step_of(found[0], value),
                )


def flat(value: Any) -> Iterator[float]:
    """The numbers of a nested list."""
    if isinstance(value, list):
        yield float(len(value))
        for item in value:
            yield from flat(item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield float(value)


@cache
def scenario_facts(path: Path) -> tuple[Fact, ...]:
    """The numbers of a scenario with names, units and reasons; what is given is the paper's."""
    out = []
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    entries = [*data.get("parameters", {}).items(), *data.get("notes", {}).items()]
    for name, entry in entries:
        kind = "published" if entry.get("source") == "given" else "parameter"
        said = " ".join(
            str(entry.get(k, "")) for k in ("unit", "where", "reason", "note")
        )
        words = stems(f"{name} {data.get('title', '')}")
        where = f"{path.stem}.toml: {name}"
        for value in flat(entry["value"]):
            for k in {kind, "parameter"}:
                out.append(
                    Fact(k, value, value, where, words=words, unit=str(entry["unit"]))
                )
        for found in NUMBER.finditer(said):
            if digits(found[0]) > 1:
                value = number(found[0])
                out.append(
                    Fact(
                        "parameter", value, value, where, words=stems(f"{name} {said}")
                    )
                )
    for key, rows in data.items():
        if isinstance(rows, list):
            for row in rows:
                for name, value in row.items():
                    for v in flat(value):
                        out.append(
                            Fact(
                                "parameter",
                                v,
                                v,
                                f"{path.stem}.toml: {key}.{name}",
                                words=stems(f"{key} {name}"),
                            )
                        )
    return tuple(out)


@cache
def study_facts(name: str) -> tuple[Fact, ...]:
    """The numbers of a study's script, of what it imports, and how many rows it has stored."""
    path = BOOK / "studies" / f"{name.replace('-', '_')}.py"
    if not path.is_file():
        return ()
    code = path.read_text(encoding="utf-8")
    out = list(parameters(code, path.name))
    for other in re.findall(
        r"^(?:import|from) (\w+)|script\(\"([\w-]+)\"\)", code, re.M
    ):
        out += study_facts(other[0] or other[1])
    label = re.search(r'^NAME.*?"([\w-]+)"', code, re.M)
    for stored in (ROOT / "data" / "studies").glob(
        f"*/{label[1] if label else name}.csv"
    ):
        rows = [
            r for r in stored.read_text(encoding="utf-8").splitlines() if r[:1] != "#"
        ]
        out.append(
            Fact(
                "parameter",
                len(rows) - 1,
                len(rows) - 1,
                f"rows of {stored.name}",
                words=stems("runs seeds pairs study stored trials times draws"),
            )
        )
    return tuple(out)


@cache
def defaults() -> dict[str, tuple[Fact, ...]]:
    """The numbers that the library's functions take if they are not told, by function."""
    out: dict[str, tuple[Fact, ...]] = {}
    files = [
        *(ROOT / "distfilt").rglob("*.py"),
        *(BOOK / "kit" / "bookkit").rglob("*.py"),
    ]
    for path in sorted(files):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                bare = ast.FunctionDef(node.name, node.args, [ast.Pass()], [])
                code = ast.unparse(ast.fix_missing_locations(bare))
                out[node.name] = (*out.get(node.name, ()), *parameters(code, node.name))
    return out


@cache
def published_facts(paper: str) -> tuple[Fact, ...]:
    """The numbers that a paper prints, as stored."""
    out = []
    for path in sorted((ROOT / "data" / "published" / paper).iterdir()):
        for found in NUMBER.finditer(path.read_text(encoding="utf-8")):
            value = number(found[0])
            out.append(
                Fact("published", value, value, f"published/{paper}/{path.name}")
            )
    return tuple(out)


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
    """What finds the facts that a numeral may mean, a few of thousands, for `trace` to judge."""
    low, high = np.array([(f.low, f.high) for f in facts], dtype=float).reshape(-1, 2).T

    def near(n: Numeral) -> list[Fact]:
        scale = np.array(factors(n.unit))
        values = n.value * scale
        half = 0.501 * n.step * scale
        with np.errstate(divide="ignore"):
            targets = np.concatenate([values, 1 / values, 1 + values, 1 - values])[
                :, None
            ]
        printed = np.pad(half, (0, 3 * len(half)))[:, None]
        reach = 1e-9 + 1e-6 * abs(targets) + printed
        narrow = high - low <= 0.41 * abs(values).max()
        inside = (low - reach <= targets) & (targets <= high + reach) & narrow
        meets = inside | (abs(abs(low) - abs(targets)) <= reach)
        return [facts[k] for k in np.flatnonzero(meets.any(axis=0))]

    return near


def trace(n: Numeral, facts: list[Fact]) -> str:
    """Where a numeral comes from, or ''; the strongest trace first."""
    best: dict[str, str] = {}
    small = n.value == int(n.value) and digits(n.text) < 3
    long = digits(n.text) > 2
    for f in sorted(facts, key=lambda f: f.section != n.section):
        if f.kind in best:
            continue
        here = f.section == n.section
        shared = bool(n.words & f.words)
        for factor in factors(n.unit):
            value = n.value * factor
            slack = 1e-9 + 1e-6 * abs(value)
            if f.kind == "check" and f.unit:
                hit = factor == 1 and f.low == value and f.unit == (n.unit or "said")
                hit = hit and (here or shared)
            elif f.kind == "check":
                targets = (
                    [value]
                    if n.value >= 1 or re.search(r"\d", n.text)
                    else [value, 1 / value]
                )
                if n.unit.startswith("%") and factor < 1:
                    targets += [1 + value, 1 - value]
                if f.low == f.high:
                    hit = any(abs(t - f.low) <= slack for t in targets)
                else:
                    inside = any(f.low - slack <= t <= f.high + slack for t in targets)
                    hit = inside and f.high - f.low <= 0.41 * abs(value)
                hit = hit and ((here and (shared or not small)) or (shared and long))
            elif f.kind == "output":
                half = 0.5001 * n.step * factor
                hit = abs(abs(value) - abs(f.low)) <= half and f.half <= half
                hit = hit and (long or (here and (shared or not small)))
            elif f.kind == "published":
                hit = abs(abs(value) - abs(f.low)) <= slack and bool(
                    SPEAKS.search(n.sentence)
                )
                hit = hit and (shared or not f.words) and not (small and not f.words)
            else:
                same = bool(
                    f.unit and n.unit and re.search(rf"(?:^|[ ,])(?:{n.unit})", f.unit)
                )
                fits = same or not (n.unit and f.unit)
                hit = abs(abs(value) - abs(f.low)) <= slack and (
                    same or (shared and fits) or (here and not small)
                )
            if hit:
                best[f.kind] = f.where
                break
    for kind in ("check", "parameter", "output", "published"):
        if kind in best:
            return f"{kind}: {best[kind]}"
    if "⸢cited⸣" in n.sentence:
        return "cited: by the sentence"
    near = (
        f
        for f in facts
        if f.section == n.section and f.low == f.high and f.kind != "output"
    )
    for f in near:
        if small and any(abs(f.low) == n.value * k for k in factors(n.unit)):
            return f"beside: {f.where}"
    return ""


def others(n: Numeral) -> Iterator[Numeral]:
    """The same sentence with another number of the same length."""
    if re.search(r"\d", n.text) or n.value == int(n.value):
        count = (
            max(digits(n.text), 1)
            if re.search(r"\d", n.text)
            else len(str(int(n.value)))
        )
        unit = (
            n.step
            if re.search(r"\d", n.text)
            else 10.0 ** (len(str(int(n.value)).rstrip("0")) < count)
        )
        low = 10 ** (count - 1)
        high = 10**count
        for k in range(16):
            whole = low + (7919 * (k + 1) + int(abs(n.value))) % (high - low)
            value = whole * (n.step if re.search(r"\d", n.text) else 1.0)
            if abs(value - abs(n.value)) > 0.5 * unit * 1e-9:
                yield replace(n, value=value)
    else:
        for k in (3, 4, 5, 7, 8, 9, 12, 15, 20, 30):
            if abs(1 / k - n.value) > 1e-9:
                yield replace(n, value=1 / k, step=0.2 / k)


def read(source: Path) -> tuple[list[Numeral], list[Fact]]:
    """The numerals of a chapter and the numbers of its run."""
    text = source.read_text(encoding="utf-8")
    cells = [
        c
        for c in json.loads(source.with_suffix(".ipynb").read_text(encoding="utf-8"))[
            "cells"
        ]
        if c["cell_type"] == "code"
    ]
    numerals: list[Numeral] = []
    facts: list[Fact] = []
    section = 0
    count = 0
    whole = ""
    for line, kind, piece in pieces(text):
        if kind == "prose":
            at = line
            for part in re.split(r"^(?=#+ )", piece, flags=re.M):
                section += part.startswith("#")
                numerals += numerals_of(part, source.stem, at, section)
                at += part.count("\n")
            continue
        where = f"cell {count + 1}"
        whole += piece
        tree = ast.parse(piece)
        for node in ast.walk(tree):
            if isinstance(node, ast.Assert):
                facts += checks(node, section, where)
            if isinstance(node, ast.keyword) and node.arg == "alt":
                said = ast.unparse(node.value)
                numerals += numerals_of(
                    said.strip("'\"") + "\n", source.stem, line, section
                )
        facts += parameters(piece, where, section)
        facts += printed(cells[count], section, where)
        count += 1
    for name in sorted(
        set(re.findall(r"(?:script\(|stored\(\s*\"\w+\",\s*)\"([\w-]+)\"", whole))
    ):
        facts += study_facts(name)
    for name in sorted(set(re.findall(r"\b([a-z]\w+)\(", whole))):
        facts += defaults().get(name, ())
    if source.stem == "index":
        for other in chosen(["04", "04b"]):
            facts += [replace(f, section=-1) for f in read(other)[1]]
    paper = PAPERS_OF.get(source.stem[:2])
    if paper:
        for path in sorted((ROOT / "data" / "scenarios" / paper).glob("*.toml")):
            facts += scenario_facts(path)
        facts += published_facts(paper)
    return numerals, facts


def main() -> int:
    parser = argparse.ArgumentParser(
        description="List the numerals of the prose and their sources."
    )
    parser.add_argument("chapters", nargs="*", help="names or numbers; all without one")
    parser.add_argument("--all", action="store_true", help="list the traced ones too")
    options = parser.parse_args()
    with KNOWN.open(encoding="utf-8", newline="") as file:
        known = list(csv.DictReader(file))
    problems = 0
    for source in chosen(options.chapters):
        numerals, facts = read(source)
        text = " ".join(source.read_text(encoding="utf-8").split())
        own = [row for row in known if row["chapter"] == source.stem]
        counts = Counter[str]()
        lucky = 0
        tries = 0
        near = nearby(facts)
        for n in numerals:
            if n.kind:
                n.source = n.kind
            else:
                n.source = trace(n, near(n))
                if n.source and not n.source.startswith("beside"):
                    changed = list(others(n))
                    tries += len(changed)
                    found = [trace(other, near(other)) for other in changed]
                    lucky += sum(bool(f) and f[:6] != "beside" for f in found)
                elif not n.source:
                    listed = (
                        r
                        for r in own
                        if r["phrase"] in n.sentence and n.text in r["phrase"]
                    )
                    n.source = next((f"known: {r['reason']}" for r in listed), "")
            counts[n.source.split(":")[0] or "untraced"] += 1
            if options.all or not n.source:
                print(
                    f"{n.chapter}:{n.line}: {n.text!r}: {n.source or 'UNTRACED'} | {n.sentence}"
                )
        problems += counts["untraced"]
        for row in own:
            if " ".join(row["phrase"].split()) not in plain_text(text):
                print(
                    f"{source.stem}: numerals.csv lists a phrase that is gone: {row['phrase']}"
                )
                problems += 1
        shown = ", ".join(f"{v} {k}" for k, v in counts.most_common())
        print(
            f"{source.stem}: {len(numerals)} numerals: {shown}; "
            f"of others in their place {100 * lucky / max(tries, 1):.0f}% would be traced"
        )
    return int(bool(problems))


def plain_text(text: str) -> str:
    """Prose in one line, as sentences are listed."""
    return " ".join(plain(text).split())


if __name__ == "__main__":
    sys.exit(main())
