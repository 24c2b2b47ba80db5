"""Scenes in which drivers perceive others, as torch and as compiled rollouts have them, and drivers with rules."""

from dataclasses import replace

import numpy as np
import torch

from agents.learned.collision_avoidance import CloseRange, CollisionAvoidance
from agents.learned.lane_changes import LaneChanges, Waiting
from rare_envs.sensors.lidar import MAX_RANGE
from rare_envs.sensors.perception import FEATURES, RANGE_COLUMNS, RATE_COLUMNS
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import OwnMotion
from rare_envs.simulation.compiled.highway.driving_rules.settings import LaneChangeSettings
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_FIELDS, LOOKING

N = LOOKING
"""Vehicles of a scene."""
EAGER = LaneChanges(coefficients=(-1.5, -0.3, 0.2, -0.1, -0.05))
"""Changes lanes within seconds."""
CHANGES = {"given up": EAGER, "waiting": replace(EAGER, foresight=2.4, over_line=0.2, waiting=Waiting())}
RULES = {"plain": CollisionAvoidance(), "close range": CollisionAvoidance(close=CloseRange())}


def draw_features(rng: np.random.Generator) -> torch.Tensor:
    """What N vehicles of a scene perceive, shape (N, 51): in lanes of 3.6 m, bodies in half of the beams."""
    features = torch.zeros(N, 51)
    offset, heading = rng.uniform(-1.9, 1.9, N), rng.choice([0.0, 0.02, 0.3], N) * rng.normal(size=N)
    known = {"length": 5.0, "width": 2.0, "lane_offset": offset, "heading": heading, "speed": rng.uniform(0, 30, N)}
    known |= {"left_marker": 1.8 + offset, "right_marker": 1.8 - offset}
    for name, values in known.items():
        features[:, FEATURES.index(name)] = torch.as_tensor(values).float()
    ranges = np.where(rng.random((N, 20)) < 0.5, rng.uniform(0.0, 1.0, (N, 20)) ** 2 * MAX_RANGE, MAX_RANGE)
    features[:, RANGE_COLUMNS] = torch.from_numpy(ranges).float()
    features[:, RATE_COLUMNS] = torch.from_numpy(rng.uniform(-15.0, 10.0, (N, 20))).float()
    return features


def beams_of(features: torch.Tensor) -> np.ndarray:
    """The beams as `measure_beams` writes them."""
    beams = np.zeros((20, BEAM_FIELDS * LOOKING), np.float32)
    beams[:, :N], beams[:, LOOKING : LOOKING + N] = features[:, RANGE_COLUMNS].T, features[:, RATE_COLUMNS].T
    return beams


def own_motions(features: torch.Tensor) -> list[OwnMotion]:
    """The own motion of each vehicle."""
    names = ("left_marker", "right_marker", "heading", "speed")
    left, right, heading, speed = (features[:, FEATURES.index(name)].numpy() for name in names)
    return [OwnMotion(*row) for row in zip(left, right, heading, speed, speed * np.sin(heading), strict=True)]


def single_settings(changes: LaneChanges) -> LaneChangeSettings:
    """The settings in single precision."""
    return LaneChangeSettings(*map(np.float32, changes.settings()))
