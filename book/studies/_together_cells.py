"""The compared filters of chapter 11: a `Cell` is a family of filters with a rule of exchange.

A cell makes its filter for any problem and for any value of its one tuned option.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any

import numpy as np
from _together_filters import (
    LikelihoodConsensus,
    SharedPlanFilter,
    SplitIntersection,
    average_on_tree,
    tree_graph,
)
from _together_mixtures import BatchedMixtures
from _together_problems import STUDY, THREE, Problem

from distfilt import network
from distfilt.density import Grid
from distfilt.filters import (
    ChannelFilter,
    EnsembleFilter,
    Filter,
    GaussianFilter,
    GaussianSumFilter,
    GridFilter,
    InformationConsensusFilter,
    InformationIncrementFilter,
    MixtureFilter,
    ParticleFilter,
)
from distfilt.mixtures import split_gaussian, target_fusion
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
    one_by_one : bool
        Whether the filter follows one run at a time.
    excluded : tuple of (str, str)
        Problems that this filter cannot have, each with the reason.
    """

    family: str
    exchange: str
    make: Maker
    option: str = ""
    grid: tuple[float, ...] = ()
    local: bool = False
    one_by_one: bool = False
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


def consensus_maker(average: str, rule: Callable[..., Array]) -> Maker:
    """Return a maker of Kalman filters that average information; the value is the inflation."""
    return gaussian_maker(InformationConsensusFilter, average=average, fusion=rule)


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


@dataclass(frozen=True, eq=False)
class SplitSum(GaussianSumFilter):
    """A Gaussian sum filter that splits a Gaussian prior along its first two components."""

    _: KW_ONLY
    parts: int = 3

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """Return the parts of the prior."""
        mixture = split_gaussian(*prior, parts=self.parts, axes=[0, 1])
        return super().initial_state(mixture, runs, rng)


def sum_maker(parts: int, hops: int | str) -> Maker:
    """Return a maker of unscented Gaussian sums with a number of parts along two axes."""

    def make(p: Problem, value: float) -> Filter:
        return SplitSum(
            p.model,
            p.sensors,
            p.graph,
            parts=parts,
            linearization="unscented",
            inflation=value,
            hops=hops,
            on_error="keep",
        )

    return make


def make_channel_filter(p: Problem, value: float) -> Filter:
    """Make channel filters on a spanning tree of the graph."""
    tree = tree_graph(p.graph)
    return ChannelFilter(p.model, p.sensors, tree, inflation=value, on_error="keep")


def make_increments(p: Problem, value: float) -> Filter:
    """Make filters of [target; own position] that send increments; nothing is tuned."""
    local = p.local
    return InformationIncrementFilter(
        local.model, local.sensors, p.graph, target_dim=len(p.scored)
    )


def make_target_intersection(p: Problem, value: float) -> Filter:
    """Make filters of [target; own position] that intersect beliefs of the target."""
    n = len(p.scored)
    return MixtureFilter(
        p.local.model,
        p.local.sensors,
        p.graph,
        target_dim=n,
        n_components=1,
        max_components=1,
        fusion=partial(target_fusion, target_dim=n),
    )


def square_grid(cells: int = 40) -> Grid:
    """Return a grid on the square of 18 m in which the targets in the plane stay."""
    return Grid((cells, cells), low=-9.0, high=9.0)


def grid_maker(**options: Any) -> Maker:
    """Return a maker of grid filters, which have no tuned option."""

    def make(p: Problem, value: float) -> Filter:
        return GridFilter(
            p.model, p.sensors, p.graph, grid=square_grid(), on_error="keep", **options
        )

    return make


# --------------------------------------------------------------- options and excluded problems

