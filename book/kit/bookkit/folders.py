"""Where the data lie: the papers' values, the scenarios and the stored studies."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["data_root"]

_PACKAGE = Path(__file__).resolve().parent
_VARIABLE = "DISTFILT_DATA"


def _complete(folder: Path) -> bool:
    """Whether a folder is the data of this book: two known files tell it from another `data`."""
    known = ("published/items.csv", "scenarios/accepted.csv")
    return all((folder / name).is_file() for name in known)


def data_root() -> Path:
    """The folder that holds ``published``, ``scenarios`` and ``studies``.

    The first of these that exists:

    1. the folder that the environment variable ``DISTFILT_DATA`` names, and no other if it is set;
    2. ``data`` in the folder where the process runs, or in the nearest folder above it, so that a
       chapter reads the working copy that it belongs to;
    3. ``data`` of the repository that holds this package.

    A folder counts only if it holds ``published/items.csv`` and ``scenarios/accepted.csv``: the
    ``data`` of another project is passed over.

    Raises
    ------
    FileNotFoundError
        If ``DISTFILT_DATA`` names a folder without these files, or there is no such folder.

    Examples
    --------
    >>> (data_root() / "published" / "items.csv").is_file()
    True
    """
    named = os.environ.get(_VARIABLE, "")
    if named:
        folder = Path(named).expanduser().resolve()
        if not _complete(folder):
            raise FileNotFoundError(
                f"{_VARIABLE}: needs a folder with published/items.csv and "
                f"scenarios/accepted.csv, got {named!r}"
            )
        return folder
    try:
        here = Path.cwd()
        above = [folder / "data" for folder in (here, *here.parents)]
    except FileNotFoundError:  # the folder was deleted under the process
        above = []
    for folder in (*above, _PACKAGE.parents[2] / "data"):
        if _complete(folder):
            return folder
    raise FileNotFoundError("no folder data with published and scenarios was found here or above")
