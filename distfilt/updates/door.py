"""The door of an update: its arguments are checked once, and loops go round it.

Every update has the signature ``(ensemble, predicted, observed, noise, *, rng, …) -> ensemble``
and is told four things: the forecast members (..., N, d); what each of them would observe without
noise (..., N, m), on the branch of the observation where a reading wraps; the observation (..., m);
and the covariance of its noise, (m, m) or (..., m, m).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec, cast

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, covariance, generator
from ..linalg import _cholesky

__all__ = ["Update", "joined", "stackable", "unchecked", "update"]

P = ParamSpec("P")

Update = Callable[..., Array]
"""``update(ensemble, predicted, observed, noise, *, rng) -> ensemble``"""


def update(
    function: Callable[Concatenate[Array, Array, Array, Array, P], Array]
) -> Callable[Concatenate[ArrayLike, ArrayLike, ArrayLike, ArrayLike, P], Array]:
    """Let a function that computes an update check what it is given.

    Parameters
    ----------
    function : callable
        ``function(ensemble, predicted, observed, noise, *, rng, …)`` for float64 arrays that fit,
        with a noise covariance for each ensemble or one for all.

    Returns
    -------
    callable
        The same with checks; :func:`unchecked` gives the function back.

    Raises
    ------
    ValueError
        By the result: if a shape does not fit, a number is not finite, `noise` is not positive
        definite, `rng` is no generator or there is one member only.

    Examples
    --------
    >>> @update
    ... def halfway(ensemble, predicted, observed, noise, *, rng):
    ...     return ensemble + 0.5 * (observed[..., None, :] - predicted)
    >>> halfway([[0.0], [2.0]], [[0.0], [2.0]], [4.0], [[1.0]], rng=np.random.default_rng(0))
    array([[2.],
           [3.]])
    """

    callable_(function, "function")

    @wraps(function)
    def checked(
        ensemble: ArrayLike, predicted: ArrayLike, observed: ArrayLike, noise: ArrayLike,
        *args: P.args, **options: P.kwargs,
    ) -> Array:
        x = array(ensemble, "ensemble", (..., "N", "d"))
        if x.shape[-2] < 2:
            raise ValueError(f"ensemble: needs at least 2 members, got {x.shape[-2]}")
        h = array(predicted, "predicted", (*x.shape[:-1], "m"))
        m = h.shape[-1]
        y = array(observed, "observed", (..., m))
        if y.shape not in ((m,), (*x.shape[:-2], m)):
            raise ValueError(f"observed: needs shape {(*x.shape[:-2], m)}, got {y.shape}")
        if y.ndim < x.ndim - 1:
            y = np.broadcast_to(y, (*x.shape[:-2], m))
        r = covariance(noise, "noise", m)
        runs, given = x.shape[:-2], r.shape[:-2]
        fits = all(n in (1, k) for n, k in zip(given[::-1], runs[::-1], strict=False))
        if len(given) > len(runs) or not fits:
            raise ValueError(f"noise: needs leading axes {runs}, got {given}")
        generator(options.get("rng"))
        return function(x, h, y, r, *args, **options)

    checked.unchecked = function  # type: ignore[attr-defined]
    # The wrapper has named parameters, where the type knows places only.
    return cast(Any, checked)  # type: ignore[no-any-return]


def unchecked(update: Update) -> Update:
    """The update without its checks, with the options that :func:`functools.partial` gave it.

    >>> unchecked(print) is print
    True
    """
    if isinstance(update, partial):
        return partial(unchecked(update.func), *update.args, **update.keywords)
    return getattr(update, "unchecked", update)


def stackable(update: Update) -> bool:
    """Whether ensembles with a noise covariance of their own each can be updated in one call.

    True for every update of this package; a plain function gets one agent's at a time.

    >>> stackable(print)
    False
    """
    if isinstance(update, partial):
        return stackable(update.func)
    return bool(getattr(update, "stacks", hasattr(update, "unchecked")))


def joined(wrapper: Callable[..., Array], inner: Update) -> Update:
    """A wrapper's own door, as stackable as what it wraps.

    >>> stackable(joined(lambda x, h, y, r, *, rng: x, print))
    False
    """
    out = update(wrapper)
    out.stacks = stackable(inner)  # type: ignore[attr-defined]
    return out


def perturbed(predicted: Array, noise: Array, rng: np.random.Generator) -> Array:
    """Predictions with a draw of the noise each, (..., N, m)."""
    root = _cholesky(noise)
    return predicted + rng.standard_normal(predicted.shape) @ np.swapaxes(root, -1, -2)
