"""What the figures draw, and what their digests notice and overlook."""

from __future__ import annotations

import base64
import html.parser
import json
import re

import matplotlib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.colors import to_rgb

from bookkit import plotting
from bookkit.plotting import (
    LINE_STYLES,
    PALETTE,
    SIZE,
    Slider,
    axes,
    band,
    colour,
    digest,
    ellipse,
    graph,
    line_style,
    save,
    slider,
    use_style,
)


@pytest.fixture(autouse=True)
def _fresh_style():
    with matplotlib.rc_context():
        yield
    pyplot.close("all")


def blank():
    return axes(xlabel="x", ylabel="y")


def curve(rate, width=3.0):
    ax = axes(xlabel="time", ylabel="x", size=(width, 2))
    t = np.linspace(0, 1, 50)
    ax.plot(t, np.exp(-rate * t))
    ax.set_ylim(0, 1.1)
    return ax


def noise(seed):
    ax = axes(xlabel="x", ylabel="y")
    ax.imshow(np.random.default_rng(seed).random((400, 600)), aspect="auto")
    return ax.figure


EYE = np.eye(2)
RUNS = np.arange(12.0).reshape(4, 3)
PAIR = [[0, 1], [1, 0]]

_CASES = {
    "colour": [("index", lambda: colour(-1)), ("index", lambda: colour(0.5))],
    "line_style": [("index", lambda: line_style(-1)), ("index", lambda: line_style("-"))],
    "axes": [
        ("xlabel", lambda: axes(xlabel="", ylabel="y")),
        ("ylabel", lambda: axes(xlabel="x", ylabel=None)),
        ("xunit", lambda: axes(xlabel="x", ylabel="y", xunit=" ")),
        ("yunit", lambda: axes(xlabel="x", ylabel="y", yunit=1)),
        ("title", lambda: axes(xlabel="x", ylabel="y", title="")),
        ("ax", lambda: axes(xlabel="x", ylabel="y", ax="here")),
        ("xscale", lambda: axes(xlabel="x", ylabel="y", xscale="cubic")),
        ("yscale", lambda: axes(xlabel="x", ylabel="y", yscale="dB")),
        ("size", lambda: axes(xlabel="x", ylabel="y", size=(6, 0))),
        ("size", lambda: axes(xlabel="x", ylabel="y", size=6)),
    ],
    "ellipse": [
        ("ax", lambda: ellipse(None, [0, 0], EYE)),
        ("mean", lambda: ellipse(blank(), [0, 0, 0], EYE)),
        ("covariance", lambda: ellipse(blank(), [0, 0], np.eye(3))),
        ("covariance", lambda: ellipse(blank(), [0, 0], [[1, 2], [2, 1]])),
        ("covariance", lambda: ellipse(blank(), [0, 0], [[1, 0.5], [0, 1]])),
        ("level", lambda: ellipse(blank(), [0, 0], EYE, level=1)),
        ("index", lambda: ellipse(blank(), [0, 0], EYE, index=-1)),
        ("label", lambda: ellipse(blank(), [0, 0], EYE, label=3)),
    ],
    "band": [
        ("ax", lambda: band(3, np.arange(3), RUNS)),
        ("x", lambda: band(blank(), [0, 0, 1], RUNS)),
        ("runs", lambda: band(blank(), np.arange(4), RUNS)),
        ("runs", lambda: band(blank(), np.arange(3), np.full((2, 3), np.nan))),
        ("runs", lambda: band(blank(), np.arange(3), np.zeros((0, 3)))),
        ("quantiles", lambda: band(blank(), np.arange(3), RUNS, quantiles=(0.9, 0.1))),
        ("quantiles", lambda: band(blank(), np.arange(3), RUNS, quantiles=(-0.1, 0.9))),
        ("quantiles", lambda: band(blank(), np.arange(3), RUNS, quantiles=(25, 75))),
        ("index", lambda: band(blank(), np.arange(3), RUNS, index=None)),
        ("label", lambda: band(blank(), np.arange(3), RUNS, label=" ")),
    ],
    "graph": [
        ("ax", lambda: graph(None, PAIR)),
        ("adjacency", lambda: graph(blank(), [[0, 1], [0, 0]])),
        ("adjacency", lambda: graph(blank(), [[0, 1]])),
        ("adjacency", lambda: graph(blank(), np.zeros((0, 0)))),
        ("labels", lambda: graph(blank(), PAIR, labels=["A"])),
        ("labels", lambda: graph(blank(), PAIR, labels=["A", 2])),
        ("positions", lambda: graph(blank(), PAIR, positions=[[0, 1]])),
        ("known", lambda: graph(blank(), PAIR, known=[0.0, 1.5])),
        ("known", lambda: graph(blank(), PAIR, known=[-0.1, 1.0])),
        ("known", lambda: graph(blank(), PAIR, known=[1.0])),
        ("notes", lambda: graph(blank(), PAIR, notes=["one"])),
        ("notes", lambda: graph(blank(), PAIR, notes=3.5)),
        ("notes", lambda: graph(blank(), PAIR, notes="ab")),
        ("labels", lambda: graph(blank(), PAIR, labels="AB")),
        ("notes", lambda: graph(blank(), PAIR, notes=["one", 2])),
    ],
    "save": [
        ("figure", lambda: save(blank(), "a.png")),
        ("path", lambda: save(blank().figure, "a.bmp")),
        ("path", lambda: save(blank().figure, None)),
    ],
    "digest": [
        ("arrays", lambda: digest()),
        ("curve", lambda: digest(curve="abc")),
        ("curve", lambda: digest(curve=[[1, 2], [3]])),
    ],
}
_CASES |= {
    "slider": [
        ("draw", lambda: slider(3, [1.0], label="x", alt="y")),
        ("draw", lambda: slider(lambda v: 3, [1.0], label="x", alt="y")),
        ("draw", lambda: slider(lambda v: blank(), [1.0], label="x", alt="y")),
        ("draw", lambda: slider(lambda v: curve(v, width=v), [3.0, 4.0], label="x", alt="y")),
        ("values", lambda: slider(curve, [], label="x", alt="y")),
        ("values", lambda: slider(curve, "abc", label="x", alt="y")),
        ("values", lambda: slider(curve, object(), label="x", alt="y")),
        ("values", lambda: slider(curve, np.array(1.0), label="x", alt="y")),
        ("label", lambda: slider(curve, [1.0], label=" ", alt="y")),
        ("alt", lambda: slider(curve, [1.0], label="x", alt="")),
        ("unit", lambda: slider(curve, [1.0], label="x", alt="y", unit="")),
        ("form", lambda: slider(curve, [1.0], label="x", alt="y", form="d")),
        ("start", lambda: slider(curve, [1.0], label="x", alt="y", start=1)),
        ("seconds", lambda: slider(curve, [1.0], label="x", alt="y", seconds=0)),
        ("colours", lambda: slider(curve, [1.0], label="x", alt="y", colours=1)),
        ("colours", lambda: slider(curve, [1.0], label="x", alt="y", colours=300)),
        ("frames", lambda: slider(noise, range(4), label="x", alt="y", form="d", colours=256)),
    ],
    "Slider": [
        ("frames", lambda: Slider((), (), (), label="x", alt="y")),
        ("frames", lambda: Slider(3.5, ("a",), ("b",), label="x", alt="y")),
        ("frames", lambda: Slider(("a",), ("a",), ("b",), label="x", alt="y")),
        ("said", lambda: Slider((b"",), "a", ("b",), label="x", alt="y")),
        ("said", lambda: Slider((b"",), (None,), ("b",), label="x", alt="y")),
        ("digests", lambda: Slider((b"",), ("a",), {"b": 1}, label="x", alt="y")),
        ("digests", lambda: Slider((b"",), ("a",), (7.5,), label="x", alt="y")),
        ("frames", lambda: Slider((b"",), (), ("",), label="x", alt="y")),
    ],
}  # fmt: skip
_REFUSED = {f"bookkit.plotting.{name}": cases for name, cases in _CASES.items()} | {
    "bookkit.digests.digest": _CASES["digest"]
}
_NONE = {
    "bookkit.plotting.LINE_STYLES": "a constant",
    "bookkit.plotting.PALETTE": "a constant",
    "bookkit.plotting.SIZE": "a constant",
    "bookkit.plotting.use_style": "takes no input",
}


