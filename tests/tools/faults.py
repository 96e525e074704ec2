"""Faults that were made once, put back in one at a time: does the test that was written find each?

    python tests/tools/faults.py [word …]

The wrong answers that a review of the library found, and the changes that its tests did not notice
then. Each is a line of the library, what stood there instead, and the test that has to fail. Writes
data/bench/faults.csv; ends with the number of faults that nobody found.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

if __package__:
    from . import mutants
else:
    import mutants

TABLE = mutants.ROOT / "data" / "bench" / "faults.csv"


class Fault(NamedTuple):
    """What it was, where, the line as it is and as it was, and a test's file and name."""

    what: str
    module: str
    line: str
    fault: str
    test: str


FAULTS = (
    Fault("van Loan of a stiff drift", "linalg.py",
          "halvings = max(0, int(np.ceil(np.log2(max(size, 1.0))))) if np.isfinite(size) else 0",
          "halvings = 0", "test_linalg.py::test_van_loan_of_a_stiff_drift"),
    Fault("a rounded drift", "models/satellite.py", "a[3, 0], a[3, 4] = 3 * n * n, 2 * n",
          "a[3, 0], a[3, 4] = round(3 * n * n, 15), 2 * n",
          "models/test_satellite.py::test_drift_of_a_geostationary_orbit_keeps_its_digits"),
    Fault("a tiny pivot", "linalg.py", "for k in np.argwhere(gap > 32 * d * _EPS):",
          "for k in ():", "test_linalg.py::test_factor_where_a_tiny_pivot_decides"),
    Fault("recolouring by covariances", "gaussians/moving.py",
          "q, r = np.linalg.qr(scaled)",
          "q, r = np.linalg.qr(scaled.astype(np.float32).astype(float))",
          "test_gaussians.py::test_the_draw_that_lost_nine_digits"),
    Fault("a mask is lost", "checks.py", "type(None), np.ma.MaskedArray)", "type(None))",
          "test_checks.py::test_what_is_not_real_numbers_is_refused_by_kind"),
    Fault("an imaginary part is lost", "checks.py",
          '_KINDS = {"b": "booleans", "c": "complex numbers",', '_KINDS = {"b": "booleans",',
          "test_checks.py::test_what_is_not_real_numbers_is_refused_by_kind"),
    Fault("asymmetry judged by the largest entry", "checks.py",
          "np.where(gap > _ROUNDING * _units(out), gap, 0.0).max()",
          "np.where(gap > _ROUNDING * np.abs(out).max(), gap, 0.0).max()",
          "test_checks.py::test_each_matrix_is_judged_alone_and_each_component_in_its_units"),
    Fault("a message aliases", "network/channel.py", "(v.copy(), arrived)", "(v, arrived)",
          "network/test_channel.py::test_a_late_message_is_what_was_sent"),
    Fault("a flow works in place", "models/base.py", "self.flow(state.copy(), t, dt)",
          "self.flow(state, t, dt)",
          "models/test_base.py::test_a_flow_that_works_in_place_leaves_the_caller_s_states"),
    Fault("wrap at its end", "sensors/base.py", "np.where(moved >= half, -half, moved)", "moved",
          "sensors/test_base.py::test_wrap_at_its_ends"),
    Fault("substeps cut off", "network/tracking.py", 'count(substeps, "substeps")', "int(substeps)",
          "test_bad_input.py"),
    Fault("particles alike", "filters/particle.py",
          "if distinct * self.members < least:\n            what", "if False:\n            what",
          "filters/test_families.py::test_collapse_warns_with_step_and_share_and_jitter_helps"),
    Fault("draw's factor transposed", "ensembles.py", "standard_normal(size) @ root.T",
          "standard_normal(size) @ root", "test_ensembles.py"),
    Fault("observe's factor transposed", "sensors/base.py",
          "standard_normal(seen.shape) @ root.T", "standard_normal(seen.shape) @ root",
          "sensors/test_base.py::test_observations_have_the_full_covariance"),
    Fault("the model's factor transposed", "models/base.py", "@ self._root(t, dt).T",
          "@ self._root(t, dt)", "models/test_base.py::test_drawn_noise_has_the_full_covariance"),
    Fault("the update's factor transposed", "updates/door.py", "@ np.swapaxes(root, -1, -2)",
          "@ root", "updates/test_wrappers.py::test_perturbed_has_the_noise_s_covariance"),
    Fault("weights averaged over components", "updates/particles.py", "(half * half).sum(axis=-2)",
          "(half * half).mean(axis=-2)",
          "filters/test_families.py::test_particles_tend_to_the_kalman_filter_with_a_full_noise"),
    Fault("no unwrapping", "filters/heard.py", "np.where(np.isnan(gap), seen, aim - gap)", "seen",
          "filters/test_contract.py::test_direction_across_pi"),
    Fault("the noise is not known", "updates/gaussian.py", "    inner = inner + noise\n",
          "    inner = inner + np.eye(len(noise))\n",
          "updates/test_gaussian.py::test_known_noise_by_its_formula"),
    Fault("noise of the wrong time", "models/base.py", "@ self._root(t, dt).T",
          "@ self._root(0.0, dt).T", "models/test_base.py"),
    Fault("squared error", "filters/record.py", "(summary.mean - known) ** 2",
          "abs(summary.mean - known)",
          "filters/test_contract.py::test_recorded_scores_by_their_definitions"),
    Fault("CRPS of the wrong spread", "filters/record.py", "np.sqrt(summary.variance[keep])",
          "summary.variance[keep]",
          "filters/test_contract.py::test_recorded_scores_by_their_definitions"),
    Fault("mutual loss on one side", "network/channel.py",
          "arrived = arrived & arrived[:, graph.reverse]", "arrived = arrived & arrived",
          "network/test_channel.py::test_one_lost_message_stops_both_sides"),
    Fault("ADMM without its dual check", "network/admm.py", "if primal < small and dual < small:",
          "if primal < small:",
          "network/test_admm.py::test_it_stops_at_the_first_check_below_the_tolerance"),
    Fault("ADMM's dual without rho", "network/admm.py", "gaps * [1.0, penalty]",
          "gaps * [1.0, 1.0]", "network/test_admm.py"),
    Fault("inputs frozen within a step", "network/tracking.py", "now = u + j * h * slope",
          "now = u", "network/test_tracking.py::test_a_step_of_substeps_by_its_equations"),
    Fault("eigenvalues in their order", "network/consensus.py",
          "for eigenvalue in _leja(_distinct(channel.graph.spectrum[1:])):",
          "for eigenvalue in _distinct(channel.graph.spectrum[1:]):",
          "network/test_consensus.py::test_finite_time_on_many_eigenvalues_needs_leja_s_order"),
    Fault("nothing seen is sent", "network/_payloads.py",
          "return first != first and bool(np.isnan(part).all())", "return False",
          "network/test_channel.py::test_nothing_but_nan_is_silence"),
    Fault("own bumps dropped", "triangular/separable.py",
          "bumps, steps = _nodes(joint, p, m), _nodes(joint[..., m:], q, 0)",
          "bumps, steps = _nodes(joint, p, m), 0 * _nodes(joint[..., m:], q, 0) + 1",
          "triangular/test_separable.py::test_fitted_bumps_stand_at_quantiles"),
    Fault("a settled Newton step is rejected", "triangular/inversion.py",
          "steep & (good | (step <= enough))", "steep & good",
          "triangular/test_inversion.py"),
    Fault("a cost in Fortran's order", "coupling/solvers.py", "np.ascontiguousarray(cost)", "cost",
          "coupling/test_solvers.py::test_a_cost_in_any_order_of_memory"),
)


