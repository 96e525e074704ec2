r"""Constraints :math:`\mathbf g(\mathbf x)=\mathbf d` on members: projection and retraction.

Equations (2) and (6)-(12) of Das and Bhattacharya, with what they leave open as options.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Literal

import numpy as np

from ..ensembles import Ensemble
from ..linalg import SolverError, as_derivative, central
from ..validation import (
    Array,
    Bounds,
    DistinctIndices,
    FrozenModel,
    Mask,
    NonNegativeFloat,
    check_array,
    validated,
)

__all__ = ["Constraint", "norm_constraint", "project", "retract"]

Reading = Literal["printed", "reversed", "particle", "shift"]
"""Four readings of (12): the gain times D_i - d̂, d̂ - D_i, d - D_i, or d - d̂."""
Motion = tuple[DistinctIndices, DistinctIndices]
"""Indices of positions and of their velocities, in the same order."""

_CLOSE = 1e-15
_STEPS = 50
"""What :func:`retract` leaves of the residual, relative, and its Newton steps at most."""


@dataclass(frozen=True, eq=False)
class Constraint(FrozenModel):
    """What every state obeys, g(x) = d.

    Parameters
    ----------
    function : callable
        ``g(x)`` on arrays (..., d) to (..., s).
    value : array_like, (s,)
        The right-hand side d.
    derivative : callable, optional
        ``derivative(x)``, the Jacobian of `function`, (..., s, d); differences stand in for it. A
        first time they are compared, and a warning tells of another function's.

    Examples
    --------
    >>> line = Constraint(lambda x: x[..., :1] + x[..., 1:], [1.0])
    >>> line.residual([[0.25, 1.0]])
    array([[0.25]])
    """

    function: Callable[[Array], Array]
    value: Annotated[Array, "s"]
    derivative: Callable[[Array], Array] | None = field(default=None, kw_only=True)

    @validated
    def residual(self, x: Annotated[Array, "... d"]) -> Array:
        """By how much states (..., d) miss, g(x) - d, (..., s)."""
        return check_array(self.violation(x), "function")

    def violation(self, x: Array) -> Array:
        """The same without a door, for trial steps: NaN where the function has no value."""
        shape = (*x.shape[:-1], self.value.size)
        try:
            g = self.function(x.copy())
        except IndexError as error:
            raise ValueError(
                f"constraint must be states with more than {x.shape[-1]} components: {error}"
            ) from error
        return check_array(g, "function", shape, finite=False) - self.value

    @validated
    def jacobian(self, x: Annotated[Array, "... d"]) -> Array:
        """Derivative of g at states (..., d), (..., s, d)."""
        near = partial(central, self.violation, x)
        return as_derivative(
            self, (x,), (*x.shape[:-1], self.value.size, x.shape[-1]), near
        )


@validated
def norm_constraint(
    indices: DistinctIndices,
    *,
    length: Annotated[float, Bounds(above=0, at_most=1e150)] = 1.0,
) -> Constraint:
    r"""Some components form a vector of given length, :math:`|\mathbf x_I|^2=L^2`.

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
    rows = list(indices)

    def squares(x: Array) -> Array:
        return np.asarray((x[..., rows] ** 2).sum(axis=-1, keepdims=True))

    def slope(x: Array) -> Array:
        out = np.zeros((*x.shape[:-1], 1, x.shape[-1]))
        out[..., 0, rows] = 2 * x[..., rows]
        return out

    return Constraint(squares, np.array([length**2]), derivative=slope)


@validated
def project(
    ensemble: Ensemble,
    constraint: Constraint,
    *,
    reading: Reading = "shift",
    regularisation: NonNegativeFloat = 1e-6,
    guarded: bool = True,
) -> Array:
    r"""Regress the members on the constraint and correct them, equations (6)-(12).

    With :math:`\mathbf D_i=\mathbf g(\mathbf x_i)`, their mean :math:`\hat{\mathbf d}` and the gain
    :math:`\mathbf K=\boldsymbol\Sigma_{xd}(\boldsymbol\Sigma_{dd}+\epsilon\mathbf I)^{-1}`:

    * ``"printed"``, :math:`\mathbf x_i+\mathbf K(\mathbf D_i-\hat{\mathbf d})`: the mean stays and
      the spread along the constraint doubles;
    * ``"reversed"``, :math:`\mathbf x_i+\mathbf K(\hat{\mathbf d}-\mathbf D_i)`: wrong aim;
    * ``"particle"``, :math:`\mathbf x_i+\mathbf K(\mathbf d-\mathbf D_i)`: exact for linear g;
    * ``"shift"``, :math:`\mathbf x_i+\mathbf K(\mathbf d-\hat{\mathbf d})`: moves the mean only.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members, at least two.
    constraint : Constraint
    reading : {"printed", "reversed", "particle", "shift"}
        Of (12), as above.
    regularisation : float
        ε, at least 0, in the units of g squared: on the manifold the covariance is singular.
    guarded : bool
        Return an ensemble as it came if the projection is not finite or makes larger what it is to
        make small: for ``"shift"``, which keeps the spread, the miss of the mean
        :math:`|\hat{\mathbf d}-\mathbf d|`; for the others the mean of the members' misses
        :math:`|\mathbf D_i-\mathbf d|`. The printed formula needs ``False`` to show what it does.

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
    >>> y = project(x, line, reading="particle", regularisation=0.0)
    >>> bool(abs(line.residual(y)).max() < 1e-14)
    True
    """
    x = ensemble
    n = ensemble.shape[-2]
    gap = constraint.residual(x)
    mean = gap.mean(axis=-2, keepdims=True)
    anomalies = gap - mean
    around = x - x.mean(axis=-2, keepdims=True)
    spread = anomalies.mT @ anomalies / n + regularisation * np.eye(gap.shape[-1])
    gain = np.linalg.solve(spread, anomalies.mT @ around / n)
    aim = {
        "printed": anomalies,
        "reversed": -anomalies,
        "particle": -gap,
        "shift": -mean,
    }[reading]
    out = x + aim @ gain
    if not guarded:
        return np.asarray(out)
    left = constraint.violation(out)
    # The members' own misses may grow where only their mean is moved: g is curved.
    before, after = (
        (mean, left.mean(axis=-2, keepdims=True)) if reading == "shift" else (gap, left)
    )
    better = np.abs(after).sum(axis=(-1, -2)) <= np.abs(before).sum(axis=(-1, -2))
    return np.asarray(np.where(better[..., None, None], out, x))


