r"""Constraints :math:`\mathbf g(\mathbf x)=\mathbf d` on members: projection and retraction.

Equations (2) and (6)-(12) of Das and Bhattacharya; the choices that they leave open are options.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Literal, NamedTuple

import numpy as np

from ..derivatives import difference_with_error, evaluate_derivative
from ..ensembles import Ensemble
from ..linalg import SolverError
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    DistinctIndices,
    FrozenModel,
    Mask,
    NonNegativeFloat,
    call_user,
    check_array,
    validated,
)

__all__ = ["Constraint", "norm_constraint", "project", "retract"]

_Length = Annotated[float, Bounds(above=0, at_most=1e150)]
"""A length whose square is finite."""

Variant = Literal["printed", "reversed", "particle", "shift"]
"""Variants of (12) of Das and Bhattacharya: the gain times D_i - d̂, d̂ - D_i, d - D_i or d - d̂."""
Motion = tuple[DistinctIndices, DistinctIndices]
"""Indices of positions and of their velocities, in the same order."""

_TOLERANCE = 1e-15
"""Relative residual that :func:`retract` aims at: a few units of rounding."""
_TOLERABLE = 1e3 * _TOLERANCE
"""Relative residual that it accepts where no step along the normals makes it smaller."""
_STEPS = 50
"""Largest number of Newton steps in :func:`retract`."""
_HALVINGS = 30
"""Largest number of times that a Newton step is tried, halved each time."""
_LEAST_EIGENVALUE = 1e-14
"""Of the normals' correlations; a Jacobian with a smaller one has lost its rank."""


@dataclass(frozen=True, eq=False)
class Constraint(FrozenModel):
    """An equation that every state satisfies, g(x) = d.

    Parameters
    ----------
    function : callable
        ``g(x)`` on arrays (..., d) to (..., s).
    value : array_like, (s,)
        The right-hand side d.
    derivative : callable, optional
        ``derivative(x)``, the Jacobian of `function`, (..., s, d); by default finite differences.
        At its first use it is compared with them, and a warning issued if they disagree.

    Examples
    --------
    >>> line = Constraint(lambda x: x[..., :1] + x[..., 1:], [1.0])
    >>> line.residual([[0.25, 1.0]])
    array([[0.25]])
    """

    function: Callable[[Array], Array]
    value: Annotated[ArrayInput, "s"]
    derivative: Callable[[Array], Array] | None = field(default=None, kw_only=True)

    @validated
    def residual(self, x: Annotated[ArrayInput, "... d"]) -> Array:
        """Return the residual g(x) - d of states (..., d), (..., s)."""
        return check_array(self.violation(x), "function")

    def violation(self, x: Array) -> Array:
        """Return the residual (..., s) of any states (..., d): NaN where g has no value."""
        shape = (*x.shape[:-1], self.value.size)
        try:
            # A copy, since a user's function might write into its argument.
            g = call_user(self.function, x.copy())
        except IndexError as error:
            raise ValueError(
                "constraint must be a function of the components that states have, got one of "
                f"more than {x.shape[-1]}: {error}"
            ) from error
        values = check_array(g, "function", shape, finite=False)
        return np.asarray(values - self.value)

    @validated
    def jacobian(self, x: Annotated[ArrayInput, "... d"]) -> Array:
        """Return the derivative of g at states (..., d), (..., s, d)."""
        shape = (*x.shape[:-1], self.value.size, x.shape[-1])
        # The derivative that the user gave, or these finite differences if there is none.
        differences = partial(difference_with_error, self.violation, x)
        return evaluate_derivative(self, (x,), shape, differences)


