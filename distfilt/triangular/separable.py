r"""Separable triangular maps: curved in every variable, one variable at a time.

Component k of the x-block is

.. math::
    S^k(\mathbf z) &= c_0 + \sum_{l<k}\Bigl(c_l z_l + \sum_j c_{lj}\,\varphi_{lj}(z_l)\Bigr)\\
    &\quad + a_0 z_k + \sum_j a_j\int_{-\infty}^{z_k}\varphi_{kj},\qquad a_0 > 0,\; a_j\ge 0,

on standardised variables, with bumps :math:`\varphi_{lj}(z)=e^{-(z-\xi_{lj})^2/2\sigma_{lj}^2}` at
sample quantiles. The signs make it increase in :math:`z_k`. The objective (12) of Grange et al. is
convex in the coefficients. Those of the earlier variables enter it quadratically and are
eliminated; a few nonnegative ones are left for Newton's method, in all runs at once.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from .. import ensembles
from ..linalg import SolverError, leading
from ..validation import Array, NonNegativeFloat, NonNegativeInt, validated
from .affine import Members, OwnMembers, OwnSeen, Seen, joint_samples, refuse

__all__ = ["SeparableMap", "fit"]

_ROOT = np.sqrt(2 * np.pi)
_SINGULAR = 1e-12
"""Eigenvalue, relative to the largest, below which a matrix counts as singular."""
_LEAST_SLOPE = 0.1
"""Least linear coefficient, per standard deviation; the best affine map has at least 1."""
_ITERATIONS = 100


@dataclass(frozen=True, eq=False)
class SeparableMap:
    """The map S(y, x) that takes x given y to the standard normal, component by component.

    Variables are numbered through: the m observations, then the d components of the state.

    Parameters
    ----------
    observed : int
        Number m of observations.
    centre, spread : ndarray, (..., m + d)
        What each variable is shifted and divided by.
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
    >>> none = np.empty((2, 1, 0))
    >>> double = SeparableMap(
    ...     0,
    ...     np.zeros(1),
    ...     np.ones(1),
    ...     none,
    ...     none,
    ...     [[]],
    ...     [np.zeros(1)],
    ...     [np.array([2.0])],
    ... )
    >>> double(np.empty((1, 0)), [[3.0]])
    array([[6.]])
    """

    observed: int
    centre: Array
    spread: Array
    bumps: Array
    steps: Array
    uses: list[list[int]]
    weights: list[Array]
    slopes: list[Array]

    @property
    def dim(self) -> int:
        """Number d of components."""
        return len(self.uses)

    def _standard(self, y: Array, x: Array) -> Array:
        """Standardised (y, x), (..., N, m + d); one y for all members is repeated."""
        lead = leading(x.shape[:-1], y.shape[:-1], "y")
        joint = np.concatenate(
            [np.broadcast_to(v, (*lead, v.shape[-1])) for v in (y, x)], -1
        )
        return np.asarray(
            (joint - self.centre[..., None, :]) / self.spread[..., None, :]
        )

    def _earlier(self, joint: Array, k: int) -> Array:
        """What component k makes of the variables before its own, (..., N)."""
        used = self.uses[k]
        features = _earlier_features(joint[..., used], self.bumps[..., used, :])
        return np.asarray((features @ self.weights[k][..., None])[..., 0])

    def _own(self, v: Array, k: int) -> tuple[Array, Array]:
        """The increasing part of component k and its slope, (..., N)."""
        values, rates = _own_features(v, self.steps[..., k, :])
        a = self.slopes[k][..., None]
        return np.asarray((values @ a)[..., 0]), np.asarray((rates @ a)[..., 0])

    @validated
    def __call__(self, y: OwnSeen, x: OwnMembers) -> Array:
        """Reference samples S(y, x), (..., N, d), of members y (..., N, m) and x (..., N, d)."""
        joint = self._standard(y, x)
        m = self.observed
        own = [self._own(joint[..., m + k], k)[0] for k in range(self.dim)]
        return np.stack(
            [self._earlier(joint, k) + v for k, v in enumerate(own)], axis=-1
        )

    @validated
    def inverse(self, y: OwnSeen, z: OwnMembers) -> Array:
        """Members x with S(y, x) = z, (..., N, d); `y` is (..., N, m), or (..., m) for all."""
        seen = y[..., None, :] if y.ndim == self.centre.ndim else y
        joint = self._standard(seen, z)
        m = self.observed
        for k in range(self.dim):
            aim = z[..., k] - self._earlier(joint, k)
            line = self.slopes[k][..., :1]
            # A line plus steps of known heights: its ends need no search.
            heights = _ROOT * self.steps[1][..., k, :] * self.slopes[k][..., 1:]
            low = (aim - heights.sum(axis=-1, keepdims=True)) / line
            joint[..., m + k] = invert(partial(self._own, k=k), aim, low, aim / line)
        return joint[..., m:] * self.spread[..., None, m:] + self.centre[..., None, m:]

    @validated
    def log_det(self, y: OwnSeen, x: OwnMembers) -> Array:
        """Logarithm of the determinant of the map's derivative in x at each member, (..., N)."""
        joint = self._standard(y, x)
        m = self.observed
        total = -np.log(self.spread[..., m:]).sum(axis=-1)[..., None]
        for k in range(self.dim):
            total = total + np.log(self._own(joint[..., m + k], k)[1])
        return np.asarray(total)


