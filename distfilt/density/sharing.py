"""How agents of a swarm learn the kernel estimate of all: consensus on densities, or flooding."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..checks import Array, array, count, instance, number
from ..network import Channel, Graph, tracking
from ..network import weights as weighting
from .kernel import _kernel_density, _kernels
from .seen import Seen

__all__ = [  # fmt: skip
    "Centralised", "DynamicAverage", "Flooding", "Neighbours", "PIConsensus", "Sharing", "alone",
]

Carried = tuple[Array, ...]
Mask = NDArray[np.bool_]

_NEVER = -1e30
"""Time stamp of what an agent has not heard of."""


@runtime_checkable
class Sharing(Protocol):
    """A rule by which agents learn the swarm's kernel estimate.

    `begin` gives what the agents remember before their first step. `learn` takes what they see
    and what they remember, lets them talk, and returns what they remember then, each agent's
    estimate (A, n), and how many agents each believes there are, (A,).

    Examples
    --------
    >>> isinstance(Centralised().reference, bool)
    True
    """

    @property
    def reference(self) -> bool:
        """Whether this is no network's rule, but what it is compared with."""
        ...

    def begin(self, seen: Seen) -> Carried:
        """What the agents remember before the first step."""
        ...

    def learn(
        self, carried: Carried, seen: Seen, channel: Channel, dt: float
    ) -> tuple[Carried, Array, Array]:
        """One step of talking."""
        ...


def alone(sharing: Sharing, seen: Seen) -> Array:
    """What each agent believes of the swarm before anybody has spoken, (A, n).

    Its own kernel, whatever it will say; only a reference knows of all without a word.

    Examples
    --------
    >>> from distfilt.density import Grid
    >>> seen = Seen(np.full((2, 2), 0.5), np.ones(2, bool), Grid((9, 9)), 0.1, 0.0)
    >>> np.array_equal(alone(Flooding(), seen), seen.kernels)
    True
    """
    instance(sharing, "sharing", Sharing)  # type: ignore[type-abstract]
    if not sharing.reference:
        return seen.kernels
    silent = Channel(Graph.from_edges(len(seen.present), np.zeros((0, 2))))
    return sharing.learn(sharing.begin(seen), seen, silent, 1.0)[1]


def _coordinates(seen: Seen, modes: int | None, values: Array | None = None) -> Array:
    """Each agent's kernel, whole or as cosine coefficients, and a 1 of the first that is here."""
    instance(seen, "seen", Seen)
    z = seen.kernels if values is None else values
    if modes is not None:
        z = z @ seen.grid.cosines(modes) * seen.grid.volume
    leader = np.zeros((len(z), 1))
    leader[int(np.argmax(seen.present)), 0] = 1.0
    return np.concatenate([z, leader], axis=1)


def _read(values: Array, seen: Seen, modes: int | None) -> tuple[Array, Array]:
    """Densities and numbers of agents that the coordinates stand for."""
    y = values[:, :-1]
    if modes is not None:
        y = y @ seen.grid.cosines(modes).T
    # The average of one 1 among zeros is 1/N; a transient may be zero or negative.
    return y, 1 / np.clip(values[:, -1], 1e-6, 1.0)


def _door(
    carried: Carried, shapes: tuple[tuple[int, ...], ...], seen: Seen, channel: Channel, dt: float
) -> Carried:
    """Refuse what a rule cannot have carried, and steps that are none."""
    instance(channel, "channel", Channel)
    number(dt, "dt", above=0)
    if channel.graph.size != len(seen.present):
        raise ValueError(f"channel: needs {len(seen.present)} agents, got {channel.graph.size}")
    if not isinstance(carried, tuple | list | np.ndarray) or len(carried) != len(shapes):
        raise ValueError(f"carried: needs {len(shapes)} arrays, as `begin` and `learn` return them")
    return tuple(array(c, "carried", s) for c, s in zip(carried, shapes, strict=True))


def _modes(value: int | None) -> None:
    if value is not None:
        count(value, "modes")


