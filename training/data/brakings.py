"""Brakings to a standstill in recorded traffic, from positions smoothed as those of the drivers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from training.data.events import Events, bumper_gaps
from training.data.smoothing import CUTOFF_ALONG, smooth_positions
from training.data.table import DT, NOBODY, Trajectories

BRAKING_ONSET = 0.5
"""Deceleration [m/s^2] above which a vehicle brakes."""
MIN_SPEED_LOSS = 3.0
"""Least loss of speed [m/s] of a braking that counts."""
STANDSTILL_SPEED = 1.0
"""Speed at the end of a braking [m/s] below which it counts as one to a standstill."""
LEAST_SPEED = -0.2
"""Smoothed speed [m/s] below which the record of a braking is broken."""
END_TICKS = 10
"""Ticks at both ends of a track in which no braking begins or ends: accelerations are least certain there."""
SHORTEST_TRACK = 42
"""Ticks below which a track is too short to show a braking."""

HARD_BRAKE_COLUMNS = ("recording", "frame", "vehicle", "lane", "lead", "speed", "gap", "deceleration")


class TrackBrakings(NamedTuple):
    """Brakings of one track."""

    events: FloatArray
    """Speed and gap at the beginning [m/s, m], strongest deceleration [m/s^2], shape (n, 3)."""
    onsets: NDArray[np.int64]
    """Tick at which each begins, shape (n,)."""

    @classmethod
    def none(cls) -> TrackBrakings:
        """Return no brakings."""
        return cls(np.empty((0, 3)), np.empty(0, dtype=np.int64))


def find_standstill_brakings(position: FloatArray, gap: FloatArray) -> TrackBrakings:
    """Return the brakings of one vehicle that end in a standstill.

    Left out are those in which the smoothed vehicle runs backwards: there the recorded position is frozen or jumps, and
    the deceleration is that of the error. There is one such among 45 brakings on US 101; it alone, with 7.3 m/s^2
    beside 3.8 of the next, would move p of the IDM from 1.7e-6 to 2.3e-5. Left out too are those that are under way
    when the track begins (3 on US 101): speed and gap at their beginning are not known.

    Args:
        position: Position along the road at consecutive ticks [m], shape (T,).
        gap: From bumper to bumper to the vehicle's leader [m], NaN where it is not known, shape (T,).

    Returns:
        Their events, and the tick at which each begins.
    """
    if len(position) < SHORTEST_TRACK:
        return TrackBrakings.none()
    speed = np.gradient(smooth_positions(position, CUTOFF_ALONG, DT), DT)
    acceleration = np.gradient(speed, DT)
    spans = [
        (first, end)
        for first, end in braking_spans(acceleration)
        if speed[end] < STANDSTILL_SPEED
        and speed[first : end + 1].min() > LEAST_SPEED
        and not (first == END_TICKS and acceleration[first - 1] < -BRAKING_ONSET)  # under way before
    ]
    return describe_brakings(speed, acceleration, gap, spans)


def braking_spans(acceleration: FloatArray) -> list[tuple[int, int]]:
    """Return the first tick of each time of braking, and the one behind the last."""
    braking = acceleration < -BRAKING_ONSET
    braking[:END_TICKS] = braking[len(braking) - END_TICKS :] = False
    edges = np.flatnonzero(np.diff(braking.astype(np.int8))) + 1
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def describe_brakings(
    speed: FloatArray, acceleration: FloatArray, gap: FloatArray, spans: Sequence[tuple[int, int]]
) -> TrackBrakings:
    """Return the brakings among times of braking that lose enough speed."""
    chosen = [(i, j) for i, j in spans if speed[i] - speed[j] >= MIN_SPEED_LOSS]
    events = [(speed[i], gap[i], -acceleration[i:j].min()) for i, j in chosen]
    return TrackBrakings(np.array(events).reshape(-1, 3), np.array([i for i, _ in chosen], dtype=np.int64))


def hard_brake_events(trajectories: Trajectories) -> Events:
    """Return brakings to a standstill of any vehicle by `MIN_SPEED_LOSS` or more, at their beginning.

    Returns:
        The columns `HARD_BRAKE_COLUMNS`, each of shape (events,): speed [m/s] of smoothed positions, `gap` from bumper
        to bumper to the vehicle's own leader [m], NaN where none is recorded or a length is not known, the strongest
        `deceleration` [m/s^2]. Who follows the vehicle does not matter, so its own gap stands for that behind it.

    Example:
        >>> from training.data import synthetic_traffic
        >>> len(hard_brake_events(synthetic_traffic(seconds=5.0))["speed"])  # nobody stops
        0
    """
    t = trajectories
    gap = bumper_gaps(t, np.arange(len(t)), np.where(t.leader != NOBODY, t.find_rows(t.leader), -1))
    rows, events = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
    for track in _tracks(t):
        found = find_standstill_brakings(t.x[track], gap[track])
        rows.append(track.start + found.onsets)
        events.append(found.events)
    row, values = np.concatenate(rows), np.concatenate(events)
    return {
        "recording": t.recording[row],
        "frame": t.frame[row],
        "vehicle": t.vehicle[row],
        "lane": t.lane[row],
        "lead": t.leader[row],
        **dict(zip(("speed", "gap", "deceleration"), values.T, strict=True)),
    }


def braking_exposure(trajectories: Trajectories) -> tuple[float, float]:
    """Return for how long [s] and how far [m] vehicles were seen such that a braking could have begun."""
    seconds, metres = 0.0, 0.0
    for track in _tracks(trajectories):
        track_seconds, track_metres = track_exposure(trajectories.x[track])
        seconds, metres = seconds + track_seconds, metres + track_metres
    return seconds, metres


def track_exposure(position: FloatArray) -> tuple[float, float]:
    """Return for how long [s] and how far [m] one vehicle was seen such that a braking could have begun.

    Args:
        position: Position along the road at consecutive ticks [m], shape (T,).
    """
    if len(position) < SHORTEST_TRACK:
        return 0.0, 0.0
    seen = position[END_TICKS : len(position) - END_TICKS]
    return len(seen) * DT, float(np.ptp(seen))


def _tracks(trajectories: Trajectories) -> list[slice]:
    """Return the rows of each track."""
    edges = np.append(trajectories.track_starts(), len(trajectories)).tolist()
    return [slice(first, end) for first, end in pairwise(edges)]
