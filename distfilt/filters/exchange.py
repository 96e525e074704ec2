"""The exchange between the agents in a step: of observations, and of beliefs by a fusion rule.

:func:`collect_observations` lets the agents share their observations, and sorts by time those that
each of them has. :func:`fuse_beliefs` applies the filter's fusion rule after the update.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, cast

import numpy as np

from ..network import Channel
from ..network.channel import Payload
from ..sensors import Sensor
from ..validation import (
    Array,
    call_user,
    check_array,
    format_number,
)
from .flooding import flood_observations
from .observations import Observation, sensor_of
from .states import SensorState

if TYPE_CHECKING:
    from .states import AnyState
    from .step import Step

__all__ = ["ObservationsByTime", "collect_observations", "fuse_beliefs"]

ObservationsByTime = dict[float, list[list[tuple[Sensor, Array]]]]
"""By time and then by agent: the sensors and values of the observations that the agent has."""


def collect_observations(step: Step[AnyState]) -> ObservationsByTime:
    """Share the step's observations, and sort by time those that each agent has then.

    An agent has its own observations and those that others sent, ordered by their agents.
    """
    observed = [list(of_agent) for of_agent in step.observations]
    # Delayed observations carry their own time, and are sorted with the others below.
    for observation in step.delayed:
        observed[observation.agent].append(observation)
    sent = _choose_outgoing(step, observed)
    # For each agent the payloads that it receives, by their sender
    inbox: Sequence[Mapping[int, Payload]] = [{} for _ in observed]
    if sent and step.filter.hops != 1:
        inbox = _flood(step, sent)
    elif sent:
        inbox = step.channel.broadcast(_pack(step, sent))
    own_labels = _label(step, observed)
    # Receivers know their neighbours' sensors, so only values travel, and the time and sensor of
    # each are looked up here. Without pending observations what is sent is what was observed.
    has_waited = bool(cast(SensorState, step.state).pending)
    sent_labels = _label(step, sent) if has_waited else own_labels
    by_time: ObservationsByTime = {}
    # Most filters have neither a gate nor sensors of changes.
    is_noted = step.streaks is not None or step.references is not None
    for agent, messages in enumerate(inbox):
        # In order of the senders, so that all agents with the same set have the same order.
        for sender in sorted((agent, *messages)):
            if sender == agent:
                times_and_sensors = own_labels[agent]
                listed = observed[agent]
                values = [observation.value for observation in observed[agent]]
            else:
                times_and_sensors = sent_labels[sender]
                listed = sent[sender]
                payload = messages[sender]
                values = list(payload) if isinstance(payload, tuple) else [payload]
            if is_noted:
                _note_received(step, agent, listed)
            # A payload may end with numbers that describe the values. They count as communication,
            # and are not read: zip stops at the last value.
            for (t, sensor), value in zip(times_and_sensors, values, strict=False):
                if t not in by_time:
                    by_time[t] = [[] for _ in observed]
                by_time[t][agent].append((sensor, value))
    return by_time


def _note_received(
    step: Step[AnyState], agent: int, observations: list[Observation]
) -> None:
    """Note whose observations an agent has: for its gate, and for sensors of changes."""
    if step.streaks is not None:
        for observation in observations:
            step.streaks.note(observation.t, agent, observation)
    # A delayed observation is never of a sensor of changes.
    if step.references is not None:
        for observation in observations:
            if observation.t == step.t:
                step.references.receive(agent, observation)


def _choose_outgoing(
    step: Step[AnyState], observed: list[list[Observation]]
) -> list[list[Observation]]:
    """Choose the observations that each agent sends in this step: its pending and its new ones.

    The list is empty if agents do not share observations. Without a channel at this time nothing is
    sent: the observations wait in ``step.pending`` for the next one, if the filter has a lag, and
    otherwise they are never sent.
    """
    f = step.filter
    if not f.share_observations or f.graph is None:
        return []
    waiting = cast(SensorState, step.state).pending
    if step.channel is None:
        # Only a filter with a lag can assimilate an observation later, at its own time.
        if f.lag:
            # A change since the sensor's last observation cannot wait.
            _refuse_waiting_changes(step, observed)
            # Copies, since the user's array may change before it is sent.
            new = [
                observation.replace(value=observation.value.copy())
                for of_agent in observed
                for observation in of_agent
            ]
            step.pending = (*waiting, *new)
        return []
    # First the pending observations, which the receivers assimilate at their stored times. All
    # leave now: ``step.pending`` stays empty.
    outgoing: list[list[Observation]] = [[] for _ in observed]
    for observation in waiting:
        if observation.t not in step.times:
            raise ValueError(
                f"lag must reach back to t = {format_number(observation.t)}, the time of an "
                f"observation that is sent at the contact at t = {format_number(step.t)}, "
                f"got {f.lag}"
            )
        outgoing[observation.agent].append(observation)
    return [old + new for old, new in zip(outgoing, observed, strict=True)]


def _refuse_waiting_changes(
    step: Step[AnyState], observed: list[list[Observation]]
) -> None:
    """Refuse observations of changes that would wait for the next contact."""
    for of_agent in observed:
        for observation in of_agent:
            if sensor_of(step.filter, observation).uses_previous:
                raise ValueError(
                    "observations of a sensor of changes must be sent at once, got one of "
                    f"agent {observation.agent} at t = {format_number(step.t)}, where the "
                    "graph has no links"
                )


def _pack(step: Step[AnyState], sent: list[list[Observation]]) -> list[Payload | None]:
    """Pack each agent's observations into one payload; None if there is none.

    The usual case, one present observation of the agent's first sensor, is its value alone.
    Otherwise a last part holds the time, the number of the sensor and the metadata of each.
    """
    payloads: list[Payload | None] = []
    for observations, numbers in zip(sent, _describe(step, sent), strict=True):
        values = [observation.value for observation in observations]
        if not values:
            payloads.append(None)
        elif not numbers:
            payloads.append(values[0])
        else:
            # The same labels in all runs.
            labels = np.broadcast_to(np.array(numbers), (*step.runs, len(numbers)))
            payloads.append((*values, labels))
    return payloads


def _describe(step: Step[AnyState], sent: list[list[Observation]]) -> list[list[float]]:
    """Return the numbers that travel with each agent's observations.

    They are time, sensor and metadata of each, as a receiver needs them to use the value. Of a
    single observation of the present time they can be left out where receivers know its sensor: the
    agent's first one, or one of the observation's own without metadata.
    """
    described = []
    for observations in sent:
        numbers: list[float] = []
        if len(observations) == 1:
            (only,) = observations
            # Time and sensor need not be sent: they are now, and the agent's first one.
            if only.t == step.t and only.sensor == 0 and not only.metadata:
                described.append(numbers)
                continue
        for observation in observations:
            # A sensor of the observation's own has no number; its metadata describe it.
            number = observation.sensor if isinstance(observation.sensor, int) else -1
            numbers += [observation.t, number, *observation.metadata]
        # -1 and no metadata: nothing that would describe the sensor
        is_plain = len(observations) == 1 and numbers == [step.t, -1]
        described.append([] if is_plain else numbers)
    return described


def _flood(
    step: Step[AnyState], sent: list[list[Observation]]
) -> Sequence[Mapping[int, Payload]]:
    """Send observations over several links; return the values that each agent receives, by origin.

    The number of the agent that made them travels with them, since a receiver does not know it from
    the link by which they come. It is followed by time, sensor and metadata of each observation,
    where these are needed, see :func:`_describe`.
    """
    bundles: list[tuple[Array, ...] | None] = []
    labels = []
    for agent, description in enumerate(_describe(step, sent)):
        values = tuple([observation.value for observation in sent[agent]])
        # An agent without observations sends nothing of its own.
        bundles.append(values or None)
        # An array, since the channel counts the numbers in a message.
        labels.append(np.array([agent, *description], dtype=float))
    # How many links an observation travels at most
    hops = step.filter.hops
    limit = None if hops == "all" else hops
    return flood_observations(step.channel, bundles, labels, limit)


def _label(
    step: Step[AnyState], observed: list[list[Observation]]
) -> list[list[tuple[float, Sensor]]]:
    """Return the time and the sensor of each agent's observations."""
    labels = []
    for observations in observed:
        of_agent = []
        for observation in observations:
            # A sensor that comes with its observation, or the number of one of the agent's
            sensor = observation.sensor
            if not isinstance(sensor, Sensor):
                sensor = step.filter.agent_sensors[observation.agent][sensor]
            of_agent.append((observation.t, sensor))
        labels.append(of_agent)
    return labels


