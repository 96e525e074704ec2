"""Affine triangular maps: the exact minimiser, the exact conditional, and an EnKF in disguise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.checks import SolverError
from distfilt.ensembles import sample_covariance
from distfilt.kalman.ensemble import enkf
from distfilt.triangular import AffineMap, affine, conditioning
from distfilt.triangular.affine import fit, fit_convex, gradient, objective
from distfilt.triangular.conditioning import (
    affine_update,
    compose,
    pca_update,
    principal_directions,
    sample_update,
)
from distfilt.triangular.regularised import informed_update, known_noise_update

NAN = float("nan")


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _samples(
    seed: int, n: int = 60, m: int = 2, d: int = 3, leading: tuple[int, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Correlated, shifted, badly scaled samples (y, x)."""
    rng = _rng(seed)
    mixing = rng.standard_normal((m + d, m + d)) * np.logspace(-1, 1, m + d)
    z = rng.standard_normal((*leading, n, m + d)) @ mixing + 10 * rng.standard_normal(m + d)
    return z[..., :m], z[..., m:]


def _enkf(y: np.ndarray, x: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """The textbook formula x + Σxy Σyy^-1 (y* - y), one ensemble."""
    joint = np.cov(np.hstack([x, y]), rowvar=False)
    d = x.shape[1]
    gain = joint[:d, d:] @ np.linalg.inv(joint[d:, d:])
    return x + (observed - y) @ gain.T


_X = np.random.default_rng(9).standard_normal((20, 2))
_Y = np.random.default_rng(8).standard_normal((20, 1))
_MAP = fit(_Y, _X)
_ONE = [[0.04]]
_A = "distfilt.triangular.affine."
_T = "distfilt.triangular.conditioning."
_R = "distfilt.triangular.regularised."


def _update(update: object = affine_update, **change: object) -> object:
    inputs = {"ensemble": _X, "predicted": _Y, "observed": [0.1], "noise": _ONE, "rng": _rng()}
    inputs.update(change)
    positional = [inputs.pop(k) for k in ("ensemble", "predicted", "observed", "noise")]
    return update(*positional, **inputs)


def _pca(**change: object) -> object:
    options = {"n_state": 1, "n_observed": 1}
    options.update(change)
    return _update(pca_update, **options)


def _update_cases(update: object) -> list[tuple[str, object]]:
    return [
        ("ensemble", lambda: _update(update, ensemble=[1.0])),
        ("predicted", lambda: _update(update, predicted=_Y[:4])),
        ("predicted", lambda: _update(update, predicted=NAN * _Y)),
        ("observed", lambda: _update(update, observed=[NAN])),
        ("observed", lambda: _update(update, observed=[0.1, 0.2])),
        ("noise", lambda: _update(update, noise=[[-1.0]])),
        ("noise", lambda: _update(update, noise=np.eye(2))),
        ("rng", lambda: _update(update, rng=1)),
    ]


BAD_INPUT = {
    _A + "AffineMap": [
        ("gain", lambda: AffineMap(np.zeros(1), np.zeros(2), np.zeros((1, 2)), np.eye(2))),
        ("scale", lambda: AffineMap(np.zeros(1), np.zeros(1), np.zeros((1, 1)), -np.eye(1))),
        ("scale", lambda: AffineMap(
            np.zeros(1), np.zeros(2), np.zeros((2, 1)), np.ones((2, 2)))),
        ("x", lambda: _MAP(_Y, _X[:, :1])),
        ("y", lambda: _MAP(_X, _X)),
        ("z", lambda: _MAP.inverse([0.1], [[NAN, 0.0]])),
        ("y", lambda: _MAP.log_det(_X, _X)),
    ],
    _A + "fit": [
        ("x", lambda: fit(_Y[:3], _X[:3])),
        ("x", lambda: fit(_Y, np.ones((20, 2)))),
        ("x", lambda: fit(_Y, _X[:, [0, 0]])),
        ("x", lambda: fit(_X[:, :1], _X)),
        ("x", lambda: fit(_Y, _X @ [[1.0, 1.0, 0.3], [0.0, 1.0, 0.7]])),
        ("x", lambda: fit(_Y, np.column_stack([_X, np.full(20, 0.1)]))),
        ("y", lambda: fit(_Y @ [[1.0, 0.3]], _X)),
        ("y", lambda: fit(np.zeros((20, 1)), _X)),
        ("y", lambda: fit(_Y[:10], _X)),
        ("x", lambda: fit(_Y, NAN * _X)),
    ],
    _A + "from_moments": [
        ("mean", lambda: affine.from_moments(0.0, np.eye(2), 1)),
        ("cov", lambda: affine.from_moments([0.0, 1.0], np.eye(3), 1)),
        ("m", lambda: affine.from_moments([0.0, 1.0], np.eye(2), 3)),
        ("y", lambda: affine.from_moments([0.0, 1.0], np.diag([0.0, 1.0]), 1)),
        ("x", lambda: affine.from_moments([0.0, 1.0], np.ones((2, 2)), 1)),
    ],
    _A + "from_rows": [
        ("rows", lambda: affine.from_rows([[0.0, 1.0]], [0.0])),
        ("rows", lambda: affine.from_rows([[0.0, 1.0, 0.0]], [0.0])),
        ("rows", lambda: affine.from_rows([[0, 1, 1], [0, 0, 1]], [])),
        ("observed_mean", lambda: affine.from_rows([[0.0, 1.0, 1.0]], [NAN])),
    ],
    _A + "fit_convex": [
        ("solver", lambda: fit_convex(_Y, _X, solver="SIMPLEX")),
        ("ECOS", lambda: fit_convex(_Y, _X, max_iters=1)),
        ("CLARABEL", lambda: fit_convex(_Y, _X, solver="CLARABEL", max_iters=1)),
        ("max_iters", lambda: fit_convex(_Y, _X, max_iters=0)),
        ("x", lambda: fit_convex(_Y[None], _X[None])),
        ("x", lambda: fit_convex(_Y[:3], _X[:3])),
    ],
    _A + "gradient": [
        ("samples", lambda: gradient([0.0, 1.0], [1.0])),
        ("coefficients", lambda: gradient([1.0], [[1.0]])),
        ("coefficients", lambda: gradient([0.0, 0.0], [[1.0]])),
    ],
    _A + "objective": [("x", lambda: objective(_MAP, _Y, _X[:, :1]))],
    _T + "affine_update": _update_cases(affine_update),
    _T + "sample_update": [
        *_update_cases(sample_update),
        ("x", lambda: _update(sample_update, ensemble=_X[:3], predicted=_Y[:3])),
        ("x", lambda: _update(sample_update, ensemble=_X[:, [0, 0]])),
    ],
    _R + "known_noise_update": [
        *_update_cases(known_noise_update),
        ("ensemble", lambda: _update(known_noise_update, ensemble=_X[:1], predicted=_Y[:1])),
        ("noise", lambda: _update(known_noise_update, noise=np.eye(1)[None])),
        ("shrinkage", lambda: _update(known_noise_update, shrinkage=1.1)),
        ("ridge", lambda: _update(known_noise_update, ridge=-0.1)),
    ],
    _R + "informed_update": [
        *_update_cases(informed_update),
        ("ensemble", lambda: _update(informed_update, ensemble=_X[:1], predicted=_Y[:1])),
        ("threshold", lambda: _update(informed_update, threshold=NAN)),
    ],
    _T + "compose": [
        ("x", lambda: compose(_MAP, _Y, [1.0], [0.1])),
        ("y", lambda: compose(_MAP, _Y[:5], _X, [0.1])),
        ("observed", lambda: compose(_MAP, _Y, _X, [0.1, 0.2])),
    ],
    _T + "pca_update": [
        ("n_state", lambda: _pca(n_state=3)),
        ("n_state", lambda: _pca(n_state=0)),
        ("n_observed", lambda: _pca(n_observed=0)),
        ("complement", lambda: _pca(complement="forget")),
        ("noise", lambda: _pca(noise=[[0.0]])),
    ],
    _T + "principal_directions": [
        ("n", lambda: principal_directions(_X, 3)),
        ("ensemble", lambda: principal_directions([[1.0, 2.0]], 1)),
    ],
}
EXEMPT = {_T + "ConditionalMap": "a protocol: it has no code"}


@given(st.integers(0, 10_000), st.integers(0, 4), st.integers(1, 5))
def test_map_whitens_and_inverts(seed: int, m: int, d: int) -> None:
    y, x = _samples(seed, 60, m, d)
    s = fit(y, x)
    z = s(y, x)
    assert np.allclose(z.mean(axis=0), 0, atol=1e-7)
    assert np.allclose(z.T @ z / len(z), np.eye(d), atol=1e-6)
    assert np.allclose(s.inverse(y, z), x, rtol=1e-9, atol=1e-9)


def test_map_is_batched() -> None:
    y, x = _samples(3, leading=(2, 4))
    whole, one = fit(y, x), fit(y[1, 2], x[1, 2])
    assert np.allclose(whole(y, x)[1, 2], one(y[1, 2], x[1, 2]), atol=1e-12)
    assert np.allclose(whole.log_det(y, x)[1, 2], one.log_det(y[1, 2], x[1, 2]))


@given(st.integers(0, 10_000))
def test_log_det_is_the_derivative_s(seed: int) -> None:
    """Finite differences of the map: it is affine, so they are exact up to rounding."""
    y, x = _samples(seed)
    s = fit(y, x)
    moved = x[0] + np.eye(3)
    base = s(y[:1], x[:1])
    columns = s(np.repeat(y[:1], 3, axis=0), moved) - base
    assert np.isclose(np.linalg.slogdet(columns)[1], s.log_det(y, x)[0], rtol=1e-9, atol=1e-9)
    assert np.allclose(np.tril(columns.T), columns.T, atol=1e-9)


@given(st.integers(0, 10_000))
def test_closed_form_is_the_minimiser(seed: int) -> None:
    """The gradient of (12) vanishes at the fit, component by component."""
    y, x = _samples(seed, m=1, d=2)
    z = (lambda v: (v - v.mean(axis=0)) / v.std(axis=0))(np.hstack([y, x]))
    s = fit(z[:, :1], z[:, 1:])
    rows = np.linalg.solve(s.scale, np.hstack([-s.gain, np.eye(2)]))
    offsets = np.linalg.solve(s.scale, s.gain @ s.observed_mean - s.mean)
    for k in range(2):
        u = np.concatenate([[offsets[k]], rows[k, : k + 2]])
        assert np.abs(gradient(u, z[:, : k + 2])).max() < 1e-8


def test_gradient_agrees_with_finite_differences() -> None:
    z = _samples(4)[1]
    u = np.array([0.3, -0.2, 0.5, 0.8])

    def loss(c: np.ndarray) -> float:
        values = c[0] + z @ c[1:]
        return float((0.5 * values**2).mean() - np.log(c[-1]))

    steps = 1e-6 * np.eye(4)
    numeric = [(loss(u + h) - loss(u - h)) / 2e-6 for h in steps]
    assert np.abs(numeric - gradient(u, z)).max() < 1e-6 * np.abs(numeric).max()


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 5))
def test_composed_affine_map_is_the_enkf(seed: int, m: int, d: int) -> None:
    y, x = _samples(seed, 60, m, d)
    observed = _rng(seed + 1).standard_normal(m)
    ours, theirs = compose(fit(y, x), y, x, observed), _enkf(y, x, observed)
    assert np.abs(ours - theirs).max() < 1e-12 * max(1, np.abs(theirs).max(), _condition(y))


