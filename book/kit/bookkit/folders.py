"""Folders of data: the papers' values, the scenarios and the stored studies."""

from __future__ import annotations

from pathlib import Path

__all__ = ["data_root", "inside"]

_REPOSITORY = Path(__file__).resolve().parents[3]


def data_root() -> Path:
    """Return the folder that holds ``published``, ``scenarios`` and ``studies``.

    It is the first ``data`` folder with ``published/items.csv`` in the current folder or above it,
    so that a chapter reads the working copy that it belongs to. Without one, it is that of this
    repository.

    Examples
    --------
    >>> (data_root() / "published" / "items.csv").is_file()
    True
    """
    current = Path.cwd()
    for folder in (current, *current.parents):
        if (folder / "data" / "published" / "items.csv").is_file():
            return folder / "data"
    return _REPOSITORY / "data"


def inside(folder: Path, paper: str, name: str, suffix: str) -> Path:
    """Return the path ``FOLDER/PAPER/NAME.SUFFIX``, which must exist.

    >>> inside(data_root() / "scenarios", "grange", "../das/pendulum", ".toml")
    Traceback (most recent call last):
    ValueError: name must be one of table-2, table-3, got '../das/pendulum'
    """
    # Only existing names pass, so that no name leads out of the folder.
    papers = ["", *sorted(p.name for p in folder.iterdir() if p.is_dir())]
    if paper not in papers:
        raise ValueError(f"paper must be one of {', '.join(papers[1:])}, got {paper!r}")
    names = sorted(p.stem for p in (folder / paper).glob(f"*{suffix}"))
    if name not in names:
        raise ValueError(
            f"name must be one of {', '.join(names) or 'none yet'}, got {name!r}"
        )
    return folder / paper / f"{name}{suffix}"
