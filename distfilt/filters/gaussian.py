"""A network of Kalman filters: forecast, assimilate, fuse the Gaussians with the neighbours'."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, covariance, increasing, number
from ..kalman.linear import predict, update
from ..linalg import symmetrise
from ..metrics import nees, squared_error
from ..models import LinearModel
from ..network import Channel, Faults, Graph, Ledger
from ..sensors import Sensor, stack
from .observations import at_one_time, over_times

if TYPE_CHECKING:
    import xarray

__all__ = ["GaussianFilter", "GaussianState"]

Fusion = Callable[[Array, Array, Channel], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class GaussianState:
    """What the agents believe between two steps.

    Parameters
    ----------
    t : float
        The time, in s.
    means : ndarray, (*runs, A, d)
    covariances : ndarray, (*runs, A, d, d)
    ledger : Ledger
        What has been sent so far.

    Examples
    --------
    >>> GaussianState(0.0, np.zeros((2, 1)), np.ones((2, 1, 1)), Ledger.empty(2)).runs
    ()
    """

    t: float
    means: Array
    covariances: Array
    ledger: Ledger

    def __post_init__(self) -> None:
        number(self.t, "t")
        m = array(self.means, "means", (..., "A", "d"))
        covariance(array(self.covariances, "covariances", (*m.shape, m.shape[-1])), "covariances")
        if self.ledger.messages.size != m.shape[-2]:
            raise ValueError(
                f"ledger: needs {m.shape[-2]} agents, got {self.ledger.messages.size}"
            )

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return tuple(self.means.shape[:-2])


@dataclass(frozen=True)
class GaussianFilter:
    """One Kalman filter per agent, for a linear model and linear sensors.

    Parameters
    ----------
    model : LinearModel
        Known to all agents.
    sensors : sequence of Sensor or None, length A
        Linear sensors.
    graph : Graph
        Who hears whom.
    fuse : callable, optional
        ``fuse(means, covs, channel) -> means, covs``, such as
        :func:`distfilt.network.fusion.covariance_intersection`; none by default.
    share : bool
        Whether agents send their observations to the neighbours, who use them too.
    faults : Faults, optional
        Messages lost and agents silenced; without a delay.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> from distfilt.network.fusion import covariance_intersection
    >>> from distfilt.sensors import direct
    >>> walk = LinearModel.from_transition(1, lambda dt: np.eye(1), lambda t, dt: dt * np.eye(1))
    >>> f = GaussianFilter(
    ...     walk, [direct([0], noise=1.0), None], graphs.path(2), covariance_intersection)
    >>> state = f.step(f.start([0.0], [[4.0]]), 1.0, [[2.0], None])
    >>> state.means.ravel().round(3)
    array([1.429, 1.429])
    """

    model: LinearModel
    sensors: Sequence[Sensor | None]
    graph: Graph
    fuse: Fusion | None = None
    share: bool = False
    faults: Faults | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.model, LinearModel):
            raise ValueError(f"model: needs a LinearModel, got {type(self.model).__name__}")
        for s in self.sensors:
            if s is not None and (not isinstance(s, Sensor) or s.linear is None):
                raise ValueError(f"sensors: needs linear sensors or None, got {s!r}")
        if not isinstance(self.graph, Graph) or self.graph.size != len(self.sensors):
            raise ValueError(f"graph: needs a Graph of {len(self.sensors)} agents like sensors")
        if self.fuse is not None:
            callable_(self.fuse, "fuse")
        if self.faults is not None and (not isinstance(self.faults, Faults) or self.faults.delay):
            raise ValueError(f"faults: needs Faults without a delay, got {self.faults!r}")

    def start(
        self, mean: ArrayLike, cov: ArrayLike, *, runs: tuple[int, ...] = (), t: float = 0.0
    ) -> GaussianState:
        """The state before the first step: the same mean (d,) and covariance (d, d) for all."""
        d, agents = self.model.dim, len(self.sensors)
        lead = (*(count(n, "runs") for n in runs), agents)
        m = np.broadcast_to(array(mean, "mean", (d,)), (*lead, d))
        p = np.broadcast_to(covariance(cov, "cov", d), (*lead, d, d))
        return GaussianState(number(t, "t"), m.copy(), p.copy(), Ledger.empty(agents))

    def step(
        self, state: GaussianState, t: float, observations: Sequence[ArrayLike | None]
    ) -> GaussianState:
        """Move to time `t` and take in what was observed there; NaN and None are missing.

        Parameters
        ----------
        state : GaussianState
            Not changed.
        t : float
            After the state's time, in s.
        observations : sequence of length A
            Per agent (*runs, m) or (m,), or None.
        """
        if not isinstance(state, GaussianState):
            raise ValueError(f"state: needs a GaussianState, got {type(state).__name__}")
        dt = number(t, "t", above=state.t) - state.t
        seen = at_one_time(observations, self.sensors, state.runs)
        channel = Channel(self.graph, ledger=state.ledger, runs=state.runs, faults=self.faults)
        q = self.model.noise(state.t, dt)
        means, covs = predict(state.means, state.covariances, F=self.model.transition(dt), Q=q)
        inbox = channel.exchange(seen) if self.share else [{} for _ in seen]
        for a, own in enumerate(seen):
            heard = dict(inbox[a]) | ({} if own is None else {a: own})
            if heard:
                both = stack([s for j in sorted(heard) if (s := self.sensors[j]) is not None])
                y = np.concatenate([heard[j] for j in sorted(heard)], axis=-1)
                means[..., a, :], covs[..., a, :, :], _ = update(
                    means[..., a, :], covs[..., a, :, :], y,
                    H=both.matrix(self.model.dim), R=both.noise,
                )
        if self.fuse is not None:
            means, covs = self.fuse(means, symmetrise(covs), channel)
        return GaussianState(float(t), means, symmetrise(covs), channel.ledger)

    def steps(
        self, state: GaussianState, times: ArrayLike, observations: Sequence[ArrayLike | None]
    ) -> Iterator[GaussianState]:
        """The states at `times`, one after the other; arguments as in :meth:`run`."""
        grid, series = over_times(observations, self.sensors, times)
        for k, t in enumerate(grid):
            state = self.step(state, float(t), [None if o is None else o[k] for o in series])
            yield state

    def run(
        self,
        state: GaussianState,
        times: ArrayLike,
        observations: Sequence[ArrayLike | None],
        *,
        truth: ArrayLike | None = None,
    ) -> xarray.Dataset:
        """Step through a series and record it.

        Parameters
        ----------
        state : GaussianState
            Where to begin.
        times : array_like, (T,)
            Strictly increasing, in s.
        observations : sequence of length A
            Per agent (T, *runs, m) or (T, m), or None.
        truth : array_like, (T, *runs, d), optional
            If given, errors and NEES are recorded too.

        Returns
        -------
        xarray.Dataset
            ``mean``, ``covariance`` and the ledger over time, run, agent and component; with
            `truth` also ``squared_error`` and ``nees``.
        """
        import xarray

        states = list(self.steps(state, times, observations))
        runs = tuple(f"run{i}" for i in range(len(state.runs)))
        lead = ("time", *(("run",) if len(runs) == 1 else runs), "agent")
        means = np.array([s.means for s in states])
        covs = np.array([s.covariances for s in states])
        data = {"mean": ((*lead, "component"), means),
                "covariance": ((*lead, "component", "column"), covs)}
        for name in ("messages", "scalars", "bytes", "lost"):
            data[name] = (("time", "agent"), np.array([getattr(s.ledger, name) for s in states]))
        if truth is not None:
            known = array(truth, "truth", (len(states), *state.runs, self.model.dim))
            known = np.broadcast_to(known[..., None, :], means.shape)
            data["squared_error"] = (lead, squared_error(means, known))
            data["nees"] = (lead, nees(means, covs, known))
        names = self.model.names or tuple(str(i) for i in range(self.model.dim))
        coords = {"time": increasing(times, "times"), "component": list(names)}
        return xarray.Dataset(data, coords=coords)