def main(words: list[str] | None = None, table: Path = TABLE) -> int:
    words = sys.argv[1:] if words is None else words
    chosen = [f for f in FAULTS if all(w in f.what for w in words)]
    mutants.warm()
    rows = []
    with tempfile.TemporaryDirectory(prefix="faults-") as scratch:
        folder = mutants.copied(mutants.ROOT, Path(scratch) / "copy")
        for fault in chosen:
            path = folder / "distfilt" / fault.module
            text = path.read_text(encoding="utf-8")
            if text.count(fault.line) < 1:
                raise SystemExit(f"{fault.what}: {fault.module} has no {fault.line!r}")
            path.write_text(text.replace(fault.line, fault.fault, 1), encoding="utf-8")
            found = not mutants.passes([f"tests/{fault.test}"], folder, 200)
            path.write_text(text, encoding="utf-8")
            print("found " if found else "MISSED", fault.what, fault.test, flush=True)
            rows.append((fault.what, fault.module, fault.test, "found" if found else "missed"))
    if not words:
        with table.open("w", encoding="utf-8", newline="") as lines:
            writer = csv.writer(lines, lineterminator="\n")
            writer.writerow(["fault", "module", "test", "result"])
            writer.writerows(rows)
    return sum(row[-1] == "missed" for row in rows)


if __name__ == "__main__":
    sys.exit(main())
