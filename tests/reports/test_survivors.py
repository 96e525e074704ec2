"""Wrong results that the tests once let pass, each with the value that tells it apart.

All of them are of our own making (source: own): an option that a constructor drops, two features
that were never tested together, and cases in which the wrong term vanishes.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from distfilt import coupling, density, network
from distfilt.filters import DensityFilter, MixtureFilter, TransportFilter
from distfilt.mixtures import jeffreys_of_many
from distfilt.models import Swarm
from distfilt.network import Channel, graphs
from distfilt.sensors import Sensor, bearing, component, stack
from distfilt.updates import enkf, principal_components, with_localization
from distfilt.updates.wrappers import gaspari_cohn
from tests.filters.families import still_model

STILL = still_model(1)


def test_the_peclet_number_of_a_face_has_the_diffusion_of_the_face() -> None:
    """Mass crosses a face at the rate B(-z) D_l / Δ², where z = v Δ / D at the face itself."""
    swarm = Swarm(lambda x, t: 0 * x + 0.3, lambda x, t: 0.02 + 0.1 * x)
    grid = density.Grid((5, 4))
    rates = density.FokkerPlanck(swarm, grid).generator(0.0).toarray()
    width = 1 / 5
    for k in range(4):
        # The cells (k, 0) and (k + 1, 0): their centres and the face between them.
        lower = grid.centres[4 * k][0]
        upper = grid.centres[4 * (k + 1)][0]
        z = 0.3 * width / (0.02 + 0.1 * (lower + upper) / 2)
        lower_diffusion = 0.02 + 0.1 * lower
        upper_diffusion = 0.02 + 0.1 * upper
        forwards = -z / np.expm1(-z) * lower_diffusion / width**2
        backwards = z / np.expm1(z) * upper_diffusion / width**2
        assert np.isclose(rates[4 * (k + 1), 4 * k], forwards, rtol=1e-12)
        assert np.isclose(rates[4 * k, 4 * (k + 1)], backwards, rtol=1e-12)


@pytest.mark.parametrize(
    "options", [{"prior_length": 0.4}, {"prior_std": 3.0}, {"mass_std": 0.5}]
)
def test_a_density_filter_starts_with_the_prior_of_its_options(
    options: dict[str, float],
) -> None:
    """Its variances are the squared rows of the factor that `zero_mean_prior` returns."""
    grid = density.Grid((8, 8))
    model = density.FokkerPlanck(Swarm(lambda x, t: 0 * x, 0.02), grid)
    f = DensityFilter(
        model, 3, 2.0, fusion=density.Flooding(), bandwidth=0.2, rank=9, **options
    )
    names = {"prior_length": "length", "prior_std": "std", "mass_std": "mass_std"}
    factor = density.zero_mean_prior(
        grid, rank=9, **{names[name]: value for name, value in options.items()}
    )
    state = f.start(np.full((3, 2), 0.5))
    assert np.allclose(state.variances, (factor**2).sum(axis=1), rtol=1e-12)
    plain = DensityFilter(
        model, 3, 2.0, fusion=density.Flooding(), bandwidth=0.2, rank=9
    )
    # Without the option they are others.
    by_default = plain.start(np.full((3, 2), 0.5)).variances
    assert not np.allclose(by_default, state.variances)


def test_a_density_filter_starts_with_gaussians_of_its_width() -> None:
    """A narrow Gaussian about an agent has a higher peak: (σ₁ / σ₂)² in two dimensions."""
    grid = density.Grid((21, 21))
    model = density.FokkerPlanck(Swarm(lambda x, t: 0 * x, 0.02), grid)
    peaks = []
    for std in (0.08, 0.16):
        f = DensityFilter(
            model, 1, 2.0, fusion=density.Flooding(), bandwidth=0.2, initial_std=std
        )
        peaks.append(f.start([[0.5, 0.5]]).estimates.max())
    assert abs(peaks[0] / peaks[1] - 4) < 0.05


def test_transport_with_correction_has_the_weighted_covariance() -> None:
    """Without it the transported members have less, with N in the denominator of both."""
    walk = still_model(2)
    sensor = component([0], std=0.5)
    x = np.random.default_rng(0).standard_normal((30, 2))
    logs = -0.5 * ((x[:, 0] - 0.7) / 0.5) ** 2
    w = np.exp(logs) / np.exp(logs).sum()
    # Σ w (x - x̄)(x - x̄)ᵀ of the members before the transport
    centred = x - w @ x
    weighted = (w[:, None] * centred).T @ centred
    close = []
    for correct in (True, False):
        f = TransportFilter(walk, [sensor], members=30, correct=correct)
        start = f.start(x, rng=np.random.default_rng(1))
        after = f.step(start, 0.0, [[0.7]])
        members = after.ensembles[0]
        assert np.allclose(members.mean(axis=0), w @ x, atol=1e-12)
        close.append(np.allclose(np.cov(members.T, bias=True), weighted, atol=1e-9))
    assert close == [True, False]


def test_stacked_residuals_are_cut_where_their_sensors_end() -> None:
    """Of [bearing, two components, bearing] the first and the last number wrap alone."""
    sensor = stack(
        [
            bearing([0, 1], std=0.1),
            component([0, 1], std=0.1),
            bearing([0, 1], std=0.1),
        ]
    )
    observed = np.array([3.0, 9.0, -9.0, -3.0])
    predicted = np.array([-3.0, 1.0, 1.0, 3.0])
    residual = sensor.residual(observed, predicted)
    turn = 2 * np.pi
    assert np.allclose(residual, [6 - turn, 8.0, -10.0, turn - 6])


@pytest.mark.parametrize("variant", ["shift", "particle"])
def test_the_safeguard_of_a_projection_looks_at_the_quantity_that_it_moves(
    variant: str,
) -> None:
    """At the mean residual for "shift", at the members' for "particle": x² = 1 tells them apart."""
    square = coupling.Constraint(lambda x: x**2, [1.0])
    verdicts = set()
    for seed in range(300):
        x = np.random.default_rng(seed).normal(0.7, 0.6, (3, 1))
        free = coupling.project(x, square, variant=variant, safeguard=False)
        before = x**2 - 1
        after = free**2 - 1
        by_mean = abs(after.mean()) <= abs(before.mean())
        by_members = np.abs(after).sum() <= np.abs(before).sum()
        accepts = by_mean if variant == "shift" else by_members
        guarded = coupling.project(x, square, variant=variant)
        assert np.allclose(guarded, free if accepts else x)
        verdicts.add((bool(by_mean), bool(by_members)))
    # Both disagreements occur.
    assert {(True, False), (False, True)} <= verdicts


