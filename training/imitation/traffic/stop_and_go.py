"""Stop-and-go scenes: dense columns behind leads that slow down, stand or crawl, and speed up again.

The recordings hardly have traffic that comes to a standstill. Here the first vehicle of every lane follows a schedule
of speeds and is replayed; those behind it are driven, from places and speeds that fit each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH
from samplers.problem import FloatArray
from training.data.ngsim_tables import US101_EDGES
from training.data.scenes import TrafficScene
from training.data.trajectories import DT

DENSE_LANES, DENSE_ROWS = 5, 7
"""Vehicles of a scene are DENSE_LANES x DENSE_ROWS; the first row is replayed."""
SCENE_SECONDS = 20.0
"""Length of a scene; leads keep their speed afterwards."""
DENSITY_RANGE = (30.0, 75.0)
"""Least and greatest number of vehicles per km and lane, drawn uniformly."""
START_TIME_GAP, STANDSTILL_GAP, FREE_SPEED = 1.5, 2.0, 20.0
"""Mean gap at the start by speed [s] and at standstill [m], and the greatest speed [m/s]."""
LEAST_HEADWAY, GAP_SHAPE = 0.5, 2.0
"""Least gap at the start by speed [s], and the shape of the gamma distribution of what gaps have beyond it."""
SPEED_SPREAD = 1.0
"""Greatest difference of speeds at the start from their mean [m/s]."""


class Wave(NamedTuple):
    """A lead's schedule of speeds, repeated: keep the speed, brake, stay slow, speed up."""

    wait: float
    """Time before it brakes [s]."""
    braking: float
    """Deceleration [m/s^2]."""
    low: float
    """Speed to which it brakes [m/s]."""
    hold: float
    """Time at that speed [s]."""
    acceleration: float
    """Up to the first speed again [m/s^2]."""


def draw_wave(speed: float, rng: np.random.Generator) -> Wave:
    """Return a schedule for a lead that drives at a speed [m/s]; two of five come to a standstill."""
    low = 0.0 if rng.random() < 0.4 else rng.uniform(0.0, 0.6) * speed
    return Wave(rng.uniform(0.0, 6.0), rng.uniform(0.7, 3.0), low, rng.uniform(1.0, 6.0), rng.uniform(0.5, 1.5))


def speeds_of_wave(wave: Wave, speed: float, ticks: int) -> FloatArray:
    """Return the speeds of a lead from tick to tick [m/s], shape (ticks,).

    Args:
        wave: Its schedule.
        speed: At the start, and between slow times.
        ticks: Number of ticks.
    """
    down, up = (max(speed - wave.low, 0.0) / rate for rate in (wave.braking, wave.acceleration))
    times = np.cumsum([0.0, wave.wait, down, wave.hold, up])
    known = [speed, speed, wave.low, wave.low, speed]
    return np.asarray(np.interp(np.mod(DT * np.arange(ticks), times[-1]), times, known))


def make_stop_and_go(rng: np.random.Generator) -> TrafficScene:
    """Return one scene of 35 vehicles in five lanes of US 101; all but the first of each lane can be driven.

    Only the first tick of those that can be driven means anything: start there.
    """
    density, vehicles, ticks = rng.uniform(*DENSITY_RANGE), DENSE_LANES * DENSE_ROWS, round(SCENE_SECONDS / DT)
    speed = float(np.clip((1000.0 / density - VEHICLE_LENGTH - STANDSTILL_GAP) / START_TIME_GAP, 0.0, FREE_SPEED))
    least = VEHICLE_LENGTH + STANDSTILL_GAP + LEAST_HEADWAY * speed
    gaps = least + (1000.0 / density - least) * DENSE_ROWS * rng.dirichlet(np.full(DENSE_ROWS, GAP_SHAPE), DENSE_LANES)
    along = np.cumsum(gaps, axis=1) - gaps * rng.random((DENSE_LANES, 1))  # lanes begin at places of their own
    speeds = np.maximum(speed + rng.uniform(-SPEED_SPREAD, SPEED_SPREAD, (DENSE_LANES, DENSE_ROWS)), 0.0)
    track = np.repeat(speeds[None], ticks, axis=0)
    for lane in range(DENSE_LANES):
        track[:, lane, -1] = speeds_of_wave(draw_wave(speed, rng), speeds[lane, -1], ticks)
    moved = np.concatenate((np.zeros((1, DENSE_LANES, DENSE_ROWS)), np.cumsum(track[:-1] * DT, axis=0)))
    edges = np.array(US101_EDGES[: DENSE_LANES + 1])
    lead = np.arange(DENSE_ROWS) == DENSE_ROWS - 1
    action = np.where(lead, np.nan, 0.0) * np.ones((ticks, DENSE_LANES, 1))
    middle = np.broadcast_to(0.5 * (edges[1:] + edges[:-1])[:, None], track.shape)
    flat = {"x": along + moved, "y": middle, "heading": np.zeros_like(track), "speed": track, "acceleration": action}
    return TrafficScene(
        name="stop and go",
        start=0.0,
        edges=tuple(edges.tolist()),
        **{name: values.reshape(ticks, vehicles).copy() for name, values in flat.items()},
        yaw_rate=action.reshape(ticks, vehicles).copy(),
        present=np.ones((ticks, vehicles), dtype=bool),
        length=np.full(vehicles, VEHICLE_LENGTH),
        width=np.full(vehicles, VEHICLE_WIDTH),
    )
