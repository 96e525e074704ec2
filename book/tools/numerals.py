"""Find every number in the prose of the chapters where it is shown.

    python book/tools/numerals.py [CHAPTER ...] [--all]

Prose is the text between the cells with its tables, exercises and solutions, and of the cells the
captions and alternative texts. Of a number it is asked that one of these places shows it:

section
    code, an output or a worked formula of its own section that gives the same digits; with three
    digits that count it may be rounded. A section reaches from one heading or exercise to the next.
    Code that draws a picture counts for the caption only.
named place
    an output or the curves of a figure, or a section, that the sentence names by its label
constant
    a number of the page, of a study or of a scenario, whose name is in the sentence: with all its
    words, or two of them
output of the page
    anywhere, if it has three digits that count or is in words

The curves of a picture are also shown by its caption and its alternative text. A number with a
citation in its sentence is the cited work's, and 95% is the level of an interval. Left out are
names, years, numbers of chapters, figures, equations and the like, definitions in formulas, and
counts in words up to twelve. The tool ends with an error if a number is shown nowhere.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
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

SCENARIOS = dict.fromkeys(("01", "02", "03", "04"), "grange")
SCENARIOS |= dict.fromkeys(("05", "06"), "das")
SCENARIOS |= dict.fromkeys(("07", "08"), "semeraro")
SCENARIOS |= dict.fromkeys(("09", "10"), "zheng")
"""The scenarios of the chapter of each number."""

# --- numbers in words and digits ------------------------------------------------------------------

ONES = re.findall(
    r"\w+",
    """zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen
    fifteen sixteen seventeen eighteen nineteen""",
)
TENS = re.findall(r"\w+", "twenty thirty forty fifty sixty seventy eighty ninety")
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
    r"times\b|-?fold\b|rad\b|radian|nats?\b|arcsec|orders? of|Hz\b": (),
}
"""Units after a number, and factors by which its value may be multiplied in the code."""
LABELS = (
    r"chapters?|figs?\.|figures?|tables?|sections?|equations?|eqs?\.|algorithms?|lines?|steps?"
    r"|items?|agents?|parts?|exercises?|rows?|version|theorems?|pages?|panels?|mixands?|sensors?"
    r"|conditions?|neighbours?|bodies|body|component|column|node|member|lemma|corollary|order"
    r"|degree|level|satellites?|robots?|state|appendix|errat(?:um|a)|places?"
    r"|rounds?|title|remarks?|facts?"
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
    labels: frozenset[str] = frozenset()
    """The figures and sections that the sentence names, or the figure that it describes."""
    source: str = ""

    @property
    def is_long(self) -> bool:
        """Whether it has three digits that count."""
        return len(re.sub(r"e.*|[^0-9]", "", self.text).lstrip("0")) > 2


@dataclass
class Shown:
    """A number of the code, of an output or of a source."""

    kind: str
    value: float
    where: str
    section: int = -1
    """The section that shows it; -1 for a picture and for values from outside the page."""
    labels: frozenset[str] = frozenset()
    """The labels of its section and its picture."""
    name: frozenset[str] = frozenset()
    """The words of its name."""
    step: float = 0.0
    """One unit in the last digit that an output prints."""

    def belongs_to(self, numeral: Numeral, exact: bool) -> bool:
        """Return whether a sentence may take a number from this place."""
        if self.section == numeral.section or self.labels & numeral.labels:
            return True
        if self.kind == "output":
            return exact and numeral.is_long or not numeral.step
        shared = self.name & numeral.words
        return len(shared) > 1 or bool(shared) and shared == self.name


GENERIC = frozenset(
    re.findall(
        r"\w+",
        """less least more most greater between within equal close checks true false number value
        name label title text caption figure table first second last size shape axis axes index
        default array numpy list dict range print plot style color marker alpha line times std""",
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


def step_of(text: str) -> float:
    """Return one unit in the last digit of a number in digits; zero for words."""
    if not re.search(r"\d", text):
        return 0.0
    # 1.20e3 has two decimals, and its last digit is worth 10.
    mantissa, _, power = text.partition("e")
    return 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))


# --- the prose ------------------------------------------------------------------------------------


def evaluate(text: str) -> float | None:
    """Return the value of a formula of numbers only, or None."""
    # TeX becomes Python: \frac12, \frac{1}{2}, \sqrt{2}, |x|, e^x, \cdot, 2\pi.
    for tex, code in (
        (r"\\[td]?frac(\d)(\d)", r"(\1/\2)"),
        (r"\\[td]?frac(\d)\{(\d+)\}", r"(\1/\2)"),
        (r"\\[td]?frac\{([^{}]*)\}\{([^{}]*)\}", r"((\1)/(\2))"),
        (r"\\(sqrt|log)\s*\{?(\d+)\}?", r"\1(\2)"),
        (r"\|([^|]+)\|", r"abs(\1)"),
        (r"\\pi", "(pi)"),
        (r"\be\^", "(exp(1))^"),
        (r"\\cdot|\\times", "*"),
        (r"\^", "**"),
        (r"\\(?:left|right|[,;! ])|[\s{}&]", ""),
        (r"(?<=[\d)])(?=[a-z(])", "*"),
    ):
        text = re.sub(tex, code, text)
    # With any other name it is a definition, not arithmetic.
    if not re.fullmatch(r"(?:sqrt|log|abs|exp|pi|[-+*/().\d])+", text):
        return None
    names = {"sqrt": math.sqrt, "log": math.log, "abs": abs, "pi": math.pi}
    with contextlib.suppress(SyntaxError, ArithmeticError, TypeError, ValueError):
        return float(eval(text, {"__builtins__": {}}, names | {"exp": math.exp}))
    return None


def worked_out(formula: str) -> list[str]:
    """Return the sides of a formula that are numbers alone and equal to the side before or after.

    A side behind an approximate sign may be off by two percent, any other by its last digit.
    """
    formula = formula.replace("{,}", "").replace("\\,", "").replace("\\%", "")
    signs = r"(=|\\approx|\\leq?|\\geq?|<|>|\\\\)"
    sides = re.split(signs, re.sub(r"[.,;]\s*$", "", formula.strip()))
    found = []
    for left, sign, right in zip(sides[::2], sides[1::2], sides[2::2], strict=False):
        values = evaluate(left), evaluate(right)
        if sign not in ("=", r"\approx") or None in values:
            continue
        # Two plain numbers are no calculation.
        if re.fullmatch(r"[\s&{}-]*[\d.]+[\s&{}]*", left):
            continue
        step = step_of(re.sub(r"[^\d.]", "", right) or "1")
        loose = 0.02 * abs(values[1]) if "approx" in sign else 0.0
        if abs(values[0] - values[1]) <= max(loose, 0.5001 * step):
            found += [left, right]
    return found


def text_of_formula(match: re.Match[str]) -> str:
    """Return the text that replaces a formula: a blank, or the number at its end."""
    formula = match[1].replace("{,}", "").replace("\\,", " ").replace("\\%", "%")
    formula = formula.strip()
    # "2 + 3 = 5": the number at the end is checked here, if the rest is numbers only.
    sides = worked_out(match[1])
    if sides and re.fullmatch(r"\s*-?\d+(?:\.\d+)?\s*", sides[-1]):
        return f" {sides[-1].strip()} ≗ "
    # "2 · 10^3" is one number.
    power = re.fullmatch(r"(?:([\d.]*) ?\\(?:cdot|times) ?)?10\^\{?(-?\d+)\}?", formula)
    if power:
        return f" {power[1] or 1}e{power[2]} "
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
        # Marks stand for a citation and for the figure or section that a sentence names.
        (r"\{cite:\w\}`[^`]*`", " ⸢cited⸣ "),
        (r"\{(?:num)?ref\}`(?:[^`<]*<)?([\w-]+)>?`", r" ⸢\1⸣ "),
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
        r"⸢.*?⸣",
        # References such as (12), names such as x1 or 2-D, "12, 2003)" of a citation
        r"\((?!\d+\) =)\d{1,2}[a-z]?\)(?:-\(\d+\))?|\[\d{1,2}\]",
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
        labels = frozenset(re.findall(r"⸢([\w-]+)⸣", sentence))
        words = stems(re.sub(r"⸢.*?⸣", "", sentence))
        in_digits = list(DIGITS.finditer(clean))
        taken = {k for hit in in_digits for k in range(*hit.span())}
        # "2 hundred" is found in digits and in words: the first counts.
        in_words = [h for h in WORDS.finditer(clean) if not taken & {*range(*h.span())}]
        for hit in (*in_digits, *in_words):
            number = hit[0].strip()
            # The unit follows the number, after a blank or a hyphen.
            after = clean[hit.end() :].lstrip(" -)")
            unit = unit_of(after)
            # The unit counts as a word: "after 20 s" may be a parameter in seconds.
            named = words | ({unit} if unit else set())
            value, step = value_of(number), step_of(number)
            numeral = Numeral(
                number, value, step, unit, section, sentence, named, labels
            )
            if re.fullmatch(r"an?|one", number, re.I) or (
                number.lower() in ("third", "quarter") and not unit
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
    """Return the source that a numeral has by its form: a formula, a count in words, or none."""
    if after.startswith("≗"):
        return "formula"
    # The usual level of an interval
    if numeral.text == "95" and after.startswith("%"):
        return "level"
    text = numeral.text.lower()
    if re.search(r"\d", text):
        return ""
    small = numeral.value in (0.5, *range(13)) and not numeral.unit
    ordinal = ORDINAL.fullmatch(text) and not re.match(r"of\b", after)
    # "two seconds" and "two metres" are phrases, not measurements.
    phrase = text == "two" and numeral.unit.startswith(("s", "m", "day"))
    return "count" if small or ordinal or phrase else ""


# --- the numbers of the code, its outputs and its sources -----------------------------------------


def constant(node: ast.AST) -> float | None:
    """Return the value of a number or of arithmetic with numbers alone, or None."""
    if isinstance(node, ast.Constant | ast.UnaryOp | ast.BinOp):
        with contextlib.suppress(Exception):
            value = eval(ast.unparse(node), {"__builtins__": {}})
            # `type` instead of isinstance, since True is an int.
            return float(value) if type(value) in (int, float) else None
    return None


def code_numbers(
    code: str, where: str, section: int = -1, labels: frozenset[str] = frozenset()
) -> Iterator[Shown]:
    """Yield the numbers of code with the words of their names."""
    lines = ["", *code.splitlines()]

    def walk(node: ast.AST, name: str) -> Iterator[Shown]:
        # A number is named by the variable that it is assigned to, or by the text beside it.
        match node:
            case ast.Assign():
                name = " ".join(map(ast.unparse, node.targets))
            case ast.AnnAssign():
                name = ast.unparse(node.target)
            case ast.keyword(arg=str(argument)):
                name = argument if stems(argument) else name
            case ast.Call(args=[ast.Constant(value=str(text)), *_]):
                name = text
            case ast.Dict():
                for key, value in zip(node.keys, node.values, strict=True):
                    key_text = ast.unparse(key) if key else ""
                    yield from walk(value, key_text)
                return
        value = constant(node)
        if value is not None:
            place = f"{where}: {lines[node.lineno].strip()}"
            yield Shown("code", value, place, section, labels, stems(name))
            return
        for child in ast.iter_child_nodes(node):
            yield from walk(child, name)

    yield from walk(ast.parse(code), "")


def formula_numbers(text: str, section: int, labels: frozenset[str]) -> Iterator[Shown]:
    """Yield the numbers of the formulas that are worked out."""
    blocks = r"(?s)`{3,}\{math\}(.*?)```|\$\$(.*?)\$\$|\$([^$]+)\$"
    for match in re.finditer(blocks, text):
        formula = re.sub(
            r"(?m)^:.*$|\\(?:begin|end)\{\w+\}",
            "",
            "".join(filter(None, match.groups())),
        )
        for side in worked_out(formula):
            for number in re.findall(r"\d+(?:\.\d+)?", side.replace("\\,", "")):
                yield Shown("formula", float(number), side, section, labels)


def flat(value: Any) -> Iterator[float]:
    """Yield the numbers of a nested list, and the lengths of its parts."""
    if isinstance(value, list):
        yield len(value)
        for item in value:
            yield from flat(item)
    elif isinstance(value, int | float):
        yield value


def scenario_numbers(path: Path) -> Iterator[Shown]:
    """Yield the numbers of a scenario with the words of their names and of their reasons."""
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    data.pop("title", "")
    entries = data.pop("parameters", {}) | data.pop("notes", {})
    for name, entry in entries.items():
        reason = " ".join(entry.get(key, "") for key in ("where", "reason", "note"))
        values = [*flat(entry["value"])]
        # The reason may hold another value, such as the paper's.
        values += [value_of(m[0]) for m in DIGITS.finditer(reason) if len(m[0]) > 1]
        words = stems(f"{name} {reason}")
        where = f"{path.name}: {name}"
        for value in values:
            yield Shown("constant", value, where, name=words)
            yield Shown("constant", value, where, name=stems(name))
    for key, rows in data.items():
        for row in rows:
            for name, cell in row.items():
                for value in flat(cell):
                    where = f"{path.name}: {name}"
                    yield Shown("constant", value, where, name=stems(f"{key} {name}"))


def texts_of_output(output: Any) -> Iterator[str]:
    """Yield the printed text of an output, and the cells of its tables."""
    data = output.get("data", {})
    page = data.get("text/html", "")
    # The text of a picture is a digest, whose digits prove nothing.
    if SLIDER in page or any(mime.startswith("image/") for mime in data):
        return
    yield output.get("text", "")
    yield from map(str, data.get(VERDICT, {}).values())
    yield BeautifulSoup(page, "html.parser").get_text(" ") or data.get("text/plain", "")


def output_numbers(
    cell: Any, where: str, section: int, labels: frozenset[str]
) -> Iterator[Shown]:
    """Yield the numbers that a cell's stored outputs print."""
    for output in cell.outputs:
        for text in texts_of_output(output):
            for match in DIGITS.finditer(text):
                value, step = value_of(match[0]), step_of(match[0])
                yield Shown("output", value, where, section, labels, step=step)


