"""Wrappers: functions that turn an update into another, and can be nested.

``with_inflation(serially(enkf), factor=1.02)`` is an update like any other, and so is
``with_projection(with_augmentation(etpf, g, std=0.1), g)``, Das and Bhattacharya's OTNLeqMA.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal, NamedTuple, cast

import numpy as np

from .. import coupling
from ..coupling.constraints import Constraint, Motion
from ..linalg import cholesky, solve_lower
from ..sensors import Sensor
from ..validation import (
    ALLOW_NAN,
    Array,
    ArrayInput,
    Bounds,
    Indices,
    Mask,
    NonNegativeFloat,
    PositiveFloat,
    Rng,
    call_user,
    check_array,
    validated,
)
from .decorator import Update, has_tag, with_missing, wraps_update

__all__ = [
    "with_augmentation",
    "with_inflation",
    "with_localization",
    "with_projection",
    "with_retraction",
    "serially",
]


def _apply_after(update: Update, change: Callable[[Array], Array]) -> Update:
    """Return an update followed by a change of the analysis members (..., N, d)."""

    @wraps_update(update)
    def update_and_change(
        ensemble: Array,
        predicted: Array,
        observed: Array,
        noise: Array,
        *,
        rng: Rng,
        predict: Callable[[Array], Array] | None = None,
        observation_places: Array | None = None,
    ) -> Array:
        # Options that the inner update does not declare must not be passed to it: `predict` is for
        # updates that predict anew after each observation, `observation_places` for localisation.
        options: dict[str, object] = {"rng": rng}
        if predict is not None:
            options["predict"] = predict
        if observation_places is not None:
            options["observation_places"] = observation_places
        analysis = call_user(update, ensemble, predicted, observed, noise, **options)
        return change(analysis)

    # Attributes from which a filter learns which options the update takes: see `has_tag`.
    for tag in ("repredicts", "locates"):
        vars(update_and_change)[tag] = has_tag(update, tag)
    vars(update_and_change)["locate"] = find_locate(update)
    return update_and_change


@validated
def with_inflation(
    update: Update, *, factor: Annotated[float, Bounds(at_least=0.5)]
) -> Update:
    """Multiply the analysis anomalies by a factor, the remedy for a spread that is too small.

    Parameters
    ----------
    update : callable
        An update.
    factor : float
        Factor of the analysis standard deviations in each update, at least 0.5.

    Notes
    -----
    J. L. Anderson, S. L. Anderson, Monthly Weather Review 127 (1999) 2741-2758.

    Examples
    --------
    >>> from distfilt.updates import enkf_exact
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> wider = with_inflation(enkf_exact, factor=2.0)
    >>> float(
    ...     wider(x, x, [1.0], [[0.5]], rng=np.random.default_rng(0))
    ...     .var(ddof=1)
    ...     .round(12)
    ... )
    1.0
    """

    def inflate(analysis: Array) -> Array:
        # x̄ + factor (x_i - x̄).
        mean = analysis.mean(axis=-2, keepdims=True)
        return np.asarray(mean + factor * (analysis - mean))

    return _apply_after(update, inflate)


@validated
def with_projection(
    update: Update,
    constraint: Constraint,
    *,
    variant: Literal["printed", "reversed", "particle", "shift"] = "shift",
    regularisation: NonNegativeFloat = 1e-6,
) -> Update:
    """Project the analysis members by regression in every update.

    Parameters
    ----------
    update : callable
        An update.
    constraint, variant, regularisation
        As for :func:`distfilt.coupling.project`.

    Returns
    -------
    callable
        An update; with :func:`etpf` it is the paper's OTNLeq. The paper's OTProj projects the
        reported members only and continues from the others: for it call
        :func:`distfilt.coupling.project` on recorded members.

    Notes
    -----
    Equations (6)-(12) of Das and Bhattacharya.

    Examples
    --------
    >>> from distfilt.coupling import norm_constraint
    >>> from distfilt.updates import etkf
    >>> x = 1.3 * np.array(
    ...     [[0.9, 0.2], [1.2, -0.2], [1.1, 0.3], [1.0, -0.1], [0.8, 0.1]]
    ... )
    >>> on = with_projection(etkf, norm_constraint([0, 1]))
    >>> after = on(x, x[:, 1:], [0.0], [[1.0]], rng=np.random.default_rng(0))
    >>> bool(
    ...     abs((after**2).sum(axis=1).mean() - 1)
    ...     < abs((x**2).sum(axis=1).mean() - 1) / 3
    ... )
    True
    """

    def project(analysis: Array) -> Array:
        return coupling.project(
            analysis, constraint, variant=variant, regularisation=regularisation
        )

    return _apply_after(update, project)


@validated
def with_retraction(
    update: Update, constraint: Constraint, *, motion: Motion | None = None
) -> Update:
    """Retract every analysis member to the constraint, each by itself.

    Parameters
    ----------
    update : callable
        An update.
    constraint, motion
        As for :func:`distfilt.coupling.retract`; with `motion` the velocities become tangent.

    Returns
    -------
    callable
        An update whose members satisfy the constraint to rounding. Their mean does not: a point
        estimate has to be retracted too.

    Examples
    --------
    >>> from distfilt.coupling import norm_constraint
    >>> from distfilt.updates import etkf
    >>> x = 1.3 * np.array(
    ...     [[0.9, 0.2], [1.2, -0.2], [1.1, 0.3], [1.0, -0.1], [0.8, 0.1]]
    ... )
    >>> on = with_retraction(etkf, norm_constraint([0, 1]))
    >>> after = on(x, x[:, 1:], [0.0], [[1.0]], rng=np.random.default_rng(0))
    >>> bool(abs((after**2).sum(axis=1) - 1).max() < 1e-14)
    True
    """

    def retract(analysis: Array) -> Array:
        return coupling.retract(analysis, constraint, motion=motion)

    return _apply_after(update, retract)


@validated
def with_augmentation(
    update: Update, constraint: Constraint, *, std: PositiveFloat
) -> Update:
    r"""Observe the constraint too, as a nearly perfect measurement: Das and Bhattacharya, (13).

    Parameters
    ----------
    update : callable
        An update.
    constraint : Constraint
        :math:`\mathbf g(\mathbf x)=\mathbf d`.
    std : float
        Standard deviation of the pretended noise, in the units of g, positive.

    Returns
    -------
    callable
        An update; with :func:`etpf` it is OTMA.

    Examples
    --------
    >>> from distfilt.coupling import norm_constraint
    >>> from distfilt.updates import etkf
    >>> x = 1.3 * np.array(
    ...     [[0.9, 0.2], [1.2, -0.2], [1.1, 0.3], [1.0, -0.1], [0.8, 0.1]]
    ... )
    >>> knows = with_augmentation(etkf, norm_constraint([0, 1]), std=0.01)
    >>> after = knows(x, x[:, 1:], [0.0], [[1.0]], rng=np.random.default_rng(0))
    >>> bool(
    ...     abs((after**2).sum(axis=1) - 1).mean()
    ...     < abs((x**2).sum(axis=1) - 1).mean() / 5
    ... )
    True
    """
    value = constraint.value

    @wraps_update(update)
    def augment(
        ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: Rng
    ) -> Array:
        # m observations and s constraints
        m = predicted.shape[-1]
        s = value.size
        # (h, g) is observed as (y*, d) with the covariance diag(R, std² I).
        g = constraint.residual(ensemble) + value
        target = np.broadcast_to(value, (*observed.shape[:-1], s))
        joint_noise = np.zeros((*noise.shape[:-2], m + s, m + s))
        joint_noise[..., :m, :m] = noise
        joint_noise[..., m:, m:] = std**2 * np.eye(s)
        # One update by both
        analysis = call_user(
            update,
            ensemble,
            np.concatenate([predicted, g], axis=-1),
            np.concatenate([observed, target], axis=-1),
            joint_noise,
            rng=rng,
        )
        return np.asarray(analysis)

    return augment


@validated
def serially(update: Update) -> Update:
    """Assimilate independent observations one after the other.

    Observations are independent where the noise covariance has a zero between them; correlated
    ones stay together. In a filter each group meets predictions that are made again from the
    members as they are by then, also if the update is wrapped once more by
    :func:`with_inflation`, :func:`with_projection` or :func:`with_retraction`. Called without
    `predict`, the update moves the later predictions along with the members, as further
    components of the state.

    Parameters
    ----------
    update : callable
        An update. It never gets more observations at once than the largest group has, so an
        agent that receives more observations than it has members can still use
        :func:`~distfilt.updates.enkf_sampled_covariance`.

    Returns
    -------
    callable
        An update with one more option, ``predict(members) -> predicted``, which a filter passes.

    Examples
    --------
    >>> from distfilt.updates import enkf_exact
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> twice = serially(enkf_exact)
    >>> predicted = np.concatenate([x, x], axis=1)
    >>> after = twice(x, predicted, [1.0, 1.0], np.eye(2), rng=np.random.default_rng(0))
    >>> float(after.mean().round(12)), float(after.var(ddof=1).round(12))
    (0.5, 0.25)
    """
    return _apply_in_turn(update, find_taper=None)


Periods = PositiveFloat | Annotated[ArrayInput, "k", ALLOW_NAN]
"""The length of a ring along every axis, or one for each axis."""


@validated
def with_localization(
    update: Update,
    *,
    places: Annotated[ArrayInput, "d k"],
    observation_places: object,
    radius: PositiveFloat,
    period: Periods | None = None,
) -> Update:
    r"""Let each observation change near components only: for few members in a large space.

    Observations are assimilated one after the other, as by :func:`serially`. The change that one
    makes in a component at distance r is multiplied by Gaspari and Cohn's function of r over
    `radius`, which falls from 1 to 0.21 at one radius and to 0 at two. For updates by a gain
    that multiplies the sample covariances by the same numbers: chance correlations of far
    components are left out.

    Observations with correlated noise (by more than rounding, 1e-12) are whitened if they are in
    different places. Each is then
    a mixture :math:`\sum_jw_jh_j` of the observations that are correlated with it, whose
    covariance with component k is :math:`\sum_jw_j\rho_{kj}\operatorname{cov}(x_k,h_j)`.

    Parameters
    ----------
    update : callable
        An update whose draws belong to the observations: :func:`~distfilt.updates.enkf`, or
        ``partial(etkf, rotation="none")``; not a random rotation, which would mix the members of
        near components and not of far ones.
    places : array_like, (d, k)
        Coordinates of each component of the state.
    observation_places : mapping, callable, or array_like, (m, k)
        Where the observations are. In a filter: a mapping from each sensor to its place, (k,), or
        to the places of its components, (sensor.dim, k); or a function of the sensor, for sensors
        that move. Then observations may be missing or lost, and every agent may receive others.
        An array has the places of all observations that an agent receives in a step, in the order
        of the sending agents; it fits a single agent, or agents that all receive the same
        observations, none of which is absent. Components may be NaN.
    radius : float
        In the units of the coordinates.
    period : float or array_like, (k,), optional
        Length of a ring, along every coordinate or along each, on which distances are the shorter
        way round. NaN or infinity stands for a coordinate that does not return.

    Returns
    -------
    callable
        An update with two more options: ``predict``, as of :func:`serially`, and
        ``observation_places``, (m, k) or (..., m, k), which a filter passes.

    Notes
    -----
    G. Gaspari, S. E. Cohn, Quarterly Journal of the Royal Meteorological Society 125 (1999)
    723-757, equation (4.10); P. L. Houtekamer, H. L. Mitchell, Monthly Weather Review 129 (2001)
    123-137. The change by a mixture is regressed on its own change, as by J. L. Anderson, Monthly
    Weather Review 131 (2003) 634-642.

    Examples
    --------
    Two components, of which the first is observed; the second is too far away to change.

    >>> from distfilt.updates import enkf
    >>> near = with_localization(
    ...     enkf, places=[[0.0], [9.0]], observation_places=[[0.0]], radius=1.0
    ... )
    >>> x = np.array([[-1.0, -1.1], [1.0, 0.9]])
    >>> after = near(x, x[:, :1], [1.0], [[2.0]], rng=np.random.default_rng(0))
    >>> (after != x).any(axis=0)
    array([ True, False])

    On a ring of length 10 the second is near, from wherever it is counted.

    >>> for place in (9.0, -1.0, 11.0):
    ...     ring = with_localization(
    ...         enkf,
    ...         places=[[0.0], [place]],
    ...         observation_places=[[0.0]],
    ...         radius=1.0,
    ...         period=10.0,
    ...     )
    ...     print(
    ...         ring(x, x[:, :1], [1.0], [[2.0]], rng=np.random.default_rng(0))[
    ...             0
    ...         ].round(3)
    ...     )
    [-0.049 -0.902]
    [-0.049 -0.902]
    [-0.049 -0.902]

    Agents on a path, each of which receives its neighbours' observations only:

    >>> from distfilt.filters import EnsembleFilter
    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import component
    >>> still = Model(3, lambda x, t, dt: x, lambda t, dt: np.zeros((3, 3)))
    >>> sensors = [component([k], std=1.0) for k in range(3)]
    >>> local = with_localization(
    ...     enkf,
    ...     places=[[0.0], [5.0], [10.0]],
    ...     observation_places={s: [5.0 * k] for k, s in enumerate(sensors)},
    ...     radius=1.0,
    ... )
    >>> f = EnsembleFilter(still, sensors, graphs.path(3), update=local, members=20)
    >>> state = f.start((np.zeros(3), np.eye(3)), rng=np.random.default_rng(0))
    >>> after = f.step(state, 0.0, [[3.0], None, [3.0]])
    >>> (after.ensembles != state.ensembles).any(axis=1)
    array([[ True, False, False],
           [ True, False,  True],
           [False, False,  True]])
    """
    k = places.shape[1]
    periods = None if period is None else _check_periods(period, k)
    fixed: Array | None = None
    locate: Callable[[Sensor], Array] | None = None
    if isinstance(observation_places, Mapping) or callable(observation_places):
        locate = _make_locate(observation_places, k)
    else:
        fixed = check_array(observation_places, "observation_places", ("m", k))

    def find_taper(d: int, m: int, given: Array | None) -> Array:
        """Return the taper of components and predictions, (d + m, m) or (..., d + m, m)."""
        at = fixed if given is None else given
        if at is None:
            raise ValueError(
                "observation_places must be given with every call of an update whose places "
                "are those of sensors, got None"
            )
        _check_places(len(places), at.shape, d, m)
        # Places of all components, and of predictions, which are further components of the state
        # if they are not made again (see `serially`).
        lead = at.shape[:-2]
        components = np.broadcast_to(places, (*lead, *places.shape))
        points = np.concatenate([components, at], axis=-2)
        # Distances from each point to each observation, along each of the k axes.
        distance = np.abs(points[..., :, None, :] - at[..., None, :, :])
        if periods is not None:
            # On a ring the shorter of both ways round.
            distance = np.minimum(distance % periods, -distance % periods)
        return gaspari_cohn(np.linalg.norm(distance, axis=-1) / radius)

    local = _apply_in_turn(update, find_taper)
    # Tags by which a filter finds out that it has to pass the places, and where a sensor is.
    vars(local).update(locates=True, locate=locate)
    return local


def find_locate(update: Update) -> Callable[[Sensor], Array] | None:
    """Return the function of an update that gives a sensor's places, (sensor.dim, k), if any.

    >>> find_locate(print)
    """
    function = update.func if isinstance(update, partial) else update
    locate: Callable[[Sensor], Array] | None = getattr(function, "locate", None)
    return locate


def _check_periods(period: Array | float, k: int) -> Array:
    """Return a positive period for each of k axes, (k,), from one for all or one each.

    It is infinite where a coordinate does not return.
    """
    periods = np.broadcast_to(np.asarray(period, dtype=np.float64), (k,)).copy()
    periods[np.isnan(periods)] = np.inf
    if not (periods > 0).all():
        raise ValueError(f"period must be positive, got {periods.tolist()}")
    return periods


def _make_locate(
    given: Mapping[Sensor, object] | Callable[[Sensor], object], k: int
) -> Callable[[Sensor], Array]:
    """Return a function that gives the places (sensor.dim, k) of a sensor's components.

    A place is (k,). Given is a mapping from sensors to places, or a function of a sensor.
    """

    def locate(sensor: Sensor) -> Array:
        """Look the sensor up, or call the user's function; repeat one place for all components.

        The places are (sensor.dim, k).
        """
        if isinstance(given, Mapping):
            if sensor not in given:
                raise ValueError(
                    "observation_places must have a place for every sensor, got none for "
                    f"{sensor}"
                )
            value = given[sensor]
        else:
            value = call_user(given, sensor)
        place = np.asarray(check_array(value, "observation_places", (...,)))
        # One place for the sensor, or one for each component of its observation.
        if place.shape not in ((k,), (sensor.dim, k)):
            raise ValueError(
                f"observation_places must have shape ({k},) or ({sensor.dim}, {k}) for a "
                f"sensor, got {place.shape}"
            )
        return np.broadcast_to(place, (sensor.dim, k))

    return locate


def gaspari_cohn(ratio: Array) -> Array:
    """Return Gaspari and Cohn's taper of covariances at ratios (...) of distance to radius.

    It falls from 1 at zero to 0 at two and beyond: equation (4.10) of their paper, cited by
    :func:`with_localization`.
    """
    r = np.asarray(ratio)
    # Two functions in Horner's form, polynomials of degree five but for a term in 1/r, that join
    # smoothly at one.
    inside = 1 + r**2 * (-5 / 3 + r * (5 / 8 + r * (1 / 2 - r / 4)))
    outside = 4 + r * (-5 + r * (5 / 3 + r * (5 / 8 + r * (-1 / 2 + r / 12))))
    # At r = 0 this is infinite, but there the other one is used.
    with np.errstate(divide="ignore"):
        outside = outside - 2 / (3 * r)
    return np.asarray(np.where(r <= 1, inside, np.where(r < 2, outside, 0.0)))


_ROUNDING = 1e-12
"""Correlations of a localised update's observations that are rounding."""