def _condition(y: np.ndarray) -> float:
    return float(np.linalg.cond(np.cov(y, rowvar=False).reshape(y.shape[1], -1)))


def test_composed_affine_map_is_the_enkf_on_standardised_data() -> None:
    rng = _rng(2)
    x = rng.standard_normal((200, 6))
    y = x[:, :4] + 0.5 * rng.standard_normal((200, 4))
    observed = rng.standard_normal(4)
    assert np.abs(compose(fit(y, x), y, x, observed) - _enkf(y, x, observed)).max() < 1e-12


def test_order_of_variables_does_not_matter_to_the_composed_map() -> None:
    y, x = _samples(5, m=3, d=4)
    observed = np.zeros(3)
    whole = compose(fit(y, x), y, x, observed)
    swapped = compose(fit(y[:, ::-1], x[:, ::-1]), y[:, ::-1], x[:, ::-1], observed)
    assert np.allclose(swapped[:, ::-1], whole, atol=1e-9)


@pytest.mark.parametrize("solver", ["ECOS", "CLARABEL"])
def test_the_printed_program_has_the_same_composed_map(solver: str) -> None:
    """(12) per component at the solver's default tolerances: 1e-8; its coefficients only 1e-4."""
    rng = _rng(6)
    x = rng.standard_normal((200, 6)) @ np.diag([1, 2, 1, 0.5, 1, 1.5])
    y = x[:, :4] + 0.5 * rng.standard_normal((200, 4))
    observed = x[0, :4]
    exact, solved = fit(y, x), fit_convex(y, x, solver=solver)
    gap = compose(exact, y, x, observed) - compose(solved, y, x, observed)
    assert np.abs(gap).max() < 1e-8
    assert np.abs(exact.scale - solved.scale).max() < 1e-4
    assert objective(exact, y, x) <= objective(solved, y, x) + 1e-12


