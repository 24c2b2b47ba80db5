"""Lateral displacement and duration of recorded lane changes together: the last two columns of a cut-in.

The tables are those of `lateral_offsets`. The two belong together: changes that go farther take longer, with a
correlation of .36 (US 101) and .42 (I-80) between displacement and log duration, and BIC is worse by 31 and 20 where
they are independent. Of 247 changes on US 101 neither goes with the speed or the gap ahead (Spearman's rank correlation
with the duration -.03 and .06), so that they are drawn apart from the speeds and gaps of a cut-in.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from samplers.problem import FloatArray
from training.data.events import course_durations, time_around_peak, time_between_spans
from training.data.table import DT, read_columns
from training.scenario_fitting.event_filters import read_csv_columns
from training.scenario_fitting.shipped.lateral_offsets import (
    CHANGES_FILE,
    PROFILES_FILE,
    settled_changes,
    settled_displacements,
    split_profiles,
)


def profile_shapes(folder: Path, site: str) -> FloatArray:
    """Return displacement [m] and duration [s] of the profiles of a site ("i80" or "us101"), shape (n, 2).

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    rows = read_columns(folder / PROFILES_FILE, ("site", "side", "change", "t", "across", "v_across"))
    found = []
    for profile, direction in split_profiles(rows, site):
        across, speed = (direction * rows[name][profile] for name in ("across", "v_across"))
        found.append((across[-1] - across[0], time_around_peak(speed, rows["t"][profile])))
    displacement, above = np.array(found).reshape(-1, 2).T
    return np.column_stack([displacement, course_durations(above, displacement)])


def change_shapes(folder: Path) -> FloatArray:
    """Return displacement [m] and duration [s] of the settled changes of single vehicles on US 101, shape (n, 2).

    Without a duration (NaN) where start or end was not recorded. The positions were smoothed at 0.35 Hz, which makes
    short changes longer: courses of 2, 3, 4 and 5 s over 3 m look like ones of 3.1, 3.6, 4.3 and 5.1 s, slower ones
    like themselves.

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    rows = read_csv_columns(
        folder / CHANGES_FILE, ("before_s", "after_s", "start_seen", "end_seen", "start_s", "end_s")
    )
    settled = settled_changes(rows)
    start, end, first, last = (rows[name][settled] for name in ("start_s", "end_s", "start_seen", "end_seen"))
    above = time_between_spans(np.round(start / DT), np.round(end / DT))
    above = np.where(first.astype(bool) & last.astype(bool), above, np.nan)
    displacement = settled_displacements(folder)
    return np.column_stack([displacement, course_durations(above, displacement)])


def lane_change_shapes(folder: Path, site: str) -> FloatArray:
    """Return displacement [m] and duration [s] of the recorded lane changes of a site ("i80" or "us101"), shape (n, 2).

    Raises:
        ValueError: A file is missing or lacks a column.
    """
    return change_shapes(folder) if site == "us101" else profile_shapes(folder, site)
