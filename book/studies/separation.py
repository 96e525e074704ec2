"""A family of pairs of bent beliefs, from components far apart to components that overlap.

Neighbouring components of an arc lie 1/c of their standard deviations apart, along the
arc, for a width c (see the study `arcs`). Each trial draws one pair of beliefs and gives
both agents one width after another, with all other numbers kept.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import arcs

NAME = "separation"
PAPER = "semeraro"

# Standard deviations between the means of neighbours
SEPARATIONS = (6.0, 5.0, 4.0, 3.0, 2.0, 1.5, 1.0, 0.75)
RULES = (*arcs.RULES, "moments")
PARTS = ("1", "2", "target")


def column_name(metric: str, separation: float) -> str:
    """Return the name of a column; the separation is in hundredths."""
    return f"{metric}_{round(100 * separation)}"


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Score all rules on one pair, for each separation of the components."""
    for_turn, for_pair, for_points = seed.spawn(3)
    turn = np.random.default_rng(for_turn).uniform(*arcs.BOUNDS["turn"])
    first_seed = int(np.random.default_rng(for_points).integers(2**31))
    columns = {}
    for separation in SEPARATIONS:
        # The same draws for each separation: only the width changes.
        rng = np.random.default_rng(for_pair)
        first_belief, second_belief = (
            arcs.draw_belief(bearing, rng, width=1 / separation)
            for bearing in (np.pi, np.pi + turn)
        )
        scores = arcs.score_rules(first_belief, second_belief, first_seed)
        columns |= {column_name(name, separation): v for name, v in scores.items()}
    return columns


parameters = {
    "members": arcs.MEMBERS,
    "bounds": arcs.BOUNDS,
    "rules": arcs.RULES,
    "separations": SEPARATIONS,
}
columns = [
    column_name(f"{rule}_{part}", separation)
    for separation in SEPARATIONS
    for rule in RULES
    for part in PARTS
]
code = (arcs.draw_belief, arcs.mix, arcs.score_rules)
seeds = np.random.SeedSequence(20262).spawn(60)
rtol = 1e-4
atol = 1e-12
# As in `arcs`: the last bit decides which of nearly equal shapes least squares keep. Where
# components overlap, a thin tail decides the divergence of C1 and C2 as well.
ill_conditioned = columns
