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

from ..ensembles import mean
from ..network import AdmmResult, Channel, admm, finite_time_consensus
from ..validation import Array, PositiveFloat, check_array, validated
from .affine import AffineMap, enough, from_moments, from_rows, refuse

__all__ = ["pool_by_admm", "pool_by_moments"]

Agree = Callable[[Array, Channel], Array]
Seen = Annotated[Array, "*channel.runs channel.graph.n_agents N M"]
Members = Annotated[Array, "*channel.runs channel.graph.n_agents N d"]


@validated
def pool_by_moments(
    y: Seen, x: Members, channel: Channel, *, average: Agree = finite_time_consensus
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
    joint = enough(y, x, x.shape[-3] * x.shape[-2])
    centre = _average(mean(joint), channel, average)
    about = joint - centre[..., None, :]
    second = about.mT @ about / joint.shape[-2]
    rows, columns = np.triu_indices(joint.shape[-1])
    packed = _average(
        np.ascontiguousarray(second[..., rows, columns]), channel, average
    )
    second[..., rows, columns] = second[..., columns, rows] = packed
    return from_moments(centre, second, y.shape[-1])


@validated
def pool_by_admm(
    y: Seen,
    x: Members,
    channel: Channel,
    *,
    rho: PositiveFloat = 1.0,
    tolerance: PositiveFloat = 1e-6,
    average: Agree = finite_time_consensus,
) -> tuple[AffineMap, AdmmResult]:
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
    run : AdmmResult
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
        raise ValueError(
            f"channel must be a single run for ADMM, got runs {channel.runs}"
        )
    joint = enough(y, x, x.shape[-3] * x.shape[-2])
    m = y.shape[-1]
    centre = _average(mean(joint), channel, average)
    squares = ((joint - centre[:, None, :]) ** 2).mean(axis=-2)
    spread = np.sqrt(_average(squares, channel, average))
    refuse(spread <= 1e-13 * np.abs(centre), m, "are not constant")
    joint = (joint - centre[:, None, :]) / spread[:, None, :]
    ones = np.concatenate([np.ones((*joint.shape[:-1], 1)), joint], axis=-1)
    solve, start, there = _proximal(ones.mT @ ones / joint.shape[-2], m)
    run = admm(solve, start, channel, rho=rho, tolerance=tolerance, average=average)
    rows = np.zeros((len(joint), *there.shape))
    rows[:, there] = run.common
    # Back from standardised variables.
    rows[..., 1:] /= spread[:, None, :]
    rows[..., 0] -= (rows[..., 1:] @ centre[..., None])[..., 0]
    return from_rows(rows, centre[:, :m]), run


def _average(values: Array, channel: Channel, agree: Agree) -> Array:
    """What the agents agree on, refused where it cannot be an average of the values."""
    out = check_array(agree(values, channel), "agree", values.shape)
    middle = values.mean(axis=-2, keepdims=True)
    # A rule that is only approximate may miss by as much as the values differ.
    slack = np.ptp(values, axis=-2, keepdims=True) + 1e-9 * np.abs(middle)
    if (np.abs(out - middle) > 2 * slack).any():
        raise ValueError(
            "agree must be a rule that returns averages of the agents' values, got up "
            f"to {np.abs(out).max():.6g} of up to {np.abs(values).max():.6g}"
        )
    return out


def _proximal(
    moments: Array, m: int
) -> tuple[Callable[[Array, float], Array], Array, Array]:
    """The proximal step of every agent, components one after the other; where to start; and which
    coefficients (d, 1 + m + d) there are.
    """
    d = moments.shape[-1] - 1 - m
    there = np.tri(d, 1 + m + d, m + 1, dtype=bool)
    start = np.tile(np.eye(d, 1 + m + d, m + 1)[there], (len(moments), 1))

    def solve(target: Array, rho: float) -> Array:
        out = np.zeros((len(target), *there.shape))
        out[:, there] = rho * target
        for k in range(d):
            n = m + k + 2
            regular = moments[:, :n, :n] + rho * np.eye(n)
            right = np.stack(
                [out[:, k, :n], np.tile(np.eye(n)[-1], (len(target), 1))], -1
            )
            pulled, column = np.moveaxis(np.linalg.solve(regular, right), -1, 0)
            last = 0.5 * (
                pulled[:, -1] + np.sqrt(pulled[:, -1] ** 2 + 4 * column[:, -1])
            )
            out[:, k, :n] = pulled + column / last[:, None]
        return np.asarray(out[:, there])

    return solve, start, there