def _earlier_features(v: Array, bumps: Array) -> Array:
    """1, the variables and their bumps, (..., N, 1 + L + L p), of variables (..., N, L)."""
    centres, widths = bumps[..., None, :, :]
    heights = np.exp(-0.5 * ((v[..., None] - centres) / widths) ** 2)
    flat = heights.reshape(*v.shape[:-1], heights.shape[-1] * v.shape[-1])
    return np.concatenate([np.ones((*v.shape[:-1], 1)), v, flat], axis=-1)


def _own_features(v: Array, steps: Array) -> tuple[Array, Array]:
    """The variable and its integrated bumps, and their slopes, (..., N, 1 + q), of (..., N)."""
    from scipy.special import ndtr

    centres, widths = steps[..., None, :]
    u = (v[..., None] - centres) / widths
    values = _ROOT * widths * ndtr(u)
    ones = np.ones((*v.shape, 1))
    rates = np.concatenate([ones, np.exp(-0.5 * u**2)], axis=-1)
    return np.concatenate([v[..., None], values], axis=-1), rates


@validated
def fit(
    y: Seen,
    x: Members,
    *,
    order: NonNegativeInt | tuple[NonNegativeInt, NonNegativeInt],
    regularisation: NonNegativeFloat = 0.0,
    uses: Sequence[Collection[NonNegativeInt]] | None = None,
) -> SeparableMap:
    r"""Fit the separable map to samples: the minimiser of (12), regularised.

    .. math:: \mathcal L^k + \tfrac\lambda2\Bigl(\sum_{l,j} c_{lj}^2 + \sum_j a_j^2\Bigr)

    The penalty is on the bumps only, so a large one gives the affine map. The linear coefficient
    :math:`a_0` is at least 0.1 per standard deviation; the best affine map has at least 1.

    Parameters
    ----------
    y : array_like, (..., N, m)
        Predicted observations, with noise; m may be 0.
    x : array_like, (..., N, d)
        Members.
    order : int or (int, int)
        Bumps per earlier variable, and integrated bumps of the own variable; one number is for
        both. 0 gives the affine map.
    regularisation : float
        The penalty λ, at least 0.
    uses : sequence of collections of int, optional
        For each of the d components, which earlier variables it may use: observations are 0 to
        m - 1, state components follow. All by default. A component that leaves some out is sparse.

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
    d = x.shape[-1]
    p, q = (order, order) if isinstance(order, int) else order
    uses = [range(m + k) for k in range(d)] if uses is None else uses
    allowed = [sorted(set(used)) for used in uses]
    if len(uses) != d or any(
        len(used) < len(given) or used[-1:] >= [m + k]
        for k, (used, given) in enumerate(zip(allowed, uses, strict=True))
    ):
        raise ValueError(
            f"uses must be for each of {d} components different variables before its "
            f"own, the {m} observations first, got {uses}"
        )
    most = max(map(len, allowed))
    needed = 2 + most if regularisation else 2 + q + most * (1 + p)
    if x.shape[-2] <= needed:
        raise ValueError(
            f"x must have more than {needed} members for as many coefficients, "
            f"got {x.shape[-2]}"
        )
    joint = joint_samples(y, x)
    centre = ensembles.mean(joint)
    joint -= centre[..., None, :]
    spread = np.sqrt((joint**2).mean(axis=-2))
    refuse(spread <= 1e-13 * np.abs(centre), m, "are not constant")
    joint /= spread[..., None, :]
    _refuse_combinations(joint, allowed, m)
    bumps = _nodes(joint, p, m)
    steps = _nodes(joint[..., m:], q, 0)
    found = []
    for k, used in enumerate(allowed):
        features = _earlier_features(joint[..., used], bumps[..., used, :])
        own = _own_features(joint[..., m + k], steps[..., k, :])
        found.append(_best_coefficients(features, *own, 1 + len(used), regularisation))
    weights, slopes = map(list, zip(*found, strict=True))
    return SeparableMap(m, centre, spread, bumps, steps, allowed, weights, slopes)


def _refuse_combinations(joint: Array, uses: list[list[int]], m: int) -> None:
    """Refuse variables that are combinations of others that the same component uses."""
    cov = joint.mT @ joint / joint.shape[-2]
    for k, used in enumerate(uses):
        for name, some in (("y", [v for v in used if v < m]), ("x", [*used, m + k])):
            least = np.linalg.eigvalsh(cov[..., some, :][..., some]).min(initial=1.0)
            if least < _SINGULAR:
                raise ValueError(
                    f"{name} must have variables that are not combinations of others, "
                    f"got a singular correlation matrix in component {k}"
                )


def _nodes(joint: Array, n: int, m: int) -> Array:
    """Centres at `n` quantiles of each variable, and widths from quantiles half way between."""
    levels = np.arange(1, 2 * n + 2) / (2 * (n + 1))
    found = np.moveaxis(np.quantile(joint, levels, axis=-2), 0, -1)
    widths = found[..., 2::2] - found[..., :-2:2]
    refuse(
        np.any(widths <= 0, axis=-1),
        m,
        "have quantiles that differ for the basis functions",
    )
    return np.stack([found[..., 1::2], widths])


def _best_coefficients(
    features: Array, values: Array, rates: Array, linear: int, penalty: float
) -> tuple[Array, Array]:
    r"""Coefficients of one component: those of the earlier variables, then the nonnegative ones.

    For the component :math:`\Psi\mathbf c + \Phi\mathbf a` the objective (12) is
    :math:`\tfrac1{2N}|\Psi\mathbf c+\Phi\mathbf a|^2 - \tfrac1N\sum_i\log(\Phi'\mathbf a)_i`, to
    be minimised over free c and nonnegative a. For given a, the best c solves a regression,
    c = -W a, which leaves a quadratic form in a.
    """
    n = features.shape[-2]
    on_c = penalty * (np.arange(features.shape[-1]) >= linear)
    on_a = penalty * (np.arange(values.shape[-1]) >= 1)
    normal = features.mT @ features / n + np.diag(on_c)
    ends = np.linalg.eigvalsh(normal)
    if (ends[..., 0] < _SINGULAR * ends[..., -1]).any():
        raise ValueError(
            "regularisation must be a positive value, for the basis functions are not "
            f"independent on these samples, got {penalty:g}"
        )
    regression = np.linalg.solve(normal, features.mT @ values / n)
    left = values - features @ regression
    quadratic = (
        left.mT @ left / n
        + regression.mT @ (on_c[:, None] * regression)
        + np.diag(on_a)
    )
    lower = np.where(np.arange(values.shape[-1]) == 0, _LEAST_SLOPE, 0.0)
    a = _nonnegative(quadratic, rates, lower)
    return -np.asarray((regression @ a[..., None])[..., 0]), a


def _nonnegative(quadratic: Array, rates: Array, lower: Array) -> Array:
    """Minimise a'Qa / 2 - mean(log(rates a)) over a >= lower by projected Newton steps.

    Each is halved, in each run, until the objective falls enough.
    """

    def loss(c: Array) -> Array:
        form = 0.5 * (c[..., None, :] @ quadratic @ c[..., None])[..., 0, 0]
        return np.asarray(form - np.log((rates @ c[..., None])[..., 0]).mean(axis=-1))

    r = quadratic.shape[-1]
    n = rates.shape[-2]
    a = np.broadcast_to(lower, quadratic.shape[:-1]).copy()
    a[..., 0] = np.maximum(lower[0], 1 / np.sqrt(quadratic[..., 0, 0]))
    for _ in range(_ITERATIONS):
        ratio = rates / (rates @ a[..., None])
        gradient = (quadratic @ a[..., None])[..., 0] - ratio.mean(axis=-2)
        free = (a > lower) | (gradient < 0)
        hessian = quadratic + ratio.mT @ ratio / n
        # Held coefficients get a row of the identity, and so a step of zero.
        system = np.where(free[..., :, None] & free[..., None, :], hessian, np.eye(r))
        slope = np.where(free, gradient, 0.0)
        step = -np.linalg.solve(system, slope[..., None])[..., 0]
        start = a
        before = loss(a)
        t = np.ones(a.shape[:-1])
        for _ in range(40):
            a = np.maximum(lower, start + t[..., None] * step)
            wanted = 1e-4 * (gradient * (a - start)).sum(axis=-1)
            # Near the minimum the fall is lost in rounding.
            good = loss(a) <= before + wanted + 1e-14 * (1 + np.abs(before))
            if good.all():
                break
            t = np.where(good, t, 0.5 * t)
        if (-(slope * step).sum(axis=-1) < 1e-13).all():
            return a
    raise SolverError(f"separable: no minimum of (12) after {_ITERATIONS} Newton steps")


def invert(
    function: Callable[[Array], tuple[Array, Array]],
    target: Array,
    low: Array,
    high: Array,
) -> Array:
    """Solve ``function(v) = target`` by Newton's method inside a shrinking bracket.

    The function gives values and positive slopes, element by element. A Newton step that would
    leave the bracket is replaced by a bisection, so the iteration converges.

    Raises
    ------
    SolverError
        If the iteration does not settle, as where a target is not a number.

    Examples
    --------
    >>> ends = np.full(2, -4.0), np.full(2, 4.0)
    >>> invert(lambda v: (np.sinh(v), np.cosh(v)), np.sinh([-2.0, 0.5]), *ends).round(9)
    array([-2. ,  0.5])
    """
    v = 0.5 * (low + high)
    moved = high - low
    for _ in range(2 * _ITERATIONS):
        value, slope = function(v)
        gap = value - target
        low = np.where(gap <= 0, v, low)
        high = np.where(gap >= 0, v, high)
        newton = v - gap / slope
        step = np.abs(newton - v)
        enough = 1e-13 * (1 + np.abs(v))
        # A step that has settled may stand on an end of its bracket; any other has to be inside
        # and half as long as the last, or Newton's method could go to and fro for ever.
        good = (newton > low) & (newton < high) & (step <= 0.5 * moved)
        new = np.where(good | (step <= enough), newton, 0.5 * (low + high))
        moved = np.abs(new - v)
        v = new
        if (moved <= enough).all():
            return np.asarray(v)
    raise SolverError("separable: the map's inverse did not settle at all targets")
