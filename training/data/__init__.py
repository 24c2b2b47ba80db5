"""Recorded traffic: trajectory tables, smoothing, scenes and events."""

from training.data.brakings import hard_brake_events
from training.data.events import car_following_events, cut_in_events
from training.data.formats.coifman_li import load_coifman_li
from training.data.formats.highd import highd_recordings, load_highd
from training.data.formats.i24_motion import load_i24_motion
from training.data.formats.ngsim import load_ngsim
from training.data.formats.tgsim import find_tgsim_files, load_tgsim
from training.data.scenes import TrafficScene, load_us101_scenes, split_by_clock
from training.data.synthetic import synthetic_traffic
from training.data.trajectories import NOBODY, Trajectories, read_trajectories, tabulate, write_trajectories
from training.data.windows import scenes_of

__all__ = [
    "NOBODY",
    "TrafficScene",
    "Trajectories",
    "car_following_events",
    "cut_in_events",
    "find_tgsim_files",
    "hard_brake_events",
    "highd_recordings",
    "load_coifman_li",
    "load_highd",
    "load_i24_motion",
    "load_ngsim",
    "load_tgsim",
    "load_us101_scenes",
    "read_trajectories",
    "scenes_of",
    "split_by_clock",
    "synthetic_traffic",
    "tabulate",
    "write_trajectories",
]
