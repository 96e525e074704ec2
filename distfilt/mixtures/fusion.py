r"""Fusing beliefs about a shared part of agents' states: only beliefs about the target travel.

An agent's state is x = [t; e]: the target t, which all agents estimate, comes first; what is its
own, e, comes last and differs from agent to agent. The fused density is

.. math:: p_f(\mathbf x)\propto p(\mathbf x)\,p(\mathbf t)^{\omega-1}
    \prod_b p_b(\mathbf t)^{\omega_b},\qquad \omega+\sum_b\omega_b=1,

equations (14)-(15) of Semeraro, LeGrand and Kulik for one other agent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from ..checks import Array, array, callable_, choice, count, instance, number
from .collocation import RULES, collocation_weights
from .gaussian import GaussianMixture, trusted
from .reduction import runnalls
from .shapes import Shapes
from .terms import (
    _conditional_shapes,
    _exponents,
    _joined,
    _literal_shapes,
    _regression,
)

__all__ = ["PartialFusion", "average", "fuse", "fuse_in_turn", "fuse_moments"]

TERMS = ("matched", "all")
FORMS = ("conditional", "literal")


@dataclass(frozen=True, eq=False)
class PartialFusion:
    r"""The exact fused density, which can be evaluated but is no mixture, and its approximations.

    Parameters
    ----------
    own : GaussianMixture
        The agent's belief about [t; e].
    heard : GaussianMixture or sequence of them
        Others' beliefs about t; all of one dimension, at most that of `own`.
    omega : float, "equal" or array_like
        Exponent of the own target marginal, in [0, 1]; the others share the rest equally. "equal"
        gives all the same. Or one exponent each, own first, nonnegative with sum 1.

    Examples
    --------
    >>> own = GaussianMixture.gaussian([0.0, 0.0], [[2.0, 1.0], [1.0, 1.0]])
    >>> other = GaussianMixture.gaussian([3.0], [[1.0]])
    >>> fused = PartialFusion(own, other, omega=0.5).approximation()
    >>> fused.means.round(4), fused.covs[0, 0, 0].round(4)
    (array([[2., 1.]]), np.float64(1.3333))
    """

    own: GaussianMixture
    heard: tuple[GaussianMixture, ...]
    omega: float | str | ArrayLike = 0.5

    def __init__(
        self,
        own: GaussianMixture,
        heard: GaussianMixture | Sequence[GaussianMixture],
        *,
        omega: float | str | ArrayLike = 0.5,
    ) -> None:
        instance(own, "own", GaussianMixture)
        others = _beliefs(heard)
        for other in others:
            instance(other, "heard", GaussianMixture)
        sizes = {other.dim for other in others}
        if len(sizes) > 1 or max(sizes) > own.dim:
            raise ValueError(
                f"heard: needs target beliefs of one size, at most own's {own.dim}, "
                f"got {sorted(sizes)}"
            )
        for name, value in (
            ("own", own), ("heard", others), ("omega", _exponents(omega, len(others))),
        ):
            object.__setattr__(self, name, value)

    @property
    def exponents(self) -> Array:
        """Exponents of the own and of the others' target marginals; their sum is 1."""
        return np.asarray(self.omega)

    @property
    def target_dim(self) -> int:
        """Number of components of the target."""
        return self.heard[0].dim

    @cached_property
    def target(self) -> GaussianMixture:
        """The own belief about the target."""
        return self.own.marginal(range(self.target_dim))

    def log_update(self, t: ArrayLike) -> Array:
        """Logarithm of the update factor g(t) of (15), not normalised, (...).

        Parameters
        ----------
        t : array_like, (..., n_t)
        """
        at = array(t, "t", (..., self.target_dim))
        with np.errstate(invalid="ignore"):  # `_numbers` refuses what is none
            return _numbers(self._log_update(at), "t")

    def log_value(self, x: ArrayLike) -> Array:
        """Logarithm of the fused density (14), not normalised, (...).

        Parameters
        ----------
        x : array_like, (..., d)
        """
        at = array(x, "x", (..., self.own.dim))
        with np.errstate(invalid="ignore"):
            logs = self.own.log_density(at) + self._log_update(at[..., : self.target_dim])
        return _numbers(logs, "x")

    def log_target(self, t: ArrayLike) -> Array:
        """Logarithm of the fused target marginal, not normalised; it needs no ego state."""
        at = array(t, "t", (..., self.target_dim))
        with np.errstate(invalid="ignore"):
            return _numbers(self.target.log_density(at) + self._log_update(at), "t")

    def _log_update(self, t: Array) -> Array:
        w = self.exponents
        out = (w[0] - 1) * self.target.log_density(t) if w[0] != 1 else np.zeros(t.shape[:-1])
        for weight, other in zip(w[1:], self.heard, strict=True):
            out = out + (weight * other.log_density(t) if weight else 0.0)
        return np.asarray(out)

    def shapes(
        self,
        *,
        terms: str = "matched",
        form: str = "conditional",
        marginal: GaussianMixture | None = None,
        received: Sequence[GaussianMixture] | None = None,
    ) -> Shapes:
        """Means and covariances of the fused mixands, (22)-(28), without weights.

        Parameters
        ----------
        terms : {"matched", "all"}
            Terms in which own mixand and divided mixand are the same, L L' of them, all positive
            definite; or all L² L', of which some are not and are left out.
        form : {"conditional", "literal"}
            By conditioning, which inverts nothing indefinite; or (22)-(27) as printed.
        marginal : GaussianMixture, optional
            What to divide by in place of the own target marginal (a reduced one); with
            ``terms="all"``.
        received : sequence of GaussianMixture, optional
            What to multiply by in place of `heard` (reduced ones).
        """
        choice(terms, "terms", TERMS)
        choice(form, "form", FORMS)
        if marginal is not None and terms == "matched":
            raise ValueError("marginal: needs terms='all', since matched terms use the own mixands")
        divided = self.target if marginal is None else self._target_like(marginal, "marginal")
        others = self.heard if received is None else _beliefs(received, "received")
        if len(others) != len(self.heard):
            raise ValueError(f"received: needs {len(self.heard)} mixtures, got {len(others)}")
        sent = [self._target_like(m, "received") for m in others]
        pairs = np.indices((self.own.size, divided.size)).reshape(2, -1)
        if terms == "matched":
            pairs = np.repeat(np.arange(self.own.size)[None], 2, axis=0)
        make = _conditional_shapes if form == "conditional" else _literal_shapes
        return make(self.own, divided, sent, self.exponents, pairs)

    def _target_like(self, mixture: GaussianMixture, name: str) -> GaussianMixture:
        instance(mixture, name, GaussianMixture)
        if mixture.dim != self.target_dim:
            raise ValueError(f"{name}: needs dimension {self.target_dim}, got {mixture.dim}")
        return mixture

    def weigh(self, shapes: Shapes, *, rule: str = "C3", at_most: int = 500) -> GaussianMixture:
        """The mixture of these shapes, with weights from the exact density at collocation points.

        Parameters
        ----------
        shapes : Shapes
        rule : {"C1", "C2", "C3", "points"}
            (30), (31), (32)-(34), or C3 with the mixands' sigma points as further points.
        at_most : int
            For "C3" and "points": how many mixands may take part, the largest by C2.
        """
        instance(shapes, "shapes", Shapes)
        return collocation_weights(
            shapes, self.own, self.log_value, self.log_update, self.target_dim,
            rule=rule, at_most=at_most,
        )

    def approximation(
        self, *, terms: str = "matched", rule: str = "C3", size: int | None = None
    ) -> GaussianMixture:
        """The fused mixture: shapes, weights, and Runnalls' reduction to `size` mixands."""
        most = None if size is None else count(size, "size")
        if self.exponents[0] == 1:
            choice(terms, "terms", TERMS)
            choice(rule, "rule", RULES)
            return self.own
        fused = self.weigh(self.shapes(terms=terms), rule=rule)
        return fused if most is None or fused.size <= most else runnalls(fused, most)


