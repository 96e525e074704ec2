"""Where the data lie: the papers' values, the scenarios and the stored studies."""

from __future__ import annotations

from pathlib import Path

__all__ = ["data_root", "inside"]

_REPOSITORY = Path(__file__).resolve().parents[3]


def data_root() -> Path:
    """The folder that holds ``published``, ``scenarios`` and ``studies``.

    It is ``data`` in the folder where the process runs or in the nearest one above it, so that a
    chapter reads the working copy that it belongs to; else that of this repository. The ``data``
    of another project, without ``published/items.csv``, is passed over.

    Examples
    --------
    >>> (data_root() / "published" / "items.csv").is_file()
    True
    """
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / "data" / "published" / "items.csv").is_file():
            return folder / "data"
    return _REPOSITORY / "data"


def inside(folder: Path, paper: str, name: str, suffix: str) -> Path:
    """The file ``FOLDER/PAPER/NAME.SUFFIX``; a name that is not one of those there is refused.

    >>> inside(data_root() / "scenarios", "grange", "../das/pendulum", ".toml")
    Traceback (most recent call last):
    ValueError: name must be one of table-2, table-3, got '../das/pendulum'
    """
    papers = ["", *sorted(p.name for p in folder.iterdir() if p.is_dir())]
    if paper not in papers:
        raise ValueError(f"paper must be one of {', '.join(papers[1:])}, got {paper!r}")
    there = sorted(p.stem for p in (folder / paper).glob(f"*{suffix}"))
    if name not in there:
        raise ValueError(
            f"name must be one of {', '.join(there) or 'none yet'}, got {name!r}"
        )
    return folder / paper / f"{name}{suffix}"
