"""Windows: the recordings of a table cut into scenes of some seconds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from training.data.scenes import TrafficScene, assemble_scene, smooth_tracks
from training.data.trajectories import DT, Trajectories

MIN_STEPS = 4
"""Least number of steps of a scene: the smoother leaves shorter tracks as they are."""


def scenes_of(trajectories: Trajectories, seconds: float = 10.0) -> tuple[TrafficScene, ...]:
    """Return scenes of some seconds over the whole road of every recording, smoothed.

    Tracks are smoothed once over their whole length and then cut, so two windows agree where they meet. A scene starts
    at a multiple of `seconds` of the recording's clock. Rows outside the lanes are left out.

    Args:
        trajectories: Table with lane boundaries, and with positions and sizes in every row.
        seconds: Length of a scene [s]; the last one of a recording is shorter.

    Raises:
        ValueError: A recording has no lane boundaries or nobody between them, a row lacks its lateral position or a
            size, or the scenes are shorter than `MIN_STEPS` steps.

    Example:
        >>> from training.data import synthetic_traffic
        >>> [scene.name for scene in scenes_of(synthetic_traffic(seconds=12.0), seconds=4.0)]
        ['synthetic-0', 'synthetic-4', 'synthetic-8']
    """
    t = trajectories
    steps = round(seconds / DT)
    if steps < MIN_STEPS:
        raise ValueError(f"Expected scenes of {MIN_STEPS * DT:g} s or more, got {seconds:g} s.")
    for name in ("y", "length", "width"):
        if np.isnan(t.column(name)).any():
            raise ValueError(f"Scenes need {name} in every row; this table lacks it in some.")
    smooth = smooth_tracks(t.track_starts(), t.x, t.y)
    scenes: list[TrafficScene] = []
    for recording in np.unique(t.recording).tolist():
        own = t.recording == recording
        edges = t.edges.get(recording, ())
        if not edges:
            raise ValueError(
                f"Recording {recording!r} has no lane boundaries, which scenes need. Give the y of each from left to "
                f"right [m], as in tabulate(columns, edges={{{recording!r}: (0.0, 3.5, 7.0)}}); "
                f"{_describe_positions(t, own)}."
            )
        inside = own & (smooth["y"] >= edges[0]) & (smooth["y"] < edges[-1])
        if not inside.any():
            raise ValueError(
                f"Recording {recording!r} has nobody between its lane boundaries, {edges[0]:g} to {edges[-1]:g} m; "
                f"{_describe_positions(t, own)}."
            )
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
            scenes.append(assemble_scene(name, start, edges, columns, t.length[rows[first]], t.width[rows[first]]))
    return tuple(scenes)


def _describe_positions(t: Trajectories, rows: NDArray[np.bool_]) -> str:
    """Return a phrase that says where across the road the vehicles of a recording are."""
    lanes = np.unique(t.lane[rows & (t.lane > 0)])
    words = f"its vehicles are at y = {t.y[rows].min():.1f} to {t.y[rows].max():.1f} m"
    medians = ", ".join(f"lane {lane} at {np.median(t.y[rows & (t.lane == lane)]):.1f} m" for lane in lanes[:8])
    return f"{words}, those of {medians}" if medians else words
