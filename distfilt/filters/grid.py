"""Grid filters: beliefs on the cells of a box, for states of one to three components."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np

from ..density import Grid
from ..linalg import cholesky, log_sum_exp, solve_lower
from ..updates import particles
from ..validation import Array, Indices, Rng, all_finite
from .base import SensorFilter
from .options import FusesBeliefs, IsolatesRuns, ScoresObservations, SharesObservations
from .particle import compute_moments, select_visible
from .priors import Prior, prior_mixtures
from .record import Summary
from .states import SensorState, State
from .step import Received, Step

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["GridFilter", "GridState"]

_MIN_LOG = -700.0
"""The smallest logarithm of a cell's probability; its exponential is still above zero."""
_CUTOFF = 6.0
"""Standard deviations of the process noise after which it is cut off."""
_MIN_STD = 0.5
"""The smallest standard deviation of the process noise, in widths of a cell."""
_MAX_AT_EDGE = 0.5
"""The largest probability that the outermost cells may have without a warning."""


@dataclass(frozen=True, eq=False, repr=False)
class GridState(SensorState):
    """The probabilities of the cells between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending
        As for :class:`~distfilt.filters.SensorState`; `rng` is None, as nothing is drawn.
    log_masses : ndarray, (*runs, A, n)
        Logarithms of the probabilities of the n cells.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = GridState(0.0, Ledger.empty(1), None, np.log([[0.25, 0.75]]))
    >>> state.masses
    array([[0.25, 0.75]])
    """

    log_masses: Annotated[Array, "... A n"]

    belief_field = "log_masses", (..., "A", "n")

    @cached_property
    def masses(self) -> Array:
        """The probabilities of the cells, (*runs, A, n)."""
        return np.asarray(np.exp(self.log_masses))