@validated
def norm_constraint(
    indices: DistinctIndices,
    *,
    length: _Length = 1.0,
) -> Constraint:
    r"""Return the constraint that some components have a given norm, :math:`|\mathbf x_I|^2=L^2`.

    Parameters
    ----------
    indices : sequence of int
        The components: the pendulum's position, or an attitude's quaternion.
    length : float
        L, positive.

    Examples
    --------
    >>> norm_constraint([0, 1]).residual([0.6, 0.8, 5.0]).round(15) + 0.0
    array([0.])
    """
    columns = list(indices)

    def norm_squared(x: Array) -> Array:
        return np.asarray((x[..., columns] ** 2).sum(axis=-1, keepdims=True))

    def jacobian(x: Array) -> Array:
        # The derivative of |x_I|² is 2 x_Iᵀ.
        derivative = np.zeros((*x.shape[:-1], 1, x.shape[-1]))
        derivative[..., 0, columns] = 2 * x[..., columns]
        return derivative

    return Constraint(norm_squared, np.array([length**2]), derivative=jacobian)


@validated
def project(
    ensemble: Ensemble,
    constraint: Constraint,
    *,
    variant: Variant = "shift",
    regularisation: NonNegativeFloat = 1e-6,
    safeguard: bool = True,
) -> Array:
    r"""Regress the members on the constraint and correct them: (6)-(12) of Das and Bhattacharya.

    With :math:`\mathbf D_i=\mathbf g(\mathbf x_i)`, their mean :math:`\hat{\mathbf d}` and the gain
    :math:`\mathbf K=\boldsymbol\Sigma_{xd}(\boldsymbol\Sigma_{dd}+\epsilon\mathbf I)^{-1}`:

    * ``"printed"``, :math:`\mathbf x_i+\mathbf K(\mathbf D_i-\hat{\mathbf d})`: the mean stays and
      the spread along the constraint doubles;
    * ``"reversed"``, :math:`\mathbf x_i+\mathbf K(\hat{\mathbf d}-\mathbf D_i)`: contracts the
      members to their own mean, not to the constraint;
    * ``"particle"``, :math:`\mathbf x_i+\mathbf K(\mathbf d-\mathbf D_i)`: exact for linear g;
    * ``"shift"``, :math:`\mathbf x_i+\mathbf K(\mathbf d-\hat{\mathbf d})`: moves the mean only.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members, at least two.
    constraint : Constraint
    variant : {"printed", "reversed", "particle", "shift"}
        Of (12), as above.
    regularisation : float
        ε, at least 0, in the units of g squared: on the manifold the covariance is singular.
    safeguard : bool
        Return an ensemble unchanged if the projection is not finite or increases the residual that
        it should decrease: for ``"shift"``, which keeps the spread, that of the mean,
        :math:`|\hat{\mathbf d}-\mathbf d|`; for the others the mean of the members' residuals
        :math:`|\mathbf D_i-\mathbf d|`. The printed formula shows its effect with ``False`` only.

    Returns
    -------
    ndarray, (..., N, d)

    Raises
    ------
    numpy.linalg.LinAlgError
        If the covariance is singular and not regularised.

    Examples
    --------
    >>> line = Constraint(lambda x: x[..., :1] + x[..., 1:], [1.0])
    >>> x = np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 0.0]])
    >>> y = project(x, line, variant="particle", regularisation=0.0)
    >>> bool(abs(line.residual(y)).max() < 1e-14)
    True
    """
    n = ensemble.shape[-2]
    residual = constraint.residual(ensemble)
    mean_residual = residual.mean(axis=-2, keepdims=True)
    # D_i - d̂ and x_i - x̄.
    output_anomalies = residual - mean_residual
    anomalies = ensemble - ensemble.mean(axis=-2, keepdims=True)
    # Kᵀ = (Σ_dd + ε I)⁻¹ Σ_dx, by a solve.
    output_covariance = output_anomalies.mT @ output_anomalies / n
    output_covariance += regularisation * np.eye(residual.shape[-1])
    cross_covariance = output_anomalies.mT @ anomalies / n
    gain = np.linalg.solve(output_covariance, cross_covariance)
    innovations = {
        "printed": output_anomalies,
        "reversed": -output_anomalies,
        "particle": -residual,
        "shift": -mean_residual,
    }
    projected = ensemble + innovations[variant] @ gain
    if not safeguard:
        return np.asarray(projected)
    before = residual
    after = constraint.violation(projected)
    # If only the mean is to be moved, only its residual is judged: where g is curved, the members'
    # own may grow.
    if variant == "shift":
        before = mean_residual
        after = after.mean(axis=-2, keepdims=True)
    # A comparison with NaN is false, so an ensemble out of the domain is refused too.
    total_before = np.abs(before).sum(axis=(-1, -2), keepdims=True)
    total_after = np.abs(after).sum(axis=(-1, -2), keepdims=True)
    return np.asarray(np.where(total_after <= total_before, projected, ensemble))


