"""Agreement as time goes on: inputs that move, meetings at random, news only when there is some."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    Mask,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Rng,
    validated,
)
from .channel import Channel, PerAgent, fusion_rule
from .consensus import _alone
from .weights import _laplacian, metropolis

__all__ = [
    "PIState",
    "event_triggered",
    "flooding",
    "gossip_consensus",
    "pi_start",
    "pi_step",
    "stable_substeps",
]

_Gain = Annotated[float, Bounds(at_least=0, at_most=1e100)]


@dataclass(frozen=True, eq=False)
class PIState(FrozenModel):
    """What the agents of a proportional-integral estimator remember.

    Parameters
    ----------
    estimate, integral : ndarray, (*runs, A, k)
        Each agent's estimate ν of the average input, and its integrator η, which starts at zero.

    Examples
    --------
    >>> pi_start([[1.0], [3.0]]).integral
    array([[0.],
           [0.]])
    """

    estimate: Annotated[Array, "... A k"]
    integral: Annotated[Array, "... A k"]


@validated
def pi_start(estimate: Annotated[Array, "... A k"]) -> PIState:
    """The state before the first step: any first estimates, (*runs, A, k), no integral.

    >>> pi_start([[1.0], [3.0]]).estimate.shape
    (2, 1)
    """
    return PIState.construct(estimate.copy(), np.zeros_like(estimate))


@validated
def stable_substeps(
    channel: Channel, dt: PositiveFloat, *, alpha: _Gain, a: _Gain, b: _Gain
) -> int:
    r"""How many explicit steps make up `dt` so that the estimator is stable.

    An eigenvalue λ of the Laplacian contributes the matrix
    :math:`\begin{pmatrix}-\alpha-a\lambda & b\lambda\\ -b\lambda & 0\end{pmatrix}`. Its eigenvalues
    μ have a negative real part, and a step h is stable when :math:`|1+h\mu|<1` for all. The
    largest λ is bounded by twice the largest degree (Gershgorin), which agents can agree on.

    Parameters
    ----------
    channel, dt
        For the graph; the step that is wanted, in s, positive.
    alpha, a, b : float
        The gains of :func:`pi_step`.

    Returns
    -------
    int
        A number for which h = `dt` / number is half of a bound of stability or less:
        at the bound a mode swings for ever, with half of it the fastest mode does not swing at all.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> stable_substeps(Channel(graphs.complete(100)), 0.1, alpha=0.2, a=0.4, b=0.04)
    8
    """
    bound = 2 * float(channel.graph.in_degree.max())
    rate = max(alpha + a * bound, 1e-300)  # without links nothing may move at all
    if alpha + a == 0:
        raise ValueError("alpha must be some damping, alpha or a above 0, got both 0")
    # Real eigenvalues lie within [-rate, 0]; complex ones, where 2 b λ exceeds α + a λ, have the
    # modulus b λ and the real part -(α + a λ)/2, and the largest λ is the worst.
    spring = b * bound
    limit = 2 / rate if 2 * spring <= rate else min(2 / rate, rate / spring**2)
    return max(1, int(np.ceil(2 * dt / limit)))


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
    ...     state = pi_step(
    ...         state, [[0.0], [4.0]], channel, dt=0.1, alpha=1.0, a=1.0, b=1.0
    ...     )
    >>> state.estimate.ravel().round(6)
    array([2., 2.])
    """
    channel.graph._undirected()
    if state.estimate.shape != inputs.shape:
        raise ValueError(
            f"state must have shape {inputs.shape}, got {state.estimate.shape}"
        )
    nu = state.estimate
    eta = state.integral
    u = inputs
    slope: Array | float = 0.0 if rate is None else rate
    n = substeps or stable_substeps(channel, dt, alpha=alpha, a=a, b=b)
    h = dt / n
    k = u.shape[-1]
    # One combination gives -h L of both: the weights I - h L less the values themselves.
    weights = _laplacian(channel.graph, h)
    combine = channel.mix
    for j in range(n):
        both = np.concatenate([nu, eta], axis=-1)
        change = combine(both, weights) - both
        pull = change[..., :k]
        spring = change[..., k:]
        now = u + j * h * slope
        moved = nu + h * (alpha * (now - nu) + slope) + a * pull - b * spring
        nu = moved
        eta = eta + b * pull
    return PIState.construct(nu, eta)


