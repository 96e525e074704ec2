r"""Affine triangular maps, equations (12)-(14) of Grange et al.

The x-block of the Knothe-Rosenblatt map of a Gaussian is affine,

.. math:: \mathbf S(\mathbf y, \mathbf x) = \mathbf L^{-1}\bigl(\mathbf x - \bar{\mathbf x}
    - \mathbf K(\mathbf y - \bar{\mathbf y})\bigr),

with the regression matrix K of x on y and the Cholesky factor L of what the regression leaves. The
minimiser of (12) over affine maps has this form with sample moments, so no solver is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .. import ensembles
from ..checks import Array, array, callable_, choice, count, covariance
from ..linalg import _leading
from ._conic import LIMIT, solve_component

if TYPE_CHECKING:
    from .composition import ConditionalMap

__all__ = [  # fmt: skip
    "AffineMap", "fit", "fit_convex", "from_moments", "from_rows", "gradient", "objective",
]

_ROUNDING = 1e-13
"""Share of a variable's variance, or of its mean, that counts as rounding."""


@dataclass(frozen=True, eq=False)
class AffineMap:
    """The affine map S(y, x) that takes x given y to the standard normal.

    Parameters
    ----------
    observed_mean : ndarray, (..., m)
        Mean of y.
    mean : ndarray, (..., d)
        Mean of x.
    gain : ndarray, (..., d, m)
        Regression of x on y.
    scale : ndarray, (..., d, d)
        Lower triangular with a positive diagonal.

    Examples
    --------
    >>> s = AffineMap(np.zeros(1), np.zeros(1), np.array([[0.5]]), np.array([[2.0]]))
    >>> s([[2.0]], [[3.0]])
    array([[1.]])
    >>> s.inverse([0.0], [[1.0]])
    array([[2.]])
    """

    observed_mean: Array
    mean: Array
    gain: Array
    scale: Array

    def __post_init__(self) -> None:
        seen = array(self.observed_mean, "observed_mean", (..., "m"))
        mean = array(self.mean, "mean", (..., "d"))
        m, d = seen.shape[-1], mean.shape[-1]
        gain = array(self.gain, "gain", (..., d, m))
        scale = array(self.scale, "scale", (..., d, d))
        for name, value in (
            ("observed_mean", seen), ("mean", mean), ("gain", gain), ("scale", scale)
        ):
            object.__setattr__(self, name, value)
        diagonal = np.diagonal(scale, axis1=-2, axis2=-1)
        if np.triu(scale, 1).any() or not (diagonal > 0).all():
            raise ValueError("scale: needs lower triangular matrices with a positive diagonal")

    def _predicted(self, y: ArrayLike, members: Array) -> Array:
        """The regression of x on y, (..., N, d), which broadcasts with these members."""
        seen = array(y, "y", (..., self.observed_mean.shape[-1]))
        if seen.ndim == self.observed_mean.ndim:
            seen = seen[..., None, :]
        centred = seen - self.observed_mean[..., None, :]
        out = self.mean[..., None, :] + centred @ np.swapaxes(self.gain, -1, -2)
        _leading(members.shape[:-1], out.shape[:-1], "y")
        return np.asarray(out)

    def __call__(self, y: ArrayLike, x: ArrayLike) -> Array:
        """Reference samples S(y, x), (..., N, d), of members y (..., N, m) and x (..., N, d)."""
        members = array(x, "x", (..., "N", self.mean.shape[-1]))
        left = np.swapaxes(members - self._predicted(y, members), -1, -2)
        return np.swapaxes(np.linalg.solve(self.scale, left), -1, -2)

    def inverse(self, y: ArrayLike, z: ArrayLike) -> Array:
        """Members x with S(y, x) = z, (..., N, d); `y` is (..., N, m), or (..., m) for all."""
        reference = array(z, "z", (..., "N", self.mean.shape[-1]))
        return self._predicted(y, reference) + reference @ np.swapaxes(self.scale, -1, -2)

    def log_det(self, y: ArrayLike, x: ArrayLike) -> Array:
        """Logarithm of the determinant of the map's derivative in x at each member, (..., N)."""
        members = array(x, "x", (..., "N", self.mean.shape[-1]))
        array(y, "y", (..., self.observed_mean.shape[-1]))
        diagonal = np.diagonal(self.scale, axis1=-2, axis2=-1)
        total = -np.log(diagonal).sum(axis=-1)
        return np.asarray(np.broadcast_to(total[..., None], members.shape[:-1])).copy()