def fuse(
    own: GaussianMixture,
    heard: GaussianMixture | Sequence[GaussianMixture],
    *,
    omega: float | str | ArrayLike = 0.5,
    terms: str = "matched",
    rule: str = "C3",
    size: int | None = None,
) -> GaussianMixture:
    """Fuse a belief about [target; ego] with others' beliefs about the target.

    Parameters
    ----------
    own, heard, omega
        As of :class:`PartialFusion`.
    terms : {"matched", "all"}
        As of :meth:`PartialFusion.shapes`.
    rule : {"C1", "C2", "C3", "points"}
        As of :meth:`PartialFusion.weigh`.
    size : int, optional
        Reduce the result to so many mixands by Runnalls' algorithm.

    Examples
    --------
    >>> own = GaussianMixture.gaussian([0.0, 0.0], [[2.0, 1.0], [1.0, 1.0]])
    >>> fuse(own, own.marginal([0])).covs.round(6).tolist()
    [[[2.0, 1.0], [1.0, 1.0]]]
    """
    return PartialFusion(own, heard, omega=omega).approximation(terms=terms, rule=rule, size=size)


def fuse_moments(
    own: GaussianMixture,
    heard: GaussianMixture | Sequence[GaussianMixture],
    *,
    omega: float | str | ArrayLike = 0.5,
) -> GaussianMixture:
    """Factorised covariance intersection: fuse the Gaussians that have the mixtures' moments.

    Parameters
    ----------
    own, heard, omega
        As of :class:`PartialFusion`.

    Returns
    -------
    GaussianMixture
        Of one mixand.

    Examples
    --------
    >>> own = GaussianMixture.gaussian([0.0], [[2.0]])
    >>> fuse_moments(own, GaussianMixture.gaussian([3.0], [[1.0]])).means.round(6)
    array([[2.]])
    """
    exact = PartialFusion(own, heard, omega=omega)
    alone = PartialFusion(
        own.collapsed(), [m.collapsed() for m in exact.heard], omega=exact.exponents
    )
    shapes = alone.shapes()
    return trusted(np.ones(1), shapes.means, shapes.covs)


