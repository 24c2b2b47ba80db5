"""Recorded traffic: trajectory tables, smoothing, scenes and events."""

from training.data.events import car_following_events, cut_in_events, hard_brake_events
from training.data.formats import (
    load_coifman_li,
    load_highd,
    load_i24_motion,
    load_ngsim,
    load_recordings,
    load_tgsim,
)
from training.data.scenes import TrafficScene, load_us101_scenes, scenes_of, split_by_clock
from training.data.table import NOBODY, Trajectories, synthetic_traffic, tabulate

__all__ = [
    "NOBODY",
    "TrafficScene",
    "Trajectories",
    "car_following_events",
    "cut_in_events",
    "hard_brake_events",
    "load_coifman_li",
    "load_highd",
    "load_i24_motion",
    "load_ngsim",
    "load_recordings",
    "load_tgsim",
    "load_us101_scenes",
    "scenes_of",
    "split_by_clock",
    "synthetic_traffic",
    "tabulate",
]
