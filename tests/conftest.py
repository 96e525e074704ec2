"""Property tests take the same examples each time; ``HYPOTHESIS_PROFILE=explore`` new ones."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

# No deadline: a busy machine is no error. Derandomised, a fresh clone passes or fails
# always.
settings.register_profile("gate", derandomize=True, deadline=None, max_examples=40)
settings.register_profile(
    "explore",
    max_examples=2000,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "gate"))
