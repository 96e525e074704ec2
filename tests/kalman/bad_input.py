"""Bad input that several filters of this folder have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from distfilt.sensors import differential, direct
from tests.kalman.problems import walk

_KF: dict[str, Any] = {"F": np.eye(2), "H": [[1.0, 0.0]], "Q": np.eye(2), "R": [[1.0]]}
_Y = np.zeros((3, 5, 1))
_COV = np.eye(2)
LOPSIDED = [[1.0, 0.5], [0.0, 1.0]]
INDEFINITE = [[1.0, 2.0], [2.0, 1.0]]


def _kf(filter_: Callable[..., Any], mean: Any = (0.0, 0.0), cov: Any = _COV,
        y: Any = _Y, **changed: Any) -> Any:
    return filter_(mean, cov, y, **{**_KF, **changed})


def linear_cases(f: Callable[..., Any]) -> list[tuple[str, Callable[[], Any]]]:
    return [
        ("mean", lambda: _kf(f, mean=[0.0, np.nan])),
        ("mean", lambda: _kf(f, mean=np.zeros((4, 2)))),
        ("cov", lambda: _kf(f, cov=np.eye(3))),
        ("cov", lambda: _kf(f, cov=LOPSIDED)),
        ("cov", lambda: _kf(f, cov=INDEFINITE)),
        ("observations", lambda: _kf(f, y=np.zeros(3))),
        ("observations", lambda: _kf(f, y=np.full((3, 1), np.inf))),
        ("F", lambda: _kf(f, F=np.ones((4, 2, 2)))),
        ("F", lambda: _kf(f, F=np.full((2, 2), np.nan))),
        ("H", lambda: _kf(f, H=np.eye(2))),
        ("Q", lambda: _kf(f, Q=-np.eye(2))),
        ("Q", lambda: _kf(f, Q=LOPSIDED)),
        ("R", lambda: _kf(f, R=[[0.0]])),
        ("R", lambda: _kf(f, R=[[-1.0]])),
    ]


def _series(
    filter_: Callable[..., Any], mean: Any = (0.0, 0.0), y: Any = _Y, **changed: Any
) -> Any:
    """A call of a filter with model and sensors; one argument of it is made wrong."""
    options: dict[str, Any] = {
        "cov": np.eye(2), "model": walk(2), "sensors": [direct([0], std=1.0)],
        "times": [1.0, 2.0, 3.0],
    }
    options.update(changed)
    return filter_(mean, options.pop("cov"), y, **options)


def series_cases(f: Callable[..., Any]) -> list[tuple[str, Callable[[], Any]]]:
    return [
        ("mean", lambda: _series(f, [np.nan, 0.0])),
        ("mean", lambda: _series(f, np.zeros(3), cov=np.eye(3))),
        ("mean", lambda: _series(f, np.zeros((4, 2)))),
        ("cov", lambda: _series(f, cov=np.eye(3))),
        ("cov", lambda: _series(f, cov=INDEFINITE)),
        ("model", lambda: _series(f, model=3)),
        ("observations", lambda: _series(f, y=np.zeros((3, 5, 2)))),
        ("observations", lambda: _series(f, y=np.full((3, 5, 1), np.inf))),
        ("observations", lambda: _series(f, y=np.zeros(3))),
        ("sensors", lambda: _series(f, sensors=[])),
        ("times", lambda: _series(f, times=[1.0, 1.0, 2.0])),
        ("times", lambda: _series(f, times=[0.0, 1.0, 2.0])),
        ("times", lambda: _series(f, times=[], y=np.zeros((0, 5, 1)))),
        ("t0", lambda: _series(f, t0=np.nan)),
    ]


def of_changes(f: Callable[..., Any]) -> tuple[str, Callable[[], Any]]:
    """The case of a sensor that needs the previous state."""
    return "sensors", lambda: _series(f, sensors=[differential([0], std=1.0)])


def with_option(f: Callable[..., Any], **option: Any) -> tuple[str, Callable[[], Any]]:
    """The case of one wrong option."""
    return next(iter(option)), lambda: _series(f, **option)
