"""Behaviour in recorded scenes: which moments count, and which bodies overlap."""

import math

import torch

from tests.training.imitation.synthetic_scenes import scene
from training.imitation.evaluation.behaviour import find_overlaps, recorded_behaviour
from training.imitation.evaluation.driving_statistics import binned_quantities
from training.imitation.traffic.recording import stack_scenes
from training.imitation.traffic.replayed_traffic import start_replay


def at_start(recording, tick=0):
    rows = torch.arange(len(recording.x))
    return start_replay(recording, rows, torch.full_like(rows, tick))


def test_the_record_counts_every_moment_that_may_be_driven_and_no_more(recording):
    behaviour = recorded_behaviour(recording)
    assert behaviour.known.sum() == 4 * (6 * 59 - 29)
    accelerations = behaviour.acceleration[behaviour.known]
    assert accelerations.abs().max() <= 0.6 + 1e-6
    jerk, _ = binned_quantities(behaviour)["jerk"]
    assert jerk.abs().max() <= 0.6 * 1.3 + 0.05  # 0.6 cos(1.3 t)


def test_overlap_of_boxes():
    traffic = at_start(stack_scenes([scene(vehicles=6)]))
    traffic = traffic._replace(x=traffic.x * 0, y=traffic.y * 0, heading=traffic.heading * 0)
    beside = traffic._replace(y=torch.tensor([[0.0, 1.8, 3.0, 5.4, 30.0, 60.0]]))
    assert find_overlaps(beside, 6)[0, 0].tolist() == [False, True, False, False, False, False]
    turned = beside._replace(heading=torch.tensor([[0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0]]))
    assert find_overlaps(turned, 6)[0, 0].tolist() == [False, True, True, False, False, False]  # 0.95 + 2.25 > 3
