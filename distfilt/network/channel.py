"""The one door between agents: it delivers what they send along the links and keeps the account."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ..checks import Array, array, choice, count
from .faults import Faults
from .graphs import Graph
from .ledger import Ledger
from .weights import Weights, stacked

__all__ = ["Channel", "LOST"]

Mask = NDArray[np.bool_]

LOST = ("mutual", "metropolis", "keep", "renormalise", "zero")
"""What :meth:`Channel.combine` can do about a lost message; the last three are biased."""


class Channel:
    """Deliver payloads along a graph's links, lose or delay some, and charge for all of them.

    Everything that an agent learns from another passes through :meth:`exchange` (any payload),
    :meth:`combine` (weighted sums of stacked vectors, one sparse product) or :meth:`carry` (a
    payload of its own on each link).

    Parameters
    ----------
    graph : Graph
        The links at this time.
    ledger : Ledger, optional
        What was sent before; empty by default. Its count of rounds numbers the losses.
    runs : tuple of int
        Leading axes of every payload that are independent runs of the same network. They are
        charged once, and lose different messages.
    faults : Faults, optional
        How the channel fails; not at all by default.

    Examples
    --------
    >>> star = Graph.from_adjacency([[0, 1, 1], [1, 0, 0], [1, 0, 0]])
    >>> channel = Channel(star)
    >>> inbox = channel.exchange([np.array([1.0]), np.array([2.0]), np.array([3.0])])
    >>> sorted(inbox[0]), sorted(inbox[1])
    ([1, 2], [0])
    >>> channel.ledger
    Ledger(rounds=1, messages=4, scalars=4, bytes=32, lost=0)
    """

    def __init__(
        self,
        graph: Graph,
        *,
        ledger: Ledger | None = None,
        runs: tuple[int, ...] = (),
        faults: Faults | None = None,
    ) -> None:
        if not isinstance(graph, Graph):
            raise ValueError(f"graph: needs a Graph, got {type(graph).__name__}")
        if ledger is not None and ledger.messages.size != graph.size:
            raise ValueError(
                f"ledger: needs {graph.size} agents like the graph, got {ledger.messages.size}"
            )
        if faults is not None and not isinstance(faults, Faults):
            raise ValueError(f"faults: needs Faults, got {type(faults).__name__}")
        self.graph = graph
        self.runs = tuple(count(n, "runs") for n in runs)
        self.faults = Faults() if faults is None else faults
        self.faults.check(graph)
        self._ledger = Ledger.empty(graph.size) if ledger is None else ledger
        self._owed: dict[int, int] = {}
        self._late: dict[Any, deque[Any]] = {}
        self._perfect = self.faults.none
        self._listeners = graph.listeners.astype(np.int64)
        self._links = self.faults.speaking(graph)

    @property
    def ledger(self) -> Ledger:
        """The account so far."""
        for size, rounds in self._owed.items():
            self._ledger = self._ledger.charge(
                rounds * self._listeners, size, 8 * size, rounds=rounds
            )
        self._owed = {}
        return self._ledger

    def exchange(self, payloads: Sequence[Any]) -> list[dict[int, Any]]:
        """Let every agent send its payload to all that hear it.

        Parameters
        ----------
        payloads : sequence of length A
            Per agent an array (*runs, ...), a tuple of arrays, or None to stay silent.

        Returns
        -------
        list of dict
            For each agent what arrived, by sender, in ascending order; the arrays are read-only.
            In a batch, the runs that lost a message find NaN in its place.

        Raises
        ------
        ValueError
            If there is not one payload per agent, or a payload lacks the leading run axes.
        """
        if len(payloads) != self.graph.size:
            raise ValueError(
                f"payloads: needs one per agent ({self.graph.size}), got {len(payloads)}"
            )
        parts = [None if p is None else _parts(p, self.runs) for p in payloads]
        runs = int(np.prod(self.runs, dtype=np.int64))
        sizes = np.array([sum(a.size for a in p) // runs if p else 0 for p in parts])
        bytes_ = np.array([sum(a.nbytes for a in p) // runs if p else 0 for p in parts])
        speaks = np.array([p is not None for p in parts])[self.graph.senders] & self._links
        arrived = self._transmit(speaks, sizes, bytes_)
        sent = self._delayed("exchange", list(payloads), [None] * self.graph.size)
        inbox: list[dict[int, Any]] = [{} for _ in range(self.graph.size)]
        for link in np.flatnonzero(arrived.any(axis=0)):
            i, j = int(self.graph.receivers[link]), int(self.graph.senders[link])
            if sent[j] is not None:
                inbox[i][j] = _delivered(sent[j], arrived[:, link].reshape(self.runs))
        return inbox

    def combine(
        self,
        values: ArrayLike,
        weights: Weights | ArrayLike | sparse.sparray,
        *,
        lost: str = "mutual",
        rounds: int = 1,
    ) -> Array:
        """Let every agent replace its value by a weighted sum of its own and what it hears.

        Parameters
        ----------
        values : array_like, (*runs, A, k)
            One vector per agent.
        weights : Weights, or matrix (A, A)
            What each agent makes of the values.
        lost : {"mutual", "metropolis", "keep", "renormalise", "zero"}
            What an agent does about a message that it misses.

            - ``"mutual"``: a link counts only if both its messages arrive, which acknowledgements
              tell; its weight goes to the own value on both sides. Keeps the average for
              symmetric weights.
            - ``"metropolis"``: the same, and the weights are the Metropolis weights of the links
              that are left; the given ones are not used.
            - ``"keep"``: the receiver gives the weight to its own value, ``"renormalise"``: to all
              that it has, ``"zero"``: to nothing. These move the average.
        rounds : int
            How many times; the values are checked once.

        Returns
        -------
        ndarray, (*runs, A, k)

        Raises
        ------
        ValueError
            If the shapes do not fit, an agent weights one that it does not hear, or the rule needs
            links both ways and some go one way.
        """
        v, w = self._checked(values, weights)
        choice(lost, "lost", LOST)
        for _ in range(count(rounds, "rounds")):
            v = self._mixed(v, w, lost)[0]
        return v

    def combine_with_own(
        self,
        values: ArrayLike,
        weights: Weights | ArrayLike | sparse.sparray,
        *,
        lost: str = "mutual",
    ) -> tuple[Array, Array]:
        """As :meth:`combine`, with the weight that each agent's own value got, (*runs, A)."""
        v, w = self._checked(values, weights)
        return self._mixed(v, w, choice(lost, "lost", LOST))

    def _checked(
        self, values: ArrayLike, weights: Weights | ArrayLike | sparse.sparray
    ) -> tuple[Array, Weights]:
        v = array(values, "values", (*self.runs, self.graph.size, "k"))
        if isinstance(weights, Weights):
            if weights.graph is self.graph:
                return v, weights
            weights = weights.matrix
        return v, Weights.from_matrix(self.graph, weights)

    def _mixed(self, v: Array, w: Weights, lost: str) -> tuple[Array, Array]:
        """One round: the combined values, and the weight that each agent's own value got."""
        if not self._perfect:
            return self._combine_what_arrives(v, w, lost)
        self._owed[v.shape[-1]] = self._owed.get(v.shape[-1], 0) + 1
        if not self.runs:
            return w.matrix @ v, w.own
        front = np.moveaxis(v, -2, 0)
        out = (w.matrix @ front.reshape(self.graph.size, -1)).reshape(front.shape)
        return np.ascontiguousarray(np.moveaxis(out, 0, -2)), w.own

    def carry(self, values: ArrayLike, *, acknowledged: bool = False) -> Array:
        """Send a payload of its own along each link.

        Parameters
        ----------
        values : array_like, (*runs, E, k)
            One vector per link, in the order of ``graph.receivers`` and ``graph.senders``.
        acknowledged : bool
            Charge an acknowledgement for each message.

        Returns
        -------
        ndarray, (*runs, E, k)
            The same, with NaN where nothing arrives.
        """
        edges = self.graph.senders.size
        v = array(values, "values", (*self.runs, edges, "k"))
        sizes = np.full(self.graph.size, v.shape[-1])
        arrived = self._transmit(self._links, sizes, 8 * sizes, acknowledged=acknowledged)
        nothing = np.full_like(v, np.nan)
        sent = self._delayed(("carry", v.shape), v, nothing)
        return np.where(arrived.reshape(*self.runs, edges)[..., None], sent, np.nan)

    def _combine_what_arrives(self, v: Array, w: Weights, lost: str) -> tuple[Array, Array]:
        k, size = v.shape[-1], self.graph.size
        both = lost in ("mutual", "metropolis")
        if both and self.graph.directed:
            raise ValueError(f"lost: {lost!r} needs links both ways, got one-way links")
        # Metropolis weights need the degree of what is left, one number more.
        sizes = np.full(size, k + (lost == "metropolis"))
        arrived = self._transmit(self._links, sizes, 8 * sizes, acknowledged=both)
        heard = self._delayed(("combine", v.shape), v, None)
        if heard is None:
            arrived = np.zeros_like(arrived)
            heard = np.zeros_like(v)
        own, links = _after_loss(self.graph, w, arrived, lost)
        runs = own.shape[0]
        delayed = self.faults.delay > 0
        matrix = stacked(self.graph, own, links, heard_at=runs * size if delayed else 0)
        flat = v.reshape(-1, k)
        out = matrix @ (np.concatenate([flat, heard.reshape(-1, k)]) if delayed else flat)
        return out.reshape(v.shape), own.reshape(*self.runs, size)

    def _transmit(
        self, speaks: Mask, sizes: Any, bytes_: Any, *, acknowledged: bool = False
    ) -> Mask:
        """Charge one round in which the links in `speaks` are used; which messages arrive."""
        now = self.ledger
        runs = int(np.prod(self.runs, dtype=np.int64))
        arrived = speaks & ~self.faults.lost(self.graph, now.rounds, runs)
        size = self.graph.size
        messages = np.bincount(self.graph.senders[speaks], minlength=size)
        missing = (speaks & ~arrived).sum(axis=0) / runs
        lost = np.bincount(self.graph.senders, weights=missing, minlength=size).astype(np.float64)
        after = now.charge(messages, sizes, bytes_, lost=lost)
        if acknowledged:
            back = np.bincount(self.graph.receivers[speaks], minlength=size)
            after = after.charge(back, 0, 1, rounds=0)
        self._ledger = after
        return np.asarray(arrived)

    def _delayed(self, key: Any, now: Any, nothing: Any) -> Any:
        """What arrives in this round of what was sent `delay` rounds ago under the same key."""
        if not self.faults.delay:
            return now
        queue = self._late.setdefault(key, deque())
        queue.append(now)
        return queue.popleft() if len(queue) > self.faults.delay else nothing


