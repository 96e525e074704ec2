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

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from .. import ensembles
from ..checks import Array, array, count, instance, number
from ..linalg import _leading
from ._convex import SINGULAR, best_coefficients
from .inversion import _newton, invert

__all__ = ["SeparableMap", "fit"]

_ROOT = np.sqrt(2 * np.pi)


@dataclass(frozen=True, eq=False)
class SeparableMap:
    """The map S(y, x) that takes x given y to the standard normal, component by component.

    Variables are numbered through: the m observations, then the d components of the state.

    Parameters
    ----------
    centre, spread : ndarray, (..., m + d)
        What each variable is shifted and divided by.
    bumps : ndarray, (2, ..., m + d, p)
        Centres and widths of the bumps of each standardised variable.
    steps : ndarray, (2, ..., d, q)
        The same for the integrated bumps of each state component.
    uses : tuple of tuple of int
        Which earlier variables each of the d components uses.
    weights : tuple of ndarray
        Per component (..., 1 + L + L p): the constant, the L linear coefficients, the bumps'.
    slopes : tuple of ndarray
        Per component (..., 1 + q): the linear coefficient and those of the integrated bumps,
        nonnegative, not all zero.

    Examples
    --------
    >>> none = np.empty((2, 1, 0))
    >>> double = SeparableMap(np.zeros(1), np.ones(1), none, none, ((),), (np.zeros(1),),
    ...                       (np.array([2.0]),))
    >>> double(np.empty((1, 0)), [[3.0]])
    array([[6.]])
    """

    centre: Array
    spread: Array
    bumps: Array
    steps: Array
    uses: tuple[tuple[int, ...], ...]
    weights: tuple[Array, ...]
    slopes: tuple[Array, ...]

    def __post_init__(self) -> None:
        centre = array(self.centre, "centre", (..., "D"))
        size, d = centre.shape[-1], len(instance(self.uses, "uses", tuple))
        spread = array(self.spread, "spread", (..., size))
        if not (spread > 0).all():
            raise ValueError(f"spread: needs positive entries, got {spread.min():g}")
        bumps = array(self.bumps, "bumps", (..., size, "p"))
        steps = array(self.steps, "steps", (..., d, "q"))
        p, q = bumps.shape[-1], steps.shape[-1]
        _uses(self.uses, size - d, d)
        parts: dict[str, Any] = {"centre": centre, "spread": spread, "bumps": bumps, "steps": steps}
        own = (1 + q,) * d
        earlier = tuple(1 + len(used) * (1 + p) for used in self.uses)
        parts |= {n: _each(getattr(self, n), n, sizes)
                  for n, sizes in (("weights", earlier), ("slopes", own))}
        for name, value in parts.items():
            object.__setattr__(self, name, value)
        for k, slopes in enumerate(self.slopes):
            if (slopes < 0).any() or not (slopes > 0).any(axis=-1).all():
                raise ValueError(
                    f"slopes: needs nonnegative coefficients, one of them positive, so that the "
                    f"map increases, got {slopes.min():.6g} in component {k}"
                )

    @property
    def dim(self) -> int:
        """Number d of components."""
        return len(self.uses)

    @property
    def observed(self) -> int:
        """Number m of observations."""
        return int(self.centre.shape[-1]) - self.dim

    def _standard(self, y: ArrayLike, x: Array) -> Array:
        """Standardised (y, x), (..., N, m + d); one y for all members is repeated."""
        seen = array(y, "y", (..., self.observed))
        if seen.ndim == self.centre.ndim:
            seen = seen[..., None, :]
        lead = _leading(x.shape[:-1], seen.shape[:-1], "y")
        parts = [np.broadcast_to(v, (*lead, v.shape[-1])) for v in (seen, x)]
        joint = np.concatenate(parts, axis=-1)
        return np.asarray((joint - self.centre[..., None, :]) / self.spread[..., None, :])

    def _earlier(self, joint: Array, k: int) -> Array:
        """What component k makes of the variables before its own, (..., N)."""
        used = list(self.uses[k])
        features = _earlier_features(joint[..., used], self.bumps[..., used, :])
        return np.asarray((features @ self.weights[k][..., None])[..., 0])

    def _own(self, v: Array, k: int) -> tuple[Array, Array]:
        """The increasing part of component k and its slope, (..., N)."""
        centres, widths = self.steps[..., k, None, :]
        first, rest = self.slopes[k][..., :1], self.slopes[k][..., 1:, None]
        u = (v[..., None] - centres) / widths
        value = first * v + ((_ROOT * widths * ndtr(u)) @ rest)[..., 0]
        return np.asarray(value), np.asarray(first + (np.exp(-0.5 * u**2) @ rest)[..., 0])

    def _inverted(self, aim: Array, k: int) -> Array:
        """Where the increasing part of component k has the values `aim`, (..., N)."""

        def own(v: Array) -> tuple[Array, Array]:
            return self._own(v, k)

        first, rest = self.slopes[k][..., :1], self.slopes[k][..., 1:]
        if not (first > 1e-6).all():
            return invert(own, aim, name="z")
        # A line plus steps of known heights: its ends need no search.
        heights = _ROOT * self.steps[1][..., k, :] * rest
        low = (aim - heights.sum(axis=-1, keepdims=True)) / first
        high = aim / first
        return _newton(own, aim, low, high, 0.5 * (low + high))

    def __call__(self, y: ArrayLike, x: ArrayLike) -> Array:
        """Reference samples S(y, x), (..., N, d), of members y (..., N, m) and x (..., N, d)."""
        joint = self._standard(y, array(x, "x", (..., "N", self.dim)))
        parts = [
            self._earlier(joint, k) + self._own(joint[..., self.observed + k], k)[0]
            for k in range(self.dim)
        ]
        return np.stack(parts, axis=-1)

    def inverse(self, y: ArrayLike, z: ArrayLike) -> Array:
        """Members x with S(y, x) = z, (..., N, d); `y` is (..., N, m), or (..., m) for all.

        Raises ValueError for a z outside the map's range, which is bounded where the slope's
        linear coefficient is zero.
        """
        reference = array(z, "z", (..., "N", self.dim))
        joint = self._standard(y, reference)
        m = self.observed
        for k in range(self.dim):
            joint[..., m + k] = self._inverted(reference[..., k] - self._earlier(joint, k), k)
        return joint[..., m:] * self.spread[..., None, m:] + self.centre[..., None, m:]

    def log_det(self, y: ArrayLike, x: ArrayLike) -> Array:
        """Logarithm of the determinant of the map's derivative in x at each member, (..., N)."""
        joint = self._standard(y, array(x, "x", (..., "N", self.dim)))
        m = self.observed
        total = -np.log(self.spread[..., m:]).sum(axis=-1)[..., None]
        for k in range(self.dim):
            total = total + np.log(self._own(joint[..., m + k], k)[1])
        return np.asarray(total)


