r"""One map for all agents: the program (22) of Grange et al., by ADMM or from averaged moments.

Every agent l has samples of its own, and all want the affine map that minimises
:math:`\sum_l\mathcal L_l(\mathbf U)`. For affine maps the sum depends on the samples through their
pooled first and second moments only, so one average consensus on those solves it. ADMM, which the
paper proposes, needs many rounds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np

from ..ensembles import mean
from ..network import AdmmResult, Channel, admm, finite_time_consensus
from ..validation import (
    Array,
    ArrayInput,
    Mask,
    PositiveFloat,
    call_user,
    check_array,
    validated,
)
from .affine import (
    AffineMap,
    check_variables,
    from_moments,
    from_rows,
    join_enough_samples,
    multiply_vector,
)

__all__ = ["pool_by_admm", "pool_by_moments"]

AverageRule = Callable[[Array, Channel], Array]
"""``average(values, channel) -> averages``, both with an axis of agents before the last."""
AgentObservations = Annotated[ArrayInput, "*channel.runs channel.graph.n_agents N M"]
AgentStates = Annotated[ArrayInput, "*channel.runs channel.graph.n_agents N d"]


@validated
def pool_by_moments(
    y: AgentObservations,
    x: AgentStates,
    channel: Channel,
    *,
    average: AverageRule = finite_time_consensus,
) -> AffineMap:
    """Fit one affine map to all agents' samples from averaged moments.

    Agents average the mean first and then the second moments about it, which keeps the digits that
    raw second moments would lose.

    Parameters
    ----------
    y : array_like, (*runs, A, N, m)
        Each agent's predicted observations, with noise.
    x : array_like, (*runs, A, N, d)
        Each agent's members; as many for all agents.
    channel : Channel
        The channel between agents, which carries D + D(D+1)/2 scalars with D = m + d, times the
        rounds of `average`.
    average : callable
        ``average(values, channel) -> averages``: a rule of average consensus. The default is exact;
        with an approximate rule the agents' maps differ.

    Returns
    -------
    AffineMap
        With the axes (*runs, A): each agent's copy.

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
    # Of all A agents with N members each; the variables (y, x) of these are (..., A, N, m + d).
    n_members = x.shape[-3] * x.shape[-2]
    joint = join_enough_samples(y, x, n_members)
    # Each agent's copy of the mean over all agents, and its own second moments about that
    centre = _average_values(mean(joint), channel, average)
    anomalies = joint - centre[..., None, :]
    second = anomalies.mT @ anomalies / joint.shape[-2]
    # A symmetric matrix: the upper triangle is sent.
    rows, columns = np.triu_indices(joint.shape[-1])
    triangle = np.ascontiguousarray(second[..., rows, columns])
    averaged = _average_values(triangle, channel, average)
    second[..., rows, columns] = averaged
    second[..., columns, rows] = averaged
    return from_moments(centre, second, y.shape[-1])


