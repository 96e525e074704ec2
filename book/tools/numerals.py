"""Trace every numeral in the prose of the chapters to a number of a cell, an output or a source.

    python book/tools/numerals.py [CHAPTER ...] [--all]

Prose is the text between the cells, with its tables, exercises and solutions, and of the cells the
captions and alternative texts. A numeral is traced to a number of equal value,

code
    in a cell of its section; or in any cell, a scenario or a study of the chapter, or the default
    of a function that it calls, in a line that shares a word with the sentence
output
    in a stored output that prints it to the digits given: of its section, or of any section if the
    numeral has three digits that count
picture
    in the digest of the picture that the caption or the alternative text describes
published
    in ``data/published``, or given by the paper to a scenario, if the sentence speaks of a paper
arithmetic
    none, but it ends a formula of numbers alone, which is worked out here
cited, known
    none, but the sentence has a citation, or stands in ``numerals.csv`` with a reason

A numeral with one digit that counts, and a whole number of two, always need a word that is shared;
without one they are counted as **beside**. Left out are names, years, numbers of chapters, figures,
equations and the like, and definitions in formulas. Numbers up to twelve and halves without a unit
are counted as **small**.

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
import math
import re
import sys
import tomllib
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import nbformat
import snowballstemmer
from bs4 import BeautifulSoup
from sphinx.search.en import ENGLISH_STOPWORDS

from common import BOOK, ROOT, SLIDER, VERDICT, chosen
from execute import read

KNOWN = Path(__file__).with_suffix(".csv")
PAPERS = dict(
    zip(
        ("01", "02", "03", "04", "05", "06", "07", "08", "09", "10"),
        ["grange"] * 4 + ["das"] * 2 + ["semeraro"] * 2 + ["zheng"] * 2,
        strict=True,
    )
)
"""The paper that the chapter of each number reproduces."""

# --- numbers in words and digits ------------------------------------------------------------------

ONES = (
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
TENS = ("twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety")
LARGE = {"hundred": 100, "thousand": 1000, "million": 10**6, "billion": 10**9}
COUNTS = {word: k for k, word in enumerate(ONES)}
COUNTS |= {word: 10 * k for k, word in enumerate(TENS, start=2)}
PARTS = {"half": 2, "halve": 2, "third": 3, "quarter": 4, "fifth": 5, "eighth": 8}
PARTS |= {"ninth": 9, "twelfth": 12}
PARTS |= {f"{word}th": COUNTS[word] for word in ("four", "six", "seven", "ten")}
PARTS |= {f"{word[:-1]}ieth": COUNTS[word] for word in TENS}
PARTS |= {f"{word}th": value for word, value in LARGE.items()}
ORDINAL = re.compile(r"(?:a )?(?:third|fifth|sixth|seventh|eighth|ninth|tenth|twelfth)")
COUNT = "|".join((*COUNTS, *LARGE))
# "three quarters", "half a million", "two hundred and five", "two and a half", "half"
WORDS = re.compile(
    rf"\b(?:(?:an?|{COUNT})(?:[ -](?:{COUNT}))*[ -](?:of an? )?(?:{'|'.join(PARTS)})s?"
    rf"|half an? (?:{'|'.join(LARGE)})"
    rf"|(?:an? )?(?:{COUNT})(?:[ -](?:{COUNT})| and a half"
    rf"|(?:(?<=hundred)|(?<=thousand)|(?<=million)) and (?:{COUNT}))*"
    r"|half|halves|twice|quarter|third)\b",
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
    r"times\b|-?fold\b": (),
    r"km\b|kilomet": (1e3, 1e-3),
    r"cm\b|centimet": (1e-2,),
    r"mm\b|millimet": (1e-3, 1e-6),
    r"m/s\b": (1e-3,),
    r"m²?\b(?!-)|metres?\b": (1e-3, 1e3),
    r"h\b|hours?\b": (3600.0,),
    r"min\b|minutes?\b": (60.0,),
    r"s\b|seconds?\b": (1000.0,),
    r"days?\b": (86400.0, 24.0),
    r"°|degrees?\b": (math.pi / 180,),
    r"rad\b|radian|nats?\b|arcsec|orders? of|Hz\b": (),
}
"""Units after a number, and factors by which its value may be multiplied in the code."""
LABELS = (
    r"chapters?|figs?\.|figures?|tables?|sections?|equations?|eqs?\.|algorithms?|lines?|steps?"
    r"|items?|agents?|parts?|exercises?|rows?|version|theorems?|pages?|panels?|mixands?|sensors?"
    r"|conditions?|neighbours?|bodies|body|component|column|node|member|lemma|corollary|order"
    r"|degree|level|satellites?|robots?|state|appendix"
)
"""Nouns whose numbers are names."""


@dataclass
class Numeral:
    """One number of the prose."""

    text: str
    value: float
    step: float
    """One unit in the last digit that is given."""
    unit: str
    section: int
    sentence: str
    words: frozenset[str]
    source: str = ""
    picture: Facts | None = None
    """The numbers of the picture that the sentence describes."""

    @property
    def is_small(self) -> bool:
        """Whether it has one digit that counts, or is a whole number of two."""
        n_digits = digits(self.text)
        return n_digits < 2 or (self.value == int(self.value) and n_digits < 3)

    @property
    def factors(self) -> tuple[float, ...]:
        return (1.0, *(UNITS[self.unit] if self.unit else ()))


@dataclass
class Fact:
    """A number of the code, of an output or of a source, with the words of its line."""

    kind: str
    value: float
    where: str
    section: int
    words: frozenset[str]
    half: float = 0.0
    """Half a unit in the last digit that an output prints."""


GENERIC = frozenset(
    re.findall(
        r"\w+",
        """less least more most greater between within equal close checks true false number value
        name label title text caption figure table first second last size shape axis axes index
        default array numpy list dict range print plot style color marker alpha line times""",
    )
)
"""Words that are in too many lines to name a number, beside the stop words of English."""

_stem = cache(snowballstemmer.stemmer("english").stemWord)


def stems(text: str) -> frozenset[str]:
    """Return the stems of the words that carry meaning; ``n_members`` has two words."""
    spaced = re.sub(r"([a-z])([A-Z])|_", r"\1 \2", text).lower()
    words = set(re.findall(r"[a-zε-ω]{3,}", spaced))
    return frozenset(map(_stem, words - ENGLISH_STOPWORDS - GENERIC - {*COUNTS}))


def value_of(text: str) -> float:
    """Return the value of a numeral in words or digits."""
    text = text.lower()
    if re.search(r"\d", text):
        return float(re.sub(r"[ \u00a0\u2009]", "", text.replace("−", "-")))
    if text == "twice":
        return 2.0
    if text.endswith(" and a half"):
        return value_of(text.removesuffix(" and a half")) + 0.5
    if text.startswith("half a"):
        return 0.5 * value_of(text.removeprefix("half "))
    words = re.findall(r"[a-z]+", text)
    part = words[-1].removesuffix("s")
    if part not in PARTS:
        return count_of(words)
    count = count_of(words[:-1]) or 1.0
    # "a three-hundredth" is 1/300, "three hundredths" are 3/100.
    if words[-1].removesuffix("th") in LARGE:
        return 1 / (count * PARTS[part])
    return count / PARTS[part]


def count_of(words: list[str]) -> float:
    """Return the value of a whole number in words: "two hundred thousand and five"."""
    total = 0.0
    part = 0.0
    for word in words:
        part += COUNTS.get(word, 0)
        if word in LARGE:
            part = (part or 1.0) * LARGE[word]
            # A hundred may be multiplied again, by a thousand or a million.
            if word != "hundred":
                total += part
                part = 0.0
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


# --- the prose ------------------------------------------------------------------------------------


def evaluate(text: str) -> float | None:
    """Return the value of a formula of numbers only, or None."""
    # TeX becomes Python: \frac12, \frac{1}{2}, \sqrt{2}, |x|, e^x, \cdot, 2\pi.
    for tex, code in (
        (r"\\[td]?frac(\d)(\d)", r"(\1/\2)"),
        (r"\\[td]?frac\{([^{}]*)\}\{([^{}]*)\}", r"((\1)/(\2))"),
        (r"\\(sqrt|log)\s*\{?(\d+)\}?", r"\1(\2)"),
        (r"\|([^|]+)\|", r"abs(\1)"),
        (r"\\pi", "(pi)"),
        (r"\be\^", "(exp(1))^"),
        (r"\\cdot|\\times", "*"),
        (r"\^", "**"),
        (r"\\[,; ]|[\s{}]", ""),
        (r"(?<=[\d)])(?=[a-z(])", "*"),
    ):
        text = re.sub(tex, code, text)
    # With any other name it is a definition, not arithmetic.
    numbers_only = re.fullmatch(r"(?:sqrt|log|abs|exp|pi|[-+*/().\d])+", text)
    if not numbers_only or not re.search(r"[-+*/a-z]", text):
        return None
    names = {"sqrt": math.sqrt, "log": math.log, "abs": abs, "pi": math.pi}
    with contextlib.suppress(SyntaxError, ArithmeticError, TypeError, ValueError):
        return float(eval(text, {"__builtins__": {}}, names | {"exp": math.exp}))
    return None


def text_of_formula(match: re.Match[str]) -> str:
    """Return the text that replaces a formula: a blank, or the number at its end."""
    formula = match[1].replace("{,}", "").replace("\\,", " ").replace("\\%", "%")
    formula = formula.strip()
    # "2 + 3 = 5": the number at the end is checked here, if the rest is numbers only.
    *_, left, sign, right = ["", "", *re.split(r"(=|\\approx)", formula)]
    if re.fullmatch(r" ?-?\d+(?:\.\d+)? ?", right):
        value = float(right)
        result = evaluate(left)
        loose = 0.02 * abs(value) if "approx" in sign else 0.0
        margin = max(loose, 0.5001 * step_of(right.strip(), value))
        if result is not None and abs(result - value) <= margin:
            return f" {right.strip()} ≗ "
    # "2 · 10^3" is one number.
    power = re.fullmatch(r"(?:([\d.]*) ?\\(?:cdot|times) ?)?10\^\{?(-?\d+)\}?", formula)
    if power:
        return f" {float(power[1] or 1) * 10.0 ** int(power[2]):g} "
    if re.fullmatch(r"\\?(?:pm)?[-\d. %]+", formula):
        return f" {formula.removeprefix(chr(92) + 'pm')} "
    # "x = 3.5" is a statement, but "x = 0" or "x = 1" is mostly a definition.
    last = re.search(
        r"(?:=|\\approx|<|>|\\leq?|\\geq?|\\pm) ?(-?\d+(?:\.\d+)?)(?:\\?[ ,;]*)$",
        formula,
    )
    return f" ({last[1]}) = " if last and float(last[1]) not in (0, 1) else " "


def plain(text: str) -> str:
    """Return prose without code, roles, addresses, comments and definitions."""
    for pattern, replacement in (
        (r"(?ms)^(`{3,})\{(?:math|include|eval-rst)\}.*?^\1$", ""),
        (r"(?m)^(`{3,}|:{3,}).*$|^:\w+:.*$|^%.*$|^\(.*\)=$", ""),
        (r"(?s)\$\$.*?\$\$", ""),
        # A mark stands for a citation, which `trace` accepts as a source.
        (r"\{cite:\w\}`[^`]*`", " ⸢cited⸣ "),
        (r"\{[\w:]+\}`[^`]*`", " "),
        (r"\]\([^)]*\)", "]"),
        # The number of a table's row, and of a list's item
        (r"(?m)^\| *\d+ *\|", "|"),
        (r"(?m)^( *)\d+\. ", r"\1"),
    ):
        text = re.sub(pattern, replacement, text)
    # Of code only the words count.
    text = re.sub(r"`([^`]*)`", lambda m: " " + re.sub(r"[^A-Za-z_]+", " ", m[1]), text)
    return re.sub(r"\$([^$]+)\$", text_of_formula, text)


def without_names(sentence: str) -> str:
    """Blank out numbers of figures, equations, years and the like, without moving text."""
    numbers = r"\d+[a-z]?(?:(?:, | and | to | or |-|–|/)\d+[a-z]?)*\b(?!\.\d| ?%)"
    roman = r"[IVX]+\b(?:(?:, | and | to )[IVX]+\b)*"
    for pattern in (
        rf"(?i)\b(?:{LABELS})\s+(?:{numbers}|{roman})",
        # References such as (12), names such as x1 or 2-D, "12, 2003)" of a citation
        r"\((?!\d+\) =)\d{1,2}[a-z]?\)(?:-\(\d+\))?",
        r"\b[A-Za-z]+\d[\w.]*|\b\d+-D\b|\b\d+(?!e-\d)[a-zA-Z]\w*-",
        r"\b\d+, (?:19|20)\d\d\)",
        r"(?<![\d.] )(?<![\d.])\b(?:19|20)\d\d\b(?! ?(?:m|s|km|runs|draws|points)\b|\.\d)",
    ):
        sentence = re.sub(pattern, lambda m: re.sub(r"\S", "_", m[0]), sentence)
    return sentence


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences and the rows of tables of some prose, each in one line."""
    end = r"(?:(?<!Fig)(?<!Figs)(?<!Eq)(?<!Prop)(?<!cf)[.!?:](?=\s)|\|\n|$)"
    for paragraph in re.split(r"\n\s*\n", plain(text)):
        for match in re.finditer(rf"(?s).+?{end}", paragraph):
            yield " ".join(match[0].split())


