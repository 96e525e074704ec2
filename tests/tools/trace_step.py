"""Trace one step of a filter: how many calls into the library it takes, and in which modules.

    python tests/tools/trace_step.py [-v]      from the project's root; -v lists the functions

A step that a reader can follow calls few functions in few modules. Comprehensions and generator
expressions are not counted as calls. The steps before the traced one make plans and fill caches,
and the traced one is at a new time, as in a run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import distfilt
from distfilt.filters import EnsembleFilter
from distfilt.models import constant_velocity
from distfilt.network import graphs
from distfilt.sensors import distance

LIBRARY = Path(distfilt.__file__).parent
INTERVAL = 0.5


@dataclass(frozen=True)
class Call:
    """One call: its depth, and the module and the qualified name of the function."""

    depth: int
    module: str
    function: str


def trace_calls(action: Callable[[], Any]) -> list[Call]:
    """Run an action, and return its calls of the library's functions in order.

    Examples
    --------
    >>> from distfilt.sensors import wrap
    >>> [call.function for call in trace_calls(lambda: wrap(0.1))][-2:]
    ['wrap', 'wrap_angles']
    """
    calls: list[Call] = []
    depth = 0

    def profile(frame: Any, event: str, argument: Any) -> None:
        nonlocal depth
        code = frame.f_code
        # Comprehensions have frames of their own, whose names are in angle brackets.
        is_library = code.co_filename.startswith(f"{LIBRARY}/")
        if not is_library or code.co_name.startswith("<"):
            return
        if event == "call":
            depth += 1
            module = str(Path(code.co_filename).relative_to(LIBRARY))
            calls.append(Call(depth, module, code.co_qualname))
        elif event == "return":
            depth -= 1

    # The profiler sees every call of a Python function, by whatever name it was made.
    sys.setprofile(profile)
    try:
        action()
    finally:
        sys.setprofile(None)
    return calls


def trace_one_agent() -> list[Call]:
    """Trace a step of one agent's ensemble Kalman filter of 60 members."""
    f = EnsembleFilter(_model(), _sensors()[:1], members=60)
    return _trace_step(f)


def trace_ring() -> list[Call]:
    """Trace a step of four agents on a ring that share observations and fuse their ensembles."""
    f = EnsembleFilter.exact(_model(), _sensors(), graphs.ring(4), members=60)
    return _trace_step(f)


def count_modules(calls: list[Call]) -> int:
    """Return the number of modules of some calls."""
    return len({call.module for call in calls})


def _model() -> Any:
    return constant_velocity(sigma=0.1)


def _sensors() -> list[Any]:
    corners = ((0, 0), (9, 0), (0, 9), (9, 9))
    return [distance([0, 1], std=0.3, origin=corner) for corner in corners]


def _trace_step(f: Any) -> list[Call]:
    mean = np.array([4.0, 4.0, 0.0, 0.0])
    cov = np.diag([1.0, 1.0, 0.1, 0.1])
    observations = [np.array([5.0])] * f.n_agents
    state = f.start((mean, cov), rng=np.random.default_rng(0))
    # Two steps check the user's functions and fill the caches.
    for k in (1, 2):
        state = f.step(state, k * INTERVAL, observations)
    return trace_calls(lambda: f.step(state, 3 * INTERVAL, observations))


def print_report(title: str, calls: list[Call], verbose: bool) -> None:
    """Print the figures of a step, and with `verbose` its functions in order of first call."""
    functions = {(call.module, call.function) for call in calls}
    deepest = max(call.depth for call in calls)
    print(
        f"{title}: {len(calls)} calls, {len(functions)} functions, "
        f"{count_modules(calls)} modules, depth {deepest}"
    )
    if verbose:
        # Each function once, at the depth of its first call
        for call in dict.fromkeys(calls):
            print(f"{'  ' * call.depth}{call.module}: {call.function}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-v", "--verbose", action="store_true")
    is_verbose = parser.parse_args().verbose
    print_report("one agent", trace_one_agent(), is_verbose)
    print_report("ring of four", trace_ring(), is_verbose)
