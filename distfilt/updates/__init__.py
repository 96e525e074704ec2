"""Updates of an ensemble by an observation, ``(ensemble, predicted, observed, noise)``."""

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
    "effective_size",
    "enkf",
    "enkf_exact",
    "enkf_sampled_covariance",
    "etkf",
    "etpf",
    "jitter",
    "principal_components",
    "principal_directions",
    "resample",
    "serially",
    "stochastic_forecast",
    "transport_map_update",
    "update",
    "with_augmentation",
    "with_inflation",
    "with_localization",
    "with_missing",
    "with_projection",
    "with_retraction",
]
