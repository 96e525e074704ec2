"""Beliefs about times between two steps, for delayed observations of times never stepped to.

A state x(τ) between two kept ones is Gaussian given them, and then independent of all others and of
what was observed so far. With the model's steps from t₀ to τ and from τ to t₁, linear about the
earlier state, x(τ) = f(x₀) + w with w ~ N(0, Q₁) and x₁ = F₂ x(τ) + w' with w' ~ N(0, Q₂), so that

    x(τ) = f(x₀) + G (x₁ - f₂(f(x₀))) + e,  G = Q₁ F₂ᵀ S⁺,  S = F₂ Q₁ F₂ᵀ + Q₂,
    e ~ N(0, Q₁ - G F₂ Q₁).

For a linear model this is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..linalg import deviations, symmetrise, to_unit_variances
from ..models import Model
from ..periods import Periods, wrap_differences
from ..validation import Array, format_number
from .observations import Observation

if TYPE_CHECKING:
    from .base import Filter
    from .ensemble import MembersFilter, MemberState
    from .gaussian import GaussianFilter, GaussianState
    from .states import AnyState, State

__all__ = ["Bridge", "bridge_states", "insert_times"]


class Bridge(NamedTuple):
    """The law of the states x(τ) given the earlier states x₀ and later ones."""

    forecast: Array
    """f(x₀), (..., d)."""
    after: Array
    """Its forecast at the later time, f₂(f(x₀)), (..., d)."""
    gain: Array
    """G, (..., d, d)."""
    slope_before: Array
    """The derivative of f at x₀, (..., d, d)."""
    slope_after: Array
    """The derivative F₂ of f₂ at f(x₀), (..., d, d)."""
    cov: Array
    """The covariance of e, (..., d, d)."""


def bridge_states(
    model: Model, before: Array, times: tuple[float, float, float], std: Array
) -> Bridge:
    """Return the law of the states at the second of three times, given those at the others.

    Of a random walk it is the mean of both in the middle, with half of one step's variance:

    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: dt * np.eye(1))
    >>> law = bridge_states(walk, np.zeros((1, 1)), (0.0, 1.0, 2.0), np.ones((1, 1)))
    >>> law.gain.ravel(), law.cov.ravel()
    (array([0.5]), array([0.5]))
    """
    start, t, end = times
    # f(x₀), F₁ at x₀, F₂ at f(x₀), and Q₁; finite differences take their steps from `std`.
    forecast = model.step(before, start, t - start)
    slope_before = model.jacobian(before, start, t - start, std=std)
    slope_after = model.jacobian(forecast, t, end - t, std=std)
    first = model.noise_at(before, start, t - start)
    # F₂ Q₁, and S = F₂ Q₁ F₂ᵀ + Q₂. Scaled to unit variances, S has no units, and so has the
    # threshold below which eigenvalues count as zero.
    cross = slope_after @ first
    scaled, unit = to_unit_variances(
        symmetrise(cross @ slope_after.mT + model.noise_at(forecast, t, end - t))
    )
    inverse = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True)
    inverse = inverse / (unit[..., :, None] * unit[..., None, :])
    # G = Q₁ F₂ᵀ S⁺, and the covariance Q₁ - G F₂ Q₁
    gain = cross.mT @ inverse
    after = model.step(forecast, t, end - t)
    cov = symmetrise(first - gain @ cross)
    return Bridge(forecast, after, gain, slope_before, slope_after, cov)


def draw_bridge(
    model: Model,
    before: Array,
    after: Array,
    times: tuple[float, float, float],
    normal: Array,
    periods: Periods,
) -> Array:
    """Return states (..., N, d) at the second of three times, from those of the others.

    `normal` holds standard normal draws that broadcast to the states.
    """
    # The members' standard deviations, as the scale of finite differences
    spread = before.std(axis=-2, keepdims=True)
    law = bridge_states(model, before, times, np.broadcast_to(spread, before.shape))
    # e = V √λ z with the covariance V diag(λ) Vᵀ, whatever its rank
    values, vectors = np.linalg.eigh(law.cov)
    scaled = np.sqrt(np.maximum(values, 0.0)) * normal
    noise = (vectors @ scaled[..., None])[..., 0]
    innovation = wrap_differences(after - law.after, periods)
    return np.asarray(law.forecast + (law.gain @ innovation[..., None])[..., 0] + noise)


def insert_times(
    f: Filter[AnyState],
    delayed: Sequence[Observation],
    state: AnyState,
    t: float,
    *,
    reuse_rng: bool,
) -> AnyState:
    """Return the state with beliefs about the times of delayed observations that it does not keep.

    A time within the step to `t` lies between two kept times only after the forecast to `t`. So the
    forecast is made here, and the state returned is that at `t`.
    """
    if not f.lag:
        return state
    # The oldest first
    for t_obs in sorted({observation.t for observation in delayed}):
        # Within the present step, and not at one of its ends: then the state is forecast to `t`.
        if t_obs > state.t and not _is_kept(t_obs, (state.t, t), t):
            state = _forecast(f, state, t, t_obs, reuse_rng=reuse_rng)
        times = (*state.times, state.t)
        # A kept time needs no insertion; one before all of them is refused later.
        if _is_kept(t_obs, times, t) or not times[0] < t_obs < times[-1]:
            continue
        state = f.insert_time(state, t_obs)
    return state


def _is_kept(t_obs: float, times: Sequence[float], t: float) -> bool:
    """Whether a time is one of these to rounding.

    A sum of steps may differ by rounding, but by far less than the shortest of them. `t` is the
    time of the present step.
    """
    shortest = min((b - a for a, b in pairwise((*times, t)) if b > a), default=0.0)
    tolerance = min(1e-9 * max(1.0, abs(t_obs)), 1e-3 * shortest)
    return min(abs(time - t_obs) for time in times) <= tolerance


def _forecast(
    f: Filter[AnyState],
    state: AnyState,
    t: float,
    t_obs: float,
    *,
    reuse_rng: bool,
) -> AnyState:
    """Return the state at the end `t` of a step, into which an observation's time is inserted then.

    It is the forecast alone: the step itself, which follows with a length of zero, has the exchange
    and the observations.
    """
    # A time at the end of the step or later is not between two of its times.
    if t_obs >= t:
        return state
    if f.exchange_interval is not None:
        raise ValueError(
            f"delayed must be of times up to the state's own, {format_number(state.t)}, for "
            f"agents that exchange at intervals, got {format_number(t_obs)}"
        )
    # The same filter without a network sends nothing.
    without_graph = f.replace(graph=None)
    return without_graph._advance(
        state, t, [None] * f.n_agents, (), reuse_rng=reuse_rng
    )


class Gap(NamedTuple):
    """The gap between two kept times in which another one lies.

    `n_before` is the number of kept times before it, which is also the index of the next one;
    `start` and `end` are the times on both of its sides.
    """

    n_before: int
    start: float
    end: float


def find_gap(state: State, t_obs: float) -> Gap:
    """Return the gap between a state's kept times in which `t_obs` lies."""
    times = (*state.times, state.t)
    n_before = sum(time < t_obs for time in times)
    return Gap(n_before, start=times[n_before - 1], end=times[n_before])


