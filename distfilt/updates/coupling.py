"""The optimal-transport update: likelihoods weigh the members, a coupling levels the weights."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, choice, count, flags, instance, number
from ..coupling import SOLVERS
from ..coupling.solvers import _solver
from ..coupling.transform import _normalised, _rejuvenated, _transform
from ..network import Channel
from ..network.consensus import average, finite_time
from .door import update

__all__ = ["ensemble_transform", "transform_by_agreement"]


@update
def ensemble_transform(
    ensemble: Array,
    predicted: Array,
    observed: Array,
    noise: Array,
    *,
    rng: np.random.Generator,
    solver: str = "network",
    regularisation: float = 0.01,
    correct: bool = False,
    rejuvenation: float = 0.0,
    inside: Callable[[Array], Array] | None = None,
) -> Array:
    r"""Weigh the members by their likelihoods and transport the weights to equal ones, (3)-(5).

    Reich's ensemble transform particle filter: nothing is Gaussian but the noise of the reading,
    and nothing is drawn.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Forecast members.
    predicted : array_like, (..., N, m)
        What they would observe, without noise.
    observed : array_like, (..., m)
        The observation y*.
    noise : array_like, (m, m) or (..., m, m)
        Its covariance.
    rng : numpy.random.Generator
        Used for `rejuvenation` only.
    solver, regularisation
        As for :func:`distfilt.coupling.plan`.
    correct : bool
        Give the members the weighted covariance too.
    rejuvenation : float
        h of :func:`distfilt.coupling.rejuvenated`; 0 draws nothing.
    inside : callable, optional
        ``inside(ensemble) -> bool``, (..., N): members that are not get no weight.

    Returns
    -------
    ndarray, (..., N, d)
        The mean is the weighted mean to rounding.

    Raises
    ------
    ValueError
        If no member is `inside`.
    SolverError
        If a linear programme is not solved.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((400, 1))
    >>> posterior = ensemble_transform(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    solve = _solver(choice(solver, "solver", SOLVERS), regularisation)
    h = number(rejuvenation, "rejuvenation", at_least=0)
    logs = log_likelihood(predicted, observed, noise)
    if inside is not None:
        good = flags(callable_(inside, "inside")(ensemble.copy()), "inside", logs.shape)
        if not good.any(axis=-1).all():
            raise ValueError("inside: needs a member inside, got an ensemble without any")
        logs = np.where(good, logs, -np.inf)
    out = _transform(ensemble, _normalised(logs), solve, correct=instance(correct, "correct", bool))
    return _rejuvenated(out, ensemble, h, rng) if h else out


def log_likelihood(predicted: Array, observed: Array, noise: Array) -> Array:
    """Log density of the observation for each member, (..., N), up to a constant."""
    gap = np.swapaxes(observed[..., None, :] - predicted, -1, -2)
    white = np.linalg.solve(np.linalg.cholesky(noise), gap)
    return np.asarray(-0.5 * (white * white).sum(axis=-2))


def transform_by_agreement(
    ensembles: ArrayLike,
    log_likelihoods: ArrayLike,
    channel: Channel,
    *,
    rounds: int | None = None,
    solver: str = "network",
    correct: bool = False,
) -> Array:
    r"""Agents with one particle set in common agree on its weights, then each transports alone.

    The likelihood of independent readings is a product, so the log-likelihood of all is A times
    the average of the agents' own, and averaging is what a network can do. Agents whose sums agree
    to the last digits compute the same transform and keep the particle set in common.

    Parameters
    ----------
    ensembles : array_like, (*runs, A, N, d)
        Every agent's copy of the set. Without process noise, or with noise drawn from a seed that
        all know, the copies stay equal.
    log_likelihoods : array_like, (*runs, A, N)
        What each agent's own reading says of each member; zeros for an agent that saw nothing.
    channel : Channel
        The door between agents: N scalars a link and round.
    rounds : int, optional
        Rounds of Metropolis averaging; exact finite-time averaging by default, which needs a
        connected graph, links both ways and no faults.
    solver, correct
        As for :func:`ensemble_transform`.

    Returns
    -------
    ndarray, (*runs, A, N, d)

    Raises
    ------
    ValueError
        If shapes do not fit the channel, or it does not allow the agreement.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> x = np.broadcast_to([[0.0], [1.0], [2.0]], (2, 3, 1))
    >>> seen = np.array([[0.0, -1.0, -4.0], [0.0, -0.5, -1.0]])
    >>> channel = Channel(graphs.path(2))
    >>> after = transform_by_agreement(x, seen, channel)
    >>> bool((after[0] == after[1]).all()), channel.ledger.rounds
    (True, 1)
    """
    door = instance(channel, "channel", Channel)
    agents = door.graph.size
    x = array(ensembles, "ensembles", (*door.runs, agents, "N", "d"))
    logs = array(log_likelihoods, "log_likelihoods", x.shape[:-1])
    full = instance(correct, "correct", bool)
    solve = _solver(choice(solver, "solver", SOLVERS), 0.01)
    if rounds is None:
        shared = finite_time(logs, door)
    else:
        shared = average(logs, door, rounds=count(rounds, "rounds"))
    return _transform(x, _normalised(agents * shared), solve, correct=full)
