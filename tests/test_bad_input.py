"""Every public name meets bad input: a name without a case, or a case that passes, fails here.

The cases live beside the other tests of their module, in ``BAD_INPUT`` (qualified name to pairs of
the argument's name and a call that has to raise) and ``EXEMPT`` (qualified name to the reason).
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

import distfilt

Case = tuple[str, Callable[[], object]]


MODULES = [distfilt] + [
    importlib.import_module(info.name)
    for info in pkgutil.walk_packages(distfilt.__path__, "distfilt.")
]


def _home(module: ModuleType, name: str) -> str:
    """Where a name is defined; packages hand names on."""
    thing = getattr(module, name)
    home = getattr(thing, "__module__", None)
    if isinstance(home, str) and home.startswith("distfilt") and hasattr(thing, "__qualname__"):
        return f"{home}.{name}"
    # Constants do not know where they are from: the module below that has the same one in public.
    inside = f"{module.__name__}."
    others = [m for m in MODULES if m.__name__.startswith(inside) and name in m.__all__]
    found = next((m for m in others if getattr(m, name) is thing), module)
    return f"{found.__name__}.{name}"


def _qualified(key: str) -> str:
    """A case's key with the name's home, for a name that its module hands on; methods stay."""
    module, _, name = key.rpartition(".")
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError:
        return key
    return _home(found, name) if name in found.__all__ else key


def _test_modules() -> Iterator[ModuleType]:
    """The other test modules, by their names as packages: ``tests.network.test_channel``."""
    here = Path(__file__)
    for path in sorted(here.parent.rglob("test_*.py")):
        parts = path.relative_to(here.parents[1]).with_suffix("").parts
        folders = [here.parents[1].joinpath(*parts[:k]) for k in range(1, len(parts))]
        if path != here and all((folder / "__init__.py").is_file() for folder in folders):
            yield importlib.import_module(".".join(parts))


def _tables() -> tuple[dict[str, list[Case]], dict[str, str]]:
    cases: dict[str, list[Case]] = {}
    exempt: dict[str, str] = {}
    for module in _test_modules():
        for key, calls in getattr(module, "BAD_INPUT", {}).items():
            cases.setdefault(_qualified(key), []).extend(calls)
        for key, reason in getattr(module, "EXEMPT", {}).items():
            if key not in sys.modules:  # a face may hand on a module, which takes no input
                exempt[_qualified(key)] = reason
    return cases, exempt


CASES, EXEMPT = _tables()
PUBLIC = sorted(
    {
        _home(m, name)
        for m in MODULES
        for name in m.__all__
        if not isinstance(getattr(m, name), ModuleType)
    }
)
CALLS = [
    pytest.param(name, argument, call, id=f"{name}-{argument}-{k}")
    for name, cases in sorted(CASES.items())
    for k, (argument, call) in enumerate(cases)
]


@pytest.fixture(autouse=True)
def _no_figures_left() -> Iterator[None]:
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_has_a_case(name: str) -> None:
    covered = bool(CASES.get(name)) or bool(EXEMPT.get(name))
    assert covered, f"{name}: no bad-input case and no reason to be exempt"


@pytest.mark.parametrize("name", sorted({*CASES, *EXEMPT}))
def test_every_case_is_of_a_public_name(name: str) -> None:
    # A case of a method belongs to its public class.
    assert name in PUBLIC or name.rpartition(".")[0] in PUBLIC


@pytest.mark.parametrize(("name", "argument", "call"), CALLS)
def test_bad_input_names_its_argument(
    name: str, argument: str, call: Callable[[], object]
) -> None:
    with pytest.raises((ValueError, RuntimeError, LookupError, ImportError)) as caught:
        call()
    message = str(caught.value)
    assert argument in message, f"{name}: {message!r} does not name {argument!r}"
