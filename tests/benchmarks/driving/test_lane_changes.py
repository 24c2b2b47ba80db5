"""The study of lane changes on a made-up one: found in the record, finished or given up, steered by hand."""

from types import SimpleNamespace

import pytest
import torch

from benchmarks.driving.lane_changes import CLASSES, OFFSET, count_completed, measure_steering
from rare_envs.sensors.perception import HEADING_COLUMN, SPEED_COLUMN
from tests.training.imitation.synthetic_scenes import crossing_recording
from training.imitation.algorithms.expert_pairs import Pairs
from training.imitation.traffic.crossings import find_crossings


@pytest.fixture
def recording():
    return crossing_recording()


def test_who_goes_straight_on_completes_it_and_who_turns_back_does_not(recording):
    def straight(features, memory):
        return torch.zeros(*features.shape[:2], 2), None

    def back(features, memory):
        action = torch.zeros(*features.shape[:2], 2)
        action[..., 1] = -features[..., HEADING_COLUMN] / 0.1 - 0.01
        return action, None

    found = find_crossings(recording)
    assert count_completed(recording, found, straight, 1.0) == (1, 1.0)
    assert count_completed(recording, found, back, 1.0) == (1, 0.0)


def test_steering_is_counted_towards_where_a_vehicle_moves():
    """Two vehicles move out, to the right and to the left, at 1 m/s across; one keeps its lane."""
    features = torch.zeros(3, 51)
    features[:, SPEED_COLUMN] = 20.0
    features[:, HEADING_COLUMN] = torch.tensor([0.05, -0.05, 0.001])
    features[:, OFFSET] = torch.tensor([0.5, -0.5, 0.0])
    pairs = Pairs(features, torch.tensor([[0.0, 0.02], [0.0, -0.01], [0.0, 0.3]]), torch.zeros(3))
    driver = SimpleNamespace(act=lambda seen: (torch.full((*seen.shape[:2], 2), 0.04), None))
    found = measure_steering(pairs, {"always right": driver})
    keeps, _, out, comes = (found[name] for name in CLASSES)
    assert out == pytest.approx({"moments": 2, "people": 0.015, "always right": 0.0}, abs=1e-6)
    assert keeps == pytest.approx({"moments": 1, "people": 0.3, "always right": 0.04}, abs=1e-6)
    assert comes["moments"] == 0
