"""Directions in orbit, as angles and as printed."""

from __future__ import annotations

import numpy as np

from distfilt.models import occulted
from distfilt.sensors import ephemeris, line_of_sight


def test_angles_point_at_the_target() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((30, 12)) * 1e4
    way = x[:, :3] - x[:, 6:9]
    a, d = line_of_sight(std=1e-4).predict(x).T
    unit = np.stack([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)], axis=-1)
    assert np.allclose(unit * np.linalg.norm(way, axis=1, keepdims=True), way)


def test_the_printed_form_loses_a_sign() -> None:
    front, back = np.zeros(12), np.zeros(12)
    front[:3], back[:3] = (3, 1, 1), (-3, 1, 1)
    printed, right = line_of_sight(std=1.0, form="printed"), line_of_sight(std=1.0)
    assert np.allclose(printed.predict(front), printed.predict(back))
    assert not np.allclose(right.predict(front), right.predict(back))


def test_right_ascension_wraps() -> None:
    eye = line_of_sight(std=1.0)
    gap = eye.residual(np.array([np.pi - 0.1, 0.2]), np.array([-np.pi + 0.1, 0.1]))
    assert np.allclose(gap, [-0.2, 0.1])


def test_places_in_the_state_and_the_ephemeris() -> None:
    x = np.arange(18.0)
    eye = line_of_sight(std=1.0, target=6, observer=12)
    y = np.zeros(12)
    y[:3], y[6:9] = x[6:9], x[12:15]
    assert np.allclose(eye.predict(x), line_of_sight(std=1.0).predict(y))
    fix = ephemeris(position_std=1e-3, velocity_std=1e-5, start=6)
    assert fix.predict(x).tolist() == x[6:12].tolist()
    assert np.allclose(np.sqrt(np.diag(fix.cov)), [1e-3] * 3 + [1e-5] * 3)


def test_a_hidden_direction_is_nan() -> None:
    x = np.zeros((2, 12))
    x[:, 0], x[0, 6], x[1, 7] = 26000.0, -42000.0, 42000.0
    eye = line_of_sight(std=1e-4, hidden=occulted)
    assert np.isnan(eye.predict(x)).tolist() == [[True, True], [False, False]]
    assert np.isnan(eye.observe(x, rng=np.random.default_rng(0))[0]).all()
    assert np.array_equal(eye.predict(x)[1], line_of_sight(std=1e-4).predict(x)[1])
