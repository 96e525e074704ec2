r"""Affine triangular maps, equations (12)-(14) of Grange et al.

The x-block of the Knothe-Rosenblatt map of a Gaussian is affine,

.. math:: \mathbf S(\mathbf y, \mathbf x) = \mathbf L^{-1}\bigl(\mathbf x - \bar{\mathbf x}
    - \mathbf K(\mathbf y - \bar{\mathbf y})\bigr),

with the regression matrix K of x on y and the Cholesky factor L of what the regression leaves. The
minimiser of (12) over affine maps has this form with sample moments, so no solver is needed.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np

from .. import ensembles
from ..linalg import SolverError, leading
from ..validation import Array, FrozenModel, Mask, import_optional, validated

__all__ = ["AffineMap", "compose", "fit", "fit_convex", "objective"]

Seen = Annotated[Array, "... N M"]
Members = Annotated[Array, "... N d"]
OwnSeen = Annotated[Array, "... self.observed"]
OwnMembers = Annotated[Array, "... N self.dim"]

_ROUNDING = 1e-13
"""Share of a variable's variance, or of its mean, that counts as rounding."""


@runtime_checkable
class ConditionalMap(Protocol):
    """What a map offers: z = S(y, x), its inverse in x, the derivative's log-determinant.

    Whatever has these three methods is one:

    >>> class Shift:
    ...     def __call__(self, y, x):
    ...         return x - y
    ...
    ...     def inverse(self, y, z):
    ...         return z + y
    ...
    ...     def log_det(self, y, x):
    ...         return 0 * x[..., 0]
    >>> import numpy as np
    >>> compose(Shift(), np.array([[1.0], [2.0]]), [[3.0], [5.0]], [10.0])
    array([[12.],
           [13.]])
    """

    def __call__(self, y: Array, x: Array) -> Array:
        """Reference samples of members."""

    def inverse(self, y: Array, z: Array) -> Array:
        """Members of reference samples."""

    def log_det(self, y: Array, x: Array) -> Array:
        """Log-determinant at each member."""


@validated
def compose(
    map_: ConditionalMap,
    y: Annotated[Array, "... N map_.observed"],
    x: Annotated[Array, "... N map_.dim"],
    observed: Annotated[Array, "... map_.observed"],
) -> Array:
    r"""The composed map (10) of Grange et al.: from joint samples to samples given the observation.

    .. math:: \mathbf T(\mathbf y,\mathbf x)
        = \mathbf S(\mathbf y^*,\cdot)^{-1}\circ\mathbf S(\mathbf y,\mathbf x)

    Parameters
    ----------
    map_ : ConditionalMap
        The x-block S of a triangular map.
    y, x : array_like, (..., N, m) and (..., N, d)
        Predicted observations, with noise, and members.
    observed : array_like, (..., m)
        What was observed, y*.

    Examples
    --------
    >>> import numpy as np
    >>> from distfilt.triangular import affine
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal((400, 1))
    >>> y = x + rng.standard_normal((400, 1))
    >>> compose(affine.fit(y, x), y, x, [2.0]).mean().round(1)
    np.float64(1.0)
    """
    return map_.inverse(observed[..., None, :], map_.__call__(y, x))


def _lower_triangular(value: Array, name: str) -> None:
    if (
        np.triu(value, 1).any()
        or not (np.diagonal(value, axis1=-2, axis2=-1) > 0).all()
    ):
        raise ValueError(
            f"{name} must have lower triangular matrices with a positive diagonal"
        )


@dataclass(frozen=True, eq=False)
class AffineMap(FrozenModel):
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
    >>> s.observed, s.dim
    (1, 1)
    """

    observed_mean: Annotated[Array, "... M"]
    mean: Annotated[Array, "... d"]
    gain: Annotated[Array, "... d M"]
    scale: Annotated[Array, "... d d", _lower_triangular]

    @property
    def observed(self) -> int:
        """Number m of observations."""
        return int(self.observed_mean.shape[-1])

    @property
    def dim(self) -> int:
        """Number d of components."""
        return int(self.mean.shape[-1])

    def _predicted(self, y: Array, members: Array) -> Array:
        """The regression of x on y, (..., N, d), which broadcasts with these members."""
        centred = y - self.observed_mean[..., None, :]
        out = self.mean[..., None, :] + centred @ np.ascontiguousarray(self.gain.mT)
        leading(members.shape[:-1], out.shape[:-1], "y")
        return np.asarray(out)

    @validated
    def __call__(self, y: OwnSeen, x: OwnMembers) -> Array:
        """Reference samples S(y, x), (..., N, d), of members y (..., N, m) and x (..., N, d)."""
        return np.asarray(
            np.linalg.solve(self.scale, (x - self._predicted(y, x)).mT).mT
        )

    @validated
    def inverse(self, y: OwnSeen, z: OwnMembers) -> Array:
        """Members x with S(y, x) = z, (..., N, d); `y` is (..., N, m), or (..., m) for all."""
        seen = y[..., None, :] if y.ndim == self.observed_mean.ndim else y
        return self._predicted(seen, z) + z @ np.ascontiguousarray(self.scale.mT)

    @validated
    def log_det(self, y: OwnSeen, x: OwnMembers) -> Array:
        """Logarithm of the determinant of the map's derivative in x at each member, (..., N)."""
        total = -np.log(np.diagonal(self.scale, axis1=-2, axis2=-1)).sum(axis=-1)
        return np.broadcast_to(total[..., None], x.shape[:-1]).copy()


