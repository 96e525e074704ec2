"""Wrappers: functions that turn an update into another, and can be nested.

``with_inflation(serially(enkf), factor=1.02)`` is an update like any other, and so is
``with_projection(with_augmentation(etpf, g, std=0.1), g)``, Das and Bhattacharya's OTNLeqMA.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np

from .. import coupling
from ..coupling.constraints import Constraint, Motion
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    Indices,
    NonNegativeFloat,
    PositiveFloat,
    Rng,
    call_user,
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
    """Return an update followed by a change of the analysis members."""

    @wraps_update(update)
    def update_and_change(
        ensemble: Array,
        predicted: Array,
        observed: Array,
        noise: Array,
        *,
        rng: Rng,
        predict: Callable[[Array], Array] | None = None,
    ) -> Array:
        # Only an update that repredicts takes a function `predict`.
        options: dict[str, Any] = {"rng": rng}
        if predict is not None:
            options["predict"] = predict
        analysis = call_user(update, ensemble, predicted, observed, noise, **options)
        return change(analysis)

    vars(update_and_change)["repredicts"] = has_tag(update, "repredicts")
    return update_and_change


@validated
def with_inflation(
    update: Update, *, factor: Annotated[float, Bounds(at_least=0.5)]
) -> Update:
    """Multiply the analysis anomalies by a factor, the remedy for a spread that is too small.

    Parameters
    ----------
    update : callable
        Any update.
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
    """Project the analysis members by regression, equations (6)-(12), in every update.

    Parameters
    ----------
    update : callable
        Any update.
    constraint, variant, regularisation
        As for :func:`distfilt.coupling.project`.

    Returns
    -------
    callable
        An update; with :func:`etpf` it is OTNLeq. OTProj projects the reported members only and
        continues from the others: call :func:`distfilt.coupling.project` on recorded members.

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
        Any update.
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
    r"""Observe the constraint too, as a nearly perfect measurement, equation (13).

    Parameters
    ----------
    update : callable
        Any update.
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
        m = predicted.shape[-1]
        s = value.size
        # (h, g) is observed as (y*, d) with the covariance diag(R, std² I).
        g = constraint.residual(ensemble) + value
        target = np.broadcast_to(value, (*observed.shape[:-1], s))
        joint_noise = np.zeros((*noise.shape[:-2], m + s, m + s))
        joint_noise[..., :m, :m] = noise
        joint_noise[..., m:, m:] = std**2 * np.eye(s)
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
        Any update. It never gets more observations at once than the largest group has, so an
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
    return _one_by_one(update, None)


@validated
def with_localization(
    update: Update,
    *,
    places: Annotated[ArrayInput, "d k"],
    observation_places: Annotated[ArrayInput, "m k"],
    radius: PositiveFloat,
    period: PositiveFloat | None = None,
) -> Update:
    r"""Let each observation change near components only: for few members in a large space.

    Observations are assimilated one after the other, as by :func:`serially`. The change that one
    makes in a component at distance r is multiplied by Gaspari and Cohn's function of r over
    `radius`, which falls from 1 to 0.21 at one radius and to 0 at two. For updates by a gain with
    independent noise that multiplies the sample covariances by the same numbers: chance
    correlations of far components are left out.

    Parameters
    ----------
    update : callable
        An update whose draws belong to the observations: :func:`~distfilt.updates.enkf`, or
        ``partial(etkf, rotation="none")``; not a random rotation, which would mix the members of
        near components and not of far ones.
    places : array_like, (d, k)
        Coordinates of each component of the state.
    observation_places : array_like, (m, k)
        Coordinates of each component of all observations that an agent receives in a step, in the
        order of the sending agents. So they fit a single agent, or agents that all receive the
        same observations. Components may be NaN, but no observation may be absent.
    radius : float
        In the units of the coordinates.
    period : float, optional
        Length of a ring, along each coordinate, on which distances are the shorter way round.

    Notes
    -----
    G. Gaspari, S. E. Cohn, Quarterly Journal of the Royal Meteorological Society 125 (1999)
    723-757, equation (4.10); P. L. Houtekamer, H. L. Mitchell, Monthly Weather Review 129 (2001)
    123-137.

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
    """
    # Distances of all components (and of predictions, see `serially`) from each observation.
    points = np.concatenate([places, observation_places])
    distance = np.abs(points[:, None] - observation_places)
    if period is not None:
        distance = np.minimum(distance % period, -distance % period)
    ratio = np.linalg.norm(distance, axis=-1) / radius
    return _one_by_one(update, gaspari_cohn(ratio))


