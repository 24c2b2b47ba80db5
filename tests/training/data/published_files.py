"""Simulated traffic in the file formats of TGSIM, I-24 MOTION, and Coifman and Li."""

from __future__ import annotations

import json

import numpy as np
from scipy.io import savemat

from tests.training.data.recordings import DT, FOOT, nearest, write_csv

WEST_END = 330_000.0
"""x_position [ft] of x = 0 of the simulated road, westbound."""
CLOCK = 1_669_118_400.0
"""Unix time [s] of the first time step."""


def bend(x, y, radius=np.inf, angle=0.0, shift=(0.0, 0.0)):
    """Points of a picture (y down) at x along and y to the right of a road that turns to the right."""
    theta = x / radius
    along, across = (x, 0.0 * x) if np.isinf(radius) else (radius * np.sin(theta), radius * (1.0 - np.cos(theta)))
    u, w = along - y * np.sin(theta), across + y * np.cos(theta)
    return shift[0] + u * np.cos(angle) - w * np.sin(angle), shift[1] + u * np.sin(angle) + w * np.cos(angle)


def tgsim_rows(traffic, run=1, lanes=(1, 2, 3), first=0, road=400.0, **place):
    """Rows of the published columns at 10 Hz; lanes of the file from left to right."""
    inside, lane, rows = traffic.inside(road), traffic.lane, []
    for i in range(traffic.x.shape[1]):
        for k in np.flatnonzero(inside[:, i]):
            if k % 5 == 0:
                x, y = bend(traffic.x[k, i], traffic.y[k, i], **place)
                rows.append(
                    {
                        "id": first + i,
                        "time": round(DT * k, 1),
                        "xloc_kf": round(float(x), 4),
                        "yloc_kf": round(float(y), 4),
                        "lane_kf": lanes[lane[k, i]],
                        "speed_kf": round(traffic.speed[k, i], 4),
                        "acceleration_kf": round(traffic.acceleration[k, i], 4),
                        "length_smoothed": round(traffic.length[i], 4),
                        "width_smoothed": round(traffic.width[i], 4),
                        "type_most_common": "small-vehicle",
                        "av": "No",
                        "run_index": run,
                    }
                )
    return rows


def i24_documents(traffic, direction=-1, road=400.0, mark=""):
    """Documents at 25 Hz; the leftmost lane begins 12 ft from the median."""
    inside, documents = traffic.inside(road), []
    for i in range(traffic.x.shape[1]):
        seen = [k for k in np.flatnonzero(inside[:, i]) if k % 2 == 0]
        if seen:
            back = (traffic.x[seen, i] - 0.5 * traffic.length[i]) / FOOT
            across = 12.0 + traffic.y[seen, i] / FOOT
            time = CLOCK + DT * np.array(seen)
            documents.append(
                {
                    "_id": {"$oid": f"6387{mark}{i:04x}"},
                    "timestamp": time.round(6).tolist(),
                    "first_timestamp": float(time[0]),
                    "last_timestamp": float(time[-1]),
                    "x_position": (WEST_END + direction * back).round(5).tolist(),
                    "y_position": (-direction * across).round(5).tolist(),
                    "length": traffic.length[i] / FOOT,
                    "width": traffic.width[i] / FOOT,
                    "height": 5.0,
                    "direction": direction,
                    "coarse_vehicle_class": 0,
                    "fragment_ids": [],
                    "flags": ["none"],
                }
            )
    return documents


def write_i24(path, documents, **style):
    path.write_text(json.dumps(documents, **style), encoding="utf-8")
    return path


def coifman_matrix(traffic, road=400.0):
    """The 18 columns with NGSIM's meaning, of which seven are filled; positions of the rear bumper."""
    inside, lane, rows = traffic.inside(road), traffic.lane, []
    rear = traffic.x - 0.5 * traffic.length
    for i in range(traffic.x.shape[1]):
        for k in np.flatnonzero(inside[:, i]):
            if k % 5 == 0:
                ahead, behind = nearest(np.where(inside[k], traffic.x[k], np.nan), lane[k], i, lane[k, i])
                row = np.zeros(18)
                row[[0, 1, 5]] = i + 1, k // 5 + 1, rear[k, i] / FOOT
                row[[11, 12, 13]] = traffic.speed[k, i] / FOOT, traffic.acceleration[k, i] / FOOT, lane[k, i] + 1
                row[[14, 15]] = ahead + 1, behind + 1
                rows.append(row)
    return np.array(rows)


def write_coifman(path, matrix):
    if path.suffix == ".mat":
        savemat(path, {"data": matrix, "note": "To use this data set for research or publication, please refer to it"})
    else:
        np.savetxt(path, matrix, fmt="%.6f")
    return path


def write_tgsim(path, rows):
    write_csv(path, rows)
    return path
