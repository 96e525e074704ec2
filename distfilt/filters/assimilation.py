"""What one step does with the observations: share them, predict them, condition on them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..checks import Array
from ..network import Channel
from ..sensors import Sensor, stack

__all__ = ["Update", "assimilate"]

Update = Callable[..., Array]
"""``update(ensemble, predicted, observed, noise, *, rng) -> ensemble``"""


def assimilate(
    stack: list[Array],
    slot: int,
    observed: Sequence[Array | None],
    sensors: Sequence[Sensor | None],
    update: Update,
    channel: Channel,
    rng: np.random.Generator,
    *,
    previous: Array | None = None,
) -> None:
    """Condition the ensembles of every time in `stack` on what was observed at time `slot`.

    Parameters
    ----------
    stack : list of ndarray, (*runs, A, N, d)
        Ensembles of earlier times and, last, of now; changed in place.
    slot : int
        Which of them was observed.
    observed : sequence of length A
        Per agent (*runs, m), with NaN where a component is missing, or None.
    sensors : sequence of Sensor or None
        What each agent sees with.
    update : callable
        The update.
    channel : Channel
        Carries each observation to those that hear its agent.
    rng : numpy.random.Generator
        Advanced by the draws of one update.
    previous : ndarray, (*runs, A, N, d), optional
        Members at the time before `slot`, for sensors that see changes.
    """
    inbox = channel.exchange(observed)
    for agent, own in enumerate(observed):
        heard = dict(inbox[agent])
        if own is not None:
            heard[agent] = own
        if not heard:
            continue
        before = None if previous is None else previous[..., agent, :, :]
        joint = _joint(heard, sensors, stack[slot][..., agent, :, :], before)
        for k, ensembles in enumerate(stack):
            # Every time's members meet the same draw of the noise, so that all the separate
            # updates are one joint update; the last one advances the generator.
            source = rng if k == len(stack) - 1 else copy.deepcopy(rng)
            members = ensembles[..., agent, :, :]
            ensembles[..., agent, :, :] = _by_pattern(update, members, *joint, source)


def _joint(
    heard: Mapping[int, Array],
    sensors: Sequence[Sensor | None],
    members: Array,
    before: Array | None,
) -> tuple[Array, Array, Array]:
    """Predictions (*runs, N, M), observations (*runs, M) and noise (M, M) of all that was heard."""
    blind = [agent for agent in heard if sensors[agent] is None]
    if blind:
        raise ValueError(f"sensors: needs a sensor for agent {blind[0]}, which observed")
    senders = sorted(heard)
    both = stack([s for a in senders if (s := sensors[a]) is not None])
    target = np.concatenate([heard[agent] for agent in senders], axis=-1)
    predicted = both.predict(members, before)
    # Readings that wrap are predicted on the branch of the observation: y* - wrap(y* - p).
    gap = both.residual(target[..., None, :], predicted)
    unwrapped = np.where(np.isnan(gap), predicted, target[..., None, :] - gap)
    return unwrapped, target, both.noise


def _by_pattern(
    update: Update,
    members: Array,
    predicted: Array,
    target: Array,
    noise: Array,
    rng: np.random.Generator,
) -> Array:
    """Update runs that miss the same components together, with those components left out."""
    present = ~np.isnan(target)
    if present.all():
        return update(members, predicted, target, noise, rng=rng)
    flat = present.reshape(-1, present.shape[-1])
    rows = members.reshape(-1, *members.shape[-2:])
    seen = predicted.reshape(-1, *predicted.shape[-2:])
    aim = target.reshape(-1, target.shape[-1])
    out = rows.copy()
    for pattern in np.unique(flat, axis=0):
        keep = np.flatnonzero(pattern)
        runs = np.flatnonzero((flat == pattern).all(axis=1))
        if keep.size:
            cov = noise[np.ix_(keep, keep)]
            out[runs] = update(
                rows[runs], seen[runs][..., keep], aim[runs][:, keep], cov, rng=rng
            )
    return out.reshape(members.shape)
