"""The scripts behind stored studies: found from any folder, as the data are."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from ..folders import data_root

__all__ = ["script"]


def script(name: str | Path) -> ModuleType:
    """The module of a stored study, from ``book/studies`` beside the data, which no wheel carries.

    It has the study's ``trial``, ``parameters``, ``columns`` and ``seeds``.

    Parameters
    ----------
    name : str or Path
        The study's name, such as ``lorenz-63`` for ``lorenz_63.py``, or a script's path.

    Examples
    --------
    >>> script("no-such-study")
    Traceback (most recent call last):
    ValueError: name: needs a script of book/studies, got no-such-study
    """
    path = name if isinstance(name, Path) else _folder() / f"{name.replace('-', '_')}.py"
    spec = importlib.util.spec_from_file_location(f"stored_study_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise ValueError(f"name: needs a script of book/studies, got {name}")
    module = importlib.util.module_from_spec(spec)
    # inspect finds a class's source through sys.modules, and scripts share modules of their folder.
    sys.modules[spec.name] = module
    folder = str(path.parent.resolve())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    spec.loader.exec_module(module)
    _sent_by_value(folder)
    return module


def _sent_by_value(folder: str) -> None:
    """A worker cannot import the scripts by their names: their functions are sent themselves."""
    import cloudpickle

    for module in list(sys.modules.values()):
        if str(getattr(module, "__file__", None) or "").startswith(f"{folder}/"):
            cloudpickle.register_pickle_by_value(module)


def _folder() -> Path:
    return data_root().parent / "book" / "studies"
