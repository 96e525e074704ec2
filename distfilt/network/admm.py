"""Consensus ADMM: agents with private objectives find the common minimiser of their sum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, SolverError, array, callable_, count, number
from .channel import Channel
from .consensus import finite_time, maximum

__all__ = ["AdmmRun", "admm"]


@dataclass(frozen=True, eq=False)
class AdmmRun:
    """What consensus ADMM found.

    Parameters
    ----------
    common : ndarray, (A, k)
        Each agent's copy of the common variable Z.
    local : ndarray, (A, k)
        Each agent's own variable.
    multipliers : ndarray, (A, k)
        Scaled multipliers; they sum to zero.
    iterations : int
        How many.
    primal, dual : float
        The residuals at the end, over all agents: the largest distance of local from common, and ρ
        times the largest change of the common variable.

    Examples
    --------
    >>> AdmmRun(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((2, 1)), 3, 1e-9, 1e-9).iterations
    3
    """

    common: Array
    local: Array
    multipliers: Array
    iterations: int
    primal: float
    dual: float


def admm(
    local_solve: Callable[[Array, float], Array], start: ArrayLike, channel: Channel, *,
    rho: float = 1.0, tolerance: float = 1e-6, iterations: int = 1000, check: int | None = 1,
    agree: Callable[[Array, Channel], Array] = finite_time,
) -> AdmmRun:
    r"""Minimise :math:`\sum_l f_l(\mathbf Z)` when agent l knows only its own :math:`f_l`.

    .. math::
        \mathbf U_l &\leftarrow \arg\min_{\mathbf U} f_l(\mathbf U)
        + \tfrac\rho2\|\mathbf U-(\mathbf Z-\mathbf W_l)\|^2,\\
        \mathbf Z &\leftarrow\tfrac1A\textstyle\sum_l(\mathbf U_l+\mathbf W_l),\\
        \mathbf W_l &\leftarrow\mathbf W_l+\mathbf U_l-\mathbf Z

    Parameters
    ----------
    local_solve : callable
        ``local_solve(target, rho) -> U`` on (A, k): the proximal step of every agent for its own
        objective at its own row of `target` = Z - W.
    start : array_like, (A, k)
        Each agent's first Z.
    channel : Channel
        The door between agents; a single run, connected.
    rho : float
        Penalty, positive.
    tolerance : float
        Stop when both residuals, of every agent, are below it.
    iterations : int
        At most this many.
    check : int or None
        After every so many iterations the agents agree on their largest residuals, so that all stop
        at once: :func:`~distfilt.network.consensus.maximum` of 2 scalars, as many rounds as the
        diameter, charged like everything else. It needs a channel that loses nothing. None: no
        agent looks, and all iterations are made.
    agree : callable
        ``agree(values, channel) -> values``: how the average is found. With a rule that is only
        approximate the agents' copies of Z differ.

    Raises
    ------
    SolverError
        If the residuals are not below `tolerance` after `iterations` although `check` is given; the
        message has them.

    Notes
    -----
    S. Boyd et al., Foundations and Trends in Machine Learning 3 (2010) 1-122, section 7.1; proposed
    for (22) of Grange et al.

    Examples
    --------
    The average of private numbers, each the minimiser of its agent's :math:`(u-c_l)^2/2`:

    >>> from distfilt.network import Channel, graphs
    >>> own = np.array([[1.0], [2.0], [6.0]])
    >>> run = admm(lambda v, rho: (own + rho * v) / (1 + rho), np.zeros((3, 1)),
    ...            Channel(graphs.path(3)))
    >>> run.common.round(5).ravel()
    array([3., 3., 3.])
    """
    callable_(local_solve, "local_solve")
    callable_(agree, "agree")
    if not isinstance(channel, Channel) or channel.runs:
        raise ValueError("channel: needs a Channel of a single run")
    z = array(start, "start", (channel.graph.size, "k"))
    penalty, small = number(rho, "rho", above=0), number(tolerance, "tolerance", above=0)
    most = count(iterations, "iterations")
    _refuse_faults(check, channel)
    w = np.zeros_like(z)
    for n in range(1, most + 1):
        u = array(local_solve(z - w, penalty), "local_solve", z.shape)
        new = array(agree(u + w, channel), "agree", z.shape)
        w = w + u - new
        gaps = np.stack([np.abs(u - new).max(axis=1), np.abs(new - z).max(axis=1)], axis=1)
        residuals, z = gaps * [1.0, penalty], new
        if check is not None and (n % check == 0 or n == most):
            # After the maximum all agents hold the same two numbers; any row will do.
            primal, dual = (float(r) for r in maximum(residuals, channel)[0])
            if primal < small and dual < small:
                return AdmmRun(z, u, w, n, primal, dual)
    if check is None:
        return AdmmRun(z, u, w, most, *(float(r) for r in residuals.max(axis=0)))
    raise SolverError(
        f"admm: residuals {primal:.3g} and {dual:.3g} after {most} iterations, "
        f"needs both below {small:g}"
    )


def _refuse_faults(check: int | None, channel: Channel) -> None:
    """Agents that miss a message would stop apart."""
    if check is not None and count(check, "check") and not channel.faults.none:
        raise ValueError(
            "check: needs a channel without faults, or agents would stop apart, got one with "
            "faults; None makes all iterations"
        )
