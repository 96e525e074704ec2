"""A progress bar for long work, silent where nobody watches."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

from .checks import count, instance

__all__ = ["track"]

_SILENT = ("TQDM_DISABLE", "CI", "PYTEST_CURRENT_TEST")


def track(items: Iterable[Any], *, show: bool, total: int | None = None) -> Iterable[Any]:
    """The items, behind a progress bar if `show` and a person may be watching.

    Parameters
    ----------
    items : iterable
        What to go through.
    show : bool
        Ask for the bar. It is left out all the same in a pipe, in a test, and where one of the
        environment variables TQDM_DISABLE and CI is set.
    total : int, optional
        How many items there are, where `items` does not know its length.

    Examples
    --------
    >>> list(track([1, 2, 3], show=False))
    [1, 2, 3]
    """
    if not isinstance(items, Iterable):
        raise ValueError(f"items: needs something to iterate over, got {type(items).__name__}")
    if total is not None:
        count(total, "total", at_least=0)
    if not instance(show, "show", bool) or any(os.environ.get(name) for name in _SILENT):
        return items
    from tqdm.auto import tqdm

    shown: Iterable[Any] = tqdm(items, total=total, leave=False, disable=None)
    return shown
