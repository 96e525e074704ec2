"""Updates: what an ensemble makes of an observation, ``(ensemble, predicted, observed, noise)``."""

from .door import update, with_missing
from .gaussian import exact_draws, known_noise, sampled_forecast, sampled_noise, square_root
from .particles import effective_size, jitter, resampled
from .transport import ensemble_transform, principal_components, principal_directions, transport
from .wrappers import augmented, inflated, localised, projected, retracted, serial

__all__ = [  # fmt: skip
    "augmented", "effective_size", "ensemble_transform", "exact_draws", "inflated", "jitter",
    "known_noise", "localised", "principal_components", "principal_directions", "projected",
    "resampled", "retracted", "sampled_forecast", "sampled_noise", "serial", "square_root",
    "transport", "update", "with_missing",
]