def numerals_of(text: str, section: int) -> Iterator[Numeral]:
    """Yield the numerals of some prose."""
    for sentence in sentences(text):
        clean = without_names(sentence)
        words = stems(sentence)
        in_digits = list(DIGITS.finditer(clean))
        taken = {k for hit in in_digits for k in range(*hit.span())}
        # "2 hundred" is found in digits and in words: the first counts.
        in_words = [h for h in WORDS.finditer(clean) if not taken & {*range(*h.span())}]
        for hit in (*in_digits, *in_words):
            text = hit[0].strip()
            value = value_of(text)
            # The unit follows the number, after a blank or a hyphen.
            after = clean[hit.end() :].lstrip(" -)")
            unit = unit_of(after)
            step = step_of(text, value)
            # The unit counts as a word: "after 20 s" may be a parameter in seconds.
            named = words | ({unit} if unit else set())
            numeral = Numeral(text, value, step, unit, section, sentence, named)
            if re.fullmatch(r"an?|one", text, re.I) or (
                text.lower() in ("third", "quarter") and not unit
            ):
                continue  # an article, a pronoun, "a third filter"
            numeral.source = source_of_form(numeral, after)
            yield numeral


def unit_of(after: str) -> str:
    """Return the unit at the start of a text; ", 2 and 3 s" has that of its last number."""
    number = rf"(?:{DIGITS.pattern}|{COUNT})"
    others = re.match(rf"(?:,? ?(?:to|and|or|–|,) {number} ?)+", after)
    starts = [after, after[others.end() :]] if others else [after]
    return next((u for start in starts for u in UNITS if re.match(u, start)), "")