def test_a_solver_that_stops_short_raises_its_status() -> None:
    with pytest.raises(SolverError, match="component 2"):
        fit_convex(_Y, _X, max_iters=1)


def test_conditioning_a_gaussian_converges_at_the_monte_carlo_rate() -> None:
    """Mean-square error of the posterior mean falls like 1/N: a slope of -1 within 0.15."""
    sizes, errors = np.array([100, 400, 1600, 6400]), []
    for n in sizes:
        x = _rng(int(n)).standard_normal((300, int(n), 1))
        out = affine_update(x, x, np.ones((300, 1)), [[1.0]], rng=_rng(1))
        errors.append(((out.mean(axis=1) - 0.5) ** 2).mean())
    slope = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert abs(slope + 1) < 0.15


def test_updates_are_affine_equivariant() -> None:
    """Observing in other units and estimating in other coordinates changes nothing."""
    y, x = _samples(7)
    a, b = _rng(1).standard_normal((3, 3)), np.diag([10.0, 0.1])
    noise, target = np.diag([0.3, 0.2]), np.zeros(2)
    plain = affine_update(x, y, target, noise, rng=_rng(3))
    other = affine_update(x @ a.T, y @ b, target, b @ noise @ b, rng=_rng(3))
    assert np.allclose(other, plain @ a.T, rtol=1e-8, atol=1e-8)


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_principal_directions_hold_the_largest_variance(seed: int, n: int) -> None:
    e = _samples(seed, m=1, d=4)[1]
    w = principal_directions(e, n)
    assert np.allclose(w.T @ w, np.eye(n), atol=1e-12)
    values = np.linalg.eigvalsh(np.cov(e, rowvar=False))[::-1]
    assert np.allclose(np.cov(e @ w, rowvar=False).reshape(n, n).diagonal(), values[:n], rtol=1e-8)


