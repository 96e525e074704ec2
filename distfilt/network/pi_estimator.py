"""Proportional-integral estimators: consensus on the average of inputs that change in time."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    FrozenModel,
    PositiveFloat,
    PositiveInt,
    validated,
)
from .channel import Channel, PerAgent
from .consensus import _warn_if_disconnected
from .graphs import Graph
from .weights import UnstableGain, _laplacian_weights

__all__ = ["PIState", "pi_start", "pi_step", "stable_substeps"]

_Gain = Annotated[float, Bounds(at_least=0, at_most=1e100)]
"""A gain, in 1/s; bounded, so that its square times that of an eigenvalue is finite."""


@dataclass(frozen=True, eq=False)
class PIState(FrozenModel):
    """State of the agents' proportional-integral estimators.

    Parameters
    ----------
    estimate, integral : ndarray, (*runs, A, k)
        Each agent's estimate ν of the average input, and its integral η, which starts
        at zero.
    graph : Graph, optional
        The graph of the step that led to this state; None at the start.

    Examples
    --------
    >>> pi_start([[1.0], [3.0]]).integral
    array([[0.],
           [0.]])
    """

    estimate: Annotated[Array, "... A k"]
    integral: Annotated[Array, "... A k"]
    graph: Graph | None = None


@validated
def pi_start(estimate: Annotated[ArrayInput, "... A k"]) -> PIState:
    """Return the state before the first step: initial estimates (*runs, A, k), integrals zero.

    >>> pi_start([[1.0], [3.0]]).estimate.shape
    (2, 1)
    """
    # η starts at zero: the sum of the integrals, which never changes, must vanish. A copy, since
    # the argument may be the user's array.
    return PIState.construct(estimate.copy(), np.zeros_like(estimate))


@validated
def stable_substeps(
    channel: Channel, dt: PositiveFloat, *, alpha: _Gain, a: _Gain, b: _Gain
) -> int:
    r"""Return the number of explicit steps in `dt` with which the estimator is stable.

    An eigenvalue λ of the Laplacian contributes the matrix
    :math:`\begin{pmatrix}-\alpha-a\lambda & b\lambda\\ -b\lambda & 0\end{pmatrix}`. Its eigenvalues
    μ have a negative real part, and a step h is stable when :math:`|1+h\mu|<1` for all.
    The largest λ is at most twice the largest degree (Gershgorin), which agents can
    agree on.

    Parameters
    ----------
    channel, dt
        A channel on the graph; the step, in s, positive.
    alpha, a, b : float
        The gains of :func:`pi_step`.

    Returns
    -------
    int
        A number for which h = `dt` / number is at most half of a bound of stability. At
        the bound a mode oscillates for ever, with half of it the fastest mode does not
        oscillate at all.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> stable_substeps(Channel(graphs.complete(100)), 0.1, alpha=0.2, a=0.4, b=0.04)
    8
    """
    if alpha + a == 0:
        raise ValueError("alpha must be positive if a is 0, or nothing damps, got 0")
    limit = _stable_step(2 * float(channel.graph.in_degree.max()), alpha, a, b)
    return max(1, int(np.ceil(2 * dt / limit)))


def _stable_step(largest: float, alpha: float, a: float, b: float) -> float:
    """Return the step h, in s, below which the modes of all eigenvalues up to `largest` shrink.

    The modes are those of :func:`stable_substeps`, with the gains α, a and b in 1/s.
    """
    # Without links and with alpha = 0 nothing moves, and any step will do.
    damping = max(alpha + a * largest, 1e-300)
    coupling = b * largest
    # μ² + (α + a λ) μ + b² λ² = 0. Real roots lie within [-damping, 0]. Complex ones,
    # where 2 b λ > α + a λ, have the modulus b λ and the real part -(α + a λ)/2, and |1
    # + h μ| < 1 for h < (α + a λ) / (b λ)²; the largest λ is the worst.
    limit = 2 / damping
    if 2 * coupling > damping:
        limit = min(limit, damping / coupling**2)
    return limit


def _warn_if_unstable_step(
    channel: Channel, h: float, alpha: float, a: float, b: float
) -> None:
    """Warn the user of substeps with which the estimates diverge on this graph.

    The substeps are h, in s, and the gains α, a and b, in 1/s, those of :func:`pi_step`.
    """
    graph = channel.graph
    # Most steps are below a bound from the degrees, which costs no eigenvalues.
    if h <= _stable_step(2 / graph.degree_bound_gain, alpha, a, b):
        return
    limit = _stable_step(2 / graph.max_stable_gain, alpha, a, b)
    # A margin for rounding of the eigenvalues.
    if h > limit * (1 + 1e-9):
        warnings.warn(
            f"substeps must be more than {h / limit:.3g} times as many for the estimates to "
            f"stay bounded, got steps of {h:.6g} s for a limit of {limit:.6g} s",
            UnstableGain,
            # The warning points at the call of `pi_step`, above it and its validation.
            stacklevel=4,
        )


@validated
def pi_step(
    state: PIState,
    inputs: PerAgent,
    channel: Channel,
    *,
    dt: PositiveFloat,
    alpha: _Gain,
    a: _Gain,
    b: _Gain,
    rate: PerAgent | None = None,
    substeps: PositiveInt | None = None,
) -> PIState:
    r"""Take one step of the proportional-integral estimator, equation (25) of Zheng et al.

    .. math::
        \dot{\boldsymbol\nu} = -\alpha(\boldsymbol\nu-\mathbf u) - a\mathbf L\boldsymbol\nu
        + b\mathbf L^\top\boldsymbol\eta\;[+\dot{\mathbf u}],\qquad
        \dot{\boldsymbol\eta} = -b\mathbf L\boldsymbol\nu

    Without the term in brackets, as printed, the average of the estimates is a low-pass
    filter of the average input and lags behind a ramp of slope s by exactly s/α. With
    it the estimates follow the average without a lag.

    Parameters
    ----------
    state : PIState
        Not changed.
    inputs : array_like, (*runs, A, k)
        The agents' inputs u at the beginning of the step. Within the step they change
        by `rate`, or not at all.
    channel : Channel
        Links both ways. Each substep is a round of 2k scalars a link. A link that loses
        a message is not used in that round. A second step on the same graph gives a
        :class:`Disconnected` warning if that graph has several components.
    dt : float
        The step, in s.
    alpha, a, b : float
        Gains, 1/s, at least 0: forgetting, proportional, integral.
    rate : array_like, (*runs, A, k), optional
        The inputs' derivative, for the term in brackets.
    substeps : int, optional
        Number of explicit steps; by default that of :func:`stable_substeps`.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel, state = Channel(graphs.path(2)), pi_start([[0.0], [4.0]])
    >>> for _ in range(300):
    ...     state = pi_step(
    ...         state, [[0.0], [4.0]], channel, dt=0.1, alpha=1.0, a=1.0, b=1.0
    ...     )
    >>> state.estimate.ravel().round(6)
    array([2., 2.])
    """
    channel.graph._check_undirected()
    # Parts that stay apart in a fixed graph have an average each. A graph that changes from
    # step to step may be connected over time; one that is used again is taken as fixed.
    if channel.graph is state.graph:
        _warn_if_disconnected(channel)
    if state.estimate.shape != inputs.shape:
        raise ValueError(
            f"state must have shape {inputs.shape}, got {state.estimate.shape}"
        )
    nu = state.estimate
    eta = state.integral
    # The derivative u' of the inputs, and the number of Euler steps.
    slope: Array | float = 0.0 if rate is None else rate
    n = substeps or stable_substeps(channel, dt, alpha=alpha, a=a, b=b)
    if substeps is not None:
        _warn_if_unstable_step(channel, dt / substeps, alpha, a, b)
    h = dt / n
    k = inputs.shape[-1]
    # One exchange of (ν, η) by I - h L, less the values themselves, gives -h L ν and -h L η.
    weights = _laplacian_weights(channel.graph, h)
    for j in range(n):
        pair = np.concatenate([nu, eta], axis=-1)
        change = channel.mix(pair, weights) - pair
        proportional = change[..., :k]
        integral = change[..., k:]
        # ν += h (α (u - ν) + u') - a h L ν + b h L η;  η -= b h L ν, with the old ν in both.
        u = inputs + j * h * slope
        drift = alpha * (u - nu) + slope
        nu = nu + h * drift + a * proportional - b * integral
        eta = eta + b * proportional
    return PIState.construct(nu, eta, channel.graph)
