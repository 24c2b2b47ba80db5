"""Lateral displacement of recorded lane changes: the distribution of the lateral offset of a cut-in.

One table for each site, since two of US 101 may hold the same changes: of I-80 the 165 changes that were smoothed and
cut out by their author, of US 101 the 302 of single vehicles that stay 3 s or more in one lane on either side. The
displacement is that of the changing vehicle; where the ego drives within its lane adds to it and is not recorded.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from samplers.problem import FloatArray
from training.data.ngsim_tables import read_columns
from training.scenario_fitting.event_filters import read_csv_columns

PROFILES_FILE = "lane_change_profiles.parquet"
CHANGES_FILE = "us101_lane_changes.csv"
MIN_LANE_TIME = 3.0
"""Least time in one lane on either side of a change [s]."""


def profile_displacements(folder: Path, site: str) -> FloatArray:
    """Return the displacements of the profiles of a site ("i80" or "us101") to the side of the change [m], shape (n,).

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    rows = read_columns(folder / PROFILES_FILE, ("site", "side", "change", "t", "across"))
    rows = {name: values[rows["site"] == site] for name, values in rows.items()}
    order = np.lexsort([rows["t"], rows["change"], rows["side"]])
    side, change, across = (rows[name][order] for name in ("side", "change", "across"))
    breaks = np.flatnonzero((side[1:] != side[:-1]) | (change[1:] != change[:-1])) + 1
    ends = [0, *breaks.tolist(), len(across)] if len(across) else []
    first, last = np.array(ends[:-1], dtype=np.int64), np.array(ends[1:], dtype=np.int64) - 1
    displacement: FloatArray = (across[last] - across[first]) * np.where(side[first] == "right", 1.0, -1.0)
    return displacement


def change_displacements(folder: Path) -> FloatArray:
    """Return the displacements of the changes of single vehicles on US 101 [m], shape (n,).

    Between 4 s before and 4 s after the crossing, 3 s where the track is shorter.

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    ends = ("across_-4s", "across_+4s", "across_-3s", "across_+3s")
    rows = read_csv_columns(folder / CHANGES_FILE, ("before_s", "after_s", *ends))
    settled = (rows["before_s"] >= MIN_LANE_TIME) & (rows["after_s"] >= MIN_LANE_TIME)
    wide, narrow = rows[ends[1]] - rows[ends[0]], rows[ends[3]] - rows[ends[2]]
    displacement: FloatArray = np.where(np.isnan(wide), narrow, wide)[settled]
    return displacement[~np.isnan(displacement)]


def lateral_offsets(folder: Path, site: str) -> FloatArray:
    """Return the recorded displacements of a site ("i80" or "us101") [m], shape (n,).

    Raises:
        ValueError: A file is missing or lacks a column.
    """
    return change_displacements(folder) if site == "us101" else profile_displacements(folder, site)
