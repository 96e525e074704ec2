"""Wrappers against the updates that they wrap, missing observations, and the decorator."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import updates
from distfilt.coupling import norm_constraint, project, retract, transform_ensemble
from distfilt.models import Model
from distfilt.updates.decorator import Update, has_tag
from distfilt.updates.gaussian import exact_forecast
from distfilt.updates.wrappers import gaspari_cohn
from tests.support import without_checks

from .cases import UPDATES, H, R, Y, kalman, members, moments, rng

ETKF = partial(updates.etkf, rotation="none")
"""An update that draws nothing."""


def test_inflation_multiplies_anomalies_only() -> None:
    """The mean stays, and the anomalies have the factor."""
    x = members(30)
    data = (x, x @ H.T, Y, R)
    analysis = updates.enkf(*data, rng=rng())
    inflated = updates.with_inflation(updates.enkf, factor=1.3)(*data, rng=rng())
    # m + λ (x - m)
    mean = analysis.mean(axis=0)
    assert np.allclose(inflated, mean + 1.3 * (analysis - mean), atol=1e-12)


# ------------------------------------------------------------------- missing observations


def test_a_missing_component_is_a_deleted_row() -> None:
    """Without a value or without a prediction: the update by the other components."""
    x = members(30)
    noise = np.array([[0.5, 0.3, 0.1], [0.3, 0.9, 0.2], [0.1, 0.2, 0.4]])
    h = np.column_stack([x @ H.T, x[:, 0]])
    y = np.array([1.2, -0.7, 0.4])
    rows = [0, 2]
    block = noise[np.ix_(rows, rows)]
    expected = ETKF(x, h[:, rows], y[rows], block, rng=rng())
    without_value = y.copy()
    without_value[1] = np.nan
    analysis = updates.with_missing(ETKF, x, h, without_value, noise, rng=rng())
    assert np.allclose(analysis, expected, atol=1e-12)
    without_prediction = h.copy()
    without_prediction[3, 1] = np.nan
    analysis = updates.with_missing(ETKF, x, without_prediction, y, noise, rng=rng())
    assert np.allclose(analysis, expected, atol=1e-12)


@pytest.mark.parametrize("name", UPDATES)
def test_missing_components_in_a_stack_with_several_covariances(name: str) -> None:
    """An ensemble's analysis and draws do not depend on the components that others miss."""
    x = members(30, 3)
    h = x @ H.T
    noise = np.stack([R, 2 * R, 3 * R])
    # Complete, without the second component, and without any
    y = np.stack([Y, [Y[0], np.nan], [np.nan, np.nan]])
    apply = partial(updates.with_missing, UPDATES[name], x, h)
    analysis = apply(y, noise, rng=rng())
    complete = apply(np.stack([Y, Y, Y]), noise, rng=rng())
    # The third ensemble has no observation, the second one has one.
    assert (analysis[2] == x[2]).all()
    assert (analysis[1] != x[1]).any()
    assert np.allclose(analysis[0], complete[0], rtol=0, atol=1e-12)
    # The first two ensembles exchange their observations.
    swapped = apply(y[[1, 0, 2]], noise, rng=rng())
    assert np.allclose(swapped[1], complete[1], rtol=0, atol=1e-12)


def test_missing_is_nan_and_not_infinity() -> None:
    """The arguments are checked, but for NaN."""
    x = members(30)
    with pytest.raises(ValueError, match="^observed must"):
        updates.with_missing(ETKF, x, x @ H.T, [np.inf, 0.0], R, rng=rng())
    with pytest.raises(ValueError, match="^noise must"):
        updates.with_missing(ETKF, x, x @ H.T, Y, -R, rng=rng())


# ------------------------------------------------------------------------- the decorator


def test_the_options_of_a_partial_are_kept_and_checked() -> None:
    """With and without checks; and a partial has the tags of its update."""
    x = members(20)
    data = (x, x @ H.T, Y, R)
    unchecked = without_checks(ETKF)(*data, rng=rng())
    assert np.array_equal(unchecked, ETKF(*data, rng=rng()))
    assert has_tag(ETKF, "stacks")
    assert not has_tag(partial(print, 3), "stacks")
    # A function without the decorator has no tags.
    plain = updates.with_inflation(lambda x, h, y, r, *, rng: x, factor=1.0)
    assert not has_tag(plain, "stacks")
    with pytest.raises(ValueError, match="rotation"):
        updates.with_inflation(partial(updates.etkf, rotation="left"), factor=1.0)