def curve_numbers(cell: Any, where: str, labels: frozenset[str]) -> Iterator[Shown]:
    """Yield the ranges of the curves of a cell's pictures, from their digests."""
    for output in cell.outputs:
        digest = output.get("data", {}).get("text/plain", "")
        # "line 1 y: 60 values, 1..25, mean 4.6, projection 0.3"
        for line in re.findall(r"values, (.*?), mean", digest):
            for text in line.split(".."):
                with contextlib.suppress(ValueError):
                    value, step = float(text), step_of(text)
                    yield Shown("picture", value, where, labels=labels, step=step)


@cache
def study_numbers(name: str) -> tuple[Shown, ...]:
    """Return the numbers of a study's script and its imports."""
    path = BOOK / "studies" / f"{name.replace('-', '_')}.py"
    if not path.is_file():
        return ()
    code = path.read_text(encoding="utf-8")
    numbers = list(code_numbers(code, path.name))
    # A study that imports another script uses its numbers too.
    imports = r"^(?:import|from) (\w+)|script\(\"([\w-]+)\"\)"
    for other in re.findall(imports, code, re.M):
        numbers += study_numbers(other[0] or other[1])
    return tuple(numbers)


@cache
def numbers_of_scenarios(paper: str) -> tuple[Shown, ...]:
    """Return the numbers of a paper's scenarios."""
    numbers: list[Shown] = []
    for path in sorted((ROOT / "data" / "scenarios" / paper).glob("*.toml")):
        numbers += scenario_numbers(path)
    return tuple(numbers)