BY_DETERMINANT = partial(covariance_intersection, rule="min_determinant")
BY_TRACE = partial(covariance_intersection, rule="trace")
FOUR_ROUNDS = partial(covariance_intersection, rounds=4)
TWO_ROUNDS = partial(network.average_consensus, rounds=2)
FOUR_AVERAGES = partial(network.average_consensus, rounds=4)
TRIGGERED = partial(
    network.event_triggered,
    rounds=STUDY["triggered_rounds"],
    threshold=STUDY["trigger"],
)
# Inflation below one serves underconfident filters, such as intersection.
# The library accepts none below 0.5.
INFLATION = (
    "inflation",
    (0.5, 0.6, 0.75, 0.9, 1.0, 1.05, 1.15, 1.3, 1.6, 2.2, 3.2, 4.5),
)
# No jitter, no gain and no rejuvenation are the natural lower ends.
JITTER = ("jitter", (0.0, 0.05, 0.1, 0.2, 0.4, 0.7))
GAIN = ("gain", (0.0, 0.003, 0.006, 0.0125, 0.025, 0.05, 0.1, 0.2, 0.3))
REJUVENATION = ("rejuvenation", (0.0, 0.1, 0.2, 0.4, 0.8, 1.2, 1.8))
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
NO_UNION = exclude(
    ("places",), WIDE + "its search for the smallest union takes a minute a run"
)
NO_SUM = exclude(
    ("linear", "places", "star"),
    "a sum of Kalman filters of a linear problem is one Kalman filter",
)
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
ITERATED = "Kalman, iterated"
UNSCENTED = "Kalman, unscented"
PERTURBED = "ensemble, perturbed"
KNOWN = "ensemble, known noise"
EXACT = "ensemble, exact draws"
ROOT = "ensemble, square root"
MAPS = "ensemble, separable maps"
GRID = "density on a grid"
SUM = "Gaussian sum of "

ALONE = "nothing"
NEAR = "observations, one hop"
TWO_HOPS = "observations, two hops"
FLOODED = "observations, flooded"
INTERSECTED = "observations, CI by determinant"
AVERAGED = "log-likelihoods, exact average"
PARTIAL = "beliefs, partial fusion"