@validated
def retract(
    states: Annotated[ArrayInput, "... d"],
    constraint: Constraint,
    *,
    motion: Motion | None = None,
) -> Array:
    r"""Move every state to the constraint by Newton steps along its normals.

    .. math:: \mathbf x\leftarrow\mathbf x-s\,\mathbf J^\top(\mathbf J\mathbf J^\top)^{-1}
        (\mathbf g(\mathbf x)-\mathbf d),

    where s is halved until the residual falls, down to the rounding of :math:`d_i` or of a state,
    :math:`|\nabla g_i|\,|\mathbf x|`, whichever is larger: the same for every unit of length.
    With `motion` the velocities then lose their part along the normals,
    :math:`\mathbf J\dot{\mathbf q}=\mathbf 0`.

    Parameters
    ----------
    states : array_like, (..., d)
        States near the constraint; each is moved by itself.
    constraint : Constraint
        For a motion a function of the positions only.
    motion : (sequence of int, sequence of int), optional
        Indices of positions and of their velocities.

    Returns
    -------
    ndarray, (..., d)
        For a length it is the closest point.

    Raises
    ------
    ValueError
        If the Jacobian loses rank at a state, so that there is no normal to move along, or g is
        not finite there.
    SolverError
        If the steps do not converge: the constraint may have no solution nearby.

    Examples
    --------
    >>> retract(
    ...     [3.0, 4.0, 1.0, 0.0], norm_constraint([0, 1]), motion=([0, 1], [2, 3])
    ... ).round(12)
    array([ 0.6 ,  0.8 ,  0.64, -0.48])
    """
    # Rows (N, d), which are moved in place
    x = states.reshape(-1, states.shape[-1]).copy()
    residual = constraint.residual(x)
    # Indices of the states that have not converged: only they take part.
    active = np.arange(len(x))
    for _ in range(_STEPS):
        jacobian = constraint.jacobian(x[active])
        error = _relative_error(constraint, x[active], residual[active], jacobian)
        is_unsolved = error > _TOLERANCE
        active = active[is_unsolved]
        if not active.size:
            break
        # The Newton step along the normals, halved until the residual decreases
        step = _normal_step(jacobian[is_unsolved], residual[active])
        search = _line_search(constraint, x[active], residual[active], step)
        x[active] = search.states
        residual[active] = search.residuals
        # Where g is large its rounding ends the descent above the tolerance, but not far above: a
        # state whose residual is tolerable and decreases no more has arrived.
        is_tolerable = error[is_unsolved] <= _TOLERABLE
        active = active[search.has_decreased | ~is_tolerable]
    else:
        # All steps are used up; the states that the last one moved may be solved.
        jacobian = constraint.jacobian(x[active])
        error = _relative_error(constraint, x[active], residual[active], jacobian)
        active = active[error > _TOLERANCE]
    if active.size:
        raise SolverError(
            f"retract: {active.size} of {len(x)} states did not reach the constraint in "
            f"{_STEPS} Newton steps, |g - d| up to {np.abs(residual[active]).max():.3g}"
        )
    if motion is not None:
        # In place
        _make_tangent(x, constraint, motion)
    return np.asarray(x.reshape(states.shape))


def _relative_error(
    constraint: Constraint, x: Array, residual: Array, jacobian: Array
) -> Array:
    """Return the largest relative residual (n,) of each state x (n, d), with Jacobians (n, s, d).

    The residuals (n, s) are taken relative to the magnitude of g_i, of which rounding is a part ε.
    """
    # Rounding of x alone changes g_i by up to ε |∇g_i| |x|.
    state_unit = np.linalg.norm(jacobian, axis=-1) * np.linalg.norm(x, axis=-1)[:, None]
    unit = np.maximum(np.abs(constraint.value), state_unit)
    # A residual of zero is exact, even where its unit is zero too.
    error = np.abs(residual) / np.where(residual == 0, 1.0, unit)
    return np.asarray(error.max(axis=-1))


