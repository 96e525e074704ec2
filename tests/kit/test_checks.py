"""A table of checks shows the values found, fails in the tests, and says "changed" to a reader."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bookkit.checks import Checks

CASES = [
    # method, arguments that hold, arguments that do not
    ("equal", (1.0, 1.0 + 1e-7), (1.0, 1.0 + 1e-5), {"within": 1e-6}),
    ("equal", (np.eye(2), np.eye(2)), (np.eye(2), np.ones((2, 2))), {"within": 1e-6}),
    ("less", (1.0, 2.0), (2.0, 2.0), {}),
    ("greater", (2.0, 1.0), (1.0, 1.0), {}),
    ("between", (1.0, 1.0, 2.0), (2.1, 1.0, 2.0), {}),
    ("holds", (True,), (False,), {}),
]


@pytest.mark.parametrize(("method", "right", "wrong", "options"), CASES)
def test_a_row_that_fails_raises_in_the_tests_and_is_shown_to_a_reader(
    monkeypatch, method, right, wrong, options
):
    monkeypatch.setenv("BOOK_STRICT", "1")
    checks = Checks("caption")
    getattr(checks, method)("a statement", *right, **options)
    with pytest.raises(AssertionError, match="a statement"):
        getattr(checks, method)("a statement", *wrong, **options)
    assert list(checks.frame["holds"]) == ["yes"]
    monkeypatch.delenv("BOOK_STRICT")
    getattr(checks, method)("another", *wrong, **options)
    assert list(checks.frame["holds"]) == ["yes", "changed"]


@pytest.mark.parametrize("method", ["equal", "less", "greater", "between"])
def test_nan_holds_nowhere(monkeypatch, method):
    monkeypatch.delenv("BOOK_STRICT", raising=False)
    checks = Checks("caption")
    bounds = (0.0, 1.0) if method == "between" else (0.0,)
    options = {"within": 1.0} if method == "equal" else {}
    getattr(checks, method)("a statement", math.nan, *bounds, **options)
    assert list(checks.frame["holds"]) == ["changed"]


def test_texts_are_escaped_in_the_page():
    checks = Checks("a < b")
    checks.holds("1 < 2", True)
    page = checks._repr_html_()
    assert "<caption>a &lt; b</caption>" in page
    assert "1 &lt; 2" in page
