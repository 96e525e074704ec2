"""The one door between agents: it delivers messages along the links and keeps the account."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ..checks import Array, array, count
from .graphs import Graph

__all__ = ["Channel", "Ledger"]

Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Ledger:
    """What the agents sent: the cost of a distributed method.

    A message is one payload on one link. Scalars and bytes count the payload on every link that
    it takes; a batch of independent runs counts once.

    Parameters
    ----------
    rounds : int
        Rounds of communication.
    messages, scalars, bytes : ndarray of int, (A,)
        Sent by each agent.

    Examples
    --------
    >>> Ledger.empty(2)
    Ledger(rounds=0, messages=0, scalars=0, bytes=0)
    """

    rounds: int
    messages: Counts
    scalars: Counts
    bytes: Counts

    @classmethod
    def empty(cls, agents: int) -> Ledger:
        """A ledger of `agents` agents that have not spoken."""
        zero = np.zeros(count(agents, "agents"), dtype=np.int64)
        return cls(0, zero, zero, zero)

    def charge(self, links: Counts, scalars: Counts, bytes_: Counts) -> Ledger:
        """The ledger after one more round; per agent: links used, scalars and bytes a link."""
        return Ledger(
            self.rounds + 1,
            self.messages + links,
            self.scalars + links * scalars,
            self.bytes + links * bytes_,
        )

    def __repr__(self) -> str:
        totals = (int(a.sum()) for a in (self.messages, self.scalars, self.bytes))
        return "Ledger(rounds={}, messages={}, scalars={}, bytes={})".format(self.rounds, *totals)


class Channel:
    """Deliver payloads along a graph's links and charge for them.

    A channel is used for one step of a filter: everything that an agent learns from another passes
    through :meth:`exchange` or :meth:`combine`.

    Parameters
    ----------
    graph : Graph
        The links at this time.
    ledger : Ledger, optional
        What was sent before; empty by default.
    runs : tuple of int
        Leading axes of every payload that are independent runs of the same network. They are not
        charged: each run is a network of its own.

    Attributes
    ----------
    ledger : Ledger
        The account so far; replaced, never changed, by each round.

    Examples
    --------
    >>> star = Graph.from_adjacency([[0, 1, 1], [1, 0, 0], [1, 0, 0]])
    >>> channel = Channel(star)
    >>> inbox = channel.exchange([np.array([1.0]), np.array([2.0]), np.array([3.0])])
    >>> sorted(inbox[0]), sorted(inbox[1])
    ([1, 2], [0])
    >>> channel.ledger
    Ledger(rounds=1, messages=4, scalars=4, bytes=32)
    """

    def __init__(
        self, graph: Graph, *, ledger: Ledger | None = None, runs: tuple[int, ...] = ()
    ) -> None:
        if not isinstance(graph, Graph):
            raise ValueError(f"graph: needs a Graph, got {type(graph).__name__}")
        if ledger is not None and ledger.messages.size != graph.size:
            raise ValueError(
                f"ledger: needs {graph.size} agents like the graph, got {ledger.messages.size}"
            )
        self.graph = graph
        self.runs = tuple(count(n, "runs") for n in runs)
        self.ledger = Ledger.empty(graph.size) if ledger is None else ledger

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

        Raises
        ------
        ValueError
            If there is not one payload per agent, or a payload lacks the leading run axes.
        """
        if len(payloads) != self.graph.size:
            raise ValueError(
                f"payloads: needs one per agent ({self.graph.size}), got {len(payloads)}"
            )
        sent = [None if p is None else _read_only(p) for p in payloads]
        sizes = np.array([self._size(p) for p in sent], dtype=np.int64)
        speaks = np.array([p is not None for p in sent])
        links = np.where(speaks, self.graph.listeners, 0).astype(np.int64)
        self.ledger = self.ledger.charge(links, sizes[:, 0], sizes[:, 1])
        return [
            {j: sent[j] for j in self.graph.neighbours(i) if speaks[j]}
            for i in range(self.graph.size)
        ]

    def combine(self, values: ArrayLike, weights: ArrayLike | sparse.sparray) -> Array:
        """Let every agent replace its value by a weighted sum of its own and what it hears.

        Parameters
        ----------
        values : array_like, (*runs, A, k)
            One vector per agent.
        weights : array_like or sparse, (A, A)
            Row i: what agent i makes of the values. Off the diagonal only links may be weighted.

        Returns
        -------
        ndarray, (*runs, A, k)

        Raises
        ------
        ValueError
            If the shapes do not fit, or an agent weights one that it does not hear.
        """
        v = array(values, "values", (*self.runs, self.graph.size, "k"))
        w = sparse.csr_array(weights)
        if w.shape != self.graph.links.shape:
            raise ValueError(f"weights: needs shape {self.graph.links.shape}, got {w.shape}")
        if not np.isfinite(w.data).all():
            raise ValueError("weights: needs finite numbers, got NaN or infinite entries")
        off = (w - sparse.diags_array(w.diagonal())).tocsr()
        off.eliminate_zeros()
        if (off != off.multiply(self.graph.links)).nnz:
            raise ValueError("weights: needs zeros where an agent does not hear another")
        used = np.asarray((off != 0).sum(axis=0), dtype=np.int64)
        size = np.full(self.graph.size, v.shape[-1], dtype=np.int64)
        self.ledger = self.ledger.charge(used, size, size * v.itemsize)
        front = np.moveaxis(v, -2, 0)
        out = (w @ front.reshape(self.graph.size, -1)).reshape(front.shape)
        return np.ascontiguousarray(np.moveaxis(out, 0, -2))

    def _size(self, payload: Any) -> tuple[int, int]:
        """Scalars and bytes of one run's payload."""
        if payload is None:
            return 0, 0
        parts = payload if isinstance(payload, tuple) else (payload,)
        runs = int(np.prod(self.runs, dtype=np.int64))
        for part in parts:
            if part.shape[: len(self.runs)] != self.runs:
                raise ValueError(f"payloads: needs leading axes {self.runs}, got {part.shape}")
        return sum(p.size for p in parts) // runs, sum(p.nbytes for p in parts) // runs


def _read_only(payload: Any) -> Any:
    if isinstance(payload, tuple):
        return tuple(_read_only(part) for part in payload)
    view = np.asarray(payload).view()
    view.flags.writeable = False
    return view
