"""Faults of a channel: lost messages, alone or in bursts, delays, and silent agents."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    Indices,
    Mask,
    NonNegativeInt,
    UnitInterval,
    check_array,
)
from .graphs import Graph

if TYPE_CHECKING:
    Windows = Sequence[Sequence[float]] | Array
else:
    # Checked by `_check_windows`, which converts it.
    Windows = object

__all__ = ["Faults"]

Hashes = NDArray[np.uint64]

_GOLDEN = 0x9E3779B97F4A7C15
"""2^64 divided by the golden ratio: the increment of the generator splitmix64."""

_LOOKBACK = 16
"""Rounds of a burst that are looked up at a time; most bursts have begun within them."""

_PROBABILITY = Bounds(at_least=0, at_most=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Faults(FrozenModel):
    r"""How a channel fails. ``faults | other`` fails in both ways.

    Parameters
    ----------
    loss : float or array_like, (A,) or (A, A)
        Probability that a message is lost, in [0, 1]; one for each receiver, or
        ``loss[i, j]`` for messages from agent j to agent i.
    seed : int
        Of the losses. Whether a message is lost is a function of seed, run, round and
        link alone. So every agent, or every process of a real network, can compute it,
        and no draw depends on earlier draws.
    burst_length : float, optional
        Mean number of rounds for which a link that fails keeps failing. By default
        losses are independent, which gives the shortest possible bursts, 1 / (1 - loss)
        rounds.
    delay : int
        Rounds by which a message arrives later, in a channel that lives as long; for
        :meth:`Channel.mix` alone.
    silent : collection of int
        Agents whose radio is off: they neither send nor receive.
    during : sequence of (start, stop), optional
        Windows in which messages are lost and agents are silent: from `start` to before
        `stop`, in s where the channel has a time `t`, as in filters, and in rounds of
        its ledger otherwise. Always by default; `stop` may be infinite.
    others : tuple of Faults
        Further faults; ``|`` fills it.

    Notes
    -----
    Bursts are a two-state Markov chain on each link (E. N. Gilbert, Bell System
    Technical Journal 39 (1960) 1253-1265, with nothing lost in one state and everything
    in the other). One number is drawn for each round. In most rounds it decides the
    next state whatever the last one was, and the state in any round follows from the
    latest such round. It is exact from the first round on and depends on no earlier
    computation.

    Examples
    --------
    >>> Faults(loss=0.2, seed=7).draw_losses(
    ...     Graph.from_adjacency([[0, 1], [1, 0]]), 0, 5
    ... ).shape
    (5, 2)

    Agent 3 is off for a while, and all links fail for 8 rounds at a time:

    >>> faults = Faults(loss=0.1, burst_length=8.0) | Faults(
    ...     silent=[3], during=[(10, 20)]
    ... )
    >>> faults.is_perfect
    False
    """

    loss: (
        UnitInterval
        | Annotated[Array, "A", _PROBABILITY]
        | Annotated[Array, "A A", _PROBABILITY]
    ) = 0.0
    seed: NonNegativeInt = 0
    burst_length: Annotated[float, Bounds(at_least=1)] | None = None
    delay: NonNegativeInt = 0
    silent: Collection[NonNegativeInt] = ()
    during: Windows | None = None
    others: tuple[Faults, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        loss = np.asarray(self.loss)
        # With independent losses of probability p, a burst lasts 1 / (1 - p) rounds on average.
        shortest = 1 / (1 - loss[loss < 1].max(initial=0.0))
        # A caller may compute the limit itself, and round it to the other side.
        if self.burst_length is not None and self.burst_length < shortest * (1 - 1e-9):
            raise ValueError(
                f"burst_length must be at least 1 / (1 - loss) = {shortest:g} rounds, the mean "
                f"length with independent losses, got {self.burst_length:g}"
            )
        # The dataclass is frozen, so that the field cannot be assigned to.
        if self.during is not None:
            object.__setattr__(self, "during", _check_windows(self.during))

    def __or__(self, other: Faults) -> Faults:
        if not isinstance(other, Faults):
            return NotImplemented
        # Two losses of one seed would fail together.
        common = self._seeds_of_losses() & other._seeds_of_losses()
        if common:
            raise ValueError(
                "seed must differ between faults that lose messages, "
                f"got {min(common)} twice"
            )
        return replace(self, others=(*self.others, *other._flatten()))

    def _flatten(self) -> tuple[Faults, ...]:
        """Return these faults and all further ones, each without others."""
        flat = [self.replace(others=())]
        for faults in self.others:
            flat.extend(faults._flatten())
        return tuple(flat)

    def _seeds_of_losses(self) -> set[int]:
        """Return the seeds of all faults that lose messages."""
        return {faults.seed for faults in self._flatten() if np.any(faults.loss)}

    def check_graph(self, graph: Graph) -> None:
        """Refuse a graph with another number of agents than `loss` has, or without a silent one."""
        n_agents = graph.n_agents
        # These faults and all that have been added by ``|``
        for faults in self._flatten():
            # One number, one for each agent, or one for each pair.
            shape = np.shape(faults.loss)
            if shape != (n_agents,) * len(shape):
                raise ValueError(
                    f"loss must be a number for each of {n_agents} agents, got {shape}"
                )
            # Agents are numbered from 0; -1 passes where none is silent.
            Bounds(below=n_agents)(max(faults.silent, default=-1), "silent")

    @cached_property
    def is_perfect(self) -> bool:
        """Whether nothing ever fails."""
        for faults in self._flatten():
            if np.any(faults.loss) or faults.delay or faults.silent:
                return False
        return True

    @cached_property
    def always_silent(self) -> frozenset[int]:
        """Agents that are silent at all times."""
        silent: set[int] = set()
        for faults in self._flatten():
            if faults.during is None:
                silent.update(faults.silent)
        return frozenset(silent)

    @cached_property
    def total_delay(self) -> int:
        """Rounds by which a message arrives later, all delays together."""
        return sum(faults.delay for faults in self._flatten())

    def active_links(
        self, graph: Graph, round_: int = 0, t: float | None = None
    ) -> Mask:
        """Return the links of which both ends have their radio on in a round, (E,)."""
        off = np.zeros(graph.n_agents, dtype=bool)
        for faults in self._flatten():
            if faults.silent and faults._is_active(round_, t):
                off[list(faults.silent)] = True
        return ~(off[graph.receivers] | off[graph.senders])

    def draw_losses(
        self, graph: Graph, round_: int, runs: int, t: float | None = None
    ) -> Mask:
        """Return which links lose the message of round `round_` in each run, (runs, E)."""
        lost = self.draw_rounds(graph, range(round_, round_ + 1), runs, t)
        return np.asarray(lost[0])

    def draw_rounds(
        self, graph: Graph, rounds: range, runs: int, t: float | None = None
    ) -> Mask:
        """Return which links lose their message in each of some successive rounds.

        The result (rounds, runs, E) has the losses of :meth:`draw_losses` for each round; drawn
        together they cost less time.
        """
        lost = np.zeros((len(rounds), runs, graph.senders.size), dtype=bool)
        # These faults and all that have been added by ``|``
        for faults in self._flatten():
            if not np.any(faults.loss):
                continue
            active = [faults._is_active(round_, t) for round_ in rounds]
            if any(active):
                # Losses (rounds, runs, E), which count in the rounds that lie in a window.
                draws = faults._draw_rounds(graph, rounds, runs)
                lost |= draws & np.array(active)[:, None, None]
        return lost

    def _is_active(self, round_: int, t: float | None) -> bool:
        """Return whether a round, or a time if there is one, lies in a window."""
        if self.during is None:
            return True
        now = round_ if t is None else t
        return any(start <= now < stop for start, stop in self.during)

    def _draw_rounds(self, graph: Graph, rounds: range, runs: int) -> Mask:
        """Return the losses of some rounds, (rounds, runs, E), as if `during` were always."""
        probability = self._link_probabilities(graph)
        # A uniform number for each round, run and link, made of random bits of the two
        link_bits = _link_bits(graph)
        uniform = _uniform(self._run_bits(rounds, runs)[:, :, None] ^ link_bits)
        if self.burst_length is None:
            return np.asarray(uniform < probability)

        # Gilbert's two-state Markov chain. A failing link fails again with probability
        # enter + stay = 1 - 1/burst_length; a working one fails next with probability enter. The
        # stationary probability of failing is then enter / (1 - stay) = loss. Both equations give
        # stay = 1 - 1 / (burst_length (1 - loss)), clipped at zero for rounding. A link that always
        # or never fails has no bursts.
        probability = np.broadcast_to(probability, link_bits.shape)
        is_random = (probability > 0) & (probability < 1)
        success = np.where(is_random, 1 - probability, 1.0)
        stay = np.where(is_random, 1 - 1 / (self.burst_length * success), 0.0).clip(0)
        enter = probability * (1 - stay)
        # u < enter: lost; enter <= u < enter + stay: as in the round before; otherwise it arrives.
        lost = uniform < enter
        repeats = ~lost & (uniform < enter + stay)
        # Links of the first round that repeat one not among these: it is looked up, and the result
        # is written into lost[0].
        unknown = np.nonzero(repeats[0])
        self._look_back(lost[0], unknown, rounds[0], link_bits, enter, stay)
        for k in range(1, len(rounds)):
            lost[k] |= repeats[k] & lost[k - 1]
        return np.asarray(lost)

    def _look_back(
        self,
        lost: Mask,
        unknown: tuple[Indices, ...],
        round_: int,
        link_bits: Hashes,
        enter: Array,
        stay: Array,
    ) -> None:
        """Fill in, in place, the losses that repeat those of an earlier round.

        A round whose number u lies outside [enter, enter + stay) decides by itself whether a link
        fails. The losses that are asked for are those of the latest such round before `round_`.

        Parameters
        ----------
        lost : ndarray of bool, (runs, E)
            The losses of round `round_`, of which the unknown ones are filled in.
        unknown : tuple of ndarray
            The runs and the links of the unknown losses, each (n,).
        round_ : int
            Number of the round.
        link_bits : ndarray of uint64, (E,)
            Random bits of the links, by `_link_bits`.
        enter, stay : ndarray, (E,)
            The probabilities of Gilbert's chain, as in `_draw_rounds`.
        """
        run, link = unknown
        runs = lost.shape[0]
        while run.size:
            # Uniform numbers (rounds, n) of the rounds before, the latest first
            earlier = range(round_ - 1, round_ - _LOOKBACK - 1, -1)
            round_ = round_ - _LOOKBACK
            uniform = _uniform(self._run_bits(earlier, runs)[:, run] ^ link_bits[link])
            fails = uniform < enter[link]
            decided = fails | (uniform >= (enter + stay)[link])
            # The first row that decides is the latest round: rows go back in time. Where none
            # does, argmax is 0, and the loss is overwritten in the next pass.
            latest = decided.argmax(axis=0)
            lost[run, link] = fails[latest, np.arange(run.size)]
            # These repeat a round that is earlier still.
            is_undecided = ~decided.any(axis=0)
            run = run[is_undecided]
            link = link[is_undecided]

    def _link_probabilities(self, graph: Graph) -> Array:
        """Return the probability of loss of each link, (E,), or one number for all."""
        loss = np.asarray(self.loss)
        if loss.ndim == 2:
            return np.asarray(loss[graph.receivers, graph.senders])
        return loss[graph.receivers] if loss.ndim == 1 else loss

    def _run_bits(self, rounds: Sequence[int], runs: int) -> Hashes:
        """Return random bits for each round and run, (rounds, runs): hashes of seed, round and run.

        Entry k of the generator splitmix64 is the hash of seed + (k + 1) `_GOLDEN`, so that any
        round's bits are computed without those before it.
        """
        keys = [(self.seed + _GOLDEN * (k + 1)) % 2**64 for k in rounds]
        numbers = np.arange(runs, dtype=np.uint64) * np.uint64(_GOLDEN)
        return _mix_bits(_mix_bits(keys)[:, None] ^ numbers)


def _check_windows(during: object) -> tuple[tuple[float, float], ...]:
    """Return the argument `during` as pairs (start, stop) of rounds or times.

    An end may be infinite; a NaN fails the comparison and is refused.
    """
    # A row (start, stop) for each window
    ends = check_array(during, "during", finite=False)
    if ends.ndim != 2 or ends.shape[1] != 2 or not (ends[:, 0] < ends[:, 1]).all():
        raise ValueError(
            "during must have windows (start, stop) with start before stop, "
            f"got {during!r}"
        )
    return tuple((float(start), float(stop)) for start, stop in ends)


@lru_cache(maxsize=32)
def _link_bits(graph: Graph) -> Hashes:
    """Return random bits for each link, (E,), which depend on its two agents alone."""
    numbers = graph.receivers * graph.n_agents + graph.senders
    return _mix_bits(numbers.astype(np.uint64) + np.uint64(_GOLDEN))


def _uniform(bits: Hashes) -> Array:
    """Return numbers in [0, 1) from the upper 53 bits, as many as a float has."""
    return (_mix_bits(bits) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def _mix_bits(bits: Hashes | list[int]) -> Hashes:
    """Apply the finaliser of splitmix64: every output bit depends on every input bit.

    The shifts and factors are those that splitmix64 prescribes.
    """
    z = np.asarray(bits, dtype=np.uint64)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))
