"""Scenes: every vehicle in a window of road over some seconds, ready to be replayed or driven anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from training.data.table import (
    CUTOFF_ACROSS,
    CUTOFF_ALONG,
    DT,
    SCENES_FILE,
    US101_EDGES,
    Trajectories,
    infer_motion,
    read_columns,
    smooth_positions,
)

Mask = NDArray[np.bool_]

US101_ZERO = 1_118_846_980
"""Unix time [s] from which the clock of the US 101 scenes counts: 15 June 2005, 07:49:40 local."""
US101_TEST = ((64.0, 89.0), (157.0, 194.0))
"""Clock [s] of the test scenes, 2, 11, 12, 17, 21, 22 and 29: 64 to 88.4 s and 157.8 to 193.2 s."""
MIN_STEPS = 4
"""Least number of steps of a scene: the smoother leaves shorter tracks as they are."""
_US101_COLUMNS = ("scene", "vehicle", "epoch_ms", "y_along", "d", "lane", "length", "width")
_STATES = ("x", "y", "heading", "speed", "acceleration", "yaw_rate")


@dataclass(frozen=True)
class TrafficScene:
    """States and actions of V vehicles at T steps, 0.1 s apart, on a straight road.

    Positions are box centres: x along the road, y across and positive to the right [m], heading relative to the road
    [rad], positive to the right. Arrays are float64 and NaN if there is no value.

    Raises:
        ValueError: Arrays differ in shape, or a state is missing where a vehicle is present.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> scene = scenes_of(synthetic_traffic(seconds=5.0), seconds=5.0)[0]
        >>> scene.name, scene.x.shape, round(scene.end, 1)
        ('synthetic-0', (49, 9), 4.8)
        >>> int(scene.leads_lane().any(axis=0).sum())
        3
    """

    name: str
    start: float
    """Clock of the recording at step 0 [s]."""
    edges: tuple[float, ...]
    """y of the lane boundaries, left to right [m]."""
    x: FloatArray
    """Shape (T, V), like the following."""
    y: FloatArray
    heading: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    """From this step to the next [m/s^2]; NaN if the record ends before it is known."""
    yaw_rate: FloatArray
    """From this step to the next [rad/s]; NaN if the acceleration is."""
    present: Mask
    """True if x, y, heading and speed are known."""
    length: FloatArray
    """Shape (V,) [m]."""
    width: FloatArray
    """Shape (V,) [m]."""

    def __post_init__(self) -> None:
        shape, states = self.x.shape, [getattr(self, name) for name in _STATES]
        if len(shape) != 2 or any(values.shape != shape for values in (*states, self.present)):
            raise ValueError(f"Scene {self.name}: expected arrays of one shape (T, V), got x of shape {shape}.")
        if self.length.shape != shape[1:] or self.width.shape != shape[1:]:
            raise ValueError(f"Scene {self.name}: expected length and width of shape {shape[1:]}.")
        if any((np.isfinite(values) != self.present).any() for values in states[:4]):
            raise ValueError(f"Scene {self.name}: states must be finite where present and NaN elsewhere.")
        for values in (*states, self.present, self.length, self.width):
            values.setflags(write=False)

    @property
    def end(self) -> float:
        """Clock of the recording at the last step [s]."""
        return self.start + DT * (len(self.x) - 1)

    @property
    def acted(self) -> Mask:
        """True if state and action are known, shape (T, V)."""
        known: Mask = self.present & np.isfinite(self.acceleration)
        return known

    def lane_numbers(self) -> NDArray[np.int64]:
        """Return the lane of each centre, 0 the leftmost, shape (T, V); -1 off the road or not present."""
        inner = np.searchsorted(np.array(self.edges), np.nan_to_num(self.y, nan=-np.inf), side="right") - 1
        return np.where(self.present & (inner < len(self.edges) - 1), inner, -1)

    def leads_lane(self) -> Mask:
        """Return True if nobody ahead is recorded in the vehicle's lane, shape (T, V).

        Such a vehicle may have reacted to somebody outside the window, so its actions are no examples to learn from.
        """
        lane, leads, steps = self.lane_numbers(), np.zeros_like(self.present), np.arange(len(self.x))
        for number in range(-1, len(self.edges) - 1):
            inside = self.present & (lane == number)
            first = np.argmax(np.where(inside, self.x, -np.inf), axis=1)
            leads[steps, first] |= inside[steps, first]
        return leads


def load_us101_scenes(folder: Path | str) -> tuple[TrafficScene, ...]:
    """Return the 28 usable scenes of US 101, smoothed, from a folder with the compact table.

    The scenes overlap, so the copies of a vehicle are first merged by vehicle and time. Each track is then cut at its
    holes and smoothed once over its whole length, and the scenes are cut from the tracks. x is NGSIM's Local_Y [m], the
    same in all scenes, moved from the front to the centre. Scene 1 (two vehicles) and ramps are left out.

    Raises:
        ValueError: The file is missing, cannot be read or lacks a column.

    Example:
        >>> load_us101_scenes("no_such_folder")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: There is no ngsim_us101_scenes.parquet in the folder 'no_such_folder'. ...
    """
    rows = read_columns(Path(folder) / SCENES_FILE, _US101_COLUMNS)
    usable = (rows["scene"] != 1) & (rows["lane"] <= 6)
    rows = {key: values[usable] for key, values in rows.items()}
    keys, copy = np.unique(np.column_stack([rows["vehicle"], rows["epoch_ms"]]), axis=0, return_inverse=True)
    copy = copy.ravel()
    count = np.bincount(copy)
    x, y, length = (np.bincount(copy, rows[key]) / count for key in ("y_along", "d", "length"))
    breaks = 1 + np.flatnonzero((np.diff(keys[:, 0]) != 0) | (np.diff(keys[:, 1]) != 100))
    smooth = {key: values[copy] for key, values in _smooth_tracks(breaks, x - 0.5 * length, y).items()}
    scenes = []
    for number in np.unique(rows["scene"]).tolist():
        chosen = np.flatnonzero(rows["scene"] == number)
        first = int(rows["epoch_ms"][chosen].min())
        edges = US101_EDGES if (rows["lane"][chosen] == 6).any() else US101_EDGES[:-1]
        step = np.rint((rows["epoch_ms"] - first) / 100.0).astype(np.int64)
        place = f"us101-{number:02}", first / 1000.0 - US101_ZERO, edges
        scenes.append(_cut_scene(place, chosen, step, rows["vehicle"], smooth, (rows["length"], rows["width"])))
    return tuple(scenes)


def _smooth_tracks(breaks: NDArray[np.int64], x: FloatArray, y: FloatArray) -> dict[str, FloatArray]:
    """Return smoothed states and actions (rows,) of positions (rows,) of tracks; one begins at each break, and at 0."""
    result = {key: np.empty(len(x)) for key in _STATES}
    for piece in np.split(np.arange(len(x)), breaks[breaks > 0]):
        along, across = smooth_positions(x[piece], CUTOFF_ALONG), smooth_positions(y[piece], CUTOFF_ACROSS)
        for key, values in zip(_STATES, (along, across, *infer_motion(along, across)), strict=True):
            result[key][piece] = values
    return result


def _cut_scene(
    place: tuple[str, float, Sequence[float]],
    chosen: NDArray[np.int64],
    step: NDArray[np.int64],
    vehicle: NDArray[np.int64],
    smooth: Mapping[str, FloatArray],
    sizes: tuple[FloatArray, FloatArray],
) -> TrafficScene:
    """Return the scene of the chosen rows, with its name, start and edges; the others have a value for each row."""
    _, first, column = np.unique(vehicle[chosen], return_index=True, return_inverse=True)
    known = np.isfinite(smooth["speed"][chosen])
    rows, column, at = chosen[known], column.ravel()[known], step[chosen][known]
    states = {key: np.full((int(step[chosen].max()) + 1, len(first)), np.nan) for key in smooth}
    for key, values in smooth.items():
        states[key][at, column] = values[rows]
    length, width = (values[chosen[first]] for values in sizes)
    name, start, edges = place
    present = np.isfinite(states["x"])
    return TrafficScene(name, start, tuple(edges), **states, present=present, length=length, width=width)


def split_by_clock(
    scenes: Sequence[TrafficScene], test: Sequence[tuple[float, float]] = US101_TEST
) -> tuple[tuple[TrafficScene, ...], tuple[TrafficScene, ...]]:
    """Split the scenes of one recording by its clock, into those to learn from and those to test on.

    Args:
        scenes: Scenes of one recording.
        test: Intervals of the clock [s] that are kept for tests.

    Returns:
        Training scenes, which lie outside the intervals, and test scenes, which lie inside one.

    Raises:
        ValueError: A scene lies across the end of an interval, so one moment would be on both sides.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> scenes = scenes_of(synthetic_traffic(seconds=12.0), seconds=4.0)
        >>> learn, test = split_by_clock(scenes, test=[(8.0, 12.0)])
        >>> [scene.name for scene in test]
        ['synthetic-8']
    """
    kept: tuple[list[TrafficScene], list[TrafficScene]] = ([], [])
    for scene in scenes:
        inside = any(low <= scene.start and scene.end <= high for low, high in test)
        if not inside and any(scene.start <= high and low <= scene.end for low, high in test):
            raise ValueError(
                f"Scene {scene.name} ({scene.start:g} to {scene.end:g} s) lies across the end of a test interval."
            )
        kept[inside].append(scene)
    return tuple(kept[0]), tuple(kept[1])


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
    if lacking := [name for name in ("y", "length", "width") if np.isnan(getattr(t, name)).any()]:
        raise ValueError(f"Scenes need {lacking[0]} in every row; this table lacks it in some.")
    smooth = _smooth_tracks(t.track_starts(), t.x, t.y)
    window, known = t.frame // steps, np.isfinite(smooth["speed"])
    scenes: list[TrafficScene] = []
    for recording in np.unique(t.recording).tolist():
        own, edges = t.recording == recording, t.edges.get(recording, ())
        inside = own & (smooth["y"] >= edges[0]) & (smooth["y"] < edges[-1]) if edges else np.zeros_like(own)
        if not inside.any():
            lanes = [f"lane {n} at {np.median(t.y[own & (t.lane == n)]):.1f} m" for n in np.unique(t.lane[own])]
            raise ValueError(
                f"Recording {recording!r} has nobody between its lane boundaries, {edges or 'of which it has none'}. "
                f"Give the y of each from left to right [m], as in tabulate(columns, edges={{{recording!r}: (0.0, 3.5, "
                f"7.0)}}); its vehicles are at y = {t.y[own].min():.1f} to {t.y[own].max():.1f} m, {', '.join(lanes)}."
            )
        for number in np.unique(window[inside & known]):
            chosen, start = np.flatnonzero(inside & known & (window == number)), DT * float(number * steps)
            place, step = (f"{recording}-{start:.0f}", start, edges), t.frame - number * steps
            scenes.append(_cut_scene(place, chosen, step, t.vehicle, smooth, (t.length, t.width)))
    return tuple(scenes)