Taper = Callable[[int, int, Array | None], Array]
"""``taper(d, m, observation_places)``: the factors of the changes, (..., d + m, m)."""


def _apply_in_turn(update: Update, find_taper: Taper | None) -> Update:
    """Return an update by groups of correlated observations, one after the other.

    With a taper, the changes by each observation are multiplied by its column of it.
    """

    @wraps_update(update)
    def update_in_turn(
        ensemble: Array,
        predicted: Array,
        observed: Array,
        noise: Array,
        *,
        rng: Rng,
        predict: Callable[[Array], Array] | None = None,
        observation_places: Annotated[ArrayInput, "... m k"] | None = None,
    ) -> Array:
        d = ensemble.shape[-1]
        # Factors (..., d + m, m) of the changes that each observation makes in each component of
        # the state, and in each prediction.
        taper: Array | None = None
        if find_taper is None and observation_places is not None:
            raise ValueError("observation_places must be None without a localisation")
        if find_taper is not None:
            taper = find_taper(d, predicted.shape[-1], observation_places)
        # An observation (..., m) that some member cannot predict counts as missing: NaN.
        is_predicted = ~np.isnan(predicted).any(axis=-2)
        usable = np.where(is_predicted, observed, np.nan)
        # Each turn is a group of observations that are assimilated together.
        turns = _plan_turns(usable, noise, taper)
        for number, turn in enumerate(turns):
            # The first group uses the filter's own predictions, later ones those of moved members.
            if predict is not None and number:
                predicted = call_user(predict, ensemble)
            state = ensemble
            # Without `predict` the predictions are updated too, as components d to d + m of the
            # state. For linear sensors and an update by a gain that is the same as to predict anew.
            if predict is None:
                state = np.concatenate([ensemble, predicted], axis=-1)
            analysis = turn.apply(update, state, predicted, taper, rng)
            # The analysis of this group is the forecast of the next.
            ensemble = analysis[..., :d]
            if predict is None:
                predicted = analysis[..., d:]
        return ensemble

    # Tags, attributes by which a filter knows how to call the update: it takes `predict`.
    vars(update_in_turn)["repredicts"] = True
    # The update takes NaN for missing observations itself: with a taper they must stay in the
    # array, so that every observation keeps its column of the taper.
    vars(update_in_turn)["accepts_missing"] = find_taper is not None
    return update_in_turn


