"""Retraction of the pendulum's members with the printed cost, the distance itself.

The runs are those of the study `pendulum`, which has retraction with the squared distance
on the same truths, observations and members.
"""

from __future__ import annotations

import numpy as np

from bookkit import studies
from distfilt.updates import with_retraction

pendulum = studies.script("pendulum")

NAME = "retraction-cost"
PAPER = "das"
scenarios = pendulum.scenarios

UPDATES = {
    "retraction": with_retraction(
        pendulum.printed_etpf, pendulum.rod, motion=pendulum.MOTION
    )
}


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Run retraction on one run."""
    truth, observations, members = pendulum.draw_data(np.random.default_rng(seed))
    analysis = pendulum.run_filters(observations, members, ("retraction",), UPDATES)
    return pendulum.score("retraction", analysis[:, 0], truth)


columns = tuple(f"retraction_{key}" for key in pendulum.SCORES)
parameters = dict(pendulum.parameters)
code = pendulum.code
seeds = pendulum.seeds
rtol = 1e-4
# Once a run has lost the swing the last bit decides its path.
max_outliers = 10
