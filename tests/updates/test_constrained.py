"""Constraints round any update: each wrapper against the parts it is made of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from distfilt.coupling import Constraint, norm, project, retract
from distfilt.updates import (
    augmented,
    clipped,
    ensemble_transform,
    inflated,
    known_noise,
    projected,
    retracted,
    square_root,
)
from distfilt.updates.door import stackable, unchecked

G = norm([0, 1], length=1.2)
R = np.array([[0.02, 0.005], [0.005, 0.03]])
Y = np.array([0.9, 0.7])
MOTION = ([0, 1], [2, 3])
INNER = pytest.mark.parametrize("inner", [ensemble_transform, known_noise, square_root])
_C = "distfilt.updates.constrained."
_TWO = Constraint(lambda x: x[..., :2], [0.0, 0.0])

BAD_INPUT: dict[str, list[tuple[str, Callable[[], object]]]] = {
    _C + "augmented": [
        ("update", lambda: augmented(3, G, std=0.1)),
        ("constraint", lambda: augmented(known_noise, 3, std=0.1)),
        ("std", lambda: augmented(known_noise, G, std=0.0)),
    ],
    _C + "projected": [
        ("update", lambda: projected(3, G)),
        ("constraint", lambda: projected(known_noise, None)),
        ("reading", lambda: projected(known_noise, G, reading="as meant")),
        ("regularisation", lambda: projected(known_noise, G, regularisation=-1.0)),
    ],
    _C + "retracted": [
        ("update", lambda: retracted(3, G)),
        ("constraint", lambda: retracted(known_noise, 3)),
        ("tolerance", lambda: retracted(known_noise, G, tolerance=0.0)),
        ("iterations", lambda: retracted(known_noise, G, iterations=0)),
    ],
    _C + "clipped": [
        ("update", lambda: clipped(3, G)),
        ("constraint", lambda: clipped(known_noise, 3)),
        ("constraint", lambda: clipped(known_noise, _TWO)),
    ],
}


def _rng() -> np.random.Generator:
    return np.random.default_rng(1)


def _members(*leading: int) -> np.ndarray:
    x = np.random.default_rng(0).standard_normal((*leading, 30, 4))
    return np.asarray([0.8, 0.6, 1.0, -1.0] + 0.15 * x)


@INNER
def test_projection_follows_the_update(inner: Callable[..., np.ndarray]) -> None:
    x = _members()
    plain = inner(x, x[:, :2], Y, R, rng=_rng())
    out = projected(inner, G, reading="particle")(x, x[:, :2], Y, R, rng=_rng())
    assert np.allclose(out, project(plain, G, reading="particle"), atol=1e-14)
    assert np.abs(out - plain).max() > 1e-3


@INNER
def test_retraction_puts_members_on_the_manifold(inner: Callable[..., np.ndarray]) -> None:
    x = _members(3)
    y = np.tile(Y, (3, 1))
    out = retracted(inner, G, motion=MOTION)(x, x[..., :2], y, R, rng=_rng())
    plain = inner(x, x[..., :2], y, R, rng=_rng())
    assert np.allclose(out, retract(plain, G, motion=MOTION), atol=1e-14)
    assert np.abs(np.hypot(out[..., 0], out[..., 1]) - 1.2).max() <= 1e-14
    assert np.abs((out[..., :2] * out[..., 2:]).sum(axis=-1)).max() < 1e-13


@INNER
def test_augmentation_is_one_more_reading(inner: Callable[..., np.ndarray]) -> None:
    x = _members()
    both = np.column_stack([x[:, :2], (x[:, :2] ** 2).sum(axis=1)])
    noise = np.zeros((3, 3))
    noise[:2, :2], noise[2, 2] = R, 0.2**2
    expected = inner(x, both, [*Y, 1.44], noise, rng=_rng())
    out = augmented(inner, G, std=0.2)(x, x[:, :2], Y, R, rng=_rng())
    assert np.allclose(out, expected, atol=1e-12)


def test_augmentation_with_noise_of_its_own_for_each_ensemble() -> None:
    x, y = _members(2), np.tile(Y, (2, 1))
    update = augmented(ensemble_transform, G, std=0.2)
    out = update(x, x[..., :2], y, np.stack([R, 5 * R]), rng=_rng())
    alone = update(x[1], x[1, :, :2], Y, 5 * R, rng=_rng())
    assert np.allclose(out[1], alone, atol=1e-11)


@INNER
def test_clipping_follows_the_update(inner: Callable[..., np.ndarray]) -> None:
    x = _members()
    out = clipped(inner, norm([0, 1], length=1.0))(x, x[:, :2], Y, R, rng=_rng())
    plain = inner(x, x[:, :2], Y, R, rng=_rng())
    inside = np.hypot(*plain[:, :2].T) <= 1
    assert (out[inside] == plain[inside]).all() and (~inside).any()
    assert np.hypot(*out[:, :2].T).max() <= 1 + 1e-14


def test_wrappers_nest_and_stay_stackable() -> None:
    update = inflated(retracted(augmented(known_noise, G, std=0.1), G), factor=1.01)
    assert stackable(update)
    x = _members(2)
    y = np.tile(Y, (2, 1))
    assert (update(x, x[..., :2], y, R, rng=_rng())
            == unchecked(update)(x, x[..., :2], y, R, rng=_rng())).all()


def test_inputs_stay_as_they_were() -> None:
    x = _members()
    kept = x.copy()
    for wrapper in (projected(known_noise, G), retracted(known_noise, G),
                    augmented(known_noise, G, std=0.1), clipped(known_noise, G)):
        wrapper(x, x[:, :2], Y, R, rng=_rng())
    assert (x == kept).all()


def test_a_unit_quaternion_in_a_pose() -> None:
    x = np.random.default_rng(3).standard_normal((2, 40, 13))
    x[..., 9:] += [3.0, 0, 0, 0]
    update = retracted(known_noise, norm(range(9, 13)))
    out = update(x, x[..., 9:], np.tile([1.0, 0, 0, 0], (2, 1)), 0.1 * np.eye(4), rng=_rng())
    assert np.abs(np.linalg.norm(out[..., 9:], axis=-1) - 1).max() <= 1e-14