@fusion_rule("vectors")
@validated
def gossip_consensus(
    values: PerAgent, channel: Channel, *, rounds: PositiveInt, rng: Rng
) -> Array:
    r"""Average in pairs: in each round one agent wakes and meets one neighbour, both drawn evenly.

    .. math:: \mathbf x_i,\mathbf x_j\leftarrow\tfrac12(\mathbf x_i+\mathbf x_j)

    Nobody keeps a clock, and the average is kept exactly. The mean squared disagreement shrinks in
    each round by at least the second largest eigenvalue of the mean matrix,
    :func:`distfilt.network.weights.gossip`.

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        Links both ways, no delay. Where one of a pair's two messages is lost, which
        acknowledgements tell, the pair stays as it is.
    rounds : int
        How many meetings; 2 messages of k scalars each.
    rng : numpy.random.Generator
        Draws the pairs. All runs of a batch meet in the same order.

    Notes
    -----
    S. Boyd, A. Ghosh, B. Prabhakar and D. Shah, IEEE Transactions on Information Theory 52 (2006)
    2508-2530.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.ring(4))
    >>> gossip_consensus(
    ...     [[0.0], [2.0], [4.0], [6.0]],
    ...     channel,
    ...     rounds=200,
    ...     rng=np.random.default_rng(1),
    ... ).round(6).ravel()
    array([3., 3., 3., 3.])
    >>> channel.ledger.messages.sum()
    np.int64(400)

    An agent without a neighbour wakes in vain:

    >>> channel = Channel(graphs.Graph.from_edges(3, [(1, 2)]))
    >>> gossip_consensus(
    ...     [[0.0], [2.0], [4.0]], channel, rounds=9, rng=np.random.default_rng(1)
    ... ).ravel()
    array([0., 3., 3.])
    >>> channel.ledger.messages
    array([0, 6, 6])
    """
    channel.graph._undirected()
    graph = channel.graph
    carry = channel.send_on_links
    out = values.copy()
    awake = rng.integers(graph.n_agents, size=rounds)
    chosen = (rng.random(rounds) * graph.in_degree[awake]).astype(np.int64)
    faulty = not channel.faults.none
    packet = np.zeros((*channel.runs, graph.senders.size, out.shape[-1]))
    links = np.zeros(graph.senders.size, dtype=bool)
    for i, nth in zip(awake.tolist(), chosen.tolist(), strict=True):
        if graph.in_degree[i] == 0:
            continue
        link = int(graph.links.indptr[i]) + nth
        pair = [link, int(graph.reverse[link])]
        links[pair] = True
        packet[..., pair, :] = out[..., graph.senders[pair], :]
        heard = carry(packet, links=links, acknowledged=faulty)[..., pair, :]
        links[pair] = False
        met = ~np.isnan(heard).any(axis=(-2, -1), keepdims=True)
        ends = graph.receivers[pair]
        out[..., ends, :] = np.where(
            met, 0.5 * (out[..., ends, :] + heard), out[..., ends, :]
        )
    return out


@fusion_rule("vectors")
@validated
def event_triggered(
    values: PerAgent,
    channel: Channel,
    *,
    rounds: PositiveInt,
    threshold: NonNegativeFloat,
    decay: Annotated[float, Bounds(above=0, at_most=1)] = 1.0,
) -> Array:
    r"""Average, but send only what has moved by more than a threshold since it was sent last.

    .. math:: \mathbf x_i\leftarrow\mathbf x_i
        +\sum_j w_{ij}(\hat{\mathbf x}_j-\hat{\mathbf x}_i)

    with the values :math:`\hat{\mathbf x}` that went over the link last; both its ends know both.
    The Metropolis weights are symmetric: they keep the average exactly, also when messages are
    lost.

    Parameters
    ----------
    values : array_like, (A, k)
        One vector per agent.
    channel : Channel
        Links both ways, a single run, no delay. Acknowledgements tell what was lost, and it is sent
        again.
    rounds : int
        How many rounds.
    threshold : float
        An agent sends its value if some component has moved by more than this; at least 0.
    decay : float
        Factor of the threshold from round to round, in (0, 1]. Below 1 the agents agree in the
        limit. With 1 their Euclidean distance from the average is in the end at most
        :math:`\sqrt{Ak}\,\|\mathbf I-\mathbf W\|\,c/(1-\rho)`, where c is the threshold and ρ the
        second largest modulus of the weights' eigenvalues.

    Notes
    -----
    D. V. Dimarogonas, E. Frazzoli and K. H. Johansson, IEEE Transactions on Automatic Control 57
    (2012) 1291-1297, in discrete time.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.ring(6))
    >>> out = event_triggered(
    ...     np.arange(6.0)[:, None], channel, rounds=40, threshold=0.05
    ... )
    >>> (
    ...     bool(np.abs(out - 2.5).max() < 0.1),
    ...     bool(channel.ledger.messages.sum() < 40 * 12),
    ... )
    (True, True)
    """
    _alone(channel)
    channel.graph._undirected()
    graph = channel.graph
    carry = channel.send_on_links
    x = values
    w = metropolis(graph)
    faulty = not channel.faults.none
    # What link e delivered last; its sender knows by the acknowledgement.
    known = np.full((graph.senders.size, x.shape[1]), np.nan)
    for _ in range(rounds):
        now = x[graph.senders]
        moved = ~(np.abs(now - known).max(axis=1) <= threshold)
        heard = carry(now, links=moved, acknowledged=faulty)
        known = np.where(np.isnan(heard), known, heard)
        gap = w.links[:, None] * (known - known[graph.reverse])
        x = x + graph.incidence @ np.where(np.isnan(gap), 0.0, gap)
        threshold *= decay
    return x


@validated
def flooding(
    values: PerAgent, channel: Channel, *, rounds: PositiveInt | None = None
) -> tuple[Array, Mask]:
    """Every agent passes on each value when it first hears of it: the rival of all averaging.

    Parameters
    ----------
    values : array_like, (A, k)
        One vector per agent.
    channel : Channel
        A single run. k + 1 scalars for each value passed on; a loss is not made good.
    rounds : int, optional
        By default until nobody has anything new to say, and so nobody speaks.

    Returns
    -------
    average : ndarray, (A, k)
        Of all that each agent knows.
    known : ndarray of bool, (A, A)
        Whose values agent i knows, ``known[i]``.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.path(3))
    >>> flooding([[0.0], [3.0], [6.0]], channel)[0].ravel()
    array([3., 3., 3.])
    >>> channel.ledger.scalars
    array([ 6, 12,  6])
    """
    _alone(channel)
    size = channel.graph.n_agents
    table = np.concatenate([np.arange(size)[:, None], values], axis=1)
    known = news = np.eye(size, dtype=bool)
    most = rounds or 2 * size
    while news.any() and most:
        most -= 1
        inbox = channel.broadcast([table[new] if new.any() else None for new in news])
        told = np.zeros_like(known)
        for mine, box in zip(told, inbox, strict=True):
            for rows in box.values():
                mine[rows[:, 0].astype(int)] = True
        news = told & ~known
        known = known | news
    return np.array([values[whose].mean(axis=0) for whose in known]), known