def _each(value: Sequence[Array], name: str, sizes: tuple[int, ...]) -> tuple[Array, ...]:
    """A component's coefficients each, (..., size)."""
    if not isinstance(value, tuple | list | np.ndarray) or getattr(value, "shape", 1) == ():
        raise ValueError(f"{name}: needs a tuple of arrays, got {type(value).__name__}")
    if len(value) != len(sizes):
        raise ValueError(f"{name}: needs one array for each of {len(sizes)} components, "
                         f"got {len(value)}")
    return tuple(array(v, name, (..., n)) for v, n in zip(value, sizes, strict=True))


def _earlier_features(v: Array, bumps: Array) -> Array:
    """1, the variables and their bumps, (..., N, 1 + L + L p), of variables (..., N, L)."""
    centres, widths = bumps[..., None, :, :]
    heights = np.exp(-0.5 * ((v[..., None] - centres) / widths) ** 2)
    flat = heights.reshape(*v.shape[:-1], heights.shape[-1] * v.shape[-1])
    return np.concatenate([np.ones((*v.shape[:-1], 1)), v, flat], axis=-1)


def _own_features(v: Array, steps: Array) -> tuple[Array, Array]:
    """The variable and its integrated bumps, and their slopes, (..., N, 1 + q), of (..., N)."""
    centres, widths = steps[..., None, :]
    u = (v[..., None] - centres) / widths
    values = _ROOT * widths * ndtr(u)
    ones = np.ones((*v.shape, 1))
    return (
        np.concatenate([v[..., None], values], axis=-1),
        np.concatenate([ones, np.exp(-0.5 * u**2)], axis=-1),
    )