@dataclass(frozen=True)
class PIConsensus:
    """The proportional-integral estimator of equation (16) of Zheng and Lin.

    Parameters
    ----------
    alpha, a, b : float
        Gains, in 1/s, of :func:`distfilt.network.tracking.pi_step`.
    modes : int, optional
        Agree on so many cosine coefficients of the density instead of on all cells.
    rate : bool
        Add the inputs' derivative, which (16) lacks, so that the average is followed without a lag.
    first_std : float, optional
        Start at a Gaussian of this width about the agent instead of at the own kernel.

    Examples
    --------
    >>> PIConsensus(modes=64).modes
    64
    """

    alpha: float = field(default=0.2, kw_only=True)
    a: float = field(default=0.4, kw_only=True)
    b: float = field(default=0.04, kw_only=True)
    modes: int | None = field(default=None, kw_only=True)
    rate: bool = field(default=False, kw_only=True)
    first_std: float | None = field(default=None, kw_only=True)
    reference = False

    def __post_init__(self) -> None:
        for name in ("alpha", "a", "b"):
            number(getattr(self, name), name, at_least=0)
        _modes(self.modes)
        instance(self.rate, "rate", bool)
        if self.first_std is not None:
            number(self.first_std, "first_std", above=0)

    def begin(self, seen: Seen) -> Carried:
        """First estimates, no integral, and the inputs of now."""
        u = _coordinates(seen, self.modes)
        if self.first_std is None:
            return u, np.zeros_like(u), u
        return _coordinates(seen, self.modes, seen.flat(self.first_std)), np.zeros_like(u), u

    def learn(
        self, carried: Carried, seen: Seen, channel: Channel, dt: float
    ) -> tuple[Carried, Array, Array]:
        """One step of (16), in as many substeps as stability asks for."""
        u = _coordinates(seen, self.modes)
        estimate, integral, before = _door(carried, (u.shape,) * 3, seen, channel, dt)
        after = tracking.pi_step(
            tracking.PIState(estimate, integral), before, channel, dt=dt, alpha=self.alpha,
            a=self.a, b=self.b, rate=(u - before) / dt if self.rate else None,
        )
        y, agents = _read(after.estimate, seen, self.modes)
        return (after.estimate, after.integral, u), y, agents


@dataclass(frozen=True)
class DynamicAverage:
    """First-order dynamic average consensus on cosine coefficients of the density.

    Metropolis weights where all links go both ways, else weights that balance the graph.

    Parameters
    ----------
    modes : int, optional
        How many coefficients; None agrees on all cells.
    rounds : int
        Of averaging in a step.

    Examples
    --------
    >>> DynamicAverage().modes
    100
    """

    modes: int | None = field(default=100, kw_only=True)
    rounds: int = field(default=1, kw_only=True)
    reference = False

    def __post_init__(self) -> None:
        _modes(self.modes)
        count(self.rounds, "rounds")

    def begin(self, seen: Seen) -> Carried:
        """Estimates that are the own kernels, which the rule needs for an exact average."""
        u = _coordinates(seen, self.modes)
        return u, u

    def learn(
        self, carried: Carried, seen: Seen, channel: Channel, dt: float
    ) -> tuple[Carried, Array, Array]:
        """Average, and add what the own input has changed by."""
        u = _coordinates(seen, self.modes)
        x, before = _door(carried, (u.shape,) * 2, seen, channel, dt)
        graph = channel.graph
        weights = weighting.balanced(graph) if graph.directed else weighting.metropolis(graph)
        lost = "keep" if graph.directed else "mutual"
        for k in range(self.rounds):
            x = tracking.first_order(
                x, u if k == 0 else before, before, channel, weights=weights, lost=lost)
        return (x, u), *_read(x, seen, self.modes)