def insert_gaussian(
    f: GaussianFilter, state: GaussianState, t_obs: float
) -> GaussianState:
    """Return a Gaussian state with the belief about a time between two that it keeps."""
    gap = find_gap(state, t_obs)
    n_before = gap.n_before
    d = state.dim
    n_times = len(state.history) + 1
    mean = state.joint_means
    cov = state.joint_covariances
    # The joint state has the latest time in its first block of d components: the time after the
    # gap is followed by the one before it.
    n_after = n_times - n_before
    after = slice((n_after - 1) * d, n_after * d)
    before = slice(n_after * d, (n_after + 1) * d)
    std = deviations(cov[..., before, before])
    model = f.model_of_states(state.runs)
    times_of_law = (gap.start, t_obs, gap.end)
    law = bridge_states(model, mean[..., before], times_of_law, std)
    # Given the state before, x(τ) is `forecast` and the state after is `law.after`, on average.
    innovation = wrap_differences(mean[..., after] - law.after, f.periods)
    new_mean = law.forecast + (law.gain @ innovation[..., None])[..., 0]
    # x(τ) = F₁ x₀ + G (x₁ - F₂ F₁ x₀) + e, for x₀ before and x₁ after: the rows are the matrix of
    # x(τ) in terms of the joint state.
    rows = np.zeros((*mean.shape[:-1], d, mean.shape[-1]))
    rows[..., after] = law.gain
    rows[..., before] = (np.eye(d) - law.gain @ law.slope_after) @ law.slope_before
    # Covariance of x(τ) with the joint state, and its own
    cross = rows @ cov
    variance = cross @ rows.mT + law.cov
    # The new block is inserted between the two.
    cut = after.stop
    cov = np.block(
        [
            [cov[..., :cut, :cut], cross[..., :cut].mT, cov[..., :cut, cut:]],
            [cross[..., :cut], variance, cross[..., cut:]],
            [cov[..., cut:, :cut], cross[..., cut:].mT, cov[..., cut:, cut:]],
        ]
    )
    mean = np.concatenate([mean[..., :cut], new_mean, mean[..., cut:]], axis=-1)
    # Of the earlier times the latest ones that the lag keeps, and their blocks after the present
    times = (*state.times[:n_before], t_obs, *state.times[n_before:])[-f.lag :]
    size = (len(times) + 1) * d
    return state.replace(
        joint_means=mean[..., :size],
        joint_covariances=symmetrise(cov[..., :size, :size]),
        history=times[::-1],
    )


def insert_members(
    f: MembersFilter[MemberState], state: MemberState, t_obs: float
) -> MemberState:
    """Return a state of members with draws of those at a time between two that it keeps.

    Each is drawn given the same member's states at the times before and after.
    """
    from .base import require_rng
    from .step import copy_rng

    gap = find_gap(state, t_obs)
    # The members of the kept times, oldest first, and the present ones
    beliefs = [*[belief for _time, belief in state.past], state.belief]
    # Steps of members draw, so that their states have a generator.
    rng = copy_rng(require_rng(state.rng))
    drawn = draw_bridge(
        f.model_of_states(state.runs),
        # The times before and after `t_obs`
        beliefs[gap.n_before - 1],
        beliefs[gap.n_before],
        (gap.start, t_obs, gap.end),
        f.draw_normal(state.belief.shape, rng),
        f.periods,
    )
    history = list(state.past)
    history.insert(gap.n_before, (t_obs, drawn))
    # The latest times that the lag keeps
    return state.replace(history=tuple(history[-f.lag :]), rng=rng)
