"""Particle filters that reach consensus on the likelihood of all observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from itertools import product
from typing import Annotated, ClassVar

import numpy as np

from ..linalg import log_sum_exp
from ..validation import (
    Array,
    Bounds,
    DistinctIndices,
    FrozenModel,
    Indices,
    Mask,
    PositiveInt,
    call_user,
    check_array,
)
from .particle import ParticleFamily, ParticleState
from .step import Step

__all__ = ["LikelihoodConsensusFilter", "PolynomialBasis"]

_CUT = 1e-10
"""Combinations of basis functions that vary less, relatively, are left out of a fit."""


@dataclass(frozen=True, eq=False)
class PolynomialBasis(FrozenModel):
    r"""All monomials of some components of the state, up to a degree, without the constant.

    Of :math:`(\mathbf x-\mathbf c)/s`, with a centre and a scale that all agents know.

    Parameters
    ----------
    components : sequence of int
        The k components of the state that the sensors observe.
    degree : int
        The largest sum of exponents.
    centre : array_like, (k,), or float
    scale : array_like, (k,), or float
        Positive. Of the size of the region in which the state moves, so that powers neither
        vanish nor overflow.

    Examples
    --------
    >>> basis = PolynomialBasis([1], degree=3, centre=1.0, scale=2.0)
    >>> basis(np.array([[9.0, 5.0]]))
    array([[2., 4., 8.]])
    """

    components: DistinctIndices
    _: KW_ONLY
    degree: PositiveInt = 2
    centre: float | Annotated[Array, "k"] = 0.0
    scale: float | Annotated[Array, "k", Bounds(above=0)] = 1.0

    def __call__(self, states: Array) -> Array:
        """Return the monomials of states (..., d), (..., P)."""
        x = (states[..., list(self.components)] - self.centre) / self.scale
        k = len(self.components)
        result = []
        for exponents in product(range(self.degree + 1), repeat=k):
            if 0 < sum(exponents) <= self.degree:
                result.append((x ** np.array(exponents)).prod(axis=-1))
        return np.stack(result, axis=-1)


@dataclass(frozen=True, eq=False)
class LikelihoodConsensusFilter(ParticleFamily):
    r"""Particle filters that weight their particles by an approximation of all likelihoods.

    Each agent approximates the log-likelihood of its own observations on its own particles, by
    least squares in P basis functions that all agents know. As the log-likelihoods of independent
    observations add up, so do the coefficients: A times their average is all that is needed,

    .. math:: \log p(\mathbf y_{1:A}\mid\mathbf x)\approx
        \sum_{p=1}^P\Bigl(\sum_{i=1}^A\alpha_{ip}\Bigr)\varphi_p(\mathbf x)

    The numbers that are sent do not depend on the number of particles or of observations. If the
    basis holds the log-likelihoods, such as quadratic polynomials those of linear sensors, and the
    average is exact, the filter is that of all observations.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`; sensors may be likelihoods, but not of
        changes. Where nobody can send, each agent uses its own observations only.
    fusion : callable
        The consensus rule, ``fusion(values, channel) -> values`` for vectors, such as
        ``partial(average_consensus, rounds=10)``; required.
    basis : callable
        ``basis(states) -> values`` of the basis functions, (..., d) to (..., P), fewer than the
        particles; such as :class:`PolynomialBasis`.
    members, ess_threshold, jitter, lag, on_error, record_evidence
        As for :class:`ParticleFilter`. The evidence is that of an agent's own observations, and
        no delayed observations are accepted.

    Notes
    -----
    O. Hlinka, O. Slučiak, F. Hlawatsch, P. M. Djurić and M. Rupp, IEEE Transactions on Signal
    Processing 60 (2012) 4334-4349.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.network import finite_time_consensus, graphs
    >>> from distfilt.sensors import component
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> f = LikelihoodConsensusFilter(
    ...     still,
    ...     [component([0], std=1.0)] * 4,
    ...     graphs.ring(4),
    ...     basis=PolynomialBasis([0]),
    ...     fusion=finite_time_consensus,
    ...     members=20000,
    ... )
    >>> state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
    >>> state = f.step(state, 0.0, [[1.0], [2.0], [3.0], [4.0]])
    >>> f.summarize(state).mean.ravel().round(1), state.ledger.messages
    (array([2., 2., 2., 2.]), array([4, 4, 4, 4]))
    """

    _: KW_ONLY
    basis: Callable[[Array], Array]

    belief_kind: ClassVar[str | None] = "vectors"
    supports_increments: ClassVar[bool] = False

    def check_parts(self) -> None:
        """Refuse a filter without a consensus rule."""
        super().check_parts()
        if self.fusion is None:
            raise ValueError(
                "fusion must be a consensus rule, such as partial(average_consensus, "
                "rounds=10), got None"
            )

    def _assimilate(
        self,
        log_weights: Array,
        stack: list[Array],
        origin: Array,
        step: Step[ParticleState],
    ) -> None:
        """Multiply the weights by the likelihood of all observations, in place."""
        if step.delayed:
            raise ValueError(
                "delayed must be empty here, where the agents exchange likelihoods of the present "
                f"state, got {len(step.delayed)} observations"
            )
        # Each agent weights a copy by its own observations, as any particle filter does.
        own = log_weights.copy()
        super()._assimilate(own, stack, origin, step)
        if not step.has_fusion:
            log_weights[...] = own
            return
        # log p(y | x) of each agent's own observations, but for a constant
        logs = own - log_weights
        is_alive = log_weights > -1e299
        # No polynomial falls to zero at once: where an observation is impossible it counts as
        # unlikely as anywhere else.
        is_possible = is_alive & (own > -1e299)
        least = np.where(is_possible, logs, np.inf).min(axis=-1, keepdims=True)
        logs = np.where(is_possible, logs, least)
        joint = log_weights + self._add_up(stack[-1], logs, is_alive, step)
        # A weight of zero stays finite.
        log_weights[...] = np.maximum(joint - log_sum_exp(joint), -1e300)

    def _fuse(
        self,
        log_weights: Array,
        stack: list[Array],
        ancestors: Indices,
        step: Step[ParticleState],
    ) -> tuple[list[Array], Array]:
        """Return the members as they are: the rule has averaged likelihoods already."""
        return stack[:-1], stack[-1]

    def _add_up(
        self, members: Array, logs: Array, is_alive: Mask, step: Step[ParticleState]
    ) -> Array:
        """Return the sums of all agents' log-likelihoods at each one's particles, (*runs, A, N)."""
        values = call_user(self.basis, members.copy())
        values = check_array(values, "basis", (*logs.shape, "P"))
        n_functions = values.shape[-1]
        if n_functions >= self.members:
            raise ValueError(
                f"basis must have fewer functions than the {self.members} particles, got "
                f"{n_functions}"
            )
        # The constant is fitted too: all is taken relative to the mean over the particles.
        weights = is_alive / is_alive.sum(axis=-1, keepdims=True)
        centred = values - (weights[..., None, :] @ values)
        centred = np.where(is_alive[..., None], centred, 0.0)
        # Functions of unit spread have coefficients of like size.
        spread = np.sqrt((centred**2).mean(axis=-2, keepdims=True))
        spread = np.where(spread > 0, spread, 1.0)
        target = logs - (weights * logs).sum(axis=-1, keepdims=True)
        target = np.where(is_alive, target, 0.0)
        # α of least squares
        inverse = np.linalg.pinv(centred / spread, rcond=_CUT)
        fitted = (inverse @ target[..., None])[..., 0] / spread[..., 0, :]
        (averaged,) = step.fuse(fitted)
        # Σ_p (Σ_i α_ip) φ_p(x), with A times the average for the sum
        return np.asarray(self.n_agents * (values @ averaged[..., None])[..., 0])