def source_of_form(numeral: Numeral, after: str) -> str:
    """Return the source that a numeral has by its form: arithmetic, small, or none."""
    if after.startswith("≗"):
        return "arithmetic"
    text = numeral.text.lower()
    whole = numeral.value == int(numeral.value)
    tiny = (whole and abs(numeral.value) <= 12) or numeral.value == 0.5
    ordinal = ORDINAL.fullmatch(text) and not re.match(r"of\b", after)
    # "two seconds" and "two metres" are phrases, not measurements.
    phrase = text == "two" and numeral.unit.startswith(("s", "m", "day"))
    return "small" if (tiny and not numeral.unit) or ordinal or phrase else ""


# --- the numbers of the code, its outputs and its sources -----------------------------------------


def constant(node: ast.AST) -> float | None:
    """Return the value of a number or of arithmetic with numbers alone, or None."""
    if isinstance(node, ast.Constant | ast.UnaryOp | ast.BinOp):
        with contextlib.suppress(Exception):
            value = eval(ast.unparse(node), {"__builtins__": {}})
            # `type` instead of isinstance, since True is an int.
            return float(value) if type(value) in (int, float) else None
    return None


def code_facts(code: str, where: str, section: int = -1) -> Iterator[Fact]:
    """Yield the numbers of code, each with the words of its line and its statement's first."""
    lines = ["", *code.splitlines()]
    tree = ast.parse(code)
    first = dict.fromkeys(range(len(lines)), 0)
    # ast.walk visits the outer statements first, so that the innermost one stays.
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt | ast.arguments):
            span = getattr(node, "lineno", 0), getattr(node, "end_lineno", None) or 0
            first |= dict.fromkeys(range(span[0], span[1] + 1), span[0])
    for node in ast.walk(tree):
        value = constant(node)
        if value is not None:
            line = node.lineno  # type: ignore[attr-defined]
            words = stems(f"{lines[first[line]]} {lines[line]}")
            yield Fact("code", value, f"{where}: {lines[line].strip()}", section, words)
        # The message of an assertion says what it checks.
        if isinstance(node, ast.Assert) and isinstance(node.msg, ast.Constant):
            words = stems(ast.unparse(node))
            for numeral in numerals_of(str(node.msg.value), section):
                yield Fact("code", numeral.value, f"{where}: assert", section, words)


