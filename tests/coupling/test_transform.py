"""The ensemble transform: identities, its correction, pieces and curved sets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from distfilt import coupling
from distfilt.coupling.transform import _choose_rows

_rng = np.random.default_rng


def _wrapped(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a - b + np.pi) % (2 * np.pi) - np.pi


def _case(
    seed: int, n: int = 40, d: int = 3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlated members far from the origin, log-weights, and the weights."""
    rng = _rng(seed)
    x = 5.0 + rng.standard_normal((n, d)) @ rng.standard_normal((d, d))
    logs = -0.5 * ((x[:, 0] - 5.5) / 0.5) ** 2
    w = np.exp(logs - logs.max())
    return x, logs, w / w.sum()


def _covariance(x: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
    w = np.full(len(x), 1 / len(x)) if w is None else w
    around = x - w @ x
    return around.T @ (w[:, None] * around)


@given(st.integers(0, 10_000), st.integers(1, 30), st.integers(1, 4))
def test_the_mean_is_the_weighted_mean(seed: int, n: int, d: int) -> None:
    x, logs, w = _case(seed, n, d)
    scale = np.abs(x).max()
    moved = coupling.transform_ensemble(x, logs)
    assert np.abs(moved.mean(axis=0) - w @ x).max() <= 1e-14 * scale
    t = coupling.transport_plans(x, logs)
    assert np.abs(t.sum(axis=1) - w).max() <= 1e-14
    assert np.abs(t.sum(axis=0) - 1 / n).max() <= 1e-14
    assert np.abs(moved - n * t.T @ x).max() <= 1e-13 * scale


def test_copies_do_not_leave_the_choice_to_rounding() -> None:
    """Ten copies of one member, then a move by rounding: without a rule for ties all differs."""
    x, logs, _ = _case(21)
    x[:10] = x[0]
    x[20:25] = x[20]
    reference = coupling.transform_ensemble(x, logs)
    for seed in range(10):
        nudged = x * (1 + 1e-15 * _rng(seed).standard_normal(x.shape))
        assert (
            np.abs(coupling.transform_ensemble(nudged, logs) - reference).max() < 1e-9
        )


def test_weights_that_underflow_and_weights_of_zero() -> None:
    x, logs, _ = _case(5)
    small, plain = (coupling.transform_ensemble(x, v) for v in (logs - 1e4, logs))
    assert np.allclose(small, plain, atol=1e-9)
    one = np.full(40, -np.inf)
    one[7] = -1e4
    assert np.abs(coupling.transform_ensemble(x, one) - x[7]).max() < 1e-13


def test_equal_weights_one_member_and_a_collapsed_ensemble_move_nobody() -> None:
    x, _, _ = _case(4)
    assert np.abs(coupling.transform_ensemble(x, np.zeros(40)) - x).max() < 1e-13
    assert (coupling.transform_ensemble([[3.0, 4.0]], [-5.0]) == [[3.0, 4.0]]).all()
    assert (coupling.transform_ensemble(np.ones((6, 2)), np.arange(6.0)) == 1).all()


@pytest.mark.parametrize("correct", [False, True])
def test_leading_axes_are_ensembles_of_their_own(correct: bool) -> None:
    x, logs = (
        np.stack(part) for part in list(zip(*map(_case, range(4)), strict=True))[:2]
    )
    batch = x.reshape(2, 2, 40, 3), logs.reshape(2, 2, 40)
    moved = coupling.transform_ensemble(*batch, correct=correct)
    alone = coupling.transform_ensemble(x[2], logs[2], correct=correct)
    assert np.allclose(moved[1, 0], alone, atol=1e-12)


@example(8, 4, 6)  # fewer members than components
@example(200, 40, 3)  # hardly any spread in one direction, before and after
@given(st.integers(0, 10_000), st.integers(20, 40), st.integers(1, 4))
def test_the_correction_gives_both_moments(seed: int, n: int, d: int) -> None:
    x, logs, w = _case(seed, n, d)
    w = (w + 0.05) / (
        w + 0.05
    ).sum()  # many members count, so that no direction is lost
    moved = coupling.transform_ensemble(x, np.log(w), correct=True)
    assert np.abs(moved.mean(axis=0) - w @ x).max() < 1e-12 * np.abs(x).max()
    p = _covariance(x, w)
    assert np.abs(_covariance(moved) - p).max() < 1e-12 * np.abs(p).max()
    plain = coupling.transform_ensemble(x, np.log(w))
    assert np.trace(_covariance(plain)) <= np.trace(p) + 1e-9 * np.trace(p)


def test_the_correction_is_the_symmetric_map() -> None:
    x, logs, w = _case(7)
    plain = coupling.transform_ensemble(x, logs)
    moved = coupling.correct_moments(plain, x, logs)
    a = plain - plain.mean(axis=0)
    b = moved - moved.mean(axis=0)
    matrix = np.linalg.lstsq(a, b, rcond=None)[0]
    assert np.abs(a @ matrix - b).max() < 1e-10
    assert (
        np.abs(matrix - matrix.T).max() < 1e-9 and np.linalg.eigvalsh(matrix).min() > 0
    )


@pytest.mark.parametrize(
    ("std", "place"),
    [
        ([1e3, 1e-3], [7e6, 0.0]),
        ([1e-6, 1e6], [0.0, 0.0]),
        ([1e3, 1e3, 1e3, 1e-3, 1e-3, 1e-3], [7e6, 0.0, 0.0, 0.0, 7e3, 0.0]),
    ],
)
def test_the_correction_in_any_units(std: list[float], place: list[float]) -> None:
    """A small unit beside a large one, far from zero, keeps its moments too."""
    x, logs, w = _case(11, 30, len(std))
    x = place + x * std
    moved = coupling.correct_moments(coupling.transform_ensemble(x, logs), x, logs)
    unit = np.outer(std, std)
    assert (np.abs(moved.mean(axis=0) - w @ x) < 1e-12 * (np.abs(place) + std)).all()
    assert np.abs((_covariance(moved) - _covariance(x, w)) / unit).max() < 1e-8


def test_the_correction_stretches_nothing_where_there_is_nothing() -> None:
    for seed in range(40):
        x, logs, _ = _case(seed, 12, 4)
        flat = x.copy()
        flat[:, 0] = 0.3
        moved = coupling.correct_moments(flat, x, logs)
        sizes = np.linalg.svd(moved - moved.mean(axis=0), compute_uv=False)
        assert sizes[3] < 1e-12 * sizes[0] and sizes[2] > 1e-6 * sizes[0]


def test_entropy_shrinks_and_debiasing_restores() -> None:
    x, logs, w = _case(9, 60, 2)
    entropic = {"solver": "entropic", "regularisation": 0.05}
    debiased = coupling.transform_ensemble(x, logs, debias=True, **entropic)
    biased, plain = (coupling.transform_ensemble(x, logs, **o) for o in (entropic, {}))
    kept = [np.trace(_covariance(e)) for e in (biased, debiased, plain)]
    assert kept[0] < 0.7 * kept[2] and abs(kept[1] - kept[2]) < 0.5 * (
        kept[2] - kept[0]
    )
    assert np.abs(debiased.mean(axis=0) - w @ x).max() < 1e-13
    free = biased + x - coupling.transform_ensemble(x, np.zeros(60), **entropic)
    assert np.allclose(debiased, free + w @ x - free.mean(axis=0))
    with pytest.warns(RuntimeWarning, match="must be logarithms, got numbers with a sum of 1"):
        coupling.transform_ensemble(x, w)


def test_rejuvenation_keeps_the_mean_and_adds_its_share() -> None:
    x, logs, _ = _case(10, 60, 3)
    copies = np.tile(x.mean(axis=0), (4000, 60, 1))
    added = coupling.rejuvenate(
        copies, np.tile(x, (4000, 1, 1)), bandwidth=0.2, rng=_rng(11)
    )
    assert np.abs(added.mean(axis=1) - x.mean(axis=0)).max() < 1e-12
    spread = added - copies
    cov = np.einsum("rni,rnj->ij", spread, spread) / (4000 * 60)
    expected = 0.04 * np.cov(x.T)
    assert np.abs(cov - expected).max() < 0.01 * np.abs(expected).max()
    assert (coupling.rejuvenate(x, x, bandwidth=0.0, rng=_rng()) == x).all()


def test_one_piece_is_the_transform_and_many_are_a_resampling() -> None:
    x, logs, _ = _case(12)
    whole = coupling.transform_within(x, logs, np.zeros(40, dtype=int), rng=_rng())
    assert np.allclose(whole, coupling.transform_ensemble(x, logs), atol=1e-13)
    drawn = coupling.transform_within(x, logs, np.arange(40), rng=_rng())
    assert np.abs(drawn[:, None] - x).sum(axis=-1).min(axis=1).max() < 1e-12


def test_pieces_choose_as_often_as_the_plan_says() -> None:
    """Over 4000 draws each column's frequencies lie within five standard errors of its shares."""
    share = np.array([[0.2, 0.5, 1.0, 0.1], [0.3, 0.5, 0.0, 0.2], [0.5, 0.0, 0.0, 0.7]])
    rng = _rng(13)
    draws = np.array([_choose_rows(share, rng) for _ in range(4000)])
    for row in range(3):
        gap = (draws == row).mean(axis=0) - share[row]
        bound = 5 * np.sqrt(share[row] * (1 - share[row]) / 4000)
        assert (np.abs(gap) <= bound + 1e-12).all()
    totals = (draws == 0).sum(axis=1)
    assert set(totals) <= {1, 2}  # 1.8 on average


def test_pieces_keep_members_apart() -> None:
    rng = _rng(14)
    x = np.concatenate([rng.uniform(-2, -1, 25), rng.uniform(1, 2, 25)])[:, None]
    logs = np.where(x[:, 0] > 0, 0.7, 0.0) + 0.3 * x[:, 0]
    y = coupling.transform_within(x, logs, (x[:, 0] > 0).astype(int), rng=rng)
    assert (np.abs(y) >= 1).all()
    assert (
        np.abs(coupling.transform_ensemble(x, logs)) < 1
    ).any()  # what the pieces prevent


def test_along_a_flat_set_is_the_transform() -> None:
    x, logs, _ = _case(15)
    flat = coupling.transform_along(x, logs, difference=np.subtract, retract=np.add)
    assert np.allclose(flat, coupling.transform_ensemble(x, logs), atol=1e-12)
    stack = coupling.transform_along(
        np.stack([x, 2 * x]),
        np.stack([logs, logs]),
        difference=np.subtract,
        retract=np.add,
    )
    assert np.allclose(stack, [flat, 2 * flat], atol=1e-12)


def test_angles_across_the_cut() -> None:
    """Turning all angles turns the result, also where that puts the cut among them."""
    rng = _rng(16)
    angle = rng.normal(0.0, 0.5, (30, 1))
    logs = -4 * (angle[:, 0] - 0.3) ** 2
    options = {
        "difference": _wrapped,
        "retract": lambda x, v: _wrapped(x + v, np.zeros(1)),
    }
    reference = coupling.transform_along(angle, logs, **options)
    turned = coupling.transform_along(
        _wrapped(angle + 3.0, np.zeros(1)), logs, **options
    )
    assert np.abs(_wrapped(turned - 3.0, reference)).max() < 1e-12
    assert np.abs(turned).max() > 3.0
