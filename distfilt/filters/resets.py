"""New beliefs about some components: of a landmark when it is first seen, or after a reset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from ..derivatives import difference_with_error
from ..linalg import factor
from ..validation import (
    Array,
    call_user,
    check_array,
    check_distinct,
    check_positive_semidefinite,
)

if TYPE_CHECKING:
    from .gaussian import GaussianState
    from .states import SensorState

Gaussians = TypeVar("Gaussians", bound="GaussianState")
Members = TypeVar("Members", bound="SensorState")

__all__ = ["Reset", "read_reset", "reset_gaussian", "reset_members"]


class Reset(NamedTuple):
    """The new belief about some components: they become value(x) + e with e ~ N(0, cov)."""

    components: list[int]
    """Their indices, k of them."""
    value: Callable[[Array], Array]
    """Their new values as a function of the whole state, (..., d) to (..., k)."""
    cov: Array
    """The covariance of e, (k, k)."""
    agents: list[int]
    """The agents whose beliefs change."""


def read_reset(
    components: Sequence[object],
    value: object,
    cov: object,
    agents: Sequence[int] | None,
    names: Sequence[str],
    n_agents: int,
) -> Reset:
    """Check the arguments of a reset; components are indices or names.

    >>> read_reset(["b"], [1.0], [[2.0]], None, ("a", "b"), 3).components
    [1]
    """
    indices = [_read_component(component, names) for component in components]
    check_distinct(indices, "components")
    k = len(indices)
    chosen = list(range(n_agents)) if agents is None else [int(a) for a in agents]
    check_distinct(chosen, "agents")
    if not k or not all(0 <= agent < n_agents for agent in chosen):
        raise ValueError(
            f"components must be at least one, and agents below {n_agents}, got "
            f"{list(components)} and {chosen}"
        )
    matrix = check_array(cov, "cov", (k, k))
    check_positive_semidefinite(matrix, "cov")
    # The new values as a function of the state, also if they are constants
    if callable(value):
        return Reset(indices, partial(_call_value, value, k), matrix, chosen)
    constant = check_array(value, "value", (k,))
    return Reset(indices, partial(_repeat_value, constant), matrix, chosen)


def _read_component(component: object, names: Sequence[str]) -> int:
    """Return the index of a component that is given by its index or its name."""
    if isinstance(component, str) and component in names:
        return list(names).index(component)
    # An index that is no whole number stays -1, and is refused; True and False are none either.
    index = -1
    if isinstance(component, int | np.integer) and not isinstance(component, bool):
        index = int(component)
    if 0 <= index < len(names):
        return index
    raise ValueError(
        f"components must be names ({', '.join(names)}) or indices below {len(names)}, got "
        f"{component!r}"
    )


def _call_value(function: Callable[[Array], Array], k: int, x: Array) -> Array:
    """Return the user's new values (..., k) of states (..., d), checked."""
    result = call_user(function, x.copy())
    return check_array(result, "value", (*x.shape[:-1], k))


def _repeat_value(constant: Array, x: Array) -> Array:
    """Return new values (k,) that do not depend on the states (..., d), for each of them."""
    return np.broadcast_to(constant, (*x.shape[:-1], constant.size))


def reset_gaussian(state: Gaussians, reset: Reset) -> Gaussians:
    """Return a Gaussian state with new present components; the past keeps the former ones."""
    d = state.dim
    # Index of the chosen agents in means (*runs, A, d)
    rows = (..., reset.agents, slice(None))
    present = state.means[rows]
    # The derivative of the new values at the means, (*runs, agents, k, d), by differences
    slope, _error = difference_with_error(reset.value, present, np.subtract)
    means = state.joint_means.copy()
    covs = state.joint_covariances.copy()
    # x' = T x + e for the joint state x, whose first d components are the present: T is the
    # identity, with the derivative of the new values in their rows.
    size = means.shape[-1]
    transform = np.zeros((*slope.shape[:-2], size, size))
    transform[...] = np.eye(size)
    transform[..., reset.components, :] = 0.0
    transform[..., reset.components, :d] = slope
    noise = np.zeros((size, size))
    noise[np.ix_(reset.components, reset.components)] = reset.cov
    old = covs[..., reset.agents, :, :]
    new = means[rows]
    new[..., reset.components] = reset.value(present)
    means[rows] = new
    covs[..., reset.agents, :, :] = transform @ old @ transform.mT + noise
    return state.replace(joint_means=means, joint_covariances=covs)


def reset_members(
    state: Members,
    reset: Reset,
    draw_normal: Callable[[tuple[int, ...], np.random.Generator], Array],
    rng: np.random.Generator,
) -> Members:
    """Return a state of members with new present components; the past keeps the former ones.

    The belief about the present is one array of members (*runs, A, N, d). Those about earlier times
    are in a field of their own, the state's history, which stays as it is.

    `draw_normal` draws standard normal numbers for all agents; with one agent's only, an axis of
    length 1, all agents have the same draws.
    """
    name, _axes = state.belief_field
    members = state.belief.copy()
    # e = L z with cov = L Lᵀ, as rows. It is drawn for all agents, so that an agent's draws do not
    # depend on which are chosen.
    shape = (*members.shape[:-1], len(reset.components))
    normal = draw_normal(shape, rng)
    # Draws that all agents have in common are repeated for each of them.
    noise = np.broadcast_to(normal @ factor(reset.cov).T, shape)
    # Indexing by a list of agents makes a copy, which is put back in the end.
    chosen = members[..., reset.agents, :, :]
    values = reset.value(chosen) + noise[..., reset.agents, :, :]
    chosen[..., reset.components] = values
    members[..., reset.agents, :, :] = chosen
    return state.replace(rng=rng, **{name: members})