def flat(value: Any) -> Iterator[float]:
    """Yield the numbers of a nested list, and the lengths of its parts."""
    if isinstance(value, list):
        yield len(value)
        for item in value:
            yield from flat(item)
    elif isinstance(value, int | float):
        yield value


def scenario_facts(path: Path) -> Iterator[Fact]:
    """Yield the numbers of a scenario, with the words of their names and their units.

    A value that the paper gives is also one that it prints.
    """
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    title = data.pop("title", "")
    entries = data.pop("parameters", {}) | data.pop("notes", {})
    for name, entry in entries.items():
        reason = " ".join(entry.get(key, "") for key in ("where", "reason", "note"))
        parts = entry["unit"].split(", ")
        units = {unit for unit in UNITS for part in parts if re.match(unit, part)}
        words = stems(f"{name} {title}")
        more_words = stems(f"{name} {reason}")
        for value in flat(entry["value"]):
            yield Fact("code", value, f"{path.name}: {name}", -1, words | units)
            if entry["source"] == "given":
                yield Fact("published", value, path.name, -1, more_words)
        for match in DIGITS.finditer(reason):
            # One digit in a reason would match too many sentences.
            if digits(match[0]) > 1:
                value = value_of(match[0])
                yield Fact("code", value, f"{path.name}: {name}", -1, more_words)
    for key, rows in data.items():
        for row in rows:
            for name, cell in row.items():
                for value in flat(cell):
                    words = stems(f"{key} {name}")
                    yield Fact("code", value, f"{path.name}: {key}.{name}", -1, words)


