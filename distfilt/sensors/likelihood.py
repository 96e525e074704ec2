"""Sensors that are a likelihood p(y | x) of any form: counts, heavy tails, noise that varies."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Annotated

import numpy as np

from ..linalg import broadcast_leading
from ..periods import PeriodsArgument
from ..validation import (
    ALLOW_NAN,
    Array,
    PositiveInt,
    Rng,
    all_finite,
    call_user,
    check_array,
    validated,
)
from ..validation.checks import refuse_mask
from ..validation.first_use import is_first_use, mark_checked, needs_check
from .base import Sensor

__all__ = ["LikelihoodSensor"]

_MANY = 20
"""So many states show what kind of numbers a function returns."""


@dataclass(frozen=True, eq=False, init=False)
class LikelihoodSensor(Sensor):
    """A sensor whose observation has any density p(y | x), for filters of weighted members.

    :class:`~distfilt.filters.ParticleFilter`, :class:`~distfilt.filters.TransportFilter` and
    :class:`~distfilt.filters.LikelihoodConsensusFilter` weigh their members by it, with their
    threshold, jitter, rejuvenation and lag, and :class:`~distfilt.filters.GridFilter` its cells.
    The other families take the noise as Gaussian and refuse it.

    Parameters
    ----------
    dim : int
        Size m of an observation.
    log_likelihood : callable
        ``log_likelihood(x, y) -> log p(y | x)``, on states (..., d) and observations (..., m) with
        the same leading axes, to (...); minus infinity where y is impossible. It gets copies. A
        missing component of an observation is NaN; one that is missing altogether is not asked
        for. With all its factors, if the evidence is recorded.
    moments : callable, optional
        ``moments(x) -> (means, covariances)`` of the observation given the state, (..., m) and
        (..., m, m). A gate and the normalised innovation squared need it.
    sample : callable, optional
        ``sample(x, rng=rng) -> y``, (..., m): draws, for :meth:`observe`.
    kind : str
        A name, for tables and messages.
    periods : sequence of (float or None), or mapping, optional
        The period of each component of the observation that is circular, as of a
        :class:`~distfilt.sensors.Sensor`: its moments are then compared the shorter way round.

    Examples
    --------
    A counter, whose counts have a Poisson distribution with a rate of exp(x):

    >>> from scipy.special import gammaln
    >>> def log_poisson(x, y):
    ...     return (y * x - np.exp(x) - gammaln(y + 1))[..., 0]
    >>> def poisson_moments(x):
    ...     return np.exp(x), np.exp(x)[..., None]
    >>> counter = LikelihoodSensor(
    ...     1,
    ...     log_poisson,
    ...     moments=poisson_moments,
    ...     sample=lambda x, rng: rng.poisson(np.exp(x)),
    ... )
    >>> counter.observe([2.0], rng=np.random.default_rng(0))
    array([3.])

    A particle filter with a gate refuses a count that no particle expects:

    >>> from distfilt.filters import ParticleFilter
    >>> from distfilt.models import Model
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(1))
    >>> f = ParticleFilter(walk, [counter], gate_probability=0.999)
    >>> start = f.start(([1.0], [[0.2]]), rng=np.random.default_rng(0))
    >>> run = f.run(start, [1.0, 2.0, 3.0], [[[4.0], [90.0], [5.0]]])
    >>> run["mean"].values[:, 0, 0].round(1), run["rejected"].values[:, 0]
    (array([1.2, 1.1, 1.4]), array([0., 1., 0.]))

    Student's t in place of Gaussian noise, so that an outlier counts little, and noise that grows
    with the distance:

    >>> def log_student(x, y, scale=0.1, nu=3):
    ...     return -(nu + 1) / 2 * np.log1p((y - x)[..., 0] ** 2 / (nu * scale**2))
    >>> student = LikelihoodSensor(1, log_student)
    >>> def log_radar(x, y):
    ...     std = 0.1 + 0.05 * np.abs(x)
    ...     return (-(((y - x) / std) ** 2) / 2 - np.log(std))[..., 0]
    >>> radar = LikelihoodSensor(1, log_radar)
    >>> radar.evaluate([[1.0], [5.0]], [1.5]).round(2)
    array([ -3.66, -48.95])

    A compass with a von Mises distribution, for states with a circular component:

    >>> def log_von_mises(x, y):
    ...     return 25 * np.cos(y - x)[..., 0]
    >>> def compass_moments(x):
    ...     return x, np.full((*x.shape, 1), 0.04)
    >>> compass = LikelihoodSensor(
    ...     1, log_von_mises, moments=compass_moments, periods=(2 * np.pi,)
    ... )
    >>> turn = Model(
    ...     1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)), periods=(2 * np.pi,)
    ... )
    >>> f = ParticleFilter(turn, [compass], gate_probability=0.999)
    >>> start = f.start(([3.0], [[0.04]]), rng=np.random.default_rng(0))
    >>> f.run(start, [1.0], [[[-3.0]]])["mean"].values.ravel().round(1)
    array([3.1])
    """

    log_likelihood: Callable[[Array, Array], Array] = field(kw_only=True)
    moments: Callable[[Array], tuple[Array, Array]] | None = field(
        default=None, kw_only=True
    )
    sample: Callable[..., Array] | None = field(default=None, kw_only=True)

    def __init__(
        self,
        dim: PositiveInt,
        log_likelihood: Callable[[Array, Array], Array],
        *,
        moments: Callable[[Array], tuple[Array, Array]] | None = None,
        sample: Callable[..., Array] | None = None,
        kind: str = "likelihood",
        periods: PeriodsArgument = (),
    ) -> None:
        # The checks below refuse a wrong `dim`; until then `noise_cov` needs some size.
        is_integer = isinstance(dim, int | np.integer) and not isinstance(dim, bool)
        is_size = is_integer and dim > 0
        vars(self).update(
            dim=dim,
            log_likelihood=log_likelihood,
            moments=moments,
            sample=sample,
            kind=kind,
            periods=periods,
            # The parts of a Gaussian sensor; no filter that accepts this one asks for them.
            h=_refuse_to_predict,
            noise_cov=np.eye(dim if is_size else 1),
            residual_function=None,
            uses_previous=False,
            linear=None,
            derivative=None,
        )
        # The dataclass's own constructor is replaced, so that the other fields get their defaults
        # here.
        for item in fields(self):
            if item.name not in vars(self):
                vars(self)[item.name] = item.default
        self.__post_init__()

    @validated
    def predict(
        self,
        x: Annotated[Array, "... d"],
        previous: Annotated[Array, "... d"] | None = None,
    ) -> Array:
        """Return the mean observation of states (..., d), as (..., m), by `moments`."""
        mean, _cov = self.predict_moments(x)
        return mean

    @validated
    def predict_moments(self, x: Annotated[Array, "... d"]) -> tuple[Array, Array]:
        """Return mean (..., m) and covariance (..., m, m) of the observation of states (..., d)."""
        if self.moments is None:
            raise ValueError(
                f"moments must be a function for a gate, for nis or for a prediction by a sensor "
                f"of kind {self.kind!r}, got None"
            )
        # A copy, since a user's function might write into its argument.
        mean, cov = call_user(self.moments, x.copy())
        shape = (*x.shape[:-1], self.dim)
        mean = check_array(mean, "moments", shape)
        return mean, check_array(cov, "moments", (*shape, self.dim))

    @validated
    def observe(
        self,
        x: Annotated[Array, "... d"],
        *,
        rng: Rng,
        previous: Annotated[Array, "... d"] | None = None,
    ) -> Array:
        """Draw an observation of each of the states (..., d), as (..., m), by `sample`."""
        if self.sample is None:
            raise ValueError(
                f"sample must be a function to draw from a sensor of kind {self.kind!r}, got None"
            )
        # A copy, since a user's function might write into its argument.
        drawn = call_user(self.sample, x.copy(), rng=rng)
        drawn = check_array(drawn, "sample", (*x.shape[:-1], self.dim))
        return np.asarray(drawn, dtype=np.float64)

    @validated
    def evaluate(
        self,
        x: Annotated[Array, "... d"],
        observed: Annotated[Array, "... self.dim", ALLOW_NAN],
    ) -> Array:
        """Return log p(y | x) of states (..., d) and observations (..., m), as (...).

        Zero where all components of an observation are missing.
        """
        lead = broadcast_leading(x.shape[:-1], observed.shape[:-1], "observed")
        x = np.broadcast_to(x, (*lead, x.shape[-1]))
        observed = np.broadcast_to(observed, (*lead, self.dim))
        is_missing = np.asarray(np.isnan(observed).all(axis=-1))
        if is_missing.all():
            return np.zeros(lead)
        if is_missing.any():
            # The user's function gets a valid observation in place of a missing one; what it
            # returns there is replaced by zero.
            observed = np.where(
                is_missing[..., None], observed[~is_missing][0], observed
            )
        # Copies, since a user's function might write into its arguments.
        result = call_user(self.log_likelihood, x.copy(), observed.copy())
        refuse_mask(result, "log_likelihood")
        logs = np.asarray(result, dtype=np.float64)
        self._check_logs(logs, x, observed)
        self._warn_of_missing_logarithm(logs)
        return np.where(is_missing, 0.0, logs)

    def _warn_of_missing_logarithm(self, logs: Array) -> None:
        """Warn once if numbers (..., N) look like likelihoods whose logarithm is missing.

        Those of many states are never negative, and tiny for some beside the largest.
        """
        if logs.size < _MANY or logs.min() < 0 or not needs_check(self, "logarithm"):
            return
        least, largest = logs.min(), logs.max()
        # Likelihoods of many states differ by more than this factor.
        if least < 1e-3 * largest:
            mark_checked(self, "logarithm")
            warnings.warn(
                f"log_likelihood must return logarithms, got numbers from {least:g} to "
                f"{largest:g}, as likelihoods are: take np.log of them",
                RuntimeWarning,
                # The warning points at the call of evaluate(), above it and its validation.
                stacklevel=4,
            )

    def _check_logs(self, logs: Array, x: Array, observed: Array) -> None:
        """Refuse log-likelihoods of a wrong shape, or that are no numbers.

        They are (...), of states x (..., d) and observations (..., m).
        """
        lead = x.shape[:-1]
        if logs.shape != lead:
            raise ValueError(
                f"log_likelihood must return shape {lead} for states {x.shape} and observations "
                f"{observed.shape}, got {logs.shape}"
            )
        if not all_finite(logs) and (np.isnan(logs) | (logs == np.inf)).any():
            if np.isnan(observed[np.isnan(logs)]).any():
                raise ValueError(
                    "log_likelihood must return a number where a component of the observation "
                    "is missing (NaN), the likelihood of the others, got NaN"
                )
            raise ValueError(
                "log_likelihood must return numbers or minus infinity (impossible), got NaN or "
                "infinity"
            )
        # A function for one state may return the right shape with wrong numbers. For the last state
        # alone it must give the same as among all, up to the rounding of another order of sums.
        if lead and logs.size and is_first_use(self, "log_likelihood"):
            last = call_user(
                self.log_likelihood,
                x.reshape(-1, x.shape[-1])[-1].copy(),
                observed.reshape(-1, self.dim)[-1].copy(),
            )
            is_same = np.allclose(last, logs.ravel()[-1], rtol=1e-6, atol=1e-9)
            if not is_same:
                raise ValueError(
                    "log_likelihood must take many states at once, (..., d), components last "
                    "(x[..., 0], not x[0] or x[:, 0]), got one for other axes"
                )


def _refuse_to_predict(x: Array) -> Array:
    """Stand in for the observation function that a likelihood does not have."""
    raise ValueError("sensor must have Gaussian noise here, got a LikelihoodSensor")
