"""Events in recorded traffic: pairs of a follower and its leader, cut-ins, and brakings to a standstill.

The definitions are those behind the shipped `us101` distributions; docs/data.md states them in full.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from samplers.problem import FloatArray
from training.data.table import CUTOFF_ALONG, DT, NOBODY, Trajectories, smooth_positions

Events = dict[str, NDArray[Any]]

MIN_PAIR_FRAMES = 20
"""Least number of frames for which a pair of ego and leader is seen in one lane: 2 s."""
MIN_LANE_FRAMES = 8
"""Least number of frames in one lane on either side of a lane change: 0.8 s."""
ASSUMED_START = 13
"""Frames from the start of a lane change to its crossing where positions across were not recorded: mean of the 42
recorded starts on US 101 (1.3 s, standard deviation 0.9 s)."""
LATERAL_SPEED = 0.2
"""Speed across above which a lane change has begun and is not over [m/s]."""
LATERAL_SPAN = 5
"""Number of frames over which the speed across is measured: 0.5 s."""

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
MEAN_SECONDS, ANSWER_SECONDS = 2.0, 3.0
"""Time after an event over which the mean acceleration is taken, and within which the hardest braking [s]."""
MEAN_REACH = 3
"""Ticks on either side of the later moment whose mean speed is taken."""
ANSWERS = ("mean_a_ego", "braking_ego", "mean_a_cutin", "braking_cutin")
"""Columns of what follows the start of a cut-in: those of `measure_answers` of the ego and of the cutter."""
SHORTEST_TRACK = 42
"""Ticks below which a track is too short to show a braking."""


def car_following_events(trajectories: Trajectories) -> Events:
    """Return the first frame of each pair of ego and leader that is seen in one lane for `MIN_PAIR_FRAMES` or more.

    Returns:
        The columns recording, frame, lane, ego, lead, v_ego, v_lead, gap, a_ego, a_lead, n and at_entry, each of shape
        (events,): speeds [m/s], accelerations [m/s^2], `gap` from bumper to bumper [m], `n` frames the pair was seen
        for, and `at_entry`. The last says whether the ego was seen first at that frame: such a pair shows following
        under way, not its beginning. In the order of the table: by ego, then by time.

    Example:
        >>> from training.data import synthetic_traffic
        >>> pairs = car_following_events(synthetic_traffic(seconds=4.0, per_lane=2))
        >>> pairs["ego"].tolist(), pairs["lead"].tolist(), pairs["gap"].round(1).tolist()
        ([0, 1, 2], [3, 4, 5], [20.3, 20.4, 20.6])
    """
    t = trajectories
    leader = t.find_rows(t.leader)
    rows = np.flatnonzero(leader >= 0)
    rows = rows[t.lane[leader[rows]] == t.lane[rows]]
    recording = np.unique(t.recording, return_inverse=True)[1].ravel()
    pairs = np.column_stack([recording[rows], t.vehicle[rows], t.leader[rows]])
    _, first, n = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    seen = n >= MIN_PAIR_FRAMES
    order = np.argsort(first[seen])
    ego, n = rows[first[seen][order]], n[seen][order]
    lead = leader[ego]
    return {
        "recording": t.recording[ego],
        "frame": t.frame[ego],
        "lane": t.lane[ego],
        "ego": t.vehicle[ego],
        "lead": t.vehicle[lead],
        "v_ego": t.speed[ego],
        "v_lead": t.speed[lead],
        "gap": bumper_gaps(t, ego, lead),
        "a_ego": t.acceleration[ego],
        "a_lead": t.acceleration[lead],
        "n": n,
        "at_entry": np.isin(ego, t.track_starts()),
    }


def bumper_gaps(trajectories: Trajectories, behind: NDArray[np.int64], before: NDArray[np.int64]) -> FloatArray:
    """Return distances from bumper to bumper between rows behind and before (n,) [m], NaN if a row is -1."""
    t = trajectories
    value = t.x[before] - t.x[behind] - 0.5 * (t.length[before] + t.length[behind])
    return np.where((behind >= 0) & (before >= 0), value, np.nan)


def _find_course(t: Trajectories, crossing: int, first: int, last: int) -> tuple[int, bool, float]:
    """Return the row at which a lane change began, whether that was recorded, and the duration of its course [s].

    Of the track from the first to the last row, the start is the last row before the crossing (the first row in the new
    lane) at which the speed towards the new lane, over the `LATERAL_SPAN` frames up to it, fell to `LATERAL_SPEED` or
    less. If it never did, that is the first row of the track; where y was not recorded, the row `ASSUMED_START` frames
    before the crossing. The end is found in the same way, going on. The displacement is that from the last slow span
    before the change to the first one after it; NaN without a start or an end.
    """
    if np.isnan(t.y[crossing]):
        return max(crossing - ASSUMED_START, first), False, float("nan")
    across = np.sign(t.lane[crossing] - t.lane[crossing - 1]) * t.y[first : last + 1]
    moved, here = across[LATERAL_SPAN:] - across[:-LATERAL_SPAN], crossing - first
    slow = np.flatnonzero(moved <= LATERAL_SPEED * LATERAL_SPAN * DT)  # spans by their first frame
    before, after = slow[slow + LATERAL_SPAN <= here], slow[slow >= here]
    if not len(before):
        return min(crossing, first + LATERAL_SPAN - 1), False, float("nan")
    if not len(after):
        return first + int(before[-1]) + LATERAL_SPAN, True, float("nan")
    above = time_between_spans(before[-1:] + LATERAL_SPAN, after[:1])
    duration = course_durations(above, across[after[:1] + LATERAL_SPAN] - across[before[-1:]])
    return first + int(before[-1]) + LATERAL_SPAN, True, float(duration[0])


def cut_in_events(trajectories: Trajectories) -> Events:
    """Return lane changes, each at its start and at its crossing, with the vehicles behind and ahead in the new lane.

    Returns:
        The columns recording, frame, phase, vehicle, from_lane, to_lane, start_seen, v_cutin, lateral_speed, ego,
        v_ego, gap_ego_cutin, lateral_offset, lead, v_lead, gap_cutin_lead, duration and those of `ANSWERS`, each of
        shape (2 changes,). Ego is the nearest vehicle behind in the new lane, lead the nearest ahead in it, -1 and NaN
        if there is none. Gaps are bumper to bumper (negative: side by side). Also the lateral offset from ego [m];
        `lateral_speed` towards the new lane over 0.8 s around the crossing [m/s]; `duration` of the cubic course that
        moves across for as long [s], NaN if start or end was not recorded; of ego and cutter, see `measure_answers`,
        the mean acceleration and the hardest braking that follow [m/s^2].

    Example:
        >>> from dataclasses import replace
        >>> from training.data import synthetic_traffic
        >>> table = synthetic_traffic(seconds=6.0)
        >>> moved = 3.6 * np.clip((table.time - 2.0) / 3.0, 0.0, 1.0) * (table.vehicle == 4)
        >>> lane = 1 + np.searchsorted([3.6, 7.2], table.y + moved)
        >>> cuts = cut_in_events(replace(table, y=table.y + moved, lane=lane))
        >>> cuts["phase"].tolist(), cuts["vehicle"].tolist(), cuts["to_lane"].tolist()
        (['crossing', 'start'], [4, 4], [3, 3])
    """
    t, breaks = trajectories, trajectories.track_starts()
    new_track = np.isin(np.arange(len(t)), breaks)
    runs = np.flatnonzero(new_track | np.append(True, np.diff(t.lane) != 0))  # of frames in one lane
    settled = np.diff(np.append(runs, len(t))) >= MIN_LANE_FRAMES
    lane, before = t.lane[runs[1:]], t.lane[runs[:-1]]
    neighbours = (np.abs(lane - before) == 1) & (lane > 0) & (before > 0)
    crossings = runs[1:][settled[1:] & settled[:-1] & neighbours & ~new_track[runs[1:]]]
    track = np.searchsorted(breaks, crossings, side="right") - 1
    spans = np.column_stack([crossings, breaks[track], np.append(breaks[1:], len(t))[track] - 1])
    courses = np.array([_find_course(t, *span) for span in spans.tolist()]).reshape(-1, 3)
    starts, seen, durations = courses.T
    rows = np.column_stack([crossings, starts]).ravel().astype(np.int64)
    change = np.repeat(crossings, 2)
    ego, lead = _find_neighbours(t, rows, t.lane[change])
    side = np.sign(t.lane[change] - t.lane[change - 1])
    reach = MIN_LANE_FRAMES // 2
    answers = np.hstack([measure_answers(breaks, t.x, t.speed, which) for which in (ego, rows)])
    return {
        "recording": t.recording[rows],
        "frame": t.frame[rows],
        "phase": np.tile(["crossing", "start"], len(crossings)),
        "vehicle": t.vehicle[rows],
        "from_lane": t.lane[change - 1],
        "to_lane": t.lane[change],
        "start_seen": np.repeat(seen.astype(bool), 2),
        "v_cutin": t.speed[rows],
        "lateral_speed": side * (t.y[change + reach] - t.y[change - reach]) / (2 * reach * DT),
        "ego": np.where(ego >= 0, t.vehicle[ego], -1),
        "v_ego": np.where(ego >= 0, t.speed[ego], np.nan),
        "gap_ego_cutin": bumper_gaps(t, ego, rows),
        "lateral_offset": np.where(ego >= 0, np.abs(t.y[rows] - t.y[ego]), np.nan),
        "lead": np.where(lead >= 0, t.vehicle[lead], -1),
        "v_lead": np.where(lead >= 0, t.speed[lead], np.nan),
        "gap_cutin_lead": bumper_gaps(t, rows, lead),
        "duration": np.repeat(durations, 2),
        **dict(zip(ANSWERS, answers.T, strict=True)),
    }


def measure_answers(
    breaks: NDArray[np.int64], position: FloatArray, speed: FloatArray, rows: NDArray[np.int64]
) -> FloatArray:
    """Return mean accelerations over the 2 s after rows, and the hardest braking in 3 s [m/s^2], (n, 2).

    The rows are of tracks one behind the other, which begin at the rows `breaks`; position along the road [m] and speed
    as recorded [m/s] are theirs. The later speed is the mean of 0.7 s about its moment, as speeds jitter; the braking
    is that of the positions smoothed at 0.40 Hz, 0 if there is none. NaN if the track ends before, or a row is -1.
    """
    ends = np.append(breaks, len(position))
    track = np.searchsorted(breaks, rows, side="right") - 1
    found = np.full((len(rows), 2), np.nan)
    for answer, (row, first, end) in zip(found, zip(rows, ends[track], ends[track + 1], strict=True), strict=True):
        later, last = row + round(MEAN_SECONDS / DT), row + round(ANSWER_SECONDS / DT)
        if row >= 0 and later < end:
            reach = min(MEAN_REACH, end - 1 - later)
            answer[0] = (speed[later - reach : later + reach + 1].mean() - speed[row]) / MEAN_SECONDS
        if row >= 0 and last < end:
            acceleration = _smooth_motion(position[first:end])[1]
            answer[1] = max(-acceleration[row - first : last - first + 1].min(), 0.0)
    return found


def _find_neighbours(
    t: Trajectories, rows: NDArray[np.int64], lane: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows nearest behind and ahead of rows in a lane, by their fronts, (n,) each; -1: none."""
    front = t.x + 0.5 * np.nan_to_num(t.length)
    recording = np.unique(t.recording, return_inverse=True)[1].ravel()
    moment = recording * (np.ptp(t.frame) + 1) + t.frame - t.frame.min()
    order = np.argsort(moment, kind="stable")
    low, high = (np.searchsorted(moment[order], moment[rows], side) for side in ("left", "right"))
    behind, before = np.full(len(rows), -1), np.full(len(rows), -1)
    for i, (row, number) in enumerate(zip(rows, lane, strict=True)):
        others = order[low[i] : high[i]]
        others = others[(t.lane[others] == number) & (t.vehicle[others] != t.vehicle[row])]
        others = others[np.argsort(front[others], kind="stable")]
        place = np.searchsorted(front[others], front[row], side="right")
        behind[i], before[i] = np.concatenate([[-1], others, [-1]])[place : place + 2]
    return behind, before