def printed_facts(path: Path) -> Iterator[Fact]:
    """Yield the numbers that a paper prints, each with the words of its line."""
    for line in path.read_text(encoding="utf-8").splitlines():
        for match in DIGITS.finditer(line):
            value = value_of(match[0])
            yield Fact("published", value, path.name, -1, stems(line))


def rows_of(output: Any) -> Iterator[str]:
    """Yield the lines that an output prints, and the rows of its tables with their heads."""
    data = output.get("data", {})
    page = data.get("text/html", "")
    # The text of a picture is a digest, whose digits prove nothing.
    if SLIDER in page or any(mime.startswith("image/") for mime in data):
        return
    yield from output.get("text", "").splitlines()
    yield from map(str, data.get(VERDICT, {}).values())
    if not page:
        yield from data.get("text/plain", "").splitlines()
    for table in BeautifulSoup(page, "html.parser").find_all("table"):
        # A number of a table is named by the caption and the head of its column.
        heads = table.find_all(["caption", "thead"])
        head = " ".join(part.get_text(" ") for part in heads)
        for row in table.find_all("tr"):
            yield f"{row.get_text(' ')}\n{head}"


def picture_facts(cell: Any) -> Iterator[Fact]:
    """Yield the ranges and means of the curves of a cell's pictures, from their digests."""
    for output in cell.outputs:
        digest = output.get("data", {}).get("text/plain", "")
        # "line 1 y: 60 values, 1..25, mean 4.6, projection 0.3": the last is a hash.
        for line in re.findall(r"values, (.*), projection", digest):
            for text in re.findall(
                r"-?\d[\d.]*\d(?:e[-+]\d+)?|\d", line.replace("..", " ")
            ):
                value = float(text)
                half = 0.5 * step_of(text, value)
                yield Fact("output", value, "picture", -1, frozenset(), half)


