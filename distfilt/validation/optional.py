"""Optional dependencies, imported when they are first used."""

from __future__ import annotations

import importlib
from types import ModuleType

__all__ = ["import_optional"]


def import_optional(module: str, extra: str) -> ModuleType:
    """Import an optional package, or name the extra that installs it.

    Raises
    ------
    ModuleNotFoundError
        If the package `module` is not installed. An error inside an installed one is passed on.

    Examples
    --------
    >>> import_optional("no_such_package", "maps")
    Traceback (most recent call last):
    ModuleNotFoundError: no_such_package is not installed; it comes with the extra maps: ...
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        # A dependency of the package may be missing rather than the package itself.
        if error.name != module.partition(".")[0]:
            raise
        raise ModuleNotFoundError(
            f"{module} is not installed; it comes with the extra {extra}: "
            f"pip install 'distfilt[{extra}]'",
            name=module,
        ) from None
