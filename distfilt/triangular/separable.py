r"""Separable triangular maps: curved in every variable, one variable at a time.

Component k of the x-block is

.. math::
    S^k(\mathbf z) &= c_0 + \sum_{l<k}\Bigl(c_l z_l + \sum_j c_{lj}\,\varphi_{lj}(z_l)\Bigr)\\
    &\quad + a_0 z_k + \sum_j a_j\int_{-\infty}^{z_k}\varphi_{kj},\qquad a_0 > 0,\; a_j\ge 0,

on standardised variables, with bumps :math:`\varphi_{lj}(z)=e^{-(z-\xi_{lj})^2/2\sigma_{lj}^2}` at
sample quantiles. The signs make it increase in :math:`z_k`. The objective (12) of Grange et al. is
convex in the coefficients. Those of the earlier variables enter it quadratically and are
eliminated; Newton's method finds the few nonnegative ones, in all runs at once.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from .. import ensembles
from ..linalg import SolverError, broadcast_leading
from ..validation import Array, NonNegativeFloat, NonNegativeInt, validated
from .affine import (
    MapObservations,
    MapStates,
    ObservationSamples,
    StateSamples,
    check_variables,
    join_samples,
    multiply_vector,
)

__all__ = ["SeparableMap", "fit"]

_BUMP_AREA = np.sqrt(2 * np.pi)
"""Integral of a bump of unit width."""
_SINGULAR = 1e-12
"""Eigenvalue, relative to the largest, below which a matrix counts as singular."""
_LEAST_SLOPE = 0.1
"""Least linear coefficient, per standard deviation; the best affine map has at least 1."""
_ITERATIONS = 100
"""Largest number of Newton steps; ten are enough as a rule."""
_HALVINGS = 40
"""Largest number of times that a Newton step is tried, halved each time."""


@dataclass(frozen=True, eq=False)
class SeparableMap:
    """The map S(y, x) that takes x given y to the standard normal, component by component.

    Variables are numbered through: the m observations, then the d components of the state.

    Parameters
    ----------
    n_observed : int
        Number m of observations.
    centre, std : ndarray, (..., m + d)
        Mean and standard deviation by which each variable is standardised.
    bumps : ndarray, (2, ..., m + d, p)
        Centres and widths of the bumps of each standardised variable.
    steps : ndarray, (2, ..., d, q)
        The same for the integrated bumps of each state component.
    uses : list of list of int
        Which earlier variables each of the d components uses.
    weights : list of ndarray
        Per component (..., 1 + L + L p): the constant, the L linear coefficients, the bumps'.
    slopes : list of ndarray
        Per component (..., 1 + q): the linear coefficient and those of the integrated bumps,
        nonnegative, the first positive, which gives the map the whole line as its range.

    Examples
    --------
    >>> no_bumps = np.empty((2, 1, 0))
    >>> double = SeparableMap(
    ...     0,
    ...     np.zeros(1),
    ...     np.ones(1),
    ...     no_bumps,
    ...     no_bumps,
    ...     [[]],
    ...     [np.zeros(1)],
    ...     [np.array([2.0])],
    ... )
    >>> double(np.empty((1, 0)), [[3.0]])
    array([[6.]])
    """

    n_observed: int
    centre: Array
    std: Array
    bumps: Array
    steps: Array
    uses: list[list[int]]
    weights: list[Array]
    slopes: list[Array]

    @property
    def dim(self) -> int:
        """Number d of components."""
        return len(self.uses)

    def _standardise(self, y: Array, x: Array) -> Array:
        """Return standardised (y, x), (..., N, m + d); one y for all members is repeated."""
        lead = broadcast_leading(x.shape[:-1], y.shape[:-1], "y")
        full_y = np.broadcast_to(y, (*lead, y.shape[-1]))
        full_x = np.broadcast_to(x, (*lead, x.shape[-1]))
        joint = np.concatenate([full_y, full_x], axis=-1)
        centred = joint - self.centre[..., None, :]
        return np.asarray(centred / self.std[..., None, :])

    def _earlier_part(self, joint: Array, k: int) -> Array:
        """Return the terms of component k in the variables before its own, (..., N).

        `joint` has the standardised (y, x), (..., N, m + d).
        """
        used = self.uses[k]
        features = _earlier_features(joint[..., used], self.bumps[..., used, :])
        return multiply_vector(features, self.weights[k])

    def _increasing_part(self, v: Array, k: int) -> tuple[Array, Array]:
        """Return the terms of component k in its own variable v (..., N), and their derivative."""
        values, rates = _increasing_features(v, self.steps[..., k, :])
        slopes = self.slopes[k]
        return multiply_vector(values, slopes), multiply_vector(rates, slopes)

    @validated
    def __call__(self, y: MapObservations, x: MapStates) -> Array:
        """Return reference samples S(y, x), (..., N, d), of y (..., N, m) and x (..., N, d)."""
        joint = self._standardise(y, x)
        components = []
        for k in range(self.dim):
            # A function of the earlier variables, and an increasing one of the own variable.
            v = joint[..., self.n_observed + k]
            increasing, _rate = self._increasing_part(v, k)
            components.append(self._earlier_part(joint, k) + increasing)
        return np.stack(components, axis=-1)

    @validated
    def inverse(self, y: MapObservations, z: MapStates) -> Array:
        """Return members x with S(y, x) = z, (..., N, d); y is (..., N, m), or (..., m) for all."""
        if y.ndim == self.centre.ndim:
            y = y[..., None, :]
        m = self.n_observed
        # Columns m and on are x, filled component by component; until then z is in their place,
        # which gives the array its shape.
        joint = self._standardise(y, z)
        for k in range(self.dim):
            # Component k in its own variable alone, as far as the earlier ones leave it open.
            target = z[..., k] - self._earlier_part(joint, k)
            # The increasing part lies between a_0 v and a_0 v + H, with H the sum of the steps'
            # heights, so its root lies between (target - H) / a_0 and target / a_0. A step is as
            # high as a_j times the area of its bump, of width sigma_j.
            linear = self.slopes[k][..., :1]
            areas = _BUMP_AREA * self.steps[1][..., k, :]
            heights = areas * self.slopes[k][..., 1:]
            total_height = heights.sum(axis=-1, keepdims=True)
            low = (target - total_height) / linear
            high = target / linear
            part = partial(self._increasing_part, k=k)
            joint[..., m + k] = invert(part, target, low, high)
        std = self.std[..., None, m:]
        centre = self.centre[..., None, m:]
        return np.asarray(joint[..., m:] * std + centre)

    @validated
    def log_det(self, y: MapObservations, x: MapStates) -> Array:
        """Return the log-determinant of the map's derivative in x at each member, (..., N)."""
        joint = self._standardise(y, x)
        m = self.n_observed
        # The derivative is triangular: the sum of log(dS_k / dx_k) = log(dS_k / dv_k) - log std_k
        # for the standardised variables v_k = (x_k - centre_k) / std_k.
        log_scale = np.log(self.std[..., m:]).sum(axis=-1)
        total = -log_scale[..., None]
        for k in range(self.dim):
            # Only the increasing part of S_k depends on v_k; its `rate` is dS_k / dv_k, (..., N).
            _value, rate = self._increasing_part(joint[..., m + k], k)
            total = total + np.log(rate)
        return np.asarray(total)


