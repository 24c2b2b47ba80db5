"""The compiled rule of collision avoidance against its torch twin."""

import numpy as np
import pytest
import torch

from agents.learned import CollisionAvoidance
from rare_envs.sensors.lidar import MAX_RANGE
from rare_envs.sensors.perception import FEATURES, RANGE_COLUMNS, RATE_COLUMNS, SPEED_COLUMN
from rare_envs.simulation.compiled.highway.avoidance_lanes import AvoidanceNumbers, limit_action
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_FIELDS, LOOKING

RULE = CollisionAvoidance()
N = 100


def seen(rng) -> torch.Tensor:
    """What N vehicles perceive: bodies in half of the beams, near ones and far ones, at rest and fast."""
    features = torch.zeros(N, 51)
    features[:, FEATURES.index("length")], features[:, FEATURES.index("width")] = 5.0, 2.0
    features[:, SPEED_COLUMN] = torch.from_numpy(rng.uniform(0.0, 30.0, N))
    ranges = np.where(rng.random((N, 20)) < 0.5, rng.uniform(0.0, 1.0, (N, 20)) ** 2 * MAX_RANGE, MAX_RANGE)
    features[:, RANGE_COLUMNS] = torch.from_numpy(ranges).float()
    features[:, RATE_COLUMNS] = torch.from_numpy(rng.uniform(-15.0, 10.0, (N, 20))).float()
    return features


def limit_all(features, action, numbers) -> np.ndarray:
    beams = np.zeros((20, BEAM_FIELDS * LOOKING), np.float32)
    beams[:, :N] = features[:, RANGE_COLUMNS].T
    beams[:, LOOKING : LOOKING + N] = features[:, RATE_COLUMNS].T
    speed = features[:, SPEED_COLUMN].numpy()
    return np.array([limit_action(*action[i].numpy(), speed[i], beams, i, numbers) for i in range(N)])


@pytest.mark.parametrize("rule", [RULE, CollisionAvoidance(deceleration=0.5, clearance=1.0, turning_radius=20.0)])
def test_bounds_are_those_of_torch(rule):
    rng = np.random.default_rng(0)
    features = seen(rng)
    action = torch.from_numpy(rng.uniform((-2.0, -0.3), (4.0, 0.3), (N, 2))).float()
    expected = rule.limit(features[:, None], action[:, None])[:, 0].numpy()
    found = limit_all(features, action, AvoidanceNumbers.of(rule.settings()))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert ((expected != action.numpy()).mean(axis=0) > 0.1).all()  # both kinds of bounds apply


def test_without_a_rule_actions_stay():
    rng = np.random.default_rng(0)
    features, action = seen(rng), torch.from_numpy(rng.uniform(-1.0, 1.0, (N, 2))).float()
    assert np.array_equal(limit_all(features, action, AvoidanceNumbers.of(None)), action.numpy())


def test_braking_for_a_vehicle_that_stands():
    """20 m/s, 50 m less half a length and 0.5 m to its rear: 20^2 / (2 * 50) = 4 m/s^2."""
    beams = np.zeros((20, BEAM_FIELDS * LOOKING), np.float32)
    beams[:, 0] = MAX_RANGE
    ahead = FEATURES.index("range_0") - RANGE_COLUMNS.start
    beams[ahead, 0], beams[ahead, LOOKING] = 53.0, -20.0
    speed, nothing = np.float32(20.0), np.float32(0.0)
    acceleration, yaw_rate = limit_action(nothing, nothing, speed, beams, 0, AvoidanceNumbers.of(RULE.settings()))
    assert np.isclose(acceleration, -4.0) and yaw_rate == 0.0
