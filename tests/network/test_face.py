"""What a reader imports from the room's face."""

from __future__ import annotations

import subprocess
import sys

import distfilt.network as network


def test_the_face_is_sorted_and_whole() -> None:
    assert sorted(network.__all__) == network.__all__
    assert len(set(network.__all__)) == len(network.__all__)
    for name in network.__all__:
        assert getattr(network, name) is not None


def test_importing_it_brings_no_heavy_package() -> None:
    heavy = ("networkx", "cvxpy", "xarray", "matplotlib", "pandas", "ot", "filterpy", "scipy.stats")
    code = f"import sys, distfilt.network; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