def course_durations(above: FloatArray, displacement: FloatArray) -> FloatArray:
    """Return the durations T of cubic courses that move across faster than `LATERAL_SPEED` for as long as recorded.

    A recording shows for how long a vehicle moves across faster than some speed; when it begins and ends to move cannot
    be seen. The course y = D (3 t^2 - 2 t^3), t from 0 to 1 in T, has the speed across 6 D t (1 - t) / T, above v for
    T sqrt(1 - 2 v T / (3 D)). The shorter of the two T is taken; where a course never moves that long, the one that
    does so longest, T = D / v. NaN if the time above (n,) [s] is not known or D (n,) [m] is not positive.
    """
    known = np.isfinite(above) & (displacement > 0.0)
    time, side = np.where(known, above, 0.0), np.where(known, displacement, 1.0)
    low, high = np.zeros_like(time), side / LATERAL_SPEED
    for _ in range(60):
        middle = 0.5 * (low + high)
        short = middle * np.sqrt(np.maximum(1.0 - 2.0 * LATERAL_SPEED * middle / (3.0 * side), 0.0)) < time
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.where(known, low, np.nan)


def time_around_peak(speed: FloatArray, time: FloatArray) -> float:
    """Return how long the speed is above `LATERAL_SPEED` around its largest value [s]."""
    slow = np.flatnonzero(speed <= LATERAL_SPEED)
    peak = int(np.argmax(speed))
    first = slow[slow < peak].max(initial=-1) + 1
    behind = slow[slow > peak].min(initial=len(speed))
    return float((behind - first) * np.median(np.diff(time)))


