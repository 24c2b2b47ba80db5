"""Lateral displacement of recorded lane changes: the distribution of the lateral offset of a cut-in.

One table for each site, since two of US 101 may hold the same changes: of I-80 the 165 changes that were smoothed and
cut out by their author, of US 101 the 302 of single vehicles that stay 3 s or more in one lane on either side. The
displacement is that of the changing vehicle; where the ego drives within its lane adds to it and is not recorded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from training.data.table import read_columns
from training.scenario_fitting.event_filters import read_csv_columns

PROFILES_FILE = "lane_change_profiles.parquet"
CHANGES_FILE = "us101_lane_changes.csv"
MIN_LANE_TIME = 3.0
"""Least time in one lane on either side of a change [s]."""


def split_profiles(rows: Mapping[str, NDArray[Any]], site: str) -> Iterator[tuple[NDArray[np.int64], float]]:
    """Yield the rows of each profile of a site in the order of time, and 1 for a change to the right, -1 to the left.

    Args:
        rows: Columns site, side, change and t of the profiles.
        site: "i80" or "us101".
    """
    chosen = np.flatnonzero(rows["site"] == site)
    chosen = chosen[np.lexsort([rows[name][chosen] for name in ("t", "change", "side")])]
    side, change = rows["side"][chosen], rows["change"][chosen]
    breaks = np.flatnonzero((side[1:] != side[:-1]) | (change[1:] != change[:-1])) + 1
    for profile in np.split(chosen, breaks) if len(chosen) else ():
        yield profile, 1.0 if rows["side"][profile[0]] == "right" else -1.0


def profile_displacements(folder: Path, site: str) -> FloatArray:
    """Return the displacements of the profiles of a site ("i80" or "us101") to the side of the change [m], shape (n,).

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    rows = read_columns(folder / PROFILES_FILE, ("site", "side", "change", "t", "across"))
    across = rows["across"]
    return np.array([side * (across[each[-1]] - across[each[0]]) for each, side in split_profiles(rows, site)])


def settled_changes(rows: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return which changes of single vehicles on US 101 have `MIN_LANE_TIME` in one lane on either side, shape (n,)."""
    return np.asarray((rows["before_s"] >= MIN_LANE_TIME) & (rows["after_s"] >= MIN_LANE_TIME))


def settled_displacements(folder: Path) -> FloatArray:
    """Return the displacements of the settled changes of single vehicles on US 101 [m], shape (n,).

    Between 4 s before and 4 s after the crossing, 3 s where the track is shorter; NaN where that is not known either.

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    ends = ("across_-4s", "across_+4s", "across_-3s", "across_+3s")
    rows = read_csv_columns(folder / CHANGES_FILE, ("before_s", "after_s", *ends))
    wide, narrow = rows[ends[1]] - rows[ends[0]], rows[ends[3]] - rows[ends[2]]
    return np.asarray(np.where(np.isnan(wide), narrow, wide)[settled_changes(rows)])


def change_displacements(folder: Path) -> FloatArray:
    """Return the displacements that `settled_displacements` knows [m], shape (n,).

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    found = settled_displacements(folder)
    return found[~np.isnan(found)]


def lateral_offsets(folder: Path, site: str) -> FloatArray:
    """Return the recorded displacements of a site ("i80" or "us101") [m], shape (n,).

    Raises:
        ValueError: A file is missing or lacks a column.
    """
    return change_displacements(folder) if site == "us101" else profile_displacements(folder, site)