@dataclass(frozen=True)
class Flooding:
    """Every agent passes on where it last knew each agent, with the time, and keeps the newest.

    Parameters
    ----------
    forget : float
        Age in s from which an entry is left out of the estimate: agents that have gone are
        forgotten then, and parts of a broken network stop believing in each other.

    Examples
    --------
    >>> Flooding(forget=5.0).forget
    5.0
    """

    forget: float = field(default=float("inf"), kw_only=True)
    reference = False

    def __post_init__(self) -> None:
        if not isinstance(self.forget, float) or self.forget != float("inf"):
            number(self.forget, "forget", above=0)

    def begin(self, seen: Seen) -> Carried:
        """Tables (A, A, d + 1) of positions and times, with the own entry only."""
        size, d = instance(seen, "seen", Seen).positions.shape
        table = np.zeros((size, size, d + 1))
        table[..., d] = _NEVER
        return (self._noted(table, seen),)

    @staticmethod
    def _noted(table: Array, seen: Seen) -> Array:
        here = np.flatnonzero(seen.present)
        out = table.copy()
        out[here, here, :-1], out[here, here, -1] = seen.positions[here], seen.t
        return out

    def learn(
        self, carried: Carried, seen: Seen, channel: Channel, dt: float
    ) -> tuple[Carried, Array, Array]:
        """Note the own position, send the table, keep the newest of each entry."""
        size, d = instance(seen, "seen", Seen).positions.shape
        (before,) = _door(carried, ((size, size, d + 1),), seen, channel, dt)
        table = self._noted(before, seen)
        inbox = channel.exchange(
            [table[i] if here else None for i, here in enumerate(seen.present)]
        )
        owners = np.arange(len(table))
        new = table.copy()
        for i, box in enumerate(inbox):
            if box and seen.present[i]:
                heard = np.stack([table[i], *box.values()])
                new[i] = heard[heard[..., -1].argmax(axis=0), owners]
        known = new[..., -1] > max(seen.t - self.forget, _NEVER / 2)
        return (new,), _mean_kernels(new, known, seen), known.sum(axis=1).astype(np.float64)


def _mean_kernels(table: Array, known: Mask, seen: Seen) -> Array:
    """Kernel estimates of the known entries of each table; equal entries are computed once."""
    if seen.wanted is not None:
        known = known.copy()
        known[np.delete(np.arange(len(known)), seen.wanted)] = False
    row, owner = np.nonzero(known)
    stamp = table[row, owner, -1]
    order = np.lexsort((stamp, owner))
    first = np.ones(order.size, dtype=bool)
    first[1:] = (np.diff(owner[order]) != 0) | (np.diff(stamp[order]) != 0)
    at = np.empty(order.size, dtype=np.int64)
    at[order] = np.cumsum(first) - 1
    chosen = order[first]
    x = table[row[chosen], owner[chosen], :-1]
    z = _kernels(x, seen.grid, np.full(len(x), seen.bandwidth))
    weights = np.zeros((len(table), len(x)))
    weights[row, at] = 1.0
    total = weights.sum(axis=1, keepdims=True)
    return np.asarray(weights @ z / np.maximum(total, 1.0))


@dataclass(frozen=True)
class Neighbours:
    """Remark 4 of Zheng and Lin as it stands: positions go to neighbours, and that is all.

    Each agent's estimate is the kernel estimate of itself and of those that it hears.

    Examples
    --------
    >>> Neighbours().reference
    False
    """

    reference = False

    def begin(self, seen: Seen) -> Carried:
        """Nothing to remember."""
        instance(seen, "seen", Seen)
        return ()

    def learn(
        self, carried: Carried, seen: Seen, channel: Channel, dt: float
    ) -> tuple[Carried, Array, Array]:
        """Send the own position; the mean of the kernels at all positions that arrive."""
        size, d = instance(seen, "seen", Seen).positions.shape
        _door(carried, (), seen, channel, dt)
        inbox = channel.exchange(
            [x if here else None for x, here in zip(seen.positions, seen.present, strict=True)]
        )
        table = np.zeros((size, size, d + 1))
        table[..., d] = _NEVER
        for i, box in enumerate(inbox):
            for j, x in box.items():
                table[i, j, :-1], table[i, j, -1] = x, seen.t
        table = Flooding._noted(table, seen)
        known = table[..., -1] > _NEVER / 2
        return (), _mean_kernels(table, known, seen), known.sum(axis=1).astype(np.float64)


@dataclass(frozen=True)
class Centralised:
    """All positions known to all at no cost: the reference that no network is.

    Examples
    --------
    >>> Centralised().reference
    True
    """

    reference = True

    def begin(self, seen: Seen) -> Carried:
        """Nothing to remember."""
        instance(seen, "seen", Seen)
        return ()

    def learn(
        self, carried: Carried, seen: Seen, channel: Channel, dt: float
    ) -> tuple[Carried, Array, Array]:
        """The kernel estimate of all that are here."""
        instance(seen, "seen", Seen)
        _door(carried, (), seen, channel, dt)
        x, size = seen.positions[seen.present], len(seen.present)
        y = _kernel_density(x, seen.grid, np.full(len(x), seen.bandwidth))
        return (), np.tile(y, (size, 1)), np.full(size, float(len(x)))