def _earlier_features(v: Array, bumps: Array) -> Array:
    """Return 1, the L variables v (..., N, L) and their bumps, (..., N, 1 + L + L p).

    `bumps` has the centres and widths of p bumps for each variable, (2, ..., L, p).
    """
    # The axis None is that of the samples.
    centres, widths = bumps[..., None, :, :]
    u = (v[..., None] - centres) / widths
    heights = np.exp(-0.5 * u**2)
    # Bumps of one variable stand side by side.
    lead = v.shape[:-1]
    n_bumps = heights.shape[-1] * v.shape[-1]
    flat_heights = heights.reshape(*lead, n_bumps)
    constant = np.ones((*lead, 1))
    return np.concatenate([constant, v, flat_heights], axis=-1)


def _increasing_features(v: Array, steps: Array) -> tuple[Array, Array]:
    """Return a variable v (..., N) with its integrated bumps, and their derivatives in v.

    Both are (..., N, 1 + q). `steps` has the centres and widths of the q bumps, (2, ..., q).
    """
    from scipy.special import ndtr

    # The axis None is that of the samples.
    centres, widths = steps[..., None, :]
    u = (v[..., None] - centres) / widths
    # The integral of exp(-u² / 2) is a normal distribution function times the bump's area.
    integrals = _BUMP_AREA * widths * ndtr(u)
    values = np.concatenate([v[..., None], integrals], axis=-1)
    # Their derivatives are one and the bumps.
    ones = np.ones((*v.shape, 1))
    bumps = np.exp(-0.5 * u**2)
    rates = np.concatenate([ones, bumps], axis=-1)
    return values, rates


