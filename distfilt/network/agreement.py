"""Rules by which ensembles agree: ``(ensembles, channel, *, …) -> ensembles``.

Each serves a filter as its ``agreement=``, with :func:`functools.partial` for the options.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, count, instance, number
from ..ensembles import _mean, _sample_covariance
from ..gaussians import _bures_barycentre, _recolour
from . import weights as weighting
from ._neighbourhood import fused_by
from .channel import Channel
from .consensus import fuses, warn_if_unstable
from .fusion import _intersected
from .weights import Weights

__all__ = ["barycentre", "intersection", "pull"]

_SWEEPS = 500
"""Iterations after which a barycentre that does not settle is an error."""

_SINGULAR = 1e-13
"""Least share of a component's variance that the components before it do not explain."""


@fuses("ensembles")
def pull(
    ensembles: ArrayLike, channel: Channel, *, gain: float, rounds: int = 1,
    include_self: bool = True,
) -> Array:
    r"""Pull every member towards the neighbours' ensemble means, equation (16) of Grange et al.

    .. math:: \mathbf x_i^l \leftarrow \mathbf x_i^l
        + \gamma\sum_{l'\in\mathrm{Nbs}(l)}(\hat{\mathbf x}^{l'}-\mathbf x_i^l)

    Parameters
    ----------
    ensembles : array_like, (*runs, A, N, d)
        One ensemble per agent.
    channel : Channel
        The door between agents; only means pass through it, d scalars a link and round. A mean
        that is lost does not pull.
    gain : float
        The gain γ, at least 0; 0 sends nothing and changes nothing.
    rounds : int
        How many times.
    include_self : bool
        Whether Nbs(l) holds l itself, as the paper's tables print. The means do not notice, but
        the spread shrinks by 1 - γ|Nbs(l)| either way, one neighbour more with it.

    Warns
    -----
    UnstableGain
        If the gain is above 2/λ_max, so that the means drift apart.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[0.0], [2.0]], [[4.0], [6.0]]]
    >>> pull(two, Channel(graphs.path(2)), gain=0.25, include_self=False)[0].ravel()
    array([1.25, 2.75])
    """
    g = number(gain, "gain", at_least=0)
    out = _ensembles(ensembles, channel)
    needed = count(rounds, "rounds")
    if g == 0:
        return out.copy()
    warn_if_unstable(channel.graph, g)
    weights = weighting.laplacian(channel.graph, g)
    for _ in range(needed):
        centre = out.mean(axis=-2)
        moved, own = channel.combine_with_own(centre, weights, lost="keep")
        kept = (own - g * instance(include_self, "include_self", bool))[..., None, None]
        out = moved[..., None, :] + kept * (out - centre[..., None, :])
    return out


@fuses("ensembles")
def intersection(
    ensembles: ArrayLike, channel: Channel, *, rule: str = "min_determinant",
    weights: Weights | ArrayLike | None = None, scale: ArrayLike | None = None, rounds: int = 1,
) -> Array:
    """Fuse mean and covariance by covariance intersection, then re-colour each ensemble.

    Safe whatever the agents' errors share, which in a network that exchanges observations is much.

    Parameters
    ----------
    ensembles : array_like, (*runs, A, N, d)
        One ensemble per agent, N > d.
    channel : Channel
        d + d(d+1)/2 scalars a link and round. Whoever misses a message fuses without it.
    rule : {"equal", "trace", "determinant", "min_trace", "min_determinant"}
        As for :func:`distfilt.network.fusion.covariance_intersection`.
    weights : Weights or array_like, (A, A), optional
        Given weights instead of a rule, nonnegative, each row's sum one.
    scale : array_like, (d,), optional
        A positive size of each component, known to all agents, by which the state is divided before
        traces are taken: a trace adds variances of different units.
    rounds : int
        How many times.

    Returns
    -------
    ndarray, (*runs, A, N, d)
        Sample means and covariances are the fused ones.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[-1.0], [1.0]], [[2.0], [4.0]]]
    >>> intersection(two, Channel(graphs.path(2)), rule="equal")[..., 0]
    array([[0.5, 2.5],
           [0.5, 2.5]])
    """
    x, size = _scaled(ensembles, channel, scale)
    fused = _intersected(_mean(x), _sampled(x), channel, rule, weights, rounds)
    out = _recolour(x, *fused)
    return out if size is None else out * size


@fuses("ensembles")
def barycentre(
    ensembles: ArrayLike, channel: Channel, *, scale: ArrayLike | None = None, rounds: int = 1,
    tolerance: float = 1e-10,
) -> Array:
    """Take the Bures-Wasserstein barycentre of the neighbourhood's Gaussians, then re-colour.

    With equal weights for all that an agent has. The covariance is about an average of the inputs':
    agreement adds no information, and takes none that was there.

    Parameters
    ----------
    ensembles, channel, rounds
        As in :func:`intersection`.
    scale : array_like, (d,), optional
        A positive size of each component, known to all agents. The barycentre is taken of states
        divided by it: unlike covariance intersection with equal weights, it depends on the units.
    tolerance : float
        As for :func:`distfilt.gaussians.bures_barycentre`, relative.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[-1.0], [1.0]], [[3.0], [9.0]]]
    >>> barycentre(two, Channel(graphs.path(2)))[..., 0].round(9)
    array([[1., 5.],
           [1., 5.]])
    """
    x, size = _scaled(ensembles, channel, scale)
    small = number(tolerance, "tolerance", above=0)

    def fuse(means: Array, covs: Array, here: NDArray[np.bool_]) -> tuple[Array, Array]:
        omega = here / here.sum(axis=-1, keepdims=True)
        centre = (omega[..., None] * means).sum(axis=-2)
        return centre, _bures_barycentre(covs, omega, small, _SWEEPS)

    out = _recolour(x, *fused_by(_mean(x), _sampled(x), channel, fuse, rounds))
    return out if size is None else out * size


def _ensembles(ensembles: ArrayLike, channel: Channel) -> Array:
    instance(channel, "channel", Channel)
    return array(ensembles, "ensembles", (*channel.runs, channel.graph.size, "N", "d"))


def _scaled(
    ensembles: ArrayLike, channel: Channel, scale: ArrayLike | None
) -> tuple[Array, Array | None]:
    """Ensembles divided by the scale of each component, and the scale, if there is one."""
    x = _ensembles(ensembles, channel)
    if scale is None:
        return x, None
    size = array(scale, "scale", (x.shape[-1],))
    if not (size > 0).all():
        raise ValueError(f"scale: needs positive sizes, got {size.min():g}")
    return x / size, size


def _sampled(x: Array) -> Array:
    """Sample covariances; refuses singular ones."""
    members, d = x.shape[-2:]
    if members <= d:
        raise ValueError(
            f"ensembles: needs more than {d} members for {d} components, got {members}"
        )
    cov = _sample_covariance(x)
    spread = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    size = np.where(spread > 0, spread, 1.0)
    try:
        # Squared pivots of the correlations: what each component has that those before have not.
        lower = np.linalg.cholesky(cov / (size[..., :, None] * size[..., None, :]))
        singular = bool((np.diagonal(lower, axis1=-2, axis2=-1) ** 2 < _SINGULAR).any())
    except np.linalg.LinAlgError:
        singular = True
    if singular:
        raise ValueError(
            "ensembles: needs components that are not constant and not combinations of others, "
            "got a singular sample covariance"
        )
    return cov
