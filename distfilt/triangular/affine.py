r"""Affine triangular maps, equations (12)-(14) of Grange et al.

The x-block of the Knothe-Rosenblatt map of a Gaussian is affine,

.. math:: \mathbf S(\mathbf y, \mathbf x) = \mathbf L^{-1}\bigl(\mathbf x - \bar{\mathbf x}
    - \mathbf K(\mathbf y - \bar{\mathbf y})\bigr),

with the regression matrix K of x on y and the Cholesky factor L of the residuals' covariance. The
minimiser of (12) over affine maps has this form with sample moments, so that no solver is needed.
Equation numbers in this module are those of that paper.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import Annotated, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from .. import ensembles
from ..linalg import SolverError, broadcast_leading
from ..validation import (
    Array,
    ArrayInput,
    FrozenModel,
    Mask,
    call_user,
    import_optional,
    validated,
)

__all__ = ["AffineMap", "compose", "fit", "fit_convex", "objective"]

ObservationSamples = Annotated[ArrayInput, "... N M"]
"""Samples of y; there may be no observation, M = 0."""
StateSamples = Annotated[ArrayInput, "... N d"]
"""Samples of x."""
MapObservations = Annotated[ArrayInput, "... self.n_observed"]
"""Samples of y, or one y for all samples of x, with a map's number of observations."""
MapStates = Annotated[ArrayInput, "... N self.dim"]
"""Samples of x, or of the reference, with a map's number of components."""

_ROUNDING = 1e-13
"""Fraction of a variable's variance, or of its mean, that counts as rounding: some hundred ε."""


@runtime_checkable
class ConditionalMap(Protocol):
    """A map z = S(y, x) with its inverse in x and the derivative's log-determinant.

    An object with these three methods is one:

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
        """Return the reference samples z (..., N, d) of y (..., N, m) and members x (..., N, d)."""

    def inverse(self, y: Array, z: Array) -> Array:
        """Return the members x of reference samples z, both (..., N, d); y may be one for all."""

    def log_det(self, y: Array, x: Array) -> Array:
        """Return the log-determinant of ∂S/∂x at each member, (..., N)."""


@validated
def compose(
    map_: ConditionalMap,
    y: ObservationSamples,
    x: StateSamples,
    observed: Annotated[ArrayInput, "... M"],
) -> Array:
    r"""Condition joint samples on an observation by the composed map (10) of Grange et al.

    .. math:: \mathbf T(\mathbf y,\mathbf x)
        = \mathbf S(\mathbf y^*,\cdot)^{-1}\circ\mathbf S(\mathbf y,\mathbf x)

    Parameters
    ----------
    map_ : ConditionalMap
        The x-block S of a triangular map.
    y, x : array_like, (..., N, m) and (..., N, d)
        Predicted observations, with noise, and members.
    observed : array_like, (..., m)
        The observation y*.

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
    _check_sizes(map_, y, x)
    # `compose` is validated, which switches checks off for the calls that it makes. The map may be
    # the user's own, and `call_user` switches them on again inside it.
    reference = call_user(map_.__call__, y, x)
    members = call_user(map_.inverse, observed[..., None, :], reference)
    return np.asarray(members)


def _check_sizes(map_: ConditionalMap, y: Array, x: Array) -> None:
    """Raise an error if samples do not have the sizes of a map; a user's own may not know any.

    Samples y are (..., N, m) and x (..., N, d).
    """
    for name, samples, size_name in (("y", y, "n_observed"), ("x", x, "dim")):
        size = getattr(map_, size_name, None)
        n_columns = samples.shape[-1]
        if size is not None and n_columns != size:
            raise ValueError(
                f"{name} must have {size} columns for this map, got {n_columns}"
            )