@validated
def fit(
    y: ObservationSamples,
    x: StateSamples,
    *,
    order: NonNegativeInt | tuple[NonNegativeInt, NonNegativeInt],
    regularisation: NonNegativeFloat = 0.0,
    uses: Sequence[Collection[NonNegativeInt]] | None = None,
) -> SeparableMap:
    r"""Fit the separable map to samples: the minimiser of (12) of Grange et al., regularised.

    Component k minimises the mean negative log-likelihood of its variable, given the earlier ones,
    and a penalty:

    .. math:: \frac1N\sum_i\Bigl(\tfrac12 S^k(\mathbf z_i)^2
        - \log\partial_k S^k(\mathbf z_i)\Bigr)
        + \tfrac\lambda2\Bigl(\sum_{l,j} c_{lj}^2 + \sum_{j\ge1} a_j^2\Bigr)

    with the coefficients of the module's docstring: :math:`c_{lj}` of bump j of the earlier
    variable l, :math:`a_j` of integrated bump j of the component's own variable. Linear
    coefficients are not penalised, so a large penalty gives the affine map. The linear coefficient
    :math:`a_0` of the own, standardised variable is at least 0.1, which keeps the map invertible;
    that of the best affine map is at least 1, so that the bound excludes none of these.

    Parameters
    ----------
    y : array_like, (..., N, m)
        Predicted observations, with noise; m may be 0.
    x : array_like, (..., N, d)
        Members.
    order : int or (int, int)
        Number of bumps per earlier variable, and of integrated bumps of the component's own
        variable; one number is for both. 0 gives the affine map.
    regularisation : float
        The penalty λ, at least 0.
    uses : sequence of collections of int, optional
        For each of the d components, the earlier variables that it may use, all by default:
        observations are numbered 0 to m - 1, state components follow. Leaving variables out makes
        the map sparse.

    Raises
    ------
    ValueError
        With too few members for the coefficients, or where a variable is constant or repeats
        others.
    SolverError
        If Newton's method does not converge.

    Notes
    -----
    The parameterisation is that of A. Spantini, R. Baptista and Y. Marzouk, SIAM Review 64 (2022)
    921-953, with a linear function in place of their two edge functions.

    Examples
    --------
    A banana: the second component bends with the first.

    >>> rng = np.random.default_rng(0)
    >>> u = rng.standard_normal((2000, 2))
    >>> x = np.column_stack([u[:, 0], u[:, 1] + u[:, 0] ** 2])
    >>> s = fit(x[:, :0], x, order=3)
    >>> bool(abs(s(x[:, :0], x) - u).mean() < 0.1)
    True
    """
    m = y.shape[-1]
    n_bumps, n_steps = (order, order) if isinstance(order, int) else order
    allowed = _check_uses(uses, m, x.shape[-1])
    # The largest component has a constant and a linear coefficient for its own and for each
    # earlier variable. The samples must determine them, and, unless a penalty does, its bumps'.
    most_used = max(len(used) for used in allowed)
    n_coefficients = 2 + most_used
    if not regularisation:
        n_coefficients += n_steps + most_used * n_bumps
    if x.shape[-2] <= n_coefficients:
        raise ValueError(
            f"x must have more than {n_coefficients} members for as many coefficients, "
            f"got {x.shape[-2]}"
        )
    # Samples (y, x) of mean zero and variance one, (..., N, m + d)
    samples = _standardise_samples(y, x)
    joint = samples.joint
    _check_combinations(joint, allowed, m)
    # Centres and widths of the bumps of each variable, at sample quantiles
    bumps = _place_bumps(joint, n_bumps, n_observed=m)
    # Integrated bumps are smooth steps; only the state's variables have them.
    steps = _place_bumps(joint[..., m:], n_steps, n_observed=0)
    weights = []
    slopes = []
    for k, used in enumerate(allowed):
        # Basis functions of the earlier variables, and of the own one with their derivatives.
        features = _earlier_features(joint[..., used], bumps[..., used, :])
        own_variable = joint[..., m + k]
        values, rates = _increasing_features(own_variable, steps[..., k, :])
        # The constant and the linear coefficients have no penalty.
        n_linear = 1 + len(used)
        weight, slope = _fit_component(
            features, values, rates, n_linear, regularisation
        )
        weights.append(weight)
        slopes.append(slope)
    return SeparableMap(
        m, samples.centre, samples.std, bumps, steps, allowed, weights, slopes
    )