@pytest.mark.parametrize("name", sorted(_REFUSED))
def test_bad_input_is_named(name):
    for argument, call in _REFUSED[name]:
        with pytest.raises(ValueError, match=rf"^{argument}: "):
            call()
        pyplot.close("all")


def test_every_public_name_has_bad_input_or_a_reason():
    names = {f"bookkit.plotting.{name}" for name in plotting.__all__}
    assert names <= _REFUSED.keys() | _NONE.keys()


# --- figures ----------------------------------------------------------------------------------

# Machado, Oliveira and Fernandes (2009), severity 1, for linear RGB: how each reader sees a colour.
_VISION = {
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
               [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
               [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
               [0.004733, 0.691367, 0.303900]],
}  # fmt: skip


def _lab(rgb):
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    f = np.cbrt(np.clip(to_xyz @ rgb / [0.9505, 1.0, 1.089], 0.0089, None))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def _closest_pair(colours, vision):
    rgb = np.array([to_rgb(c) for c in colours])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = [_lab(np.clip(_VISION[vision] @ c, 0, 1)) for c in linear]
    return min(np.linalg.norm(a - b) for i, a in enumerate(seen) for b in seen[:i])


@pytest.mark.parametrize("vision", sorted(_VISION))
def test_palette_stays_distinct(vision):
    # A difference of about 2 is just noticeable side by side; thin lines need several times that.
    assert _closest_pair(PALETTE, vision) > 10


def test_the_default_colours_would_not_stay_distinct():
    assert _closest_pair(matplotlib.colormaps["tab10"].colors[:8], "protan") < 10


def test_colour_and_style_pairs_repeat_late():
    assert len({(colour(k), str(line_style(k))) for k in range(40)}) == 40
    assert len(set(PALETTE)) == 8 and len(set(map(str, LINE_STYLES))) == 5


def test_axes_are_labelled_with_units():
    ax = axes(xlabel="time", xunit="s", ylabel="error", title="Runs", yscale="log")
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_title()) == ("time (s)", "error", "Runs")
    assert ax.get_yscale() == "log" and tuple(ax.figure.get_size_inches()) == SIZE
    again = axes(xlabel="lag", ylabel="error", ax=ax)
    assert again is ax and ax.get_xlabel() == "lag"


