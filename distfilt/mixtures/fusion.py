r"""Fusing beliefs about a shared part of agents' states: only beliefs about the target travel.

An agent's state is x = [t; e]: the target t, which all agents estimate, comes first; what is its
own, e, comes last and differs from agent to agent. The fused density is

.. math:: p_f(\mathbf x)\propto p(\mathbf x)\,p(\mathbf t)^{\omega-1}
    \prod_b p_b(\mathbf t)^{\omega_b},\qquad \omega+\sum_b\omega_b=1,

equations (14)-(15) of Semeraro, LeGrand and Kulik for one other agent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from ..doors import Array, Count, Record, Share, door, summing_to_one, unchecked
from ..gaussians.single import unscented_points
from ..linalg import SolverError
from .gaussian import GaussianMixture, log_sum
from .mixands import Shapes, conditional_shapes, literal_shapes, nonnegative_least_squares

__all__ = ["Exponents", "Others", "PartialFusion", "Rule", "Terms"]

Others = GaussianMixture | Sequence[GaussianMixture]
Exponents = Share | Literal["equal"] | Annotated[Array, "K", summing_to_one]
Terms = Literal["matched", "all"]
Rule = Literal["C1", "C2", "C3", "points"]

_FLOOR = 1e-3
"""Relative density below which the rows of "points" stop gaining weight."""


@dataclass(frozen=True, eq=False)
class PartialFusion(Record):
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
    >>> exact = PartialFusion(own, other)
    >>> fused = exact.weigh(exact.shapes())
    >>> fused.means.round(4), fused.covs[0, 0, 0].round(4)
    (array([[2., 1.]]), np.float64(1.3333))
    """

    own: GaussianMixture
    heard: Others
    _: KW_ONLY
    omega: Exponents = "equal"

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = {other.dim for other in self.others}
        if len(sizes) != 1 or max(sizes) > self.own.dim:
            raise ValueError(
                f"heard: needs target beliefs, one or more, of one size, at most own's "
                f"{self.own.dim}, got {sorted(sizes)}"
            )
        if np.ndim(self.omega) and len(self.exponents) != len(self.others) + 1:
            raise ValueError(
                f"omega: needs {len(self.others) + 1} exponents, got {len(self.exponents)}"
            )

    @property
    def others(self) -> tuple[GaussianMixture, ...]:
        """What is heard, one or several."""
        return (self.heard,) if isinstance(self.heard, GaussianMixture) else tuple(self.heard)

    @cached_property
    def exponents(self) -> Array:
        """Exponents of the own and of the others' target marginals; their sum is 1."""
        others = len(self.others)
        if isinstance(self.omega, np.ndarray):
            return self.omega
        if isinstance(self.omega, str):
            return np.full(others + 1, 1 / (others + 1))
        return np.array([self.omega] + [(1 - self.omega) / others] * others)

    @property
    def target_dim(self) -> int:
        """Number of components of the target."""
        return self.others[0].dim

    @cached_property
    def target(self) -> GaussianMixture:
        """The own belief about the target."""
        return unchecked(self.own.marginal)(range(self.target_dim))

    @door
    def log_update(self, t: Annotated[Array, "... self.target_dim"]) -> Array:
        """Logarithm of the update factor g(t) of (15), not normalised, (...).

        Parameters
        ----------
        t : array_like, (..., n_t)
        """
        return self._with_update(np.zeros(t.shape[:-1]), t, "t")

    def _with_update(self, logs: Array, t: Array, name: str) -> Array:
        """Logarithms of densities and that of the update factor, added."""
        w = self.exponents
        with np.errstate(invalid="ignore"):
            if w[0] != 1:
                logs = logs + (w[0] - 1) * unchecked(self.target.log_density)(t)
            for weight, other in zip(w[1:], self.others, strict=True):
                if weight:
                    logs = logs + weight * unchecked(other.log_density)(t)
        if np.isnan(logs).any():  # one density is divided by another, and both are zero
            raise ValueError(f"{name}: needs points whose density is a number, got one too far out")
        return logs

    @door
    def log_value(self, x: Annotated[Array, "... self.own.dim"]) -> Array:
        """Logarithm of the fused density (14), not normalised, (...).

        Parameters
        ----------
        x : array_like, (..., d)
        """
        logs = unchecked(self.own.log_density)(x)
        return self._with_update(logs, x[..., : self.target_dim], "x")

    @door
    def log_target(self, t: Annotated[Array, "... self.target_dim"]) -> Array:
        """Logarithm of the fused target marginal, not normalised; it needs no ego state."""
        return self._with_update(unchecked(self.target.log_density)(t), t, "t")

    @door
    def shapes(
        self, *, terms: Terms = "matched", form: Literal["conditional", "literal"] = "conditional",
        marginal: GaussianMixture | None = None, received: Sequence[GaussianMixture] | None = None,
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
        if marginal is not None and terms == "matched":
            raise ValueError("marginal: needs terms='all', since matched terms use the own mixands")
        divided = self.target if marginal is None else marginal
        sent = self.others if received is None else received
        if len(sent) != len(self.others):
            raise ValueError(f"received: needs {len(self.others)} mixtures, got {len(sent)}")
        for name, mixture in (("marginal", divided), *(("received", other) for other in sent)):
            if mixture.dim != self.target_dim:
                raise ValueError(f"{name}: needs dimension {self.target_dim}, got {mixture.dim}")
        pairs: NDArray[np.intp] = np.indices((self.own.size, divided.size)).reshape(2, -1)
        if terms == "matched":
            pairs = np.repeat(np.arange(self.own.size)[None], 2, axis=0)
        make = conditional_shapes if form == "conditional" else literal_shapes
        return make(self.own, divided, sent, self.exponents, pairs)

    @door
    def weigh(self, shapes: Shapes, *, rule: Rule = "C3", at_most: Count = 500) -> GaussianMixture:
        """The mixture of these shapes, with weights from the exact density at collocation points.

        Mixands whose weight is zero are left out.

        Parameters
        ----------
        shapes : Shapes
        rule : {"C1", "C2", "C3", "points"}
            (30), (31), (32)-(34), or C3 with the mixands' sigma points as further points.
        at_most : int
            For "C3" and "points": how many mixands may take part, the largest by C2.

        Raises
        ------
        SolverError
            If no mixand has a weight, or least squares do not end.
        """
        mixture = shapes.equally_weighed()
        logs = self._at_means(shapes, alone=rule == "C1")
        if rule in ("C1", "C2"):
            return _weighed(mixture, logs)
        if shapes.size > at_most:
            keep = np.sort(np.argsort(mixture.log_peaks - logs, kind="stable")[:at_most])
            shapes, logs = unchecked(shapes.select)(keep), logs[keep]
            mixture = shapes.equally_weighed()
        points = shapes.means
        if rule == "points":
            points = unchecked(unscented_points)(mixture.means, mixture.factors)[0]
            points = points.reshape(-1, mixture.dim)
            logs = unchecked(self.log_value)(points)
        matrix = np.exp(unchecked(mixture.component_log_densities)(points) - mixture.log_peaks)
        right = np.exp(logs - logs.max())
        if rule == "points":
            rows = 1 / np.sqrt(right + _FLOOR)
            matrix, right = matrix * rows[:, None], right * rows
        found = unchecked(nonnegative_least_squares)(matrix, right)
        with np.errstate(divide="ignore"):
            return _weighed(mixture, np.log(found))

    def _at_means(self, shapes: Shapes, *, alone: bool) -> Array:
        """Log density at the shapes' means, exact or with the mixand alone that each came from."""
        if not alone:
            return unchecked(self.log_value)(shapes.means)
        own, q = self.own, shapes.source
        white = np.linalg.solve(own.factors[q], (shapes.means - own.means[q])[..., None])[..., 0]
        logs = (own.log_weights + own.log_peaks)[q] - 0.5 * (white**2).sum(axis=-1)
        return np.asarray(logs + unchecked(self.log_update)(shapes.means[:, : self.target_dim]))


def _weighed(mixture: GaussianMixture, logs: Array) -> GaussianMixture:
    """Weights from the logarithms of EQ coefficients, by (18); what vanishes is left out."""
    mass = logs - mixture.log_peaks
    total = log_sum(mass)
    if not np.isfinite(total):
        raise SolverError("no fused mixand has a weight: the exact density is zero at every point")
    w = np.exp(mass - total)
    keep = w > 0
    return GaussianMixture.unchecked(
        w[keep] / w[keep].sum(), mixture.means[keep], mixture.covs[keep]
    )