def _check_uses(
    uses: Sequence[Collection[int]] | None, m: int, d: int
) -> list[list[int]]:
    """Return the earlier variables that each of d components uses, sorted; all by default."""
    if uses is None:
        return [list(range(m + k)) for k in range(d)]
    allowed = [sorted(set(used)) for used in uses]
    valid = len(allowed) == d
    for k, (used, variables) in enumerate(zip(allowed, uses, strict=True)):
        is_distinct = len(used) == len(variables)
        # Component k is variable m + k: all that it uses come before.
        is_earlier = not used or used[-1] < m + k
        valid = valid and is_distinct and is_earlier
    if not valid:
        raise ValueError(
            f"uses must be for each of {d} components different variables before its "
            f"own, the {m} observations first, got {uses}"
        )
    return allowed


class _StandardSamples(NamedTuple):
    """Standardised samples (y, x), (..., N, m + d), and their means and deviations (..., m + d)."""

    joint: Array
    centre: Array
    std: Array


def _standardise_samples(y: Array, x: Array) -> _StandardSamples:
    """Return samples (y, x) with mean zero and variance one."""
    joint = join_samples(y, x)
    centre = ensembles.mean(joint)
    joint -= centre[..., None, :]
    variance = (joint**2).mean(axis=-2)
    std = np.sqrt(variance)
    # A smaller deviation is rounding of the mean.
    is_constant = std <= 1e-13 * np.abs(centre)
    # Refuse constant ones: the error names the first, as a column of y or of x.
    check_variables(is_constant, y.shape[-1], needs="are not constant")
    joint /= std[..., None, :]
    return _StandardSamples(joint, centre, std)


def _check_combinations(joint: Array, uses: list[list[int]], m: int) -> None:
    """Raise an error if a component's variables are linear combinations of each other.

    `joint` has the standardised samples (y, x), (..., N, m + d); `uses` lists the earlier variables
    of each component.
    """
    correlation = joint.mT @ joint / joint.shape[-2]
    for k, used in enumerate(uses):
        observations = [v for v in used if v < m]
        # If the observations alone are combinations of each other, the error names y.
        for name, variables in (("y", observations), ("x", [*used, m + k])):
            block = correlation[..., variables, :][..., variables]
            if np.linalg.eigvalsh(block).min(initial=1.0) < _SINGULAR:
                raise ValueError(
                    f"{name} must have variables that are not combinations of others, "
                    f"got a singular correlation matrix in component {k}"
                )


def _place_bumps(joint: Array, n: int, *, n_observed: int) -> Array:
    """Return `n` centres for each variable, at sample quantiles, and widths, (2, ..., D, n).

    The samples `joint` are (..., N, D). An error names a variable: the first ones observed
    are y, the others x.
    """
    # 2 n + 1 equally spaced levels: every second one is a centre, and its width is the distance
    # of the two levels next to it.
    n_levels = 2 * n + 1
    levels = np.arange(1, n_levels + 1) / (n_levels + 1)
    quantiles = np.quantile(joint, levels, axis=-2)
    quantiles = np.moveaxis(quantiles, 0, -1)
    centres = quantiles[..., 1::2]
    edges = quantiles[..., ::2]
    widths = np.diff(edges, axis=-1)
    is_degenerate = np.any(widths <= 0, axis=-1)
    # The error names the first such variable, as a column of y or of x.
    needs = "have quantiles that differ for the basis functions"
    check_variables(is_degenerate, n_observed, needs)
    return np.stack([centres, widths])