@dataclass(frozen=True)
class _Group:
    """Observations that are assimilated together: correlated ones, or a single one.

    `indices` (g,) are their places among the m observations; `observed` (..., m) and `noise`
    (..., m, m) are those of all m.
    """

    indices: Indices
    observed: Array
    noise: Array

    def apply(
        self,
        update: Update,
        state: Array,
        predicted: Array,
        taper: Array | None,
        rng: Rng,
    ) -> Array:
        """Return the state (..., N, k) after the observations, its changes multiplied by the taper.

        The state has d components, and behind them m predictions if these are updated too. So has
        the taper of localisation, (..., d + m, m), which is 1 near an observation and 0 far from
        it. `predicted` is (..., N, m).
        """
        # The update gets these observations, and of them those that are not missing.
        group = self.indices
        analysis = with_missing(
            update,
            state,
            predicted[..., group],
            self.observed[..., group],
            self.noise[..., group[:, None], group],
            rng=rng,
        )
        if taper is None:
            return np.asarray(analysis)
        # x <- x + rho (x' - x). Observations of a group have one place, and so equal columns.
        rho = taper[..., None, : state.shape[-1], group[0]]
        return np.asarray(state + rho * (analysis - state))


class _TaperedMoments(NamedTuple):
    """N - 1 times the tapered moments of a combination of observations.

    Its covariances with the components of the state, (..., k), and its variance, (...).
    """

    cov: Array
    variance: Array


