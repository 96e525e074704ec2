"""Particle filters that reach consensus on the likelihood of all observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from itertools import product
from typing import Annotated, ClassVar

import numpy as np

from ..linalg import cholesky, log_sum_exp, solve_lower
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
from .step import Received, Step

__all__ = ["LikelihoodConsensusFilter", "PolynomialBasis"]

_RANK_TOLERANCE = 1e-10
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

    @property
    def exponents(self) -> Indices:
        """The exponents of each monomial, (P, k)."""
        k = len(self.components)
        every = product(range(self.degree + 1), repeat=k)
        return np.array([e for e in every if 0 < sum(e) <= self.degree])

    def __call__(self, states: Array) -> Array:
        """Return the monomials of states (..., d), (..., P)."""
        x = (states[..., list(self.components)] - self.centre) / self.scale
        return np.stack([(x**e).prod(axis=-1) for e in self.exponents], axis=-1)


@dataclass(frozen=True, eq=False)
class LikelihoodConsensusFilter(ParticleFamily):
    r"""Particle filters that weight their particles by an approximation of all likelihoods.

    Each agent approximates the predictions of its own sensors on its own particles, by least
    squares in P basis functions that all agents know and a constant,
    :math:`\hat h(\mathbf x)=\mathbf c^\top\boldsymbol\varphi(\mathbf x)` with
    :math:`\varphi_0=1`. With Gaussian noise the log-likelihood of the residual is quadratic in the
    functions. As the log-likelihoods of independent observations add up, so do the matrices of
    these forms: A times their average is all that is needed,

    .. math:: \log p(\mathbf y_{1:A}\mid\mathbf x)\approx-\tfrac12\,\boldsymbol\varphi^\top
        \Bigl(\sum_{i=1}^A\sum_m\mathbf c_{im}\mathbf c_{im}^\top\Bigr)\boldsymbol\varphi

    where :math:`\mathbf c_{im}` are the coefficients of the m-th residual of agent i, in units of
    its standard deviation. The numbers that are sent do not depend on the number of particles or
    of observations: P (P + 3) / 2, or, of monomials up to a degree, one for each monomial up to
    twice the degree. If the basis holds the predictions, as linear functions those of linear
    sensors, and the average is exact, the filter is that of all observations.

    A log-likelihood that is not of this form, as of a sensor that is a likelihood, of an angle
    of which some particles have no prediction, or of an agent some of whose observations the
    gate has rejected, is itself approximated in the P basis functions.

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
    Processing 60 (2012) 4334-4349, for likelihoods of the exponential family. The agents draw
    different particles, so each one evaluates the others' approximations a little outside the
    particles that these were fitted on. A squared residual is small or large there, but never
    gives a particle more weight than a perfect fit would. A polynomial that is fitted to the
    log-likelihood itself has no such limit: it may rise without bound beyond the particles, and
    one particle then takes all the weight. This remains possible for sensors that are
    likelihoods; prefer a low degree there.

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
    ...     basis=PolynomialBasis([0], degree=1),
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
        if not step.has_fusion:
            super()._assimilate(log_weights, stack, origin, step)
            return
        # Each agent weights a copy by its own observations, as any particle filter does.
        own = log_weights.copy()
        # A fit of functions of the particles, on those whose weight is not zero: the logarithm of
        # zero is stored as -1e300.
        regression = _LeastSquares(
            self._evaluate_basis(stack[-1]), log_weights > -1e299
        )
        # The K products of two basis functions, in which the log-likelihoods are approximated
        products = _Products(self.basis, regression.n_functions)
        coefficients = np.zeros((*log_weights.shape[:-1], products.size))
        for time_index, group in step.received():
            self._weight(own, stack, time_index, group, origin, step)
            # The index of the group's agents in arrays (*runs, A, ...)
            rows = group.rows
            # log p(y | x) of each agent's own observations, but for a constant
            logs = own[..., rows, :] - log_weights[..., rows, :]
            # An impossible observation leaves a weight of zero.
            is_possible = own[..., rows, :] > -1e299
            whitened = _whiten(group, stack[-1][..., rows, :, :])
            coefficients[..., rows, :] = _approximate(
                regression.select(rows),
                products,
                logs,
                whitened,
                is_possible,
            )
        (averaged,) = step.fuse(coefficients)
        # A times the average is the sum over the agents.
        values = products.evaluate(regression.functions)
        total = self.n_agents * (values @ averaged[..., None])[..., 0]
        joint = log_weights + total
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

    def _evaluate_basis(self, members: Array) -> Array:
        """Return the basis functions at all particles (*runs, A, N, d), (*runs, A, N, P)."""
        # A copy, since the user's function may work in place
        values = call_user(self.basis, members.copy())
        values = check_array(values, "basis", (*members.shape[:-1], "P"))
        n_functions = values.shape[-1]
        if n_functions >= self.members:
            raise ValueError(
                f"basis must have fewer functions than the {self.members} particles, got "
                f"{n_functions}"
            )
        return values