def time_between_spans(start: NDArray[Any], end: NDArray[Any]) -> FloatArray:
    """Return the time above `LATERAL_SPEED` [s] between the start and end frames (n,) of the slow spans around changes.

    The speed falls to that of a span in its middle, half a frame nearer to the change in the mean.
    """
    return np.asarray((end - start + LATERAL_SPAN - 1) * DT, dtype=np.float64)


def write_events(events: Mapping[str, NDArray[Any]], path: Path | str) -> None:
    """Write events to a CSV file, missing values as empty fields."""
    columns = {
        name: pa.array(np.round(values, 4) if values.dtype.kind == "f" else values, from_pandas=True)
        for name, values in events.items()
    }
    csv.write_csv(pa.table(columns), path)


def _smooth_motion(position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return speed and acceleration of smoothed positions along the road, (T,) each [m/s, m/s^2]."""
    speed = np.gradient(smooth_positions(position, CUTOFF_ALONG), DT)
    return speed, np.gradient(speed, DT)


def find_brakings(position: FloatArray, gap: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return speed and gap at the beginning, peak deceleration and loss of speed of brakings (n, 4), and onsets.

    The loss of a braking to a standstill, which ends below `STANDSTILL_SPEED`, is all of the speed.

    Position along the road and gap to the leader (NaN where it is not known) are those of one vehicle at consecutive
    ticks (T,) [m]; the onset (n,) is the tick at which a braking begins. Left out are those under way when the track
    begins or ends, and those in which the smoothed vehicle runs backwards: there the recorded position is frozen or
    jumps, and the deceleration is that of the error (7.3 m/s^2 for one on US 101, beside 3.8 of the next).
    """
    events, onsets = [], []
    if len(position) >= SHORTEST_TRACK:
        speed, acceleration = _smooth_motion(position)
        braking = acceleration < -BRAKING_ONSET
        braking[:END_TICKS] = braking[len(braking) - END_TICKS :] = False
        edges = np.flatnonzero(np.diff(braking.astype(np.int8))) + 1
        for first, end in edges.reshape(-1, 2).tolist():
            under_way = first == END_TICKS and acceleration[first - 1] < -BRAKING_ONSET
            stops = speed[end] < STANDSTILL_SPEED
            goes_on = end == len(braking) - END_TICKS and acceleration[end] < -BRAKING_ONSET and not stops
            whole = speed[first : end + 1].min() > LEAST_SPEED and not under_way and not goes_on
            if whole and speed[first] - speed[end] >= MIN_SPEED_LOSS:
                loss = speed[first] - (0.0 if stops else speed[end])
                events.append((speed[first], gap[first], -acceleration[first:end].min(), loss))
                onsets.append(first)
    return np.array(events).reshape(-1, 4), np.array(onsets, dtype=np.int64)


def hard_brake_events(trajectories: Trajectories) -> Events:
    """Return brakings of any vehicle by `MIN_SPEED_LOSS` or more, at their beginning.

    Returns:
        The columns recording, frame, vehicle, lane, lead, speed, gap, peak and loss, each of shape (events,): speed
        [m/s] of smoothed positions, `gap` from bumper to bumper to the vehicle's own leader [m], NaN if none is
        recorded or a length is not known, the `peak` of the deceleration [m/s^2] and the `loss` of speed [m/s], all of
        it in a braking to a standstill. Who follows the vehicle does not matter, so its own gap stands for that behind
        it.

    Example:
        >>> from training.data import synthetic_traffic
        >>> len(hard_brake_events(synthetic_traffic(seconds=5.0))["speed"])  # nobody brakes
        0
    """
    t = trajectories
    gap = bumper_gaps(t, np.arange(len(t)), np.where(t.leader != NOBODY, t.find_rows(t.leader), -1))
    rows, events = [np.empty(0, dtype=np.int64)], [np.empty((0, 4))]
    for track in np.split(np.arange(len(t)), t.track_starts()[1:]):
        found, onsets = find_brakings(t.x[track], gap[track])
        rows.append(track[onsets])
        events.append(found)
    row, values = np.concatenate(rows), np.concatenate(events)
    return {
        "recording": t.recording[row],
        "frame": t.frame[row],
        "vehicle": t.vehicle[row],
        "lane": t.lane[row],
        "lead": t.leader[row],
        **dict(zip(("speed", "gap", "peak", "loss"), values.T, strict=True)),
    }


def braking_exposure(tracks: Iterable[FloatArray]) -> tuple[float, float]:
    """Return for how long [s] and how far [m] tracks (T,) [m] were seen so that a braking could have begun."""
    seen = [x[END_TICKS : len(x) - END_TICKS] for x in tracks if len(x) >= SHORTEST_TRACK]
    return sum(len(x) * DT for x in seen), float(sum(np.ptp(x) for x in seen))
