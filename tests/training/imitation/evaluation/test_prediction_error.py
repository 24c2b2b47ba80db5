"""Errors of one driven vehicle among replayed others."""

import torch

from training.imitation.evaluation.behaviour import regular_starts
from training.imitation.evaluation.prediction_error import TIMES, draw_segments, prediction_errors
from training.imitation.traffic.replayed_traffic import start_replay


def test_one_vehicle_is_driven_and_the_others_replayed(recording):
    chosen = draw_segments(recording, 2.0, 2, torch.Generator().manual_seed(0))
    assert len(chosen[0]) == 2 * len(regular_starts(recording)[0])
    traffic = start_replay(recording, *chosen[:2], only=chosen[2])
    assert (traffic.driven.sum(dim=1) == 1).all()
    assert torch.equal(traffic.vehicle[:, 0], chosen[2])


def test_constant_speed_is_off_by_what_the_record_changed(recording, constant):
    chosen = draw_segments(recording, 10.0, 3, torch.Generator().manual_seed(0))  # at the start of each scene
    found = prediction_errors(recording, constant, chosen, rollouts=2)
    scene, _, vehicle = chosen
    speed = recording.speed[scene, 20, vehicle] - recording.speed[scene, 0, vehicle]
    torch.testing.assert_close(found[2.0].speed[: len(scene)], -speed)
    torch.testing.assert_close(found[2.0].speed[len(scene) :], -speed)
    assert len(found[10.0].speed) == 0  # the record is 6 s long
    assert set(found) == set(TIMES)
    assert found[0.5].position.abs().mean() < found[5.0].position.abs().mean()
