"""What a table shows, as a page and as text."""

from __future__ import annotations

import numpy as np
import pandas as pd
from bs4 import BeautifulSoup

from bookkit.tables import table


def test_a_table_marks_the_best_number_in_the_form_that_is_asked_for():
    frame = pd.DataFrame(
        {"error": [0.523, np.nan, 0.404], "gain": [1.0, 3.0, 2.0], "rule": ["a<b", "c", "d"]},
        index=["alone", "none", "fused"],
    )
    found = table(frame, form={"error": ".2f", "gain": "+.1f"}, caption="Error, m.",
                  best={"error": "min", "gain": "max"})  # fmt: skip
    page = BeautifulSoup(found._repr_html_(), "html.parser")
    rows = [[c.text for c in row.find_all(["th", "td"])] for row in page.find_all("tr")]
    assert rows == [["", "error", "gain", "rule"], ["alone", "0.52", "+1.0", "a<b"],
                    ["none", "nan", "+3.0", "c"], ["fused", "0.40", "+2.0", "d"]]  # fmt: skip
    assert [b.text for b in page.find_all("b")] == ["+3.0", "0.40"]
    assert page.caption.text == "Error, m."
    assert [line.split() for line in repr(found).splitlines()] == [["Error,", "m."], *(r for r in (
        rows[0][1:], *rows[1:]))]  # fmt: skip
