"""Digests change with the data, of arrays and of figures, and not with rounding or style."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

matplotlib.use("Agg")

from matplotlib.figure import Figure

from bookkit.digests import digest, of_axes

CURVES = st.lists(
    st.floats(-1e6, 1e6).map(lambda v: round(v, 3)), min_size=1, max_size=60
)


# Derandomised: a number lies within 1e-9 of a tie with a probability of 1e-5.
@settings(derandomize=True)
@given(CURVES, st.integers(0, 2**32 - 1))
def test_digest_survives_rounding(values, seed):
    curve = np.array(values)
    # Relative errors of 1e-9 are more than another processor makes.
    noise = np.random.default_rng(seed).uniform(-1, 1, curve.size)
    assert digest(curve=curve * (1 + 1e-9 * noise)) == digest(curve=curve)
    # Errors of the last bit of the largest entry, as other processors make
    assert digest(curve=curve + 1e-16 * np.abs(curve).max() * noise) == digest(
        curve=curve
    )


@pytest.mark.parametrize(
    "value", [1.0, 10.0, 1e-3, 0.12345, 12.345, 1.0005, 9.9995, -2.5e7, 1e-9]
)
def test_digest_is_steady_at_round_numbers(value):
    # A tie of the rounding at a round number would make the digits unstable.
    curve = np.array([value, 0.3 * value, -0.7 * value, 1.0])
    # Errors of both signs round to the same text, so no tie lies there.
    texts = {digest(c=curve * (1 + e)) for e in (0.0, 1e-9, -1e-9, 1e-13, -1e-13)}
    assert len(texts) == 1


def test_digest_sees_order_sign_and_size():
    t = np.linspace(0, 6, 200)
    curve = np.sin(t)
    for other in (
        # Each change keeps some numbers of the digest; the order keeps range and mean.
        curve[::-1],
        -curve,
        1.001 * curve,
        curve + 0.001,
        np.sin(t + 0.01),
        curve[:-1],
    ):
        assert digest(c=curve) != digest(c=other)
    swapped = curve.copy()
    bumped = curve.copy()
    # The swap keeps range and mean, and the alternating signs of the projection.
    swapped[[40, 60]] = swapped[[60, 40]]
    bumped[100] += 0.02
    assert len({digest(c=curve), digest(c=swapped), digest(c=bumped)}) == 3


def test_digest_text():
    # Numbers that are 0 up to rounding print as 0, without a sign.
    assert digest(a=[], b=np.zeros(3)) == (
        "a: 0 values\nb: 3 values, 0..0, mean 0, projection 0"
    )
    assert digest(a=[np.nan, np.nan]) == "a: 2 values, 2 NaN"
    text = digest(a=[1.0, np.nan, np.inf, 2.0])
    assert text.endswith("1 NaN, 1 infinite")
    assert text.startswith("a: 4 values, 1..2, mean 1.5,")
    assert digest(a=[np.nan, 1.0, np.inf, 2.0]) != text
    # The mean of a full period is 0 up to rounding.
    assert "mean 0," in digest(a=np.sin(np.linspace(0, 2 * np.pi, 101)[:-1]))
    assert digest(a=np.array([123456, 234567])).startswith(
        "a: 2 values, 1.235e+05..2.346e+05"
    )


def test_digest_is_the_documented_projection():
    values = np.array([3.0, -1.0, 4.0, 1.5])
    k = np.arange(4)
    # The formula of the docstring, written once more
    weights = np.array([1, -1, 1, -1]) * (1 + (k * (np.sqrt(5) - 1) / 2) % 1)
    expected = weights @ values / np.linalg.norm(weights)
    printed = float(digest(a=values).rsplit(" ", 1)[1])
    assert printed == pytest.approx(expected, rel=6e-4)


# --- figures ----------------------------------------------------------------------------------

T = np.linspace(0.0, 6.0, 50)
GRID = np.add.outer(np.sin(T[:8]), np.cos(T[:9]))


def picture(change: str = "") -> Figure:
    """Draw two panels with every kind of artist, one of them changed."""
    figure = Figure(figsize=(6, 3))
    first, second = figure.subplots(1, 2)
    # One artist at a time is larger by one percent.
    scale = {name: 1.01 if name == change else 1.0 for name in CHANGED}
    if change == "swapped panels":
        first, second = second, first
    first.plot(T, 1000 * np.cos(T))
    first.plot(T, scale["small curve"] * np.sin(T))
    first.plot(scale["times"] * T, np.sin(2 * T), visible=change != "hidden curve")
    first.bar([1, 2, 3], [2.0, scale["bar"] * 5.0, 4.0])
    first.fill_between(T, np.sin(T), scale["band"] * (2 + np.cos(T)))
    first.add_patch(
        matplotlib.patches.Ellipse((0, 0), scale["ellipse"] * 3.0, 1.0, angle=30)
    )
    first.inset_axes([0.6, 0.6, 0.3, 0.3]).plot(T, scale["inset"] * T**2)
    if change != "missing points":
        second.scatter(T, scale["points"] * T**2, c=scale["colours"] * np.cos(T))
    second.scatter([scale["one point"] * 3.0], [4.0])
    second.quiver(T[:5], T[:5], scale["arrows"] * T[:5], -T[:5])
    second.contour(scale["levels"] * GRID, levels=[-0.5, 0.5, 1.0])
    second.pcolormesh(scale["mesh"] * GRID)
    second.imshow(scale["image"] * GRID, extent=(0, scale["extent"] * 2.0, 0, 1))
    second.errorbar(T[:4], T[:4], scale["bars of error"] * 0.1 * np.ones(4))
    second.vlines([1.0, scale["rules"] * 2.0], 0, 1)
    return figure


CHANGED = [
    "small curve",
    "times",
    "bar",
    "band",
    "ellipse",
    "inset",
    "points",
    "colours",
    "one point",
    "arrows",
    "levels",
    "mesh",
    "image",
    "extent",
    "bars of error",
    "rules",
]


def test_one_changed_artist_changes_the_text():
    # Every changed artist must give a text of its own.
    changes = ["", *CHANGED, "swapped panels", "hidden curve", "missing points"]
    texts = [of_axes(picture(change)) for change in changes]
    assert len(set(texts)) == len(changes)
    assert texts[0] == of_axes(picture())


def test_drawing_and_style_do_not_change_the_text(tmp_path):
    figure = picture()
    before = of_axes(figure)
    # Drawing computes layouts; the data stay the same.
    figure.savefig(tmp_path / "a.png", dpi=40)
    assert of_axes(figure) == before
    for axes in figure.axes:
        for line in axes.lines:
            line.set(color="red", linewidth=3)
    assert of_axes(figure) == before


def test_text_of_each_kind():
    axes = Figure().subplots()
    axes.plot([0.0, 1.0], [2.0, np.nan])
    axes.plot([0.0, 1.0], [5.0, 7.0])
    axes.bar([1.0, 3.0], [2.0, 4.0], width=1.0)
    axes.imshow(np.ma.masked_greater([[1.0, 2.0], [3.0, 4.0]], 3.5))
    lines = of_axes(axes).splitlines()
    assert lines[0] == "axes 1: 2 lines, 2 patches, 1 image"
    assert lines[1].startswith("line 1 x: 2 values, 0..1, mean 0.5,")
    assert lines[2].startswith("line 1 y: 2 values, 2..2,")
    assert lines[2].endswith("1 NaN")
    # The x of line 2 repeats that of line 1, and is left out.
    assert lines[3].startswith("line 2 y: 2 values, 5..7,")
    assert lines[4].startswith("patch 1-2 x: 10 values, 0.5..3.5,")
    assert lines[5].startswith("patch 1-2 y: 10 values, 0..4,")
    assert lines[6].startswith("image 1 value: 4 values, 1..3,")
    assert "1 NaN" in lines[6]
    assert lines[7].startswith("image 1 extent: 4 values, -0.5..1.5,")
    assert len(lines) == 8


def test_an_empty_figure_says_so():
    assert of_axes(Figure()) == of_axes(Figure().subplots(2)) == "an empty figure"