def test_ellipse_holds_its_share():
    cov, mean = np.array([[4.0, 1.5], [1.5, 1.0]]), np.array([3.0, -2.0])
    ax = ellipse(blank(), mean, cov, level=0.8, index=1, label="A")
    outline = ax.lines[0].get_xydata() - mean
    squared = (outline * np.linalg.solve(cov, outline.T).T).sum(axis=1)
    assert np.allclose(squared, -2 * np.log(0.2), rtol=1e-10)
    assert ax.lines[0].get_color() == PALETTE[1] and ax.lines[0].get_label() == "A"
    assert ax.lines[1].get_xydata().tolist() == [mean.tolist()]
    line = ellipse(blank(), mean, [[4.0, 0.0], [0.0, 0.0]]).lines[0].get_xydata()
    assert np.allclose(line[:, 1], -2.0) and np.ptp(line[:, 0]) > 9


def test_band_shows_median_and_quantiles():
    runs = np.random.default_rng(0).standard_normal((101, 7))
    ax = band(blank(), np.arange(7), runs, quantiles=(0.05, 0.95), index=2, label="runs")
    ordered = np.sort(runs, axis=0)
    assert np.allclose(ax.lines[0].get_ydata(), ordered[50])
    edges = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert edges.min() == pytest.approx(ordered[5].min())
    assert edges.max() == pytest.approx(ordered[95].max())
    assert ax.lines[0].get_label() == "runs"