def _after_loss(graph: Graph, w: Weights, arrived: Mask, lost: str) -> tuple[Array, Array]:
    """Own and link weights of each run, (R, A) and (R, E), once some messages are missing."""
    ends = graph.receivers

    def sums(per_link: Array) -> Array:
        return np.asarray((graph.incidence @ per_link.T).T)

    if lost in ("mutual", "metropolis"):
        arrived = arrived & arrived[:, graph.reverse]
    if lost == "metropolis":
        degrees = sums(arrived.astype(np.float64))
        pair = np.maximum(degrees[:, ends], degrees[:, graph.senders])
        links = arrived / (1 + pair)
        return 1 - sums(links), links
    links = w.links * arrived
    own = np.broadcast_to(w.own, (arrived.shape[0], graph.size))
    if lost in ("mutual", "keep"):
        own = own + sums(w.links * ~arrived)
    elif lost == "renormalise":
        total = own + sums(links)
        if (np.abs(total) < 1e-12).any():
            raise ValueError("lost: 'renormalise' needs weights left, got a row that sums to 0")
        own, links = own / total, links / total[:, ends]
    return np.asarray(own), links


def _parts(payload: Any, runs: tuple[int, ...]) -> list[Array]:
    parts = [np.asarray(p) for p in (payload if isinstance(payload, tuple) else (payload,))]
    for part in parts:
        if part.shape[: len(runs)] != runs:
            raise ValueError(f"payloads: needs leading axes {runs}, got shape {part.shape}")
    return parts


def _delivered(payload: Any, arrived: Mask) -> Any:
    """A read-only view, or a copy with NaN in the runs that lost it."""
    if isinstance(payload, tuple):
        return tuple(_delivered(part, arrived) for part in payload)
    view = np.asarray(payload).view()
    if not arrived.all():
        gone = ~arrived.reshape(arrived.shape + (1,) * (view.ndim - arrived.ndim))
        view = np.where(gone, np.nan, view)
    view.flags.writeable = False
    return view
