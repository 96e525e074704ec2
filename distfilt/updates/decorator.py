"""The decorator of updates, and observations with missing components.

Every update has the signature ``(ensemble, predicted, observed, noise, *, rng, …) -> ensemble``.
Its arguments are the forecast members (..., N, d); each member's predicted observation without
noise (..., N, m), unwrapped to the branch of the observation where a component is circular; the
observation (..., m); and the covariance of its noise, (m, m) or (..., m, m).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from inspect import signature
from types import EllipsisType
from typing import Annotated, Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..ensembles import Ensemble
from ..linalg import broadcast_leading, cholesky
from ..validation import (
    ALLOW_NAN,
    Array,
    ArrayInput,
    Indices,
    InvalidArgumentError,
    Mask,
    PositiveDefinite,
    Rng,
    call_user,
    validated,
)

__all__ = [
    "Update",
    "has_tag",
    "perturb_observations",
    "update",
    "with_missing",
    "wraps_update",
]

F = TypeVar("F", bound=Callable[..., Array])

Update = Callable[..., Array]
"""``update(ensemble, predicted, observed, noise, *, rng) -> ensemble``"""


_KINDS = (
    Ensemble,
    Annotated[ArrayInput, "... N m"],
    Annotated[ArrayInput, "... m"],
    Annotated[PositiveDefinite, "... m m"],
)
"""Kinds of an update's first four arguments, whatever their own annotations are."""


def update(function: F) -> F:
    """Add checks of the arguments to a function that computes an update.

    Parameters
    ----------
    function : callable
        ``function(ensemble, predicted, observed, noise, *, rng, …)`` for float64 arrays that fit,
        with a noise covariance for each ensemble or one for all. Annotations of its options are
        checked too, as :mod:`distfilt.validation` describes. In a filter whose runs miss different
        components, every run has draws of its own, of any distribution of numpy's, if they are
        drawn for all runs at once: if the first axes of their shape are those of the ensemble.

    Returns
    -------
    callable
        The same function with checks.

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
    >>> halfway(
    ...     [[0.0], [2.0]], [[0.0], [2.0]], [4.0], [[1.0]], rng=np.random.default_rng(0)
    ... )
    array([[2.],
           [3.]])
    """
    if not hasattr(function, "__annotations__"):
        raise InvalidArgumentError(
            f"function must be a function, got {type(function).__name__}"
        )
    # The names by which the function calls its ensemble, predictions, observation and noise
    data = list(signature(function).parameters)[:4]
    annotations = dict(function.__annotations__)
    annotations.update(zip(data, _KINDS, strict=True))
    annotations["rng"] = Rng

    def call_checked(**arguments: object) -> Array:
        """Call the function with checked arguments, after broadcasting their leading axes."""
        arrays = {}
        for name in data:
            value = arguments.get(name)
            if isinstance(value, np.ndarray):
                arrays[name] = value
        # An argument that is left out is the function's own error.
        if len(arrays) == len(data):
            arguments.update(_share_leading_axes(arrays))
        return call_user(function, **arguments)

    checked = validated(function, call=call_checked, annotations=annotations)
    # A tag, see `has_tag`: it takes a stack of ensembles in one call.
    vars(checked)["stacks"] = True
    return checked


def _share_leading_axes(arrays: dict[str, Array]) -> dict[str, Array]:
    """Return predictions and observation with the ensemble's leading axes, where they differ.

    Given are an update's first four arguments by their names; returned are those that change. They
    are the ensemble (..., N, d), predictions (..., N, m), the observation (..., m) and the noise's
    covariance (..., m, m).
    """
    ensemble, predicted, observed, noise = arrays.values()
    lead = ensemble.shape[:-2]
    leads = (predicted.shape[:-2], observed.shape[:-1], noise.shape[:-2])
    # The usual case: all agree, and the noise has one covariance for each ensemble or one for all.
    if leads[0] == leads[1] == lead and leads[2] in ((), lead):
        return {}
    # The function may call its arguments as it likes.
    _name_ensemble, name_predicted, name_observed, name_noise = arrays
    names = (name_predicted, name_observed, name_noise)
    for name, axes in zip(names, leads, strict=True):
        # The ensemble's axes are the result's: no other argument may add to them.
        if broadcast_leading(lead, axes, name) != lead:
            raise ValueError(f"{name} must have leading axes {lead}, got {axes}")
    return {
        name_predicted: np.broadcast_to(predicted, (*lead, *predicted.shape[-2:])),
        name_observed: np.broadcast_to(observed, (*lead, observed.shape[-1])),
    }