def test_graph_draws_links_once():
    adjacency = np.array([[1, 1, 1], [1, 0, 0], [1, 0, 1]])
    ax = graph(blank(), adjacency, labels=["A", "B", "C"])
    ends = {tuple(map(tuple, line.get_xydata().round(6))) for line in ax.lines}
    discs = [tuple(p) for p in ax.collections[0].get_offsets().round(6).tolist()]
    assert ends == {(discs[0], discs[1]), (discs[0], discs[2])}
    assert discs[0] == (0.0, 1.0)
    assert np.allclose(np.hypot(*np.transpose(discs)), 1, atol=1e-5)
    alone = graph(blank(), [[0]])
    assert not alone.lines and alone.collections[0].get_offsets().tolist() == [[0.0, 0.0]]
    placed = graph(blank(), PAIR, positions=[[0, 0], [2, 1]])
    assert placed.lines[0].get_xydata().tolist() == [[0, 0], [2, 1]]


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_same_figure_is_the_same_file(tmp_path, suffix):
    use_style()
    files = []
    for k in range(2):
        ax = axes(xlabel="time", xunit="s", ylabel=r"error $\epsilon$", yunit="m")
        band(ax, np.arange(3), RUNS, label="runs")
        ax.legend()
        files.append(save(ax.figure, tmp_path / f"{k}{suffix}").read_bytes())
    assert files[0] == files[1]
    assert b"matplotlib.org/" not in files[0] if suffix == ".png" else b"<dc:date>" not in files[0]


def test_style_fixes_size_and_resolution():
    use_style()
    assert tuple(matplotlib.rcParams["figure.figsize"]) == SIZE
    assert matplotlib.rcParams["figure.dpi"] == matplotlib.rcParams["savefig.dpi"] == 110
    assert matplotlib.rcParams["axes.prop_cycle"].by_key()["color"] == list(PALETTE)


def test_graph_shows_who_knows_what():
    ax = graph(blank(), PAIR, labels=["A", "B"], known=[0.0, 1.0], notes=["angle", ""])
    empty, full = ax.collections[0].get_facecolors()
    assert empty.tolist() == [1, 1, 1, 1] and np.allclose(full[:3], to_rgb(colour(5)))
    half = graph(blank(), PAIR, known=[0.5, 0.5]).collections[0].get_facecolors()[0]
    assert np.allclose(half[:3], 0.5 + 0.5 * np.array(to_rgb(colour(5))))
    assert [t.get_text() for t in ax.texts] == ["A", "angle", "B"]


# --- pictures that move -----------------------------------------------------------------------