def _check_lower_triangular(value: Array, name: str) -> None:
    """Raise an error unless matrices (..., d, d) are lower triangular, their diagonal positive."""
    diagonal = np.diagonal(value, axis1=-2, axis2=-1)
    if np.triu(value, 1).any() or not (diagonal > 0).all():
        raise ValueError(f"{name} must be lower triangular with a positive diagonal")


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
    >>> s.n_observed, s.dim
    (1, 1)
    """

    observed_mean: Annotated[Array, "... M"]
    mean: Annotated[Array, "... d"]
    gain: Annotated[Array, "... d M"]
    scale: Annotated[Array, "... d d", _check_lower_triangular]

    @property
    def n_observed(self) -> int:
        """Number m of observations."""
        return int(self.observed_mean.shape[-1])

    @property
    def dim(self) -> int:
        """Number d of components."""
        return int(self.mean.shape[-1])

    def _regression(self, y: Array, members: Array) -> Array:
        """Return the regression of x on y, (..., N, d), which broadcasts with the members."""
        centred = y - self.observed_mean[..., None, :]
        # x̄ + K (y - ȳ); members are rows, so y multiplies Kᵀ. A contiguous copy is faster.
        predicted = self.mean[..., None, :] + centred @ np.ascontiguousarray(
            self.gain.mT
        )
        # Raises an error that names y if its leading axes do not fit those of the members.
        broadcast_leading(members.shape[:-1], predicted.shape[:-1], "y")
        return np.asarray(predicted)

    @validated
    def __call__(self, y: MapObservations, x: MapStates) -> Array:
        """Return reference samples S(y, x), (..., N, d), of y (..., N, m) and x (..., N, d)."""
        residual = x - self._regression(y, x)
        # L⁻¹ of the residual, members as right-hand sides.
        return np.asarray(np.linalg.solve(self.scale, residual.mT).mT)

    @validated
    def inverse(self, y: MapObservations, z: MapStates) -> Array:
        """Return members x with S(y, x) = z, (..., N, d); y is (..., N, m), or (..., m) for all."""
        if y.ndim == self.observed_mean.ndim:
            y = y[..., None, :]
        # L z, with members as rows
        residual = z @ np.ascontiguousarray(self.scale.mT)
        return np.asarray(self._regression(y, z) + residual)

    @validated
    def log_det(self, y: MapObservations, x: MapStates) -> Array:
        """Return the log-determinant of the map's derivative in x at each member, (..., N)."""
        diagonal = np.diagonal(self.scale, axis1=-2, axis2=-1)
        # det L⁻¹, the same for all members: repeated, as an array to which can be written.
        value = -np.log(diagonal).sum(axis=-1)
        return np.broadcast_to(value[..., None], x.shape[:-1]).copy()


def multiply_vector(matrix: Array, vector: Array) -> Array:
    """Return products of matrices (..., n, k) and vectors (..., k), (..., n)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def join_samples(y: Array, x: Array) -> Array:
    """Return the variables (y, x) of each member, (..., N, m + d)."""
    if y.shape[:-1] != x.shape[:-1]:
        raise ValueError(
            f"y must have members {x.shape[:-1]} as x has them, got {y.shape[:-1]}"
        )
    return np.concatenate([y, x], axis=-1)


def join_enough_samples(y: Array, x: Array, n_members: int) -> Array:
    """Return the variables (y, x) of each member, (..., N, m + d), fewer than members.

    `n_members` counts the samples of all agents together: a covariance of m + d variables is
    singular unless there are more.
    """
    joint = join_samples(y, x)
    n_variables = joint.shape[-1]
    if n_members <= n_variables:
        raise ValueError(
            f"x must have more than {n_variables} members for {n_variables} "
            f"variables, got {n_members}"
        )
    return joint


def check_variables(wrong: Mask, m: int, needs: str) -> None:
    """Raise an error that names the first variable flagged as wrong, of (..., m + d), y before x.

    `needs` says in the message how variables have to be. One wrong ensemble of a batch is enough.
    """
    flat_wrong = wrong.reshape(-1, wrong.shape[-1])
    columns = np.flatnonzero(flat_wrong.any(axis=0))
    if not columns.size:
        return
    # The first m columns are y, the others x.
    column = int(columns[0])
    name = "y"
    if column >= m:
        name = "x"
        column -= m
    raise ValueError(
        f"{name} must have variables that {needs}, got one in column {column}"
    )


@validated
def fit(y: ObservationSamples, x: StateSamples) -> AffineMap:
    """Fit the affine map to samples in closed form: the minimiser of (12) of Grange et al.

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
    joint = join_enough_samples(y, x, x.shape[-2])
    mean = ensembles.mean(joint)
    joint -= mean[..., None, :]
    covariance = joint.mT @ joint / joint.shape[-2]
    return from_moments(mean, covariance, y.shape[-1])


