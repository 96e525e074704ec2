"""The ensemble transform: identities, its correction, pieces and curved sets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from distfilt import coupling
from distfilt.coupling.transform import _choose_rows

_rng = np.random.default_rng


def _wrap_difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the difference of angles in [-pi, pi)."""
    return (a - b + np.pi) % (2 * np.pi) - np.pi


def _case(
    seed: int, n: int = 40, d: int = 3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return correlated members far from the origin, log-weights, and the weights."""
    rng = _rng(seed)
    normal = rng.standard_normal((n, d))
    x = 5.0 + normal @ rng.standard_normal((d, d))
    # The likelihood of an observation of the first component, 5.5 ± 0.5
    deviation = (x[:, 0] - 5.5) / 0.5
    logs = -0.5 * deviation**2
    weights = np.exp(logs - logs.max())
    return x, logs, weights / weights.sum()


def _covariance(x: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Return the weighted covariance with N in the denominator; equal weights by default."""
    if weights is None:
        weights = np.full(len(x), 1 / len(x))
    anomalies = x - weights @ x
    return anomalies.T @ (weights[:, None] * anomalies)


# --------------------------------------------------------------------------- identities


@given(st.integers(0, 10_000), st.integers(1, 30), st.integers(1, 4))
def test_the_mean_is_the_weighted_mean(seed: int, n: int, d: int) -> None:
    """x+ = N T' x for a plan T with the weights and 1/N as its marginals."""
    x, logs, weights = _case(seed, n, d)
    scale = np.abs(x).max()
    transformed = coupling.transform_ensemble(x, logs)
    mean_error = transformed.mean(axis=0) - weights @ x
    assert np.abs(mean_error).max() <= 1e-14 * scale
    plan = coupling.transport_plans(x, logs)
    row_error = plan.sum(axis=1) - weights
    column_error = plan.sum(axis=0) - 1 / n
    assert np.abs(row_error).max() <= 1e-14
    assert np.abs(column_error).max() <= 1e-14
    error = transformed - n * plan.T @ x
    assert np.abs(error).max() <= 1e-13 * scale


def test_copies_do_not_leave_the_choice_to_rounding() -> None:
    """Several plans are optimal then; a perturbation of the size of rounding keeps the plan."""
    x, logs, _ = _case(21)
    x[:10] = x[0]
    x[20:25] = x[20]
    reference = coupling.transform_ensemble(x, logs)
    for seed in range(10):
        rounding = 1e-15 * _rng(seed).standard_normal(x.shape)
        perturbed = x * (1 + rounding)
        transformed = coupling.transform_ensemble(perturbed, logs)
        assert np.abs(transformed - reference).max() < 1e-9


def test_weights_that_underflow_and_weights_of_zero() -> None:
    """Only differences of log-weights matter; one weight alone gives copies of its member."""
    x, logs, _ = _case(5)
    reference = coupling.transform_ensemble(x, logs)
    tiny = coupling.transform_ensemble(x, logs - 1e4)
    assert np.allclose(tiny, reference, atol=1e-9)
    single = np.full(40, -np.inf)
    single[7] = -1e4
    copies = coupling.transform_ensemble(x, single)
    assert np.abs(copies - x[7]).max() < 1e-13


def test_a_far_member_of_hardly_any_weight_counts_in_the_mean() -> None:
    """A weight of 5e-16 at 1e9 moves the mean of members about one by 5e-7."""
    x = _rng(22).standard_normal((21, 1))
    x[-1] = 1e9
    weights = np.append(np.linspace(1.0, 2.0, 20), 30 * 5e-16)
    weights /= weights.sum()
    transformed = coupling.transform_ensemble(x, np.log(weights))
    # By exact sums: of the members nearby, and of the far one
    mean = weights[:-1] @ x[:-1, 0] + weights[-1] * 1e9
    assert abs(transformed.mean() - mean) < 1e-9


def test_ensembles_that_the_transform_does_not_change() -> None:
    """Equal weights, one member, and members that coincide."""
    x, _, _ = _case(4)
    # The cheapest plan between equal masses at equal places moves nothing.
    with_equal_weights = coupling.transform_ensemble(x, np.zeros(40))
    assert np.abs(with_equal_weights - x).max() < 1e-13
    single = coupling.transform_ensemble([[3.0, 4.0]], [-5.0])
    assert (single == [[3.0, 4.0]]).all()
    coinciding = coupling.transform_ensemble(np.ones((6, 2)), np.arange(6.0))
    assert (coinciding == 1).all()


@pytest.mark.parametrize("correct", [False, True])
def test_leading_axes_are_separate_ensembles(correct: bool) -> None:
    """An ensemble of a batch is transformed as if it were the only one."""
    cases = [_case(seed) for seed in range(4)]
    x = np.stack([case[0] for case in cases])
    logs = np.stack([case[1] for case in cases])
    batch_x = x.reshape(2, 2, 40, 3)
    batch_logs = logs.reshape(2, 2, 40)
    batch = coupling.transform_ensemble(batch_x, batch_logs, correct=correct)
    # Ensemble 2 is entry (1, 0) of the batch.
    single = coupling.transform_ensemble(x[2], logs[2], correct=correct)
    assert np.allclose(batch[1, 0], single, atol=1e-12)


# ------------------------------------------------------------------------ the correction


@example(8, 4, 6)  # fewer members than components
@example(200, 40, 3)  # hardly any spread in one direction, before and after
@given(st.integers(0, 10_000), st.integers(20, 40), st.integers(1, 4))
def test_the_correction_gives_both_moments(seed: int, n: int, d: int) -> None:
    """Mean and covariance are the weighted ones; without it the covariance is smaller."""
    x, _, weights = _case(seed, n, d)
    # Many members have a weight, so that no direction is lost.
    weights = weights + 0.05
    weights = weights / weights.sum()
    logs = np.log(weights)
    corrected = coupling.transform_ensemble(x, logs, correct=True)
    mean_error = np.abs(corrected.mean(axis=0) - weights @ x).max()
    scale = np.abs(x).max()
    assert mean_error < 1e-12 * scale
    p = _covariance(x, weights)
    covariance_error = np.abs(_covariance(corrected) - p).max()
    assert covariance_error < 1e-12 * np.abs(p).max()
    # Members are averages of the prior's: Jensen's inequality for the trace.
    transformed = coupling.transform_ensemble(x, logs)
    trace = np.trace(p)
    assert np.trace(_covariance(transformed)) <= trace + 1e-9 * trace


def test_the_correction_is_the_symmetric_map() -> None:
    """The matrix between the anomalies before and after, by least squares, is positive definite."""
    x, logs, _ = _case(7)
    transformed = coupling.transform_ensemble(x, logs)
    corrected = coupling.correct_moments(transformed, x, logs)
    before = transformed - transformed.mean(axis=0)
    after = corrected - corrected.mean(axis=0)
    matrix = np.linalg.lstsq(before, after, rcond=None)[0]
    # One linear map moves all members exactly.
    assert np.abs(before @ matrix - after).max() < 1e-10
    assert np.abs(matrix - matrix.T).max() < 1e-9
    assert np.linalg.eigvalsh(matrix).min() > 0


@pytest.mark.parametrize(
    ("std", "offset"),
    [
        ([1e3, 1e-3], [7e6, 0.0]),
        ([1e-6, 1e6], [0.0, 0.0]),
        ([1e3, 1e3, 1e3, 1e-3, 1e-3, 1e-3], [7e6, 0.0, 0.0, 0.0, 7e3, 0.0]),
    ],
)
def test_the_correction_in_any_units(std: list[float], offset: list[float]) -> None:
    """A small unit beside a large one, far from zero, gets its moments too."""
    x, logs, weights = _case(11, 30, len(std))
    x = offset + x * std
    transformed = coupling.transform_ensemble(x, logs)
    corrected = coupling.correct_moments(transformed, x, logs)
    mean_error = np.abs(corrected.mean(axis=0) - weights @ x)
    # The accuracy of a component is that of its own size, not of the largest one.
    assert (mean_error < 1e-12 * (np.abs(offset) + std)).all()
    error = _covariance(corrected) - _covariance(x, weights)
    relative_error = error / np.outer(std, std)
    assert np.abs(relative_error).max() < 1e-8


def test_the_correction_does_not_stretch_rounding() -> None:
    """A direction without any spread in the transformed members stays without."""
    for seed in range(40):
        x, logs, _ = _case(seed, 12, 4)
        flat = x.copy()
        flat[:, 0] = 0.3
        corrected = coupling.correct_moments(flat, x, logs)
        anomalies = corrected - corrected.mean(axis=0)
        sizes = np.linalg.svd(anomalies, compute_uv=False)
        # Rank three: the fourth direction has only rounding, the third is real.
        assert sizes[3] < 1e-12 * sizes[0]
        assert sizes[2] > 1e-6 * sizes[0]


# ------------------------------------------------------------- the distance as the cost


@pytest.mark.parametrize("seed", range(4))
def test_with_the_distance_mass_stays_where_it_may(seed: int) -> None:
    """By the triangle inequality min(w_i, 1/N) stays; the cost is that of the programme."""
    x, logs, weights = _case(seed)
    plan = coupling.transport_plans(x, logs, cost="distance")
    staying = np.diagonal(plan)
    most = np.minimum(weights, 1 / 40)
    assert np.abs(staying - most).max() < 1e-15
    distances = np.sqrt(coupling.squared_distances(x))
    optimal = coupling.transport_plan(distances, weights)
    # The addition that decides ties may cost 1e-7 of the range.
    cost = (plan * distances).sum()
    assert abs(cost - optimal.value) < 1e-7 * distances.max()
    by_square = coupling.transport_plans(x, logs)
    cost_by_square = (by_square * distances).sum()
    assert cost_by_square > 1.01 * optimal.value
    transformed = coupling.transform_ensemble(x, logs, cost="distance")
    assert np.allclose(transformed, 40 * plan.T @ x, rtol=0, atol=1e-12)


def test_copies_do_not_leave_the_choice_to_rounding_with_the_distance() -> None:
    """Ten coinciding members, perturbed by rounding, give the same plan."""
    x, logs, _ = _case(6)
    # Most pairs coincide.
    x[:30] = x[0]
    reference = coupling.transport_plans(x, logs, cost="distance")
    for seed in range(5):
        rounding = 1e-15 * _rng(seed).standard_normal(x.shape)
        perturbed = x * (1 + rounding)
        plan = coupling.transport_plans(perturbed, logs, cost="distance")
        assert np.abs(plan - reference).max() < 1e-9


def test_the_loss_of_spread_vanishes_for_the_square_only() -> None:
    """With the distance averages mix mass from far apart however many members there are."""
    lost = {}
    for n in (50, 400):
        x = _rng(n).standard_normal((n, 2))
        logs = -2 * (1.0 - x[:, 0]) ** 2
        likelihood = np.exp(logs)
        weights = likelihood / likelihood.sum()
        before = np.trace(_covariance(x, weights))
        for cost in ("squared", "distance"):
            after = coupling.transform_ensemble(x, logs, cost=cost)
            left = np.trace(_covariance(after))
            lost[cost, n] = 1 - left / before
    assert lost["squared", 400] < 0.4 * lost["squared", 50]
    assert lost["distance", 400] > 0.6 * lost["distance", 50]
    assert lost["distance", 400] > 5 * lost["squared", 400]


# ------------------------------------------------------------- entropy and rejuvenation


def test_entropy_shrinks_the_ensemble_and_debiasing_restores_it() -> None:
    """By the displacement under equal weights, with the mean put right again."""
    x, logs, weights = _case(9, 60, 2)
    entropic: dict[str, Any] = {"solver": "entropic", "regularisation": 0.05}
    exact = coupling.transform_ensemble(x, logs)
    biased = coupling.transform_ensemble(x, logs, **entropic)
    debiased = coupling.transform_ensemble(x, logs, debias=True, **entropic)
    exact_variance = np.trace(_covariance(exact))
    biased_variance = np.trace(_covariance(biased))
    debiased_variance = np.trace(_covariance(debiased))
    assert biased_variance < 0.7 * exact_variance
    loss = exact_variance - biased_variance
    assert abs(debiased_variance - exact_variance) < 0.5 * loss
    mean_error = debiased.mean(axis=0) - weights @ x
    assert np.abs(mean_error).max() < 1e-13
    # Without regularisation equal weights would move nothing: x - T(x) is the bias.
    unweighted = coupling.transform_ensemble(x, np.zeros(60), **entropic)
    expected = biased + x - unweighted
    expected += weights @ x - expected.mean(axis=0)
    assert np.allclose(debiased, expected)


def test_debiasing_takes_off_the_displacement_of_the_same_cost() -> None:
    """Equal weights then move nothing, whatever the cost."""
    x, logs, weights = _case(9, 60, 2)
    options: dict[str, Any] = {"solver": "entropic", "regularisation": 0.05}
    for cost in ("squared", "distance"):
        options["cost"] = cost
        still = coupling.transform_ensemble(x, np.zeros(60), debias=True, **options)
        assert np.allclose(still, x, rtol=0, atol=1e-12)
        biased = coupling.transform_ensemble(x, logs, **options)
        unweighted = coupling.transform_ensemble(x, np.zeros(60), **options)
        expected = biased + x - unweighted
        expected += weights @ x - expected.mean(axis=0)
        debiased = coupling.transform_ensemble(x, logs, debias=True, **options)
        assert np.allclose(debiased, expected, rtol=0, atol=1e-12)


def test_weights_in_place_of_logarithms_warn() -> None:
    """They are nonnegative and sum to one."""
    x, _, weights = _case(9, 60, 2)
    message = "log_weights must be logarithms, got numbers from"
    with pytest.warns(RuntimeWarning, match=message):
        coupling.transform_ensemble(x, weights)


def test_rejuvenation_keeps_the_mean_and_adds_covariance() -> None:
    """h² times the forecast's covariance, on average over 4000 draws."""
    x, _, _ = _case(10, 60, 3)
    copies = np.tile(x.mean(axis=0), (4000, 60, 1))
    forecast = np.tile(x, (4000, 1, 1))
    rejuvenated = coupling.rejuvenate(copies, forecast, bandwidth=0.2, rng=_rng(11))
    # The draws are centred in each ensemble.
    mean_error = rejuvenated.mean(axis=1) - x.mean(axis=0)
    assert np.abs(mean_error).max() < 1e-12
    noise = rejuvenated - copies
    covariance = np.einsum("rni,rnj->ij", noise, noise) / (4000 * 60)
    expected = 0.04 * np.cov(x.T)
    error = np.abs(covariance - expected).max()
    assert error < 0.01 * np.abs(expected).max()
    unchanged = coupling.rejuvenate(x, x, bandwidth=0.0, rng=_rng())
    assert (unchanged == x).all()


# -------------------------------------------------------------------------------- pieces


def test_one_piece_is_the_transform_and_many_are_a_resampling() -> None:
    """With a piece for every member each new member is a copy."""
    x, logs, _ = _case(12)
    labels = np.zeros(40, dtype=int)
    one_piece = coupling.transform_within(x, logs, labels, rng=_rng())
    transformed = coupling.transform_ensemble(x, logs)
    assert np.allclose(one_piece, transformed, atol=1e-13)
    resampled = coupling.transform_within(x, logs, np.arange(40), rng=_rng())
    distance = np.abs(resampled[:, None] - x).sum(axis=-1)
    to_nearest = distance.min(axis=1)
    assert to_nearest.max() < 1e-12


def test_pieces_are_chosen_with_the_plan_s_probabilities() -> None:
    """Over 4000 draws each frequency lies within five standard errors of its probability."""
    probabilities = np.array(
        [
            [0.2, 0.5, 1.0, 0.1],
            [0.3, 0.5, 0.0, 0.2],
            [0.5, 0.0, 0.0, 0.7],
        ]
    )
    rng = _rng(13)
    choices = np.array([_choose_rows(probabilities, rng) for _ in range(4000)])
    for row in range(3):
        p = probabilities[row]
        error = (choices == row).mean(axis=0) - p
        # The standard error of a frequency is √(p (1 - p) / n).
        standard_error = np.sqrt(p * (1 - p) / 4000)
        bound = 5 * standard_error
        assert (np.abs(error) <= bound + 1e-12).all()
    # Systematic: 1.8 columns on average, so one or two in every draw.
    totals = (choices == 0).sum(axis=1)
    assert set(totals) <= {1, 2}


def test_members_stay_in_their_pieces() -> None:
    """Of two intervals no average lies between them, unlike with the plain transform."""
    rng = _rng(14)
    negative = rng.uniform(-2, -1, 25)
    positive = rng.uniform(1, 2, 25)
    x = np.concatenate([negative, positive])[:, None]
    is_positive = x[:, 0] > 0
    logs = np.where(is_positive, 0.7, 0.0) + 0.3 * x[:, 0]
    pieces = is_positive.astype(int)
    within = coupling.transform_within(x, logs, pieces, rng=rng)
    assert (np.abs(within) >= 1).all()
    across = coupling.transform_ensemble(x, logs)
    assert (np.abs(across) < 1).any()


# --------------------------------------------------------------------------- curved sets


def test_along_a_flat_set_it_is_the_transform() -> None:
    """With differences and sums as tangent vectors and retraction, also in a batch."""
    x, logs, _ = _case(15)
    options: dict[str, Any] = {"difference": np.subtract, "retract": np.add}
    flat = coupling.transform_along(x, logs, **options)
    assert np.allclose(flat, coupling.transform_ensemble(x, logs), atol=1e-12)
    ensembles = np.stack([x, 2 * x])
    batch = coupling.transform_along(ensembles, np.stack([logs, logs]), **options)
    assert np.allclose(batch, [flat, 2 * flat], atol=1e-12)


def test_a_rotation_of_all_angles_rotates_the_result() -> None:
    """Also if it puts the cut at pi among the angles."""
    rng = _rng(16)
    angles = rng.normal(0.0, 0.5, (30, 1))
    logs = -4 * (angles[:, 0] - 0.3) ** 2
    zero = np.zeros(1)
    options: dict[str, Any] = {
        "difference": _wrap_difference,
        "retract": lambda x, v: _wrap_difference(x + v, zero),
    }
    reference = coupling.transform_along(angles, logs, **options)
    rotated_angles = _wrap_difference(angles + 3.0, zero)
    rotated = coupling.transform_along(rotated_angles, logs, **options)
    error = _wrap_difference(rotated - 3.0, reference)
    assert np.abs(error).max() < 1e-12
    # Some angles are indeed beside the cut.
    assert np.abs(rotated).max() > 3.0