class _LeastSquares:
    """Least squares in basis functions (..., N, P) and a constant, on the particles that count.

    >>> x = np.array([[0.0], [1.0], [2.0], [9.0]])
    >>> regression = _LeastSquares(x, np.array([True, True, True, False]))
    >>> regression.fit(np.array([[1.0], [3.0], [5.0], [0.0]])).ravel().round(9)
    array([1., 2.])
    """

    def __init__(self, functions: Array, is_alive: Mask) -> None:
        self.functions = functions
        self.is_alive = is_alive
        self.n_functions = functions.shape[-1]

    def select(self, rows: Indices | slice) -> _LeastSquares:
        """Return those of some agents alone."""
        return _LeastSquares(
            self.functions[..., rows, :, :], self.is_alive[..., rows, :]
        )

    def fit(self, values: Array) -> Array:
        """Return the coefficients of values (..., N, m), of the constant first, (..., P + 1, m)."""
        # The constant is fitted by taking all relative to the mean over the particles that count.
        weights = self.is_alive / self.is_alive.sum(axis=-1, keepdims=True)
        mean = weights[..., None, :] @ self.functions
        alive = self.is_alive[..., None]
        centred = np.where(alive, self.functions - mean, 0.0)
        # Functions of unit spread have coefficients of like size.
        spread = np.sqrt((centred**2).mean(axis=-2, keepdims=True))
        spread = np.where(spread > 0, spread, 1.0)
        mean_value = weights[..., None, :] @ np.where(alive, values, 0.0)
        target = np.where(alive, values - mean_value, 0.0)
        inverse = np.linalg.pinv(centred / spread, rcond=_RANK_TOLERANCE)
        slopes = (inverse @ target) / spread.mT
        return np.concatenate([mean_value - mean @ slopes, slopes], axis=-2)


class _Products:
    """Products of two of the functions 1, φ_1, ..., φ_P, but for the constant.

    Those of monomials that are the same monomial count once.

    >>> products = _Products(PolynomialBasis([0], degree=2), 2)
    >>> products.size
    4
    >>> products.evaluate(np.array([[2.0, 4.0]]))
    array([[ 2.,  4.,  8., 16.]])
    """

    def __init__(self, basis: Callable[[Array], Array], n_functions: int) -> None:
        # The numbers of the two functions of each pair, but for the first pair, 1 times 1
        first, second = np.triu_indices(n_functions + 1)
        self.first = first[1:]
        self.second = second[1:]
        # Which product each pair is; pairs of equal monomials share one
        labels = np.arange(self.first.size)
        if isinstance(basis, PolynomialBasis):
            # x^a x^b = x^(a + b)
            constant = np.zeros((1, len(basis.components)), dtype=int)
            exponents = np.concatenate([constant, basis.exponents])
            sums = exponents[self.first] + exponents[self.second]
            _distinct, labels = np.unique(sums, axis=0, return_inverse=True)
        labels = labels.ravel()
        self.labels: Indices = labels
        self.size = int(labels.max()) + 1
        # A pair for each product, by which it is computed
        _distinct, self.pairs = np.unique(labels, return_index=True)

    def evaluate(self, functions: Array) -> Array:
        """Return the products of functions (..., N, P), (..., N, K)."""
        ones = np.ones((*functions.shape[:-1], 1))
        terms = np.concatenate([ones, functions], axis=-1)
        left = terms[..., self.first[self.pairs]]
        return np.asarray(left * terms[..., self.second[self.pairs]])

    def expand_squares(self, coefficients: Array) -> Array:
        """Return those of -½ Σ (c' φ)² for coefficients (..., P + 1, m) of functions, (..., K)."""
        # The matrix -½ Σ_m c_m c_mᵀ of the quadratic form in 1, φ_1, ..., φ_P
        matrix = -0.5 * coefficients @ coefficients.mT
        # A product of two different functions appears twice in the quadratic form.
        pairs = matrix[..., self.first, self.second]
        pairs = np.where(self.first == self.second, pairs, 2 * pairs)
        return self._collect(pairs)

    def expand_functions(self, coefficients: Array) -> Array:
        """Return the coefficients of c' φ for those (..., P + 1) of functions, (..., K)."""
        pairs = np.zeros((*coefficients.shape[:-1], self.first.size))
        # The products with the constant, function 0, are the functions themselves, in their order.
        pairs[..., self.first == 0] = coefficients[..., 1:]
        return self._collect(pairs)

    def _collect(self, pairs: Array) -> Array:
        """Add up the coefficients of pairs that have the same product, (..., K)."""
        # Whether a pair has a product, (pairs, K)
        is_product = self.labels[:, None] == np.arange(self.size)
        return np.asarray(pairs @ is_product)