def _normal_step(jacobian: Array, residual: Array) -> Array:
    """Return the shortest step that removes `residual` to first order, -J'(J J')⁻¹(g - d).

    Jacobians are (n, s, d), residuals (n, s), steps (n, d).
    """
    # Normals of length one, so that the rank does not depend on the units of the constraints. A
    # zero normal becomes NaN, then zero, and its eigenvalue is zero.
    with np.errstate(invalid="ignore"):
        normals = jacobian / np.linalg.norm(jacobian, axis=-1, keepdims=True)
    correlations = np.nan_to_num(normals @ normals.mT)
    smallest_eigenvalue = np.linalg.eigvalsh(correlations)[..., 0]
    is_deficient = ~(smallest_eigenvalue > _LEAST_EIGENVALUE)
    if is_deficient.any():
        raise ValueError(
            "constraint must have a Jacobian of full rank, got one that loses rank at "
            f"state {is_deficient.argmax()} ({is_deficient.sum()} of {is_deficient.size})"
        )
    # λ = (J J')⁻¹ (g - d), and the step -J' λ
    multipliers = np.linalg.solve(jacobian @ jacobian.mT, residual[..., None])
    return np.asarray(-(jacobian.mT @ multipliers)[..., 0])


class _LineSearch(NamedTuple):
    """States (n, d) after a line search, their residuals (n, s), and which decreased, (n,)."""

    states: Array
    residuals: Array
    has_decreased: Mask


def _line_search(
    constraint: Constraint, x: Array, residual: Array, step: Array
) -> _LineSearch:
    """Halve each state's step until its residual decreases.

    States and steps are (n, d), residuals (n, s). A state whose residual does not decrease stays
    where it is. Residuals are those of the constraint.
    """
    before = np.linalg.norm(residual, axis=-1)
    has_decreased = np.zeros(len(x), dtype=bool)
    new_x = x.copy()
    new_residual = residual.copy()
    for k in range(_HALVINGS):
        # The states that are still to be moved try 1, 1/2, 1/4, ... of their steps.
        rows = np.flatnonzero(~has_decreased)
        trial = x[rows] + 0.5**k * step[rows]
        trial_residual = constraint.violation(trial)
        # False too where g has no value, NaN.
        is_smaller = np.linalg.norm(trial_residual, axis=-1) < before[rows]
        new_x[rows[is_smaller]] = trial[is_smaller]
        new_residual[rows[is_smaller]] = trial_residual[is_smaller]
        has_decreased[rows[is_smaller]] = True
        if has_decreased.all():
            break
    return _LineSearch(new_x, new_residual, has_decreased)


def _make_tangent(x: Array, constraint: Constraint, motion: Motion) -> None:
    """Remove the part of the velocities along the normals, in the array of states (n, d) itself.

    The motion has the indices of positions and of velocities; the constraint is one on positions.
    """
    positions = list(motion[0])
    velocities = list(motion[1])
    _check_motion(motion, x.shape[-1])
    jacobian = constraint.jacobian(x)[..., positions]
    # v <- v - Jᵀ(J Jᵀ)⁻¹ J v, so that J v = 0.
    rate = (jacobian @ x[:, velocities, None])[..., 0]
    x[:, velocities] += _normal_step(jacobian, rate)


def _check_motion(motion: Motion, d: int) -> None:
    """Raise an error unless every position has a velocity of its own among d components.

    The motion has the indices of positions, and of their velocities in the same order.
    """
    positions, velocities = motion
    # As many velocities as positions, and no component is both.
    paired = len(positions) == len(velocities)
    disjoint = not set(positions) & set(velocities)
    if not (paired and disjoint and max(*positions, *velocities) < d):
        raise ValueError(
            f"motion must have as many other indices below {d} for velocities as for "
            f"positions, got {motion}"
        )
