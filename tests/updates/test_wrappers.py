"""Wrappers against what they wrap, missing readings, and the door itself."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from distfilt.models import Model
from distfilt.updates import (
    centred,
    exact_draws,
    exact_forecast,
    gated,
    inflated,
    known_noise,
    sampled_forecast,
    sampled_noise,
    serial,
    update,
    with_missing,
)
from distfilt.updates.door import joined, perturbed, stackable, unchecked

from .cases import UPDATES, H, R, Y, kalman, members, moments


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_inflation_multiplies_anomalies_only() -> None:
    x = members(30)
    plain = known_noise(x, x @ H.T, Y, R, rng=rng())
    wide = inflated(known_noise, factor=1.3)(x, x @ H.T, Y, R, rng=rng())
    centre = plain.mean(axis=0)
    assert np.allclose(wide, centre + 1.3 * (plain - centre), atol=1e-12)


def test_gate_is_the_update_without_the_wild_reading() -> None:
    x = members(40)
    h = x @ H.T
    wild = np.array([Y[0], 500.0])
    out = gated(exact_draws)(x, h, wild, R, rng=rng())
    alone = exact_draws(x, h[:, :1], Y[:1], R[:1, :1], rng=rng())
    assert np.allclose(*(m.mean(axis=0) for m in (out, alone)), atol=1e-12)
    assert np.allclose(np.cov(out.T), np.cov(alone.T), atol=1e-12)


def test_gate_uses_the_sample_variance_of_few_members() -> None:
    """Of -1 and 1 it is 2, so with noise 0.5 a reading passes within q times the root of 2.5."""
    x, q = np.array([[-1.0], [1.0]]), 1.959963984540054
    for y, passes in ((0.999 * q * np.sqrt(2.5), True), (1.001 * q * np.sqrt(2.5), False)):
        out = gated(known_noise, probability=0.95)(x, x, [y], [[0.5]], rng=rng())
        assert bool((out != x).any()) is passes


def test_gate_lets_the_stated_share_pass() -> None:
    """Of consistent readings 5% are rejected at probability .95, run by run."""
    x = members(400, 2000)
    h = x[..., :1]
    truth = members(2000, seed=9)[:, :1]
    y = truth + np.sqrt(0.5) * rng(2).standard_normal(truth.shape)
    out = gated(exact_draws, probability=0.95)(x, h, y, [[0.5]], rng=rng())
    kept = (out == x).all(axis=(1, 2)).mean()
    assert abs(kept - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 2000) + 0.005


def test_serial_without_a_sensor_is_exact_for_linear_readings() -> None:
    x = members(20)
    diagonal = np.diag([0.5, 0.9])
    mean, cov = kalman(*moments(x), H, diagonal, Y)
    out = serial(exact_draws)(x, x @ H.T, Y, diagonal, rng=rng())
    assert np.allclose(out.mean(axis=0), mean, atol=1e-12)
    assert np.allclose(np.cov(out.T), cov, atol=1e-12)


def test_serial_keeps_correlated_readings_together() -> None:
    x = members(20)
    mean, cov = kalman(*moments(x), H, R, Y)
    out = serial(exact_draws)(x, x @ H.T, Y, R, rng=rng())
    assert np.allclose(out.mean(axis=0), mean, atol=1e-12)
    assert np.allclose(np.cov(out.T), cov, atol=1e-12)


def test_serial_predicts_again() -> None:
    """Two curved readings: the second is predicted from the members as the first left them."""
    x = members(30)
    both = lambda e: np.stack([e[:, 0] ** 2, np.exp(e[:, 0])], axis=1)  # noqa: E731
    diagonal, y = np.diag([0.5, 0.9]), np.array([1.5, 3.0])
    source = rng(4)
    out = serial(exact_draws)(x, both(x), y, diagonal, rng=source, predict=both)
    source = rng(4)
    first = with_missing(exact_draws, x, both(x)[:, :1], y[:1], diagonal[:1, :1], rng=source)
    second = with_missing(
        exact_draws, first, both(first)[:, 1:], y[1:], diagonal[1:, 1:], rng=source
    )
    assert np.allclose(out, second, atol=1e-13)
    without = serial(exact_draws)(x, both(x), y, diagonal, rng=rng(4))
    assert np.abs(without - out).max() > 1e-3


def test_serial_serves_more_readings_than_members() -> None:
    """A hub that hears twenty readings with ten members, sampled noise and all."""
    x = members(10)
    h = np.repeat(x[:, :1], 20, axis=1)
    with pytest.raises(ValueError, match="at least 21 members for 20 readings"):
        sampled_noise(x, h, np.ones(20), np.eye(20), rng=rng())
    out = serial(sampled_noise)(x, h, np.ones(20), np.eye(20), rng=rng())
    assert out[:, 0].var() < 0.5 * x[:, 0].var()


@pytest.mark.parametrize("name", UPDATES)
def test_missing_readings_of_a_stack_with_noise_of_its_own(name: str) -> None:
    x = members(30, 3)
    noise = np.stack([R, 2 * R, 3 * R])
    y = np.stack([Y, [Y[0], np.nan], [np.nan, np.nan]])
    out = with_missing(UPDATES[name], x, x @ H.T, y, noise, rng=rng())
    full = with_missing(UPDATES[name], x, x @ H.T, np.stack([Y] * 3), noise, rng=rng())
    assert (out[2] == x[2]).all() and (out[1] != x[1]).any()
    # What the others miss is no business of the first one's draws.
    assert np.allclose(out[0], full[0], rtol=0, atol=1e-12)
    turned = with_missing(UPDATES[name], x, x @ H.T, y[[1, 0, 2]], noise, rng=rng())
    assert np.allclose(turned[1], full[1], rtol=0, atol=1e-12)


def test_missing_rows_are_deleted_rows() -> None:
    x = members(30)
    h = np.column_stack([x @ H.T, x[:, 0]])
    noise = np.array([[0.5, 0.3, 0.1], [0.3, 0.9, 0.2], [0.1, 0.2, 0.4]])
    out = with_missing(exact_draws, x, h, np.array([1.2, np.nan, 0.4]), noise, rng=rng())
    keep = [0, 2]
    h2, r2 = np.vstack([H[0], [1.0, 0, 0]]), noise[np.ix_(keep, keep)]
    mean, cov = kalman(*moments(x), h2, r2, np.array([1.2, 0.4]))
    assert np.allclose(out.mean(axis=0), mean, atol=1e-12)
    assert np.allclose(np.cov(out.T), cov, atol=1e-12)


def test_a_prediction_that_does_not_exist_is_a_missing_reading() -> None:
    x = members(30)
    h = x @ H.T
    bad = h.copy()
    bad[3, 1] = np.nan
    out = with_missing(exact_draws, x, bad, Y, R, rng=rng())
    wanted = with_missing(exact_draws, x, h, np.array([Y[0], np.nan]), R, rng=rng())
    assert np.allclose(out, wanted, atol=1e-13)


def test_draws_differ_between_ensembles_with_other_patterns() -> None:
    x = members(50, 3)
    y = np.stack([Y, [Y[0], np.nan], [np.nan, Y[1]]])
    out = with_missing(known_noise, x, 0 * x @ H.T, y, R, rng=rng())
    assert np.allclose(out, x)  # a reading of nothing moves nobody
    lone = with_missing(known_noise, x, x @ H.T, y, R, rng=rng())
    moved = lone - x
    assert abs(np.corrcoef(moved[1, :, 0], moved[2, :, 0])[0, 1]) < 0.95


@pytest.mark.parametrize("wrap", [gated, partial(inflated, factor=1.0)])
def test_centred_reaches_through_other_wrappers(wrap: object) -> None:
    x = members(9)
    diagonal = np.diag([0.5, 0.9])
    mean, _ = kalman(*moments(x), H, diagonal, Y)
    out = centred(wrap(known_noise))(x, x @ H.T, Y, diagonal, rng=rng())
    assert np.allclose(out.mean(axis=0), mean, atol=1e-12)


def test_perturbed_has_the_noise_s_covariance() -> None:
    """A factor that is transposed has another covariance: the matrix is full."""
    seen = perturbed(np.zeros((200_000, 2)), R, rng(0))
    assert np.allclose(np.cov(seen.T), R, atol=4 * 0.9 * np.sqrt(2 / 200_000))


def test_partial_options_survive_the_open_door() -> None:
    shrunk = partial(known_noise, shrinkage=0.4)
    x = members(20)
    a = unchecked(shrunk)(x, x @ H.T, Y, R, rng=rng())
    assert np.array_equal(a, known_noise(x, x @ H.T, Y, R, rng=rng(), shrinkage=0.4))
    assert stackable(shrunk) and not stackable(partial(print, 3))
    assert not stackable(inflated(lambda x, h, y, r, *, rng: x, factor=1.0))


def test_exact_forecast_adds_q_exactly() -> None:
    phi, q = np.array([[1.0, 0.3], [0.0, 0.9]]), np.array([[0.4, 0.1], [0.1, 0.2]])
    model = Model(2, lambda x, t, dt: x @ phi.T, lambda t, dt: dt * q)
    x = members(12, 3)[..., :2]
    out = exact_forecast(x, model, 0.0, 0.5, rng=rng())
    for e, m in zip(out, x, strict=True):
        assert np.allclose(e.mean(axis=0), phi @ m.mean(axis=0), atol=1e-13)
        assert np.allclose(np.cov(e.T), phi @ np.cov(m.T) @ phi.T + 0.5 * q, atol=1e-12)
    plain = sampled_forecast(members(100_000)[:, :2], model, 0.0, 0.5, rng=rng())
    wanted = phi @ np.cov(members(100_000)[:, :2].T) @ phi.T + 0.5 * q
    assert np.allclose(np.cov(plain.T), wanted, atol=0.03)


BAD_INPUT = {
    "distfilt.updates.wrappers.inflated": [
        ("update", lambda: inflated(3, factor=1.0)),
        ("factor", lambda: inflated(known_noise, factor=0.0)),
    ],
    "distfilt.updates.wrappers.gated": [
        ("update", lambda: gated(3)),
        ("probability", lambda: gated(known_noise, probability=1.0)),
    ],
    "distfilt.updates.wrappers.centred": [("update", lambda: centred(3))],
    "distfilt.updates.wrappers.serial": [("update", lambda: serial(3))],
    "distfilt.updates.forecasts.exact_forecast": [
        ("model", lambda: exact_forecast(np.zeros((3, 1)), "text", 0.0, 0.1, rng=rng())),
    ],
    "distfilt.updates.forecasts.sampled_forecast": [
        ("model", lambda: sampled_forecast(np.zeros((3, 1)), 3.5, 0.0, 0.1, rng=rng())),
        ("ensemble", lambda: sampled_forecast(np.zeros((3, 2)), Model(1, lambda x, t, dt: x,
                                       lambda t, dt: np.eye(1)), 0.0, 0.1, rng=rng())),
    ],
}
EXEMPT = {
    "distfilt.updates.door.update": "makes a door; what the door refuses is tested for each update",
    "distfilt.updates.door.unchecked": "takes checks away",
    "distfilt.updates.door.stackable": "says yes or no of anything",
    "distfilt.updates.door.joined": "makes a wrapper's door",
    "distfilt.updates.door.Update": "a type",
    "distfilt.updates.missing.Rows": "made by with_missing",
    "distfilt.updates.missing.with_missing": "inside the door: its callers have checked",
}


def test_exempt_names_exist() -> None:
    assert callable(update) and callable(joined)