def test_the_decorator_does_not_change_the_function() -> None:
    """The kinds of its arguments are the wrapper's; its annotations stay."""

    def shift(x: Any, h: Any, y: Any, r: Any, *, rng: Any) -> Any:
        return x + 1.0

    annotations = dict(shift.__annotations__)
    checked = updates.update(shift)
    with pytest.raises(ValueError, match="^h must"):
        checked(members(5), "a", Y, R, rng=rng())
    assert shift.__annotations__ == annotations


def test_calls_inside_a_user_s_update_are_checked() -> None:
    """Validation is skipped in the library's own calls only."""

    @updates.update
    def transform(x: Any, h: Any, y: Any, r: Any, *, rng: Any) -> Any:
        return transform_ensemble(x, np.full(len(x), np.nan), solver="simplex")

    x = members(5)
    inflated = updates.with_inflation(transform, factor=1.1)
    # "simplex" is no solver: the mistake is the user's, in every wrapper.
    for update in (transform, inflated, partial(updates.with_missing, inflated)):
        with pytest.raises(ValueError, match="^solver must"):
            update(x, x @ H.T, Y, R, rng=rng())


# --------------------------------------------------------------------------- one by one


def test_serial_updates_without_a_sensor_are_exact_for_linear_observations() -> None:
    """The moments of the Kalman filter, for independent and for correlated noise.

    There are two ensembles, and components whose noise is correlated in one of them stay
    together in both.
    """
    x = members(20, 2)
    diagonal = np.diag([0.5, 0.9])
    update = updates.serially(updates.enkf_exact)
    independent = np.stack([diagonal, 2 * diagonal])
    correlated = np.stack([diagonal, R])
    for noise in (independent, correlated):
        analysis = update(x, x @ H.T, [Y, Y], noise, rng=rng())
        for k in range(2):
            prior_mean, prior_cov = moments(x[k])
            mean, cov = kalman(prior_mean, prior_cov, H, noise[k], Y)
            assert np.allclose(analysis[k].mean(axis=0), mean, atol=1e-12)
            assert np.allclose(np.cov(analysis[k].T), cov, atol=1e-12)


def test_serial_updates_predict_again() -> None:
    """The second of two nonlinear observations is predicted from the members after the first."""

    def predict(e: np.ndarray) -> np.ndarray:
        return np.stack([e[:, 0] ** 2, np.exp(e[:, 0])], axis=1)

    x = members(30)
    y = np.array([1.5, 3.0])
    data = (x, predict(x), y, np.diag([0.5, 0.9]))
    update = updates.serially(ETKF)
    analysis = update(*data, rng=rng(), predict=predict)
    h = predict(x)[:, :1]
    first = ETKF(x, h, y[:1], [[0.5]], rng=rng())
    h = predict(first)[:, 1:]
    second = ETKF(first, h, y[1:], [[0.9]], rng=rng())
    assert np.allclose(analysis, second, atol=1e-13)
    # Predictions that move along with the members differ, since h is not linear.
    without_predict = update(*data, rng=rng())
    assert np.abs(without_predict - analysis).max() > 1e-3


# ------------------------------------------------------------------------------ forecasts


def test_exact_forecast_adds_q_exactly() -> None:
    """Mean and covariance of the forecast members, plus Q, to rounding."""
    phi = np.array([[1.0, 0.3], [0.0, 0.9]])
    q = np.array([[0.4, 0.1], [0.1, 0.2]])

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        # Nonlinear, and infinite from 50 on.
        return np.where(x < 50, x @ phi.T + 0.3 * x**2, np.inf)

    linear = Model(2, lambda x, t, dt: x @ phi.T, lambda t, dt: dt * q)
    nonlinear = replace(linear, transition=transition)
    x = members(12, 3)[..., :2]
    forecast = exact_forecast(x, nonlinear, 0.0, 0.5, rng=rng())
    steps = nonlinear.step(x, 0.0, 0.5)
    for k in range(3):
        expected = steps[k].mean(axis=0)
        assert np.allclose(forecast[k].mean(axis=0), expected, atol=1e-13)
        expected = np.cov(steps[k].T) + 0.5 * q
        assert np.allclose(np.cov(forecast[k].T), expected, atol=1e-12)
    # A failed ensemble does not change the draws of the others.
    x[1, 0] = 99.0
    with_failure = exact_forecast(x, nonlinear, 0.0, 0.5, rng=rng())
    assert np.array_equal(with_failure[::2], forecast[::2])
    assert np.isnan(with_failure[1]).all()


