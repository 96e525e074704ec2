"""Scripts of stored studies are found from any folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from bookkit import studies


def test_script_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = studies.script("lorenz-63")
    assert found.NAME == "lorenz-63" and callable(found.trial)
    assert tuple(studies.stored("grange", "lorenz-63").columns) == tuple(found.columns)


_REFUSED = {
    "bookkit.studies.scripts.script": [("name", lambda: studies.script("no-such-study"))],
}