KALMAN_CELLS = {
    # The lower end of the scale: each agent has its own observations.
    "ekf_alone": Cell(
        EXTENDED, ALONE, gaussian_maker(share_observations=False), *INFLATION
    ),
    # One value to each neighbour; an agent updates with all that it has.
    "ekf_near": Cell(EXTENDED, NEAR, gaussian_maker(), *INFLATION),
    # Products of beliefs count what both have seen twice.
    "ekf_naive": Cell(
        EXTENDED,
        "beliefs, multiplied",
        gaussian_maker(share_observations=False, fusion=network.naive_fusion),
        *INFLATION,
    ),
    # Weights in proportion to 1 / trace P, without a search.
    "ekf_trace": Cell(
        EXTENDED,
        "observations, CI by trace",
        gaussian_maker(fusion=BY_TRACE),
        *INFLATION,
    ),
    # Weights that minimize the determinant of the fused covariance.
    "ekf_ci": Cell(
        EXTENDED, INTERSECTED, gaussian_maker(fusion=BY_DETERMINANT), *INFLATION
    ),
    # Battistelli and Chisci (2014): four rounds of geometric means.
    "ekf_info": Cell(
        EXTENDED,
        "beliefs, four rounds of equal CI",
        gaussian_maker(share_observations=False, fusion=FOUR_ROUNDS),
        *INFLATION,
    ),
    # A times an average of two rounds is not yet the sum.
    "ekf_two": Cell(
        EXTENDED,
        "information, two rounds",
        consensus_maker("measurements", TWO_ROUNDS),
        *INFLATION,
    ),
    # As many rounds as the graph has different eigenvalues give the exact average.
    "ekf_meas": Cell(
        EXTENDED,
        "information, exact average",
        consensus_maker("measurements", network.finite_time_consensus),
        *INFLATION,
    ),
    # Every agent is the joint filter.
    "ekf_flood": Cell(
        EXTENDED,
        FLOODED,
        gaussian_maker(hops="all"),
        *INFLATION,
    ),
    # Half of the ring of eight lies within two hops, and the agent itself.
    "ekf_hops": Cell(EXTENDED, TWO_HOPS, gaussian_maker(hops=2), *INFLATION),
    # The mode of the posterior instead of one linearization.
    "iekf_flood": Cell(
        ITERATED, FLOODED, gaussian_maker(hops="all", iterations=4), *INFLATION
    ),
    # Two messages on each of A - 1 links, whatever A.
    "ekf_tree": Cell(
        EXTENDED,
        "information, summed on a spanning tree",
        consensus_maker("measurements", average_on_tree),
        *INFLATION,
    ),
    # Beliefs less what both ends of a link know already.
    "ekf_channel": Cell(
        EXTENDED,
        "beliefs, channel filter on a spanning tree",
        make_channel_filter,
        *INFLATION,
    ),
    # Kamal et al. (2013): A times the average of P⁻¹/A + HᵀR⁻¹H.
    "ekf_icf": Cell(
        EXTENDED,
        "information and priors, four rounds (ICF)",
        consensus_maker("weighted", FOUR_AVERAGES),
        *INFLATION,
    ),
    # Battistelli et al. (2015), with γ = A: twice the numbers of the row above.
    "ekf_hcmci": Cell(
        EXTENDED,
        "information, priors apart, four rounds (HCMCI)",
        consensus_maker("hybrid", FOUR_AVERAGES),
        *INFLATION,
    ),
    # Cattivelli and Sayed (2010): covariances are not sent.
    "ekf_diffuse": Cell(
        EXTENDED,
        "observations, then means (diffusion)",
        gaussian_maker(fusion=network.diffuse_means),
        *INFLATION,
    ),
    # Less cautious than intersection: only what may be common is removed.
    "ekf_inverted": Cell(
        EXTENDED,
        "observations, inverse CI",
        gaussian_maker(fusion=network.inverse_covariance_intersection),
        *INFLATION,
    ),
    # Along each direction the better of two estimates.
    "ekf_ellipsoid": Cell(
        EXTENDED,
        "observations, ellipsoidal intersection",
        gaussian_maker(fusion=network.ellipsoidal_intersection),
        *INFLATION,
    ),
    # More cautious than intersection: either estimate may be wrong.
    "ekf_union": Cell(
        EXTENDED,
        "observations, covariance union",
        gaussian_maker(fusion=network.covariance_union),
        *INFLATION,
        excluded=NO_UNION,
    ),
    # Only the part of an error that may be common is discounted.
    "ekf_split": Cell(
        EXTENDED,
        "beliefs, split CI",
        gaussian_maker(SplitIntersection),
        *INFLATION,
    ),
    # Eight rounds, in which an agent is silent while its value changes little.
    "ekf_event": Cell(
        EXTENDED,
        "information, averaged when it changes",
        consensus_maker("measurements", TRIGGERED),
        *INFLATION,
    ),
    # Unscented points instead of derivatives, with three rules of exchange.
    "ukf_near": Cell(
        UNSCENTED, NEAR, gaussian_maker(linearization="unscented"), *INFLATION
    ),
    "ukf_hops": Cell(
        UNSCENTED,
        TWO_HOPS,
        gaussian_maker(linearization="unscented", hops=2),
        *INFLATION,
    ),
    # Diffusion with unscented points.
    "ukf_diffuse": Cell(
        UNSCENTED,
        "observations, then means (diffusion)",
        gaussian_maker(linearization="unscented", fusion=network.diffuse_means),
        *INFLATION,
    ),
    # Intersection with unscented points.
    "ukf_ci": Cell(
        UNSCENTED,
        INTERSECTED,
        gaussian_maker(linearization="unscented", fusion=BY_DETERMINANT),
        *INFLATION,
    ),
    "ukf_flood": Cell(
        UNSCENTED,
        FLOODED,
        gaussian_maker(linearization="unscented", hops="all"),
        *INFLATION,
    ),
    # What an observation adds about the target, r(n + 1) - r(r - 1)/2 numbers.
    "news": Cell(
        "information increments",
        "increments, one hop",
        make_increments,
        local=True,
        one_by_one=True,
        excluded=NO_INCREMENTS,
    ),
    # Agents do not keep the correlation of their positions with each other.
    "own_ci": Cell(
        "Kalman of target and own position",
        "beliefs of the target, equal CI",
        make_target_intersection,
        local=True,
        one_by_one=True,
        excluded=NO_POSITION,
    ),
}
ENSEMBLE_CELLS = {
    # Evensen's filter: perturbed observations, sampled noise covariance.
    "enkf_near": Cell(
        PERTURBED, NEAR, ensemble_maker(enkf_sampled_covariance), *INFLATION
    ),
    # The known R in place of the sampled one.
    "known_near": Cell(KNOWN, NEAR, ensemble_maker(enkf), *INFLATION),
    # The published rule of Grange et al.: means pull each other.
    "known_pull": Cell(KNOWN, "observations, mean pull", make_mean_pull, *GAIN),
    "known_flood": Cell(
        KNOWN,
        FLOODED,
        ensemble_maker(enkf, hops="all"),
        *INFLATION,
    ),
    # Draws with exactly the moments of the fused Gaussian.
    "exact_ci": Cell(EXACT, INTERSECTED, make_exact_ensemble, *INFLATION),
    # A square root that leaves the order of the members.
    "root_ci": Cell(
        ROOT,
        INTERSECTED,
        ensemble_maker(etkf, fusion=network.intersect_ensembles),
        *INFLATION,
    ),
    "root_flood": Cell(
        ROOT,
        FLOODED,
        ensemble_maker(etkf, hops="all"),
        *INFLATION,
    ),
    # Curved updates, one component after another.
    "maps_near": Cell(
        MAPS, NEAR, ensemble_maker(SEPARABLE), *INFLATION, excluded=NO_MAPS
    ),
    "maps_flood": Cell(
        MAPS,
        FLOODED,
        ensemble_maker(SEPARABLE, hops="all"),
        *INFLATION,
        excluded=NO_MAPS,
    ),
}
PARTICLE_CELLS = {
    # Particles with the same rules as Kalman filters.
    "pf_alone": Cell(
        "particles",
        ALONE,
        particle_maker(share_observations=False),
        *JITTER,
        excluded=NO_CLOUD,
    ),
    "pf_near": Cell("particles", NEAR, particle_maker(), *JITTER, excluded=NO_CLOUD),
    # Clouds are fused by their moments.
    "pf_ci": Cell(
        "particles",
        INTERSECTED,
        particle_maker(fusion=intersect_clouds),
        *JITTER,
        excluded=NO_CLOUD,
    ),
    # Polynomials of the log-likelihood on common particles.
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
        particle_maker(hops="all"),
        *JITTER,
        excluded=NO_CLOUD,
    ),
    # Weights by all likelihoods, then optimal transport to equal weights.
    "ot_plain": Cell(
        "transport, plain", AVERAGED, transport_maker(), excluded=NO_CLOUD
    ),
    # The second moment is corrected after the transport.
    "ot_right": Cell(
        "transport, corrected",
        AVERAGED,
        transport_maker(correct=True),
        excluded=NO_CLOUD,
    ),
    # Noise gives the members a width again.
    "ot_young": Cell(
        "transport, rejuvenated",
        AVERAGED,
        transport_maker(),
        *REJUVENATION,
        excluded=NO_CLOUD,
    ),
}
DENSITY_CELLS = {
    # Parts of the prior follow both modes; no beliefs are sent.
    "sum9_near": Cell(SUM + "9", NEAR, sum_maker(3, 1), *INFLATION, excluded=NO_SUM),
    "sum9_hops": Cell(
        SUM + "9", TWO_HOPS, sum_maker(3, 2), *INFLATION, excluded=NO_SUM
    ),
    # The more parts, the nearer to the exact posterior.
    "sum4_flood": Cell(
        SUM + "4", FLOODED, sum_maker(2, "all"), *INFLATION, excluded=NO_SUM
    ),
    "sum9_flood": Cell(
        SUM + "9", FLOODED, sum_maker(3, "all"), *INFLATION, excluded=NO_SUM
    ),
    "sum16_flood": Cell(
        SUM + "16", FLOODED, sum_maker(4, "all"), *INFLATION, excluded=NO_SUM
    ),
    # Mixtures of three, by the rules of chapter 7.
    "gm_c1": Cell("mixture, C1", PARTIAL, mixture_maker("C1"), *INFLATION, local=True),
    "gm_c2": Cell("mixture, C2", PARTIAL, mixture_maker("C2"), *INFLATION, local=True),
    "gm_c3": Cell("mixture, C3", PARTIAL, mixture_maker("C3"), *INFLATION, local=True),
    # Exact but for the size of the cells, with three rules of exchange.
    "grid_near": Cell(GRID, NEAR, grid_maker(), excluded=NO_GRID),
    # The geometric mean of all beliefs counts nothing twice, and is too wide.
    "grid_mean": Cell(
        GRID,
        "beliefs, geometric mean",
        grid_maker(share_observations=False, fusion=network.average_consensus),
        excluded=NO_GRID,
    ),
    "grid_flood": Cell(
        GRID,
        FLOODED,
        grid_maker(hops="all"),
        excluded=NO_GRID,
    ),
}
CELLS = KALMAN_CELLS | ENSEMBLE_CELLS | PARTICLE_CELLS | DENSITY_CELLS


def cell_names(problem: str) -> list[str]:
    """Return the names of the cells that a problem has."""
    return [name for name, cell in CELLS.items() if not cell.why_excluded(problem)]
