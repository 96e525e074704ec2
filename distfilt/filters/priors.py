"""Priors of any kind, as a Gaussian's moments, as members, or as mixtures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from ..ensembles import draw, sample_covariance
from ..mixtures import GaussianMixture
from ..periods import Periods, fold, fold_torn
from ..validation import (
    Array,
    call_user,
    check_array,
    check_positive_definite,
    check_positive_semidefinite,
)

if TYPE_CHECKING:
    from typing import Protocol

    class _Distribution(Protocol):
        """A frozen distribution, such as scipy's multivariate_normal(mean, cov)."""

        def rvs(
            self, size: int = ..., random_state: np.random.Generator = ...
        ) -> Array: ...

    _OnePrior = (
        tuple[ArrayLike, ArrayLike]
        | ArrayLike
        | _Distribution
        | GaussianMixture
        | Callable[..., ArrayLike]
    )
    Prior = _OnePrior | Sequence[_OnePrior]
else:
    # Checked by the functions below, which convert it.
    Prior = object

__all__ = [
    "Prior",
    "draw_members",
    "moments_by_agent",
    "prior_mixtures",
    "prior_moments",
    "split_by_agent",
]


def _is_mean_and_cov(prior: object) -> TypeGuard[tuple[ArrayLike, ArrayLike]]:
    """Whether a prior is (mean, cov), and not a list of two members."""
    if not isinstance(prior, tuple | list):
        return False
    if any(_is_pair(entry) for entry in prior):
        raise ValueError("prior must be one for all agents, got a list of (mean, cov)")
    if len(prior) != 2:
        return False
    # Of a list of two the covariance has one axis more than the mean, two members equally many.
    return isinstance(prior, tuple) or _count_axes(prior[0]) < _count_axes(prior[1])


def _is_pair(entry: object) -> TypeGuard[Sequence[ArrayLike]]:
    """Whether an entry of a list is (mean, cov), a vector and a matrix.

    >>> _is_pair(([0.0], [[1.0]])), _is_pair([[1.0, 0.0], [0.0, 1.0]])
    (True, False)
    """
    if not isinstance(entry, tuple | list) or len(entry) != 2:
        return False
    return _count_axes(entry[0]) < 2 and _count_axes(entry[1]) == 2


def _count_axes(value: ArrayLike) -> int:
    """Return the number of an array's axes; -1 for entries of different lengths."""
    try:
        return np.ndim(value)
    except ValueError:
        return -1


def prior_moments(
    prior: Prior,
    dim: int,
    definiteness: str = "semidefinite",
    *,
    periods: Periods = (),
) -> tuple[Array, Array]:
    """Return the mean (d,) and covariance (d, d) of a prior that has them.

    Parameters
    ----------
    prior : tuple, distribution, GaussianMixture or array_like
        As for :meth:`distfilt.filters.Filter.start`.
    dim : int
        Size d of the state.
    definiteness : {"semidefinite", "definite"}
        The condition that the covariance has to meet.
    periods : tuple
        The model's periods: angles of members and mixtures are shifted by whole periods first, so
        that they are near each other.

    Examples
    --------
    >>> from scipy.stats import multivariate_normal
    >>> prior_moments(multivariate_normal([1.0], [[4.0]]), 1)
    (array([1.]), array([[4.]]))

    Members on both sides of a cut:

    >>> mean, cov = prior_moments([[6.2], [0.1], [6.1], [0.2]], 1, periods=(2 * np.pi,))
    >>> mean.round(2), cov.round(2)
    (array([0.01]), array([[0.03]]))
    """
    mean, cov = _find_moments(prior, dim, periods)
    mean = check_array(np.atleast_1d(mean), "prior", (dim,))
    cov = check_array(cov, "prior")
    # In one dimension a scalar variance serves as covariance.
    is_variance = dim == cov.size == 1
    if cov.shape != (dim, dim) and not is_variance:
        raise ValueError(
            f"prior must have a covariance of shape {(dim, dim)}, got {cov.shape}"
        )
    cov = cov.reshape(dim, dim)
    if definiteness == "definite":
        constant = np.flatnonzero(cov.diagonal() == 0)
        if constant.size:
            raise ValueError(
                "prior must be a positive definite matrix here, got the variance 0 of "
                f"component {constant[0]}: give a known constant a small variance, or use a "
                "GaussianFilter or members"
            )
        check_positive_definite(cov, "prior")
    else:
        check_positive_semidefinite(cov, "prior")
    return mean, cov


def _find_moments(
    prior: Any, dim: int, periods: Periods
) -> tuple[ArrayLike, ArrayLike]:
    """Return the mean and covariance of a prior, unchecked."""
    if isinstance(prior, GaussianMixture):
        # Angles within half a period of their circular mean
        means = fold(prior.means, periods, prior.weights)
        return GaussianMixture(prior.weights, means, prior.covs).moments()
    if hasattr(prior, "rvs"):
        # A scalar distribution of scipy has a variance; either may be a method.
        mean = prior.mean
        cov: Any = getattr(prior, "cov", None)
        if cov is None:
            cov = getattr(prior, "var", None)
        return mean() if callable(mean) else mean, cov() if callable(cov) else cov
    if _is_mean_and_cov(prior):
        return prior
    if callable(prior) or np.ndim(prior) != 2:
        kind = "a function" if callable(prior) else type(prior).__name__
        raise ValueError(
            f"prior must be (mean, cov), or have a mean and a covariance, got {kind}"
        )
    # Members: their sample moments, which need angles that are not cut at the end of a period.
    members = check_array(prior, "prior", ("N", dim))
    if len(members) <= dim:
        raise ValueError(f"prior must have more than {dim} members, got {len(members)}")
    members = fold_torn(members, periods)
    return members.mean(axis=0), sample_covariance(members)


