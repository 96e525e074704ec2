"""Updates: what an ensemble makes of an observation, ``(ensemble, predicted, observed, noise)``."""

from .constrained import augmented, clipped, projected, retracted
from .coupling import ensemble_transform, transform_by_agreement
from .door import update
from .forecasts import exact_forecast, sampled_forecast
from .gaussian import exact_draws, known_noise, sampled_noise, square_root
from .missing import with_missing
from .particles import Particles, effective_size, jitter, resample, resampled
from .transport import (
    informed_directions,
    principal_components,
    principal_directions,
    transport,
    transport_sample,
)
from .wrappers import centred, gated, inflated, serial

__all__ = [  # fmt: skip
    "Particles", "augmented", "centred", "clipped", "effective_size", "ensemble_transform",
    "exact_draws", "exact_forecast", "gated", "inflated", "informed_directions", "jitter",
    "known_noise", "principal_components", "principal_directions", "projected", "resample",
    "resampled", "retracted", "sampled_forecast", "sampled_noise", "serial", "square_root",
    "transform_by_agreement", "transport", "transport_sample", "update", "with_missing",
]