@dataclass(frozen=True)
class _Combination:
    """A combination of correlated observations in different places, made by whitening.

    Its value is sum_j w_j y_j over the g observations `indices`; its noise has unit variance and is
    independent of that of the other combinations.
    """

    indices: Indices
    weights: Array
    """(..., g)"""
    value: Array
    """(...,), NaN where the observation is missing."""

    def apply(
        self,
        update: Update,
        state: Array,
        predicted: Array,
        taper: Array | None,
        rng: Rng,
    ) -> Array:
        """Return the state after the observation, with the covariances multiplied by the taper.

        The combination z = sum_j w_j h_j has no place of its own. Each part h_j keeps its taper:
        the covariance of component k and z becomes sum_j w_j rho_kj cov(x_k, h_j), and the variance
        of z becomes sum_ij w_i w_j rho_ij cov(h_i, h_j). Arguments are those of
        :meth:`_Group.apply`.
        """
        # Combinations are made only where there is a taper, (..., d + m, m).
        taper = cast(Array, taper)
        # The predictions h_j (..., N, g) that are combined, and whether all of them exist, (...)
        parts, is_predicted = self._select_parts(predicted)
        combined = (self.weights[..., None, :] * parts).sum(axis=-1, keepdims=True)
        mean = combined.mean(axis=-2, keepdims=True)
        # Anomalies of the state and of the combination, (..., N, k) and (..., N, 1).
        x = state - state.mean(axis=-2, keepdims=True)
        z = combined - mean
        variance = (z * z).sum(axis=(-2, -1))
        # The tapered covariances of state and combination, (..., k), and the latter's tapered
        # variance, (...). All moments here are N - 1 times as large, which cancels.
        tapered = self._taper_moments(x, parts, taper)
        # Without variance there is no gain; NaN leaves the ensemble as it is.
        is_used = (variance > 0) & (tapered.variance > 0) & is_predicted
        target = np.where(is_used, self.value, np.nan)[..., None]
        # The update gets a prediction that is scaled to the tapered variance. It is also appended
        # to the state, so that its own change is known afterwards. The noise of a combination has
        # the variance 1.
        ratio = np.ones_like(variance)
        np.divide(tapered.variance, variance, out=ratio, where=is_used)
        z = np.sqrt(ratio)[..., None, None] * z
        prediction = mean + z
        extended = np.concatenate([state, prediction], axis=-1)
        analysis = with_missing(
            update, extended, prediction, target, np.eye(1), rng=rng
        )
        change = analysis - extended
        # An update by a gain changes member i by c_i cov(x, z) in every component, and z itself by
        # c_i var(z). That gives c_i, and the state then moves by the tapered covariance.
        n_state = state.shape[-1]
        divisor = np.where(is_used, tapered.variance, 1.0)[..., None, None]
        c = change[..., n_state:] / divisor
        by_gain = c * tapered.cov[..., None, :]
        # Other updates change the state by more than that. This remainder cannot be divided among
        # the parts j, so it gets their mean taper.
        remainder = change[..., :n_state] - c * (x.mT @ z).mT
        rho = taper[..., self.indices]
        mean_taper = self._average_taper(rho[..., :n_state, :])
        # The axis None is that of the members.
        return np.asarray(state + by_gain + mean_taper[..., None, :] * remainder)

    def _taper_moments(self, x: Array, parts: Array, taper: Array) -> _TaperedMoments:
        """Return the tapered moments of the combination of parts h_j (..., N, g).

        `x` (..., N, k) has the anomalies of the state: of its d components, and of the m
        predictions if these are updated too.
        """
        # rho of the parts, (..., d + m, g): the rows d and on are those of the observations.
        rho = taper[..., self.indices]
        d = taper.shape[-2] - taper.shape[-1]
        rho_of_state = rho[..., : x.shape[-1], :]
        rho_between = rho[..., d + self.indices, :]
        weights = self.weights[..., None, :]
        h = parts - parts.mean(axis=-2, keepdims=True)
        # sum_j w_j rho_kj cov(x_k, h_j)
        cov = (rho_of_state * weights * (x.mT @ h)).sum(axis=-1)
        # sum_ij w_i w_j rho_ij cov(h_i, h_j), which a taper may make negative.
        products = weights.mT * weights * rho_between * (h.mT @ h)
        variance = np.maximum(products.sum(axis=(-2, -1)), 0.0)
        return _TaperedMoments(cov, variance)

    def _select_parts(self, predicted: Array) -> tuple[Array, Mask]:
        """Return the g predictions (..., N, g) that are combined, and whether they exist (...).

        A prediction that does not exist is NaN. It does no harm if its observation is missing too,
        which has weight zero in the combinations of the others. Otherwise the combination is not
        observed, and all its predictions become zero.
        """
        parts = predicted[..., self.indices]
        has_weight = np.broadcast_to(self.weights[..., None, :] != 0, parts.shape)
        parts = np.where(has_weight, parts, 0.0)
        # Every prediction that has a weight exists, for all members.
        is_predicted = np.asarray(np.isfinite(parts).all(axis=(-2, -1)))
        return np.where(is_predicted[..., None, None], parts, 0.0), is_predicted

    def _average_taper(self, rho: Array) -> Array:
        """Return the mean (..., k) of the parts' tapers rho (..., k, g), weighted by w_j²."""
        weights = self.weights[..., None, :]
        squares = weights * weights
        return np.asarray((rho * squares).sum(axis=-1) / squares.sum(axis=-1))