def _samples(y: ArrayLike, x: ArrayLike) -> tuple[Array, Array]:
    members = array(x, "x", (..., "N", "d"))
    seen = array(y, "y", (*members.shape[:-1], "m"))
    needed = seen.shape[-1] + members.shape[-1]
    if members.shape[-2] <= needed:
        raise ValueError(
            f"x: needs more than {needed} members for {needed} variables, got {members.shape[-2]}"
        )
    return seen, members


def fit(y: ArrayLike, x: ArrayLike) -> AffineMap:
    """Fit the affine map to samples in closed form: the minimiser of (12).

    Parameters
    ----------
    y : array_like, (..., N, m)
        Predicted observations, with noise; m may be 0 for a map of x alone.
    x : array_like, (..., N, d)
        Members, more than m + d. No variable may be constant or repeat others.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal((500, 2))
    >>> s = fit(x[:, :1] + 0.1 * rng.standard_normal((500, 1)), x)
    >>> s.gain.round(1).ravel() + 0.0
    array([1., 0.])
    """
    seen, members = _samples(y, x)
    m = seen.shape[-1]
    joint = np.concatenate([seen, members], axis=-1)
    mean = ensembles.mean(joint)
    joint -= mean[..., None, :]
    cov = np.swapaxes(joint, -1, -2) @ joint / joint.shape[-2]
    return _from_moments(mean, cov, m)


def from_moments(mean: ArrayLike, cov: ArrayLike, m: int) -> AffineMap:
    """The affine map of a Gaussian (y, x), or of samples with these moments (divided by N).

    Parameters
    ----------
    mean : array_like, (..., m + d)
        Mean of (y, x).
    cov : array_like, (..., m + d, m + d)
        Their covariance, symmetric and positive definite.
    m : int
        Number of observations, at least 0.

    Examples
    --------
    >>> from_moments([0.0, 1.0], [[2.0, 1.0], [1.0, 1.0]], 1).gain
    array([[0.5]])
    """
    centre = array(mean, "mean", (..., "D"))
    joint = covariance(cov, "cov", centre.shape[-1], semidefinite=True)
    joint = array(joint, "cov", (*centre.shape, centre.shape[-1]))
    if count(m, "m", at_least=0) > centre.shape[-1]:
        raise ValueError(f"m: needs at most {centre.shape[-1]} observations, got {m}")
    return _from_moments(centre, joint, m)


def _from_moments(centre: Array, joint: Array, m: int) -> AffineMap:
    """`from_moments` of checked arguments."""
    lower = _cholesky(joint, centre, m)
    # The factor of the joint covariance holds the map: its lower blocks are K L_yy and L.
    across = np.swapaxes(lower[..., m:, :m], -1, -2)
    gain = np.linalg.solve(np.swapaxes(lower[..., :m, :m], -1, -2), across)
    return AffineMap(
        centre[..., :m], centre[..., m:], np.swapaxes(gain, -1, -2), lower[..., m:, m:]
    )


def from_rows(rows: ArrayLike, observed_mean: ArrayLike) -> AffineMap:
    """The affine map of the coefficients of (13), component by component.

    Parameters
    ----------
    rows : array_like, (..., d, 1 + m + d)
        Per component of the x-block: the constant, the coefficients of y and those of x, zero to
        the right of the diagonal and positive on it.
    observed_mean : array_like, (..., m)
        The y about which the map is written; any will do.

    Examples
    --------
    >>> from_rows([[-1.0, 0.0, 2.0]], [0.0]).inverse([5.0], [[1.0]])
    array([[1.]])
    """
    ybar = array(observed_mean, "observed_mean", (..., "m"))
    m = ybar.shape[-1]
    u = array(rows, "rows", (*ybar.shape[:-1], "d", "D"))
    d = u.shape[-2]
    if u.shape[-1] != 1 + m + d:
        raise ValueError(f"rows: needs {1 + m + d} columns for m = {m}, d = {d}, got {u.shape}")
    upper = u[..., 1 + m :]
    if not (np.diagonal(upper, axis1=-2, axis2=-1) > 0).all():
        raise ValueError("rows: needs positive coefficients of each component's own variable")
    scale = np.linalg.solve(upper, np.broadcast_to(np.eye(d), upper.shape))
    gain = np.asarray(-np.linalg.solve(upper, u[..., 1 : 1 + m]), dtype=np.float64)
    offset = -np.linalg.solve(upper, u[..., :1])[..., 0]
    mean = offset + (gain @ ybar[..., None])[..., 0]
    if np.triu(upper, 1).any():
        raise ValueError("rows: needs zeros to the right of the diagonal")
    return AffineMap(ybar, mean, gain, np.tril(scale))