def fuse_beliefs(step: Step[AnyState], values: tuple[Array, ...]) -> tuple[Array, ...]:
    """Apply the filter's fusion rule to values (*runs, A, ...).

    The rule gets all runs at once. If it raises, each run is fused alone. Failed runs keep their
    values.
    """
    inputs = [v.copy() for v in values]
    if step.any_failed:
        # A failed run's values may make the rule fail again, so those of a good run stand in:
        # `keep_failed` puts its second argument into the failed runs. One run at least is good:
        # otherwise nothing is fused.
        good = tuple(np.argwhere(~step.failed)[0])
        # The values of the first good run, (A, ...), broadcast to all runs.
        inputs = [step.keep_failed(v, v[good]) for v in inputs]
    # Each run's number travels with its values, so that its channel loses the same messages alone
    # as in the batch.
    run_numbers = _number_runs(step.runs)
    channel = step.channel
    ledger = channel.ledger
    # The channels of the attempts that went through. Each starts from the ledger before the fusion,
    # so that no attempt is charged for another.
    used: list[Channel] = []

    def fuse_runs(*arguments: Array) -> tuple[Array, ...]:
        # The last two are what `step.apply` adds for all rows: a shared array and a generator.
        *beliefs, numbers, _shared, _rng = arguments
        attempt = channel.for_run(numbers.astype(np.intp), ledger)
        # A cast: a filter's `fusion` may be None or a protocol, but not where this is called.
        rule = cast("Callable[..., object]", step.filter.fusion)
        results = _apply_rule(rule, beliefs, attempt)
        used.append(attempt)
        return results

    # All runs at once, and one by one if that fails.
    results = step.apply(fuse_runs, (*inputs, run_numbers), values)
    if used:
        step.channel = _merge_channels(channel, used, run_numbers)
    if not step.any_failed:
        return results
    pairs = zip(results, values, strict=True)
    return tuple([step.keep_failed(new, old) for new, old in pairs])