def _plan_turns(
    observed: Array, noise: Array, taper: Array | None
) -> list[_Group | _Combination]:
    """Return what is assimilated in turn: groups in one place, and whitened observations.

    Observations are (..., m), their noise covariance (..., m, m), the taper (..., d + m, m).
    """
    turns: list[_Group | _Combination] = []
    # Correlations up to this one count as rounding. Groups are the observations (indices) that
    # larger ones connect.
    rounding = 0.0 if taper is None else _ROUNDING
    for group in _group_correlated(noise, rounding):
        # Observations in one place have the same taper: they can be assimilated together, as all
        # can be without a taper.
        if taper is None:
            is_one_place = True
        else:
            columns = taper[..., group]
            is_one_place = bool((columns == columns[..., :1]).all())
        if is_one_place:
            turns.append(_Group(group, observed, noise))
        else:
            # As many combinations of them with independent noise
            turns.extend(_whiten(group, observed[..., group], noise))
    return turns


def _whiten(group: Indices, observed: Array, noise: Array) -> list[_Combination]:
    """Return g combinations of g correlated observations, with independent noise of unit variance.

    `group` (g,) are their indices, `observed` (..., g) their values, NaN where missing; `noise`
    (..., m, m) is the covariance of all.
    """
    g = group.size
    covariance = noise[..., group[:, None], group]
    missing = np.isnan(observed)
    if missing.any():
        # A missing one gets a unit variance of its own.
        either = missing[..., :, None] | missing[..., None, :]
        covariance = np.where(either, np.eye(g), covariance)
    # W = L⁻¹ for R = L Lᵀ, so that W R Wᵀ = I.
    whitening = solve_lower(cholesky(covariance), np.eye(g))
    values = np.where(missing, 0.0, observed)
    mixed = (whitening @ values[..., None])[..., 0]
    mixed = np.where(missing, np.nan, mixed)
    return [
        _Combination(group, np.asarray(whitening[..., i, :]), mixed[..., i])
        for i in range(g)
    ]