def has_tag(update: Update, tag: str) -> bool:
    """Return whether an update has a tag, an attribute by which a filter knows how to call it.

    ``stacks``: it updates ensembles with a noise covariance each in one call, as every update of
    this package does; a plain function gets one agent's ensemble at a time. ``repredicts``: it
    takes a function ``predict``. ``locates``: it takes ``observation_places``.
    ``accepts_missing``: it gets missing components as NaN. ``weights_members``: it compares each
    member with the observation by itself, so that predicted angles are brought near the observation
    one by one.

    >>> has_tag(print, "stacks")
    False
    """
    # Options fixed by `partial` do not change the tags.
    function = update.func if isinstance(update, partial) else update
    return bool(getattr(function, tag, False))


def wraps_update(wrapped: Update) -> Callable[[F], F]:
    """Decorate a wrapper of an update: it gets the checks of an update and the wrapped one's tags.

    >>> has_tag(wraps_update(print)(lambda x, h, y, r, *, rng: x), "stacks")
    False
    """

    def decorate(wrapper: F) -> F:
        checked = update(wrapper)
        # The attributes by which a filter knows how to call it: see `has_tag`.
        for tag in ("stacks", "accepts_missing", "weights_members"):
            vars(checked)[tag] = has_tag(wrapped, tag)
        return checked

    return decorate


def perturb_observations(
    predicted: Array, noise: Array, rng: Rng, *, centred: bool = False
) -> Array:
    """Add a draw of the noise to each prediction, (..., N, m).

    The draws' sample covariance, with N - 1 in the denominator, is the noise's on average,
    centred or not.
    """
    normal = rng.standard_normal(predicted.shape)
    # The members' mean is then not changed by the draws.
    if centred:
        normal -= normal.mean(axis=-2, keepdims=True)
    # h(x_i) + ζ_i with ζ_i = L ξ_i and R = L Lᵀ; members are rows, so ξ multiplies Lᵀ, of which a
    # contiguous copy is faster. The sum overwrites the draws.
    perturbed = normal @ np.ascontiguousarray(cholesky(noise).mT)
    return np.asarray(np.add(perturbed, predicted, out=perturbed))


@validated
def with_missing(
    update: Update,
    ensemble: Ensemble,
    predicted: Annotated[ArrayInput, "... N m", ALLOW_NAN],
    observed: Annotated[ArrayInput, "... m", ALLOW_NAN],
    noise: Annotated[PositiveDefinite, "... m m"],
    *,
    rng: Rng,
) -> Array:
    """Apply an update where NaN marks a missing component.

    An ensemble without any observation stays as it is. Ensembles that miss the same components
    are updated together, so a batch costs one call for each pattern.

    Parameters
    ----------
    update : callable
        ``update(ensemble, predicted, observed, noise, *, rng)``.
    ensemble : ndarray, (..., N, d)
    predicted : ndarray, (..., N, m)
        NaN for every member where a prediction does not exist; that component is missing too.
    observed : ndarray, (..., m)
        NaN where a component is missing.
    noise : ndarray, (m, m) or (..., m, m)
    rng : numpy.random.Generator

    Examples
    --------
    >>> from distfilt.updates import enkf_exact
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> predicted = np.concatenate([x, x], axis=1)
    >>> after = with_missing(
    ...     enkf_exact,
    ...     x,
    ...     predicted,
    ...     np.array([1.0, np.nan]),
    ...     0.5 * np.eye(2),
    ...     rng=np.random.default_rng(0),
    ... )
    >>> float(after.mean().round(12))
    0.5
    """
    # The axes of a batch of ensembles, such as runs and agents, and the number of components
    lead = observed.shape[:-1]
    m = observed.shape[-1]
    # The caller's generator advances by the same amount for any pattern.
    seed = _draw_seed(rng)
    # The usual case: nothing is missing. A finite sum of squares proves it; it may overflow.
    squares = np.vdot(observed, observed) + np.vdot(predicted, predicted)
    if math.isfinite(squares):
        # A generator made of the seed, by which each row of a batch has draws of its own.
        stream = _stream(rng, seed, m, lead)
        result = call_user(update, ensemble, predicted, observed, noise, rng=stream)
        return result
    # A component needs a value, and a prediction of every member, to be present: (..., m).
    present = ~np.isnan(observed) & ~np.isnan(predicted).any(axis=-2)
    # An update with this tag takes NaN for missing components itself.
    if has_tag(update, "accepts_missing"):
        marked = np.where(present, observed, np.nan)
        stream = _stream(rng, seed, m, lead)
        result = call_user(update, ensemble, predicted, marked, noise, rng=stream)
        return result
    # One call for all ensembles that miss the same components
    return _update_by_pattern(
        update, (ensemble, predicted, observed, noise), present, rng, seed
    )


