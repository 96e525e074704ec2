"""The one door between agents: it delivers what they send along the links and keeps the account."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Literal, TypeVar

import numpy as np

from ..validation import Array, Mask, PositiveInt, skip_validation, validated
from . import ledger as accounts
from .faults import Faults
from .graphs import Graph, as_graph
from .ledger import Ledger
from .weights import ConsensusWeights, _matching, stack_weights

__all__ = ["Channel", "Lost", "PerAgent", "kind_of_rule", "fusion_rule"]

_PERFECT = Faults()
_Own = Annotated[Array, "*self.runs self.graph.n_agents k"]

PerAgent = Annotated[Array, "*channel.runs channel.graph.n_agents k"]
"""One vector for each agent of an argument named `channel`."""

Lost = Literal["mutual", "metropolis", "keep", "renormalise", "zero"]
"""What :meth:`Channel.combine` can do about a lost message; the last three are biased."""

Fused = Literal[
    "vectors", "ensembles", "gaussians", "mixtures", "densities", "particles"
]
F = TypeVar("F", bound=Callable[..., Any])


class Channel:
    """Deliver payloads along a graph's links, lose or delay some, and charge for all of them.

    Everything that an agent learns from another passes through :meth:`exchange` (any payload),
    :meth:`combine` (weighted sums of stacked vectors, one sparse product) or :meth:`carry` (a
    vector of its own on each link).

    Parameters
    ----------
    graph : Graph
        The links at this time; or a networkx graph, a matrix of links, or edges.
    ledger : Ledger, optional
        What was sent before; empty by default. Its count of rounds numbers the losses.
    runs : tuple of int
        Leading axes of every payload that are independent runs of the same network. They are
        charged once, and lose different messages.
    faults : Faults, optional
        How the channel fails; not at all by default. A delay is for :meth:`combine` alone.
    t : float, optional
        The time, in s, which the windows of faults count then; rounds without it.

    Examples
    --------
    >>> star = Graph.from_adjacency([[0, 1, 1], [1, 0, 0], [1, 0, 0]])
    >>> channel = Channel(star)
    >>> inbox = channel.broadcast([np.array([1.0]), np.array([2.0]), np.array([3.0])])
    >>> sorted(inbox[0]), sorted(inbox[1])
    ([1, 2], [0])
    >>> channel.ledger
    Ledger(rounds=1, messages=4, scalars=4, bytes=32, lost=0)
    """

    @validated
    def __init__(
        self,
        graph: Any,
        *,
        ledger: Ledger | None = None,
        runs: tuple[PositiveInt, ...] = (),
        faults: Faults | None = None,
        t: float | None = None,
    ) -> None:
        self.graph: Graph = as_graph(
            graph, None if ledger is None else ledger.messages.size
        )
        self.runs = runs
        self._among = int(np.prod(runs, dtype=np.int64)), slice(None)
        self.faults = _PERFECT if faults is None else faults
        self.t = t
        self._ledger = Ledger.empty(self.graph.n_agents) if ledger is None else ledger
        self._owed: dict[int, int] = {}
        self._late: dict[tuple[int, ...], deque[Any]] = {}
        self._perfect = self.faults.none
        if not self._perfect:
            self.faults.check(self.graph)

    @classmethod
    def construct(cls, *args: Any, **options: Any) -> Channel:
        """The same for a caller that made the graph and the ledger itself, as filters do."""
        channel = cls.__new__(cls)
        with skip_validation():
            channel.__init__(*args, **options)  # type: ignore[misc]
        return channel

    def for_run(self, run: Any, ledger: Ledger) -> Channel:
        """The same with another account; of the numbers of all runs, or as one loses messages."""
        channel = Channel.construct(
            self.graph, ledger=ledger, runs=run.shape, faults=self.faults, t=self.t
        )
        channel._among = (
            self._among[0],
            slice(None) if run.ndim else slice(run, run + 1),
        )
        return channel

    @property
    def ledger(self) -> Ledger:
        """The account so far."""
        for size, rounds in self._owed.items():
            messages = rounds * self.graph.out_degree.astype(np.int64)
            self._ledger = self._charged(
                self._ledger, messages, size, 8 * size, rounds=rounds
            )
        self._owed = {}
        return self._ledger

    def _charged(
        self,
        ledger: Ledger,
        messages: Any,
        scalars: Any,
        bytes_: Any,
        *,
        rounds: int = 1,
        lost: Any = 0.0,
    ) -> Ledger:
        """The account after more rounds, in which agents sent so many messages of these sizes."""
        spoke = self.graph.senders.size > 0
        return ledger.replace(
            rounds=ledger.rounds + rounds * spoke,
            messages=ledger.messages + messages,
            scalars=ledger.scalars + messages * scalars,
            bytes=ledger.bytes + messages * bytes_,
            lost=ledger.lost + lost,
        )

    def broadcast(self, payloads: Sequence[Any]) -> list[dict[int, Any]]:
        """Let every agent send its payload to all that hear it.

        Parameters
        ----------
        payloads : sequence of length A
            Per agent a numeric array (*runs, ...), a flat tuple of them, or None to stay silent.
            Each entry counts as one scalar, of its own item size. What is missing is not sent:
            entries that are NaN (in all runs) cost nothing, and nothing but NaN is silence.

        Returns
        -------
        list of dict
            For each agent what arrived, by sender, in ascending order; the arrays are read-only.
            In a batch, the runs that lost a message find NaN in its place, and integers become
            floats there.
        """
        graph = self.graph
        sent, scalars, bytes_ = accounts.count_payload(
            payloads, graph.n_agents, self.runs
        )
        speaks = np.array([p is not None for p in sent])[graph.senders]
        arrived = self._transmit(speaks, scalars, bytes_)
        some = np.flatnonzero(arrived.any(axis=0))
        inbox = _by_receiver(graph, sent, some)
        for k in some[~arrived[:, some].all(axis=0)].tolist():
            receiver = int(graph.receivers[k])
            sender = int(graph.senders[k])
            here = arrived[:, k].reshape(self.runs)
            inbox[receiver][sender] = accounts.drop_lost(sent[sender], here)
        return inbox

    @validated
    def mix(
        self,
        values: _Own,
        weights: ConsensusWeights,
        *,
        lost: Lost = "mutual",
        rounds: PositiveInt = 1,
    ) -> Array:
        """Let every agent replace its value by a weighted sum of its own and what it hears.

        Parameters
        ----------
        values : array_like, (*runs, A, k)
            One vector per agent.
        weights : Weights
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
            How many times.
        """
        w = _matching(self.graph, weights)
        if self._perfect:
            return self._combine_all(values, w, rounds)
        for _ in range(rounds):
            values = self._combine_with_own(values, w, lost)[0]
        return values

    def _combine_all(self, v: Array, w: ConsensusWeights, rounds: int) -> Array:
        """Rounds without faults, agents in front throughout."""
        self._owed[v.shape[-1]] = self._owed.get(v.shape[-1], 0) + rounds
        front = np.moveaxis(v, -2, 0)
        flat = front.reshape(self.graph.n_agents, -1)
        for _ in range(rounds):
            flat = w.matrix @ flat
        return np.ascontiguousarray(np.moveaxis(flat.reshape(front.shape), 0, -2))

    @validated
    def send_on_links(
        self,
        values: Annotated[Array, "*self.runs self.graph.senders.size k"],
        *,
        links: Annotated[Mask, "self.graph.senders.size"] | None = None,
        acknowledged: bool = False,
    ) -> Array:
        """Send a payload of its own along each link.

        Parameters
        ----------
        values : array_like, (*runs, E, k)
            One vector per link, in the order of ``graph.receivers`` and ``graph.senders``.
        links : array_like of bool, (E,), optional
            The links that are used in this round; all by default. The others are not charged.
        acknowledged : bool
            Charge an acknowledgement for each message, of one byte, to the agent that it was for.

        Returns
        -------
        ndarray, (*runs, E, k)
            The same, with NaN where nothing arrives.
        """
        edges = self.graph.senders.size
        arrived = self._sent(values.shape[-1], links, acknowledged=acknowledged)
        return np.where(arrived.reshape(*self.runs, edges)[..., None], values, np.nan)

    def _combine_with_own(
        self, v: Array, w: ConsensusWeights, lost: Lost
    ) -> tuple[Array, Array]:
        """As :meth:`combine`, with the weight that each agent's own value got, (*runs, A)."""
        if self._perfect:
            return self._combine_all(v, w, 1), w.own
        k = v.shape[-1]
        size = self.graph.n_agents
        both = lost in ("mutual", "metropolis")
        if both and self.graph.directed:
            raise ValueError(f"lost: {lost!r} needs links both ways, got one-way links")
        # Metropolis weights need the degree of what is left, one number more.
        arrived = self._sent(k + (lost == "metropolis"), acknowledged=both, late=True)
        flat = v.reshape(-1, k)
        delay = self.faults.has_delay
        heard, arrived = self._delayed(flat, arrived) if delay else (flat, arrived)
        own, links = _after_loss(self.graph, w, arrived, lost)
        matrix = stack_weights(
            self.graph, own, links, heard_at=len(flat) if delay else 0
        )
        out = matrix @ (np.concatenate([flat, heard]) if delay else flat)
        return out.reshape(v.shape), own.reshape(*self.runs, size)

    def _sent(self, numbers: int, links: Mask | None = None, **options: bool) -> Mask:
        """Send so many numbers over some links, all by default; which messages arrive, (R, E)."""
        used = np.ones(self.graph.senders.size, dtype=bool) if links is None else links
        return self._transmit(used, numbers, 8 * numbers, **options)

    def _delayed(self, values: Array, arrived: Mask) -> tuple[Array, Mask]:
        """The values of some rounds ago, and on which links those arrive now."""
        queue = self._late.setdefault(values.shape, deque())
        queue.append((values.copy(), arrived))
        if len(queue) > self.faults.has_delay:
            return queue.popleft()  # type: ignore[no-any-return]
        return np.zeros_like(values), np.zeros_like(arrived)

    def _transmit(
        self,
        speaks: Mask,
        sizes: Any,
        bytes_: Any,
        *,
        acknowledged: bool = False,
        late: bool = False,
    ) -> Mask:
        """Charge one round in which the links in `speaks` are used; which arrive, (R, E)."""
        if self.faults.has_delay and not late:
            raise ValueError(
                f"channel must have no delay here, got {self.faults.has_delay} rounds"
            )
        now = self.ledger
        size = self.graph.n_agents
        (runs, here) = self._among
        if self._perfect:
            arrived = np.broadcast_to(speaks, (runs, speaks.size))[here]
            lost = np.zeros(size)
        else:
            speaks = speaks & self.faults.speaking(self.graph, now.rounds, self.t)
            arrived = (
                speaks & ~self.faults.lost(self.graph, now.rounds, runs, self.t)[here]
            )
            missing = (speaks & ~arrived).mean(axis=0)
            lost = np.bincount(
                self.graph.senders, weights=missing, minlength=size
            ).astype(float)
        messages = np.bincount(self.graph.senders[speaks], minlength=size)
        after = self._charged(now, messages, sizes, bytes_, lost=lost)
        if acknowledged:
            back = np.bincount(self.graph.receivers[speaks], minlength=size)
            after = self._charged(after, back, 0, 1, rounds=0)
        self._ledger = after
        return np.asarray(arrived)