def _fit_component(
    features: Array, values: Array, rates: Array, n_linear: int, penalty: float
) -> tuple[Array, Array]:
    r"""Return a component's coefficients: of the earlier variables, then the nonnegative ones.

    `features` is :math:`\Psi`, the functions of the earlier variables, `values` is :math:`\Phi`,
    those of the own variable, and `rates` their derivatives :math:`\Phi'`. The first `n_linear`
    features have no penalty. Shapes are (..., N, p), (..., N, q) and (..., N, q).

    For the component :math:`\Psi\mathbf c + \Phi\mathbf a` the objective (12) of Grange et al. is
    :math:`\tfrac1{2N}|\Psi\mathbf c+\Phi\mathbf a|^2 - \tfrac1N\sum_i\log(\Phi'\mathbf a)_i`, to
    be minimised over free c and nonnegative a. For given a, the best c solves a regression,
    c = -W a, which leaves a quadratic form in a.
    """
    n = features.shape[-2]
    # The penalty is on the bumps only.
    is_bump = np.arange(features.shape[-1]) >= n_linear
    is_step = np.arange(values.shape[-1]) >= 1
    feature_penalty = penalty * is_bump
    value_penalty = penalty * is_step
    # W = (Ψᵀ Ψ / N + D)⁻¹ Ψᵀ Φ / N, with the penalty on the diagonal of D.
    normal_matrix = features.mT @ features / n + np.diag(feature_penalty)
    eigenvalues = np.linalg.eigvalsh(normal_matrix)
    smallest = eigenvalues[..., 0]
    largest = eigenvalues[..., -1]
    if (smallest < _SINGULAR * largest).any():
        raise ValueError(
            "regularisation must be positive, since the basis functions are not "
            f"independent on these samples, got {penalty:g}"
        )
    regression = np.linalg.solve(normal_matrix, features.mT @ values / n)
    residual = values - features @ regression
    # Q = Rᵀ R / N + Wᵀ D W + E for the residuals R = Φ - Ψ W, E the penalty of a.
    quadratic = residual.mT @ residual / n
    weighted = feature_penalty[:, None] * regression
    quadratic = quadratic + regression.mT @ weighted
    quadratic = quadratic + np.diag(value_penalty)
    # Minimise aᵀ Q a / 2 - mean(log(Φ' a)) over a at least these bounds.
    lower = np.where(is_step, 0.0, _LEAST_SLOPE)
    slopes = _minimise_nonnegative(quadratic, rates, lower)
    # c = -W a.
    weights = -multiply_vector(regression, slopes)
    return weights, slopes


def _loss(a: Array, quadratic: Array, rates: Array) -> Array:
    """Return the loss a'Qa / 2 - mean(log(rates a)), (...), of coefficients a (..., q)."""
    column = a[..., None]
    row = a[..., None, :]
    form = 0.5 * (row @ quadratic @ column)[..., 0, 0]
    logs = np.log(multiply_vector(rates, a))
    return np.asarray(form - logs.mean(axis=-1))


