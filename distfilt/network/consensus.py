"""Rules by which neighbours agree: ``(values, channel, *, rounds) -> values``."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, count, number
from ..ensembles import mean
from .channel import Channel

__all__ = ["average", "mean_pull"]


def average(values: ArrayLike, channel: Channel, *, gain: float, rounds: int = 1) -> Array:
    r"""Move every agent's value towards its neighbours', the averaging behind equation (16).

    .. math:: \mathbf x_i \leftarrow \mathbf x_i
        + \gamma\sum_{j\in\mathcal N_i}(\mathbf x_j-\mathbf x_i)

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        The door between agents.
    gain : float
        The gain γ, positive. The values agree if and only if the graph is connected and
        γ < 2/λ_max of its Laplacian.
    rounds : int
        How many times.

    Returns
    -------
    ndarray, (*runs, A, k)

    Raises
    ------
    ValueError
        If the values do not fit the channel, or `gain` is not positive.

    Examples
    --------
    >>> from distfilt.network import Channel, Graph
    >>> star = Channel(Graph.from_adjacency([[0, 1, 1], [1, 0, 0], [1, 0, 0]]))
    >>> average([[0.0], [3.0], [-1.5]], star, gain=0.5, rounds=40).ravel().round(4)
    array([0.5, 0.5, 0.5])
    """
    g = number(gain, "gain", above=0)
    out = array(values, "values", (*channel.runs, channel.graph.size, "k"))
    step = np.eye(channel.graph.size) - g * channel.graph.laplacian
    for _ in range(count(rounds, "rounds")):
        out = channel.combine(out, step)
    return out


def mean_pull(
    ensembles: ArrayLike,
    channel: Channel,
    *,
    gain: float,
    rounds: int = 1,
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
        The door between agents; only means pass through it, d scalars a link and round.
    gain : float
        The gain γ, at least 0; 0 sends nothing and changes nothing.
    rounds : int
        How many times.
    include_self : bool
        Whether Nbs(l) holds l itself, as the paper's tables print. The means do not notice, but
        the spread shrinks by 1 - γ|Nbs(l)| either way, one neighbour more with it.

    Returns
    -------
    ndarray, (*runs, A, N, d)

    Raises
    ------
    ValueError
        If the ensembles do not fit the channel, or `gain` is negative.

    Examples
    --------
    >>> from distfilt.network import Channel, Graph
    >>> pair = Channel(Graph.from_adjacency([[0, 1], [1, 0]]))
    >>> two = [[[0.0], [2.0]], [[4.0], [6.0]]]
    >>> mean_pull(two, pair, gain=0.25, include_self=False)[0].ravel()
    array([1.25, 2.75])
    """
    g = number(gain, "gain", at_least=0)
    size = channel.graph.size
    out = array(ensembles, "ensembles", (*channel.runs, size, "N", "d"))
    if g == 0:
        return out.copy()
    heard = channel.graph.links + np.eye(size) * include_self
    weight = channel.graph.degrees + include_self
    for _ in range(count(rounds, "rounds")):
        pull = channel.combine(mean(out), heard)
        out = out + g * (pull[..., None, :] - weight[:, None, None] * out)
    return out
