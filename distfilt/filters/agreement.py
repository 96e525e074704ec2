r"""Agreement of ensembles: agents exchange mean and covariance, fuse them, and re-colour.

Each rule has the signature ``(ensembles, channel, *, …) -> ensembles`` and serves as `consensus`
of :class:`~distfilt.filters.EnsembleFilter`, with :func:`functools.partial` for its options. The
pull towards the neighbours' means, equation (16) of Grange et al., is
:func:`distfilt.network.consensus.mean_pull`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, SolverError, array, count, covariance, number
from ..checks import weights as unit_weights
from ..ensembles import anomalies, mean, sample_covariance
from ..linalg import symmetrise
from ..network import Channel
from ..network.fusion import covariance_intersection, exchanged

__all__ = [
    "barycentre_agreement",
    "bures_barycentre",
    "intersection_agreement",
    "recolour",
]


def recolour(ensemble: ArrayLike, mean: ArrayLike, cov: ArrayLike) -> Array:
    r"""Move an ensemble affinely so that its sample mean and covariance are the given ones.

    .. math:: \mathbf x_i' = \mathbf m + \mathbf A(\mathbf x_i-\bar{\mathbf x}),\qquad
        \mathbf A = \mathbf L^{-\top}(\mathbf L^\top\mathbf P\mathbf L)^{1/2}\mathbf L^{-1},\qquad
        \hat{\mathbf C} = \mathbf L\mathbf L^\top

    A is the optimal transport between Gaussians: of all affine maps with this result it moves the
    members least, with each component measured by its new standard deviation.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members, more than d.
    mean : array_like, (..., d)
        The new mean.
    cov : array_like, (..., d, d)
        The new sample covariance, positive definite.

    Returns
    -------
    ndarray, (..., N, d)

    Raises
    ------
    ValueError
        If shapes do not fit, `cov` is not positive definite, or the ensemble's covariance is
        singular.

    Examples
    --------
    >>> recolour([[0.0], [2.0]], [5.0], [[8.0]]).ravel()
    array([3., 7.])
    """
    x = array(ensemble, "ensemble", (..., "N", "d"))
    d = x.shape[-1]
    centre = array(mean, "mean", (*x.shape[:-2], d))
    wanted = covariance(array(cov, "cov", (*x.shape[:-2], d, d)), "cov")
    now = _sampled(x, "ensemble")
    # In units of the new spread, so that components of different size lose no digits.
    unit = np.sqrt(np.diagonal(wanted, axis1=-2, axis2=-1))
    outer = unit[..., :, None] * unit[..., None, :]
    lower = np.linalg.cholesky(now / outer)
    middle = _root(symmetrise(np.swapaxes(lower, -1, -2) @ (wanted / outer) @ lower))
    right = np.swapaxes(np.linalg.solve(np.swapaxes(lower, -1, -2), middle), -1, -2)
    # A = right' lower^-1 is symmetric: rows of anomalies are multiplied by lower^-T right.
    turned = np.linalg.solve(np.swapaxes(lower, -1, -2), right)
    spread = (anomalies(x) / unit[..., None, :]) @ turned
    return np.asarray(centre[..., None, :] + spread * unit[..., None, :])


def _sampled(x: Array, name: str) -> Array:
    """Sample covariance; refuses one that is singular."""
    members, d = x.shape[-2:]
    if members <= d:
        raise ValueError(f"{name}: needs more than {d} members for {d} components, got {members}")
    cov = sample_covariance(x)
    scale = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    singular = (scale == 0).any()
    if not singular:
        ends = np.linalg.eigvalsh(cov / (scale[..., :, None] * scale[..., None, :]))
        singular = bool((ends[..., 0] < 1e-13 * ends[..., -1]).any())
    if singular:
        raise ValueError(f"{name}: needs components that are not constant and not combinations of "
                         f"others, got a singular sample covariance")
    return cov


def _root(cov: Array) -> Array:
    """Symmetric square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(cov)
    roots = np.sqrt(np.clip(values, 0.0, None))
    return np.asarray((vectors * roots[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def intersection_agreement(
    ensembles: ArrayLike,
    channel: Channel,
    *,
    weights: str = "fixed",
    scale: ArrayLike | None = None,
    rounds: int = 1,
) -> Array:
    """Fuse mean and covariance by covariance intersection, then re-colour each ensemble.

    Safe whatever the agents' errors share, which in a network that exchanges observations is much.

    Parameters
    ----------
    ensembles : array_like, (*runs, A, N, d)
        One ensemble per agent, N > d.
    channel : Channel
        d + d(d+1)/2 scalars a link and round. Whoever misses a message fuses without it.
    weights : {"fixed", "trace", "determinant"}
        As for :func:`distfilt.network.fusion.covariance_intersection`.
    scale : array_like, (d,), optional
        A positive size of each component, known to all agents, by which the state is divided before
        traces are taken: a trace adds variances of different units.
    rounds : int
        How many times.

    Returns
    -------
    ndarray, (*runs, A, N, d)
        Sample means and covariances are the fused ones.

    Raises
    ------
    ValueError
        If the ensembles do not fit the channel or their covariances are singular.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[-1.0], [1.0]], [[2.0], [4.0]]]
    >>> intersection_agreement(two, Channel(graphs.path(2)))[..., 0]
    array([[0.5, 2.5],
           [0.5, 2.5]])
    """
    x, size = _scaled(ensembles, channel, scale)
    fused = covariance_intersection(
        mean(x), _sampled(x, "ensembles"), channel, weights=weights, rounds=rounds
    )
    return recolour(x, *fused) * size


def barycentre_agreement(
    ensembles: ArrayLike,
    channel: Channel,
    *,
    scale: ArrayLike | None = None,
    rounds: int = 1,
    tolerance: float = 1e-10,
) -> Array:
    """Take the Bures-Wasserstein barycentre of the neighbourhood's Gaussians, then re-colour.

    With equal weights for all that an agent has. The covariance is about an average of the inputs':
    agreement adds no information, and takes none that was there.

    Parameters
    ----------
    ensembles, channel, rounds
        As in :func:`intersection_agreement`.
    scale : array_like, (d,), optional
        A positive size of each component, known to all agents. The barycentre is taken of states
        divided by it: unlike covariance intersection with fixed weights, it depends on the units.
    tolerance : float
        As for :func:`bures_barycentre`.

    Returns
    -------
    ndarray, (*runs, A, N, d)

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[-1.0], [1.0]], [[3.0], [9.0]]]
    >>> barycentre_agreement(two, Channel(graphs.path(2)))[..., 0].round(9)
    array([[1., 5.],
           [1., 5.]])
    """
    x, size = _scaled(ensembles, channel, scale)
    small = number(tolerance, "tolerance", above=0)

    def fuse(means: Array, covs: Array, here: Array) -> tuple[Array, Array]:
        omega = here / here.sum(axis=0)
        centre = (omega[..., None] * means).sum(axis=0)
        share, parts = np.moveaxis(omega, 0, -1), np.moveaxis(covs, 0, -3)
        return centre, bures_barycentre(parts, share, tolerance=small)

    fused = exchanged(mean(x), _sampled(x, "ensembles"), channel, rounds, fuse)
    return recolour(x, *fused) * size


def bures_barycentre(
    covs: ArrayLike, weights: ArrayLike, *, tolerance: float = 1e-10, iterations: int = 500
) -> Array:
    r"""Covariance of the Wasserstein barycentre of centred Gaussians.

    The solution of
    :math:`\mathbf S=\sum_j\omega_j(\mathbf S^{1/2}\mathbf P_j\mathbf S^{1/2})^{1/2}` by the fixed
    point

    .. math:: \mathbf S\leftarrow\mathbf S^{-1/2}\Bigl(\sum_j\omega_j
        (\mathbf S^{1/2}\mathbf P_j\mathbf S^{1/2})^{1/2}\Bigr)^2\mathbf S^{-1/2}.

    Parameters
    ----------
    covs : array_like, (..., J, d, d)
        Covariances, positive definite.
    weights : array_like, (..., J)
        Nonnegative, with sum 1.
    tolerance : float
        Stop when the largest relative change of any run is below it.
    iterations : int
        At most this many.

    Returns
    -------
    ndarray, (..., d, d)

    Raises
    ------
    SolverError
        If the change is not below `tolerance` after `iterations`.

    Notes
    -----
    P. C. Álvarez-Esteban, E. del Barrio, J. A. Cuesta-Albertos and C. Matrán, Journal of
    Mathematical Analysis and Applications 441 (2016) 744-762.

    Examples
    --------
    Standard deviations are averaged where the covariances commute:

    >>> bures_barycentre([[[1.0]], [[9.0]]], [0.5, 0.5]).round(9)
    array([[4.]])
    """
    p = covariance(covs, "covs")
    if p.ndim < 3:
        raise ValueError(f"covs: needs shape (..., J, d, d), got {p.shape}")
    omega = unit_weights(array(weights, "weights", p.shape[:-2]), "weights")
    small = number(tolerance, "tolerance", above=0)
    share = omega[..., None, None]
    s = symmetrise((share * p).sum(axis=-3))
    for _ in range(count(iterations, "iterations")):
        root = _root(s)
        wide = root[..., None, :, :]
        inner = (share * _root(symmetrise(wide @ p @ wide))).sum(axis=-3)
        half = np.linalg.solve(root, inner)
        new = symmetrise(half @ np.swapaxes(half, -1, -2))
        change = np.abs(new - s).max(axis=(-2, -1)) / np.abs(s).max(axis=(-2, -1))
        s = new
        if (change < small).all():
            return s
    raise SolverError(
        f"bures_barycentre: relative change {change.max():.3g} after {iterations} iterations, "
        f"needs less than {small:g}"
    )


def _scaled(
    ensembles: ArrayLike, channel: Channel, scale: ArrayLike | None
) -> tuple[Array, Array]:
    """Ensembles divided by the scale of each component, and the scale."""
    if not isinstance(channel, Channel):
        raise ValueError(f"channel: needs a Channel, got {type(channel).__name__}")
    x = array(ensembles, "ensembles", (*channel.runs, channel.graph.size, "N", "d"))
    size = np.ones(x.shape[-1]) if scale is None else array(scale, "scale", (x.shape[-1],))
    if not (size > 0).all():
        raise ValueError(f"scale: needs positive sizes, got {size.min():g}")
    return x / size, size
