"""Forecasts: how the members of an ensemble meet the model's noise."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..doors import Array, NonNegative, Rng, door, unchecked
from ..ensembles import anomalies, exact_noise
from ..models import Model
from .door import several

__all__ = ["exact_forecast", "sampled_forecast"]

Members = Annotated[Array, "... n model.dim"]


@door
def sampled_forecast(
    ensemble: Members, model: Model, t: float, dt: NonNegative, *, rng: Rng
) -> Array:
    """Move every member with the model and add an independent draw of the noise, (..., N, d).

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members at time `t`.
    model : Model
    t, dt : float
        From when, and how far, in s.
    rng : numpy.random.Generator

    Examples
    --------
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> sampled_forecast([[1.0], [2.0]], still, 0.0, 0.1, rng=np.random.default_rng(0)).ravel()
    array([1., 2.])
    """
    return unchecked(model.sample_step)(ensemble, t, dt, rng=rng)


@door
def exact_forecast(
    ensemble: Annotated[Members, several], model: Model, t: float, dt: NonNegative, *, rng: Rng
) -> Array:
    r"""Move the members and add noise that is exact to second order.

    The draws are centred, orthogonal to the moved members' anomalies, and have the sample
    covariance Q: for a linear model the sample covariance becomes
    :math:`\boldsymbol\Phi\mathbf P\boldsymbol\Phi^\top+\mathbf Q` to rounding.

    Parameters
    ----------
    ensemble, model, t, dt, rng
        As for :func:`sampled_forecast`; more members than d + the rank of Q.

    Examples
    --------
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> moved = exact_forecast(x, walk, 0.0, 0.5, rng=np.random.default_rng(0))
    >>> bool(abs(moved.mean()) < 1e-12), float(moved.var(ddof=1).round(12))
    (True, 1.0)
    """
    moved = unchecked(model.step)(ensemble, t, dt)
    q = model.noise(t, dt)
    if not q.any():
        return moved
    bad = ~np.isfinite(moved).all(axis=(-2, -1), keepdims=True)
    clean = np.where(bad, ensemble, moved)
    noisy = clean + exact(unchecked(anomalies)(clean), q, rng)
    # Members that the model lost stay lost, and do not take the others' noise with them.
    return np.where(bad, np.nan, noisy)


def exact(avoid: Array, cov: Array, rng: Rng) -> Array:
    """Exact draws, (..., N, k), that say of an update's ensemble if it has too few members."""
    try:
        return unchecked(exact_noise)(avoid, cov, rng=rng)
    except ValueError as error:
        raise ValueError(str(error).replace("anomalies_to_avoid", "ensemble")) from None
