"""The compared filters of chapter 11: a `Cell` is a family of filters with a rule of exchange.

A cell makes its filter for any problem and for any value of its one tuned option.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from _together_filters import (
    FloodedEnsemble,
    FloodedGaussian,
    FloodedGrid,
    FloodedParticles,
    GridFilter,
    LikelihoodConsensus,
    MeasurementConsensus,
    SharedPlanFilter,
    TargetExchangeFilter,
)
from _together_mixtures import BatchedMixtures
from _together_problems import STUDY, THREE, Problem

from distfilt import network
from distfilt.filters import EnsembleFilter, Filter, GaussianFilter, ParticleFilter
from distfilt.network import covariance_intersection
from distfilt.triangular import separable
from distfilt.updates import (
    enkf,
    enkf_exact,
    enkf_sampled_covariance,
    etkf,
    transport_map_update,
    with_inflation,
)

Array = np.ndarray
Maker = Callable[..., Filter]
"""``make(problem, value)``, for ensembles and particles also ``make(problem, value, members)``"""


@dataclass(frozen=True)
class Cell:
    """A filter with a rule of exchange; `make(problem, value)` builds it with its tuned value.

    Parameters
    ----------
    family, exchange : str
        The filter, and the data that agents exchange.
    make : callable
        Makes the filter.
    option : str
        The tuned option, '' for none.
    grid : tuple of float
        The values of the option that are tried.
    local : bool
        Whether agents filter their own problem [target; own position], if there is one.
    excluded : tuple of (str, str)
        Problems that this filter cannot have, each with the reason.
    """

    family: str
    exchange: str
    make: Maker
    option: str = ""
    grid: tuple[float, ...] = ()
    local: bool = False
    excluded: tuple[tuple[str, str], ...] = ()

    def why_excluded(self, name: str) -> str:
        """The reason why a problem is excluded, or ''."""
        return dict(self.excluded).get(name, "")


# ---------------------------------------------------------------------------------------- makers


def gaussian_maker(
    kind: Any = GaussianFilter, *, linearization: str = "extended", **options: Any
) -> Maker:
    """Return a maker of Kalman filters; the value is the inflation."""

    def make(p: Problem, value: float) -> Filter:
        return kind(
            p.model,
            p.sensors,
            p.graph,
            linearization=linearization,
            inflation=value,
            on_error="keep",
            **options,
        )

    return make


def ensemble_maker(
    update: Callable[..., Array], kind: Any = EnsembleFilter, **options: Any
) -> Maker:
    """Return a maker of ensemble filters; the value is the inflation."""

    def make(p: Problem, value: float, members: int = STUDY["members"]) -> Filter:
        return kind(
            p.model,
            p.sensors,
            p.graph,
            update=with_inflation(update, factor=value),
            members=members,
            on_error="keep",
            **options,
        )

    return make


def make_exact_ensemble(
    p: Problem, value: float, members: int = STUDY["members"]
) -> Filter:
    """Make an ensemble filter with exact draws and intersection by determinant."""
    update = with_inflation(enkf_exact, factor=value)
    return EnsembleFilter.exact(
        p.model, p.sensors, p.graph, update=update, members=members, on_error="keep"
    )


def make_mean_pull(p: Problem, value: float, members: int = STUDY["members"]) -> Filter:
    """Make an ensemble filter whose means pull each other with a gain."""
    rule = partial(network.mean_pull, gain=value, include_self=False)
    return EnsembleFilter(
        p.model, p.sensors, p.graph, fusion=rule, members=members, on_error="keep"
    )


def particle_maker(kind: Any = ParticleFilter, **options: Any) -> Maker:
    """Return a maker of particle filters; the value is the jitter."""

    def make(p: Problem, value: float, members: int = STUDY["particles"]) -> Filter:
        return kind(
            p.model,
            p.sensors,
            p.graph,
            jitter=value,
            members=members,
            on_error="keep",
            **options,
        )

    return make


def intersect_clouds(ensembles: Array, channel: Any) -> Array:
    """Intersect particle clouds, which resampling may have left without any width."""
    noise = np.random.default_rng(0).standard_normal(ensembles.shape[-2:])
    return network.intersect_ensembles(ensembles + 0.01 * noise, channel)


def make_likelihood_consensus(
    p: Problem, value: float, members: int = STUDY["particles"]
) -> Filter:
    """Make a filter of common particles; curved sensors get polynomials of degree four."""
    n = len(p.scored)
    # Of position and velocity the sensors see the position.
    observed = tuple(range(2 if n == 4 else n))
    return LikelihoodConsensus(
        p.model,
        p.sensors,
        p.graph,
        jitter=value,
        members=members,
        degree=4 if "curved" in p.traits else 2,
        observed=observed,
    )


def transport_maker(**options: Any) -> Maker:
    """Return a maker of transport filters; a value other than zero is the rejuvenation."""

    def make(p: Problem, value: float, members: int = STUDY["transported"]) -> Filter:
        chosen = dict(options)
        if value:
            chosen["rejuvenation"] = value
        return SharedPlanFilter(
            p.model, p.sensors, p.graph, members=members, on_error="keep", **chosen
        )

    return make


def mixture_maker(rule: str) -> Maker:
    """Return a maker of mixture filters with a rule for the fused weights."""

    def make(p: Problem, value: float) -> Filter:
        local = p.local or p
        return BatchedMixtures(
            local.model,
            local.sensors,
            p.graph,
            target_dim=len(p.scored),
            rule=rule,
            n_components=STUDY["mixands"],
            split_threshold=STUDY["stretch"],
            inflation=value,
        )

    return make


def target_maker(send_increments: bool) -> Maker:
    """Return a maker of filters of [target; own position]."""

    def make(p: Problem, value: float) -> Filter:
        return TargetExchangeFilter(
            p.local.model,
            p.local.sensors,
            p.graph,
            send_increments=send_increments,
            inflation=value,
            on_error="keep",
        )

    return make


def grid_maker(kind: Any = GridFilter, **options: Any) -> Maker:
    """Return a maker of grid filters, which have no tuned option."""

    def make(p: Problem, value: float) -> Filter:
        return kind(p.model, p.sensors, p.graph, **options)

    return make


# --------------------------------------------------------------- options and excluded problems

BY_DETERMINANT = partial(covariance_intersection, rule="min_determinant")
BY_TRACE = partial(covariance_intersection, rule="trace")
FOUR_ROUNDS = partial(covariance_intersection, rounds=4)
TWO_ROUNDS = partial(network.average_consensus, rounds=2)
# Inflation below one serves underconfident filters, such as intersection.
INFLATION = ("inflation", (0.9, 1.0, 1.05, 1.15, 1.3))
JITTER = ("jitter", (0.0, 0.05, 0.1, 0.2, 0.4))
GAIN = ("gain", (0.025, 0.05, 0.1, 0.2, 0.4))
REJUVENATION = ("rejuvenation", (0.05, 0.1, 0.2, 0.4, 0.8))
SEPARABLE_FIT = partial(separable.fit, order=1, regularisation=0.05)
SEPARABLE = partial(transport_map_update, fit=SEPARABLE_FIT)

Exclusions = tuple[tuple[str, str], ...]


def exclude(names: tuple[str, ...], reason: str) -> Exclusions:
    """Return some problems, each with the same reason."""
    return tuple((name, reason) for name in names)


KNOWN_POSITIONS = ("linear", "range", "lorenz", *THREE)
WIDE = "16 components: "
NO_CLOUD = exclude(("places",), WIDE + "the weights of a cloud collapse")
NO_POLYNOMIALS = exclude(
    ("places",),
    WIDE + "polynomials of degree 2 have 152 terms, and a cloud collapses",
)
NO_MAPS = exclude(
    ("linear", "star"),
    "the best map is affine: an ensemble with perturbed observations",
) + exclude(("places",), WIDE + "a map has more coefficients than members")
NO_INCREMENTS = exclude(
    KNOWN_POSITIONS,
    "an observation is its own information increment: observations, one hop",
)
NO_POSITION = exclude(KNOWN_POSITIONS, "no agent is uncertain of its position")
DIMS = {"linear": 4, "lorenz": 3, "places": 16, "star": 3, "angles": 4}
NO_GRID = tuple(
    (name, f"{d} components need 40 to the power of {d} cells")
    for name, d in DIMS.items()
)


# ----------------------------------------------------------------------------------------- cells

EXTENDED = "Kalman, extended"
UNSCENTED = "Kalman, unscented"
PERTURBED = "ensemble, perturbed"
KNOWN = "ensemble, known noise"
EXACT = "ensemble, exact draws"
ROOT = "ensemble, square root"
MAPS = "ensemble, separable maps"
GRID = "density on a grid"

ALONE = "nothing"
NEAR = "observations, one hop"
FLOODED = "observations, flooded"
INTERSECTED = "observations, CI by determinant"
AVERAGED = "log-likelihoods, exact average"
PARTIAL = "beliefs, partial fusion"

KALMAN_CELLS = {
    "ekf_alone": Cell(
        EXTENDED, ALONE, gaussian_maker(share_observations=False), *INFLATION
    ),
    "ekf_near": Cell(EXTENDED, NEAR, gaussian_maker(), *INFLATION),
    "ekf_naive": Cell(
        EXTENDED,
        "beliefs, multiplied",
        gaussian_maker(share_observations=False, fusion=network.naive_fusion),
        *INFLATION,
    ),
    "ekf_trace": Cell(
        EXTENDED,
        "observations, CI by trace",
        gaussian_maker(fusion=BY_TRACE),
        *INFLATION,
    ),
    "ekf_ci": Cell(
        EXTENDED, INTERSECTED, gaussian_maker(fusion=BY_DETERMINANT), *INFLATION
    ),
    "ekf_info": Cell(
        EXTENDED,
        "beliefs, four rounds of equal CI",
        gaussian_maker(share_observations=False, fusion=FOUR_ROUNDS),
        *INFLATION,
    ),
    "ekf_two": Cell(
        EXTENDED,
        "information, two rounds",
        gaussian_maker(MeasurementConsensus, agree=TWO_ROUNDS),
        *INFLATION,
    ),
    "ekf_meas": Cell(
        EXTENDED,
        "information, exact average",
        gaussian_maker(MeasurementConsensus),
        *INFLATION,
    ),
    "ekf_flood": Cell(
        EXTENDED,
        FLOODED,
        gaussian_maker(FloodedGaussian, share_observations=False),
        *INFLATION,
    ),
    "ukf_ci": Cell(
        UNSCENTED,
        INTERSECTED,
        gaussian_maker(linearization="unscented", fusion=BY_DETERMINANT),
        *INFLATION,
    ),
    "ukf_flood": Cell(
        UNSCENTED,
        FLOODED,
        gaussian_maker(
            FloodedGaussian, linearization="unscented", share_observations=False
        ),
        *INFLATION,
    ),
    "news": Cell(
        "information increments",
        "increments, one hop",
        target_maker(send_increments=True),
        *INFLATION,
        local=True,
        excluded=NO_INCREMENTS,
    ),
    "own_ci": Cell(
        "Kalman of target and own position",
        "beliefs of the target, equal CI",
        target_maker(send_increments=False),
        *INFLATION,
        local=True,
        excluded=NO_POSITION,
    ),
}
ENSEMBLE_CELLS = {
    "enkf_near": Cell(
        PERTURBED, NEAR, ensemble_maker(enkf_sampled_covariance), *INFLATION
    ),
    "known_near": Cell(KNOWN, NEAR, ensemble_maker(enkf), *INFLATION),
    "known_pull": Cell(KNOWN, "observations, mean pull", make_mean_pull, *GAIN),
    "known_flood": Cell(
        KNOWN,
        FLOODED,
        ensemble_maker(enkf, FloodedEnsemble, share_observations=False),
        *INFLATION,
    ),
    "exact_ci": Cell(EXACT, INTERSECTED, make_exact_ensemble, *INFLATION),
    "root_ci": Cell(
        ROOT,
        INTERSECTED,
        ensemble_maker(etkf, fusion=network.intersect_ensembles),
        *INFLATION,
    ),
    "root_flood": Cell(
        ROOT,
        FLOODED,
        ensemble_maker(etkf, FloodedEnsemble, share_observations=False),
        *INFLATION,
    ),
    "maps_near": Cell(
        MAPS, NEAR, ensemble_maker(SEPARABLE), *INFLATION, excluded=NO_MAPS
    ),
    "maps_flood": Cell(
        MAPS,
        FLOODED,
        ensemble_maker(SEPARABLE, FloodedEnsemble, share_observations=False),
        *INFLATION,
        excluded=NO_MAPS,
    ),
}
PARTICLE_CELLS = {
    "pf_alone": Cell(
        "particles",
        ALONE,
        particle_maker(share_observations=False),
        *JITTER,
        excluded=NO_CLOUD,
    ),
    "pf_near": Cell("particles", NEAR, particle_maker(), *JITTER, excluded=NO_CLOUD),
    "pf_ci": Cell(
        "particles",
        INTERSECTED,
        particle_maker(fusion=intersect_clouds),
        *JITTER,
        excluded=NO_CLOUD,
    ),
    "pf_agreed": Cell(
        "particles",
        "likelihood consensus",
        make_likelihood_consensus,
        *JITTER,
        excluded=NO_POLYNOMIALS,
    ),
    "pf_flood": Cell(
        "particles",
        FLOODED,
        particle_maker(FloodedParticles, share_observations=False),
        *JITTER,
        excluded=NO_CLOUD,
    ),
    "ot_plain": Cell(
        "transport, plain", AVERAGED, transport_maker(), excluded=NO_CLOUD
    ),
    "ot_right": Cell(
        "transport, corrected",
        AVERAGED,
        transport_maker(correct=True),
        excluded=NO_CLOUD,
    ),
    "ot_young": Cell(
        "transport, rejuvenated",
        AVERAGED,
        transport_maker(),
        *REJUVENATION,
        excluded=NO_CLOUD,
    ),
}
DENSITY_CELLS = {
    "gm_c1": Cell("mixture, C1", PARTIAL, mixture_maker("C1"), *INFLATION, local=True),
    "gm_c2": Cell("mixture, C2", PARTIAL, mixture_maker("C2"), *INFLATION, local=True),
    "gm_c3": Cell("mixture, C3", PARTIAL, mixture_maker("C3"), *INFLATION, local=True),
    "grid_near": Cell(GRID, NEAR, grid_maker(), excluded=NO_GRID),
    "grid_mean": Cell(
        GRID,
        "beliefs, geometric mean",
        grid_maker(share_observations=False, fusion=network.average_consensus),
        excluded=NO_GRID,
    ),
    "grid_flood": Cell(
        GRID,
        FLOODED,
        grid_maker(FloodedGrid, share_observations=False),
        excluded=NO_GRID,
    ),
}
CELLS = KALMAN_CELLS | ENSEMBLE_CELLS | PARTICLE_CELLS | DENSITY_CELLS


def cell_names(problem: str) -> list[str]:
    """Return the names of the cells that a problem has."""
    return [name for name, cell in CELLS.items() if not cell.why_excluded(problem)]