def fit(
    y: ArrayLike, x: ArrayLike, *, order: int | tuple[int, int], regularisation: float = 0.0,
    uses: Sequence[Collection[int]] | None = None, least_slope: float = 0.1,
) -> SeparableMap:
    r"""Fit the separable map to samples: the minimiser of (12), regularised.

    .. math:: \mathcal L^k + \tfrac\lambda2\Bigl(\sum_{l,j} c_{lj}^2 + \sum_j a_j^2\Bigr)

    The penalty is on the bumps only, so a large one gives the affine map.

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
    least_slope : float
        Lower bound of the linear coefficient :math:`a_0`, per standard deviation, at least 0. A
        positive one gives the map the whole line as its range. The best affine map has at least 1.

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
    members = array(x, "x", (..., "N", "d"))
    seen = array(y, "y", (*members.shape[:-1], "m"))
    m, d = seen.shape[-1], members.shape[-1]
    p, q = (count(n, "order", at_least=0) for n in _pair(order))
    penalty = number(regularisation, "regularisation", at_least=0)
    floor = number(least_slope, "least_slope", at_least=0)
    allowed = _uses([range(m + k) for k in range(d)] if uses is None else uses, m, d)
    _enough(members, allowed, p, q, penalty)
    joint, centre, spread = _standardised(np.concatenate([seen, members], axis=-1), m)
    _independent(joint, allowed, m)
    bumps, steps = _nodes(joint, p, m), _nodes(joint[..., m:], q, 0)
    weights, slopes = [], []
    for k, used in enumerate(allowed):
        features = _earlier_features(joint[..., list(used)], bumps[..., list(used), :])
        own = _own_features(joint[..., m + k], steps[..., k, :])
        c, a = best_coefficients(features, *own, 1 + len(used), penalty, floor)
        weights.append(c)
        slopes.append(a)
    return SeparableMap(centre, spread, bumps, steps, allowed, tuple(weights), tuple(slopes))


def _pair(order: int | tuple[int, int]) -> tuple[int, int]:
    if isinstance(order, tuple):
        if len(order) != 2:
            raise ValueError(f"order: needs an integer or two, got {order!r}")
        return order
    return order, order


def _uses(uses: Sequence[Collection[int]], m: int, d: int) -> tuple[tuple[int, ...], ...]:
    if len(instance(uses, "uses", Sequence)) != d:  # type: ignore[type-abstract]
        raise ValueError(f"uses: needs one collection for each of {d} components, got {len(uses)}")
    for k, used in enumerate(uses):
        given = instance(used, "uses", Collection)  # type: ignore[type-abstract]
        numbers = [count(v, "uses", at_least=0) for v in given]
        if len(set(numbers)) < len(numbers) or (numbers and max(numbers) >= m + k):
            raise ValueError(
                f"uses: needs different variables below {m + k} for component {k}, got {numbers}"
            )
    return tuple(tuple(sorted(used)) for used in uses)


def _enough(x: Array, uses: tuple[tuple[int, ...], ...], p: int, q: int, penalty: float) -> None:
    """Refuse more free coefficients than members; penalised ones need none."""
    most = max((len(used) for used in uses), default=0)
    needed = 2 + most if penalty else 2 + q + most * (1 + p)
    if x.shape[-2] <= needed:
        raise ValueError(f"x: needs more than {needed} members for as many coefficients, "
                         f"got {x.shape[-2]}")


def _standardised(joint: Array, m: int) -> tuple[Array, Array, Array]:
    centre = ensembles.mean(joint)
    shifted = joint - centre[..., None, :]
    spread = np.sqrt((shifted**2).mean(axis=-2))
    constant = (spread <= 1e-13 * np.abs(centre)).any(axis=tuple(range(spread.ndim - 1)))
    if constant.any():
        k = int(np.argmax(constant))
        raise ValueError(f"{'y' if k < m else 'x'}: needs variables that are not constant, "
                         f"got one in column {k if k < m else k - m}")
    return shifted / spread[..., None, :], centre, spread


def _independent(joint: Array, uses: tuple[tuple[int, ...], ...], m: int) -> None:
    """Refuse variables that are combinations of others that the same component uses."""
    cov = np.swapaxes(joint, -1, -2) @ joint / joint.shape[-2]

    def singular(used: Sequence[int]) -> bool:
        part = cov[..., used, :][..., :, used]
        return bool(len(used) and (np.linalg.eigvalsh(part)[..., 0] < SINGULAR).any())

    for k, used in enumerate(uses):
        if singular([*used, m + k]):
            name = "y" if singular([v for v in used if v < m]) else "x"
            raise ValueError(f"{name}: needs variables that are not combinations of others, "
                             f"got a singular correlation matrix in component {k}")


def _nodes(joint: Array, n: int, m: int) -> Array:
    """Centres at `n` quantiles of each variable, and widths from quantiles half way between."""
    levels = np.arange(1, 2 * n + 2) / (2 * (n + 1))
    found = np.moveaxis(np.quantile(joint, levels, axis=-2), 0, -1)
    widths = found[..., 2::2] - found[..., :-2:2]
    if not (widths > 0).all():
        k = int(np.argwhere(~(widths > 0))[0][-2])
        raise ValueError(f"{'y' if k < m else 'x'}: needs quantiles that differ for its basis "
                         f"functions, got many equal values in one variable")
    return np.stack([found[..., 1::2], widths])
