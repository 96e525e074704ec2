"""Wrappers against what they wrap, missing readings, and the door itself."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import updates
from distfilt.coupling import norm_constraint, project, retract
from distfilt.models import Model
from distfilt.updates.decorator import Update, has_tag
from distfilt.updates.gaussian import exact_forecast
from distfilt.updates.wrappers import gaspari_cohn
from tests.support import without_checks

from .cases import UPDATES, H, R, Y, kalman, members, moments, rng

ROOT = partial(updates.etkf, rotation="none")
"""An update that draws nothing."""


def test_inflation_multiplies_anomalies_only() -> None:
    x = members(30)
    plain = updates.enkf(x, x @ H.T, Y, R, rng=rng())
    wide = updates.with_inflation(updates.enkf, factor=1.3)(x, x @ H.T, Y, R, rng=rng())
    centre = plain.mean(axis=0)
    assert np.allclose(wide, centre + 1.3 * (plain - centre), atol=1e-12)


def test_missing_and_unpredicted_readings_are_deleted_rows() -> None:
    x = members(30)
    noise = np.array([[0.5, 0.3, 0.1], [0.3, 0.9, 0.2], [0.1, 0.2, 0.4]])
    h = np.column_stack([x @ H.T, x[:, 0]])
    y = np.array([1.2, -0.7, 0.4])
    keep = [0, 2]
    wanted = ROOT(x, h[:, keep], y[keep], noise[np.ix_(keep, keep)], rng=rng())
    blind = h.copy()
    gap = y.copy()
    blind[3, 1] = np.nan
    gap[1] = np.nan
    for seen, told in ((h, gap), (blind, y)):
        out = updates.with_missing(ROOT, x, seen, told, noise, rng=rng())
        assert np.allclose(out, wanted, atol=1e-12)


def test_serial_without_a_sensor_is_exact_for_linear_readings() -> None:
    x = members(20, 2)  # of two agents, whose readings' errors may go together for one
    for noise in (
        np.diag([0.5, 0.9]) * [[[1.0]], [[2.0]]],
        np.stack([np.diag([0.5, 0.9]), R]),
    ):
        out = updates.serially(updates.enkf_exact)(x, x @ H.T, [Y, Y], noise, rng=rng())
        for own, r, after in zip(x, noise, out, strict=True):
            mean, cov = kalman(*moments(own), H, r, Y)
            assert np.allclose(after.mean(axis=0), mean, atol=1e-12)
            assert np.allclose(np.cov(after.T), cov, atol=1e-12)


def test_serial_predicts_again() -> None:
    """Two curved readings: the second is predicted from the members as the first left them."""

    def both(e: np.ndarray) -> np.ndarray:
        return np.stack([e[:, 0] ** 2, np.exp(e[:, 0])], axis=1)

    x = members(30)
    y = np.array([1.5, 3.0])
    four = x, both(x), y, np.diag([0.5, 0.9])
    out = updates.serially(ROOT)(*four, rng=rng(), predict=both)
    first = ROOT(x, both(x)[:, :1], y[:1], [[0.5]], rng=rng())
    second = ROOT(first, both(first)[:, 1:], y[1:], [[0.9]], rng=rng())
    assert np.allclose(out, second, atol=1e-13)
    assert np.abs(updates.serially(ROOT)(*four, rng=rng()) - out).max() > 1e-3


@pytest.mark.parametrize("name", UPDATES)
def test_missing_readings_of_a_stack_with_noise_of_its_own(name: str) -> None:
    x = members(30, 3)
    noise = np.stack([R, 2 * R, 3 * R])
    y = np.stack([Y, [Y[0], np.nan], [np.nan, np.nan]])
    out = updates.with_missing(UPDATES[name], x, x @ H.T, y, noise, rng=rng())
    full = updates.with_missing(
        UPDATES[name], x, x @ H.T, np.stack([Y] * 3), noise, rng=rng()
    )
    assert (out[2] == x[2]).all() and (out[1] != x[1]).any()
    # What the others miss is no business of the first one's draws.
    assert np.allclose(out[0], full[0], rtol=0, atol=1e-12)
    turned = updates.with_missing(
        UPDATES[name], x, x @ H.T, y[[1, 0, 2]], noise, rng=rng()
    )
    assert np.allclose(turned[1], full[1], rtol=0, atol=1e-12)


def test_partial_options_survive_the_open_door() -> None:
    turned = partial(updates.etkf, rotation="none")
    x = members(20)
    given = (x, x @ H.T, Y, R)
    assert np.array_equal(
        without_checks(turned)(*given, rng=rng()), turned(*given, rng=rng())
    )
    assert has_tag(turned, "stacks") and not has_tag(partial(print, 3), "stacks")
    assert not has_tag(
        updates.with_inflation(lambda x, h, y, r, *, rng: x, factor=1.0), "stacks"
    )
    with pytest.raises(ValueError, match="rotation"):
        updates.with_inflation(partial(updates.etkf, rotation="left"), factor=1.0)


def test_exact_forecast_adds_q_exactly() -> None:
    phi = np.array([[1.0, 0.3], [0.0, 0.9]])
    q = np.array([[0.4, 0.1], [0.1, 0.2]])
    model = Model(2, lambda x, t, dt: x @ phi.T, lambda t, dt: dt * q)
    bent = replace(
        model,
        transition=lambda x, t, dt: np.where(x < 50, x @ phi.T + 0.3 * x**2, np.inf),
    )
    x = members(12, 3)[..., :2]
    out = exact_forecast(x, bent, 0.0, 0.5, rng=rng())
    for e, m in zip(out, bent.step(x, 0.0, 0.5), strict=True):
        assert np.allclose(e.mean(axis=0), m.mean(axis=0), atol=1e-13)
        assert np.allclose(np.cov(e.T), np.cov(m.T) + 0.5 * q, atol=1e-12)
    x[1, 0] = 99.0  # an ensemble that is lost takes no bit of the others' noise with it
    lost = exact_forecast(x, bent, 0.0, 0.5, rng=rng())
    assert np.array_equal(lost[::2], out[::2]) and np.isnan(lost[1]).all()
    plain = updates.stochastic_forecast(
        members(100_000)[:, :2], model, 0.0, 0.5, rng=rng()
    )
    wanted = phi @ np.cov(members(100_000)[:, :2].T) @ phi.T + 0.5 * q
    assert np.allclose(np.cov(plain.T), wanted, atol=0.03)


CIRCLE = norm_constraint([0, 1], length=1.2)
NOISE = np.array([[0.02, 0.005], [0.005, 0.03]])
SEEN = np.array([0.9, 0.7])
MOTION = ([0, 1], [2, 3])
INNERS = [updates.etpf, updates.enkf, updates.etkf]
INNER = pytest.mark.parametrize("inner", INNERS)


def swings(*leading: int) -> np.ndarray:
    x = np.random.default_rng(0).standard_normal((*leading, 30, 4))
    return np.asarray([0.8, 0.6, 1.0, -1.0] + 0.15 * x)


@INNER
def test_projection_and_retraction_follow_the_update(inner: Update) -> None:
    x = swings(3)
    y = np.tile(SEEN, (3, 1))
    four = x, x[..., :2], y, NOISE
    plain = inner(*four, rng=rng())
    how: Any = {"variant": "particle", "regularisation": 0.01}
    out = updates.with_projection(inner, CIRCLE, **how)(*four, rng=rng())
    assert np.allclose(out, project(plain, CIRCLE, **how), atol=1e-14)
    assert np.abs(out - plain).max() > 1e-3
    out = updates.with_retraction(inner, CIRCLE, motion=MOTION)(*four, rng=rng())
    assert np.allclose(out, retract(plain, CIRCLE, motion=MOTION), atol=1e-14)
    assert np.abs(np.hypot(out[..., 0], out[..., 1]) - 1.2).max() <= 1e-14


@INNER
def test_augmentation_is_one_more_reading(inner: Update) -> None:
    x = swings()
    both = np.column_stack([x[:, :2], (x[:, :2] ** 2).sum(axis=1)])
    noise = np.zeros((3, 3))
    noise[:2, :2] = NOISE
    noise[2, 2] = 0.2**2
    expected = inner(x, both, [*SEEN, 1.44], noise, rng=rng())
    out = updates.with_augmentation(inner, CIRCLE, std=0.2)(
        x, x[:, :2], SEEN, NOISE, rng=rng()
    )
    assert np.allclose(out, expected, atol=1e-12)


# ------------------------------------------------------------------------------ localisation


def test_the_taper_is_a_correlation_that_ends_at_two_radii() -> None:
    """Its values by hand, its smooth joints, and no negative eigenvalue on a line or a ring."""
    assert np.allclose(
        gaspari_cohn(np.array([0.0, 1.0, 2.0, 3.0])), [1, 5 / 24, 0, 0], atol=1e-15
    )
    for joint, power in ((1.0, 1), (2.0, 3)):
        left, right = gaspari_cohn(joint + np.array([-1e-3, 1e-3])) - gaspari_cohn(
            np.array(joint)
        )
        assert abs(left + right) < 1e-3**power
    gap = np.abs(np.subtract.outer(np.arange(40.0), np.arange(40.0)))
    for distance in (gap, np.minimum(gap, 40 - gap)):
        assert np.linalg.eigvalsh(gaspari_cohn(distance / 5)).min() > -1e-12


def test_one_reading_localised_is_the_update_with_a_tapered_gain() -> None:
    x = members(20)
    places = np.array([[0.0], [1.5], [7.0]])
    at = np.array([[0.5]])
    zeta = np.sqrt(0.5) * rng(3).standard_normal((20, 1))
    share = gaspari_cohn(np.abs(places - at)[:, 0] / 2)
    gain = np.cov(x.T)[:, 0] / (np.cov(x.T)[0, 0] + 0.5) * share

    def seeded(*four: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return updates.enkf(*four, rng=np.random.default_rng(3))

    near = updates.with_localization(
        seeded, places=places, observation_places=at, radius=2.0
    )
    out = near(x, x[:, :1], [1.0], [[0.5]], rng=rng())
    assert np.allclose(out, x + (1.0 - x[:, :1] - zeta) * gain, atol=1e-12)
    assert (out[:, 2] == x[:, 2]).all()


@pytest.mark.parametrize("given", [{}, {"predict": lambda e: e[:, [0, 2]]}])
def test_readings_on_a_ring_localised_one_after_the_other(
    given: dict[str, Any],
) -> None:
    """What the first reading moves, predictions or the members of which they are made, the second
    meets; distances are the shorter way round.
    """
    x = members(20)
    y = np.array([1.0, -0.5])
    places = [[0.0], [1.5], [7.0]]
    near = partial(
        updates.with_localization, ROOT, places=places, radius=2.0, period=8.0
    )
    out = near(observation_places=[[0.0], [7.0]])(
        x, x[:, [0, 2]], y, np.diag([0.5, 0.9]), rng=rng(), **given
    )
    first = near(observation_places=[[0.0]])(x, x[:, :1], y[:1], [[0.5]], rng=rng())
    second = near(observation_places=[[7.0]])(
        first, first[:, 2:], y[1:], [[0.9]], rng=rng()
    )
    assert np.allclose(out, second, atol=1e-12)
    for k, noise, r in (
        ([2], [[0.9]], [0.5, 1.25, 0.0]),
        ([0, 2], R, [0.0, 0.75, 0.0]),
    ):
        four = (
            x,
            x[:, k],
            y[-len(k) :],
            noise,
        )  # two whose errors go together move as one
        local = near(observation_places=[places[i] for i in k])(*four, rng=rng())
        share = gaspari_cohn(np.array(r))
        assert np.allclose(local - x, share * (ROOT(*four, rng=rng()) - x), atol=1e-12)
