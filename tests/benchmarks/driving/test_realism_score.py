"""The realism score of drivers in miniature."""

import json

import numpy as np
import pytest
import torch

from agents import LearnedDriver
from benchmarks.driving import realism_score
from benchmarks.driving.realism import constant_velocity
from benchmarks.driving.realism_score import (
    average_scenes,
    by_features,
    by_lanes,
    find_starts,
    format_table,
    judge,
    measure_scores,
    simulate,
)
from benchmarks.driving.sim_agents import FEATURE_NAMES
from rare_envs.control.lane_changing import LaneChangingDriver
from tests.training.imitation.synthetic_scenes import plain_policy, scenes
from training.imitation.traffic import stack_scenes


@pytest.fixture(scope="module", autouse=True)
def short():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(realism_score, "TICKS", 20)
        patch.setattr(realism_score, "LEAST_TICKS", 25)
        yield


@pytest.fixture(scope="module")
def recording():
    return stack_scenes(scenes(2))


@pytest.fixture(scope="module")
def starts(recording):
    return list(find_starts(recording))


def test_starts_hold_the_record_until_it_ends(recording, starts):
    assert [(int(start.scene), int(start.tick)) for start in starts] == [(0, 0), (0, 20), (1, 0), (1, 20)]
    second = starts[1]
    assert second.states.shape == (9, 21, 3)  # the scene has 60 ticks
    leaver = int((second.traffic.vehicle[0] == 8).nonzero()[0, 0])  # in view for the first 30 ticks of the scene
    assert second.valid[leaver].tolist() == [True] * 10 + [False] * 11
    assert second.valid.sum() == 8 * 21 + 10
    someone = int(second.traffic.vehicle[0, 0])
    torch.testing.assert_close(second.states[0, :, 0], recording.x[0, 20:41, someone])


def test_rollouts_begin_at_the_record_and_follow_the_driver(recording, starts):
    poses = simulate(recording, starts[0], by_features(constant_velocity), 3)
    torch.testing.assert_close(poses[:, :, 0], starts[0].states[:, 0].expand(3, -1, -1))
    driven = starts[0].traffic.driven[0]
    along = poses[0, driven, -1, 0] - poses[0, driven, 0, 0]
    torch.testing.assert_close(along, 2.0 * (starts[0].traffic.speed * starts[0].traffic.heading.cos())[0, driven])
    torch.testing.assert_close(poses[0, ~driven], starts[0].states[~driven], rtol=0, atol=1e-4)  # replayed


def test_the_record_scores_better_than_constant_velocity(recording, starts):
    start = starts[0]
    steady = simulate(recording, start, by_features(constant_velocity), 8)
    best, worse = (judge(start, each)["motorway"]["meta"] for each in (start.states.expand(8, -1, -1, -1), steady))
    assert best > worse > 0


def test_idm_and_mobil_remember_their_lanes(recording, starts):
    decide = by_lanes(LaneChangingDriver())
    action, memory = decide(starts[0].traffic, None)
    assert action.shape == (1, starts[0].traffic.drivers, 2)
    _, after = decide(starts[0].traffic, memory)
    assert (after[..., 0] >= 1).all()


def test_means_are_over_starts_then_over_scenes(starts):
    rows = [judge(start, start.states.expand(2, -1, -1, -1)) for start in starts]
    for row, collision in zip(rows, (0.0, 0.2, 0.5, 0.7), strict=True):
        row["collision"] = collision
    found = average_scenes(rows)["collision"]
    assert len(average_scenes(rows)["wosac_2024"]["meta"]["scenes"]) == 2
    assert found["mean"] == pytest.approx(0.35)
    assert found["standard_error"] == pytest.approx(np.std([0.1, 0.6], ddof=1) / np.sqrt(2))


def test_every_row_has_every_feature_and_the_same_seed_the_same_score(recording):
    drivers = {"mgail": LearnedDriver(plain_policy())}
    found = measure_scores(recording, drivers, seed=1, rollouts=2)
    names = ["the record itself", "constant velocity", "idm", "idm+mobil", "mgail"]
    assert list(found) == names
    json.dumps(found, allow_nan=False)
    for row in found.values():
        assert set(row["wosac_2024"]["likelihoods"]) == set(FEATURE_NAMES)
        assert all(0 < value["mean"] <= 1 for value in row["wosac_2024"]["likelihoods"].values())
    best = found["the record itself"]["wosac_2024"]
    assert best["min_ade"]["mean"] == 0 and all(
        best["meta"]["mean"] >= row["wosac_2024"]["meta"]["mean"] for row in found.values()
    )
    assert format_table(found).count("\n") == 1 + len(names)
    again = measure_scores(recording, drivers, seed=1, rollouts=2)
    other = measure_scores(recording, drivers, seed=2, rollouts=2)
    assert again["mgail"] == found["mgail"] != other["mgail"]
