"""The channel between agents: it delivers messages along the links and keeps the ledger.

In shapes A is the number of agents, E that of links, and R that of independent runs of the network,
all of them in one axis; ``*runs`` are the runs in the axes that the caller gave them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ..periods import Periods
from ..validation import (
    Array,
    ArrayInput,
    Indices,
    InvalidArgumentError,
    Mask,
    MaskInput,
    PositiveInt,
    skip_validation,
    validated,
)
from .faults import Faults
from .graphs import Graph, as_graph
from .ledger import Counts, Ledger
from .weights import (
    ConsensusWeights,
    _check_same_links,
    interleave_weights,
    stack_weights,
)

__all__ = ["Channel", "LossRule", "PerAgent", "fusion_rule", "kind_of_rule"]

_PERFECT = Faults()

_BILLS = (
    *("messages", "scalars", "bytes"),
    *("transmissions", "broadcast_scalars", "broadcast_bytes"),
)
"""The counts of a ledger by link, and by broadcast."""

_BLOCK_SIZE = 2**15
"""Number of messages whose losses are drawn at a time: few enough to stay in the cache."""

_Values = Annotated[ArrayInput, "*self.runs self.graph.n_agents k"]

PerAgent = Annotated[ArrayInput, "*channel.runs channel.graph.n_agents k"]
"""One vector for each agent of an argument named `channel`."""

LossRule = Literal["mutual", "metropolis", "keep", "renormalise", "zero"]
"""Where :meth:`Channel.mix` puts the weight of a lost message; the last three move the average."""

BeliefKind = Literal[
    "vectors", "ensembles", "gaussians", "mixtures", "densities", "particles"
]
Part = NDArray[Any]
Payload = Part | tuple[Part, ...]
"""A message: a numeric array, or a flat tuple of them."""
F = TypeVar("F", bound=Callable[..., object])
P = TypeVar("P", bound=Payload)


class _Transmission(NamedTuple):
    """The scalars and bytes of a radio transmission that reaches all receivers of an agent."""

    scalars: int | Counts
    bytes: int | Counts


class _Size(NamedTuple):
    """The scalars and bytes of a round's messages: one number, or one for each link or agent.

    `transmission` is None if each message needs a transmission of its own. With `is_common`, each
    message on the agent's links is as large as the transmission.
    """

    scalars: int | Counts
    bytes: int | Counts
    transmission: _Transmission | None = None
    is_common: bool = False

    @classmethod
    def of_floats(cls, numbers: int) -> _Size:
        """Return the size of so many floats, the same for all receivers."""
        transmission = _Transmission(numbers, 8 * numbers)
        return cls(numbers, 8 * numbers, transmission, is_common=True)


@dataclass
class _Queues:
    """Messages on their way: the values of each round, and which of its messages arrive."""

    values: deque[Array] = field(default_factory=deque)
    arrivals: deque[Mask] = field(default_factory=deque)


class Channel:
    """Deliver payloads along a graph's links, lose or delay some, and charge for all of them.

    Everything that an agent learns from another passes through :meth:`broadcast` (any
    payload, to all neighbours), :meth:`unicast` (any payload, a different one on each
    link), :meth:`mix` (weighted sums of vectors, one sparse product) or
    :meth:`send_on_links` (a different vector on each link).

    Parameters
    ----------
    graph : Graph
        The links at this time; or a networkx graph, a matrix of links, or edges.
    ledger : Ledger, optional
        The ledger so far; empty by default. Its count of rounds numbers the losses.
    runs : tuple of int
        Leading axes of every payload that are independent runs of the same network.
        They are charged once, and lose different messages.
    faults : Faults, optional
        How the channel fails; not at all by default. A delay is for :meth:`mix` alone.
    t : float, optional
        The time, in s, to which the windows of faults then refer; to rounds without it.

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
        graph: object,
        *,
        ledger: Ledger | None = None,
        runs: tuple[PositiveInt, ...] = (),
        faults: Faults | None = None,
        t: float | None = None,
    ) -> None:
        n_agents = None if ledger is None else ledger.messages.size
        self.graph: Graph = as_graph(graph, n_agents)
        self.runs = runs
        self.faults = _PERFECT if faults is None else faults
        self.t = t
        # The periods of the beliefs' components, for rules of fusion: a filter sets them.
        self.periods: Periods = ()
        # Whether a graph of several parts is expected, and no reason for a warning.
        self.expects_parts = False
        self._ledger = Ledger.empty(self.graph.n_agents) if ledger is None else ledger
        # Losses are drawn for all runs of the batch, so that a channel that :meth:`for_run` made
        # for one of them loses the same messages.
        self._n_all_runs = math.prod(runs)
        self._own_runs = slice(None)
        # Number of rounds without faults that are not yet in the ledger, by message size.
        self._uncharged: dict[int, int] = {}
        # Messages on their way in a channel with a delay, by the shape of the values.
        self._queues: dict[tuple[int, ...], _Queues] = {}
        self._perfect = self.faults.is_perfect
        if not self._perfect:
            self.faults.check_graph(self.graph)

    @classmethod
    def construct(cls, *args: object, **options: object) -> Channel:
        """Build a channel without checks, from a graph and a ledger that the library made."""
        make: Callable[..., Channel] = cls
        with skip_validation():
            return make(*args, **options)

    def for_run(self, run: Indices, ledger: Ledger) -> Channel:
        """Return a copy with another ledger, for the runs that an array numbers, or for one.

        Parameters
        ----------
        run : ndarray of int, (*runs) or ()
            Numbers of all runs of the channel, or the number of one of them, without axes. That
            one loses the same messages as in the channel of all runs.
        ledger : Ledger
            The copy's ledger.
        """
        # A copy of all attributes, without the checks of the constructor.
        channel = object.__new__(type(self))
        vars(channel).update(vars(self))
        channel.runs = run.shape
        channel._ledger = ledger
        channel._uncharged = {}
        channel._queues = {}
        # Losses are drawn for all runs; of them the copy takes those of its own.
        channel._own_runs = slice(None) if run.ndim else slice(run, run + 1)
        return channel

    @property
    def ledger(self) -> Ledger:
        """The ledger so far."""
        if self._uncharged:
            self._charge_mixing()
        return self._ledger

    def broadcast(self, payloads: Sequence[P | None]) -> list[dict[int, P]]:
        """Let every agent send its payload to all that receive from it.

        Parameters
        ----------
        payloads : sequence of length A
            Per agent a numeric array (*runs, ...), a flat tuple of them, or None to
            stay silent. Each entry counts as one scalar, of its own item size. Missing
            entries are not sent: those that are NaN in all runs cost nothing, and a
            payload of NaN alone is silence.

        Returns
        -------
        list of dict
            The payloads that each agent receives, by sender, ascending; the arrays are
            read-only. In a batch, the runs that lost a message find NaN in its place,
            and integers become floats there.
        """
        graph = self.graph
        # Read-only copies, and the scalars and bytes of each, (A,)
        copies, scalars, bytes_ = _count_payloads(payloads, graph.n_agents, self.runs)
        # Copies have the types of what was given.
        sent = cast(list[P], copies)
        if self._perfect:
            self._charge_broadcast(sent, scalars, bytes_)
            return _deliver_everywhere(graph, sent)
        # A link is used if its sender is not silent.
        sends = np.array([payload is not None for payload in sent])
        size = _Size(
            scalars[graph.senders],
            bytes_[graph.senders],
            _Transmission(scalars, bytes_),
            is_common=True,
        )
        used = sends[graph.senders]
        # Which messages arrive in each run, (R, E)
        arrived = self._transmit(used, size)
        # A message is in the inbox if any run has received it.
        received = np.flatnonzero(arrived.any(axis=0))
        inbox = _group_by_receiver(graph, sent, received)
        # Where some runs have lost it, the receiver's entry for the sender is NaN in those.
        in_all_runs = arrived[:, received].all(axis=0)
        for link in received[~in_all_runs].tolist():
            receiver = int(graph.receivers[link])
            sender = int(graph.senders[link])
            by_run = arrived[:, link].reshape(self.runs)
            masked = _mask_lost(inbox[receiver][sender], by_run)
            inbox[receiver][sender] = cast(P, masked)
        return inbox

    def unicast(
        self,
        payloads: Sequence[P | None],
        *,
        common: Sequence[Payload | None] | None = None,
    ) -> list[P | None]:
        """Let every agent send a payload of its own on each of its links.

        Parameters
        ----------
        payloads : sequence of length E
            Per link, in the order of ``graph.receivers`` and ``graph.senders``, a
            payload as for :meth:`broadcast`, or None for silence.
        common : sequence of length A, optional
            Per agent the payload that serves all its receivers in one transmission, for
            the bill by broadcast; without it each message is a transmission of its own.

        Returns
        -------
        list of length E
            What arrives on each link, None where nothing does; lost entries are NaN as
            for :meth:`broadcast`.

        Examples
        --------
        >>> channel = Channel(Graph.from_edges(2, [(0, 1)]))
        >>> channel.unicast([np.array([1.0, 2.0]), None])
        [array([1., 2.]), None]
        >>> channel.ledger.scalars
        array([0, 2])
        """
        graph = self.graph
        n_links = graph.senders.size
        # Read-only copies, and the scalars and bytes of each, (E,)
        copies, scalars, bytes_ = _count_payloads(payloads, n_links, self.runs)
        sent = cast(list[P | None], copies)
        # The size of a transmission that serves all receivers, for the bill by broadcast
        transmission = None
        if common is not None:
            _copies, agent_scalars, agent_bytes = _count_payloads(
                common, graph.n_agents, self.runs
            )
            transmission = _Transmission(agent_scalars, agent_bytes)
        size = _Size(scalars, bytes_, transmission)
        used = np.array([payload is not None for payload in sent], dtype=bool)
        # Which messages arrive in each run, (R, E)
        arrived = self._transmit(used, size)
        result: list[P | None] = []
        for link, payload in enumerate(sent):
            if payload is None or not arrived[:, link].any():
                result.append(None)
            elif arrived[:, link].all():
                result.append(payload)
            else:
                # The runs that have lost the message find NaN.
                by_run = arrived[:, link].reshape(self.runs)
                result.append(cast(P, _mask_lost(payload, by_run)))
        return result

    @validated
    def mix(
        self,
        values: _Values,
        weights: ConsensusWeights,
        *,
        on_loss: LossRule = "mutual",
        rounds: PositiveInt = 1,
    ) -> Array:
        r"""Let every agent replace its value by a weighted sum of it and the received ones.

        .. math:: \mathbf x_i\leftarrow w_{ii}\mathbf x_i+\sum_j w_{ij}\mathbf x_j

        The sum is over the agents j from which i has a link.

        Parameters
        ----------
        values : array_like, (*runs, A, k)
            One vector per agent.
        weights : ConsensusWeights
            The weights of the sums.
        on_loss : {"mutual", "metropolis", "keep", "renormalise", "zero"}
            Where the weight of a lost message goes.

            - ``"mutual"``: a link counts only if both its messages arrive, which both ends learn
              by acknowledgements; otherwise its weight is added to :math:`w_{ii}` at both ends.
              Keeps the average for symmetric weights.
            - ``"metropolis"``: the same, and the weights are the Metropolis weights of the links
              that are left; the given ones are not used.
            - ``"keep"``: to the receiver's own value. ``"renormalise"``: to all values that it
              has. ``"zero"``: nowhere. These move the average.
        rounds : int
            Number of rounds.

        Returns
        -------
        ndarray, (*runs, A, k)
            The values after the last round.
        """
        _check_same_links(weights, self.graph)
        if self._perfect:
            return self._mix_without_faults(values, weights, rounds)
        after_rounds = self._mix_rounds(values, weights, on_loss, rounds)
        # The values after the last round
        mixed, _self_weights = deque(after_rounds, maxlen=1).pop()
        return mixed

    @validated
    def send_on_links(
        self,
        values: Annotated[ArrayInput, "*self.runs self.graph.senders.size k"],
        *,
        links: Annotated[MaskInput, "self.graph.senders.size"] | None = None,
        acknowledged: bool = False,
        is_broadcast: bool = False,
    ) -> Array:
        """Send a different payload along each link.

        Parameters
        ----------
        values : array_like, (*runs, E, k)
            One vector per link, in the order of ``graph.receivers`` and
            ``graph.senders``.
        links : array_like of bool, (E,), optional
            The links that are used in this round; all by default. The others are not
            charged.
        acknowledged : bool
            Charge an acknowledgement of one byte for each message, to its receiver.
        is_broadcast : bool
            Whether an agent's messages are equal on all its links, so that one
            transmission carries them in the bill by broadcast.

        Returns
        -------
        ndarray, (*runs, E, k)
            The same values, with NaN where nothing arrives.
        """
        arrived = self._transmit_numbers(
            values.shape[-1],
            links,
            acknowledged=acknowledged,
            is_broadcast=is_broadcast,
        )
        # Flags (*runs, E)
        by_run = arrived.reshape(*self.runs, self.graph.senders.size)
        return np.where(by_run[..., None], values, np.nan)

    def _mix_without_faults(
        self, values: Array, weights: ConsensusWeights, rounds: int
    ) -> Array:
        """Mix values (*runs, A, k) in rounds in which every message arrives at once.

        The weights are those of each agent's value and of each link.
        """
        # The ledger adds these rounds when it is read: each time it would cost more than the
        # product.
        size = values.shape[-1]
        self._uncharged[size] = self._uncharged.get(size, 0) + rounds
        # One sparse product for all runs and components, agents first.
        agents_first = np.moveaxis(values, -2, 0)
        flat = agents_first.reshape(self.graph.n_agents, -1)
        for _ in range(rounds):
            flat = weights.matrix @ flat
        # Back to (*runs, A, k)
        mixed = np.moveaxis(flat.reshape(agents_first.shape), 0, -2)
        return np.ascontiguousarray(mixed)

    def _mix_once(
        self, values: Array, weights: ConsensusWeights, on_loss: LossRule
    ) -> tuple[Array, Array]:
        """Return the mixed values, and the weight that each own value got, (*runs, A)."""
        if self._perfect:
            mixed = self._mix_without_faults(values, weights, rounds=1)
            return mixed, weights.self_weights
        return next(self._mix_rounds(values, weights, on_loss, rounds=1))

    def _mix_rounds(
        self, values: Array, weights: ConsensusWeights, on_loss: LossRule, rounds: int
    ) -> Iterator[tuple[Array, Array]]:
        """Mix values (*runs, A, k) in rounds with faults.

        Yield after each round the values, and the weights that the agents' own values got,
        (*runs, A): these grow where the weight of a lost message stays with the receiver.
        """
        both_ways = on_loss in ("mutual", "metropolis")
        if both_ways and self.graph.is_directed:
            raise ValueError(
                "on_loss must not be "
                f"{on_loss!r} on a graph with one-way links, which needs links both ways"
            )
        size = values.shape[-1]
        # Metropolis weights need the sender's number of working links: one number more.
        numbers = size + 1 if on_loss == "metropolis" else size
        flat = values.reshape(-1, size)
        # Losses and weights of many rounds at once, as many as the cache holds. Losses are drawn
        # for all runs of the batch, also where this channel is for one of them.
        block = max(1, _BLOCK_SIZE // (1 + self._n_all_runs * self.graph.senders.size))
        while rounds > 0:
            # Every link carries a message in every round. If both ends must know whether it came,
            # the receiver acknowledges it.
            # Which messages arrive is (count, R, E).
            used = np.ones(self.graph.senders.size, dtype=bool)
            count = min(rounds, block)
            arrived = self._transmit_rounds(
                count, used, _Size.of_floats(numbers), acknowledged=both_ways
            )
            rounds -= count
            for mixed, self_weights in self._mix_block(flat, weights, arrived, on_loss):
                flat = mixed
                by_run = self_weights.reshape(*self.runs, self.graph.n_agents)
                yield mixed.reshape(values.shape), by_run

    def _mix_block(
        self, flat: Array, weights: ConsensusWeights, arrived: Mask, on_loss: LossRule
    ) -> Iterator[tuple[Array, Array]]:
        """Mix values of R runs in rounds of which it is known which messages arrive.

        Parameters
        ----------
        flat : ndarray, (R A, k)
            The agents' values, one run below the other.
        weights, on_loss
            As for :meth:`mix`.
        arrived : ndarray of bool, (rounds, R, E)
            Whether each link delivers its message.

        Yields
        ------
        values, self_weights : ndarray, (R A, k) and (R, A)
            After each round.
        """
        graph = self.graph
        # Rows by which delayed values lie below the present ones in the product; 0 without a delay.
        offset = 0
        if self.faults.total_delay:
            # The messages that arrive now were sent in earlier rounds.
            offset = len(flat)
            arrived = self._delay_arrivals(flat.shape, arrived)
        n_rounds, n_runs, n_links = arrived.shape
        # Weights of all rounds and runs, (rounds R, A) and (rounds R, E)
        self_weights, link_weights = _weights_after_loss(
            graph, weights, arrived.reshape(n_rounds * n_runs, n_links), on_loss
        )
        # One block-diagonal matrix for the R runs of the first round
        matrix = stack_weights(
            graph, self_weights[:n_runs], link_weights[:n_runs], received_offset=offset
        )
        # The matrices of all rounds have their entries at the same places: only the entries change.
        entries = interleave_weights(graph, self_weights, link_weights)
        entries = entries.reshape(n_rounds, -1)
        by_round = self_weights.reshape(n_rounds, n_runs, graph.n_agents)
        for k in range(n_rounds):
            matrix.data = entries[k]
            present_and_late = flat
            if offset:
                # An agent's own value is of this round, those received are late: this round's
                # values join a queue, and those of earlier ones leave it, (R A, k). Appended
                # below, they take part in the same product.
                present_and_late = np.concatenate([flat, self._delay_values(flat)])
            flat = matrix @ present_and_late
            yield flat, by_round[k]

    def _delay_values(self, values: Array) -> Array:
        """Return the values of some rounds ago; zeros, without a weight, before the first."""
        # Values of each shape wait in a queue of their own, as copies: the array may be changed
        # before they are used.
        queue = self._queues.setdefault(values.shape, _Queues()).values
        queue.append(values.copy())
        if len(queue) > self.faults.total_delay:
            return queue.popleft()
        return np.zeros_like(values)

    def _delay_arrivals(self, shape: tuple[int, ...], arrived: Mask) -> Mask:
        """Return for each round which messages of some rounds ago arrive, (rounds, R, E)."""
        queue = self._queues.setdefault(shape, _Queues()).arrivals
        delayed = np.zeros_like(arrived)
        for k, links in enumerate(arrived):
            queue.append(links)
            # Nothing arrives before the first message has been on its way for so long.
            if len(queue) > self.faults.total_delay:
                delayed[k] = queue.popleft()
        return delayed

    def _transmit_numbers(
        self,
        numbers: int,
        links: Mask | None = None,
        *,
        acknowledged: bool = False,
        is_broadcast: bool = True,
    ) -> Mask:
        """Send so many floats over links (E,), all by default; return which arrive, (R, E).

        Arguments are those of :meth:`send_on_links`; with R runs and E links.
        """
        # The usual case is faster.
        if links is None and self._perfect and is_broadcast and not acknowledged:
            return self._transmit_everywhere(numbers)
        if links is None:
            links = self.graph._every_link
        # Scalars and bytes of a message, eight bytes a float; without `of_floats` there is no
        # transmission that serves all receivers.
        size = _Size.of_floats(numbers)
        if not is_broadcast:
            size = _Size(numbers, 8 * numbers)
        return self._transmit(links, size, acknowledged=acknowledged)

    def _transmit(self, used: Mask, size: _Size, *, acknowledged: bool = False) -> Mask:
        """Charge one round on the links in use, and return which messages arrive, (R, E).

        The links in use are a mask (E,), and `size` is that of a message. An acknowledged message
        costs its receiver a byte in return.
        """
        if self.faults.total_delay:
            raise ValueError(
                "channel must have no delay here, "
                f"got one of {self.faults.total_delay} rounds"
            )
        if not self._perfect:
            arrived = self._transmit_rounds(
                count=1, used=used, size=size, acknowledged=acknowledged
            )
            return np.asarray(arrived[0])
        # Without faults every message arrives, in each run.
        self._charge(used[None], size, acknowledged=acknowledged)
        if self._n_all_runs == 1:
            return used[None]
        return self._repeat_for_runs(used)

    def _transmit_everywhere(self, numbers: int) -> Mask:
        """Send so many floats over every link of a channel without faults, and charge that."""
        graph = self.graph
        self._add_to_ledger(graph._bill_of_floats(numbers))
        if self._n_all_runs == 1:
            return graph._every_link[None]
        return self._repeat_for_runs(graph._every_link)

    def _charge_broadcast(
        self, sent: Sequence[Payload | None], scalars: Counts, bytes_: Counts
    ) -> None:
        """Charge a round in which agents send payloads of these sizes to all their receivers.

        The payload of each agent is in `sent`, None for silence; scalars and bytes are (A,).
        """
        graph = self.graph
        # 1 for an agent that sends, 0 for a silent one
        sends = np.array([payload is not None for payload in sent], dtype=np.int64)
        bill = []
        # First by link, a message to each receiver, then by broadcast, one transmission to all.
        for count in (graph.messages_a_round, graph.is_sender):
            used = count * sends
            bill += [used, used * scalars, used * bytes_]
        self._add_to_ledger(bill)

    def _add_to_ledger(self, bill: Sequence[Counts]) -> None:
        """Enter one round without a loss: what each agent sends, in the order of `_BILLS`."""
        ledger = self._ledger
        # A graph without links has no rounds.
        rounds = ledger.rounds + (1 if self.graph.senders.size else 0)
        totals = [
            getattr(ledger, name) + n for name, n in zip(_BILLS, bill, strict=True)
        ]
        by_link = totals[:3]
        by_broadcast = totals[3:]
        self._ledger = Ledger.construct(rounds, *by_link, ledger.lost, *by_broadcast)

    def _repeat_for_runs(self, used: Mask) -> Mask:
        """Return the links in use, (E,), for each run of this channel, (R, E)."""
        everywhere = np.broadcast_to(used, (self._n_all_runs, used.size))
        return np.asarray(everywhere[self._own_runs])

    def _transmit_rounds(
        self, count: int, used: Mask, size: _Size, *, acknowledged: bool
    ) -> Mask:
        """Charge some rounds with faults, and return which messages arrive, (count, R, E).

        The links in use are a mask (E,), and `size` is that of a message; there are R runs. An
        acknowledged message costs its receiver a byte in return.
        """
        graph = self.graph
        first = self.ledger.rounds
        # A graph without links has no rounds, so that their number does not grow.
        step = 1 if graph.senders.size else 0
        rounds = [first + k * step for k in range(count)]
        # Silent agents send nothing, which costs nothing.
        active = [self.faults.active_links(graph, round_, self.t) for round_ in rounds]
        used_by_round = used & np.array(active)
        draws = self.faults.draw_rounds(
            graph, range(first, first + count), self._n_all_runs, self.t
        )
        # The losses are those of all runs of the batch, of which this channel has its own.
        arrived = used_by_round[:, None] & ~draws[:, self._own_runs]
        # The ledger counts losses as the mean over the runs. Rounds are added one after the other,
        # so that a block of rounds gives the same floating-point sum as single ones.
        missing = (used_by_round[:, None] & ~arrived).mean(axis=1)
        lost = self.ledger.lost
        for row in missing:
            lost = lost + self._count_by_agent(graph.senders, row)
        self._charge(used_by_round, size, acknowledged=acknowledged)
        self._ledger = self._ledger.replace(lost=lost)
        return np.asarray(arrived)

    def _count_by_agent(
        self, agents: Indices, weights: Array | None = None
    ) -> Counts | Array:
        """Return how often each agent occurs in an array, or the sum of its weights, (A,)."""
        counts: Counts | Array = np.bincount(
            agents, weights, minlength=self.graph.n_agents
        )
        return counts

    def _charge_mixing(self) -> None:
        """Add the waiting rounds of `_mix_without_faults` to the ledger; every link was used."""
        uncharged = self._uncharged
        self._uncharged = {}
        every_link = self.graph._every_link[None]
        for numbers, rounds in uncharged.items():
            self._charge(every_link, _Size.of_floats(numbers), repeated=rounds)

    def _charge(
        self,
        used_by_round: Mask,
        size: _Size,
        *,
        acknowledged: bool = False,
        repeated: int = 1,
    ) -> None:
        """Add messages to the ledger: per link, and per transmission to all receivers at once.

        Parameters
        ----------
        used_by_round : ndarray of bool, (rounds, E)
            The links that carry a message.
        size : _Size
            Scalars and bytes of a message.
        acknowledged : bool
            Add an acknowledgement of one byte for each message, to its receiver.
        repeated : int
            How often the rounds took place.
        """
        graph = self.graph
        # Not `self.ledger`, which would first add the rounds that are not yet in it.
        ledger = self._ledger
        totals: dict[str, object] = {}
        # A graph without links has no rounds.
        if graph.senders.size:
            totals["rounds"] = ledger.rounds + repeated * len(used_by_round)
        bills = self._count_bills(used_by_round, size, acknowledged, repeated)
        for name, amount in zip(_BILLS, bills, strict=True):
            totals[name] = getattr(ledger, name) + amount
        self._ledger = ledger.replace(**totals)

    def _count_bills(
        self, used_by_round: Mask, size: _Size, acknowledged: bool, repeated: int
    ) -> list[Counts]:
        """Return messages, scalars and bytes of each agent per link, then per transmission.

        That is the order of the ledger's fields in `_BILLS`. The arguments are those of
        :meth:`_charge`. Each count is (A,).
        """
        graph = self.graph
        if size.is_common and size.transmission is not None and not acknowledged:
            # The usual case: an agent sends the same on all its links, or on those in use.
            if np.count_nonzero(used_by_round) == used_by_round.size:
                rounds = repeated * len(used_by_round)
                messages = rounds * graph.messages_a_round
                sends = rounds * graph.is_sender
            else:
                uses = repeated * used_by_round.sum(axis=0)
                links_in_use = self._count_by_agent(graph.senders, uses)
                messages = np.asarray(links_in_use, dtype=np.int64)
                sends = repeated * self._count_transmissions(used_by_round)
            # A message on a link is as large as a transmission.
            scalars, bytes_ = size.transmission
            links_bill = [messages, messages * scalars, messages * bytes_]
            return [*links_bill, sends, sends * scalars, sends * bytes_]
        # How often each link was used.
        uses = repeated * used_by_round.sum(axis=0)
        by_link: list[Counts | Array] = []
        for weights in (uses, uses * size.scalars, uses * size.bytes):
            # The sum over the links on which an agent sends
            by_link.append(self._count_by_agent(graph.senders, weights))
        # Without a common one each message is a transmission of its own.
        by_agent = by_link
        if size.transmission is not None:
            sends = repeated * self._count_transmissions(used_by_round)
            by_agent = [sends, *[sends * part for part in size.transmission]]
        amounts = [np.asarray(n, dtype=np.int64) for n in (*by_link, *by_agent)]
        if acknowledged:
            # One byte back for each message: messages and bytes of both bills grow.
            replies = np.asarray(self._count_by_agent(graph.receivers, uses), np.int64)
            for name in ("messages", "bytes", "transmissions", "broadcast_bytes"):
                k = _BILLS.index(name)
                amounts[k] = amounts[k] + replies
        return amounts

    def _count_transmissions(self, used_by_round: Mask) -> Counts:
        """Return in how many rounds each agent sends on any link, (A,)."""
        graph = self.graph
        # Every agent that has a receiver sends in every round.
        if used_by_round.all():
            return len(used_by_round) * graph.is_sender
        sends = np.zeros(graph.n_agents, dtype=np.int64)
        for used in used_by_round:
            sends += self._count_by_agent(graph.senders[used]) > 0
        return sends


def _count_payloads(
    payloads: object, agents: int, runs: tuple[int, ...]
) -> tuple[list[Payload | None], Counts, Counts]:
    """Return read-only copies of the agents' payloads, and the scalars and bytes of each, (A,).

    Entries that are NaN in all runs are not sent. A payload without any other entry is
    silence, like None, and comes back as None.
    """
    if not isinstance(payloads, Sequence | np.ndarray) or len(payloads) != agents:
        size = len(payloads) if hasattr(payloads, "__len__") else None
        received = type(payloads).__name__ if size is None else size
        raise InvalidArgumentError(
            f"payloads must be a list with one entry for each of {agents} agents, got {received}"
        )
    n_runs = math.prod(runs)
    sent: list[Payload | None] = [None] * agents
    scalars = [0] * agents
    bytes_ = [0] * agents
    for agent, payload in enumerate(payloads):
        # None is silence, which costs nothing.
        if payload is None:
            continue
        is_tuple = type(payload) is tuple
        parts = payload if is_tuple else (payload,)
        if not parts:
            raise ValueError(
                f"payloads[{agent}] must have arrays, or None to stay silent, got ()"
            )
        # Copied even if the payload turns out to be silence: the checks come with it.
        copies = [_copy_part(part, agent, runs) for part in parts]
        silent = True
        for part in copies:
            # The number of entries that a run sends
            count = part.size // n_runs
            # Of floats, "f": a sum of squares is NaN only if an entry is, and takes half as long as
            # np.isnan.
            if part.dtype.kind == "f" and math.isnan(np.vdot(part, part)):
                count = _count_present(part, n_runs)
            scalars[agent] += count
            bytes_[agent] += count * part.itemsize
            # An empty array is a message without content, not silence.
            silent = silent and count == 0 and part.size > 0
        if not silent:
            sent[agent] = tuple(copies) if is_tuple else copies[0]
    return sent, np.array(scalars), np.array(bytes_)


def _copy_part(part: object, agent: int, runs: tuple[int, ...]) -> Part:
    """Return a read-only copy of an array, or refuse anything else.

    The part is one of an agent's payload, with the leading axes of the runs.
    """
    # A masked array's mask, or an object, could carry numbers that are not counted. numpy's letters
    # "biuf" are booleans, integers with and without a sign, and floats.
    plain = part if isinstance(part, np.ndarray) else None
    if isinstance(part, np.ma.MaskedArray):
        plain = None
    if plain is None or plain.dtype.kind not in "biuf":
        name = type(part).__name__ if plain is None else f"dtype {plain.dtype}"
        raise InvalidArgumentError(
            f"payloads[{agent}] must be an array of real numbers, a flat tuple of them "
            f"or None, got {name}"
        )
    if plain.shape[: len(runs)] != runs:
        raise ValueError(
            f"payloads[{agent}] must have leading axes {runs}, got shape {plain.shape}"
        )
    # The sender may go on computing in its own array.
    copy: Part = np.array(plain)
    copy.flags.writeable = False
    return copy


def _count_present(part: Part, n_runs: int) -> int:
    """Return the number of entries of a run, except those that are NaN in every run."""
    present = ~np.isnan(part).reshape(n_runs, -1)
    return int(present.any(axis=0).sum())


def _mask_lost(payload: Payload, arrived: Mask) -> Payload:
    """Return read-only copies of a payload with NaN in the runs that lost the message."""
    if isinstance(payload, tuple):
        return tuple([_mask_part(part, arrived) for part in payload])
    return _mask_part(payload, arrived)


def _mask_part(payload: Part, arrived: Mask) -> Part:
    """Return a read-only copy of an array (*runs, ...) with NaN where nothing arrived, (*runs)."""
    # One flag for each run, for all of the payload's other axes.
    axes = (1,) * (payload.ndim - arrived.ndim)
    masked = np.where(arrived.reshape(arrived.shape + axes), payload, np.nan)
    masked.flags.writeable = False
    return masked


def _deliver_everywhere(graph: Graph, sent: Sequence[P | None]) -> list[dict[int, P]]:
    """Return for each agent the messages of all that it receives from, by sender, ascending.

    The payload of each agent is in `sent`, None for silence.
    """
    inbox: list[dict[int, P]] = [{} for _ in sent]
    for sender, payload in enumerate(sent):
        if payload is not None:
            for receiver in graph._receivers_of[sender]:
                inbox[receiver][sender] = payload
    return inbox


def _group_by_receiver(
    graph: Graph, sent: Sequence[P], links: Indices
) -> list[dict[int, P]]:
    """Return for each agent the messages on some links, ascending numbers, by sender.

    The payload of each agent is in `sent`. The links are those that deliver, (n,).
    """
    senders = graph.senders[links].tolist()
    # Links are ordered by receiver: agent i has those from bounds[i] to before bounds[i + 1].
    agents = np.arange(graph.n_agents + 1)
    bounds = np.searchsorted(graph.receivers[links], agents).tolist()
    inbox = []
    for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
        inbox.append({sender: sent[sender] for sender in senders[start:stop]})
    return inbox


def _weights_after_loss(
    graph: Graph, weights: ConsensusWeights, arrived: Mask, on_loss: LossRule
) -> tuple[Array, Array]:
    """Return self-weights (R, A) and link weights (R, E) of each run after losses.

    For R runs, A agents and E links, `arrived` (R, E) marks the links that have delivered; the
    rules are those of :meth:`Channel.mix`.
    """
    receivers = graph.receivers
    # From a number for each link (R, E) to the sum over the links to each agent, (R, A).
    sum_links = partial(graph._sum_by_receiver, axis=1)
    if on_loss in ("mutual", "metropolis"):
        # A link counts only if its opposite has delivered too.
        arrived = arrived & arrived[:, graph.reverse]
    if on_loss == "metropolis":
        degrees = sum_links(arrived.astype(np.float64))
        larger = np.maximum(degrees[:, receivers], degrees[:, graph.senders])
        # w_ij = 1 / (1 + max(d_i, d_j)) with the degrees of this round.
        link_weights = arrived / (1 + larger)
        return 1 - sum_links(link_weights), link_weights

    # A lost message has no weight; for "zero" that is all.
    link_weights = weights.link_weights * arrived
    shape = (arrived.shape[0], graph.n_agents)
    self_weights = np.broadcast_to(weights.self_weights, shape)
    if on_loss in ("mutual", "keep"):
        # The own value takes over the weights of lost messages.
        self_weights = self_weights + sum_links(weights.link_weights * ~arrived)
    elif on_loss == "renormalise":
        total = self_weights + sum_links(link_weights)
        # Weights are of the size of one, so that a smaller sum is zero but for rounding.
        if (np.abs(total) < 1e-12).any():
            raise ValueError(
                "on_loss must not be 'renormalise' where the weights of received messages "
                "and of the own value sum to 0"
            )
        # Rows sum to one again.
        self_weights = self_weights / total
        link_weights = link_weights / total[:, receivers]
    return np.asarray(self_weights), link_weights


def fusion_rule(kind: BeliefKind) -> Callable[[F], F]:
    """Declare a rule's kind of belief, so that a filter can refuse one of another kind.

    Parameters
    ----------
    kind : {"vectors", "ensembles", "gaussians", "mixtures", "densities", "particles"}
        The beliefs that ``rule(belief, channel, *, …)`` takes and returns.

    Examples
    --------
    >>> @fusion_rule("vectors")
    ... def stubborn(belief, channel):
    ...     return belief
    >>> stubborn.belief_kind
    'vectors'
    """

    def declare(rule: F) -> F:
        rule.belief_kind = kind  # type: ignore[attr-defined]
        return rule

    return declare


def kind_of_rule(rule: Callable[..., object]) -> str | None:
    """Return the kind of belief that a rule declares, through partials; None without a declaration.

    >>> from distfilt.network import average_consensus
    >>> kind_of_rule(partial(average_consensus, rounds=3)), kind_of_rule(print)
    ('vectors', None)
    """
    while isinstance(rule, partial):
        rule = rule.func
    return getattr(rule, "belief_kind", None)