def _update_by_pattern(
    update: Update,
    data: tuple[Array, Array, Array, Array],
    present: Mask,
    rng: Rng,
    seed: list[int],
) -> Array:
    """Update the ensembles of a batch, those with the same components `present` together.

    `data` are an update's first four arguments; `present` (..., m) marks the components that each
    ensemble has observed and predicted; `seed` is that of the draws.
    """
    ensemble, predicted, observed, noise = data
    lead = observed.shape[:-1]
    m = observed.shape[-1]
    # All leading axes become one, the rows of the batch.
    flat_present = present.reshape(-1, m)
    flat_observed = observed.reshape(-1, m)
    flat_ensemble = ensemble.reshape(-1, *ensemble.shape[-2:])
    flat_predicted = predicted.reshape(-1, *predicted.shape[-2:])
    # One covariance for all rows, or one for each.
    one_noise = noise.ndim == 2
    if not one_noise:
        noise = np.broadcast_to(noise, (*lead, m, m)).reshape(-1, m, m)
    result = flat_ensemble.copy()
    # One call for each set of components.
    for pattern in np.unique(flat_present, axis=0):
        columns = np.flatnonzero(pattern)
        # Without any observation the forecast is the analysis.
        if not columns.size:
            continue
        rows = np.flatnonzero((flat_present == pattern).all(axis=1))
        # Rows and columns of the missing components are deleted from R.
        if one_noise:
            part = noise[np.ix_(columns, columns)]
        else:
            part = noise[np.ix_(rows, columns, columns)]
        # `_stream` gives each row draws of its own, whatever the other rows miss.
        result[rows] = call_user(
            update,
            flat_ensemble[rows],
            flat_predicted[rows][..., columns],
            flat_observed[rows][:, columns],
            part,
            rng=_stream(rng, seed, columns.size, lead, rows),
        )
    return np.asarray(result.reshape(ensemble.shape))


