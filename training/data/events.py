"""Events in recorded traffic: pairs of a follower and its leader, and cut-ins; pooled and written to files.

The definitions are those behind the shipped `us101` distributions; docs/data.md states them in full.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from samplers.problem import FloatArray
from training.data.table import DT, Trajectories

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

CAR_FOLLOWING_COLUMNS = (
    *("recording", "frame", "lane", "ego", "lead", "v_ego", "v_lead", "gap", "a_ego", "a_lead", "n", "at_entry"),
)
CUT_IN_COLUMNS = (
    *("recording", "frame", "phase", "vehicle", "from_lane", "to_lane", "start_seen", "v_cutin", "lateral_speed"),
    *("ego", "v_ego", "gap_ego_cutin", "lateral_offset", "lead", "v_lead", "gap_cutin_lead", "duration"),
)


def car_following_events(trajectories: Trajectories) -> Events:
    """Return the first frame of each pair of ego and leader that is seen in one lane for `MIN_PAIR_FRAMES` or more.

    Returns:
        The columns `CAR_FOLLOWING_COLUMNS`, each of shape (events,): speeds [m/s], accelerations [m/s^2], `gap` from
        bumper to bumper [m], `n` frames the pair was seen for, and `at_entry`. The last says whether the ego was seen
        first at that frame: such a pair shows following under way, not its beginning. In the order of the table: by
        ego, then by time.

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
    """Return distances from bumper to bumper between two rows each [m], NaN where a row is -1.

    Args:
        trajectories: The table.
        behind: Rows of the rear vehicles, shape (n,).
        before: Rows of the front vehicles, shape (n,).
    """
    t = trajectories
    value = t.x[before] - t.x[behind] - 0.5 * (t.length[before] + t.length[behind])
    return np.where((behind >= 0) & (before >= 0), value, np.nan)


def find_lane_changes(trajectories: Trajectories) -> NDArray[np.int64]:
    """Return rows that are the first in a neighbouring lane, `MIN_LANE_FRAMES` or more in one lane on either side."""
    t = trajectories
    new_track = np.zeros(len(t), dtype=bool)
    new_track[t.track_starts()] = True
    runs = np.flatnonzero(new_track | np.append(True, np.diff(t.lane) != 0))
    length = np.diff(np.append(runs, len(t)))
    settled = (length[1:] >= MIN_LANE_FRAMES) & (length[:-1] >= MIN_LANE_FRAMES)
    lane, before = t.lane[runs[1:]], t.lane[runs[:-1]]
    neighbours = (np.abs(lane - before) == 1) & (lane > 0) & (before > 0)
    crossings: NDArray[np.int64] = runs[1:][settled & neighbours & ~new_track[runs[1:]]]
    return crossings


def find_start(trajectories: Trajectories, crossing: int, first: int) -> tuple[int, bool]:
    """Return the row at which a lane change began, and whether its beginning was recorded.

    Going back from the crossing, that is the last row before the speed towards the new lane, over the `LATERAL_SPAN`
    frames up to it, fell to `LATERAL_SPEED` or less. If it never did, the first row of the track is returned, and
    False. Where y was not recorded, that is the row `ASSUMED_START` frames before the crossing, and False.

    Args:
        trajectories: The table.
        crossing: First row in the new lane.
        first: First row of the vehicle's track.
    """
    t = trajectories
    if np.isnan(t.y[crossing]):
        return max(crossing - ASSUMED_START, first), False
    side = np.sign(t.lane[crossing] - t.lane[crossing - 1])
    row = crossing
    while row - LATERAL_SPAN >= first:
        if side * (t.y[row] - t.y[row - LATERAL_SPAN]) <= LATERAL_SPEED * LATERAL_SPAN * DT:
            return row, True
        row -= 1
    return row, False


def find_duration(trajectories: Trajectories, crossing: int, first: int, last: int) -> float:
    """Return the duration of the course of a lane change [s]; NaN where its start or its end was not recorded.

    The end is found as the start is, see `find_start`: going on from the crossing, the first row from which the speed
    over `LATERAL_SPAN` frames fell to `LATERAL_SPEED` or less. The displacement is that from the last slow span before
    the change to the first one after it.

    Args:
        trajectories: The table.
        crossing: First row in the new lane.
        first: First row of the vehicle's track.
        last: Its last row.
    """
    t = trajectories
    start, seen = find_start(t, crossing, first)
    side = np.sign(t.lane[crossing] - t.lane[crossing - 1])
    for end in range(crossing, last - LATERAL_SPAN + 1) if seen else ():
        if side * (t.y[end + LATERAL_SPAN] - t.y[end]) <= LATERAL_SPEED * LATERAL_SPAN * DT:
            above = time_between_spans(np.array([start]), np.array([end]))
            moved = side * (t.y[end + LATERAL_SPAN] - t.y[start - LATERAL_SPAN])
            return float(course_durations(above, np.array([moved]))[0])
    return float("nan")