def from_moments(mean: Array, covariance: Array, m: int) -> AffineMap:
    """Return the affine map of a Gaussian (y, x), or of samples with these moments (divided by N).

    Raises an error that names y or x if its covariance has no Cholesky factor. The covariance is
    (..., m + d, m + d), the mean (..., m + d), and the first m variables are y.
    """
    needs = "are not constant and not combinations of others"
    # The Cholesky factor of the covariance of (y, x)
    lower = _factor_joint(covariance, m, needs)
    # Rounding may give a repeated variable a tiny variance: L_kk² is the variance of variable k
    # that the variables before it do not explain.
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    unexplained = np.diagonal(lower, axis1=-2, axis2=-1) ** 2
    is_combination = unexplained <= _ROUNDING * variance
    is_constant = variance <= (_ROUNDING * mean) ** 2
    # The error names the first such variable, as a column of y or of x.
    check_variables(is_combination | is_constant, m, needs)
    # The factor of the joint covariance contains the map: its lower blocks are K L_yy and L.
    observed_factor = lower[..., :m, :m]
    cross_factor = lower[..., m:, :m]
    gain = np.linalg.solve(observed_factor.mT, cross_factor.mT).mT
    scale = lower[..., m:, m:]
    return AffineMap.construct(mean[..., :m], mean[..., m:], gain, scale)


def _factor_joint(covariance: Array, m: int, needs: str) -> Array:
    """Return the Cholesky factor of the covariance of (y, x), (..., m + d, m + d).

    Where there is none, raise an error that names y or x. `needs` says how variables have to be.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        name = "x"
    # The observations come first, so they are at fault if their block has no factor.
    try:
        np.linalg.cholesky(covariance[..., :m, :m])
    except np.linalg.LinAlgError:
        name = "y"
    raise ValueError(f"{name} must have variables that {needs}")


def from_rows(coefficients: Array, observed_mean: Array) -> AffineMap:
    """Return the affine map of the coefficients of (13) of Grange et al., component by component.

    Each component of the x-block has a row (..., d, 1 + m + d): the constant, the coefficients of
    y, and those of x, which are zero to the right of the diagonal and positive on it. Coefficients
    do not determine both means: that of y is given, and that of x follows from it.
    """
    split = 1 + observed_mean.shape[-1]
    # S(y, x) = c + B y + A x with A = L⁻¹, so K = -L B and x̄ = K ȳ - L c.
    x_coefficients = coefficients[..., split:]
    solution = np.linalg.solve(x_coefficients, coefficients[..., :split])
    gain = np.asarray(-solution[..., 1:], dtype=np.float64)
    mean = multiply_vector(gain, observed_mean) - solution[..., 0]
    identity = np.broadcast_to(np.eye(x_coefficients.shape[-1]), x_coefficients.shape)
    scale = np.linalg.solve(x_coefficients, identity)
    return AffineMap.construct(observed_mean, mean, gain, np.tril(scale))


@validated
def objective(
    map_: ConditionalMap,
    y: ObservationSamples,
    x: StateSamples,
) -> Array:
    r"""Return the objective (12) of Grange et al. of the x-block, (...).

    .. math:: \frac1N\sum_i \tfrac12|\mathbf S(\mathbf y_i,\mathbf x_i)|^2
        - \log\det\partial_{\mathbf x}\mathbf S(\mathbf y_i,\mathbf x_i)

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
    _check_sizes(map_, y, x)
    reference = call_user(map_.__call__, y, x)
    log_det = call_user(map_.log_det, y, x)
    # |S(y, x)|² / 2 - log det.
    squares = 0.5 * (reference**2).sum(axis=-1)
    return np.asarray((squares - log_det).mean(axis=-1))


