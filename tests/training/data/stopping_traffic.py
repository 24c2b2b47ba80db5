"""Made-up recordings of vehicles that brake to a standstill, each with a leader ahead of it that does so too."""

import numpy as np

from training.data import NOBODY, tabulate
from training.data.table import DT

LENGTH = 4.5
PAUSE = 60
"""Ticks before and after a braking."""


def stopping_track(speed, deceleration, final=0.0):
    """Positions of a vehicle that brakes once [m]."""
    braking = np.arange(speed, final, -deceleration * DT)
    return DT * np.cumsum(np.concatenate([np.full(PAUSE, speed), braking, np.full(PAUSE, final)]))


def stopping_traffic(speeds, gaps, decelerations, every=400, length=LENGTH, final=0.0):
    """Return followers 0, 2, 4 ... behind leaders 1, 3, 5 ...; one pair begins each `every` ticks.

    The leaders, ahead of whom nobody is recorded, make no events.
    """
    rows = {name: [] for name in ("vehicle", "frame", "x", "leader", "speed")}
    for i, (speed, gap, deceleration) in enumerate(zip(speeds, gaps, decelerations, strict=True)):
        x = stopping_track(speed, deceleration, final)
        for vehicle, position, leader in ((2 * i, x, 2 * i + 1), (2 * i + 1, x + gap + LENGTH, NOBODY)):
            rows["vehicle"].append(np.full(len(x), vehicle))
            rows["frame"].append(every * i + np.arange(len(x)))
            rows["x"].append(position)
            rows["leader"].append(np.full(len(x), leader))
            rows["speed"].append(np.clip(np.gradient(position, DT), 0.0, None))
    columns = {name: np.concatenate(parts) for name, parts in rows.items()}
    constant = {"recording": "stops", "y": 0.0, "acceleration": np.nan, "length": length, "width": 1.8, "lane": 1}
    return tabulate(columns | constant)
