"""Filters of many agents: one step is that of the form that the model allows, filter by filter."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.density import (
    FokkerPlanck,
    Grid,
    LowRank,
    Separate,
    Shared,
    filters_start,
    filters_step,
    low_rank_step,
    shared_moved,
    shared_start,
    shared_step,
    zero_mean_prior,
)
from distfilt.models import rotating_swarm

GRID = Grid((8, 8))
MOVE = FokkerPlanck(rotating_swarm(), GRID).solver(0.0, 0.1)
BASIS = zero_mean_prior(GRID, rank=12)
RNG = np.random.default_rng(1)
BASE, SEEN, NOISE = (RNG.random((3, 64)) + 0.5 for _ in range(3))
NOISE[2] = np.inf


def _proportional(forecast: np.ndarray) -> np.ndarray:
    return 0.1 * NOISE * np.maximum(forecast, 0.1)


def test_an_exact_model_has_one_basis_and_its_step() -> None:
    start = filters_start(BASIS, BASE, exact=True)
    after = filters_step(start, MOVE, SEEN, _proportional, 0.1)
    moved = shared_moved(shared_start(BASIS, BASE), MOVE)
    wanted = shared_step(moved, SEEN, _proportional(moved.estimates), 0.1)
    assert isinstance(after, Shared)
    assert np.array_equal(after.information, wanted.information)
    assert np.array_equal(after.estimates, wanted.estimates)


@pytest.mark.parametrize("process", [None, 0.7 * BASIS])
def test_an_inexact_model_has_a_factor_for_each_filter(process: np.ndarray | None) -> None:
    start = filters_start(BASIS, BASE, exact=False)
    after = filters_step(start, MOVE, SEEN, _proportional, 0.1, process=process)
    r = _proportional(MOVE(BASE))
    assert isinstance(after, Separate) and after.estimates.shape == after.variances.shape == (3, 64)
    for i in range(3):
        one = low_rank_step(LowRank(BASE[i], BASIS), MOVE, SEEN[i], r[i], 0.1, process=process)
        assert np.array_equal(after.estimates[i], one.mean)
        assert np.allclose(after.variances[i], np.diag(one.factor @ one.factor.T), rtol=1e-12)
    assert np.array_equal(after.estimates[2], MOVE(BASE[2]))


def test_both_forms_agree_where_the_model_is_exact() -> None:
    forms = [filters_start(BASIS, BASE, exact=exact) for exact in (True, False)]
    for _ in range(4):
        forms = [filters_step(f, MOVE, SEEN, _proportional, 0.1) for f in forms]
    shared, separate = forms
    assert np.abs(shared.estimates - separate.estimates).max() < 1e-12
    assert np.abs(shared.variances - separate.variances).max() < 1e-12


def test_a_start_does_not_hold_what_its_caller_may_change() -> None:
    for exact in (True, False):
        basis, base = BASIS.copy(), BASE.copy()
        start = filters_start(basis, base, exact=exact)
        basis[:], base[:] = 0, 0
        assert np.array_equal(start.estimates, BASE)
        assert np.allclose(start.variances, (BASIS**2).sum(axis=1))


_EXACT, _OTHER = (filters_start(BASIS, BASE, exact=exact) for exact in (True, False))
BAD_INPUT = {
    "distfilt.density.forms.Separate": [
        ("filters", lambda: Separate(())),
        ("filters", lambda: Separate(3.5)),
        ("filters", lambda: Separate((3,))),
        ("filters", lambda: Separate(tuple(LowRank(np.ones(n), np.eye(n)) for n in (2, 3)))),
    ],
    "distfilt.density.forms.filters_start": [
        ("basis", lambda: filters_start(BASIS[0], BASE, exact=False)),
        ("base", lambda: filters_start(BASIS, BASE[:, :5], exact=False)),
        ("base", lambda: filters_start(BASIS, BASE[0], exact=True)),
        ("exact", lambda: filters_start(BASIS, BASE, exact=None)),
    ],
    "distfilt.density.forms.filters_step": [
        ("filters", lambda: filters_step(3, MOVE, SEEN, _proportional, 0.1)),
        ("move", lambda: filters_step(_EXACT, 3, SEEN, _proportional, 0.1)),
        ("move", lambda: filters_step(_OTHER, 3, SEEN, _proportional, 0.1)),
        ("observed", lambda: filters_step(_EXACT, MOVE, SEEN[:2], _proportional, 0.1)),
        ("observed", lambda: filters_step(_OTHER, MOVE, SEEN[:2], _proportional, 0.1)),
        ("noise", lambda: filters_step(_EXACT, MOVE, SEEN, NOISE, 0.1)),
        ("noise", lambda: filters_step(_OTHER, MOVE, SEEN, lambda p: NOISE[:2], 0.1)),
        ("noise", lambda: filters_step(_OTHER, MOVE, SEEN, lambda p: 0 * p, 0.1)),
        ("dt", lambda: filters_step(_OTHER, MOVE, SEEN, _proportional, 0.0)),
        ("process", lambda: filters_step(_EXACT, MOVE, SEEN, _proportional, 0.1, process=BASIS)),
        ("process", lambda: filters_step(_OTHER, MOVE, SEEN, _proportional, 0.1,
                                         process=BASIS[:5])),
    ],
}
