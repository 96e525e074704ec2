"""What goes wrong on the way: messages lost, alone or in bursts, late, and agents silent."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    Mask,
    NonNegativeInt,
    UnitInterval,
    check_array,
)
from .graphs import Graph

__all__ = ["Faults"]

_GOLDEN = 0x9E3779B97F4A7C15

Hashes = NDArray[np.uint64]

_BETWEEN = Bounds(at_least=0, at_most=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Faults(FrozenModel):
    r"""How a channel fails. ``faults | other`` fails in both ways.

    Parameters
    ----------
    loss : float or array_like, (A,) or (A, A)
        Probability that a message is lost, in [0, 1]; one for each receiver, or ``loss[i, j]`` for
        what agent i hears of agent j.
    seed : int
        Of the losses. Whether a message is lost is a function of seed, run, round and link alone,
        so that every agent, or every process of a real network, can compute it, and no draw
        depends on what was drawn before.
    burst : float, optional
        Mean number of rounds for which a link that fails keeps failing. Losses are independent by
        default, which is the shortest burst there is, 1 / (1 - loss) rounds.
    delay : int
        Rounds that a message takes on top of its own, in a channel that lives as long; for
        averages (:meth:`Channel.combine`) alone.
    silent : collection of int
        Agents whose radio is off: they neither send nor hear.
    during : sequence of (start, stop), optional
        When losses happen and agents are silent: from `start` to before `stop`, in s where the
        channel has a time `t`, as in filters, and in rounds of its ledger otherwise. Always by
        default; `stop` may be infinite.
    also : tuple of Faults
        What fails besides; ``|`` fills it.

    Notes
    -----
    Bursts are a two-state Markov chain on each link (E. N. Gilbert, Bell System Technical Journal
    39 (1960) 1253-1265, with nothing lost in one state and everything in the other). Its state in a
    round is that of the last round, looking back, in which the number drawn leads to the same
    state from both: exact from the first round on, and again independent of what was computed
    before.

    Examples
    --------
    >>> Faults(loss=0.2, seed=7).lost(
    ...     Graph.from_adjacency([[0, 1], [1, 0]]), 0, 5
    ... ).shape
    (5, 2)

    Agent 3 is off for a while, and all links fail for 8 rounds at a time:

    >>> faults = Faults(loss=0.1, burst=8.0) | Faults(silent=[3], during=[(10, 20)])
    >>> faults.none
    False
    """

    loss: (
        UnitInterval
        | Annotated[Array, "A", _BETWEEN]
        | Annotated[Array, "A A", _BETWEEN]
    ) = 0.0
    seed: NonNegativeInt = 0
    burst: Annotated[float, Bounds(at_least=1)] | None = None
    delay: NonNegativeInt = 0
    silent: Collection[NonNegativeInt] = ()
    during: Any = None
    also: tuple[Faults, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        loss = np.asarray(self.loss)
        shortest = 1 / (1 - loss[loss < 1].max(initial=0.0))
        if self.burst is not None and self.burst < shortest * (1 - 1e-9):
            raise ValueError(
                f"burst must have at least 1 / (1 - loss) = {shortest:g} rounds, which independent "
                f"losses last, got {self.burst:g}"
            )
        if self.during is not None:
            object.__setattr__(self, "during", _windows(self.during))

    def __or__(self, other: Faults) -> Faults:
        if not isinstance(other, Faults):
            return NotImplemented
        mine, theirs = (
            {f.seed for f in x._all() if np.any(f.loss)} for x in (self, other)
        )
        if mine & theirs:
            raise ValueError(
                f"seed must be other seeds to lose other messages, got {min(mine & theirs)} twice"
            )
        return replace(self, also=(*self.also, *other._all()))

    def _all(self) -> tuple[Faults, ...]:
        return (self.replace(also=()), *(x for f in self.also for x in f._all()))

    def check(self, graph: Graph) -> None:
        """Refuse a graph whose agents do not fit."""
        agents = graph.n_agents
        for faults in self._all():
            got = np.shape(faults.loss)
            if got != (agents,) * len(got):
                raise ValueError(
                    f"loss must be a number for each of {agents} agents, got {got}"
                )
            Bounds(below=agents)(max(faults.silent, default=-1), "silent")

    @cached_property
    def none(self) -> bool:
        """Whether nothing ever fails."""
        return not any(np.any(f.loss) or f.delay or f.silent for f in self._all())

    @cached_property
    def has_delay(self) -> int:
        """Rounds that a message takes on top of its own, all delays together."""
        return sum(f.delay for f in self._all())

    def speaking(self, graph: Graph, round_: int = 0, t: float | None = None) -> Mask:
        """Links whose both ends have their radio on in a round, (E,)."""
        off = np.zeros(graph.n_agents, dtype=bool)
        for faults in self._all():
            if faults.silent and faults._active(round_, t):
                off[list(faults.silent)] = True
        return ~(off[graph.receivers] | off[graph.senders])

    def lost(
        self, graph: Graph, round_: int, runs: int, t: float | None = None
    ) -> Mask:
        """Which links lose the message of round `round_` in each of `runs` runs, (runs, E)."""
        out = np.zeros((runs, graph.senders.size), dtype=bool)
        for faults in self._all():
            if np.any(faults.loss) and faults._active(round_, t):
                out |= faults._losses(graph, round_, runs)
        return out

    def _active(self, round_: int, t: float | None) -> bool:
        now = round_ if t is None else t
        return self.during is None or any(
            start <= now < stop for start, stop in self.during
        )

    def _losses(self, graph: Graph, round_: int, runs: int) -> Mask:
        i = graph.receivers
        j = graph.senders
        link = _mixed((i * graph.n_agents + j).astype(np.uint64) + np.uint64(_GOLDEN))
        loss = np.asarray(self.loss)
        rate = loss[(i, j)[: loss.ndim]]
        drawn = _uniform(self._runs([round_], runs).T ^ link)
        if self.burst is None:
            return np.asarray(drawn < rate)
        rate = np.broadcast_to(rate, link.shape)
        inner = (rate > 0) & (rate < 1)
        stay = np.where(
            inner, 1 - 1 / (self.burst * np.where(inner, 1 - rate, 1.0)), 0.0
        ).clip(0)
        enter = rate * (1 - stay)
        out = drawn < enter
        run, at = np.nonzero(~out & (drawn < enter + stay))
        while run.size:  # sixteen rounds back at a time
            before = range(round_ - 1, round_ - 17, -1)
            round_ = round_ - 16
            drawn = _uniform(self._runs(before, runs)[:, run] ^ link[at])
            hit = drawn < enter[at]
            known = hit | (drawn >= (enter + stay)[at])
            out[run, at] = hit[known.argmax(axis=0), np.arange(run.size)]
            run, at = (x[~known.any(axis=0)] for x in (run, at))
        return np.asarray(out)

    def _runs(self, rounds: Sequence[int], runs: int) -> Hashes:
        """Bits for each round and run."""
        keys = _mixed([(self.seed + _GOLDEN * (k + 1)) % 2**64 for k in rounds])
        return _mixed(
            keys[:, None] ^ (np.arange(runs, dtype=np.uint64) * np.uint64(_GOLDEN))
        )


def _windows(during: Any) -> tuple[tuple[float, float], ...]:
    ends = check_array(during, "during", finite=False)
    if ends.ndim != 2 or ends.shape[1] != 2 or not (ends[:, 0] < ends[:, 1]).all():
        raise ValueError(
            f"during must have windows (start, stop) with start before stop, got {during!r}"
        )
    return tuple((float(start), float(stop)) for start, stop in ends)


def _uniform(bits: Hashes) -> Array:
    return (_mixed(bits) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def _mixed(bits: Hashes | list[int]) -> Hashes:
    """The finaliser of splitmix64: every output bit depends on every input bit."""
    z = np.asarray(bits, dtype=np.uint64)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))
