"""Localisation and tracking by news: agents tell what their readings taught them of the target."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np

from ..checks import Array, count, instance
from ..mixtures import GaussianMixture, conditioned
from ..network import Channel
from .mixture import MixtureFilter

__all__ = ["NewsFilter", "increment"]

_NOTHING = 1e-6
"""A gain in information, as a share of what was there before, below which nothing was learned."""


def increment(before: GaussianMixture, after: GaussianMixture) -> Array:
    r"""What a belief has gained, as readings of unit noise that would have taught the same.

    For Gaussians the gain in information :math:`\mathbf P_+^{-1}-\mathbf P_-^{-1}` is
    :math:`\mathbf H^\top\mathbf H` with as many rows as it has rank, and
    :math:`\mathbf P_+^{-1}\mathbf m_+-\mathbf P_-^{-1}\mathbf m_-` is
    :math:`\mathbf H^\top\mathbf z`. Whoever takes the readings :math:`\mathbf z=\mathbf H\mathbf t`
    plus unit noise learns exactly that. Directions in which information was lost are left out.

    Parameters
    ----------
    before, after : GaussianMixture
        Beliefs about the target before and after what is to be told; of several mixands the
        moments are compared.

    Returns
    -------
    ndarray, (r, n + 1)
        Rows of H, zero below its diagonal, with z as the last column.

    Examples
    --------
    >>> old = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])
    >>> new = GaussianMixture.gaussian([1.0, 0.0], [[0.5, 0.0], [0.0, 1.0]])
    >>> np.abs(increment(old, new))
    array([[1., 0., 2.]])
    """
    one = instance(before, "before", GaussianMixture).collapsed()
    two = instance(after, "after", GaussianMixture).collapsed()
    if one.dim != two.dim:
        raise ValueError(f"after: needs dimension {one.dim}, got {two.dim}")
    # In the frame in which the old covariance is the identity.
    narrower = np.linalg.solve(two.factors[0], one.factors[0])
    _, size, axes = np.linalg.svd(narrower)
    gain = size**2 - 1
    learned = gain > _NOTHING
    root, axes = np.sqrt(gain[learned]), axes[learned]
    moved = axes @ np.linalg.solve(one.factors[0], two.means[0] - one.means[0])
    rows = root[:, None] * np.linalg.solve(one.factors[0].T, axes.T).T
    values = rows @ one.means[0] + size[learned] ** 2 / root * moved
    # Another orthogonal basis of the same readings, with zeros that need not be sent.
    turn, rows = np.linalg.qr(rows)
    return np.concatenate([rows, (values @ turn)[:, None]], axis=1)


@dataclass(frozen=True, eq=False)
class NewsFilter(MixtureFilter):
    """Every agent tells the others what its own reading taught it of the target, and no more.

    A reading is told once, by whom it belongs to, so that nothing is counted twice and nothing has
    to be discounted. For linear models and Gaussians that equals one filter with everybody's
    readings, if everybody hears everybody and nothing is lost. It needs to know where readings come
    from: what all receive alike has to be named in `common`, and is taken by each for itself.

    Parameters
    ----------
    models, sensors, graph, target_dim, stretch, scale, rule, gate, faults, names
        As of :class:`MixtureFilter`; a `graph` is needed and an `agreement` is not taken.
    size, most : int
        As there. With more than one mixand the moments' news are told, which is an approximation.
    common : sequence of int
        Components of the readings that all agents receive alike, with the same error.

    Examples
    --------
    Two agents, and the Kalman filter of both readings:

    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import direct
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> f = NewsFilter([still, still], [direct([0], std=1.0)] * 2, graphs.path(2), target_dim=1)
    >>> prior = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> after = f.step(f.start([prior, prior]), 1.0, [[3.0], [0.0]])
    >>> [float(m.means[0, 0].round(9)) for m in after.mixtures], after.ledger.scalars
    ([1.0, 1.0], array([2, 2]))
    """

    _: KW_ONLY
    size: int = 1
    most: int = 1
    common: Sequence[int] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.agreement is not None:
            raise ValueError("agreement: needs None, since news are added, got one")
        if self.graph is None:
            raise ValueError("graph: needs a Graph, got None")
        least = min((s.dim for s in self.sensors if s is not None), default=0)
        instance(self.common, "common", Collection)  # type: ignore[type-abstract]
        alike = tuple(count(k, "common", at_least=0) for k in self.common)
        if alike and max(alike) >= least:
            raise ValueError(f"common: needs components below {least}, got {max(alike)}")
        object.__setattr__(self, "common", alike)

    def _told(
        self, beliefs: list[GaussianMixture], seen: Sequence[Array | None], channel: Channel | None
    ) -> list[GaussianMixture]:
        """Own readings, then others' news, then what all received alike."""
        own, alike = self._parted(seen)
        after = self._read(beliefs, own)
        part = range(self.target_dim)
        said = [
            None if old is new else increment(old.marginal(part), new.marginal(part))
            for old, new in zip(beliefs, after, strict=True)
        ]
        assert channel is not None  # there is a graph
        inbox = channel.exchange([None if s is None or not s.size else _packed(s) for s in said])
        for k, heard in enumerate(inbox):
            for news in heard.values():
                after[k] = _learned(after[k], _unpacked(news, self.target_dim))
        return self._read(after, alike)

    def _parted(self, seen: Sequence[Array | None]) -> tuple[list[Array | None], ...]:
        """Readings without and with nothing but the common components; None where none is left."""
        own: list[Array | None] = []
        alike: list[Array | None] = []
        for y in seen:
            everybody = np.isin(np.arange(0 if y is None else y.size), self.common)
            for part, gone in ((own, everybody), (alike, ~everybody)):
                left = None if y is None else np.where(gone, np.nan, y)
                part.append(None if left is None or np.isnan(left).all() else left)
        return own, alike


def _packed(news: Array) -> Array:
    """The numbers of an increment that are not zero by construction, 13 for two rows of six."""
    r, k = news.shape
    return news[np.triu_indices(r, 0, k)]


def _unpacked(numbers: Array, n: int) -> Array:
    """The increment of n components, whose number of rows follows from its length."""
    for r in range(1, n + 1):
        filled = np.triu_indices(r, 0, n + 1)
        if filled[0].size == numbers.size:
            out = np.zeros((r, n + 1))
            out[filled] = numbers
            return out
    raise ValueError(f"news: needs an increment of {n} components, got {numbers.size} numbers")


def _learned(belief: GaussianMixture, news: Array) -> GaussianMixture:
    """A belief after news of its first components."""
    rows, values = news[:, :-1], news[:, -1]
    return conditioned(
        belief, values, lambda x: x[..., : rows.shape[1]] @ rows.T, np.eye(values.size)
    )