def test_the_gate_of_a_mixture_has_the_spread_of_a_curved_sensor() -> None:
    """x² of N(0, 1) has mean 1 and variance 2: y = 4 is 3²/2.1 away, and 3²/.1 by slope alone."""
    square = Sensor(1, lambda x: x**2, [[0.1]])
    # The chi-squared quantile of 0.99 with one degree is 6.63 > 9 / 2.1 = 4.3.
    f = MixtureFilter(STILL, [square], target_dim=1, gate_probability=0.99)
    start = f.start(([0.0], [[1.0]]))
    assert f.step(start, 0.0, [[4.0]]).rejected == 0
    # And y = 5 with 16 / 2.1 = 7.6 is outside.
    assert f.step(start, 0.0, [[5.0]]).rejected == 1


def test_principal_directions_of_observations_are_those_with_noise() -> None:
    """The first prediction spreads most; with its noise the second does, and it alone is used."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4000, 2)) * [2.0, 1.0]
    noise = np.diag([0.01, 100.0])
    after = principal_components(
        x, x, [2.0, 5.0], noise, rng=rng, n_state=2, n_observed=1
    )
    # The second component is observed with variance 100, the first not at all.
    assert np.allclose(after.mean(axis=0), [0.0, 5.0 / 101], atol=0.15)
    assert np.allclose(after.var(axis=0), [4.0, 100 / 101], rtol=0.1)


def test_localisation_is_by_the_distance() -> None:
    """At (3, 4) the taper is that of distance 5, not of 4 (largest) or of 7 (sum)."""
    x = np.random.default_rng(0).standard_normal((6, 2)) + [0.0, 3.0]
    arguments = x, x[:, :1], [1.0], [[0.5]]
    local = with_localization(
        enkf,
        places=[[0.0, 0.0], [3.0, 4.0]],
        observation_places=[[0.0, 0.0]],
        radius=4.0,
    )
    untapered = enkf(*arguments, rng=np.random.default_rng(7)) - x
    tapered = local(*arguments, rng=np.random.default_rng(7)) - x
    # Gaspari and Cohn at r = 5/4, from their equation (4.10).
    r = 1.25
    high_powers = r**5 / 12 - r**4 / 2 + 5 * r**3 / 8
    low_powers = 5 * r**2 / 3 - 5 * r + 4 - 2 / (3 * r)
    rho = high_powers + low_powers
    assert np.isclose(gaspari_cohn(np.array(r)), rho)
    # Draws of the localised update belong to another stream, so ratios of means are compared.
    moments = np.cov(x.T)
    ratio = moments[0, 1] / moments[0, 0]
    assert np.allclose(tapered[:, 1], rho * ratio * tapered[:, 0], atol=1e-12)
    assert np.allclose(untapered[:, 1], ratio * untapered[:, 0], atol=1e-12)


def test_the_first_threshold_of_events_is_the_threshold() -> None:
    """Both agents move by ½ in the first round: not above .8 · .75, but above .8 · .75²."""
    for threshold, messages in ((0.8, 1), (0.6, 2)):
        channel = Channel(graphs.path(2))
        network.event_triggered(
            np.array([[0.0], [1.0]]),
            channel,
            rounds=2,
            threshold=threshold,
            decay=0.75,
        )
        assert channel.ledger.messages.tolist() == [messages] * 2


@pytest.mark.parametrize("d", [1, 2])
def test_the_ends_of_the_trapezoid_rule_count_half(d: int) -> None:
    """Densities that do not vanish at the ends of the box, against numpy's rule axis by axis."""
    nodes = 5
    axis = np.linspace(0.0, 1.0, nodes)
    slopes = np.array([[2.0, -1.0], [-1.0, 3.0]])[:, :d]
    points = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1)

    def integrate(values: np.ndarray) -> float:
        for _ in range(d):
            values = np.trapezoid(values, axis, axis=-1)
        return float(values)

    logs = [points @ slope for slope in slopes]
    masses = [integrate(np.exp(log)) for log in logs]
    logs = [log - np.log(mass) for log, mass in zip(logs, masses, strict=True)]
    p, q = (np.exp(log) for log in logs)
    log_ratio = logs[0] - logs[1]
    # ½ ∫ (p - q) log(p / q) dx
    expected = 0.5 * integrate((p - q) * log_ratio)
    functions = [partial(np.dot, b=slope) for slope in slopes]
    (result,) = jeffreys_of_many(
        functions[0], functions[1:], np.zeros(d), np.ones(d), nodes=nodes
    )
    assert np.isclose(result.value, expected, rtol=1e-12)