def _check_places(n_state: int, shape: tuple[int, ...], d: int, m: int) -> None:
    """Raise an error unless there are coordinates for d components and m observations.

    The coordinates of components are `n_state` rows, and those of the observations have a shape
    (..., rows, k).
    """
    if (n_state, shape[-2]) != (d, m):
        raise ValueError(
            f"places must have {d} rows and observation_places {m}, one for each "
            f"component and observation, got {n_state} and {shape[-2]}: where observations "
            "are lost, or agents receive different ones, pass a mapping from each sensor to "
            "its place"
        )


def _group_correlated(noise: Array, rounding: float = 0.0) -> list[Indices]:
    """Return the indices of each group of observations with correlated noise.

    Groups are in the order of their first observations. `noise` (..., m, m) is the covariance of
    all; correlations up to `rounding` do not count.
    """
    from scipy.sparse import csgraph, csr_array

    stds = np.sqrt(np.diagonal(noise, axis1=-2, axis2=-1))
    least = rounding * stds[..., :, None] * stds[..., None, :]
    is_correlated = np.abs(noise) > least
    # Over a batch: observations that are correlated in any of its covariances stay together.
    in_any = is_correlated.reshape(-1, *noise.shape[-2:]).any(axis=0)
    # Groups are the connected components of the graph of correlations.
    graph = csr_array(in_any)
    _n_components, labels = csgraph.connected_components(graph, directed=False)
    # Each label once, in the order in which they first come.
    distinct_labels = dict.fromkeys(labels.tolist())
    return [np.flatnonzero(labels == label) for label in distinct_labels]
