"""The progress bar shows where a person watches, and nowhere else."""

from __future__ import annotations

import sys

import pytest

from distfilt.progress import track


def test_items_come_through_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    for show in (True, False):
        assert list(track(range(3), show=show)) == [0, 1, 2]
        assert list(track(iter("ab"), show=show, total=2)) == ["a", "b"]
    assert capsys.readouterr() == ("", "")


class _Screen:
    """A stream that says it is a terminal, and keeps what it is told."""

    encoding = "utf-8"

    def __init__(self) -> None:
        self.text = ""

    def write(self, text: str) -> None:
        self.text += text

    def flush(self) -> None: ...

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("quiet", ["", "TQDM_DISABLE", "CI", "PYTEST_CURRENT_TEST"])
def test_a_bar_is_drawn_on_a_terminal_only_and_can_be_silenced(
    quiet: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = _Screen()
    monkeypatch.setattr(sys, "stderr", screen)
    for name in ("TQDM_DISABLE", "CI", "PYTEST_CURRENT_TEST"):
        monkeypatch.delenv(name, raising=False)
    if quiet:
        monkeypatch.setenv(quiet, "1")
    assert list(track([1, 2, 3], show=False)) == [1, 2, 3] and not screen.text
    assert list(track(iter([1, 2, 3]), show=True, total=3)) == [1, 2, 3]
    assert ("3/3" in screen.text or "0/3" in screen.text) != bool(quiet)