def fuse_in_turn(
    own: GaussianMixture,
    heard: GaussianMixture | Sequence[GaussianMixture],
    *,
    omega: float | str = "equal",
    pair: Callable[..., GaussianMixture] = fuse,
) -> GaussianMixture:
    """Fuse what is heard one belief after another: fewer mixands at a time than in one pass.

    With the own exponent m / (m + 1) at the m-th belief all exponents end up equal, in whatever
    order, up to what the approximations lose. With a fixed one the last belief counts most.

    Parameters
    ----------
    own, heard
        As of :class:`PartialFusion`.
    omega : "equal" or float
        m / (m + 1), or the own exponent each time.
    pair : callable
        ``pair(own, heard, omega=...) -> mixture``, such as :func:`fuse` and :func:`fuse_moments`.

    Examples
    --------
    >>> ends = [GaussianMixture.gaussian([m], [[1.0]]) for m in (3.0, 6.0)]
    >>> own = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> fuse_in_turn(own, ends).means.round(9)
    array([[3.]])
    >>> fuse_in_turn(own, ends, omega=0.5).means.round(9)
    array([[3.75]])
    """
    callable_(pair, "pair")
    if isinstance(omega, str):
        choice(omega, "omega", ("equal",))
    others = _beliefs(heard)
    for m, other in enumerate(others, start=1):
        own = pair(own, other, omega=m / (m + 1) if isinstance(omega, str) else omega)
    return own


def _beliefs(
    heard: GaussianMixture | Iterable[GaussianMixture], name: str = "heard"
) -> tuple[GaussianMixture, ...]:
    """One or several mixtures as a tuple."""
    if not isinstance(heard, GaussianMixture | Iterable):
        raise ValueError(f"{name}: needs mixtures, got {type(heard).__name__}")
    others = (heard,) if isinstance(heard, GaussianMixture) else tuple(heard)
    if not others:
        raise ValueError(f"{name}: needs at least one belief, got none")
    return others


def _numbers(logs: Array, name: str) -> Array:
    """Refuse points so far out that one density is divided by another and both are zero."""
    if np.isnan(logs).any():
        raise ValueError(f"{name}: needs points whose densities are numbers, got one too far out")
    return logs


def average(
    own: GaussianMixture, heard: GaussianMixture, *, omega: float = 0.5
) -> GaussianMixture:
    r"""Arithmetic average of the target beliefs, with the own conditional belief about the rest.

    :math:`p(\mathbf e|\mathbf t)\,[\omega\,p(\mathbf t)+(1-\omega)\,p_b(\mathbf t)]`. The weights
    of the own mixands given t are taken at the means of the heard mixands; with one own mixand the
    result is exact.

    Parameters
    ----------
    own, heard : GaussianMixture
        As of :class:`PartialFusion`.
    omega : float
        The own share, in [0, 1].

    Examples
    --------
    >>> own = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.5], [0.5, 1.0]])
    >>> average(own, GaussianMixture.gaussian([2.0], [[1.0]])).moments()[0]
    array([1. , 0.5])
    """
    w = number(omega, "omega", at_least=0, at_most=1)
    exact = PartialFusion(own, heard, omega=w)
    target, n = exact.target, exact.target_dim
    logs = target.log_weights + target.component_log_densities(heard.means)
    share = np.exp(logs - logsumexp(logs, axis=1, keepdims=True))
    means = np.empty((heard.size, own.size, own.dim))
    covs = np.empty((heard.size, own.size, own.dim, own.dim))
    gain, rest = _regression(own, n)
    means[..., :n] = heard.means[:, None]
    gap = heard.means[:, None] - own.means[:, :n]
    means[..., n:] = own.means[:, n:] + (gain @ gap[..., None])[..., 0]
    covs[:] = _joined(np.broadcast_to(heard.covs[:, None], (*means.shape[:2], n, n)), gain, rest)
    new = (heard.weights[:, None] * share).ravel() * (1 - w)
    d = own.dim
    keep = new > 0
    return trusted(
        np.concatenate([w * own.weights, new[keep]]),
        np.concatenate([own.means, means.reshape(-1, d)[keep]]),
        np.concatenate([own.covs, covs.reshape(-1, d, d)[keep]]),
    )