class _Page(html.parser.HTMLParser):
    """Tags with their attributes, and the text of the scripts."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.scripts, self.open = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.open = tag == "script"

    def handle_endtag(self, tag):
        self.open = self.open and tag != "script"

    def handle_data(self, data):
        if self.open:
            self.scripts.append(data)

    def find(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


def test_a_slider_holds_its_frames_and_nothing_else():
    use_style()
    rates = [0.0, 0.5, 1.0, 2.0]
    found = slider(curve, rates, label="rate", unit="1/s", alt="A curve <falls>.", start=2)
    assert found.said == ("rate 0 1/s", "rate 0.5 1/s", "rate 1 1/s", "rate 2 1/s")
    assert len(set(found.frames)) == 4 and not pyplot.get_fignums()
    page = _Page(found.html)
    (image,), (knob,) = page.find("img"), page.find("input")
    assert image["alt"] == "A curve <falls>. rate 1 1/s."
    first = base64.b64decode(image["src"].removeprefix("data:image/png;base64,"))
    assert first == found.frames[2] and first[:4] == b"\x89PNG"
    assert (knob["type"], knob["min"], knob["max"], knob["value"]) == ("range", "0", "3", "2")
    assert knob["aria-label"] == "rate" and len(page.find("button")) == 1
    data = json.loads(page.scripts[0])
    assert [base64.b64decode(f) for f in data["frames"]] == list(found.frames)
    assert data["said"] == list(found.said) and data["milliseconds"] == 500
    assert "http" not in found.html and not any("src" in s for s in page.find("script"))
    assert len(found.html) < 100_000
    bundle = found._repr_mimebundle_()
    assert set(bundle) == {"text/plain", "text/html", "image/png"}
    assert base64.b64decode(bundle["image/png"]) == found.frames[2]


def test_a_slider_drawn_twice_is_the_same_page():
    use_style()
    one, two = (slider(curve, [0.0, 1.0], label="rate", alt="A curve.") for _ in range(2))
    assert one.html == two.html and repr(one) == repr(two)


def test_a_slider_notices_a_changed_frame():
    use_style()
    texts = {
        repr(slider(lambda v, k=k: curve(v * k), [0.5, 1.0], label="rate", alt="A curve."))
        for k in (1.0, 1.01, 0.99)
    }
    assert len(texts) == 3
    keys = {re.search('data-frames="([0-9a-f]{16})"', slider(
        curve, [0.5, last], label="rate", alt="A curve.").html)[1] for last in (1.0, 1.01)}
    assert len(keys) == 2


def test_texts_of_a_slider_cannot_end_its_script():
    found = slider(curve, [1.0], label="rate", alt="</script><b>x</b>")
    page = _Page(found.html)
    assert json.loads(page.scripts[0])["alt"] == "</script><b>x</b>" and not page.find("b")


# --- the digest -------------------------------------------------------------------------------

CURVES = st.lists(st.floats(-1e6, 1e6).map(lambda v: round(v, 3)), min_size=1, max_size=60)


@settings(derandomize=True)  # a number may lie 1e-9 from a tie, by a chance of 1e-5 a number
@given(CURVES, st.integers(0, 2**32 - 1))
def test_digest_survives_rounding(values, seed):
    curve = np.array(values)
    noise = np.random.default_rng(seed).uniform(-1, 1, curve.size)
    assert digest(curve=curve * (1 + 1e-9 * noise)) == digest(curve=curve)
    assert digest(curve=curve + 1e-16 * np.abs(curve).max() * noise) == digest(curve=curve)


@pytest.mark.parametrize("value", [1.0, 10.0, 1e-3, 0.12345, 12.345, 1.0005, 9.9995, -2.5e7, 1e-9])
def test_digest_is_steady_at_round_numbers(value):
    curve = np.array([value, 0.3 * value, -0.7 * value, 1.0])
    texts = {digest(c=curve * (1 + e)) for e in (0.0, 1e-9, -1e-9, 1e-13, -1e-13)}
    assert len(texts) == 1


@given(
    st.lists(st.integers(-50, 50), min_size=2, max_size=60), st.data(), st.sampled_from([-20, 20])
)
def test_digest_sees_one_changed_entry(values, data, change):
    curve = np.array(values, dtype=float)
    moved = curve.copy()
    moved[data.draw(st.integers(0, len(values) - 1))] += change
    # The projection moves by 20/sqrt(4n), at least 1.2, and its last digit is worth at most 0.1.
    assert digest(c=curve) != digest(c=moved)


def test_digest_sees_order_sign_and_size():
    t = np.linspace(0, 6, 200)
    curve = np.sin(t)
    for other in (curve[::-1], -curve, 1.001 * curve, curve + 0.001, np.sin(t + 0.01), curve[:-1]):
        assert digest(c=curve) != digest(c=other)
    swapped = curve.copy()
    swapped[[40, 60]] = swapped[[60, 40]]  # same range, mean and parity
    assert digest(c=curve) != digest(c=swapped)
    bumped = curve.copy()
    bumped[100] += 0.02
    assert digest(c=curve) != digest(c=bumped)


def test_digest_text():
    assert digest(a=[], b=np.zeros(3)) == ("a: 0 values\nb: 3 values, 0..0, mean 0, projection 0")
    assert digest(a=[np.nan, np.nan]) == "a: 2 values, 2 NaN"
    text = digest(a=[1.0, np.nan, np.inf, 2.0])
    assert text.endswith("1 NaN, 1 infinite") and text.startswith("a: 4 values, 1..2, mean 1.5,")
    moved = digest(a=[np.nan, 1.0, np.inf, 2.0])
    assert moved != text
    turn = np.linspace(0, 2 * np.pi, 101)[:-1]
    assert "mean 0," in digest(a=np.sin(turn))
    assert digest(a=np.array([123456, 234567])).startswith("a: 2 values, 1.235e+05..2.346e+05")


def test_digest_is_the_documented_projection():
    values = np.array([3.0, -1.0, 4.0, 1.5])
    k = np.arange(4)
    weights = np.array([1, -1, 1, -1]) * (1 + (k * (np.sqrt(5) - 1) / 2) % 1)
    expected = weights @ values / np.linalg.norm(weights)
    printed = float(digest(a=values).rsplit(" ", 1)[1])
    assert printed == pytest.approx(expected, rel=6e-4)


def test_each_axis_has_its_own_scale() -> None:
    ax = plotting.axes(xlabel="time", ylabel="error", yscale="log")
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "log")