@dataclass(frozen=True, eq=False)
class GridFilter(
    SensorFilter[GridState],
    FusesBeliefs[GridState],
    SharesObservations[GridState],
    IsolatesRuns[GridState],
    ScoresObservations[GridState],
):
    r"""One belief on a grid per agent, by Bayes' rule for any model and sensors.

    The density at the cells' centres :math:`\mathbf x_i` is forecast and weighted,

    .. math:: p_i^-\propto\sum_jN(\mathbf x_i;\mathbf f(\mathbf x_j),\mathbf Q)\,p_j,\qquad
        p_i\propto p(\mathbf y\mid\mathbf x_i)\,p_i^-

    Where densities and noise are wider than a cell the sums are as accurate as the integrals, and
    the filter is a reference for all others. The work grows as the number of cells, exponential in
    the dimension.

    Parameters
    ----------
    model : Model
        Of one to three components, none of them circular, with a noise that does not depend on the
        state. Its standard deviation is at least half a cell in every direction, or zero for a
        state that rests.
    sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`; sensors may be likelihoods.
    grid : Grid
        The box and its cells, of :mod:`distfilt.density`. Probability that leaves the box is lost:
        a warning says so.
    fusion : callable, optional
        A rule of vectors, such as :func:`~distfilt.network.average_consensus`, for the logarithms
        of n numbers: their average is the geometric mean of the densities.
    fused : {"beliefs", "likelihoods"}
        Whether the rule averages beliefs, which counts nothing twice; or the likelihoods of the
        agents' own observations, of which A times the average is then added: Bayes' rule for all
        observations, if the average is exact.
    share_observations, hops, on_error, record_evidence
        As in :mod:`distfilt.filters.options`; "likelihoods" needs ``share_observations=False``.

    Notes
    -----
    The point-mass filter: R. S. Bucy and K. D. Senne, Automatica 7 (1971) 287-298.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.sensors import component
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> f = GridFilter(
    ...     walk, [component([0], std=1.0)], grid=Grid((200,), low=-10.0, high=10.0)
    ... )
    >>> state = f.step(f.start(([0.0], [[1.0]])), 1.0, [[3.0]])
    >>> f.summarize(state).mean.round(6), f.summarize(state).variance.round(6)
    (array([[2.]]), array([[0.666667]]))
    """

    _: KW_ONLY
    grid: Grid
    fused: Literal["beliefs", "likelihoods"] = "beliefs"

    state_class: ClassVar[type[State]] = GridState
    batched_summary: ClassVar[bool] = True
    supports_likelihoods: ClassVar[bool] = True
    belief_kind: ClassVar[str | None] = "vectors"

    def check_parts(self) -> None:
        """Refuse a model that does not fit the grid, and observations that would count twice."""
        super().check_parts()
        if self.model.dim != self.grid.dim:
            raise ValueError(
                f"grid must have {self.model.dim} axes, got {self.grid.dim}"
            )
        if any(period is not None for period in self.periods):
            raise ValueError(
                f"model must have no circular components here, got periods {self.periods}"
            )
        # One matrix Q for all cells makes the forecast one sparse product.
        if self.model.has_state_noise:
            raise ValueError(
                "model must have a noise that does not depend on the state here, got a "
                f"{type(self.model).__name__}"
            )
        # Likelihoods are added over the agents: observations must not have been shared before.
        if self.fused == "likelihoods" and (
            self.share_observations or self.fusion is None
        ):
            raise ValueError(
                "fused must be 'beliefs' unless there is a fusion rule, and "
                "share_observations is False, got 'likelihoods'"
            )

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Return the prior's density at the centres, times the cells' volume."""
        centres = self.grid.centres
        # A distribution of scipy has a density; any other prior is a mixture or a Gaussian.
        if hasattr(prior, "logpdf"):
            logs = np.broadcast_to(prior.logpdf(centres), (self.n_agents, len(centres)))
        else:
            mixtures = prior_mixtures(prior, self.model.dim, self.n_agents)
            logs = np.array([mixture.log_density(centres) for mixture in mixtures])
        # ∫ p(x) dx as a sum over the cells, which is 1 if the grid holds the prior. Half of that is
        # far too little.
        total = np.exp(log_sum_exp(logs)) * self.grid.volume
        if (total < 0.5).any():
            raise ValueError(
                "prior must have its probability in the box of the grid, and be wider than a "
                f"cell, got a sum of {total.min():.2g} over the cells"
            )
        logs = _normalize(logs)
        return {"log_masses": np.broadcast_to(logs, (*runs, *logs.shape)).copy()}

    def next_state(self, step: Step[GridState]) -> GridState:
        """Forecast the cells' probabilities, weight them by likelihoods, fuse."""
        # Log-probabilities (*runs, A, n) of the cells, equal ones in failed runs
        forecast = step.keep_failed(self._forecast(step), old=0.0)
        logs = _normalize(forecast)
        for _time_index, group in step.received():
            self._weight(logs, group, step)
        if step.has_fusion and self.fused == "likelihoods":
            # log p(y | x) + a constant: the change by each agent's own observations. A times the
            # average over the agents is their sum.
            (averaged,) = step.fuse(logs - _normalize(forecast))
            logs = _normalize(forecast + self.n_agents * averaged)
        elif step.has_fusion:
            # Π p_i^(1/A), normalised: the geometric mean of the beliefs
            (averaged,) = step.fuse(logs)
            logs = _normalize(averaged)
        return step.end(log_masses=logs)

    def summarize(self, state: GridState) -> Summary:
        """Return means and covariances; a belief is no narrower than a cell."""
        centres = self.grid.centres
        weights = state.masses
        mean, cov = compute_moments(centres, weights)
        # The variance w² / 12 of a uniform density on a cell of width w, along each axis
        cell_variance = self.grid.spacing**2 / 12
        # Index of the diagonal
        i = np.arange(len(cell_variance))
        cov[..., i, i] = np.maximum(cov[..., i, i], cell_variance)
        mean = state.mask_failed(mean)
        cov = state.mask_failed(cov)
        return Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov)

    def _forecast(self, step: Step[GridState]) -> Array:
        """Return the logarithms of the forecast probabilities."""
        old: Array = step.state.log_masses
        if not step.dt:
            return old
        t = step.state.t
        moved = self.model.step(self.grid.centres, t, step.dt)
        noise = self.model.Q(t, step.dt)
        # Without motion and noise the probabilities stay: no sum over cells may spread them.
        if not noise.any() and np.array_equal(moved, self.grid.centres):
            return old
        matrix = _transition_matrix(self.grid, moved.tobytes(), noise.tobytes())
        # All runs and agents in one sparse product
        columns = step.state.masses.reshape(-1, old.shape[-1]).T
        forecast = (matrix @ columns).T.reshape(old.shape)
        # Columns of the matrix sum to less than 1 near the sides of the box, where probability
        # leaves it. A loss of a hundredth is worth a warning.
        total = step.keep_failed(forecast.sum(axis=-1), old=1.0)
        if (total < 0.99).any():
            step.warn_once(
                "outside",
                "grid must have a box in which the state stays, but at t = "
                f"{step.t:g} s a probability of {1 - total.min():.2g} has left it",
            )
        # The logarithm of zero becomes a finite one, below all others.
        with np.errstate(divide="ignore"):
            return np.asarray(np.maximum(np.log(forecast), 2 * _MIN_LOG))

    def _weight(self, logs: Array, group: Received, step: Step[GridState]) -> None:
        """Multiply a group's probabilities by the likelihood of its observations, in place."""
        # The index of the group's agents in arrays (*runs, A, ...)
        rows = group.rows
        old = logs[..., rows, :]
        n_agents = len(group.agents)
        # The cells' predictions depend on the observed value, and so on the run, only if an angle
        # is brought near it, or a sensor is a likelihood. Otherwise one for each agent is enough.
        lead = old.shape[:-1] if group.wraps else (n_agents,)
        if group.likelihoods:
            lead = old.shape[:-1]
        members = np.broadcast_to(self.grid.centres, (*lead, *self.grid.centres.shape))
        predicted = group.predict(members, branch="each")
        if not all_finite(predicted):
            # A cell that cannot see contradicts what was seen, unless none can.
            is_blind = np.asarray(np.isnan(predicted).all(axis=-2))
            is_blind = np.broadcast_to(is_blind, group.target.shape)
            step.note_unseen(group, is_blind, "no cell can see")
        weights = np.exp(old)
        group = step.gate(
            group,
            _predict_moments,
            predicted,
            weights,
            near_observed=True,
            is_gaussian=False,
            weighted=(members, weights) if group.likelihoods else None,
        )
        group, likelihoods = group.log_likelihood(members)

        # log p_i + log p(y | x_i); a cell without a prediction contradicts the observation.
        joint = old + likelihoods
        joint = joint + particles.log_likelihood(
            predicted, group.target, group.noise, contradict=True
        )
        zero = np.zeros(old.shape[:-1])
        logs[..., rows, :], total = step.apply(
            _normalize_joint, (joint,), (old, zero), group.agents
        )
        self._warn_of_edge(logs[..., rows, :], step)
        if step.scores:
            constant = particles.log_normalizer(group.target, group.noise)
            step.add_log_likelihood(total + constant, group.agents)

    def _warn_of_edge(self, logs: Array, step: Step[GridState]) -> None:
        """Warn once if most of a belief lies in the outermost cells of the box.

        Then the state is probably outside, where the belief has no cells. `logs` are the
        log-probabilities (*runs, G, n) of the agents that have just been updated.
        """
        at_edge = np.exp(logs[..., self._outermost]).sum(axis=-1)
        # Failed runs give no warning.
        largest = step.keep_failed(at_edge, old=0.0).max(initial=0.0)
        if largest > _MAX_AT_EDGE:
            step.warn_once(
                "edge",
                f"grid must have a box in which the state stays, but at t = {step.t:g} s a "
                f"probability of {largest:.2g} is in the outermost cells",
            )

    @cached_property
    def _outermost(self) -> Indices:
        """Indices of the cells at a side of the box, along axes with ten cells or more.

        Along shorter axes the two outermost cells hold much of any belief.
        """
        shape = np.array(self.grid.shape)
        # Each cell's index along every axis, (n, d)
        indices = np.indices(self.grid.shape).reshape(shape.size, -1).T
        at_side = ((indices == 0) | (indices == shape - 1)) & (shape >= 10)
        return np.flatnonzero(at_side.any(axis=-1))


