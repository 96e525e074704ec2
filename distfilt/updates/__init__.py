"""Updates: what an ensemble makes of an observation, ``(ensemble, predicted, observed, noise)``."""

from .decorator import update, with_missing
from .gaussian import enkf_exact, enkf, stochastic_forecast, enkf_sampled_covariance, etkf
from .particles import effective_size, jitter, resample
from .transport import etpf, principal_components, principal_directions, transport_map_update
from .wrappers import with_augmentation, with_inflation, with_localization, with_projection, with_retraction, serially

__all__ = [  # fmt: skip
    "with_augmentation", "effective_size", "etpf", "enkf_exact", "with_inflation", "jitter",
    "enkf", "with_localization", "principal_components", "principal_directions", "with_projection",
    "resample", "with_retraction", "stochastic_forecast", "enkf_sampled_covariance", "serially", "etkf",
    "transport_map_update", "update", "with_missing",
]
