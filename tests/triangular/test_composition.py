"""The composed map: the ensemble Kalman filter in disguise."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from distfilt.triangular import compose
from distfilt.triangular.affine import fit
from tests.triangular.samples import rng_of, samples

_X = np.random.default_rng(9).standard_normal((20, 2))
_Y = np.random.default_rng(8).standard_normal((20, 1))
_MAP = fit(_Y, _X)
BAD_INPUT = {
    "distfilt.triangular.composition.compose": [
        ("map_", lambda: compose(3, _Y, _X, [0.1])),
        ("map_", lambda: compose(np.add, _Y, _X, [0.1])),
        ("x", lambda: compose(_MAP, _Y, [1.0], [0.1])),
        ("y", lambda: compose(_MAP, _Y[:5], _X, [0.1])),
        ("observed", lambda: compose(_MAP, _Y, _X, [0.1, 0.2])),
    ],
}
EXEMPT = {"distfilt.triangular.composition.ConditionalMap": "a protocol: it has no code"}


def _enkf(y: np.ndarray, x: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """The textbook formula x + Σxy Σyy^-1 (y* - y), one ensemble."""
    joint = np.cov(np.hstack([x, y]), rowvar=False)
    d = x.shape[1]
    gain = joint[:d, d:] @ np.linalg.inv(joint[d:, d:])
    return x + (observed - y) @ gain.T


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 5))
def test_composed_affine_map_is_the_enkf(seed: int, m: int, d: int) -> None:
    y, x = samples(seed, 60, m, d)
    observed = rng_of(seed + 1).standard_normal(m)
    ours, theirs = compose(fit(y, x), y, x, observed), _enkf(y, x, observed)
    assert np.abs(ours - theirs).max() < 1e-12 * max(1, np.abs(theirs).max(), _condition(y))


def _condition(y: np.ndarray) -> float:
    return float(np.linalg.cond(np.cov(y, rowvar=False).reshape(y.shape[1], -1)))


def test_composed_affine_map_is_the_enkf_on_standardised_data() -> None:
    rng = rng_of(2)
    x = rng.standard_normal((200, 6))
    y = x[:, :4] + 0.5 * rng.standard_normal((200, 4))
    observed = rng.standard_normal(4)
    assert np.abs(compose(fit(y, x), y, x, observed) - _enkf(y, x, observed)).max() < 1e-12


def test_order_of_variables_does_not_matter_to_the_composed_map() -> None:
    y, x = samples(5, m=3, d=4)
    observed = np.zeros(3)
    whole = compose(fit(y, x), y, x, observed)
    swapped = compose(fit(y[:, ::-1], x[:, ::-1]), y[:, ::-1], x[:, ::-1], observed)
    assert np.allclose(swapped[:, ::-1], whole, atol=1e-9)


def test_members_just_enough() -> None:
    """One member more than variables is enough for a map, but not for a good one."""
    y, x = samples(8, n=6, m=2, d=3)
    assert np.isfinite(compose(fit(y, x), y, x, np.zeros(2))).all()