def test_pca_with_all_directions_is_the_whole_update() -> None:
    y, x = _samples(7)
    inputs = (x, y, np.zeros(2), np.diag([0.3, 0.2]))
    whole = affine_update(*inputs, rng=_rng(3))
    for complement in ("keep", "drop", "literal"):
        out = pca_update(
            *inputs, rng=_rng(3), n_state=3, n_observed=5, complement=complement
        )
        assert np.allclose(out, whole, atol=1e-8)


def test_pca_complement() -> None:
    """Outside the leading directions: kept, set to the mean, or lost with the mean."""
    y, x = _samples(7)
    inputs = (x, y, np.zeros(2), np.diag([0.3, 0.2]))
    w = principal_directions(x, 2)
    outside = np.eye(3) - w @ w.T
    out = {
        c: pca_update(*inputs, rng=_rng(3), n_state=2, n_observed=2, complement=c)
        for c in ("keep", "drop", "literal")
    }
    assert np.allclose(out["keep"] @ outside, x @ outside, atol=1e-9)
    assert np.allclose(out["drop"] @ outside, (x @ outside).mean(axis=0), atol=1e-9)
    assert np.allclose(out["literal"] @ outside, 0, atol=1e-9)
    assert np.allclose(out["keep"] @ w, out["literal"] @ w, atol=1e-8)


def test_updates_leave_their_inputs() -> None:
    y, x = _samples(7)
    before = x.copy(), y.copy()
    affine_update(x, y, np.zeros(2), np.eye(2), rng=_rng())
    pca_update(x, y, np.zeros(2), np.eye(2), rng=_rng(), n_state=1, n_observed=1)
    assert (x == before[0]).all() and (y == before[1]).all()


def test_members_just_enough() -> None:
    """One member more than variables is enough for a map, but not for a good one."""
    y, x = _samples(8, n=6, m=2, d=3)
    assert np.isfinite(compose(fit(y, x), y, x, np.zeros(2))).all()


def test_another_fit_can_be_handed_in() -> None:
    y, x = _samples(9, n=40, m=1, d=2)
    x, y = x / x.std(axis=0), y / y.std(axis=0)
    inputs = (x, y, np.zeros(1), np.eye(1))
    closed = affine_update(*inputs, rng=_rng(3))
    solved = affine_update(*inputs, rng=_rng(3), fit=affine.fit_convex)
    assert np.abs(closed - solved).max() < 1e-6
    assert conditioning.affine_update is affine_update


def test_known_noise_is_the_filter_of_chapter_1() -> None:
    y, x = _samples(10, leading=(3,))
    inputs = (x, y, np.zeros((3, 2)), np.diag([0.3, 0.2]))
    ours = known_noise_update(*inputs, rng=_rng(3))
    theirs = enkf(*inputs, rng=_rng(3), known_noise=True)
    assert np.abs(ours - theirs).max() < 1e-10


