"""Rules by which agents agree on an average or a maximum: ``(values, channel, *, …) -> values``."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, count, instance, number
from ..doors import unchecked
from . import weights as weighting
from .channel import Channel
from .links import Graph
from .weights import Weights

__all__ = [  # fmt: skip
    "UnstableGain", "average", "finite_time", "fused_kind", "fuses", "maximum", "push_sum",
]

F = TypeVar("F", bound=Callable[..., Any])

Fused = Literal["vectors", "ensembles", "gaussians", "mixtures", "densities", "particles"]

_SMALL = 1000
"""Up to this many agents :func:`maximum` looks for the diameter itself."""


def fuses(kind: Fused) -> Callable[[F], F]:
    """Say what a rule of agreement fuses, so that a filter can tell if the rule is for it.

    Parameters
    ----------
    kind : {"vectors", "ensembles", "gaussians", "mixtures", "densities", "particles"}
        What ``rule(belief, channel, *, …) -> belief`` takes and returns.

    Examples
    --------
    >>> @fuses("vectors")
    ... def stubborn(belief, channel):
    ...     return belief
    >>> stubborn.fuses
    'vectors'
    """

    def named(rule: F) -> F:
        for function in (rule, unchecked(rule)):
            function.fuses = kind  # type: ignore[attr-defined]
        return rule

    return named


def fused_kind(rule: Callable[..., Any]) -> str | None:
    """What a rule says that it fuses, also with options given by a partial; None if nothing.

    >>> fused_kind(partial(average, rounds=3)), fused_kind(print)
    ('vectors', None)
    """
    while isinstance(rule, partial):
        rule = rule.func
    return getattr(rule, "fuses", None)


class UnstableGain(RuntimeWarning):
    """A gain above 2/λ_max: what the agents exchange drives them apart instead of together.

    Turn it into an error, or off, by ``warnings.filterwarnings("error", category=UnstableGain)``.

    >>> issubclass(UnstableGain, RuntimeWarning)
    True
    """


def warn_if_unstable(graph: Graph, gain: float) -> None:
    """Warn the caller's caller of a gain at which averaging on the graph diverges.

    A bound from the degrees clears most gains; eigenvalues are computed, once for a graph, only
    beyond it.
    """
    if gain <= graph.safe_gain:
        return
    limit = graph.largest_gain
    if gain > limit * (1 + 1e-9):
        warnings.warn(
            f"gain: {gain:.6g} is above 2/λ_max = {limit:.6g} of this graph, so the agents drift "
            f"apart",
            UnstableGain,
            stacklevel=3,
        )


def _values(values: ArrayLike, channel: Channel, name: str = "values") -> Array:
    instance(channel, "channel", Channel)
    return array(values, name, (*channel.runs, channel.graph.size, "k"))


def _connected(channel: Channel) -> None:
    if not channel.graph.connected:
        parts = channel.graph.components.max() + 1
        raise ValueError(f"channel: needs a connected graph to agree, got {parts} components")


@fuses("vectors")
def average(
    values: ArrayLike, channel: Channel, *, rounds: int = 1, gain: float | None = None,
    weights: Weights | None = None, lost: str = "mutual",
) -> Array:
    r"""Move every agent's value towards its neighbours', the averaging behind equation (16).

    .. math:: \mathbf x_i \leftarrow \mathbf x_i
        + \gamma\sum_{j\in\mathcal N_i}(\mathbf x_j-\mathbf x_i)

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        The door between agents. On a graph that is not connected each component agrees for itself.
    rounds : int
        How many times.
    gain : float, optional
        The gain γ, positive. The values agree if and only if the graph is connected and
        γ < 2/λ_max of its Laplacian; above it an :class:`UnstableGain` warns.
    weights : Weights, optional
        Other weights instead; Metropolis by default. They have to keep the average on their own
        account: symmetric, or :func:`distfilt.network.weights.balanced` on a digraph.
    lost : str
        What to do about lost messages: see :meth:`Channel.combine`.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> average([[0.0], [3.0], [-1.5]], Channel(graphs.star(3)), gain=0.5, rounds=40).round(4)
    array([[0.5],
           [0.5],
           [0.5]])
    """
    out = _values(values, channel)
    if gain is not None and weights is not None:
        raise ValueError("gain: needs to stand alone, got weights too")
    if gain is not None:
        weights = weighting.laplacian(channel.graph, number(gain, "gain", above=0))
        warn_if_unstable(channel.graph, gain)
    elif weights is None:
        weights = weighting.metropolis(channel.graph)
    weighting.keeping(weights)
    return channel.combine(out, weights, lost=lost, rounds=rounds)


@fuses("vectors")
def finite_time(values: ArrayLike, channel: Channel) -> Array:
    r"""The exact average in as many rounds as the Laplacian has distinct nonzero eigenvalues.

    .. math:: \prod_{k}\Bigl(\mathbf I-\tfrac1{\lambda_k}\mathbf L\Bigr)\mathbf x
        = \bar x\,\mathbf 1

    Each factor removes one eigenspace and leaves the average alone.

    Parameters
    ----------
    values, channel
        As for :func:`average`. Connected, with links both ways, and without faults: one lost
        message spoils the product.

    Notes
    -----
    Large factors come between small ones (Leja's order), or rounding grows with the number of
    eigenvalues.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.star(5))
    >>> finite_time(np.arange(5.0)[:, None], channel).ravel().round(12)
    array([2., 2., 2., 2., 2.])
    >>> channel.ledger.rounds
    2
    """
    out = _values(values, channel)
    _connected(channel)
    if not channel.faults.none:
        raise ValueError("channel: needs no faults for a finite-time rule, got a faulty channel")
    for eigenvalue in _leja(_distinct(channel.graph.spectrum[1:])):
        out = channel.combine(out, weighting.laplacian(channel.graph, 1 / eigenvalue))
    return out


def _distinct(values: Array) -> Array:
    gaps = np.diff(values, prepend=-np.inf) > 1e-9 * max(1.0, float(values.max(initial=0)))
    return values[gaps]


def _leja(points: Array) -> list[float]:
    """The points in an order in which partial products of their factors stay small.

    Each next one is farthest, in the geometric mean, from all before it.
    """
    score, order = np.abs(points), []
    for k in range(points.size):
        at = int(score.argmax())
        order.append(at)
        with np.errstate(divide="ignore"):
            away = np.log(np.abs(points - points[at]))
        score = away if k == 0 else score + away
        score[order] = -np.inf
    return [float(p) for p in points[order]]


@fuses("vectors")
def push_sum(values: ArrayLike, channel: Channel, *, rounds: int) -> Array:
    r"""Averages on any strongly connected digraph, also when messages are lost, without answers.

    Each agent pushes shares of its value and of a weight that began at one, and the ratio tends to
    the average. On each link it sends the *running sum* of all it ever pushed there; the receiver
    takes the increase since what it heard last, so that a lost message is made good by the next.

    Parameters
    ----------
    values, channel
        As for :func:`average`. Strongly connected; messages may be lost.
    rounds : int
        How many rounds; k + 1 scalars a link and round.

    Returns
    -------
    ndarray, (*runs, A, k)
        The ratios.

    Notes
    -----
    D. Kempe, A. Dobra and J. Gehrke, Foundations of Computer Science (2003) 482-491; running sums:
    N. H. Vaidya, C. N. Hadjicostis and A. D. Dominguez-Garcia (2011).

    Examples
    --------
    >>> from distfilt.network import Channel, Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> push_sum([[0.0], [3.0], [6.0]], Channel(circle), rounds=80).ravel().round(9)
    array([3., 3., 3.])
    """
    v = _values(values, channel)
    _connected(channel)
    graph = channel.graph
    mass = np.concatenate([v, np.ones((*v.shape[:-1], 1))], axis=-1)
    share = 1 / (1 + graph.listeners)[:, None]
    pushed = np.zeros_like(mass)
    heard = np.zeros((*channel.runs, graph.senders.size, mass.shape[-1]))
    for _ in range(count(rounds, "rounds")):
        pushed = pushed + share * mass
        arrived = channel.carry(pushed[..., graph.senders, :])
        latest = np.where(np.isnan(arrived), heard, arrived)
        mass = share * mass + _summed(latest - heard, channel)
        heard = latest
    return np.asarray(mass[..., :-1] / mass[..., -1:])


def _summed(per_link: Array, channel: Channel) -> Array:
    """Sum of what each agent received over its links, (*runs, A, k)."""
    front = np.moveaxis(per_link, -2, 0)
    out = channel.graph.incidence @ front.reshape(front.shape[0], -1)
    return np.moveaxis(out.reshape(channel.graph.size, *front.shape[1:]), 0, -2)


@fuses("vectors")
def maximum(values: ArrayLike, channel: Channel, *, rounds: int | None = None) -> Array:
    """The largest value, component by component; exact after as many rounds as the diameter.

    Parameters
    ----------
    values, channel
        As for :func:`average`. Connected; a lost message only costs time.
    rounds : int, optional
        By default the graph's diameter; with more than 1 000 agents ``graph.diameter_bound``, which
        is enough, and at most twice as much, where the diameter itself would take long to find.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> maximum([[1.0], [5.0], [2.0]], Channel(graphs.path(3))).ravel()
    array([5., 5., 5.])
    """
    out = _values(values, channel)
    _connected(channel)
    graph = channel.graph
    small = graph.size <= _SMALL
    enough = graph.diameter if small else graph.diameter_bound
    needed = enough if rounds is None else count(rounds, "rounds")
    for _ in range(needed):
        arrived = channel.carry(out[..., graph.senders, :])
        if graph.senders.size:
            hears = graph.degrees > 0
            best = np.fmax.reduceat(arrived, graph.links.indptr[:-1][hears], axis=-2)
            out = out.copy()
            out[..., hears, :] = np.fmax(out[..., hears, :], best)
    return out.copy()