def output_facts(cell: Any, where: str, section: int) -> Iterator[Fact]:
    """Yield the numbers that a cell's stored outputs print."""
    for output in cell.outputs:
        for row in rows_of(output):
            words = stems(row)
            for match in DIGITS.finditer(row):
                value = value_of(match[0])
                half = 0.5 * step_of(match[0], value)
                yield Fact("output", value, where, section, words, half)


@cache
def study_facts(name: str) -> tuple[Fact, ...]:
    """Return the numbers of a study's script and its imports, and its number of stored rows."""
    path = BOOK / "studies" / f"{name.replace('-', '_')}.py"
    if not path.is_file():
        return ()
    code = path.read_text(encoding="utf-8")
    facts = list(code_facts(code, path.name))
    # A study that imports another script uses its numbers too.
    imports = r"^(?:import|from) (\w+)|script\(\"([\w-]+)\"\)"
    for other in re.findall(imports, code, re.M):
        facts += study_facts(other[0] or other[1])
    label = re.search(r'^NAME.*?"([\w-]+)"', code, re.M)
    words = stems("runs seeds pairs study stored trials times draws")
    for stored in (ROOT / "data" / "studies").glob(
        f"*/{label[1] if label else name}.csv"
    ):
        rows = re.findall(r"(?m)^[^#\n]", stored.read_text(encoding="utf-8"))
        facts.append(Fact("code", len(rows) - 1, f"rows of {stored.name}", -1, words))
    return tuple(facts)


@cache
def defaults() -> dict[str, list[Fact]]:
    """Return the default values of the functions of the library and of the kit, by name."""
    facts: dict[str, list[Fact]] = {}
    for folder in (ROOT / "distfilt", BOOK / "kit" / "bookkit"):
        for path in sorted(folder.rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef):
                    # One line an argument, so that only its own name counts.
                    code = "\n".join(
                        f"{node.name}_{argument.arg} = {ast.unparse(default)}"
                        for argument, default in defaults_of(node.args)
                    )
                    more = code_facts(code, node.name)
                    facts.setdefault(node.name, []).extend(more)
    return facts


def defaults_of(spec: ast.arguments) -> Iterator[tuple[ast.arg, ast.expr]]:
    """Yield the arguments that have a default, each with it."""
    # Defaults belong to the last positional arguments, so both are read from the end.
    yield from zip(spec.args[::-1], spec.defaults[::-1], strict=False)
    for argument, default in zip(spec.kwonlyargs, spec.kw_defaults, strict=True):
        if default is not None:
            yield argument, default


