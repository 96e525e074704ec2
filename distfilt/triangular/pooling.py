r"""One map for all agents: the program (22) of Grange et al., by ADMM or from averaged moments.

Every agent l has samples of its own, and all want the affine map that minimises
:math:`\sum_l\mathcal L_l(\mathbf U)`. For affine maps the sum depends on the samples through their
pooled first and second moments only, so agreeing on those, once, is the whole task. ADMM gets there
too, in many rounds; it is what the paper proposes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, instance
from ..ensembles import mean
from ..network import AdmmRun, Channel, admm, finite_time
from . import affine
from .affine import AffineMap

__all__ = ["pool_by_admm", "pool_by_moments"]

Agree = Callable[[Array, Channel], Array]


def pool_by_moments(
    y: ArrayLike, x: ArrayLike, channel: Channel, *, agree: Agree = finite_time
) -> AffineMap:
    """The affine map of all agents' samples together, from averaged moments: each agent's copy.

    Agents agree on the mean first and then on the second moments about it, which keeps the digits
    that raw second moments would lose.

    Parameters
    ----------
    y : array_like, (*runs, A, N, m)
        Each agent's predicted observations, with noise.
    x : array_like, (*runs, A, N, d)
        Each agent's members; as many for all agents.
    channel : Channel
        The door between agents; D + D(D+1)/2 scalars with D = m + d, times the rounds of `agree`.
    agree : callable
        ``agree(values, channel) -> values``: how an average is found. The default is exact; with an
        approximate rule the agents' maps differ.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> x = np.random.default_rng(0).standard_normal((3, 40, 2))
    >>> pooled = pool_by_moments(x[..., :0], x, Channel(graphs.path(3)))
    >>> one = affine.fit(np.empty((120, 0)), x.reshape(120, 2))
    >>> bool(abs(pooled.scale - one.scale).max() < 1e-12)
    True
    """
    joint, m = _joint(y, x, channel)
    callable_(agree, "agree")
    centre, cov = _agreed_moments(joint, channel, agree)
    return affine._from_moments(centre, cov, m)


def pool_by_admm(
    y: ArrayLike, x: ArrayLike, channel: Channel, *, rho: float = 1.0, tolerance: float = 1e-6,
    iterations: int = 1000, check: int | None = 1, standardise: bool = True,
    agree: Agree = finite_time,
) -> tuple[AffineMap, AdmmRun]:
    r"""The same map by consensus ADMM on the components' coefficients, the paper's proposal.

    Agent l's proximal step has a closed form. With :math:`\mathbf C_l` the second moments of
    :math:`(1, z_1,\dots,z_k)`, :math:`\mathbf H = (\mathbf C_l+\rho\mathbf I)^{-1}` and
    :math:`\mathbf b = \rho(\mathbf Z-\mathbf W_l)`,

    .. math:: \mathbf u = \mathbf H\mathbf b + \frac{\mathbf H\mathbf e_k}{u_k},\qquad
        u_k = \tfrac12\Bigl((\mathbf H\mathbf b)_k
        + \sqrt{(\mathbf H\mathbf b)_k^2 + 4H_{kk}}\Bigr).

    Parameters
    ----------
    y, x, channel
        As in :func:`pool_by_moments`; a channel of a single run.
    rho, tolerance, iterations, check, agree
        As in :func:`distfilt.network.admm`.
    standardise : bool
        Agree on each variable's mean and variance first, 2 D scalars more, and work on standardised
        variables. Without it badly scaled data take thousands of iterations.

    Returns
    -------
    map : AffineMap
        With a leading axis (A,): each agent's copy. It is as exact as `tolerance`, and the number
        of iterations grows with the condition number of the variables' correlation matrix.
    run : AdmmRun
        How ADMM ended; its ``common`` holds the coefficients.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> x = np.random.default_rng(0).standard_normal((3, 40, 2))
    >>> solved, run = pool_by_admm(x[..., :0], x, Channel(graphs.path(3)))
    >>> pooled = pool_by_moments(x[..., :0], x, Channel(graphs.path(3)))
    >>> bool(abs(pooled.scale - solved.scale).max() < 1e-5), run.iterations < 250
    (True, True)
    """
    joint, m = _joint(y, x, channel)
    callable_(agree, "agree")
    instance(standardise, "standardise", bool)
    size = joint.shape[-1]
    if channel.runs:
        raise ValueError(f"channel: needs a single run for ADMM, got runs {channel.runs}")
    centre, spread = np.zeros(joint.shape[:-2] + (size,)), np.ones(joint.shape[:-2] + (size,))
    if standardise:
        centre = _average(mean(joint), channel, agree)
        squares = ((joint - centre[..., None, :]) ** 2).mean(axis=-2)
        spread = np.sqrt(_average(squares, channel, agree))
    joint = (joint - centre[..., None, :]) / spread[..., None, :]
    ones = np.concatenate([np.ones((*joint.shape[:-1], 1)), joint], axis=-1)
    moments = np.swapaxes(ones, -1, -2) @ ones / joint.shape[-2]
    solve, start = _proximal(moments, m)
    run = admm(
        solve, start, channel, rho=rho, tolerance=tolerance, iterations=iterations, check=check,
        agree=agree,
    )
    return _in_units(_as_map(run.common, m, size - m), centre, spread), run


def _joint(y: ArrayLike, x: ArrayLike, channel: Channel) -> tuple[Array, int]:
    instance(channel, "channel", Channel)
    members = array(x, "x", (*channel.runs, channel.graph.size, "N", "d"))
    seen = array(y, "y", (*members.shape[:-1], "m"))
    samples, size = channel.graph.size * members.shape[-2], seen.shape[-1] + members.shape[-1]
    if samples <= size:
        raise ValueError(f"x: needs more than {size} members of all agents together for {size} "
                         f"variables, got {samples}")
    joint = np.concatenate([seen, members], axis=-1)
    _varies(joint, seen.shape[-1])
    return joint, seen.shape[-1]


def _varies(joint: Array, m: int) -> None:
    """Refuse variables that are the same for all members of all agents."""
    largest = np.abs(joint).max(axis=(-3, -2))
    constant = np.ptp(joint, axis=(-3, -2)) <= 1e-13 * largest
    if constant.any():
        name = "y" if constant[..., :m].any() else "x"
        raise ValueError(f"{name}: needs variables that are not constant, got one")


def _average(values: Array, channel: Channel, agree: Agree) -> Array:
    """What the agents agree on, refused where it cannot be an average of the values."""
    out = array(agree(values, channel), "agree", values.shape, finite=False)
    low, high = values.min(axis=-2, keepdims=True), values.max(axis=-2, keepdims=True)
    # A rule that is only approximate may miss by as much as the values differ.
    slack = (high - low) + 1e-9 * np.maximum(np.abs(low), np.abs(high))
    good = (out >= low - slack) & (out <= high + slack)
    if not good.all():
        at = tuple(np.argwhere(~good)[0])
        raise ValueError(
            f"agree: needs a rule that returns averages of the agents' values, got {out[at]:.6g} "
            f"of values up to {values.max(axis=-2)[(*at[:-2], at[-1])]:.6g}"
        )
    return out


def _agreed_moments(joint: Array, channel: Channel, agree: Agree) -> tuple[Array, Array]:
    centre = _average(mean(joint), channel, agree)
    about = joint - centre[..., None, :]
    second = np.swapaxes(about, -1, -2) @ about / joint.shape[-2]
    rows, columns = np.triu_indices(joint.shape[-1])
    packed = _average(np.ascontiguousarray(second[..., rows, columns]), channel, agree)
    cov = np.empty_like(second)
    cov[..., rows, columns] = cov[..., columns, rows] = packed
    return centre, cov


def _proximal(moments: Array, m: int) -> tuple[Callable[[Array, float], Array], Array]:
    """The proximal step of every agent, components one after the other, and where to start."""
    size = moments.shape[-1] - 1
    lengths = [m + k + 2 for k in range(size - m)]
    ends = np.cumsum([0, *lengths])
    start = np.zeros((moments.shape[0], ends[-1]))
    start[:, ends[1:] - 1] = 1.0

    def solve(target: Array, rho: float) -> Array:
        out = np.empty_like(target)
        for n, a, b in zip(lengths, ends[:-1], ends[1:], strict=True):
            regular = moments[:, :n, :n] + rho * np.eye(n)
            right = np.stack([rho * target[:, a:b], np.tile(np.eye(n)[-1], (len(target), 1))], -1)
            both = np.linalg.solve(regular, right)
            pulled, column = both[..., 0], both[..., 1]
            last = 0.5 * (pulled[:, -1] + np.sqrt(pulled[:, -1] ** 2 + 4 * column[:, -1]))
            out[:, a:b] = pulled + column / last[:, None]
        return out

    return solve, start


def _as_map(coefficients: Array, m: int, d: int) -> AffineMap:
    """The affine map of stacked coefficients (A, K)."""
    rows = np.zeros((coefficients.shape[0], d, 1 + m + d))
    first = 0
    for k in range(d):
        rows[:, k, : m + k + 2] = coefficients[:, first : first + m + k + 2]
        first += m + k + 2
    return affine.from_rows(rows, np.zeros((coefficients.shape[0], m)))


def _in_units(standard: AffineMap, centre: Array, spread: Array) -> AffineMap:
    """A map of standardised variables as one of the variables themselves."""
    m = standard.observed_mean.shape[-1]
    sy, sx = spread[..., :m], spread[..., m:]
    return AffineMap(
        centre[..., :m],
        centre[..., m:] + sx * standard.mean,
        sx[..., :, None] * standard.gain / sy[..., None, :],
        sx[..., :, None] * standard.scale,
    )