def joint_samples(y: Array, x: Array) -> Array:
    """The variables (y, x) of each member, (..., N, m + d)."""
    if y.shape[:-1] != x.shape[:-1]:
        raise ValueError(
            f"y must have members {x.shape[:-1]} as x has them, got {y.shape[:-1]}"
        )
    return np.concatenate([y, x], axis=-1)


def enough(y: Array, x: Array, members: int) -> Array:
    """The variables joined, refused unless there are more members than variables."""
    joint = joint_samples(y, x)
    if members <= joint.shape[-1]:
        raise ValueError(
            f"x must have more than {joint.shape[-1]} members for {joint.shape[-1]} "
            f"variables, got {members}"
        )
    return joint


def refuse(wrong: Mask, m: int, needs: str) -> None:
    """An error if a variable of (..., m + d) is not what a fit needs, y blamed before x."""
    columns = np.flatnonzero(wrong.reshape(-1, wrong.shape[-1]).any(axis=0))
    if columns.size:
        k = int(columns[0])
        name, column = ("y", k) if k < m else ("x", k - m)
        raise ValueError(
            f"{name} must have variables that {needs}, got one in column {column}"
        )


@validated
def fit(y: Seen, x: Members) -> AffineMap:
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
    joint = enough(y, x, x.shape[-2])
    mean = ensembles.mean(joint)
    joint -= mean[..., None, :]
    return from_moments(mean, joint.mT @ joint / joint.shape[-2], y.shape[-1])


def from_moments(mean: Array, cov: Array, m: int) -> AffineMap:
    """The affine map of a Gaussian (y, x), or of samples with these moments (divided by N).

    An error says which of them has no factor.
    """
    needs = "are not constant and not combinations of others"
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    try:
        lower = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        try:
            np.linalg.cholesky(cov[..., :m, :m])
        except np.linalg.LinAlgError:
            raise ValueError(f"y must have variables that {needs}") from None
        raise ValueError(f"x must have variables that {needs}") from None
    # Rounding may leave a repeated variable a tiny variance of its own.
    left = np.diagonal(lower, axis1=-2, axis2=-1) ** 2
    refuse(
        (left <= _ROUNDING * variance) | (variance <= (_ROUNDING * mean) ** 2), m, needs
    )
    # The factor of the joint covariance holds the map: its lower blocks are K L_yy and L.
    gain = np.linalg.solve(lower[..., :m, :m].mT, lower[..., m:, :m].mT)
    return AffineMap.construct(
        mean[..., :m], mean[..., m:], gain.mT, lower[..., m:, m:]
    )


def from_rows(u: Array, observed_mean: Array) -> AffineMap:
    """The affine map of the coefficients of (13), component by component.

    Per component of the x-block, (..., d, 1 + m + d): the constant, the coefficients of y and those
    of x, zero to the right of the diagonal and positive on it. The map is written about any y.
    """
    upper = u[..., 1 + observed_mean.shape[-1] :]
    solved = np.linalg.solve(upper, u[..., : 1 + observed_mean.shape[-1]])
    gain = -solved[..., 1:]
    mean = (gain @ observed_mean[..., None])[..., 0] - solved[..., 0]
    scale = np.linalg.solve(
        upper, np.broadcast_to(np.eye(upper.shape[-1]), upper.shape)
    )
    return AffineMap.construct(observed_mean, mean, gain, np.tril(scale))


@validated
def objective(map_: ConditionalMap, y: Seen, x: Members) -> Array:
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
    squares = 0.5 * (map_(y, x) ** 2).sum(axis=-1)
    return np.asarray((squares - map_.log_det(y, x)).mean(axis=-1))


@validated
def fit_convex(
    y: Annotated[Array, "N M"],
    x: Annotated[Array, "N d"],
    *,
    solver: Literal["ECOS", "CLARABEL"] = "ECOS",
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
    joint = enough(y, x, len(x))
    m = y.shape[-1]
    cp = import_optional("cvxpy", "maps")
    rows = np.zeros((x.shape[-1], 1 + joint.shape[-1]))
    # Of size one: a solver's tolerances are absolute.
    centre = joint.mean(axis=0)
    size = joint.std(axis=0)
    size += size == 0
    ones = np.column_stack([np.ones(len(joint)), (joint - centre) / size]) / np.sqrt(
        len(joint)
    )
    # What cvxpy would warn of, the status below tells, and it becomes an error.
    with _SOLVING, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for k, n in enumerate(range(m + 2, m + 2 + len(rows))):
            problem, root, u = _program(n)
            root.value = np.linalg.qr(ones[:, :n], mode="r")
            try:
                problem.solve(solver=solver, warm_start=False)
                status = problem.status
            except cp.error.SolverError as error:
                status = error
            if status != cp.OPTIMAL:
                raise SolverError(
                    f"{solver}: component {n - 1} of the map stopped with {status!r}"
                )
            rows[k, :n] = u.value
    rows[:, 1:] /= size
    rows[:, 0] -= rows[:, 1:] @ centre
    return from_rows(rows, ensembles.mean(y))


_SOLVING = Lock()
"""A compiled program holds its last data: one thread at a time."""


@lru_cache(maxsize=32)
def _program(n: int) -> tuple[Any, Any, Any]:
    """The program (12) of n coefficients, compiled once, with the samples' triangular factor open.

    The samples enter by |u_0 + Z u|² only, which their QR factor keeps.
    """
    cp = import_optional("cvxpy", "maps")
    root = cp.Parameter((n, n))
    u = cp.Variable(n)
    loss = cp.sum_squares(root @ u) / 2 - cp.log(u[n - 1])
    return cp.Problem(cp.Minimize(loss)), root, u