def _normalize(logs: Array) -> Array:
    """Return logarithms of probabilities (..., n) whose sum is 1, none below the smallest."""
    return np.maximum(logs - log_sum_exp(logs), _MIN_LOG)


def _normalize_joint(joint: Array, *_others: object) -> tuple[Array, Array]:
    """Return normalised logarithms (..., n), and those of the sums, (...).

    The shared array and the generator that :meth:`Step.apply` adds are not needed.
    """
    total = log_sum_exp(joint)
    # Not so for minus infinity and NaN
    if not (total > -1e300).all():
        raise ArithmeticError("every cell has a likelihood of zero")
    return np.maximum(joint - total, _MIN_LOG), total[..., 0]


def _predict_moments(predicted: Array, weights: Array) -> tuple[Array, Array]:
    """Return moments of the predictions of the cells that can see; NaN if none can."""
    visible, visible_weights = select_visible(predicted, weights)
    return compute_moments(visible, visible_weights)


@lru_cache(maxsize=8)
def _transition_matrix(grid: Grid, moved: bytes, noise: bytes) -> csr_array:
    """Return the sparse matrix whose column j spreads the probability of cell j, (n, n).

    `moved` has the bytes of the n centres after the model's step, `noise` those of Q.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import KDTree

    d = grid.dim
    # Bytes are the key of the cache, since arrays cannot be.
    points = np.frombuffer(moved).reshape(-1, d)
    cov = np.frombuffer(noise).reshape(d, d)
    # In units of a cell, the narrowest direction of the noise
    scaled = cov / grid.spacing[:, None] / grid.spacing
    narrowest = np.sqrt(max(np.linalg.eigvalsh(scaled)[0], 0.0))
    if narrowest < _MIN_STD:
        raise ValueError(
            "grid must have cells no wider than twice the standard deviation of the process "
            f"noise, got cells of {1 / max(narrowest, 1e-9):.3g} deviations"
        )
    # Distances in standard deviations: |L⁻¹ (x_i - f(x_j))|
    lower = cholesky(cov)
    targets = solve_lower(lower, grid.centres.T).T
    sources = solve_lower(lower, points.T).T
    distances = KDTree(targets).sparse_distance_matrix(
        KDTree(sources), _CUTOFF, output_type="coo_matrix"
    )
    # N(x_i; f(x_j), Q) times the volume of a cell
    peak = grid.volume / np.sqrt((2 * np.pi) ** d) / np.diagonal(lower).prod()
    kernel = peak * np.exp(-0.5 * distances.data**2)
    entries = (kernel, (distances.row, distances.col))
    return csr_array(entries, distances.shape)