def _by_receiver(graph: Graph, sent: Sequence[Any], links: Any) -> list[dict[int, Any]]:
    """What arrives on some links, given by their ascending numbers, for each agent by sender."""
    senders = graph.senders[links].tolist()
    messages = [sent[j] for j in senders]
    ends = np.searchsorted(
        graph.receivers[links], np.arange(graph.n_agents + 1)
    ).tolist()
    return [
        dict(zip(senders[i:j], messages[i:j], strict=True)) for i, j in pairwise(ends)
    ]


def _after_loss(
    graph: Graph, w: ConsensusWeights, arrived: Mask, lost: str
) -> tuple[Array, Array]:
    """Own and link weights of each run, (R, A) and (R, E), once some messages are missing."""
    ends = graph.receivers
    sums = partial(graph._summed, axis=1)
    if lost in ("mutual", "metropolis"):
        arrived = arrived & arrived[:, graph.reverse]
    if lost == "metropolis":
        degrees = sums(arrived.astype(np.float64))
        pair = np.maximum(degrees[:, ends], degrees[:, graph.senders])
        links = arrived / (1 + pair)
        return 1 - sums(links), links
    links = w.links * arrived
    own = np.broadcast_to(w.own, (arrived.shape[0], graph.n_agents))
    if lost in ("mutual", "keep"):
        own = own + sums(w.links * ~arrived)
    elif lost == "renormalise":
        total = own + sums(links)
        if (np.abs(total) < 1e-12).any():
            raise ValueError(
                "lost: 'renormalise' needs weights left, got a row that sums to 0"
            )
        own = own / total
        links = links / total[:, ends]
    return np.asarray(own), links


def fusion_rule(kind: Fused) -> Callable[[F], F]:
    """Say what a rule of agreement fuses, so that a filter can tell if the rule is for it.

    Parameters
    ----------
    kind : {"vectors", "ensembles", "gaussians", "mixtures", "densities", "particles"}
        What ``rule(belief, channel, *, …)`` takes and returns.

    Examples
    --------
    >>> @fusion_rule("vectors")
    ... def stubborn(belief, channel):
    ...     return belief
    >>> stubborn.belief_kind
    'vectors'
    """

    def named(rule: F) -> F:
        rule.belief_kind = kind  # type: ignore[attr-defined]
        return rule

    return named


def kind_of_rule(rule: Callable[..., Any]) -> str | None:
    """What a rule says that it fuses, also with options given by a partial; None if nothing.

    >>> from distfilt.network import average_consensus
    >>> kind_of_rule(partial(average_consensus, rounds=3)), kind_of_rule(print)
    ('vectors', None)
    """
    while isinstance(rule, partial):
        rule = rule.func
    return getattr(rule, "belief_kind", None)