@validated
def retract(
    states: Annotated[Array, "... d"],
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
    x = states.reshape(-1, states.shape[-1]).copy()
    gap = constraint.residual(x)
    left = np.arange(len(x))
    for _ in range(_STEPS):
        slope, excess = _excess(constraint, x[left], gap[left])
        todo = excess > _CLOSE
        left = left[todo]
        slope = slope[todo]
        excess = excess[todo]
        if not left.size:
            break
        step = _along_normals(slope, gap[left])
        x[left], gap[left], better = _shortened(constraint, x[left], gap[left], step)
        # Rounding ends the descent a little above the tolerance where g is large.
        left = left[better | (excess > 1e3 * _CLOSE)]
    else:
        left = left[_excess(constraint, x[left], gap[left])[1] > _CLOSE]
    if left.size:
        raise SolverError(
            f"retract: {left.size} of {len(x)} states did not reach the constraint "
            f"in {_STEPS} Newton steps, |g - d| up to {np.abs(gap[left]).max():.3g}"
        )
    if motion is not None:
        _make_tangent(x, constraint, motion)
    return np.asarray(x.reshape(states.shape))


def _excess(constraint: Constraint, x: Array, gap: Array) -> tuple[Array, Array]:
    """Jacobians at states (n, d), and how far each is off in units of what rounding explains."""
    slope = constraint.jacobian(x)
    reach = np.linalg.norm(slope, axis=-1) * np.linalg.norm(x, axis=-1)[:, None]
    unit = np.maximum(np.abs(constraint.value), reach)
    return slope, (np.abs(gap) / np.where(gap == 0, 1.0, unit)).max(axis=-1)


def _along_normals(slope: Array, gap: Array) -> Array:
    """The shortest step that takes away `gap` to first order; refuses a lost rank."""
    with np.errstate(invalid="ignore"):
        rows = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    least = np.linalg.eigvalsh(np.nan_to_num(rows @ rows.mT))[..., 0]
    lost = ~(least > 1e-14)
    if lost.any():
        raise ValueError(
            "constraint must be a Jacobian of full rank, got one that loses rank at "
            f"state {lost.argmax()} ({lost.sum()} of {lost.size})"
        )
    dual = np.linalg.solve(slope @ slope.mT, gap[..., None])
    return np.asarray(-(slope.mT @ dual)[..., 0])


def _shortened(
    constraint: Constraint, x: Array, gap: Array, step: Array
) -> tuple[Array, Array, Mask]:
    """The step halved in each state until its residual falls; whether it did."""
    before = np.linalg.norm(gap, axis=-1)
    better = np.zeros(len(x), dtype=bool)
    place = x.copy()
    left = gap.copy()
    for k in range(30):
        todo = np.flatnonzero(~better)
        trial = x[todo] + 0.5**k * step[todo]
        missed = constraint.violation(trial)
        falls = np.linalg.norm(missed, axis=-1) < before[todo]
        place[todo[falls]] = trial[falls]
        left[todo[falls]] = missed[falls]
        better[todo[falls]] = True
        if better.all():
            break
    return place, left, better


def _make_tangent(x: Array, constraint: Constraint, motion: Motion) -> None:
    """Take from the velocities in states (n, d) their part along the normals, in place."""
    places, rates = (list(part) for part in motion)
    if (
        len(places) != len(rates)
        or {*places} & {*rates}
        or max(places + rates) >= x.shape[-1]
    ):
        needs = (
            f"as many other indices below {x.shape[-1]} for velocities as for positions"
        )
        raise ValueError(f"motion must be {needs}, got {motion}")
    slope = constraint.jacobian(x)[..., places]
    along = (slope @ x[:, rates, None])[..., 0]
    x[:, rates] += _along_normals(slope, along)
