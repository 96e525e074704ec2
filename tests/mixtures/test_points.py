"""Splits and square-root filters at points, against exact moments and the Kalman filter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.kalman import update as kalman_update
from distfilt.mixtures import (
    GaussianMixture,
    conditioned,
    moved,
    split,
    split_library,
    split_stretched,
    stretching,
)
from distfilt.mixtures.unscented import forecast, update

from .examples import random_mixture

P = random_mixture(4, 3, 1)
U = P.factors[[1, 3], :, 0]
EYE = np.eye(2)


def same(x: np.ndarray) -> np.ndarray:
    return x


BAD_INPUT = {
    "distfilt.mixtures.splitting.split_library": [
        ("std", lambda: split_library(std=1.0)),
        ("std", lambda: split_library(std=0.0)),
    ],
    "distfilt.mixtures.splitting.stretching": [
        ("factors", lambda: stretching(EYE, [EYE])),
        ("factors", lambda: stretching(np.ones((1, 3, 2)), np.ones((1, 2, 2)))),
        ("jacobians", lambda: stretching([EYE], [np.eye(3)])),
        ("scale", lambda: stretching([EYE], [EYE], scale=[1.0])),
    ],
    "distfilt.mixtures.splitting.split": [
        ("mixture", lambda: split(3, [0], U)),  # type: ignore[arg-type]
        ("which", lambda: split(P, [4, 1], U)),
        ("which", lambda: split(P, [1, 1], U)),
        ("which", lambda: split(P, [-1, 1], U)),
        ("directions", lambda: split(P, [1], U)),
        ("directions", lambda: split(P, [1, 3], 2 * U)),
        ("std", lambda: split(P, [1, 3], U, std=2.0)),
    ],
    "distfilt.mixtures.unscented.forecast": [
        ("means", lambda: forecast(3.0, EYE, same, EYE)),
        ("factors", lambda: forecast([0.0, 0.0], np.zeros((2, 2)), same, EYE)),
        ("factors", lambda: forecast([0.0, 0.0], np.eye(3), same, EYE)),
        ("noise_factor", lambda: forecast([0.0, 0.0], EYE, same, np.eye(3))),
        ("rule", lambda: forecast([0.0, 0.0], EYE, same, EYE, rule="cubature")),
        ("function", lambda: forecast([0.0, 0.0], EYE, 3, EYE)),
        ("function", lambda: forecast([0.0, 0.0], EYE, lambda x: np.nan * x, EYE)),
        ("factors", lambda: forecast([0.0, 0.0], 1e151 * EYE, same, EYE)),
    ],
    "distfilt.mixtures.unscented.update": [
        ("observed", lambda: update([0.0, 0.0], EYE, 1.0, same, EYE)),
        ("noise", lambda: update([0.0, 0.0], EYE, [1.0, 1.0], same, -EYE)),
        ("factors", lambda: update([0.0, 0.0], np.zeros((2, 2)), [0.0, 0.0], same, EYE)),
        ("rule", lambda: update([0.0, 0.0], EYE, [0.0, 0.0], same, EYE, rule="cubature")),
        ("function", lambda: update([0.0, 0.0], EYE, [0.0, 0.0], "same", EYE)),
        ("residual", lambda: update([0.0, 0.0], EYE, [0.0, 0.0], same, EYE, residual=3)),
        ("factors", lambda: update([0.0, 0.0], 1e300 * EYE, [0.0, 0.0], same, EYE)),
    ],
    "distfilt.mixtures.steps.split_stretched": [
        ("mixture", lambda: split_stretched(3, np.sin, most=3, stretch=1.0)),
        ("jacobian", lambda: split_stretched(P, 3, most=3, stretch=1.0)),
        ("most", lambda: split_stretched(P, np.sin, most=0, stretch=1.0)),
        ("stretch", lambda: split_stretched(P, np.sin, most=3, stretch=0.0)),
    ],
    "distfilt.mixtures.steps.moved": [
        ("mixture", lambda: moved(3, np.sin, np.eye(2))),
        ("noise_factor", lambda: moved(P, np.sin, np.eye(4))),
        ("function", lambda: moved(P, 3, np.eye(3))),
        ("rule", lambda: moved(P, np.sin, np.eye(3), rule="best")),
    ],
    "distfilt.mixtures.steps.conditioned": [
        ("mixture", lambda: conditioned(3, [1.0], np.sin, np.eye(1))),
        ("observed", lambda: conditioned(P, 1.0, np.sin, np.eye(2))),
        ("observed", lambda: conditioned(P, [1.0], lambda x: x[..., :1] * np.nan, np.eye(1))),
        ("noise", lambda: conditioned(P, [1.0, 2.0], np.sin, np.eye(4))),
        ("function", lambda: conditioned(P, [1.0], 3, np.eye(1))),
        ("residual", lambda: conditioned(P, [1.0], np.sin, np.eye(1), residual=3)),
        ("gate", lambda: conditioned(P, [1.0, 2.0, 3.0], np.sin, np.eye(3), gate=0.0)),
        ("gate", lambda: conditioned(P, [1.0, 2.0, 3.0], np.sin, np.eye(3), gate=1e300)),
    ],
}
EXEMPT = {"distfilt.mixtures.unscented.POINT_RULES": "a constant"}


@pytest.mark.parametrize("std", [0.5, 0.7, 0.9])
def test_the_library_keeps_moments_and_is_near_the_normal(std: float) -> None:
    w, m = split_library(std=std)
    assert np.isclose(w.sum(), 1) and (w > 0).all() and np.isclose(w @ m, 0)
    assert np.isclose(w @ m**2 + std**2, 1)
    x = np.linspace(-9, 9, 20001)

    def ise(a: float) -> float:
        at = np.sqrt((1 - std**2) / (2 * a))
        p = GaussianMixture([a, 1 - 2 * a, a], [[-at], [0.0], [at]], np.full((3, 1, 1), std**2))
        gap = np.exp(p.log_density(x[:, None])) - np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
        return float(np.trapezoid(gap**2, x))

    best = ise(w[0])
    assert all(best <= ise(w[0] * f) + 1e-12 for f in (0.9, 1.1))
    assert best < {0.5: 1.5e-2, 0.7: 2e-3, 0.9: 1e-4}[std]


def test_splits_keep_the_moments() -> None:
    after = split(P, [1, 3], U, std=0.6)
    assert after.size == 8
    for a, b in zip(after.moments(), P.moments(), strict=True):
        assert np.allclose(a, b, rtol=1e-12)
    assert np.allclose(after.weights[:2], P.weights[[0, 2]])
    assert np.isclose(after.weights[2:5].sum(), P.weights[1])
    assert np.linalg.eigvalsh(after.covs).min() > 0
    assert split(P, [], np.empty((0, 3))).size == 4


def test_stretching_is_the_largest_image() -> None:
    rng = np.random.default_rng(2)
    g = rng.standard_normal((4, 2, 3))
    scale = np.array([1.0, 3.0])
    u, length = stretching(P.factors, g, scale=scale)
    for k in range(4):
        assert np.isclose(u[k] @ np.linalg.solve(P.covs[k], u[k]), 1)
        assert np.isclose(np.linalg.norm(scale * (g[k] @ u[k])), length[k])
        z = rng.standard_normal((500, 3))
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        assert np.linalg.norm(scale * (z @ P.factors[k].T @ g[k].T), axis=1).max() <= length[k]


@given(st.integers(0, 100), st.integers(1, 4), st.sampled_from(["dd2", "unscented"]))
def test_linear_problems_are_the_kalman_filter(seed: int, d: int, rule: str) -> None:
    rng = np.random.default_rng(seed)
    p = random_mixture(3, d, seed)
    f, h = rng.standard_normal((d, d)), rng.standard_normal((2, d))
    q, r = random_mixture(1, d, seed + 1).factors[0], random_mixture(1, 2, seed + 2).covs[0]
    m, s = forecast(p.means, p.factors, lambda x: x @ f.T, q, rule=rule)
    assert np.allclose(m, p.means @ f.T)
    covs = s @ np.swapaxes(s, -1, -2)
    assert np.allclose(covs, f @ p.covs @ f.T + q @ q.T)
    y = rng.standard_normal(2)
    after, root, logs, distance = update(m, s, y, lambda x: x @ h.T, r, rule=rule)
    for k in range(3):
        wm, wp, wl = kalman_update(m[k], covs[k], y, H=h, R=r)
        assert np.allclose(after[k], wm, atol=1e-7)
        assert np.allclose(root[k] @ root[k].T, wp, atol=1e-7)
        assert np.isclose(logs[k], wl)
        inner = h @ covs[k] @ h.T + r
        assert np.isclose(distance[k], (y - h @ m[k]) @ np.linalg.solve(inner, y - h @ m[k]))


@pytest.mark.parametrize("rule", ["dd2", "unscented"])
def test_squares_have_exact_means(rule: str) -> None:
    p = random_mixture(1, 3, 5)
    m, s = forecast(p.means, p.factors, lambda x: x**2, np.zeros((3, 1)) + 1e-9, rule=rule)
    assert np.allclose(m, p.means**2 + np.diagonal(p.covs, axis1=-2, axis2=-1))
    assert np.allclose(np.triu(s[0], 1), 0) and (np.diag(s[0]) > 0).all()


def test_angles_that_wrap_between_points() -> None:
    def bearing(x: np.ndarray) -> np.ndarray:
        return np.arctan2(x[..., 1:2], x[..., 0:1])

    def wrap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a - b + np.pi) % (2 * np.pi) - np.pi

    at = np.array([-5.0, 0.01])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    wrapped = update(at, 0.3 * EYE, [-np.pi + 0.05], bearing, [[0.01]], residual=wrap)
    turned = update(turn @ at, 0.3 * EYE, [-np.pi / 2 + 0.05], bearing, [[0.01]], residual=wrap)
    assert np.allclose(turn @ wrapped[0], turned[0]) and np.isclose(wrapped[2], turned[2])