@cache
def paper_facts(paper: str) -> tuple[Fact, ...]:
    """Return the numbers of a paper's scenarios, and those that it prints."""
    facts: list[Fact] = []
    for path in sorted((ROOT / "data" / "scenarios" / paper).glob("*.toml")):
        facts += scenario_facts(path)
    for path in sorted((ROOT / "data" / "published" / paper).glob("*.csv")):
        facts += printed_facts(path)
    return tuple(facts)


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
            facts += [replace(f, section=-1) for f in read_chapter(other)[1]]
    paper = PAPERS.get(source.stem[:2])
    return [*facts, *(paper_facts(paper) if paper else ())]


# --- the trace ------------------------------------------------------------------------------------

SPEAKS = re.compile(
    r"paper|print|publish|\b(?:table|fig|algorithm|section|title)", re.I
)
"""Words of a sentence that speaks of a paper."""


class Facts:
    """Numbers in the order of their absolute values."""

    def __init__(self, facts: Iterable[Fact]) -> None:
        self.facts = sorted(facts, key=lambda f: abs(f.value))
        self.values = [abs(f.value) for f in self.facts]

    def between(self, low: float, high: float) -> list[Fact]:
        """Return those with an absolute value in an interval."""
        first = bisect_left(self.values, low)
        return self.facts[first : bisect_right(self.values, high)]

    def equal_to(self, numeral: Numeral) -> Iterator[Fact]:
        """Yield the numbers that a numeral may state, in its own unit or another one."""
        in_words = not re.search(r"\d", numeral.text)
        for factor in numeral.factors:
            value = abs(numeral.value * factor)
            half = 0.5001 * numeral.step * factor
            # An output must be as precise as the sentence, or more.
            for fact in self.between(value - half, value + half):
                if fact.kind == "output" and fact.half <= half:
                    yield fact
            # "a fifth" may be the number 5 of the code.
            targets = [value, 1 / value] if in_words and 0 < value < 1 else [value]
            for target in targets:
                slack = 1e-9 + 1e-6 * target
                for fact in self.between(target - slack, target + slack):
                    if fact.kind != "output":
                        yield fact


def trace(numeral: Numeral, facts: Facts) -> str:
    """Return where a numeral comes from, or ''."""
    beside = ""
    long = digits(numeral.text) > 2
    of_paper = SPEAKS.search(numeral.sentence)
    for fact in sorted(
        facts.equal_to(numeral), key=lambda f: f.section != numeral.section
    ):
        in_section = fact.section == numeral.section
        shares_word = bool(numeral.words & fact.words)
        named = shares_word or not numeral.is_small
        good = {
            "code": shares_word or (in_section and named),
            "output": long or (in_section and named),
            "published": of_paper and (shares_word or numeral.value % 1),
        }
        if good[fact.kind]:
            return f"{fact.kind}: {fact.where}"
        if in_section and fact.kind == "code":
            beside = f"beside: {fact.where}"
    if numeral.picture and any(numeral.picture.equal_to(numeral)):
        return "picture: its digest"
    return "cited: by the sentence" if "⸢cited⸣" in numeral.sentence else beside


def others(numeral: Numeral) -> Iterator[Numeral]:
    """Yield the same sentence with other numbers of the same length."""
    in_digits = re.search(r"\d", numeral.text)
    if in_digits or numeral.value == int(numeral.value):
        length = digits(numeral.text) if in_digits else len(str(int(numeral.value)))
        low = 10 ** (max(length, 1) - 1)
        # Numbers with as many digits, spread by a multiple of a prime: no random draw.
        spread = (7919 * k + int(abs(numeral.value)) for k in range(1, 17))
        unit = numeral.step if in_digits else 1.0
        values = [unit * (low + k % (9 * low)) for k in spread]
    else:
        values = [1 / k for k in (3, 4, 5, 7, 8, 9, 12, 15, 20, 30)]
    for value in values:
        if not math.isclose(value, abs(numeral.value)):
            step = numeral.step if in_digits else step_of("", value)
            yield replace(numeral, value=value, step=step)


# --- the chapters ---------------------------------------------------------------------------------