def _draw_seed(rng: Rng) -> list[int]:
    """Draw four words of 32 bits, of which seeds are made.

    They are those of two integers below 2^63, ``rng.integers(2**63, size=2)``, which numpy makes of
    raw draws of 64 bits without the lowest. Raw draws take a fraction of the time.
    """
    # All rows of a batch have the same words.
    source = rng.batch if isinstance(rng, RowGenerator) else rng
    first, second = source.bit_generator.random_raw(2).tolist()
    # Bits 1 to 32 and bits 33 to 63 of each.
    return [first // 2 % 2**32, first >> 33, second // 2 % 2**32, second >> 33]


def _stream(
    rng: Rng,
    seed: list[int],
    m: int,
    lead: tuple[int, ...],
    rows: Indices | EllipsisType = ...,
) -> Rng:
    """Return the random stream of updates with m components, for a batch or some of its rows.

    An ensemble's draws must not depend on which components other ensembles miss. So there is one
    stream for each number m of components, and each stream is drawn for all rows of the batch
    (*lead), of which a :class:`RowGenerator` returns those that are asked for.

    The `seed` is what :func:`_draw_seed` has drawn from `rng`, which says here only whether it
    belongs to some rows of a larger batch.
    """
    # The number of components is part of the seed.
    words = np.array([*seed, m], dtype=np.uint32)
    bits = np.random.PCG64(np.random.SeedSequence(words))
    if isinstance(rng, RowGenerator):
        # The generator is already for some rows of a batch: pick from those.
        return RowGenerator(bits, rng.lead, rng.rows[rows])
    if isinstance(rows, EllipsisType):
        return Rng(bits)
    return RowGenerator(bits, lead, rows)


def _with_key(bits: np.random.BitGenerator, rows: Indices) -> np.random.BitGenerator:
    """Return a stream that belongs to some rows of a batch, from that of the batch."""
    seeds = cast(np.random.SeedSequence, bits.seed_seq)
    key = (*seeds.spawn_key, *rows.tolist())
    return np.random.PCG64(np.random.SeedSequence(seeds.entropy, spawn_key=key))


class RowGenerator(Rng):
    """A generator for a batch (*lead) that returns the draws of some of its rows.

    `rows` are flat indices into the batch. Draws of any distribution are made for the whole
    batch if they have an entry for each row. So two ensembles that miss different components
    have different draws:

    >>> def add_noise(x, h, y, r, *, rng):
    ...     return x + rng.laplace(size=x.shape)
    >>> observed = np.array([[1.0, np.nan], [np.nan, 1.0]])
    >>> a, b = with_missing(
    ...     add_noise,
    ...     np.zeros((2, 3, 1)),
    ...     np.zeros((2, 3, 2)),
    ...     observed,
    ...     np.eye(2),
    ...     rng=np.random.default_rng(0),
    ... )
    >>> bool((a != b).all())
    True
    """

    def __init__(
        self, bits: np.random.BitGenerator, lead: tuple[int, ...], rows: Indices
    ) -> None:
        self.lead = lead
        self.rows = rows
        self.is_partial = rows.size != math.prod(lead)
        # Draws that do not belong to rows, such as a seed, are other ones for other rows.
        super().__init__(_with_key(bits, rows) if self.is_partial else bits)
        self.batch = Rng(bits) if self.is_partial else self

    def spawn(self, n_children: int) -> list[Rng]:
        """Return generators for the same rows, each with a stream of its own."""
        return [
            RowGenerator(bits, self.lead, self.rows)
            for bits in self.batch.bit_generator.spawn(n_children)
        ]

    def permuted(
        self,
        x: ArrayLike,
        *,
        axis: int | None = None,
        out: NDArray[np.generic] | None = None,
    ) -> NDArray[np.generic]:
        """Permute as numpy does, the slices of each row by draws of the row's own.

        Arguments are those of numpy's `permuted`.
        """
        values = np.asarray(x)
        # An array without an axis of the rows is permuted by numpy.
        if not self._has_rows(values.shape) or axis is None:
            return super().permuted(x, axis=axis, out=out)
        # The whole batch is permuted, so that every row uses up its own draws; the rows that are
        # not here get any valid values.
        whole = self._fill_batch(values).reshape(-1, *values.shape[1:])
        mixed = self.batch.permuted(whole, axis=axis)[self.rows]
        if out is None:
            return mixed
        out[...] = mixed
        return out

    def _has_rows(self, shape: tuple[int, ...]) -> bool:
        """Whether draws of a shape have an entry for each row, so that rows have to be selected."""
        return self.is_partial and shape[:1] == self.rows.shape

    def _fill_batch(self, values: Array) -> Array:
        """Return values of the rows (n, ...) in their places of the batch, (*lead, ...)."""
        # The other rows get valid values, those of the first row.
        whole = np.repeat(values[:1], math.prod(self.lead), axis=0)
        whole[self.rows] = values
        return whole.reshape(*self.lead, *values.shape[1:])

    def _extend_parameter(self, parameter: ArrayLike, n_axes: int) -> ArrayLike:
        """Return a distribution's parameter for the rows as one for the whole batch.

        The draws have `n_axes` axes, the first of which are the rows. For n rows it is (n, ...),
        (1, ...) or of fewer axes; for the batch it has the axes *lead in place of the first.
        """
        values = np.asarray(parameter)
        # A parameter without an axis of rows is the same for all rows.
        if values.ndim < n_axes:
            return parameter
        if len(values) == 1:
            return values.reshape((1,) * len(self.lead) + values.shape[1:])
        return self._fill_batch(values)


_PARAMETERS: dict[str, tuple[str, ...]] = {
    "beta": ("a", "b"),
    "binomial": ("n", "p"),
    "chisquare": ("df",),
    "exponential": ("scale",),
    "f": ("dfnum", "dfden"),
    "gamma": ("shape", "scale"),
    "geometric": ("p",),
    "gumbel": ("loc", "scale"),
    "hypergeometric": ("ngood", "nbad", "nsample"),
    "integers": ("low", "high"),
    "laplace": ("loc", "scale"),
    "logistic": ("loc", "scale"),
    "lognormal": ("mean", "sigma"),
    "logseries": ("p",),
    "negative_binomial": ("n", "p"),
    "noncentral_chisquare": ("df", "nonc"),
    "noncentral_f": ("dfnum", "dfden", "nonc"),
    "normal": ("loc", "scale"),
    "pareto": ("a",),
    "poisson": ("lam",),
    "power": ("a",),
    "random": (),
    "rayleigh": ("scale",),
    "standard_cauchy": (),
    "standard_exponential": (),
    "standard_gamma": ("shape",),
    "standard_normal": (),
    "standard_t": ("df",),
    "triangular": ("left", "mode", "right"),
    "uniform": ("low", "high"),
    "vonmises": ("mu", "kappa"),
    "wald": ("mean", "scale"),
    "weibull": ("a",),
    "zipf": ("a",),
}
"""The parameters of each distribution of numpy whose draws are numbers, before ``size``."""
_EVENTS: dict[str, tuple[str, ...]] = {
    "choice": ("a",),
    "dirichlet": ("alpha",),
    "multinomial": ("n", "pvals"),
    "multivariate_hypergeometric": ("colors", "nsample"),
    "multivariate_normal": ("mean", "cov"),
}
"""The same for draws that are vectors, or are made from a list: all rows share parameters."""
_OPTIONS: dict[str, tuple[str, ...]] = {
    "choice": ("replace", "p", "axis", "shuffle"),
    "integers": ("dtype", "endpoint"),
    "multivariate_hypergeometric": ("method",),
    "random": ("dtype", "out"),
    "standard_exponential": ("dtype", "method", "out"),
    "standard_gamma": ("dtype", "out"),
    "standard_normal": ("dtype", "out"),
}
"""Further arguments that may be given by position, after ``size``."""


def _draw_rows(
    name: str, parameters: tuple[str, ...], *, by_row: bool
) -> Callable[..., Array]:
    """Return the method of a distribution that draws for the batch and selects the rows.

    `name` and `parameters` are numpy's; `by_row` says whether each row may have its own parameters.
    The batch has the axes ``self.lead``, and ``self.rows`` (n,) are flat indices into it.
    """
    # numpy's own method, which the new one calls.
    draw = getattr(np.random.Generator, name)
    names = (*parameters, "size", *_OPTIONS.get(name, ()))

    def method(self: RowGenerator, *args: Any, **options: Any) -> Any:
        # This generator is asked for numbers of some rows of a batch, (n, ...). It draws for all
        # rows and selects, so that a row's numbers do not depend on which others are asked for.
        # First all arguments by name, as numpy would bind them.
        bound = dict(zip(names, args, strict=False)) | options
        size = bound.get("size")
        target = bound.get("out")
        if size is None and target is not None:
            shape = target.shape
        elif size is None and by_row:
            # Without a size it is that of the parameters.
            shapes = [np.shape(bound[p]) for p in parameters if p in bound]
            shape = np.broadcast_shapes(*shapes)
        else:
            shape = tuple(size) if np.iterable(size) else ()
        # Draws whose first axis is not that of the rows are numpy's.
        if not self._has_rows(shape):
            return draw(self, *args, **options)
        # Draw for all rows of the batch, (*lead, ...), in place of this generator's, (n, ...).
        # Parameters that the rows have each for themselves get entries for the other rows too.
        for p in parameters:
            if by_row and bound.get(p) is not None:
                bound[p] = self._extend_parameter(bound[p], len(shape))
        bound["size"] = (*self.lead, *shape[1:])
        out = bound.pop("out", None)
        draws = draw(self.batch, **bound)
        # The batch's axes become one, of which `rows` are indices.
        batch_size = math.prod(self.lead)
        flat_draws = draws.reshape(batch_size, *draws.shape[len(self.lead) :])
        selected = flat_draws[self.rows]
        if out is None:
            return selected
        out[...] = selected
        return out

    method.__name__ = name
    method.__doc__ = f"Draw as numpy's `{name}` does, and return the draws of the rows."
    return method


for _name, _parameters in _PARAMETERS.items():
    setattr(RowGenerator, _name, _draw_rows(_name, _parameters, by_row=True))
for _name, _parameters in _EVENTS.items():
    setattr(RowGenerator, _name, _draw_rows(_name, _parameters, by_row=False))
