"""Synthetic traffic: a table of made-up trajectories, for examples and for trying a training without recordings."""

from __future__ import annotations

import numpy as np

from training.data.trajectories import DT, NOBODY, Trajectories, find_leaders, tabulate

US_LANE_WIDTH = 3.6
"""Width of a lane [m]."""
SPACING_ALONG = 25.0
"""Distance between the vehicles of a lane at the start [m]."""
MEAN_SPEED, SPEED_SWING = 12.0, 1.0
"""Mean and amplitude of the speeds [m/s]."""
LATERAL_SWING = 0.2
"""Amplitude of the motion within the lane [m]."""
SPEED_RATE, LATERAL_RATE = 1.3, 1.0
"""Angular frequencies of both [rad/s]."""


def synthetic_traffic(seconds: float = 12.0, lanes: int = 3, per_lane: int = 3) -> Trajectories:
    """Return vehicles that follow each other, speed up and slow down, and sway within their lanes.

    Speeds are 12 + cos(1.3 t + k) m/s and lateral positions swing by 0.2 m, with a phase of its own for each vehicle k.

    Args:
        seconds: Duration [s].
        lanes: Number of lanes, 3.6 m wide.
        per_lane: Vehicles in each lane.

    Returns:
        A table of one recording, "synthetic", with lane boundaries; accelerations are not recorded (NaN).

    Example:
        >>> table = synthetic_traffic(seconds=2.0)
        >>> len(table), table.edges["synthetic"]
        (180, (0.0, 3.6, 7.2, 10.8))
    """
    vehicles = np.arange(lanes * per_lane)
    frame = np.arange(round(seconds / DT))
    time = DT * frame[:, None]
    speed = MEAN_SPEED + SPEED_SWING * np.cos(SPEED_RATE * time + vehicles)
    x = SPACING_ALONG * (vehicles // lanes) + DT * np.cumsum(speed, axis=0)
    lane = vehicles % lanes
    y = US_LANE_WIDTH * (lane + 0.5) + LATERAL_SWING * np.sin(LATERAL_RATE * time + 2.0 * vehicles)
    columns = {
        "recording": "synthetic",
        "vehicle": np.tile(vehicles, len(frame)),
        "frame": np.repeat(frame, len(vehicles)),
        "x": x.ravel(),
        "y": y.ravel(),
        "speed": speed.ravel(),
        "acceleration": np.nan,
        "length": 4.5,
        "width": 1.8,
        "lane": np.tile(1 + lane, len(frame)),
    }
    row = find_leaders(columns["frame"], columns["lane"], columns["x"])
    leader = np.where(row >= 0, columns["vehicle"][row], NOBODY)
    edges = tuple(round(US_LANE_WIDTH * k, 6) for k in range(lanes + 1))
    return tabulate({**columns, "leader": leader}, {"synthetic": edges})