def test_known_noise_has_the_smaller_error_in_small_ensembles() -> None:
    """Posterior means of 4000 ensembles of 8 members, four components, all observed."""
    rng = _rng(5)
    x = rng.standard_normal((4000, 10, 4))
    inputs = (x, x, np.ones((4000, 4)), np.eye(4))
    error = {
        name: ((update(*inputs, rng=_rng(6)).mean(axis=1) - 0.5) ** 2).mean()
        for name, update in (("sampled", affine_update), ("known", known_noise_update))
    }
    assert error["known"] < 0.8 * error["sampled"]


def test_shrinkage_and_ridge_have_their_limits() -> None:
    y, x = _samples(11)
    inputs = (x, y, np.zeros(2), np.diag([0.3, 0.2]))
    plain = known_noise_update(*inputs, rng=_rng(3))
    none = known_noise_update(*inputs, rng=_rng(3), shrinkage=1.0)
    assert np.array_equal(none, x)
    assert np.abs(known_noise_update(*inputs, rng=_rng(3), ridge=1e12) - x).max() < 1e-6
    little = known_noise_update(*inputs, rng=_rng(3), shrinkage=1e-9, ridge=1e-9)
    assert np.abs(little - plain).max() < 1e-5


def test_shrinkage_takes_the_correlations_it_says() -> None:
    """The gain with the joint correlation matrix shrunk by hand."""
    y, x = _samples(12)
    noise, target, s = np.diag([0.3, 0.2]), np.array([1.0, -2.0]), 0.3
    joint = np.cov(np.hstack([x, y]), rowvar=False)
    joint = (1 - s) * joint + s * np.diag(np.diag(joint))
    gain = joint[:3, 3:] @ np.linalg.inv(joint[3:, 3:] + noise)
    drawn = y + _rng(3).standard_normal(y.shape) @ np.sqrt(noise)
    ours = known_noise_update(x, y, target, noise, rng=_rng(3), shrinkage=s)
    assert np.allclose(ours, x + (target - drawn) @ gain.T, atol=1e-9)


def test_informed_update_without_a_threshold_leaves_nothing_out() -> None:
    y, x = _samples(13, leading=(4,))
    inputs = (x, y, np.zeros((4, 2)), np.array([[0.3, 0.1], [0.1, 0.2]]))
    whole = known_noise_update(*inputs, rng=_rng(3))
    assert np.abs(informed_update(*inputs, rng=_rng(3), threshold=0.0) - whole).max() < 1e-8
    assert np.array_equal(informed_update(*inputs, rng=_rng(3), threshold=1e12), x)


def test_informed_directions_do_not_depend_on_units() -> None:
    y, x = _samples(14)
    units, noise, target = np.diag([1e3, 1e-2]), np.diag([0.3, 0.2]), np.zeros(2)
    level = np.linalg.eigvalsh(sample_covariance(y) / np.sqrt(np.outer([0.3, 0.2], [0.3, 0.2])))
    for threshold in (0.0, level.mean()):
        plain = informed_update(x, y, target, noise, rng=_rng(3), threshold=threshold)
        other = informed_update(
            x, y @ units, target, units @ noise @ units, rng=_rng(3), threshold=threshold
        )
        assert np.allclose(plain, other, atol=1e-8)


def test_direct_sampling_and_the_composed_map_agree_where_the_map_fits() -> None:
    rng = _rng(15)
    x = rng.standard_normal((60, 2000, 2)) @ np.array([[1.0, 0.5], [0.0, 1.0]])
    inputs = (x, x[..., :1], np.full((60, 1), 1.5), [[0.5]])
    direct, composed = sample_update(*inputs, rng=_rng(1)), affine_update(*inputs, rng=_rng(1))
    assert np.abs(direct.mean(axis=(0, 1)) - composed.mean(axis=(0, 1))).max() < 0.01
    gap = sample_covariance(direct).mean(axis=0) - sample_covariance(composed).mean(axis=0)
    assert np.abs(gap).max() < 0.01


def test_composed_map_keeps_what_a_misfitted_map_forgets() -> None:
    """Of a skewed prior and an observation that says nothing, (10) keeps the skewness."""
    x = _rng(16).exponential(size=(20, 2000, 1))
    inputs = (x, _rng(17).standard_normal(x.shape), np.zeros((20, 1)), [[1.0]])

    def skewness(e: np.ndarray) -> float:
        gap = e - e.mean(axis=1, keepdims=True)
        return float(((gap**3).mean(axis=1) / (gap**2).mean(axis=1) ** 1.5).mean())

    assert skewness(affine_update(*inputs, rng=_rng(1))) > 1.8
    assert abs(skewness(sample_update(*inputs, rng=_rng(1)))) < 0.1
