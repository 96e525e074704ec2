"""The paper's reduction (41) inside its filter in orbit: the error with it and without it.

The draws are those of the study `orbit`. Before an agent fuses with C3, each mixture that
it receives is reduced by (41), with the printed factor: components that overlap with none
of the agent's own are merged into one.
"""

from __future__ import annotations

import numpy as np

from bookkit import studies
from distfilt.mixtures import GaussianMixture, fuse_mixtures, merge_irrelevant

choices = studies.script("orbit-choices")
paper = choices.paper

NAME = "relevance"
PAPER = "semeraro"
THRESHOLD = 40.0
"""The paper's factor of (41), a note of the scenario."""


class RelevantFusion:
    """Fusion with C3 of received mixtures that (41) has reduced; counts their components."""

    def __init__(self) -> None:
        self.received = 0
        self.left = 0

    def __call__(
        self, own: GaussianMixture, received: list[GaussianMixture]
    ) -> GaussianMixture:
        target = own.marginal(range(6))
        reduced = [
            merge_irrelevant(mixture, target, threshold=THRESHOLD)
            for mixture in received
        ]
        self.received += sum(mixture.n_components for mixture in received)
        self.left += sum(mixture.n_components for mixture in reduced)
        return fuse_mixtures(own, reduced)


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Run the filter with (41), on the data of one run of the study `orbit`."""
    # Its first child is the seed of the paper's scene.
    rng = np.random.default_rng(seed.spawn(1)[0])
    truth, *inputs = paper.simulate(paper.SETTING, rng)
    fusion = RelevantFusion()
    options = {**paper.MANY, "fusion": fusion}
    row = choices.run_row(paper.SETTING, options, truth, tuple(inputs))
    row["share_left"] = fusion.left / fusion.received
    return {name: float(paper.SIX.format(value)) for name, value in row.items()}


columns = (*choices.METRICS, "share_left")
parameters = {"setting": paper.SETTING, "threshold": THRESHOLD}
code = (*paper.run_code, choices.run_row, RelevantFusion)
scenarios = paper.scenarios
seeds = paper.seeds
rtol = 1e-3
# The last bit decides which components are merged, and the later hours with them.
max_outliers = 2