def numbers_of_sources(source: Path, code: str) -> list[Shown]:
    """Return the numbers of the studies and scenarios of a chapter."""
    numbers: list[Shown] = []
    studies = re.findall(r"(?:script\(|stored\(\s*\"\w+\",\s*)\"([\w-]+)\"", code)
    for name in sorted(set(studies)):
        numbers += study_numbers(name)
    # The first page shows results of chapter 4, so it may use its numbers.
    if source.stem == "index":
        for other in chosen(["04", "04b"]):
            numbers += [replace(s, section=1) for s in read_chapter(other)[1]]
    paper = SCENARIOS.get(source.stem[:2])
    return [*numbers, *(numbers_of_scenarios(paper) if paper else ())]


# --- the chapters ---------------------------------------------------------------------------------


class Numbers:
    """The numbers that a chapter shows, in the order of their values."""

    def __init__(self, numbers: Iterable[Shown]) -> None:
        self.all = sorted(numbers, key=lambda shown: abs(shown.value))
        self.values = [abs(shown.value) for shown in self.all]

    def source_of(self, numeral: Numeral) -> str:
        """Return where a number of the prose is shown, or ''."""
        if "cited" in numeral.labels:
            return "cited"
        for factor in (1.0, *UNITS.get(numeral.unit, ())):
            value = abs(numeral.value) * factor
            for shown in self.equal_to(value, numeral.step * factor, numeral.is_long):
                exact = math.isclose(abs(shown.value), value, rel_tol=1e-6)
                if shown.belongs_to(numeral, exact):
                    return f"{shown.kind}: {shown.where}"
        return ""

    def equal_to(self, value: float, step: float, is_long: bool) -> Iterator[Shown]:
        """Yield the numbers that a numeral with this value and last digit may state."""
        # In words a number is round: "forty", "a fifth".
        round_half = 0.5 if value == int(value) else 0.1 * value
        half = 0.5001 * step or round_half
        for shown in self.between(value - half, value + half):
            exact = math.isclose(abs(shown.value), value, rel_tol=1e-6, abs_tol=1e-9)
            # Curves and long numbers may be rounded; any other is given as it is shown.
            rounded = shown.kind == "picture" or is_long
            if exact or (rounded and 0 < shown.step <= step or shown.step and not step):
                yield shown
        # "A fifth" may be the number 5 of the code.
        if not step and 0 < value < 1:
            yield from self.between(1 / value - 1e-9, 1 / value + 1e-9)

    def between(self, low: float, high: float) -> list[Shown]:
        """Return those with an absolute value in an interval."""
        first = bisect_left(self.values, low)
        return self.all[first : bisect_right(self.values, high)]


