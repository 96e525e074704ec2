"""Wrappers: what can be put around any update, one round another.

``inflated(serial(enkf), factor=1.02)`` is an update like any other, and so is
``projected(augmented(ensemble_transform, g, std=0.1), g)``, Das and Bhattacharya's OTNLeqMA.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np

from .. import coupling
from ..coupling.constraints import Constraint, Motion
from ..validation import (
    Array,
    Bounds,
    Indices,
    NonNegativeFloat,
    PositiveFloat,
    Rng,
    validated,
)
from .decorator import Update, around, has_tag, with_missing

__all__ = [
    "with_augmentation",
    "with_inflation",
    "with_localization",
    "with_projection",
    "with_retraction",
    "serially",
]


def _followed(update: Update, change: Callable[[Array], Array]) -> Update:
    """An update, and then what `change` makes of its members."""
    inner = update

    @around(update)
    def both(
        ensemble: Array,
        predicted: Array,
        observed: Array,
        noise: Array,
        *,
        rng: Rng,
        predict: Callable[[Array], Array] | None = None,
    ) -> Array:
        more = {} if predict is None else {"predict": predict}
        return change(inner(ensemble, predicted, observed, noise, rng=rng, **more))

    vars(both)["repredicts"] = has_tag(update, "repredicts")
    return both


@validated
def with_inflation(
    update: Update, *, factor: Annotated[float, Bounds(at_least=0.5)]
) -> Update:
    """Multiply the analysis anomalies by a factor: the remedy for a spread that is too small.

    Parameters
    ----------
    update, factor
        Any update; by what its standard deviations are multiplied each time, at least 0.5.

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

    def inflate(after: Array) -> Array:
        centre = after.mean(axis=-2, keepdims=True)
        return np.asarray(centre + factor * (after - centre))

    return _followed(update, inflate)


@validated
def with_projection(
    update: Update,
    constraint: Constraint,
    *,
    reading: Literal["printed", "reversed", "particle", "shift"] = "shift",
    regularisation: NonNegativeFloat = 1e-6,
) -> Update:
    """Project the analysis members by regression, equations (6)-(12), and go on from them.

    Parameters
    ----------
    update : callable
        Any update.
    constraint, reading, regularisation
        As for :func:`distfilt.coupling.project`.

    Returns
    -------
    callable
        An update; round :func:`ensemble_transform` it is OTNLeq. OTProj projects what is reported
        only: call :func:`distfilt.coupling.project` on recorded members.

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
    project = coupling.project
    return _followed(
        update,
        lambda x: project(
            x, constraint, reading=reading, regularisation=regularisation
        ),
    )


@validated
def with_retraction(
    update: Update, constraint: Constraint, *, motion: Motion | None = None
) -> Update:
    """Put every analysis member on the constraint by itself.

    Parameters
    ----------
    update : callable
        Any update.
    constraint, motion
        As for :func:`distfilt.coupling.retract`; with `motion` the velocities become tangent.

    Returns
    -------
    callable
        An update whose members obey the constraint to rounding. Their mean does not: a point
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
    retract = coupling.retract
    return _followed(update, lambda x: retract(x, constraint, motion=motion))


