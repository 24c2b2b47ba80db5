"""New leaders in the record of one instrumented car: moments at which the gap to the vehicle ahead jumps.

A cut-in, an own lane change and a leader that leaves the lane all give the car a new leader; each is the beginning of
car-following. The record has the speed of the vehicle ahead on drives with radar only.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from training.data.table import read_columns

CIRCLES_FILE = "i24_circles_following.parquet"
MIN_JUMP = 6.0
"""Change of the gap within `JUMP_TICKS` that shows another leader [m]."""
JUMP_TICKS = 3
"""0.3 s."""
LEAST_PAUSE = 20
"""Ticks between two events: 2 s."""
SETTLING_TICKS = 8
"""Ticks from the beginning of a jump to the values that are taken: the radar takes up its new target."""
STEADY_TICKS = 10
"""Ticks after these in which the gap must not jump again."""
MAX_STEP = 2.0
"""Largest change of the gap in one tick while a leader stays the same [m]."""
NO_LEADER = 252.0
"""Gap that stands for nobody ahead [m]."""


def find_new_leaders(speed: FloatArray, relative_speed: FloatArray, gap: FloatArray) -> FloatArray:
    """Return the new leaders of one drive.

    Args:
        speed: Own speed at consecutive ticks [m/s], shape (T,).
        relative_speed: Speed ahead less own speed [m/s], NaN where it is not known, shape (T,).
        gap: Distance to the vehicle ahead [m], NaN where nobody is, shape (T,).

    Returns:
        Own speed, speed ahead and gap [m/s, m/s, m] once the new leader is tracked, shape (n, 3).
    """
    filled = np.where(np.isnan(gap), NO_LEADER, gap)
    jumps = np.abs(filled[JUMP_TICKS:] - filled[:-JUMP_TICKS]) > MIN_JUMP
    onsets = np.flatnonzero(jumps & ~np.append(False, jumps[:-1]))
    found = []
    for onset in _apart(onsets):
        first = onset + SETTLING_TICKS
        window = slice(first, first + STEADY_TICKS)
        tracked = (
            len(filled) > window.stop and np.isfinite(gap[window]).all() and np.isfinite(relative_speed[window]).all()
        )
        if tracked and np.abs(np.diff(gap[window])).max() < MAX_STEP:
            found.append((speed[first], speed[first] + relative_speed[window].mean(), gap[first]))
    return np.array(found).reshape(-1, 3)


def _apart(onsets: NDArray[np.int64]) -> list[int]:
    """Return the onsets that come more than `LEAST_PAUSE` ticks after the one before that counts."""
    kept: list[int] = []
    for onset in onsets.tolist():
        if not kept or onset - kept[-1] > LEAST_PAUSE:
            kept.append(onset)
    return kept


def load_new_leaders(folder: Path) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the new leaders of all drives with radar, shape (n, 3), and the drive of each, shape (n,).

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    rows = read_columns(folder / CIRCLES_FILE, ("drive", "t", "speed", "gap", "rel_speed", "radar"))
    events, drives = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)]
    for drive in np.unique(rows["drive"][rows["radar"].astype(bool)]):
        chosen = np.flatnonzero(rows["drive"] == drive)
        chosen = chosen[np.argsort(rows["t"][chosen], kind="stable")]
        events.append(find_new_leaders(*(rows[name][chosen].astype(float) for name in ("speed", "rel_speed", "gap"))))
        drives.append(np.full(len(events[-1]), drive, dtype=np.int64))
    return np.concatenate(events), np.concatenate(drives)
