"""A mixture along an arc: what an agent believes that knows a distance well and a bearing badly."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import array, count, number
from .gaussian import GaussianMixture, symmetric

__all__ = ["arc"]


def arc(
    mixands: int,
    agent: ArrayLike,
    *,
    angle_std: float,
    range_std: float,
    ego_std: float,
    width: float = 0.31,
    span: float = 1.46,
) -> GaussianMixture:
    r"""A belief about [target; ego] in the plane, four components, bent along an arc.

    The agent aims at the origin from a distance R. Mixand k lies at the angle
    :math:`\theta_k=\theta_0+\sigma_\theta s_k` with :math:`s_k` equally spaced in ± `span`,
    weighs :math:`\propto e^{-s_k^2/2}`, and has the target at distance R, the ego position moved
    half as far the other way. Within a mixand the errors are independent along the line of sight
    (`range_std`) and across it (R, `width` and the spacing of the angles multiplied); the ego
    position takes half of the error across, and has `ego_std` of its own in both directions.

    Parameters
    ----------
    mixands : int
        At least 2.
    agent : array_like, (2,)
        Where the agent stands, not at the origin.
    angle_std : float
        In rad, above 0.
    range_std, ego_std : float
        In the agent's units of length, above 0.
    width, span : float
        Without unit, above 0.

    Returns
    -------
    GaussianMixture
        Of dimension 4: target (2), ego (2).

    Examples
    --------
    >>> bent = arc(5, [-10.0, 0.0], angle_std=0.6, range_std=0.4, ego_std=0.4)
    >>> bent.means[2].round(6) + 0.0
    array([  0.,   0., -10.,   0.])
    """
    n = count(mixands, "mixands", at_least=2)
    a = array(agent, "agent", (2,))
    r = float(np.hypot(*a))
    if r == 0:
        raise ValueError("agent: needs a place apart from the origin, got the origin")
    std = number(angle_std, "angle_std", above=0)
    own = number(ego_std, "ego_std", above=0)
    s = np.linspace(-1, 1, n) * number(span, "span", above=0)
    theta = np.arctan2(-a[1], -a[0]) + std * s
    across = r * number(width, "width", above=0) * std * (s[1] - s[0])
    variances = np.array([number(range_std, "range_std", above=0), across, own, own]) ** 2
    u = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    v = np.stack([-u[:, 1], u[:, 0]], axis=-1)
    slope = np.zeros((n, 4, 4))
    slope[:, :2, 0], slope[:, :2, 1] = u, v
    slope[:, 2:, 1], slope[:, 2:, 2], slope[:, 2:, 3] = -0.5 * v, u, v
    means = np.concatenate([a + r * u, a - 0.5 * r * (u + a / r)], axis=-1)
    w = np.exp(-0.5 * s**2)
    covs = symmetric((slope * variances) @ np.swapaxes(slope, -1, -2))
    return GaussianMixture(w / w.sum(), means, covs)