def test_stochastic_forecast_adds_q_on_average() -> None:
    """Phi P Phi' + Q within four standard errors of 100 000 members."""
    phi = np.array([[1.0, 0.3], [0.0, 0.9]])
    q = np.array([[0.4, 0.1], [0.1, 0.2]])
    model = Model(2, lambda x, t, dt: x @ phi.T, lambda t, dt: dt * q)
    x = members(100_000)[:, :2]
    forecast = updates.stochastic_forecast(x, model, 0.0, 0.5, rng=rng())
    propagated = phi @ np.cov(x.T) @ phi.T
    expected = propagated + 0.5 * q
    assert np.allclose(np.cov(forecast.T), expected, atol=0.03)


# ---------------------------------------------------------------------------- constraints

CIRCLE = norm_constraint([0, 1], length=1.2)
NOISE = np.array([[0.02, 0.005], [0.005, 0.03]])
OBSERVED = np.array([0.9, 0.7])
MOTION = ([0, 1], [2, 3])
EACH_UPDATE = pytest.mark.parametrize(
    "update", [updates.etpf, updates.enkf, updates.etkf]
)


def swings(*leading: int) -> np.ndarray:
    """Draw positions and velocities (*leading, 30, 4) of a pendulum near the circle."""
    normal = np.random.default_rng(0).standard_normal((*leading, 30, 4))
    return np.asarray([0.8, 0.6, 1.0, -1.0] + 0.15 * normal)


@EACH_UPDATE
def test_projection_and_retraction_follow_the_update(update: Update) -> None:
    """The wrapped update is the composition with `project` or `retract`."""
    x = swings(3)
    data = (x, x[..., :2], np.tile(OBSERVED, (3, 1)), NOISE)
    analysis = update(*data, rng=rng())
    options: Any = {"variant": "particle", "regularisation": 0.01}
    wrapped = updates.with_projection(update, CIRCLE, **options)
    projected = wrapped(*data, rng=rng())
    assert np.allclose(projected, project(analysis, CIRCLE, **options), atol=1e-14)
    assert np.abs(projected - analysis).max() > 1e-3
    wrapped = updates.with_retraction(update, CIRCLE, motion=MOTION)
    retracted = wrapped(*data, rng=rng())
    expected = retract(analysis, CIRCLE, motion=MOTION)
    assert np.allclose(retracted, expected, atol=1e-14)
    # Every member has the length of the circle's radius.
    radius = np.hypot(retracted[..., 0], retracted[..., 1])
    assert np.abs(radius - 1.2).max() <= 1e-14


@EACH_UPDATE
def test_augmentation_is_one_more_observation(update: Update) -> None:
    """|q|² is observed as L² = 1.44 with independent noise of the given deviation."""
    x = swings()
    positions = x[:, :2]
    squares = (positions**2).sum(axis=1)
    predicted = np.column_stack([positions, squares])
    # Block diagonal: R of the sensor, and σ² of the constraint
    noise = np.zeros((3, 3))
    noise[:2, :2] = NOISE
    noise[2, 2] = 0.2**2
    expected = update(x, predicted, [*OBSERVED, 1.44], noise, rng=rng())
    augmented = updates.with_augmentation(update, CIRCLE, std=0.2)
    analysis = augmented(x, positions, OBSERVED, NOISE, rng=rng())
    assert np.allclose(analysis, expected, atol=1e-12)


# --------------------------------------------------------------------------- localisation


def test_the_taper_is_a_correlation_that_ends_at_two_radii() -> None:
    """Its values by hand, its smooth joints, and no negative eigenvalue on a line or a ring."""
    values = gaspari_cohn(np.array([0.0, 1.0, 2.0, 3.0]))
    assert np.allclose(values, [1, 5 / 24, 0, 0], atol=1e-15)
    # The differences to both sides of a joint cancel up to a power of the step.
    step = 1e-3
    for joint, power in ((1.0, 1), (2.0, 3)):
        centre = gaspari_cohn(np.array(joint))
        sides = joint + np.array([-step, step])
        before, after = gaspari_cohn(sides) - centre
        assert abs(before + after) < step**power
    points = np.arange(40.0)
    on_line = np.abs(np.subtract.outer(points, points))
    on_ring = np.minimum(on_line, 40 - on_line)
    # A correlation matrix is positive semidefinite.
    for distance in (on_line, on_ring):
        taper = gaspari_cohn(distance / 5)
        assert np.linalg.eigvalsh(taper).min() > -1e-12