@validated
def fit_convex(
    y: Annotated[ArrayInput, "N M"],
    x: Annotated[ArrayInput, "N d"],
    *,
    solver: Literal["ECOS", "CLARABEL"] = "ECOS",
) -> AffineMap:
    """Fit the affine map by the convex program (12) of Grange et al., with cvxpy.

    The paper solves the program for one component after the other. :func:`fit` gives the same
    composed map in closed form, hundreds to thousands of times faster.

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
    joint = join_enough_samples(y, x, len(x))
    m = y.shape[-1]
    # Standardised variables, since a solver's tolerances are absolute. A constant stays as it is.
    centre = joint.mean(axis=0)
    std = joint.std(axis=0)
    std[std == 0] = 1.0
    standard = (joint - centre) / std
    # Rows (1, y, x) / √N, so that the mean square of a component S = Z u is |Z u|².
    design = np.column_stack([np.ones(len(joint)), standard])
    design = design / np.sqrt(len(joint))
    coefficients = np.zeros((x.shape[-1], design.shape[-1]))
    # The solver's warnings are silenced: the status is checked, and raises an error.
    with _PROGRAM_LOCK, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for k in range(x.shape[-1]):
            # Component k uses the constant, y, and x up to its own.
            n = m + k + 2
            coefficients[k, :n] = _solve_component(design[:, :n], solver)
    # Back from standardised variables: u (z - c) / s is (u / s) z and the constant -(u / s) c.
    coefficients[:, 1:] /= std
    coefficients[:, 0] -= coefficients[:, 1:] @ centre
    return from_rows(coefficients, ensembles.mean(y))


_PROGRAM_LOCK = Lock()
"""A compiled program is shared, and holds the parameters of one solution: one thread at a time."""


def _solve_component(design: Array, solver: str) -> Array:
    """Return the coefficients (n,) of one component for features (N, n), by a conic solver.

    The features, one row a sample, are the `design`.
    """
    cp = import_optional("cvxpy", "maps")
    n = design.shape[-1]
    program = _compile_program(n)
    # R of the features Z = Q R, by which the program depends on them.
    program.root.value = np.asarray(np.linalg.qr(design, mode="r"))
    try:
        program.problem.solve(solver=solver, warm_start=False)
        status = program.problem.status
    except cp.error.SolverError as error:
        status = error
    if status != cp.OPTIMAL:
        raise SolverError(
            f"{solver}: component {n - 1} of the map stopped with {status!r}"
        )
    return np.asarray(program.coefficients.value)


class _Symbol(Protocol):
    """A parameter or a variable of cvxpy, as far as it is used here."""

    value: Array | None


class _Problem(Protocol):
    """A problem of cvxpy, as far as it is used here."""

    @property
    def status(self) -> str: ...

    def solve(self, *, solver: str, warm_start: bool) -> float: ...


class _Program(NamedTuple):
    """A problem with the parameter R (n, n) and the variable u (n,), the coefficients."""

    problem: _Problem
    root: _Symbol
    coefficients: _Symbol


@lru_cache(maxsize=32)
def _compile_program(n: int) -> _Program:
    """Return the program (12) of Grange et al. for n coefficients.

    It minimises |Z u|² / 2 - log u_n, where a row of Z has the features of a sample over √N. With
    Z = Q R the first term is |R u|² / 2, so that R (n, n) is the parameter, and one program serves
    for any number of samples.
    """
    cp = import_optional("cvxpy", "maps")
    root = cp.Parameter((n, n))
    coefficients = cp.Variable(n)
    squares = cp.sum_squares(root @ coefficients) / 2
    # The last coefficient is the derivative in the component's own variable.
    loss = squares - cp.log(coefficients[n - 1])
    return _Program(cp.Problem(cp.Minimize(loss)), root, coefficients)
