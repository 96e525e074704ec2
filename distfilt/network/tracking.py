"""Dynamic average consensus: agents follow the average of inputs that change in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, count, instance, number
from . import weights as weighting
from .channel import Channel
from .consensus import _values
from .weights import Weights

__all__ = ["PIState", "first_order", "pi_start", "pi_step", "stable_substeps"]


@dataclass(frozen=True, eq=False)
class PIState:
    """What the agents of a proportional-integral estimator remember.

    Parameters
    ----------
    estimate : ndarray, (*runs, A, k)
        Each agent's estimate ν of the average input.
    integral : ndarray, (*runs, A, k)
        Each agent's integrator η; it starts at zero.

    Examples
    --------
    >>> pi_start([[1.0], [3.0]]).integral
    array([[0.],
           [0.]])
    """

    estimate: Array
    integral: Array

    def __post_init__(self) -> None:
        estimate = array(self.estimate, "estimate", (..., "A", "k"))
        array(self.integral, "integral", estimate.shape)


def pi_start(estimate: ArrayLike) -> PIState:
    """The state before the first step: any first estimates, (*runs, A, k), no integral.

    >>> pi_start([[1.0], [3.0]]).estimate.shape
    (2, 1)
    """
    first = array(estimate, "estimate", (..., "A", "k"))
    return PIState(first.copy(), np.zeros_like(first))


def stable_substeps(
    channel: Channel, dt: float, *, alpha: float, a: float, b: float, safety: float = 2.0
) -> int:
    r"""How many explicit steps make up `dt` so that the estimator is stable.

    An eigenvalue λ of the Laplacian contributes the matrix
    :math:`\begin{pmatrix}-\alpha-a\lambda & b\lambda\\ -b\lambda & 0\end{pmatrix}`. Its eigenvalues
    μ have a negative real part, and a step h is stable when
    :math:`|1+h\mu|<1` for all of them. The
    largest λ is bounded by twice the largest degree (Gershgorin), which agents can agree on.

    Parameters
    ----------
    channel, dt
        For the graph; the step that is wanted, in s, positive.
    alpha, a, b : float
        The gains of :func:`pi_step`.
    safety : float
        Factor, at least 1, by which the steps are shorter than the bound of stability, at which a
        mode would swing for ever. With 2 the fastest mode does not swing at all.

    Returns
    -------
    int
        At least 1; the smallest number for which h = `dt` / number is the bound / `safety` or less.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> stable_substeps(Channel(graphs.complete(100)), 0.1, alpha=0.2, a=0.4, b=0.04)
    8
    """
    instance(channel, "channel", Channel)
    step, factor = number(dt, "dt", above=0), number(safety, "safety", at_least=1)
    named = ((alpha, "alpha"), (a, "a"), (b, "b"))
    gains = [number(g, n, at_least=0, at_most=1e100) for g, n in named]
    bound = 2 * float(channel.graph.degrees.max())
    rate = gains[0] + gains[1] * bound
    if rate == 0:
        raise ValueError("alpha: needs some damping, alpha or a above 0, got both 0")
    # Real eigenvalues lie within [-rate, 0]; complex ones, where 2 b λ exceeds α + a λ, have the
    # modulus b λ and the real part -(α + a λ)/2, and the largest λ is the worst.
    spring = gains[2] * bound
    limit = 2 / rate if 2 * spring <= rate else min(2 / rate, rate / spring**2)
    return max(1, int(np.ceil(factor * step / limit)))


def pi_step(
    state: PIState, inputs: ArrayLike, channel: Channel, *, dt: float, alpha: float, a: float,
    b: float, rate: ArrayLike | None = None, substeps: int | None = None,
) -> PIState:
    r"""One step of the proportional-integral estimator, equation (25) of Zheng et al.

    .. math::
        \dot{\boldsymbol\nu} = -\alpha(\boldsymbol\nu-\mathbf u) - a\mathbf L\boldsymbol\nu
        + b\mathbf L^\top\boldsymbol\eta\;[+\dot{\mathbf u}],\qquad
        \dot{\boldsymbol\eta} = -b\mathbf L\boldsymbol\nu

    Without the term in brackets, as printed, the average of the estimates is a low-pass filter of
    the average input and lags behind a ramp of slope s by exactly s/α. With it the average is
    followed without a lag.

    Parameters
    ----------
    state : PIState
        Not changed.
    inputs : array_like, (*runs, A, k)
        What the agents measure at the beginning of the step, u. Within the step it moves on by
        `rate`, or stays.
    channel : Channel
        Links both ways. Each substep is a round of 2k scalars a link. A link of which a message is
        lost rests for that round.
    dt : float
        The step, in s.
    alpha, a, b : float
        Gains, 1/s, at least 0: forgetting, proportional, integral.
    rate : array_like, (*runs, A, k), optional
        The inputs' derivative, for the term in brackets.
    substeps : int, optional
        Explicit steps that make up `dt`; by default as many as stability asks for.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel, state = Channel(graphs.path(2)), pi_start([[0.0], [4.0]])
    >>> for _ in range(300):
    ...     state = pi_step(state, [[0.0], [4.0]], channel, dt=0.1, alpha=1.0, a=1.0, b=1.0)
    >>> state.estimate.ravel().round(6)
    array([2., 2.])
    """
    instance(state, "state", PIState)
    instance(channel, "channel", Channel)
    if channel.graph.directed:
        raise ValueError("channel: needs links both ways to keep the sum, got one-way links")
    shape = (*channel.runs, channel.graph.size, state.estimate.shape[-1])
    nu = array(state.estimate, "state", shape)
    eta = state.integral
    u = array(inputs, "inputs", shape)
    slope = 0.0 if rate is None else array(rate, "rate", shape)
    least = stable_substeps(channel, dt, alpha=alpha, a=a, b=b)
    n = least if substeps is None else count(substeps, "substeps")
    h, k = dt / n, u.shape[-1]
    # One combination gives -h L of both: the weights I - h L less the values themselves.
    weights = weighting.laplacian(channel.graph, h)
    for j in range(n):
        both = np.concatenate([nu, eta], axis=-1)
        change = channel.combine(both, weights) - both
        pull, spring = change[..., :k], change[..., k:]
        now = u + j * h * slope
        moved = nu + h * (alpha * (now - nu) + slope) + a * pull - b * spring
        nu, eta = moved, eta + b * pull
    return PIState(nu, eta)


def first_order(
    estimates: ArrayLike, inputs: ArrayLike, previous: ArrayLike, channel: Channel, *,
    weights: Weights | None = None, lost: str = "mutual",
) -> Array:
    r"""One round of first-order dynamic average consensus.

    .. math:: \mathbf x \leftarrow \mathbf W\mathbf x + \mathbf u_{k+1} - \mathbf u_k

    The average of the estimates equals the average of the inputs in every round if it did at the
    start, as it does for estimates that start at the inputs.

    Parameters
    ----------
    estimates, inputs, previous : array_like, (*runs, A, k)
        One per agent: what they believe, measure now, and measured a round ago.
    channel, weights, lost
        As for :func:`distfilt.network.average`.

    Notes
    -----
    M. Zhu and S. Martinez, Automatica 46 (2010) 322-329.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.path(2))
    >>> first_order([[0.0], [2.0]], [[1.0], [3.0]], [[0.0], [2.0]], channel).ravel()
    array([2., 2.])
    """
    x = _values(estimates, channel, "estimates")
    change = array(inputs, "inputs", x.shape) - array(previous, "previous", x.shape)
    w = weighting.metropolis(channel.graph) if weights is None else weighting.keeping(weights)
    return channel.combine(x, w, lost=lost) + change
