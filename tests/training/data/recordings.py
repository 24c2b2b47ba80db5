"""Simulated traffic in the file formats of recorded traffic: raw NGSIM and highD."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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


def write_csv(path, rows):
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def ngsim_rows(traffic, road=400.0):
    """Rows of the published columns, in feet, sorted by vehicle and frame."""
    inside, lane, rows = traffic.inside(road), traffic.lane, []
    front = traffic.x + 0.5 * traffic.length
    for i in range(traffic.x.shape[1]):
        for k in np.flatnonzero(inside[:, i])[::1]:
            if k % 5:
                continue
            j, b = nearest(np.where(inside[k], traffic.x[k], np.nan), lane[k], i, lane[k, i])
            rows.append(
                {
                    "Vehicle_ID": i + 1,
                    "Frame_ID": k // 5 + 1,
                    "Total_Frames": 0,
                    "Global_Time": 1_118_846_980_000 + 20 * k,
                    "Local_X": round(traffic.y[k, i] / FOOT, 3),
                    "Local_Y": round(front[k, i] / FOOT, 3),
                    "Global_X": 0.0,
                    "Global_Y": 0.0,
                    "v_Length": round(traffic.length[i] / FOOT, 3),
                    "v_Width": round(traffic.width[i] / FOOT, 3),
                    "v_Class": 2,
                    "v_Vel": round(traffic.speed[k, i] / FOOT, 3),
                    "v_Acc": round(traffic.acceleration[k, i] / FOOT, 3),
                    "Lane_ID": lane[k, i] + 1,
                    "Preceding": j + 1,
                    "Following": b + 1,
                    "Space_Headway": 0.0,
                    "Time_Headway": 0.0,
                }
            )
    return rows


def write_ngsim(path, traffic, road=400.0):
    rows = ngsim_rows(traffic, road)
    write_csv(path, rows)
    return rows


def write_highd(folder, upper, lower, recording="01", road=420.0):
    """The three files of a recording at 25 Hz; `upper` drives towards -x."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows, meta, first = [], [], 1
    top = 8.0  # y of the first upper marking in the picture
    bottom = top + LANE * upper.lanes + 6.0  # and of the first lower one
    for traffic, direction in ((upper, 1), (lower, 2)):
        inside, lane = traffic.inside(road), traffic.lane
        for i in range(traffic.x.shape[1]):
            seen = [k for k in np.flatnonzero(inside[:, i]) if k % 2 == 0]
            if not seen:
                continue
            meta.append({"id": first + i, "numFrames": len(seen), "class": "Car", "drivingDirection": direction})
            for k in seen:
                j, _ = nearest(np.where(inside[k], traffic.x[k], np.nan), lane[k], i, lane[k, i])
                x, y = traffic.x[k, i], traffic.y[k, i]
                across = (traffic.y[min(k + 1, len(traffic.y) - 1), i] - traffic.y[k, i]) / DT
                sign = 1.0
                if direction == 1:
                    x, y, sign = road - x, LANE * traffic.lanes - y, -1.0
                y += top if direction == 1 else bottom
                rows.append(
                    {
                        "frame": k // 2 + 1,
                        "id": first + i,
                        "x": round(x - 0.5 * traffic.length[i], 4),
                        "y": round(y - 0.5 * traffic.width[i], 4),
                        "width": round(traffic.length[i], 4),
                        "height": round(traffic.width[i], 4),
                        "xVelocity": round(sign * traffic.speed[k, i], 4),
                        "yVelocity": round(sign * across, 4),
                        "xAcceleration": round(sign * traffic.acceleration[k, i], 4),
                        "precedingId": first + j if j >= 0 else 0,
                        "laneId": 0,
                    }
                )
        first += traffic.x.shape[1]
    write_csv(folder / f"{recording}_tracks.csv", rows)
    write_csv(folder / f"{recording}_tracksMeta.csv", meta)
    markings = [
        ";".join(f"{start + LANE * k:g}" for k in range(traffic.lanes + 1))
        for start, traffic in ((top, upper), (bottom, lower))
    ]
    write_csv(
        folder / f"{recording}_recordingMeta.csv",
        [{"id": 1, "frameRate": 25, "upperLaneMarkings": markings[0], "lowerLaneMarkings": markings[1]}],
    )
    return rows


def expected(traffic, table, steps, first=0):
    """Simulated values at the rows of a table, by name."""
    k, i = steps, table.vehicle - first
    names = ("x", "y", "speed", "acceleration")
    values = {name: getattr(traffic, name)[k, i] for name in names}
    return values | {"length": traffic.length[i], "width": traffic.width[i], "lane": traffic.lane[k, i] + 1}


def check_values(table, values, x_offset=0.0, atol=2e-3):
    for name in ("x", "y", "length", "width", "speed"):
        offset = x_offset if name == "x" else 0.0
        np.testing.assert_allclose(table.column(name), values[name] + offset, atol=atol, err_msg=name)


def change(rows, index, **values):
    return [{**row, **values} if i == index else row for i, row in enumerate(rows)]


def table_of(*tracks, edges=EDGES) -> Trajectories:
    """Tracks as (x, y, speed), each of shape (T,), all from frame 0; vehicles 1, 2, ... of 4 m length."""
    x, y, speed = (np.concatenate([np.broadcast_to(track[i], len(track[0])) for track in tracks]) for i in range(3))
    vehicle = np.concatenate([np.full(len(track[0]), number + 1) for number, track in enumerate(tracks)])
    frame = np.concatenate([np.arange(len(track[0])) for track in tracks])
    lane = np.searchsorted(edges, y, side="right")
    row = find_leaders(frame, lane, x)
    columns = {"recording": "r", "vehicle": vehicle, "frame": frame, "x": x, "y": y, "speed": speed, "lane": lane}
    columns |= {"acceleration": 0.5, "length": 4.0, "width": 1.8, "leader": np.where(row >= 0, vehicle[row], NOBODY)}
    return tabulate(columns, {"r": edges})


def cutting_in(sign=1.0, pause=20):
    """Vehicle 1 moves across at 1.3 m/s from second 2 on, between vehicles 2 (behind) and 3 (ahead)."""
    t = 0.1 * np.arange(90)
    across = 1.75 + np.clip(1.3 * (t - 0.1 * pause), 0.0, 3.5)
    y, other = (across, 5.25) if sign > 0 else (7.0 - across, 1.75)
    return table_of((20.0 + 10.0 * t, y, 10.0), (9.0 * t, other, 9.0), (50.0 + 12.0 * t, other, 12.0))
