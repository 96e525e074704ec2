"""Updates: what an ensemble makes of an observation, ``(ensemble, predicted, observed, noise)``."""

from .decorator import update, with_missing
from .gaussian import (
    enkf,
    enkf_exact,
    enkf_sampled_covariance,
    etkf,
    stochastic_forecast,
)
from .particles import effective_size, jitter, resample
from .transport import (
    etpf,
    principal_components,
    principal_directions,
    transport_map_update,
)
from .wrappers import (
    serially,
    with_augmentation,
    with_inflation,
    with_localization,
    with_projection,
    with_retraction,
)

__all__ = [
    "with_augmentation",
    "effective_size",
    "etpf",
    "enkf_exact",
    "with_inflation",
    "jitter",
    "enkf",
    "with_localization",
    "principal_components",
    "principal_directions",
    "with_projection",
    "resample",
    "with_retraction",
    "stochastic_forecast",
    "enkf_sampled_covariance",
    "serially",
    "etkf",
    "transport_map_update",
    "update",
    "with_missing",
]