def gaspari_cohn(ratio: Array) -> Array:
    """Return the taper of covariances at ratios of distance to radius, zero from two on."""
    r = np.asarray(ratio)
    # (4.10): two polynomials of degree five, in Horner's form, that join smoothly at one.
    inside = 1 + r**2 * (-5 / 3 + r * (5 / 8 + r * (1 / 2 - r / 4)))
    outside = 4 + r * (-5 + r * (5 / 3 + r * (5 / 8 + r * (-1 / 2 + r / 12))))
    # At zero the other polynomial is used.
    with np.errstate(divide="ignore"):
        outside = outside - 2 / (3 * r)
    return np.asarray(np.where(r <= 1, inside, np.where(r < 2, outside, 0.0)))


def _one_by_one(update: Update, taper: Array | None) -> Update:
    """Return an update by groups of correlated observations in turn.

    The changes by each observation are multiplied by its column of `taper`, (d + m, m).
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
    ) -> Array:
        d = ensemble.shape[-1]
        if taper is not None:
            _check_taper(taper, d, predicted.shape[-1])
        # Predictions that are not made again move along, as components d to d + m of the state.
        carries_predictions = predict is None
        for turn, group in enumerate(_group_correlated(noise)):
            # The first group meets the filter's own predictions.
            if predict is not None and turn:
                predicted = call_user(predict, ensemble)
            state = ensemble
            if carries_predictions:
                state = np.concatenate([ensemble, predicted], axis=-1)
            analysis = with_missing(
                update,
                state,
                predicted[..., group],
                observed[..., group],
                noise[..., group[:, None], group],
                rng=rng,
            )
            if taper is not None:
                # x <- x + rho (x' - x); a group's component has its nearest observation's rho.
                rho = taper[: state.shape[-1], group].max(axis=-1)
                analysis = state + rho * (analysis - state)
            # The next group starts from here.
            ensemble = analysis[..., :d]
            if carries_predictions:
                predicted = analysis[..., d:]
        return ensemble

    tagged: Any = update_in_turn
    tagged.repredicts = True
    # Every observation keeps its column of the taper, also where others are missing.
    tagged.accepts_missing = taper is not None
    return update_in_turn


def _check_taper(taper: Array, d: int, m: int) -> None:
    """Raise an error unless there are coordinates for d components and m observations."""
    n_observed = taper.shape[1]
    n_state = len(taper) - n_observed
    if (n_state, n_observed) != (d, m):
        raise ValueError(
            f"places must have {d} rows and observation_places {m}, one for each "
            f"component and observation, got {n_state} and {n_observed}"
        )


def _group_correlated(noise: Array) -> list[Indices]:
    """Return the indices of observations with correlated noise, in the order of their first."""
    from scipy.sparse import csgraph, csr_array

    # Over a batch: observations that are correlated in any of its covariances stay together.
    correlated = (noise != 0).reshape(-1, *noise.shape[-2:]).any(axis=0)
    # Groups are the connected components of the graph of correlations.
    graph = csr_array(correlated)
    labels = csgraph.connected_components(graph, directed=False)[1]
    return [np.flatnonzero(labels == label) for label in dict.fromkeys(labels.tolist())]