def _cholesky(cov: Array, mean: Array, m: int) -> Array:
    """Factor of the joint covariance of (y, x); an error says which of them is to blame."""
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    try:
        lower = np.asarray(np.linalg.cholesky(cov), dtype=np.float64)
        # Rounding may leave a repeated variable a tiny variance of its own.
        left = np.diagonal(lower, axis1=-2, axis2=-1) ** 2
        repeated = (left <= _ROUNDING * variance) | (variance <= (_ROUNDING * mean) ** 2)
        if not repeated.any():
            return lower
        name = "y" if repeated[..., :m].any() else "x"
    except np.linalg.LinAlgError:
        try:
            np.linalg.cholesky(cov[..., :m, :m])
            name = "x"
        except np.linalg.LinAlgError:
            name = "y"
    raise ValueError(
        f"{name}: needs variables that are not constant and not combinations of others, "
        f"got a sample covariance that is not positive definite"
    )


def objective(map_: ConditionalMap, y: ArrayLike, x: ArrayLike) -> Array:
    """The objective (12) of the x-block, summed over its components, (...).

    Up to a constant it is the negative mean log-likelihood of x given y under the map.

    Parameters
    ----------
    map_ : AffineMap or SeparableMap
        The map S.
    y, x : array_like, (..., N, m) and (..., N, d)
        Samples.

    Examples
    --------
    >>> x = np.array([[-1.0], [1.0], [-1.0], [1.0]])
    >>> float(objective(fit(np.empty((4, 0)), x), np.empty((4, 0)), x))
    0.5
    """
    callable_(map_, "map_")
    seen, members = _samples(y, x)
    squares = 0.5 * (map_(seen, members) ** 2).sum(axis=-1)
    return np.asarray((squares - map_.log_det(seen, members)).mean(axis=-1))


def gradient(coefficients: ArrayLike, samples: ArrayLike) -> Array:
    r"""Gradient (k + 1,) of (12) for one affine component, the corrected equation (14).

    .. math:: \frac{\partial\mathcal L^k}{\partial u_l}
        = \frac1N\sum_i U^k(\mathbf z_i)\, z_{i,l} - \frac{\delta_{lk}}{u_k}

    The paper prints :math:`u_l` where :math:`z_{i,l}` belongs.

    Parameters
    ----------
    coefficients : array_like, (k + 1,)
        :math:`u_0` and :math:`u_1,\dots,u_k`, with :math:`u_k > 0`.
    samples : array_like, (N, k)
        The first k variables.

    Examples
    --------
    >>> gradient([0.0, 1.0], [[-1.0], [1.0]])
    array([0., 0.])
    """
    z = array(samples, "samples", ("N", "k"))
    if not len(z):
        raise ValueError("samples: needs at least one, got none")
    u = array(coefficients, "coefficients", (z.shape[1] + 1,))
    if u[-1] <= 0:
        raise ValueError(f"coefficients: needs a positive last entry, got {u[-1]:g}")
    ones = np.column_stack([np.ones(len(z)), z])
    out = np.asarray(ones.T @ (ones @ u) / len(z))
    out[-1] -= 1 / u[-1]
    return out


def fit_convex(
    y: ArrayLike, x: ArrayLike, *, solver: str = "ECOS", max_iters: int | None = None
) -> AffineMap:
    """Fit the affine map by the convex program (12), component by component, in cvxpy.

    The paper's way. :func:`fit` gives the same composed map in closed form, hundreds to thousands
    of times faster.

    Parameters
    ----------
    y, x : array_like, (N, m) and (N, d)
        As for :func:`fit`.
    solver : {"ECOS", "CLARABEL"}
        A conic solver, at its default tolerances.
    max_iters : int, optional
        Stop the solver early, which raises.

    Raises
    ------
    SolverError
        If the solver does not report an optimum; the message has its status and the component.

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal((50, 1))
    >>> exact, solved = fit(x[:, :0], x), fit_convex(x[:, :0], x)
    >>> bool(abs(exact.scale - solved.scale).max() < 1e-4)
    True
    """
    seen, members = _samples(y, x)
    array(members, "x", ("N", "d"))
    choice(solver, "solver", tuple(LIMIT))
    m, d = seen.shape[-1], members.shape[-1]
    joint = np.concatenate([seen, members], axis=-1)
    rows = np.zeros((d, 1 + m + d))
    for k in range(d):
        rows[k, : m + k + 2] = solve_component(joint[:, : m + k + 1], solver, max_iters)
    return from_rows(rows, ensembles.mean(seen))
