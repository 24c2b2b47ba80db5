"""Scenes from any table of trajectories: its recordings cut into windows of time."""

from __future__ import annotations

import numpy as np

from training.data.scenes import Scene, assemble, smooth_tracks
from training.data.table import DT, Trajectories

SHORTEST = 4
"""Steps of a scene, at least."""


def scenes_of(trajectories: Trajectories, seconds: float = 10.0) -> tuple[Scene, ...]:
    """Every recording in windows of time over its whole road, smoothed.

    Tracks are smoothed once over their whole length and then cut, so two windows agree where they meet. A scene
    starts at a multiple of `seconds` of the recording's clock. Rows outside the lanes are left out.

    Args:
        trajectories: With lane boundaries, and positions and sizes in every row.
        seconds: Length of a scene [s]; the last one of a recording is shorter.

    Raises:
        ValueError: A recording has no lane boundaries, a row has no position across or size, or the length is
            less than a few steps.
    """
    t = trajectories
    steps = round(seconds / DT)
    if steps < SHORTEST:
        raise ValueError(f"Expected scenes of {SHORTEST * DT:g} s or more, got {seconds:g} s.")
    for name in ("y", "length", "width"):
        if np.isnan(t.column(name)).any():
            raise ValueError(f"Scenes need {name} in every row; this table lacks it in some.")
    smooth = smooth_tracks(t.breaks(), t.x, t.y)
    scenes: list[Scene] = []
    for recording in np.unique(t.recording):
        edges = t.edges.get(str(recording), ())
        if not edges:
            raise ValueError(
                f"Scenes need the lane boundaries of recording {recording}; put them into edges "
                "(dataclasses.replace(table, edges={...}))."
            )
        inside = (t.recording == recording) & (smooth["y"] >= edges[0]) & (smooth["y"] < edges[-1])
        inside &= np.isfinite(smooth["speed"])
        window = t.frame // steps
        for number in np.unique(window[inside]):
            rows = np.flatnonzero(inside & (window == number))
            _, first, column = np.unique(t.vehicle[rows], return_index=True, return_inverse=True)
            columns = {name: values[rows] for name, values in smooth.items()}
            columns["step"] = (t.frame[rows] - number * steps).astype(np.float64)
            columns["vehicle"] = column.ravel().astype(np.float64)
            start = DT * float(number * steps)
            name = f"{recording}-{start:.0f}"
            scenes.append(assemble(name, start, edges, columns, t.length[rows[first]], t.width[rows[first]]))
    return tuple(scenes)