def _whiten(group: Received, members: Array) -> Array:
    """Return residuals of all particles in units of the noise, (*runs, G, N, M).

    The group's G agents have M observed numbers each, and members (*runs, G, N, d). A missing
    number has a residual of zero; what a particle cannot predict is NaN.
    """
    # Each predicted angle is brought within half a period of the observed one.
    predicted = group.predict(members, branch="each")
    # L⁻¹ (y - h(x)) with R = L Lᵀ. Row and column of a missing number in R, (M, M) or (G, M, M),
    # become those of the identity, and so do those of a sensor that is a likelihood, whose
    # variance is zero.
    variance = np.diagonal(group.noise, axis1=-2, axis2=-1)
    missing = np.isnan(group.target) | (variance == 0)
    is_pair = ~missing[..., :, None] & ~missing[..., None, :]
    covariance = np.where(is_pair, group.noise, np.eye(missing.shape[-1]))
    residual = group.target[..., None, :] - predicted
    residual = np.where(missing[..., None, :], 0.0, residual)
    return np.asarray(solve_lower(cholesky(covariance), residual.mT).mT)


def _approximate(
    regression: _LeastSquares,
    products: _Products,
    logs: Array,
    whitened: Array,
    is_possible: Mask,
) -> Array:
    """Return the coefficients of some agents' log-likelihoods in the products, (*runs, G, K).

    A Gaussian log-likelihood is -½ |r|² of the whitened residuals r: these are fitted by the basis
    functions, so that the squares are exact if the sensor is. Others are fitted directly.
    """
    # The particles that have a weight, (*runs, G, N)
    alive = regression.is_alive
    # Whether the log-likelihoods are -½ |r|², but for a constant
    exact = -0.5 * (whitened**2).sum(axis=-1)
    difference = np.where(alive, logs - exact, 0.0)
    largest = np.where(alive, np.abs(exact), 0.0).max(axis=-1)
    # The range of the difference over the particles
    span = difference.max(axis=-1, where=alive, initial=-np.inf)
    span = span - difference.min(axis=-1, where=alive, initial=np.inf)
    # They are if the difference is the same for all particles, up to rounding, and no observation
    # is impossible for one of them.
    is_gaussian = span <= 1e-9 * (1 + largest)
    is_gaussian &= (is_possible | ~alive).all(axis=-1)
    squares = products.expand_squares(regression.fit(np.nan_to_num(whitened)))
    if is_gaussian.all():
        return squares
    # No polynomial falls to zero at once: where an observation is impossible it counts as
    # unlikely as anywhere else.
    least = np.where(is_possible & alive, logs, np.inf).min(axis=-1, keepdims=True)
    bounded = np.where(is_possible & alive, logs, least)
    direct = products.expand_functions(regression.fit(bounded[..., None])[..., 0])
    return np.where(is_gaussian[..., None], squares, direct)
