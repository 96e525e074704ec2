"""Figures, sliders and tables of results."""

from __future__ import annotations

import base64
import io
import json
import re

import matplotlib
import numpy as np
import pandas as pd
import pytest
from bs4 import BeautifulSoup
from PIL import Image

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.colors import to_rgb

from bookkit import plotting
from bookkit.plotting import (
    PALETTE,
    SIZE,
    axes,
    colour,
    graph,
    line_style,
    slider,
    use_style,
)
from bookkit.tables import ResultTable


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


PAIR = [[0, 1], [1, 0]]

# --- figures ----------------------------------------------------------------------------------


def test_colour_and_style_pairs_repeat_late():
    # 8 and 5 have no common divisor: the pair repeats after 40.
    assert len({(colour(k), str(line_style(k))) for k in range(40)}) == 40
    assert len(set(PALETTE)) == 8
    assert len({str(line_style(8 * k)) for k in range(5)}) == 5


def test_axes_are_labelled_with_units():
    ax = axes(xlabel="time", xunit="s", ylabel="error", title="Runs", yscale="log")
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_title()) == (
        "time (s)",
        "error",
        "Runs",
    )
    assert ax.get_yscale() == "log"
    assert tuple(ax.figure.get_size_inches()) == SIZE
    relabelled = axes(xlabel="lag", ylabel="error", ax=ax)
    assert relabelled is ax
    assert ax.get_xlabel() == "lag"


def test_ellipse_holds_its_share():
    cov = np.array([[4.0, 1.5], [1.5, 1.0]])
    mean = np.array([3.0, -2.0])
    ax = plotting.ellipse(blank(), mean, cov, level=0.8, index=1, label="A")
    outline = ax.lines[0].get_xydata() - mean
    # All points of the outline have the Mahalanobis distance of the level.
    squared = (outline * np.linalg.solve(cov, outline.T).T).sum(axis=1)
    assert np.allclose(squared, -2 * np.log(0.2), rtol=1e-10)
    assert ax.lines[0].get_color() == PALETTE[1]
    assert ax.lines[0].get_label() == "A"
    assert ax.lines[1].get_xydata().tolist() == [mean.tolist()]
    # A covariance of rank one gives a line.
    line = (
        plotting.ellipse(blank(), mean, [[4.0, 0.0], [0.0, 0.0]]).lines[0].get_xydata()
    )
    assert np.allclose(line[:, 1], -2.0)
    assert np.ptp(line[:, 0]) > 9


def test_band_shows_median_and_quantiles():
    runs = np.random.default_rng(0).standard_normal((101, 7))
    ax = plotting.band(
        blank(), np.arange(7), runs, quantiles=(0.05, 0.95), index=2, label="runs"
    )
    # With 101 runs, the quantiles 0.05, 0.5 and 0.95 are the runs 5, 50 and 95.
    ordered = np.sort(runs, axis=0)
    assert np.allclose(ax.lines[0].get_ydata(), ordered[50])
    edges = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert edges.min() == pytest.approx(ordered[5].min())
    assert edges.max() == pytest.approx(ordered[95].max())
    assert ax.lines[0].get_label() == "runs"


def test_graph_draws_links_once():
    adjacency = np.array([[1, 1, 1], [1, 0, 0], [1, 0, 1]])
    ax = graph(blank(), adjacency, labels=["A", "B", "C"])
    # Each link once, and no link of an agent to itself
    ends = {tuple(map(tuple, line.get_xydata().round(6))) for line in ax.lines}
    discs = [tuple(p) for p in ax.collections[0].get_offsets().round(6).tolist()]
    assert ends == {(discs[0], discs[1]), (discs[0], discs[2])}
    assert discs[0] == (0.0, 1.0)
    assert np.allclose(np.hypot(*np.transpose(discs)), 1, atol=1e-5)
    placed = graph(blank(), PAIR, positions=[[0, 0], [2, 1]])
    assert placed.lines[0].get_xydata().tolist() == [[0, 0], [2, 1]]


def test_graph_fills_discs_and_writes_notes():
    ax = graph(blank(), PAIR, labels=["A", "B"], known=[0.0, 1.0], notes=["angle", ""])
    # White for 0, the palette's colour for 1, mixed linearly between
    empty, full = ax.collections[0].get_facecolors()
    assert empty.tolist() == [1, 1, 1, 1]
    assert np.allclose(full[:3], to_rgb(colour(5)))
    half = graph(blank(), PAIR, known=[0.5, 0.5]).collections[0].get_facecolors()[0]
    assert np.allclose(half[:3], 0.5 + 0.5 * np.array(to_rgb(colour(5))))
    assert [t.get_text() for t in ax.texts] == ["A", "angle", "B"]


