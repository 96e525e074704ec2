r"""One map for all agents: the program (22) of Grange et al., by ADMM or from averaged moments.

Every agent l has samples of its own, and all want the affine map that minimises
:math:`\sum_l\mathcal L_l(\mathbf U)`. For affine maps the sum depends on the samples through their
pooled first and second moments only, so agreeing on those, once, is the whole task. ADMM gets there
too, in many rounds; it is what the paper proposes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np

from ..doors import Array, Positive, array, door, unchecked
from ..ensembles import mean
from ..network import AdmmRun, Channel, admm, finite_time
from .affine import AffineMap, enough, from_moments, from_rows, refuse

__all__ = ["pool_by_admm", "pool_by_moments"]

Agree = Callable[[Array, Channel], Array]
Seen = Annotated[Array, "*channel.runs channel.graph.size N M"]
Members = Annotated[Array, "*channel.runs channel.graph.size N d"]


@door
def pool_by_moments(
    y: Seen, x: Members, channel: Channel, *, agree: Agree = finite_time
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
    >>> from distfilt.triangular import affine
    >>> one = affine.fit(np.empty((120, 0)), x.reshape(120, 2))
    >>> bool(abs(pooled.scale - one.scale).max() < 1e-12)
    True
    """
    joint = _joint(y, x)
    centre = _average(unchecked(mean)(joint), channel, agree)
    about = joint - centre[..., None, :]
    second = about.mT @ about / joint.shape[-2]
    rows, columns = np.triu_indices(joint.shape[-1])
    packed = _average(np.ascontiguousarray(second[..., rows, columns]), channel, agree)
    second[..., rows, columns] = second[..., columns, rows] = packed
    return from_moments(centre, second, y.shape[-1])


@door
def pool_by_admm(
    y: Seen, x: Members, channel: Channel, *, rho: Positive = 1.0, tolerance: Positive = 1e-6,
    agree: Agree = finite_time,
) -> tuple[AffineMap, AdmmRun]:
    r"""The same map by consensus ADMM on the components' coefficients, the paper's proposal.

    Agents agree on each variable's mean and variance first, 2 D scalars more, and work on
    standardised variables: badly scaled data would take thousands of iterations. Agent l's proximal
    step has a closed form. With :math:`\mathbf C_l` the second moments of
    :math:`(1, z_1,\dots,z_k)`, :math:`\mathbf H = (\mathbf C_l+\rho\mathbf I)^{-1}` and
    :math:`\mathbf b = \rho(\mathbf Z-\mathbf W_l)`,

    .. math:: \mathbf u = \mathbf H\mathbf b + \frac{\mathbf H\mathbf e_k}{u_k},\qquad
        u_k = \tfrac12\Bigl((\mathbf H\mathbf b)_k
        + \sqrt{(\mathbf H\mathbf b)_k^2 + 4H_{kk}}\Bigr).

    Parameters
    ----------
    y, x, channel
        As in :func:`pool_by_moments`; a channel of a single run.
    rho, tolerance, agree
        As in :func:`distfilt.network.admm`.

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
    if channel.runs:
        raise ValueError(f"channel: needs a single run for ADMM, got runs {channel.runs}")
    joint, m = _joint(y, x), y.shape[-1]
    centre = _average(unchecked(mean)(joint), channel, agree)
    squares = ((joint - centre[:, None, :]) ** 2).mean(axis=-2)
    spread = np.sqrt(_average(squares, channel, agree))
    joint = (joint - centre[:, None, :]) / spread[:, None, :]
    ones = np.concatenate([np.ones((*joint.shape[:-1], 1)), joint], axis=-1)
    solve, start = _proximal(ones.mT @ ones / joint.shape[-2], m)
    run = admm(solve, start, channel, rho=rho, tolerance=tolerance, agree=agree)
    rows = np.zeros((len(joint), x.shape[-1], ones.shape[-1]))
    for k, (a, b) in enumerate(_parts(m, x.shape[-1])):
        rows[:, k, : b - a] = run.common[:, a:b]
    one = from_rows(rows, np.zeros((len(joint), m)))
    sy, sx = spread[:, :m], spread[:, m:]  # back from standardised variables
    found = AffineMap.unchecked(
        centre[:, :m], centre[:, m:] + sx * one.mean,
        sx[:, :, None] * one.gain / sy[:, None, :], sx[:, :, None] * one.scale,
    )
    return found, run


def _joint(y: Array, x: Array) -> Array:
    """All agents' variables, refused where they cannot have a map."""
    joint = enough(y, x, x.shape[-3] * x.shape[-2])
    constant = np.ptp(joint, axis=(-3, -2)) <= 1e-13 * np.abs(joint).max(axis=(-3, -2))
    refuse(constant, y.shape[-1], "are not constant")
    return joint


def _average(values: Array, channel: Channel, agree: Agree) -> Array:
    """What the agents agree on, refused where it cannot be an average of the values."""
    out = array(agree(values, channel), "agree", values.shape)
    low, high = values.min(axis=-2, keepdims=True), values.max(axis=-2, keepdims=True)
    # A rule that is only approximate may miss by as much as the values differ.
    slack = (high - low) + 1e-9 * np.maximum(np.abs(low), np.abs(high))
    wrong = out[(out < low - slack) | (out > high + slack)]
    if wrong.size:
        raise ValueError("agree: needs a rule that returns averages of the agents' values, got "
                         f"{wrong[0]:.6g} of values up to {values.max():.6g}")
    return out


def _parts(m: int, d: int) -> list[tuple[int, int]]:
    """Where the coefficients of each component stand in a row of all."""
    ends = np.cumsum([0, *(m + k + 2 for k in range(d))]).tolist()
    return list(zip(ends[:-1], ends[1:], strict=True))


def _proximal(moments: Array, m: int) -> tuple[Callable[[Array, float], Array], Array]:
    """The proximal step of every agent, components one after the other, and where to start."""
    parts = _parts(m, moments.shape[-1] - 1 - m)
    start = np.zeros((len(moments), parts[-1][1]))
    start[:, [b - 1 for _, b in parts]] = 1.0

    def solve(target: Array, rho: float) -> Array:
        out = np.empty_like(target)
        for a, b in parts:
            n = b - a
            regular = moments[:, :n, :n] + rho * np.eye(n)
            right = np.stack([rho * target[:, a:b], np.tile(np.eye(n)[-1], (len(target), 1))], -1)
            pulled, column = np.moveaxis(np.linalg.solve(regular, right), -1, 0)
            last = 0.5 * (pulled[:, -1] + np.sqrt(pulled[:, -1] ** 2 + 4 * column[:, -1]))
            out[:, a:b] = pulled + column / last[:, None]
        return out

    return solve, start