@validated
def with_augmentation(
    update: Update, constraint: Constraint, *, std: PositiveFloat
) -> Update:
    r"""Observe the constraint too, as a reading that is nearly perfect, equation (13).

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
        An update; round :func:`ensemble_transform` it is OTMA.

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
    inner = update
    g = constraint.residual

    @around(update)
    def augment(
        ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: Rng
    ) -> Array:
        m = predicted.shape[-1]
        s = constraint.value.size
        seen = np.concatenate([predicted, g(ensemble) + constraint.value], axis=-1)
        target = np.broadcast_to(constraint.value, (*observed.shape[:-1], s))
        both = np.zeros((*noise.shape[:-2], m + s, m + s))
        both[..., :m, :m] = noise
        both[..., m:, m:] = std**2 * np.eye(s)
        return inner(
            ensemble, seen, np.concatenate([observed, target], axis=-1), both, rng=rng
        )

    return augment


@validated
def serially(update: Update) -> Update:
    """Take independent readings in one after the other.

    Readings are independent where the noise covariance has a zero between them; correlated ones
    stay together. Inside a filter each group meets predictions that are made again from the members
    as they are by then, also where the members are changed once more (:func:`inflated`,
    :func:`projected`, :func:`retracted`); called alone, the update moves the later predictions
    along with the members, as further components of the state.

    Parameters
    ----------
    update : callable
        Any update; it never sees more readings at once than the largest group, so an agent that
        hears more than it has members can still use :func:`~distfilt.updates.enkf_sampled_covariance`.

    Returns
    -------
    callable
        An update with one more option, ``predict(members) -> predicted``, which a filter gives.

    Examples
    --------
    >>> from distfilt.updates import enkf_exact
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> twice = serially(enkf_exact)
    >>> seen = np.concatenate([x, x], axis=1)
    >>> after = twice(x, seen, [1.0, 1.0], np.eye(2), rng=np.random.default_rng(0))
    >>> float(after.mean().round(12)), float(after.var(ddof=1).round(12))
    (0.5, 0.25)
    """
    return _one_by_one(update, None)


@validated
def with_localization(
    update: Update,
    *,
    places: Annotated[Array, "d k"],
    observation_places: Annotated[Array, "m k"],
    radius: PositiveFloat,
    period: PositiveFloat | None = None,
) -> Update:
    r"""Let each reading move only components near it: the remedy for few members in a large space.

    Readings are taken in one after the other, as by :func:`serial`, and what one changes in a
    component at distance r is multiplied by Gaspari and Cohn's function of r over `radius`, which
    falls from 1 to 0.21 at one radius and to 0 at two. For updates by a gain with independent
    noise that multiplies the sample covariances by the same numbers: chance correlations of far
    components are left out.

    Parameters
    ----------
    update : callable
        An update whose draws stay with the readings: :func:`~distfilt.updates.enkf`, or
        ``partial(square_root, rotation="none")``; not a random rotation, which mixes the members of
        near components and not of far ones.
    places : array_like, (d, k)
        Where each component of the state is.
    readings : array_like, (m, k)
        Where each reading is, in the same coordinates: of all that an agent hears in a step, by
        agent. So it is for an agent alone, or for agents who all hear each other; some numbers may
        be NaN, but no reading may fail to come.
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
    Two components, of which the first is seen; the second is too far to be moved.

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
    both = np.concatenate([places, observation_places])
    gap = np.abs(both[:, None] - observation_places)
    if period is not None:
        gap = np.minimum(gap % period, -gap % period)
    return _one_by_one(update, gaspari_cohn(np.linalg.norm(gap, axis=-1) / radius))


def gaspari_cohn(ratio: Array) -> Array:
    """The taper of covariances, by distances over the radius: a polynomial that ends at two."""
    r = np.asarray(ratio)
    near = 1 + r**2 * (-5 / 3 + r * (5 / 8 + r * (1 / 2 - r / 4)))
    far = 4 + r * (-5 + r * (5 / 3 + r * (5 / 8 + r * (-1 / 2 + r / 12))))
    with np.errstate(divide="ignore"):
        far = far - 2 / (3 * r)
    return np.asarray(np.where(r <= 1, near, np.where(r < 2, far, 0.0)))


def _one_by_one(update: Update, taper: Array | None) -> Update:
    """Groups of correlated readings in turn; what each changes is tapered, (d + m, m)."""

    @around(update)
    def one_by_one(
        ensemble: Array,
        predicted: Array,
        observed: Array,
        noise: Array,
        *,
        rng: Rng,
        predict: Callable[[Array], Array] | None = None,
    ) -> Array:
        x = ensemble
        h = predicted
        d = ensemble.shape[-1]
        if taper is not None and taper.shape != (d + h.shape[-1], h.shape[-1]):
            m = taper.shape[1]
            raise ValueError(
                f"readings must be {m}, of {len(taper) - m} components, for each of "
                f"which there is a place; got {h.shape[-1]} of {d}"
            )
        for k, rows in enumerate(_groups(noise)):
            if predict is not None and k:
                h = predict(x)
            both = np.concatenate([x, h], axis=-1) if predict is None else x
            block = noise[..., rows[:, None], rows]
            moved = with_missing(
                update, both, h[..., rows], observed[..., rows], block, rng=rng
            )
            if taper is not None:
                moved = both + taper[: both.shape[-1], rows].max(axis=-1) * (
                    moved - both
                )
            x = moved[..., :d]
            h = moved[..., d:] if predict is None else h
        return x

    made: Any = one_by_one
    made.repredicts = True
    made.whole = taper is not None
    return one_by_one


def _groups(noise: Array) -> list[Indices]:
    """Indices of readings that are correlated with each other, in the order of their first."""
    from scipy.sparse import csgraph, csr_array

    linked = (noise != 0).reshape(-1, *noise.shape[-2:]).any(axis=0)
    labels = csgraph.connected_components(csr_array(linked), directed=False)[1]
    return [np.flatnonzero(labels == k) for k in dict.fromkeys(labels.tolist())]
