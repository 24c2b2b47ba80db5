"""Driven and replayed traffic: exact inversion of the record, which vehicles are driven, features."""

import pytest
import torch

from training.imitation.traffic.replayed_traffic import replay_features, start_replay, step_replay


def at_start(recording, tick=0):
    rows = torch.arange(len(recording.x))
    return start_replay(recording, rows, torch.full_like(rows, tick))


def recorded(recording, traffic, name):
    return getattr(recording, name)[traffic.scene, traffic.tick].gather(1, traffic.vehicle)


def test_recorded_actions_reproduce_the_record(recording):
    traffic = at_start(recording)
    for _ in range(25):
        action = torch.stack([recorded(recording, traffic, name) for name in ("acceleration", "yaw_rate")], dim=-1)
        traffic = step_replay(recording, traffic, action)
    for name in ("x", "y", "heading", "speed"):
        torch.testing.assert_close(getattr(traffic, name), recorded(recording, traffic, name), atol=1e-4, rtol=0)


def test_the_first_of_each_lane_is_replayed_and_comes_after_the_driven(recording):
    traffic = at_start(recording)
    assert traffic.driven.sum(dim=1).tolist() == [6, 6, 6]
    assert traffic.driven[:, :6].all()
    assert (traffic.vehicle[:, 6:].sort(dim=1)[0] == torch.tensor([6, 7, 8])).all()


def test_replayed_vehicles_follow_the_record_and_then_keep_their_speed(recording):
    traffic = at_start(recording)
    still = torch.zeros(*traffic.x.shape, 2)
    for _ in range(40):
        traffic = step_replay(recording, traffic, still)
    last = (traffic.vehicle == 8).nonzero()  # recorded up to tick 29
    for b, i in last.tolist():
        end = recording.x[b, 29, 8] + 11 * 0.1 * recording.speed[b, 29, 8] * torch.cos(recording.heading[b, 29, 8])
        assert traffic.x[b, i] == pytest.approx(float(end), abs=1e-3)
    ahead = traffic.vehicle == 7
    torch.testing.assert_close(traffic.x[ahead], recording.x[:, 40, 7])


def test_driven_vehicles_stop_and_do_not_reverse(recording):
    traffic = at_start(recording)
    brake = torch.zeros(*traffic.x.shape, 2)
    brake[..., 0] = -8.0
    for _ in range(30):
        traffic = step_replay(recording, traffic, brake)
    assert (traffic.speed[traffic.driven] == 0).all()


def test_a_curriculum_drives_the_rearmost(recording):
    rows = torch.arange(3)
    traffic = start_replay(recording, rows, torch.zeros_like(rows), most=2)
    assert traffic.driven.sum(dim=1).tolist() == [2, 2, 2]
    assert traffic.x[traffic.driven].max() < 25


def test_features_are_where_the_names_say(recording):
    from rare_envs.sensors.perception import FEATURES

    traffic = at_start(recording)
    features = replay_features(traffic)
    assert len(FEATURES) == features.shape[-1] == 51
    torch.testing.assert_close(features[..., FEATURES.index("speed")], traffic.speed)
    left, right = (features[..., FEATURES.index(name)] for name in ("left_marker", "right_marker"))
    torch.testing.assert_close(left + right, torch.full_like(left, 3.6))
    torch.testing.assert_close(features[..., 0], 0.5 * (left - right))