# --- sliders ----------------------------------------------------------------------------------


def parse(html):
    """Return a function that finds elements, and the data of the slider's script."""
    page = BeautifulSoup(html, "html.parser")
    return page.find_all, json.loads(page.script.string)


def test_a_slider_holds_its_frames_and_nothing_else():
    use_style()
    assert tuple(matplotlib.rcParams["figure.figsize"]) == SIZE
    assert (
        matplotlib.rcParams["figure.dpi"] == matplotlib.rcParams["savefig.dpi"] == 110
    )
    assert matplotlib.rcParams["axes.prop_cycle"].by_key()["color"] == list(PALETTE)
    rates = [0.0, 0.5, 1.0, 2.0]
    result = slider(
        curve, rates, label="rate", unit="1/s", alt="A curve <falls>.", start=2
    )
    assert result.labels == ("rate 0 1/s", "rate 0.5 1/s", "rate 1 1/s", "rate 2 1/s")
    assert len(set(result.frames)) == 4
    assert not pyplot.get_fignums()
    # The page has one picture and one slider, and all frames as data.
    find, data = parse(result.html)
    (image,) = find("img")
    (knob,) = find("input")
    assert image["alt"] == "A curve <falls>. rate 1 1/s."
    # The page shows the frame `start`, at half of its pixels.
    first = base64.b64decode(image["src"].removeprefix("data:image/webp;base64,"))
    assert first == result.frames[2]
    assert first[8:12] == b"WEBP"
    first_frame = Image.open(io.BytesIO(first))
    assert first_frame.size == tuple(2 * n for n in result.size)
    assert [image["width"], image["height"]] == [str(n) for n in result.size]
    assert (knob["type"], knob["min"], knob["max"], knob["value"]) == (
        "range",
        "0",
        "3",
        "2",
    )
    assert knob["aria-label"] == "rate"
    assert len(find("button")) == 1
    assert [base64.b64decode(f) for f in data["frames"]] == list(result.frames)
    assert data["said"] == list(result.labels)
    assert data["milliseconds"] == 500
    # It needs no network: no address, and no script from a file.
    assert "http" not in result.html
    assert not any("src" in s.attrs for s in find("script"))
    assert len(result.html) < 100_000
    bundle = result._repr_mimebundle_()
    assert set(bundle) == {"text/plain", "text/html", "image/png"}
    # The picture for print is the frame that is shown first.
    still = Image.open(io.BytesIO(base64.b64decode(bundle["image/png"])))
    assert (np.asarray(still) == np.asarray(first_frame)).all()


def test_a_slider_is_reproducible_and_its_text_changes_with_a_frame():
    use_style()
    sliders = [
        slider(curve, [0.5, last], label="rate", alt="A curve.")
        for last in (1.0, 1.0, 1.01, 0.99)
    ]
    # Equal arguments give equal bytes; a changed curve another text.
    assert sliders[0].html == sliders[1].html
    assert len({repr(s) for s in sliders}) == 3
    assert (
        len({re.search('data-frames="([0-9a-f]{16})"', s.html)[1] for s in sliders})
        == 3
    )


def test_texts_of_a_slider_cannot_end_its_script():
    result = slider(curve, [1.0], label="rate", alt="</script><b>x</b>")
    # The parser would find the bold text if the script had ended.
    find, data = parse(result.html)
    assert data["alt"] == "</script><b>x</b>"
    assert not find("b")


def test_a_table_formats_numbers_and_marks_the_best_one():
    frame = pd.DataFrame(
        {"m": [0.523, np.nan, 0.404], "rule": ["a<b", "c", "d"]}, index=[*"xyz"]
    )
    result = ResultTable(frame, form={"m": ".2f"}, best={"m": "min"}, caption="Error")
    page = BeautifulSoup(result._repr_html_(), "html.parser")
    # NaN is no best value, and is shown.
    rows = [[c.text for c in row.find_all(["th", "td"])] for row in page.find_all("tr")]
    assert rows == [
        ["", "m", "rule"],
        ["x", "0.52", "a<b"],
        ["y", "nan", "c"],
        ["z", "0.40", "d"],
    ]
    assert [b.text for b in page.find_all("b")] == ["0.40"]
    assert page.caption.text == "Error"
    assert repr(result).split() == ["Error", *rows[0][1:], *rows[1], *rows[2], *rows[3]]