def _minimise_nonnegative(quadratic: Array, rates: Array, lower: Array) -> Array:
    """Minimise a'Qa / 2 - mean(log(rates a)) over a >= lower by projected Newton steps.

    `quadratic` is Q (..., q, q), `rates` (..., N, q) are derivatives of the own variable's
    functions, and `lower` (q,) the lower bounds. Returns a, (..., q).
    """
    n = rates.shape[-2]
    identity = np.eye(quadratic.shape[-1])
    # The best affine map without steps, a_0 = Q_00^(-1/2), is the start.
    a = np.broadcast_to(lower, quadratic.shape[:-1]).copy()
    affine_slope = 1 / np.sqrt(quadratic[..., 0, 0])
    a[..., 0] = np.maximum(lower[0], affine_slope)
    for _ in range(_ITERATIONS):
        # Gradient Q a - mean(r_i / r_i'a) and Hessian Q + mean(r_i r_i' / (r_i'a)²), where r_i
        # is the row of rates of sample i.
        ratio = rates / (rates @ a[..., None])
        gradient = multiply_vector(quadratic, a) - ratio.mean(axis=-2)
        hessian = quadratic + ratio.mT @ ratio / n
        # A coefficient at its bound is fixed if the loss increases inwards. It gets a row of the
        # identity, and so a step of zero.
        free = (a > lower) | (gradient < 0)
        both_free = free[..., :, None] & free[..., None, :]
        system = np.where(both_free, hessian, identity)
        free_gradient = np.where(free, gradient, 0.0)
        solution = np.linalg.solve(system, free_gradient[..., None])
        step = -solution[..., 0]
        # A part of the step, so that the loss decreases, and back to the bounds
        a = _search_projected(a, step, gradient, quadratic, rates, lower)
        # The Newton decrement gᵀ H⁻¹ g is about twice the distance of the loss from its minimum,
        # before the step. The loss is of the order of one, with a rounding of some 1e-15.
        decrement = -(free_gradient * step).sum(axis=-1)
        if (decrement < 1e-13).all():
            return a
    raise SolverError(f"separable: no minimum of (12) after {_ITERATIONS} Newton steps")


def _search_projected(
    start: Array,
    step: Array,
    gradient: Array,
    quadratic: Array,
    rates: Array,
    lower: Array,
) -> Array:
    """Halve the step from `start` (..., q), in each run, until the loss decreases enough.

    A point below a bound is projected: moved to the bound. The other arguments are those of
    :func:`_minimise_nonnegative` and its gradient.
    """
    before = _loss(start, quadratic, rates)
    # The loss is of the order of one, with a rounding of some 1e-15.
    rounding = 1e-14 * (1 + np.abs(before))
    length = np.ones(start.shape[:-1])
    for _ in range(_HALVINGS):
        a = np.maximum(lower, start + length[..., None] * step)
        # Armijo's condition, with the customary 1e-4: the loss falls by some part of the decrease
        # that the gradient predicts. Near the minimum the decrease is lost in rounding.
        required = 1e-4 * (gradient * (a - start)).sum(axis=-1)
        accepted = _loss(a, quadratic, rates) <= before + required + rounding
        if accepted.all():
            break
        length = np.where(accepted, length, 0.5 * length)
    return a


def invert(
    function: Callable[[Array], tuple[Array, Array]],
    target: Array,
    low: Array,
    high: Array,
) -> Array:
    """Solve ``function(v) = target`` by Newton's method inside a shrinking bracket.

    The function returns values and positive derivatives, element by element. Target and bracket
    are arrays of one shape, or broadcast to it, with a root between `low` and `high` in each
    element. A Newton step that would leave the bracket is replaced by a bisection, so the
    iteration converges.

    Raises
    ------
    SolverError
        If the iteration does not converge, for instance if a target is NaN.

    Examples
    --------
    >>> ends = np.full(2, -4.0), np.full(2, 4.0)
    >>> invert(lambda v: (np.sinh(v), np.cosh(v)), np.sinh([-2.0, 0.5]), *ends).round(9)
    array([-2. ,  0.5])
    """
    v = 0.5 * (low + high)
    last_change = high - low
    for _ in range(2 * _ITERATIONS):
        value, derivative = function(v)
        error = value - target
        # The function increases, so the error's sign says on which side the root lies.
        low = np.where(error <= 0, v, low)
        high = np.where(error >= 0, v, high)
        newton = v - error / derivative
        change = np.abs(newton - v)
        # A few hundred units of rounding.
        tolerance = 1e-13 * (1 + np.abs(v))
        # Newton's step is taken where it is inside the bracket and at most half as long as the
        # last, or the method could alternate for ever; and where it is within the tolerance, when
        # rounding may put it on the end of the bracket.
        inside = (newton > low) & (newton < high)
        shrinks = change <= 0.5 * last_change
        takes_newton = (inside & shrinks) | (change <= tolerance)
        new = np.where(takes_newton, newton, 0.5 * (low + high))
        last_change = np.abs(new - v)
        v = new
        if (last_change <= tolerance).all():
            return np.asarray(v)
    raise SolverError("separable: the map's inverse did not converge at all targets")