def texts_of(cell: Any) -> Iterator[str]:
    """Yield the caption of a cell's picture, and the alternative text for screen readers."""
    options = cell.metadata.get("mystnb", {})
    yield options.get("figure", {}).get("caption", "")
    yield options.get("image", {}).get("alt", "")
    for node in ast.walk(ast.parse(cell.source)):
        if isinstance(node, ast.keyword) and node.arg == "alt":
            yield ast.unparse(node.value).strip("'\"")


def read_chapter(source: Path) -> tuple[list[Numeral], list[Shown]]:
    """Return the numerals of a chapter and the numbers that it shows."""
    notebook = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    outputs = iter([cell for cell in notebook.cells if cell.cell_type == "code"])
    numerals: list[Numeral] = []
    numbers: list[Shown] = []
    codes: list[str] = []
    section = 0
    labels: frozenset[str] = frozenset()
    next_labels: frozenset[str] = frozenset()
    for cell in read(source).cells:
        if cell.cell_type == "markdown":
            # Every heading and every exercise starts a section, to which the cells after it belong.
            for part in re.split(r"(?m)^(?=#+ |`{3,}\{exercise\})", cell.source):
                if part.startswith(("#", "```")):
                    section += 1
                    labels = next_labels | {*re.findall(r"(?m)^:label: (.+)", part)}
                # The label of a heading stands before it.
                next_labels = frozenset(re.findall(r"\(([\w-]+)\)=\s*\Z", part))
                numerals += numerals_of(part, section)
                numbers += formula_numbers(part, section, labels)
        elif cell.cell_type == "code":
            codes.append(cell.source)
            where = f"cell {len(codes)}"
            # A cell that has not run yet has no outputs; pairs.py reports it.
            stored = next(outputs, nbformat.v4.new_code_cell())
            options = cell.metadata.get("mystnb", {})
            own = frozenset([options.get("figure", {}).get("name", where)])
            for text in texts_of(cell):
                for numeral in numerals_of(text, section):
                    numerals.append(replace(numeral, labels=numeral.labels | own))
            # The text does not speak of sizes and limits of a picture.
            drawn = "figure" in options
            code_section, code_labels = (-1, own) if drawn else (section, labels)
            numbers += code_numbers(cell.source, where, code_section, code_labels)
            numbers += output_numbers(stored, where, section, labels | own)
            numbers += curve_numbers(stored, where, own)
    return numerals, numbers + numbers_of_sources(source, "\n".join(codes))


def report(source: Path, show_all: bool) -> int:
    """Print a chapter's numerals that are shown nowhere, or all; return their number."""
    numerals, number_list = read_chapter(source)
    numbers = Numbers(number_list)
    for numeral in numerals:
        numeral.source = numeral.source or numbers.source_of(numeral)
        if show_all or not numeral.source:
            place = numeral.source or "SHOWN NOWHERE"
            print(f"{source.stem}: {numeral.text!r}: {place} | {numeral.sentence}")
    counts = Counter(n.source.split(":")[0] or "shown nowhere" for n in numerals)
    summary = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    print(f"{source.stem}: {len(numerals)} numerals: {summary}")
    return counts["shown nowhere"]


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Find every number in the prose where it is shown."
    )
    parser.add_argument("chapters", nargs="*", help="names or numbers; all without one")
    parser.add_argument("--all", action="store_true", help="list the found ones too")
    options = parser.parse_args()
    sources = chosen(options.chapters)
    return int(any([report(source, options.all) for source in sources]))


if __name__ == "__main__":
    sys.exit(main())