def draw_members(
    prior: Prior,
    members: int,
    leading: tuple[int, ...],
    dim: int,
    rng: np.random.Generator,
) -> Array:
    """Draw members (*leading, N, d) of a prior of any kind that :meth:`Filter.start` accepts.

    >>> draw_members(([0.0], [[1.0]]), 5, (2,), 1, np.random.default_rng(0)).shape
    (2, 5, 1)
    """
    shape = (*leading, members, dim)
    if _is_mean_and_cov(prior):
        mean, cov = prior_moments(prior, dim)
        return draw(mean, cov, members, rng=rng, leading=leading)
    source: Any = prior
    if hasattr(source, "rvs"):
        # scipy's name of the generator, and this package's.
        keyword = "rng" if isinstance(source, GaussianMixture) else "random_state"
        drawn = source.rvs(math.prod(shape[:-1]), **{keyword: rng})
        # Draws of one component may come without an axis for it.
        return check_array(drawn.reshape(*shape[:-1], -1), "prior", shape)
    if callable(source):
        source = call_user(source, members, rng=rng, leading=leading)
    ensemble = check_array(source, "prior", (..., members, dim))
    if ensemble.shape != shape and ensemble.shape != shape[-2:]:
        raise ValueError(
            f"prior must have shape {shape} or {shape[-2:]}, got {ensemble.shape}"
        )
    # One ensemble serves all runs and agents; a copy, since the filter updates in place.
    return np.broadcast_to(ensemble, shape).copy()


def split_by_agent(prior: Prior, dim: int, n_agents: int) -> list[_OnePrior] | None:
    """Return the priors of a list with one for each agent; None if the prior is one for all.

    A list of priors has ``(mean, cov)`` pairs, distributions, mixtures, functions or arrays of
    members (N, d); pairs may be in a tuple.

    >>> normal = ([0.0, 0.0], np.eye(2))
    >>> (
    ...     split_by_agent(normal, 2, 2) is None,
    ...     len(split_by_agent([normal, normal], 2, 2)),
    ... )
    (True, 2)
    >>> split_by_agent([normal], 2, 2)
    Traceback (most recent call last):
    ValueError: prior must be one for all or a list with one for each of 2 agents, got 1
    """
    entries: list[Any] = list(prior) if isinstance(prior, list | tuple) else []
    # A tuple is a prior (mean, cov), unless its entries are such pairs.
    is_prior_of_all = type(prior) is tuple and not all(map(_is_pair, entries))
    if not entries or is_prior_of_all:
        return None
    are_priors = [_is_prior(entry, dim) for entry in entries]
    # In a list [mean, cov] of arrays only the second has two axes, as members (N, d) have: such a
    # list is one prior for all.
    are_arrays = all(isinstance(e, np.ndarray) for e in entries)
    if are_arrays and not all(are_priors) or not any(are_priors):
        return None
    if len(entries) != n_agents:
        raise ValueError(
            f"prior must be one for all or a list with one for each of {n_agents} agents, "
            f"got {len(entries)}"
        )
    for agent, entry in enumerate(entries):
        if not _is_prior(entry, dim):
            raise ValueError(
                f"prior[{agent}] must be a prior as the other agents have one, got "
                f"{type(entry).__name__}"
            )
    return entries


def _is_prior(entry: object, dim: int) -> bool:
    """Whether an entry of a list is a prior by itself, and not a member of one."""
    if isinstance(entry, GaussianMixture) or hasattr(entry, "rvs") or callable(entry):
        return True
    if _is_pair(entry):
        return True
    if type(entry) is tuple:
        # A member of one component is no pair of numbers, but (mean, variance) may be.
        return len(entry) == 2 and dim == 1
    return isinstance(entry, np.ndarray) and entry.ndim == 2


def moments_by_agent(
    prior: Prior,
    dim: int,
    n_agents: int,
    definiteness: str = "semidefinite",
    *,
    periods: Periods = (),
) -> tuple[Array, Array]:
    """Return mean and covariance of a prior, (d,) and (d, d), with an axis of agents for a list.

    >>> means, covs = moments_by_agent([([0.0], [[1.0]]), ([5.0], [[2.0]])], 1, 2)
    >>> means.shape, covs.shape
    ((2, 1), (2, 1, 1))
    """
    priors = split_by_agent(prior, dim, n_agents)
    if priors is None:
        return prior_moments(prior, dim, definiteness, periods=periods)
    moments = [prior_moments(one, dim, definiteness, periods=periods) for one in priors]
    means = np.array([mean for mean, _cov in moments])
    return means, np.array([cov for _mean, cov in moments])


def prior_mixtures(
    prior: Prior, dim: int, n_agents: int, *, periods: Periods = ()
) -> tuple[GaussianMixture, ...]:
    """Return a mixture for each agent, of one prior for all or of a list with one each.

    >>> [mixture.n_components for mixture in prior_mixtures(([0.0], [[1.0]]), 1, 2)]
    [1, 1]
    """
    # One prior for all agents is that of each.
    priors: list[Any] = split_by_agent(prior, dim, n_agents) or [prior] * n_agents
    mixtures = []
    for one in priors:
        if isinstance(one, GaussianMixture):
            mixture = one
        else:
            # A component needs a density, and so a definite covariance.
            moments = prior_moments(one, dim, "definite", periods=periods)
            mixture = GaussianMixture.gaussian(*moments)
        if mixture.dim != dim:
            raise ValueError(f"prior must have dimension {dim}, got {mixture.dim}")
        mixtures.append(mixture)
    return tuple(mixtures)