def texts_of(cell: Any) -> Iterator[str]:
    """Yield the caption of a cell's picture, and what readers hear who do not see it."""
    options = cell.metadata.get("mystnb", {})
    yield options.get("figure", {}).get("caption", "")
    yield options.get("image", {}).get("alt", "")
    for node in ast.walk(ast.parse(cell.source)):
        if isinstance(node, ast.keyword) and node.arg == "alt":
            yield ast.unparse(node.value).strip("'\"")


def read_chapter(source: Path) -> tuple[list[Numeral], list[Fact]]:
    """Return the numerals of a chapter and the numbers of its run."""
    notebook = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    outputs = iter([cell for cell in notebook.cells if cell.cell_type == "code"])
    numerals: list[Numeral] = []
    facts: list[Fact] = []
    codes: list[str] = []
    section = 0
    for cell in read(source).cells:
        if cell.cell_type == "markdown":
            # Every heading starts a section, to which the cells after it belong.
            for part in re.split(r"(?m)^(?=#+ )", cell.source):
                section += part.startswith("#")
                numerals += numerals_of(part, section)
        elif cell.cell_type == "code":
            codes.append(cell.source)
            where = f"cell {len(codes)}"
            # A cell that has not run yet has no outputs; pairs.py reports it.
            stored = next(outputs, nbformat.v4.new_code_cell())
            picture = Facts(picture_facts(stored))
            for text in texts_of(cell):
                for numeral in numerals_of(text, section):
                    numerals.append(replace(numeral, picture=picture))
            facts += code_facts(cell.source, where, section)
            facts += output_facts(stored, where, section)
    return numerals, facts + facts_of_sources(source, "\n".join(codes))


def share_of_others(numerals: list[Numeral], facts: Facts) -> float:
    """Return how often another number in the place of a numeral would be traced as well."""
    traces = [
        trace(other, facts)
        for numeral in numerals
        if numeral.source.startswith(
            ("code", "output", "picture", "published", "cited")
        )
        for other in others(numeral)
    ]
    good = [text for text in traces if text and not text.startswith("beside")]
    return len(good) / max(len(traces), 1)


def report(source: Path, known: list[dict[str, str]], show_all: bool) -> int:
    """Print a chapter's numerals without a source, or all; return the number of faults."""
    numerals, fact_list = read_chapter(source)
    facts = Facts(fact_list)
    phrases = [row for row in known if row["chapter"] == source.stem]
    for numeral in numerals:
        reasons = [
            f"known: {row['reason']}"
            for row in phrases
            if row["phrase"] in numeral.sentence and numeral.text in row["phrase"]
        ]
        numeral.source = numeral.source or trace(numeral, facts) or "".join(reasons[:1])
        if show_all or not numeral.source:
            print(
                f"{source.stem}: {numeral.text!r}: {numeral.source or 'UNTRACED'} "
                f"| {numeral.sentence}"
            )
    prose = " ".join(numeral.sentence for numeral in numerals)
    gone = [row["phrase"] for row in phrases if row["phrase"] not in prose]
    for phrase in gone:
        print(f"{source.stem}: numerals.csv lists a phrase that is gone: {phrase}")
    counts = Counter(n.source.split(":")[0] or "untraced" for n in numerals)
    summary = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    print(
        f"{source.stem}: {len(numerals)} numerals: {summary}; of others in their place "
        f"{share_of_others(numerals, facts):.0%} would be traced"
    )
    return counts["untraced"] + len(gone)


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Trace the numerals of the prose to their sources."
    )
    parser.add_argument("chapters", nargs="*", help="names or numbers; all without one")
    parser.add_argument("--all", action="store_true", help="list the traced ones too")
    options = parser.parse_args()
    with KNOWN.open(encoding="utf-8", newline="") as file:
        known = list(csv.DictReader(file))
    sources = chosen(options.chapters)
    return int(any([report(source, known, options.all) for source in sources]))


if __name__ == "__main__":
    sys.exit(main())