def cut_in_events(trajectories: Trajectories) -> Events:
    """Return lane changes, each at its start and at its crossing, with the vehicles behind and ahead in the new lane.

    Returns:
        The columns `CUT_IN_COLUMNS`, each of shape (2 changes,): ego is the nearest vehicle behind in the new lane,
        lead the nearest ahead in it, -1 and NaN where there is none. Gaps are bumper to bumper (negative: side by
        side). Also the lateral offset from ego [m]; `lateral_speed` towards the new lane over 0.8 s around the crossing
        [m/s]; `duration` of the cubic course that moves across for as long [s], NaN where start or end was not
        recorded.

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
    t = trajectories
    breaks = t.track_starts()
    crossings = find_lane_changes(t)
    track = np.searchsorted(breaks, crossings, side="right") - 1
    firsts, lasts = breaks[track], np.append(breaks[1:], len(t))[track] - 1
    starts = [find_start(t, int(c), int(first)) for c, first in zip(crossings, firsts, strict=True)]
    rows = np.column_stack([crossings, [row for row, _ in starts]]).ravel().astype(np.int64)
    change = np.repeat(crossings, 2)
    spans = zip(crossings.tolist(), firsts.tolist(), lasts.tolist(), strict=True)
    durations = np.array([find_duration(t, *span) for span in spans], dtype=float)
    ego, lead = _find_neighbours(t, rows, t.lane[change])
    side = np.sign(t.lane[change] - t.lane[change - 1])
    reach = MIN_LANE_FRAMES // 2
    return {
        "recording": t.recording[rows],
        "frame": t.frame[rows],
        "phase": np.tile(["crossing", "start"], len(crossings)),
        "vehicle": t.vehicle[rows],
        "from_lane": t.lane[change - 1],
        "to_lane": t.lane[change],
        "start_seen": np.repeat(np.array([seen for _, seen in starts], dtype=bool), 2),
        "v_cutin": t.speed[rows],
        "lateral_speed": side * (t.y[change + reach] - t.y[change - reach]) / (2 * reach * DT)
        if len(rows)
        else t.y[:0],
        "ego": np.where(ego >= 0, t.vehicle[ego], -1),
        "v_ego": np.where(ego >= 0, t.speed[ego], np.nan),
        "gap_ego_cutin": bumper_gaps(t, ego, rows),
        "lateral_offset": np.where(ego >= 0, np.abs(t.y[rows] - t.y[ego]), np.nan),
        "lead": np.where(lead >= 0, t.vehicle[lead], -1),
        "v_lead": np.where(lead >= 0, t.speed[lead], np.nan),
        "gap_cutin_lead": bumper_gaps(t, rows, lead),
        "duration": np.repeat(durations, 2),
    }


def _find_neighbours(
    t: Trajectories, rows: NDArray[np.int64], lane: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of the nearest vehicles behind and ahead in a lane, by their fronts, at the frames of rows.

    Args:
        t: The table.
        rows: Rows of the vehicles whose neighbours are sought, shape (n,).
        lane: Lane that is searched for each, shape (n,).

    Returns:
        Rows behind and rows ahead, shape (n,) each; -1 where there is none.
    """
    front = t.x + 0.5 * np.nan_to_num(t.length)
    recording = np.unique(t.recording, return_inverse=True)[1].ravel()
    moment = recording * (np.ptp(t.frame) + 1) + t.frame - t.frame.min()
    order = np.argsort(moment, kind="stable")
    low, high = (np.searchsorted(moment[order], moment[rows], side) for side in ("left", "right"))
    behind, before = np.full(len(rows), -1), np.full(len(rows), -1)
    for i, (row, number) in enumerate(zip(rows, lane, strict=True)):
        others = order[low[i] : high[i]]
        others = others[(t.lane[others] == number) & (t.vehicle[others] != t.vehicle[row])]
        back, ahead = (others[front[others] <= front[row]], others[front[others] > front[row]])
        if back.size:
            behind[i] = back[np.argmax(front[back])]
        if ahead.size:
            before[i] = ahead[np.argmin(front[ahead])]
    return behind, before


def course_durations(above: FloatArray, displacement: FloatArray) -> FloatArray:
    """Return the durations T of cubic courses that move across faster than `LATERAL_SPEED` for as long as recorded.

    A recording shows for how long a vehicle moves across faster than some speed; when it begins and ends to move cannot
    be seen. The course y = D (3 t^2 - 2 t^3), t from 0 to 1 in T, has the speed across 6 D t (1 - t) / T, above v for
    T sqrt(1 - 2 v T / (3 D)). The shorter of the two T is taken; where a course never moves that long, the one that
    does so longest, T = D / v.

    Args:
        above: Time above `LATERAL_SPEED` [s], shape (n,).
        displacement: D [m], shape (n,).

    Returns:
        T [s], shape (n,); NaN where the time is not known or the vehicle did not move to its new side.
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


def time_between_spans(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the time above `LATERAL_SPEED` of changes that are found by their mean speed over `LATERAL_SPAN` frames.

    The last slow span before a change ends at its start, the first slow one after it begins at its end. The speed falls
    to that of a span in its middle, half a frame nearer to the change in the mean.

    Args:
        start: Frames of the starts, shape (n,).
        end: Frames of the ends, shape (n,).
    """
    return (end - start + LATERAL_SPAN - 1) * DT


def concatenate_events(parts: Sequence[Events]) -> Events:
    """Return the events of several tables as one.

    Raises:
        ValueError: No table is given.
    """
    if not parts:
        raise ValueError("Expected events of at least one recording, got none.")
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def write_events(events: Mapping[str, NDArray[Any]], path: Path | str) -> None:
    """Write events to a CSV file, missing values as empty fields."""
    columns = {
        name: pa.array(np.round(values, 4) if values.dtype.kind == "f" else values, from_pandas=True)
        for name, values in events.items()
    }
    csv.write_csv(pa.table(columns), path)
