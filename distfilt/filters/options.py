"""The options that a family of filters can offer: one class for each.

A family derives from :class:`~distfilt.filters.SensorFilter` and from the classes of the options
that it offers. The other options are no arguments of its constructor.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Literal, TypeVar

from ..validation import (
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    validated,
)
from .base import Filter
from .observations import Observation
from .plans import TimesArgument
from .record import SCORES, Recording, Score, Scored, Truth
from .states import State

if TYPE_CHECKING:
    import xarray

__all__ = [
    "ExchangesAtIntervals",
    "FusesBeliefs",
    "IsolatesRuns",
    "KeepsPast",
    "ScoresObservations",
    "SharesObservations",
]

S = TypeVar("S", bound=State)


@dataclass(frozen=True, eq=False)
class FusesBeliefs(Filter[S]):
    """A filter whose agents fuse their beliefs after the update.

    Parameters
    ----------
    fusion : callable, optional
        ``fusion(belief, channel) -> belief``; the form of the belief is the family's. A rule of
        this package that fuses another kind of belief is refused.
    """

    _: KW_ONLY
    fusion: Callable[..., object] | None = None


@dataclass(frozen=True, eq=False)
class SharesObservations(Filter[S]):
    """A filter whose agents can send their observations to other agents.

    Parameters
    ----------
    share_observations : bool
        Whether they do; the receivers assimilate them too.
    hops : int or "all"
        Over how many links an observation travels: 1 for the neighbours; more if agents forward
        it in the same step, each once and never back to a neighbour from which it came; "all"
        until all agents of a connected graph have it. If no message is lost the graph's diameter
        is enough, and saves a last round in which nothing is new. The number of the agent that
        made it is sent too, unless `hops` is 1.

    Examples
    --------
    Kalman filters that flood their observations are one filter of all of them:

    >>> import numpy as np
    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import component
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> f = GaussianFilter(
    ...     still, [component([0], std=1.0)] * 4, graphs.path(4), hops="all"
    ... )
    >>> state = f.step(f.start(([0.0], [[1.0]])), 0.0, [[1.0], [2.0], [3.0], [4.0]])
    >>> state.means.ravel().round(6), state.ledger.scalars
    (array([2., 2., 2., 2.]), array([ 2, 10, 10,  2]))
    """

    _: KW_ONLY
    share_observations: bool = True
    hops: PositiveInt | Literal["all"] = 1


@dataclass(frozen=True, eq=False)
class ExchangesAtIntervals(Filter[S]):
    """A filter whose agents may exchange at some times only.

    Parameters
    ----------
    exchange_interval : float, optional
        Agents exchange once in so many seconds; in every step by default. Observations wait until
        then and are sent as delayed ones, so that a `lag` has to reach back to them.
    """

    _: KW_ONLY
    exchange_interval: PositiveFloat | None = None


@dataclass(frozen=True, eq=False)
class IsolatesRuns(Filter[S]):
    """A filter of many runs at once, in which one may fail without the others.

    Parameters
    ----------
    on_error : {"raise", "keep"}
        If one run of a batch fails, raise a :class:`FilterError` that names it; or let the other
        runs go on and record the failed one as NaN. If a fusion rule raises, each run is fused
        alone.
    """

    _: KW_ONLY
    on_error: Literal["raise", "keep"] = "raise"


@dataclass(frozen=True, eq=False)
class ScoresObservations(Filter[S]):
    """A filter that can score the observations by its predictions of them.

    Parameters
    ----------
    record_evidence : bool
        Whether the states and the record have of each step and agent, over the observations that
        it assimilates (its own, received and delayed ones, not those that the gate rejects):
        ``log_likelihood``, the logarithm of their density given all earlier observations; ``nis``,
        their normalised innovation squared, added up; and ``n_observed``, how many numbers they
        are. The sum of ``log_likelihood`` over a run is the evidence of the model, and for a
        consistent filter ``nis`` is ``n_observed`` on average. In a step with an observation of a
        likelihood sensor without moments ``nis`` is NaN, since it is unknown.

    Examples
    --------
    Two values of the process noise, of which the record prefers the second:

    >>> import numpy as np
    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import Model
    >>> from distfilt.sensors import component
    >>> for q in (0.01, 1.0):
    ...     walk = Model(1, lambda x, t, dt: x, lambda t, dt: q * dt * np.eye(1))
    ...     f = GaussianFilter(walk, [component([0], std=0.1)], record_evidence=True)
    ...     y = [[0.2], [1.1], [0.4], [-0.9]]
    ...     run = f.run(f.start(([0.0], [[1.0]])), [1.0, 2.0, 3.0, 4.0], [y])
    ...     evidence = float(run["log_likelihood"].sum())
    ...     ratio = float(run["nis"].sum() / run["n_observed"].sum())
    ...     print(round(evidence, 2), round(ratio, 2))
    -54.92 28.31
    -5.53 0.74
    """

    _: KW_ONLY
    record_evidence: bool = False


@dataclass(frozen=True, eq=False)
class KeepsPast(Filter[S]):
    """A filter that keeps its beliefs about earlier times.

    Parameters
    ----------
    lag : int
        How many earlier times are kept, for delayed observations and for smoothing.
    """

    _: KW_ONLY
    lag: NonNegativeInt = 0

    @validated
    def smooth(
        self,
        state: S,
        times: TimesArgument,
        observations: object,
        *,
        truth: Truth = None,
        scores: Collection[Score] = SCORES,
        scored: Scored = None,
        keep: Collection[str] | None = None,
        delayed: Sequence[Observation] = (),
    ) -> xarray.Dataset:
        """Fixed-lag smoothing: record of each time the belief when `lag` more have been observed.

        Parameters and result are those of :meth:`run`. The filter needs a `lag`; near the end
        fewer times follow, and the last estimate is the filter's.
        """
        if not self.lag:
            raise ValueError("lag must be at least 1 for smoothing, got 0")
        recording = Recording(truth, scores, scored, keep)
        return self._record(state, times, observations, recording, delayed, self.lag)