@validated
def pool_by_admm(
    y: AgentObservations,
    x: AgentStates,
    channel: Channel,
    *,
    rho: PositiveFloat = 1.0,
    tolerance: PositiveFloat = 1e-6,
    average: AverageRule = finite_time_consensus,
) -> tuple[AffineMap, AdmmResult]:
    r"""Fit the same map by consensus ADMM on the components' coefficients, the paper's proposal.

    Agents average each variable's mean and variance first, 2 D scalars more, and work on
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
    rho, tolerance, average
        As in :func:`distfilt.network.admm`.

    Returns
    -------
    map : AffineMap
        With a leading axis (A,): each agent's copy. It is as exact as `tolerance`, and the number
        of iterations grows with the condition number of the variables' correlation matrix.
    run : AdmmResult
        The result of ADMM; its ``common`` has the coefficients.

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
            f"channel must have a single run for ADMM, got runs {channel.runs}"
        )
    # Of all A agents with N members each; the variables (y, x) of these are (A, N, m + d).
    n_members = x.shape[-3] * x.shape[-2]
    joint = join_enough_samples(y, x, n_members)
    m = y.shape[-1]
    d = x.shape[-1]
    # Each agent's copy of the variables' means and deviations over all agents, (A, m + d)
    centre, std = _average_scales(joint, m, channel, average)
    standard = (joint - centre[:, None, :]) / std[:, None, :]
    # Rows (1, y, x), and each agent's second moments C of them, (A, 1 + m + d, 1 + m + d)
    constant = np.ones((*standard.shape[:-1], 1))
    design = np.concatenate([constant, standard], axis=-1)
    moments = design.mT @ design / design.shape[-2]
    # Component k of the state uses the constant, y, and x up to its own: (d, 1 + m + d), of which
    # the entries that are true are one vector of unknowns for ADMM.
    used = np.tri(d, 1 + m + d, m + 1, dtype=bool)
    # The standard normal's map z_k = x_k is the start, for each of the A agents.
    identity = np.eye(d, 1 + m + d, m + 1)
    start = np.tile(identity[used], (len(joint), 1))
    run = admm(
        _proximal_step(moments, used),
        start,
        channel,
        rho=rho,
        tolerance=tolerance,
        average=average,
    )
    # Unpacked to a row for each component, (A, d, 1 + m + d).
    coefficients = np.zeros((len(joint), *used.shape))
    coefficients[:, used] = run.common
    # Back from standardised variables.
    coefficients[..., 1:] /= std[:, None, :]
    coefficients[..., 0] -= multiply_vector(coefficients[..., 1:], centre)
    return from_rows(coefficients, centre[:, :m]), run


def _average_scales(
    joint: Array, m: int, channel: Channel, average: AverageRule
) -> tuple[Array, Array]:
    """Return the mean and standard deviation of each variable over all agents, (A, m + d) each.

    They are found by consensus from the agents' own samples (A, N, m + d) of m observed and d state
    variables: each agent has a copy. A constant variable raises an error. The rule of consensus is
    `average`.
    """
    centre = _average_values(mean(joint), channel, average)
    anomalies = joint - centre[:, None, :]
    squares = (anomalies**2).mean(axis=-2)
    std = np.sqrt(_average_values(squares, channel, average))
    # A smaller deviation is rounding of the mean.
    is_constant = std <= 1e-13 * np.abs(centre)
    # Refuse constant ones: the error names the first, as a column of y or of x.
    check_variables(is_constant, m, needs="are not constant")
    return centre, std


def _average_values(values: Array, channel: Channel, average: AverageRule) -> Array:
    """Return the averages of values (..., A, n) over the agents, by a rule of consensus.

    Raises an error if they cannot be averages of the values.
    """
    averages = call_user(average, values, channel)
    averages = check_array(averages, "average", values.shape)
    exact = values.mean(axis=-2, keepdims=True)
    # A rule that is only approximate may be off by as much as the values differ, twice that for
    # one that overshoots, and by rounding where all are equal.
    spread = np.ptp(values, axis=-2, keepdims=True)
    tolerance = 2 * (spread + 1e-9 * np.abs(exact))
    if (np.abs(averages - exact) > tolerance).any():
        raise ValueError(
            "average must be a rule that returns averages of the agents' values, got up "
            f"to {np.abs(averages).max():.6g} of up to {np.abs(values).max():.6g}"
        )
    return averages


def _proximal_step(moments: Array, used: Mask) -> Callable[[Array, float], Array]:
    """Return the proximal step of all agents, the formula of :func:`pool_by_admm`.

    The `moments` are the second moments C of (1, y, x), (A, 1 + m + d, 1 + m + d). The step is a
    function of the targets Z - W and of rho. It works on the used coefficients, one row an agent:
    those that `used` (d, 1 + m + d) marks, row k for component k of the map.
    """

    def solve(target: Array, rho: float) -> Array:
        """Return the coefficients u (A, n) of the agents for their targets Z - W (A, n).

        For each component k they minimise ½ uᵀ C u - log u_k + ½ rho |u - target|², where u_k is
        the component's own coefficient, the last that it uses. So (C + rho I) u = b + e_k / u_k
        with b = rho target and the last unit vector e_k.
        """
        # Unpacked to (A, d, 1 + m + d): b, which each component's solution replaces.
        coefficients = np.zeros((len(target), *used.shape))
        coefficients[:, used] = rho * target
        for k in range(len(used)):
            # It uses the first n of (1, y, x).
            n = int(used[k].sum())
            # H b and H e_k of all agents in one solve, H = (C + rho I)⁻¹.
            regular = moments[:, :n, :n] + rho * np.eye(n)
            identity = np.eye(n)
            last_unit = np.tile(identity[-1], (len(target), 1))
            right = np.stack([coefficients[:, k, :n], last_unit], axis=-1)
            solution = np.linalg.solve(regular, right)
            hb = solution[..., 0]
            he = solution[..., 1]
            # Row k of u = H b + H e_k / u_k is u_k² - (H b)_k u_k - H_kk = 0. Its positive root is
            # u_k = ((H b)_k + sqrt((H b)_k² + 4 H_kk)) / 2.
            hb_last = hb[:, -1]
            discriminant = hb_last**2 + 4 * he[:, -1]
            last = 0.5 * (hb_last + np.sqrt(discriminant))
            coefficients[:, k, :n] = hb + he / last[:, None]
        return np.asarray(coefficients[:, used])

    return solve
