"""Simulated traffic in the file formats of recorded traffic."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.io import savemat

from training.data.table import NOBODY, Trajectories, find_leaders, tabulate

FOOT = 0.3048
LANE = 3.75
DT = 0.02
ROAD = 400.0
"""Recorded stretch of road [m]."""
EDGES = (0.0, 3.5, 7.0)


@dataclass(frozen=True)
class Traffic:
    """IDM vehicles on straight lanes; arrays of shape (T, V) every `DT` seconds, positions of box centres [m]."""

    x: np.ndarray
    y: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    length: np.ndarray
    width: np.ndarray
    lanes: int
    changed: np.ndarray
    """Time step at which each vehicle began to change lanes; -1: never. Shape (V,)."""

    @property
    def lane(self) -> np.ndarray:
        """0 the leftmost."""
        return np.clip(self.y // LANE, 0, self.lanes - 1).astype(int)

    def inside(self, road: float) -> np.ndarray:
        return (self.x - 0.5 * self.length > 0.0) & (self.x + 0.5 * self.length < road)


def nearest(x, lane, here, wanted):
    """Indices of the vehicles ahead of and behind vehicle `here` in a lane; -1: none."""
    others = np.flatnonzero((lane == wanted) & (np.arange(len(x)) != here))
    ahead, behind = others[x[others] > x[here]], others[x[others] <= x[here]]
    return (
        ahead[np.argmin(x[ahead])] if len(ahead) else -1,
        behind[np.argmax(x[behind])] if len(behind) else -1,
    )


def simulate(seed=0, lanes=3, per_lane=16, seconds=24.0, changers=0.4):
    """Platoons that drive into the recorded stretch of road; some vehicles change lanes within it."""
    rng = np.random.default_rng(seed)
    n, steps = lanes * per_lane, round(seconds / DT)
    length, width = rng.uniform(3.8, 5.4, n), rng.uniform(1.7, 2.0, n)
    lane = np.repeat(np.arange(lanes), per_lane)
    took = np.random.default_rng((seed, 1)).uniform(3.5, 4.5, n)  # seconds from centre to centre
    x = np.concatenate([200.0 - np.cumsum(rng.uniform(18.0, 45.0, per_lane)) for _ in range(lanes)])
    y = LANE * (lane + 0.5)
    v, desired = rng.uniform(17.0, 23.0, n), rng.uniform(17.0, 27.0, n)
    keen, changed, target = rng.random(n) < changers, np.full(n, -1), lane.copy()
    record = {name: np.empty((steps, n)) for name in ("x", "y", "speed", "acceleration")}
    for k in range(steps):
        a = np.empty(n)
        for i in range(n):
            j, _ = nearest(x, np.clip(y // LANE, 0, lanes - 1).astype(int), i, lane[i])
            a[i] = 1.5 * (1.0 - (v[i] / desired[i]) ** 4)
            if j >= 0:
                gap = max(x[j] - x[i] - 0.5 * (length[i] + length[j]), 0.5)
                wish = 2.0 + max(1.2 * v[i] + v[i] * (v[i] - v[j]) / (2.0 * np.sqrt(1.5 * 2.0)), 0.0)
                a[i] = max(a[i] - 1.5 * (wish / gap) ** 2, -6.0)
            if keen[i] and changed[i] < 0 and 60.0 < x[i] < 250.0 and k % 25 == 0:
                wanted = lane[i] + (1 if lane[i] == 0 or (lane[i] < lanes - 1 and i % 2) else -1)
                ahead, behind = nearest(x, lane, i, wanted)
                room = 9.0 + 0.5 * length[i]
                if (ahead < 0 or x[ahead] - x[i] > room) and (behind < 0 or x[i] - x[behind] > room):
                    changed[i], target[i] = k, wanted
        for name, values in zip(record, (x, y, v, a), strict=True):
            record[name][k] = values
        moving = changed >= 0
        phase = np.clip((k + 1 - changed) * DT / took, 0.0, 1.0)
        came = np.where(moving, record["y"][np.maximum(changed, 0), np.arange(n)], y)
        y = np.where(moving, came + (LANE * (target + 0.5) - came) * phase**3 * (10 - 15 * phase + 6 * phase**2), y)
        lane = np.clip(y // LANE, 0, lanes - 1).astype(int)
        x, v = x + v * DT, np.maximum(v + a * DT, 0.0)
    return Traffic(**record, length=length, width=width, lanes=lanes, changed=changed)


def see(traffic, every, road):
    """Rows of the vehicles within the recorded road at every so many steps, by vehicle, then by time, (n,) each."""
    step, vehicle = np.nonzero(traffic.inside(road)[::every])
    order = np.lexsort([step, vehicle])
    step, vehicle = every * step[order], vehicle[order]
    moving = {name: getattr(traffic, name)[step, vehicle] for name in ("x", "y", "speed", "acceleration", "lane")}
    sizes = {name: getattr(traffic, name)[vehicle] for name in ("length", "width")}
    return SimpleNamespace(step=step, vehicle=vehicle, **moving, **sizes)


def ahead_of(seen):
    """Vehicle ahead in the same lane, by centres; -1: none."""
    found = np.full(len(seen.x), -1)
    for row in range(len(seen.x)):
        near = (seen.step == seen.step[row]) & (seen.lane == seen.lane[row]) & (seen.x > seen.x[row])
        if near.any():
            found[row] = seen.vehicle[near][np.argmin(seen.x[near])]
    return found


def as_rows(columns, digits=4):
    """Rows of columns of numbers, rounded, or of one value for all rows."""
    n = max(np.size(values) for values in columns.values())
    columns = {name: np.broadcast_to(values, n) for name, values in columns.items()}
    rounded = {name: v.round(digits) if v.dtype.kind == "f" else v for name, v in columns.items()}
    return [dict(zip(rounded, row, strict=True)) for row in zip(*(v.tolist() for v in rounded.values()), strict=True)]


def write_csv(path, rows):
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_ngsim(path, traffic, road=ROAD):
    """The published columns, in feet, sorted by vehicle and frame; returns the rows."""
    seen = see(traffic, 5, road)
    columns = {
        "Vehicle_ID": seen.vehicle + 1,
        "Frame_ID": seen.step // 5 + 1,
        "Total_Frames": 0,
        "Global_Time": 1_118_846_980_000 + 20 * seen.step,
        "Local_X": seen.y / FOOT,
        "Local_Y": (seen.x + 0.5 * seen.length) / FOOT,
        "Global_X": 0.0,
        "Global_Y": 0.0,
        "v_Length": seen.length / FOOT,
        "v_Width": seen.width / FOOT,
        "v_Class": 2,
        "v_Vel": seen.speed / FOOT,
        "v_Acc": seen.acceleration / FOOT,
        "Lane_ID": seen.lane + 1,
        "Preceding": ahead_of(seen) + 1,
        "Following": 0,
        "Space_Headway": 0.0,
        "Time_Headway": 0.0,
    }
    rows = as_rows(columns, 3)
    write_csv(path, rows)
    return rows


def coifman_matrix(traffic, road=ROAD):
    """The 18 columns with NGSIM's meaning, of which seven are filled; positions of the rear bumper."""
    seen = see(traffic, 5, road)
    matrix = np.zeros((len(seen.x), 18))
    matrix[:, [0, 1, 5]] = np.column_stack([seen.vehicle + 1, seen.step // 5 + 1, (seen.x - 0.5 * seen.length) / FOOT])
    motion = seen.speed / FOOT, seen.acceleration / FOOT
    matrix[:, 11:15] = np.column_stack([*motion, seen.lane + 1, ahead_of(seen) + 1])
    return matrix


def write_coifman(path, matrix):
    if path.suffix == ".mat":
        savemat(path, {"data": matrix, "note": "To use this data set for research or publication, please refer to it"})
    else:
        np.savetxt(path, matrix, fmt="%.6f")
    return path


def write_highd(folder, upper, lower, recording="01", road=420.0):
    """The three files of a recording at 25 Hz; `upper` drives towards -x. Returns the rows of tracks."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows, meta, markings, first, top = [], [], [], 1, 8.0  # y of the first marking in the picture
    for traffic, direction, sign in ((upper, 1, -1.0), (lower, 2, 1.0)):
        seen = see(traffic, 2, road)
        later = np.minimum(seen.step + 1, len(traffic.y) - 1)
        across = (traffic.y[later, seen.vehicle] - seen.y) / DT
        x, y = (seen.x, seen.y) if sign > 0 else (road - seen.x, LANE * traffic.lanes - seen.y)
        ahead = ahead_of(seen)
        columns = {
            "frame": seen.step // 2 + 1,
            "id": first + seen.vehicle,
            "x": x - 0.5 * seen.length,
            "y": top + y - 0.5 * seen.width,
            "width": seen.length,
            "height": seen.width,
            "xVelocity": sign * seen.speed,
            "yVelocity": sign * across,
            "xAcceleration": sign * seen.acceleration,
            "precedingId": np.where(ahead >= 0, first + ahead, 0),
            "laneId": 0,
        }
        rows += as_rows(columns)
        meta += as_rows({"id": first + np.unique(seen.vehicle), "class": "Car", "drivingDirection": direction})
        markings.append(";".join(f"{top + LANE * k:g}" for k in range(traffic.lanes + 1)))
        first, top = first + traffic.x.shape[1], top + LANE * traffic.lanes + 6.0
    write_csv(folder / f"{recording}_tracks.csv", rows)
    write_csv(folder / f"{recording}_tracksMeta.csv", meta)
    about = {"id": 1, "frameRate": 25, "upperLaneMarkings": markings[0], "lowerLaneMarkings": markings[1]}
    write_csv(folder / f"{recording}_recordingMeta.csv", [about])
    return rows


WEST_END = 330_000.0
"""x_position [ft] of x = 0 of the simulated road of I-24, westbound."""
CLOCK = 1_669_118_400.0
"""Unix time [s] of the first time step there."""


def bend(x, y, radius=np.inf, angle=0.0, shift=(0.0, 0.0)):
    """Points of a picture (y down) at x along and y to the right of a road that turns to the right."""
    theta = x / radius
    along, across = (x, 0.0 * x) if np.isinf(radius) else (radius * np.sin(theta), radius * (1.0 - np.cos(theta)))
    u, w = along - y * np.sin(theta), across + y * np.cos(theta)
    return shift[0] + u * np.cos(angle) - w * np.sin(angle), shift[1] + u * np.sin(angle) + w * np.cos(angle)


def tgsim_rows(traffic, run=1, lanes=(1, 2, 3), first=0, road=ROAD, **place):
    """Rows of the published columns at 10 Hz; lanes of the file from left to right."""
    seen = see(traffic, 5, road)
    x, y = bend(seen.x, seen.y, **place)
    columns = {
        "id": first + seen.vehicle,
        "time": (DT * seen.step).round(1),
        "xloc_kf": x,
        "yloc_kf": y,
        "lane_kf": np.array(lanes)[seen.lane],
        "speed_kf": seen.speed,
        "acceleration_kf": seen.acceleration,
        "length_smoothed": seen.length,
        "width_smoothed": seen.width,
        "type_most_common": "small-vehicle",
        "run_index": run,
    }
    return as_rows(columns)


def i24_documents(traffic, direction=-1, road=ROAD, mark=""):
    """Documents at 25 Hz; the leftmost lane begins 12 ft from the median."""
    seen, documents = see(traffic, 2, road), []
    for vehicle in np.unique(seen.vehicle).tolist():
        own = seen.vehicle == vehicle
        back, across = (seen.x - 0.5 * seen.length)[own] / FOOT, 12.0 + seen.y[own] / FOOT
        documents.append(
            {
                "_id": {"$oid": f"6387{mark}{vehicle:04x}"},
                "timestamp": (CLOCK + DT * seen.step[own]).round(6).tolist(),
                "x_position": (WEST_END + direction * back).round(5).tolist(),
                "y_position": (-direction * across).round(5).tolist(),
                "length": traffic.length[vehicle] / FOOT,
                "width": traffic.width[vehicle] / FOOT,
                "direction": direction,
                "coarse_vehicle_class": 0,
                "flags": ["none"],
            }
        )
    return documents


def write_i24(path, documents, **style):
    path.write_text(json.dumps(documents, **style), encoding="utf-8")
    return path


def table_of(*tracks, edges=EDGES) -> Trajectories:
    """Tracks as (x, y, speed), each of shape (T,), all from frame 0; vehicles 1, 2, ... of 4 m length."""
    x, y, speed = (np.concatenate([np.broadcast_to(track[i], len(track[0])) for track in tracks]) for i in range(3))
    vehicle = np.concatenate([np.full(len(track[0]), number + 1) for number, track in enumerate(tracks)])
    frame = np.concatenate([np.arange(len(track[0])) for track in tracks])
    lane = np.searchsorted(edges, y, side="right")
    columns = {"recording": "r", "vehicle": vehicle, "frame": frame, "x": x, "y": y, "speed": speed, "lane": lane}
    columns |= {"acceleration": 0.5, "length": 4.0, "width": 1.8, "leader": find_leaders(vehicle, frame, lane, x)}
    return tabulate(columns, {"r": edges})


def cutting_in(sign=1.0, pause=20):
    """Vehicle 1 moves across at 1.3 m/s from second 2 on, between vehicles 2 (behind) and 3 (ahead)."""
    t = 0.1 * np.arange(90)
    across = 1.75 + np.clip(1.3 * (t - 0.1 * pause), 0.0, 3.5)
    y, other = (across, 5.25) if sign > 0 else (7.0 - across, 1.75)
    return table_of((20.0 + 10.0 * t, y, 10.0), (9.0 * t, other, 9.0), (50.0 + 12.0 * t, other, 12.0))


LENGTH = 4.5
PAUSE = 60
"""Ticks before and after a braking."""
TICK = 0.1


def stopping_track(speed, deceleration, final=0.0):
    """Positions of a vehicle that brakes once [m]."""
    braking = np.arange(speed, final, -deceleration * TICK)
    return TICK * np.cumsum(np.concatenate([np.full(PAUSE, speed), braking, np.full(PAUSE, final)]))


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
            rows["speed"].append(np.clip(np.gradient(position, TICK), 0.0, None))
    columns = {name: np.concatenate(parts) for name, parts in rows.items()}
    constant = {"recording": "stops", "y": 0.0, "acceleration": np.nan, "length": length, "width": 1.8, "lane": 1}
    return tabulate(columns | constant)