@lru_cache(maxsize=16)
def _number_runs(runs: tuple[int, ...]) -> Array:
    """Return the numbers of the runs of a batch, as floats, read-only."""
    numbers = np.arange(math.prod(runs), dtype=np.float64).reshape(runs)
    numbers.setflags(write=False)
    return numbers


def _apply_rule(
    rule: Callable[..., object], beliefs: list[Array], channel: Channel
) -> tuple[Array, ...]:
    """Call a fusion rule, with one array or a tuple of them, and check its results."""
    is_single = len(beliefs) == 1
    fused = call_user(rule, beliefs[0] if is_single else tuple(beliefs), channel)
    # A rule of one array returns an array, one of several arrays a tuple or list of as many.
    results: tuple[object, ...] = (fused,)
    if not is_single:
        results = tuple(fused) if isinstance(fused, Iterable) else ()
    if len(results) != len(beliefs):
        raise ValueError(
            f"fusion must return {len(beliefs)} arrays, got {len(results)}"
        )
    checked: list[Array] = []
    for new, old in zip(results, beliefs, strict=True):
        # Mostly it is an array that fits: then nothing has to be converted.
        if type(new) is np.ndarray and new.dtype == np.float64:
            fits = new.shape == old.shape
            if fits and math.isfinite(np.vdot(new, new)):
                checked.append(new)
                continue
        checked.append(check_array(new, "fusion", old.shape))
    return tuple(checked)


def _merge_channels(
    before: Channel, used: list[Channel], run_numbers: Array
) -> Channel:
    """Return the channel whose ledger counts the fusion once.

    A ledger counts the messages of one run; those that are lost in some runs are averaged.

    Parameters
    ----------
    before : Channel
        The channel of the step, before the fusion.
    used : list of Channel
        The channels of the attempts that went through: one of all runs, or one for each run that
        could be fused. All runs send the same numbers.
    run_numbers : ndarray, (*runs)
        Numbers of the runs, for the channel that is returned.
    """
    for_batch = [channel for channel in used if channel.runs == run_numbers.shape]
    if for_batch:
        return for_batch[-1]
    # What was sent is the same in each ledger; what was lost is not.
    lost = np.mean([channel.ledger.lost for channel in used], axis=0)
    ledger = used[-1].ledger.replace(lost=lost)
    return before.for_run(run_numbers.astype(np.intp), ledger)