def test_a_single_observation_is_localised_by_a_tapered_gain() -> None:
    """x + rho K (y - h - zeta), with the gain multiplied by the taper component by component."""
    x = members(20)
    places = np.array([[0.0], [1.5], [7.0]])
    observation_places = np.array([[0.5]])
    # The perturbations that `enkf` draws with this seed, of variance R = 0.5
    zeta = np.sqrt(0.5) * rng(3).standard_normal((20, 1))
    distances = np.abs(places - observation_places)[:, 0]
    rho = gaspari_cohn(distances / 2)
    # The first component is observed: K = P e₁ / (P₁₁ + R).
    covariance = np.cov(x.T)
    innovation_variance = covariance[0, 0] + 0.5
    gain = rho * covariance[:, 0] / innovation_variance

    def update_with_seed(*data: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return updates.enkf(*data, rng=np.random.default_rng(3))

    local = updates.with_localization(
        update_with_seed,
        places=places,
        observation_places=observation_places,
        radius=2.0,
    )
    analysis = local(x, x[:, :1], [1.0], [[0.5]], rng=rng())
    innovations = 1.0 - x[:, :1] - zeta
    expected = x + innovations * gain
    assert np.allclose(analysis, expected, atol=1e-12)
    # The third component is farther than two radii.
    assert (analysis[:, 2] == x[:, 2]).all()


RING = [[0.0], [1.5], [7.0]]
"""Places of three components on a ring of length 8."""


def localize_on_ring(columns: list[int]) -> Update:
    """Return a localised update by observations of some components on the ring."""
    return updates.with_localization(
        ETKF,
        places=RING,
        observation_places=[RING[k] for k in columns],
        radius=2.0,
        period=8.0,
    )


@pytest.mark.parametrize("options", [{}, {"predict": lambda e: e[:, [0, 2]]}])
def test_localised_observations_on_a_ring_are_assimilated_in_turn(
    options: dict[str, Any],
) -> None:
    """The second observation meets the members, and their predictions, after the first."""
    x = members(20)
    y = np.array([1.0, -0.5])
    noise = np.diag([0.5, 0.9])
    update = localize_on_ring([0, 2])
    analysis = update(x, x[:, [0, 2]], y, noise, rng=rng(), **options)
    update_first = localize_on_ring([0])
    first = update_first(x, x[:, :1], y[:1], [[0.5]], rng=rng())
    update_second = localize_on_ring([2])
    second = update_second(first, first[:, 2:], y[1:], [[0.9]], rng=rng())
    assert np.allclose(analysis, second, atol=1e-12)


@pytest.mark.parametrize(
    ("columns", "y", "noise", "ratios"),
    [
        # From place 7 the others are 1 and 2.5 away, the shorter way round.
        ([2], [-0.5], [[0.9]], [0.5, 1.25, 0.0]),
        # Correlated observations in one place are one group.
        ([0, 0], [1.0, -0.5], R, [0.0, 0.75, 0.5]),
    ],
)
def test_distances_on_a_ring_are_the_shorter_way_round(
    columns: list[int], y: list[float], noise: np.ndarray, ratios: list[float]
) -> None:
    """The changes by a group are those of the update times the taper of these ratios."""
    x = members(20)
    data = (x, x[:, columns], y, noise)
    analysis = localize_on_ring(columns)(*data, rng=rng())
    rho = gaspari_cohn(np.array(ratios))
    change = ETKF(*data, rng=rng()) - x
    assert np.allclose(analysis - x, rho * change, atol=1e-12)


def test_places_whole_turns_apart_are_one_place() -> None:
    """Longitudes of 350° and -10°, and of 730° and 10°, beside a latitude without a period."""
    x = members(20)
    data = (x, x @ H.T, Y, R)
    places = np.array([[350.0, 3.0], [10.0, -2.0], [60.0, 0.0]])
    observed = np.array([[20.0, 1.0], [320.0, 0.0]])
    turns = 360.0 * np.array([[-1.0, 0.0], [2.0, 0.0], [0.0, 0.0]])
    results = []
    for shift, back in ((0 * turns, 0.0), (turns, 0.0), (turns, -720.0)):
        local = updates.with_localization(
            ETKF,
            places=places + shift,
            observation_places=observed + [back, 0.0],
            radius=40.0,
            period=[360.0, np.nan],
        )
        results.append(local(*data, rng=rng()))
    assert np.allclose(results[1], results[0], rtol=0, atol=1e-9)
    assert np.allclose(results[2], results[0], rtol=0, atol=1e-9)
