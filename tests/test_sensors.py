"""Sensors: what they see, how angles wrap, how derivatives agree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import ensembles, sensors
from distfilt.sensors import Sensor, angle, differential, direct, range_, stack, wrap

NAN = float("nan")


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


_S = "distfilt.sensors."
_E = "distfilt.ensembles."
BAD_INPUT = {
    _S + "Sensor": [
        ("dim", lambda: Sensor(0, lambda x: x, np.eye(1))),
        ("function", lambda: Sensor(1, 2, np.eye(1))),
        ("noise", lambda: Sensor(2, lambda x: x, np.eye(1))),
        ("noise", lambda: Sensor(1, lambda x: x, [[-1.0]])),
        ("function", lambda: Sensor(2, lambda x: x, np.eye(2)).predict([1.0])),
        ("previous", lambda: differential([0], noise=1.0).predict([1.0])),
        ("x", lambda: direct([3], noise=1.0).predict([1.0])),
        ("x", lambda: direct([0], noise=1.0).predict([NAN])),
        ("rng", lambda: direct([0], noise=1.0).observe([1.0], rng=0)),
        ("observed", lambda: direct([0], noise=1.0).residual([1.0, 2.0], [1.0])),
        ("predicted", lambda: direct([0], noise=1.0).residual([1.0], [NAN])),
        ("sensor", lambda: range_([0, 1], noise=1.0).matrix(2)),
        ("dim", lambda: direct([0], noise=1.0).matrix(0)),
    ],
    _S + "angle": [
        ("indices", lambda: angle([0], noise=0.1)),
        ("noise", lambda: angle([0, 1], noise=-0.1)),
    ],
    _S + "differential": [("noise", lambda: differential([0], noise=0.0))],
    _S + "direct": [
        ("indices", lambda: direct([0, 0], noise=0.1)),
        ("indices", lambda: direct([], noise=0.1)),
        ("indices", lambda: direct([-1], noise=0.1)),
        ("noise", lambda: direct([0], noise=-1.0)),
    ],
    _S + "of_kind": [
        ("kind", lambda: sensors.of_kind("radar", [0], noise=0.1)),
        ("noise", lambda: sensors.of_kind("angle", [0, 1], noise=-0.1)),
    ],
    _S + "range_": [("noise", lambda: range_([0], noise=NAN))],
    _S + "stack": [
        ("sensors", lambda: stack([])),
        ("sensors", lambda: stack([direct([0], noise=1.0), 3])),
        ("sensors", lambda: stack(direct([0], noise=1.0))),
    ],
    _S + "wrap": [
        ("angles", lambda: wrap([NAN])),
        ("period", lambda: wrap([1.0], period=0.0)),
    ],
    _E + "anomalies": [("ensemble", lambda: ensembles.anomalies([1.0, 2.0]))],
    _E + "cross_covariance": [
        ("other", lambda: ensembles.cross_covariance(np.eye(3), np.eye(2))),
        ("ensemble", lambda: ensembles.cross_covariance([[1.0]], [[1.0]])),
    ],
    _E + "draw": [
        ("mean", lambda: ensembles.draw([[0.0]], [[1.0]], 3, rng=_rng())),
        ("cov", lambda: ensembles.draw([0.0], [[-1.0]], 3, rng=_rng())),
        ("cov", lambda: ensembles.draw([0.0], np.eye(2), 3, rng=_rng())),
        ("members", lambda: ensembles.draw([0.0], [[1.0]], 0, rng=_rng())),
        ("leading", lambda: ensembles.draw([0.0], [[1.0]], 3, rng=_rng(), leading=(0,))),
        ("rng", lambda: ensembles.draw([0.0], [[1.0]], 3, rng=7)),
    ],
    _E + "mean": [("ensemble", lambda: ensembles.mean([[NAN]]))],
    _E + "sample_covariance": [("ensemble", lambda: ensembles.sample_covariance([[1.0]]))],
}


@given(st.floats(-50, 50), st.integers(-5, 5))
def test_wrap_forgets_whole_turns(value: float, turns: int) -> None:
    once, again = wrap([value]), wrap([value + turns * 2 * np.pi])
    assert abs(wrap(once - again)[0]) < 1e-9
    assert -np.pi <= once[0] < np.pi


@given(st.floats(-10, 10), st.floats(-10, 10))
def test_angle_is_arctan_up_to_its_branch(a: float, b: float) -> None:
    if abs(a) < 1e-6:
        return
    seen = angle([0, 1], noise=0.1).predict([a, b])[0]
    assert abs(np.arctan(b / a) - seen) < 1e-9 or abs(abs(seen) - np.pi / 2) < 1e-9


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_full_angle_residual_is_the_short_way(y: float, p: float) -> None:
    gap = angle([0, 1], noise=0.1, full=True).residual([y], [p])[0]
    assert abs(gap) <= np.pi and abs(np.exp(1j * (y - p)) - np.exp(1j * gap)) < 1e-9


def test_angle_of_nothing_is_missing() -> None:
    assert np.isnan(angle([0, 1], noise=0.1).predict([0.0, 0.0])).all()


@pytest.mark.parametrize(
    "sensor",
    [direct([2, 0], noise=0.1), range_([0, 1, 2], noise=0.1), angle([1, 2], noise=0.1, full=True)],
    ids=lambda s: s.kind,
)
def test_jacobian_predicts_small_changes(sensor: Sensor) -> None:
    """The error of the linearisation is of second order: halving the change quarters it."""
    x, v = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.2])
    slope = sensor.jacobian(x) @ v
    gaps = [
        np.abs(sensor.residual(sensor.predict(x + h * v), sensor.predict(x)) - h * slope).max()
        for h in (1e-2, 5e-3)
    ]
    assert gaps[1] < 0.27 * gaps[0] + 1e-12


def test_linear_sensor_is_its_matrix() -> None:
    sensor = direct([3, 1], noise=0.1)
    x = _rng().standard_normal((4, 5))
    assert (sensor.predict(x) == x @ sensor.matrix(5).T).all()
    assert (sensor.jacobian(x)[0] == sensor.matrix(5)).all()


def test_differential_sees_changes_only() -> None:
    sensor = differential([0, 1], noise=0.1)
    before, after = _rng().standard_normal((2, 7, 3))
    assert (sensor.predict(after + 5, before + 5) - sensor.predict(after, before) < 1e-12).all()


def test_noise_has_the_stated_covariance() -> None:
    """Each sample variance of 4000 readings lies in its 99.9% chi-square band."""
    from scipy.stats import chi2

    noise = direct([0, 1], noise=0.3).observe(np.zeros((4000, 2)), rng=_rng()) / 0.3
    low, high = chi2.ppf([2.5e-4, 1 - 2.5e-4], 4000)
    assert ((low < (noise**2).sum(axis=0)) & ((noise**2).sum(axis=0) < high)).all()


def test_a_sensor_s_noise_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        direct([0], noise=0.1).noise[0, 0] = 2.0


def test_range_and_unknown_previous_leave_inputs() -> None:
    x = _rng().standard_normal((3, 3))
    before = x.copy()
    sensors.range_([0, 1], noise=0.1).predict(x)
    assert (x == before).all()


@given(st.integers(0, 1000), st.integers(2, 8), st.integers(1, 4))
def test_sample_covariance_is_numpy_s(seed: int, members: int, d: int) -> None:
    e = np.random.default_rng(seed).standard_normal((2, members, d))
    ours = ensembles.sample_covariance(e)
    assert np.allclose(ours[1], np.cov(e[1], rowvar=False).reshape(d, d), atol=1e-12)
    assert (ensembles.cross_covariance(e, e) - ours < 1e-12).all()


def test_anomalies_sum_to_zero_when_members_equal_components() -> None:
    e = _rng().standard_normal((4, 4))
    assert np.abs(ensembles.anomalies(e).sum(axis=0)).max() < 1e-12
    assert ensembles.mean(e).shape == (4,)


def test_a_stacked_sensor_is_its_parts() -> None:
    parts = [direct([0, 2], noise=0.1), angle([0, 1], noise=0.2), range_([0, 1], noise=0.3)]
    both, x = stack(parts), np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 2.0]])
    apart = np.concatenate([s.predict(x) for s in parts], axis=-1)
    assert (both.predict(x) == apart).all()
    assert np.allclose(both.noise.diagonal(), [0.01, 0.01, 0.04, 0.09])
    far = apart + np.array([0.0, 0.0, np.pi, 0.0])  # a line's angle repeats after pi
    assert np.abs(both.residual(far, apart)).max() < 1e-12
