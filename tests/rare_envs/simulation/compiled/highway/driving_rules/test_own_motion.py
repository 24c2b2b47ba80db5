"""Compiled own motion against what drivers perceive."""

import math

import numpy as np
import torch

from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import perceive_own
from rare_envs.traffic.road import i80

ROAD = CurvedRoadNumbers.of(i80())


def test_distances_to_the_lines_of_the_lane_and_off_the_road_too():
    y = np.linspace(-3.0, 25.0, 60, dtype=np.float32)
    owns = [perceive_own(each, np.float32(0.0), np.float32(20.0), ROAD) for each in y]
    left, right = i80().markers(torch.from_numpy(y))
    assert np.allclose([own.left for own in owns], left) and np.allclose([own.right for own in owns], right)


def test_speed_across_is_to_the_right():
    own = perceive_own(np.float32(5.0), np.float32(-0.1), np.float32(20.0), ROAD)
    assert math.isclose(own.across, 20.0 * math.sin(-0.1), rel_tol=1e-6)
