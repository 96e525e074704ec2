r"""Constraints :math:`\mathbf g(\mathbf x)=\mathbf d` on members: projection and retraction.

Equations (2) and (6)-(13) of Das and Bhattacharya, with what they leave open as options.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, SolverError, array, callable_, choice, count, instance, number, places
from ..differences import _central

__all__ = [  # fmt: skip
    "READINGS", "Constraint", "norm", "project", "retract",
]

READINGS = ("printed", "reversed", "particle", "shift")
"""Four readings of (12): the gain times D_i - d̂, d̂ - D_i, d - D_i, or d - d̂."""


@dataclass(frozen=True, eq=False)
class Constraint:
    """What every state obeys, g(x) = d.

    Parameters
    ----------
    function : callable
        ``g(x)`` on arrays (..., d) to (..., s).
    value : array_like, (s,)
        The right-hand side d.
    derivative : callable, optional
        ``derivative(x)``, the Jacobian of `function`, (..., s, d); differences stand in for it.

    Examples
    --------
    >>> line = Constraint(lambda x: x[..., :1] + x[..., 1:], [1.0])
    >>> line.residual([[0.25, 1.0]])
    array([[0.25]])
    """

    function: Callable[[Array], Array]
    value: Array
    derivative: Callable[[Array], Array] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        callable_(self.function, "function")
        value = array(self.value, "value", ("s",)).copy()
        count(value.size, "value")
        value.setflags(write=False)
        object.__setattr__(self, "value", value)
        if self.derivative is not None:
            callable_(self.derivative, "derivative")

    def residual(self, x: ArrayLike) -> Array:
        """By how much states (..., d) miss, g(x) - d, (..., s)."""
        return self._residual(array(x, "x", (..., "d")))

    def _residual(self, x: Array) -> Array:
        try:
            g = np.asarray(self.function(x.copy()))
        except IndexError as error:
            raise ValueError(f"function: needs states of more components, got {x.shape}") from error
        if g.shape != (*x.shape[:-1], self.value.size):
            raise ValueError(
                f"function: needs to return {(*x.shape[:-1], self.value.size)} for states "
                f"{x.shape}, got {g.shape}"
            )
        return np.asarray(g - self.value)

    def jacobian(self, x: ArrayLike) -> Array:
        """Derivative of g at states (..., d), (..., s, d)."""
        return self._jacobian(array(x, "x", (..., "d")))

    def _jacobian(self, x: Array) -> Array:
        if self.derivative is None:
            return _central(self._residual, x, np.subtract)
        slope = np.asarray(self.derivative(x.copy()))
        needed = (*x.shape[:-1], self.value.size, x.shape[-1])
        if slope.shape != needed:
            raise ValueError(f"derivative: needs to return shape {needed}, got {slope.shape}")
        return slope


def norm(indices: Sequence[int], *, length: float = 1.0) -> Constraint:
    r"""Some components form a vector of given length, :math:`|\mathbf x_I|^2=L^2`.

    Parameters
    ----------
    indices : sequence of int
        The components: the pendulum's position, or an attitude's quaternion.
    length : float
        L, positive.

    Examples
    --------
    >>> norm([0, 1]).residual([0.6, 0.8, 5.0]).round(15) + 0.0
    array([0.])
    """
    rows = list(places(indices, "indices"))
    size = number(length, "length", above=0, at_most=1e150)

    def squares(x: Array) -> Array:
        return np.asarray((x[..., rows] ** 2).sum(axis=-1, keepdims=True))

    def slope(x: Array) -> Array:
        out = np.zeros((*x.shape[:-1], 1, x.shape[-1]))
        out[..., 0, rows] = 2 * x[..., rows]
        return out

    return Constraint(squares, np.array([size**2]), derivative=slope)


def _constraint(value: Constraint) -> Constraint:
    return instance(value, "constraint", Constraint)


def project(
    ensemble: ArrayLike,
    constraint: Constraint,
    *,
    reading: str = "shift",
    regularisation: float = 1e-6,
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
        `READINGS`.
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
    x = array(ensemble, "ensemble", (..., "N", "d"))
    if x.shape[-2] < 2:
        raise ValueError(f"ensemble: needs at least 2 members, got {x.shape[-2]}")
    choice(reading, "reading", READINGS)
    eps = number(regularisation, "regularisation", at_least=0)
    guard = instance(guarded, "guarded", bool)
    return _project(x, _constraint(constraint), reading, eps, guard)


def _project(x: Array, constraint: Constraint, reading: str, eps: float, guarded: bool) -> Array:
    gap = constraint._residual(x)
    mean = gap.mean(axis=-2, keepdims=True)
    anomalies = gap - mean
    n = x.shape[-2]
    around = x - x.mean(axis=-2, keepdims=True)
    spread = np.swapaxes(anomalies, -1, -2) @ anomalies / n + eps * np.eye(gap.shape[-1])
    cross = np.swapaxes(anomalies, -1, -2) @ around / n
    gain = np.linalg.solve(spread, cross)
    aim = {"printed": anomalies, "reversed": -anomalies, "particle": -gap, "shift": -mean}[reading]
    out = x + aim @ gain
    if not guarded:
        return np.asarray(out)
    worse = ~np.isfinite(out).all(axis=(-1, -2))
    left = constraint._residual(np.where(worse[..., None, None], x, out))
    # The members' own misses may grow where only their mean is moved: g is curved.
    before, after = (mean, left.mean(axis=-2, keepdims=True)) if reading == "shift" else (gap, left)
    worse |= np.abs(after).sum(axis=(-1, -2)) > np.abs(before).sum(axis=(-1, -2))
    return np.asarray(np.where(worse[..., None, None], x, out))


Motion = tuple[Sequence[int], Sequence[int]]
"""Indices of positions and of their velocities, in the same order."""


def retract(
    states: ArrayLike,
    constraint: Constraint,
    *,
    motion: Motion | None = None,
    tolerance: float = 1e-15,
    iterations: int = 50,
) -> Array:
    r"""Move every state to the constraint by Newton steps along its normals.

    .. math:: \mathbf x\leftarrow\mathbf x-s\,\mathbf J^\top(\mathbf J\mathbf J^\top)^{-1}
        (\mathbf g(\mathbf x)-\mathbf d),

    where s is halved until the residual falls. With `motion` the velocities then lose their part
    along the normals, :math:`\mathbf J\dot{\mathbf q}=\mathbf 0`.

    Parameters
    ----------
    states : array_like, (..., d)
        States near the constraint; each is moved by itself.
    constraint : Constraint
        For a motion a function of the positions only.
    motion : (sequence of int, sequence of int), optional
        Indices of positions and of their velocities.
    tolerance : float
        Largest :math:`|\mathbf g-\mathbf d|` that is left, relative to :math:`1+|\mathbf d|`.
    iterations : int
        How many Newton steps at most.

    Returns
    -------
    ndarray, (..., d)
        For a length it is the closest point.

    Raises
    ------
    ValueError
        If the Jacobian loses rank at a state: there is no normal to move along.
    SolverError
        If the steps do not converge: the constraint may have no solution nearby.

    Examples
    --------
    >>> retract([3.0, 4.0, 1.0, 0.0], norm([0, 1]), motion=([0, 1], [2, 3])).round(12)
    array([ 0.6 ,  0.8 ,  0.64, -0.48])
    """
    x = array(states, "states", (..., "d"))
    g = _constraint(constraint)
    least = number(tolerance, "tolerance", above=0)
    most = count(iterations, "iterations")
    pair = None if motion is None else _motion(motion, x.shape[-1])
    return _retract(x, g, pair, least, most)


def _motion(motion: Motion, dim: float = np.inf) -> Motion:
    if not isinstance(motion, tuple) or len(motion) != 2 or len(motion[0]) != len(motion[1]):
        raise ValueError(f"motion: needs two lists of indices of one length, got {motion!r}")
    found = [count(i, "motion", at_least=0) for part in motion for i in part]
    if len(set(found)) != len(found) or max(found, default=dim) >= dim:
        raise ValueError(f"motion: needs different indices below {dim}, got {found}")
    return list(motion[0]), list(motion[1])


def _retract(
    x: Array, constraint: Constraint, motion: Motion | None, tolerance: float, iterations: int
) -> Array:
    flat = x.reshape(-1, x.shape[-1]).copy()
    limit = tolerance * (1 + float(np.linalg.norm(constraint.value)))
    gap = constraint._residual(flat)
    size = np.linalg.norm(gap, axis=-1)
    for _ in range(iterations):
        far = np.flatnonzero(size > limit)
        if not far.size:
            break
        step = _along_normals(constraint._jacobian(flat[far]), gap[far])
        flat[far], gap[far], better = _shortened(constraint, flat[far], gap[far], step)
        size[far] = np.where(better, np.linalg.norm(gap[far], axis=-1), size[far])
        # Rounding ends the descent a little above the limit where g is large.
        stuck = far[~better]
        if (size[stuck] > 1e3 * limit).any():
            break
        size[stuck] = 0.0
    if (size > limit).any():
        raise SolverError(
            f"retract: {int((size > limit).sum())} of {size.size} states did not reach the "
            f"constraint in {iterations} Newton steps, |g - d| up to {size.max():.3g}"
        )
    if motion is not None:
        places, rates = motion
        slope = constraint._jacobian(flat)[..., places]
        along = (slope @ flat[:, rates, None])[..., 0]
        flat[:, rates] += _along_normals(slope, along)
    return np.asarray(flat.reshape(x.shape))


def _along_normals(slope: Array, gap: Array) -> Array:
    """The shortest step that takes away `gap` to first order; refuses a lost rank."""
    gram = slope @ np.swapaxes(slope, -1, -2)
    values = np.linalg.eigvalsh(gram)
    lost = values[..., 0] <= 1e-24 + 1e-14 * values[..., -1]
    if lost.any():
        row = int(np.argmax(lost))
        raise ValueError(
            f"constraint: needs a Jacobian of full rank, got one that loses rank at state {row} "
            f"({int(lost.sum())} of {lost.size})"
        )
    dual = np.linalg.solve(gram, gap[..., None])
    return np.asarray(-(np.swapaxes(slope, -1, -2) @ dual)[..., 0])


def _shortened(
    constraint: Constraint, x: Array, gap: Array, step: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The step halved in each state until its residual falls; whether it did."""
    before = np.linalg.norm(gap, axis=-1)
    share, better = np.ones(len(x)), np.zeros(len(x), dtype=bool)
    place, left = x.copy(), gap.copy()
    for _ in range(30):
        todo = np.flatnonzero(~better)
        if not todo.size:
            break
        trial = x[todo] + share[todo, None] * step[todo]
        missed = constraint._residual(trial)
        falls = np.linalg.norm(missed, axis=-1) < before[todo]
        place[todo[falls]], left[todo[falls]] = trial[falls], missed[falls]
        better[todo[falls]] = True
        share[todo] *= 0.5
    return place, left, better
