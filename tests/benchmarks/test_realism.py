"""Realism of drivers in miniature: the report, the score of rollouts, and features of motion by hand."""

import json
import math

import numpy as np
import pytest
import torch

from agents import LearnedDriver
from agents.learned.networks import HUMAN_NOISE, WeightDistribution, head_weights
from benchmarks.driving import realism, realism_score
from benchmarks.driving.realism import constant_velocity, format_realism, measure_all
from benchmarks.driving.realism_score import average_scenes, by_features, find_starts, simulate
from benchmarks.driving.realism_score import judge as judge_start
from benchmarks.driving.sim_agents import (
    FAR,
    MAX_TIME_TO_COLLISION,
    WOSAC_2024,
    FeatureSetting,
    box_distance_of_sizes,
    feature_likelihood,
    kinematic_features,
    motion_features,
)
from rare_envs.traffic.bodies import axes_of, box_distance
from tests.training.imitation.synthetic_scenes import scenes, tiny
from training.imitation.traffic import stack_scenes
from training.imitation.train import make_learner, prepare_data


@pytest.fixture(scope="module")
def driver():
    data = prepare_data(scenes(2))
    policy = make_learner(data, tiny()).policy.eval().requires_grad_(False)
    mean = head_weights(policy).double().numpy()
    return LearnedDriver(policy, HUMAN_NOISE, weights=WeightDistribution(mean, 1e6 * np.eye(404)), name="mine")


def test_a_report_has_every_row(recording, driver, monkeypatch):
    monkeypatch.setattr(realism, "SECONDS", (2.0, 3.0))
    rows = measure_all(recording, recording, {"mine": driver}, noises=2, draws=2)
    json.dumps(rows, allow_nan=False)
    names = ["people", "constant velocity", "IDM, lane keeping", "mine", "mine, drawn from its distribution"]
    assert [row["name"] for row in rows] == names
    one = rows[3]["2 s"]
    assert one["vehicles"] == 2 * (6 + 6 + 5) * 2  # scenes, starts at 0, 2 and 4 s, sequences of noise
    assert one["collision"] == pytest.approx(np.mean(one["collisions"]))
    assert one["standard_error"]["mean_speed"] > 0
    table = format_realism(rows, "3 s")
    assert all(f"| {name} |" in table for name in names)


@pytest.fixture(scope="module", autouse=True)
def short():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(realism_score, "TICKS", 20)
        patch.setattr(realism_score, "LEAST_TICKS", 25)
        yield


@pytest.fixture(scope="module")
def recording():
    return stack_scenes(scenes(2))


def test_starts_hold_the_record_until_it_ends(recording):
    starts = list(find_starts(recording))
    assert [(int(start.scene), int(start.tick)) for start in starts] == [(0, 0), (0, 20), (1, 0), (1, 20)]
    second = starts[1]
    assert second.states.shape == (9, 21, 3)  # the scene has 60 ticks
    leaver = int((second.traffic.vehicle[0] == 8).nonzero()[0, 0])  # in view for the first 30 ticks of the scene
    assert second.valid[leaver].tolist() == [True] * 10 + [False] * 11
    assert second.valid.sum() == 8 * 21 + 10
    someone = int(second.traffic.vehicle[0, 0])
    torch.testing.assert_close(second.states[0, :, 0], recording.x[0, 20:41, someone])


def test_rollouts_begin_at_the_record_and_follow_the_driver(recording):
    starts = list(find_starts(recording))
    poses = simulate(recording, starts[0], by_features(constant_velocity), 3)
    torch.testing.assert_close(poses[:, :, 0], starts[0].states[:, 0].expand(3, -1, -1))
    driven = starts[0].traffic.driven[0]
    along = poses[0, driven, -1, 0] - poses[0, driven, 0, 0]
    torch.testing.assert_close(along, 2.0 * (starts[0].traffic.speed * starts[0].traffic.heading.cos())[0, driven])
    torch.testing.assert_close(poses[0, ~driven], starts[0].states[~driven], rtol=0, atol=1e-4)  # replayed


def test_means_are_over_starts_then_over_scenes(recording):
    starts = list(find_starts(recording))
    rows = [judge_start(start, start.states.expand(2, -1, -1, -1)) for start in starts]
    for row, collision in zip(rows, (0.0, 0.2, 0.5, 0.7), strict=True):
        row["collision"] = collision
    found = average_scenes(rows)["collision"]
    assert len(average_scenes(rows)["wosac_2024"]["meta"]["scenes"]) == 2
    assert found["mean"] == pytest.approx(0.35)
    assert found["standard_error"] == pytest.approx(np.std([0.1, 0.6], ddof=1) / np.sqrt(2))


LANE_EDGES = (-1.75, 5.25)
HALVES = FeatureSetting(0.0, 2.0, 2, 1.0, pseudocount=0.5)
T = 9
CLOCK = 0.1 * torch.arange(T, dtype=torch.float64)


def agent(x=0.0, y=0.0, heading=0.0, speed=0.0):
    """Poses (T, 3) of one that drives straight on along the road."""
    return torch.stack((x + speed * CLOCK, y + 0 * CLOCK, heading + 0 * CLOCK), dim=-1)


def features(*agents, valid=None, sizes=None, **kwargs):
    states = torch.stack(agents)
    valid = torch.ones(states.shape[:2], dtype=torch.bool) if valid is None else valid
    sizes = torch.tensor([[4.0, 2.0]] * len(agents), dtype=torch.float64) if sizes is None else sizes
    return motion_features(states, valid, sizes, LANE_EDGES, **kwargs)


def test_kinematics_of_a_parabola_and_a_turn():
    """x = 10 t + t^2 and a heading of 0.3 t^2: central differences are exact for both."""
    states = torch.stack((10 * CLOCK + CLOCK**2, 0 * CLOCK, 0.3 * CLOCK**2), dim=-1)
    speed, acceleration, turn, turn_change = kinematic_features(states)
    torch.testing.assert_close(speed[1:-1], (10 + 2 * CLOCK)[1:-1])
    torch.testing.assert_close(turn[1:-1], (0.6 * CLOCK)[1:-1])
    torch.testing.assert_close(acceleration[2:-2], torch.full((T - 4,), 2.0, dtype=torch.float64))
    torch.testing.assert_close(turn_change[2:-2], torch.full((T - 4,), 0.6, dtype=torch.float64))
    for values, missing in ((speed, 1), (acceleration, 2), (turn, 1), (turn_change, 2)):
        assert values.isnan().nonzero()[:, 0].tolist() == [*range(missing), *range(T - missing, T)]


def test_behind_a_slower_one():
    found = features(agent(speed=20.0), agent(x=30.0, speed=15.0))
    gap = 26.0 - 5.0 * CLOCK  # bumper to bumper
    torch.testing.assert_close(found["distance_to_nearest_object"][0], gap)
    torch.testing.assert_close(found["time_to_collision"][0, 1:-1], (gap / 5.0).clamp(max=MAX_TIME_TO_COLLISION)[1:-1])
    assert found["time_to_collision"][1, 1:-1].eq(MAX_TIME_TO_COLLISION).all()  # the one in front follows nobody
    assert not found["collision_indication"].any()


def test_bodies_that_overlap_collide_by_their_depth_and_the_outermost_corner_leaves_the_road_first():
    found = features(agent(), agent(x=3.0, y=1.5))
    torch.testing.assert_close(found["distance_to_nearest_object"], torch.full((2, T), -0.5, dtype=torch.float64))
    assert found["collision_indication"].eq(1).all()
    found = features(agent(y=0.0), agent(x=50.0, y=4.0), agent(x=90.0, y=4.0, heading=0.5))
    reach = 2.0 * math.sin(0.5) + 1.0 * math.cos(0.5)
    expected = torch.tensor([-0.75, -0.25, 4.0 + reach - 5.25], dtype=torch.float64)
    torch.testing.assert_close(found["distance_to_road_edge"][:, 0], expected)
    assert found["offroad_indication"][:, 0].tolist() == [0.0, 0.0, 1.0]


def test_steps_that_are_not_recorded_have_no_features_and_are_not_seen():
    valid = torch.ones(2, T, dtype=torch.bool)
    valid[1, 4:] = False
    found = features(agent(), agent(x=10.0), valid=valid)
    assert found["distance_to_nearest_object"][0].tolist() == [6.0] * 4 + [FAR] * 5
    assert found["distance_to_nearest_object"][1].isnan().tolist() == [False] * 4 + [True] * 5
    assert found["linear_speed"][1].isnan().tolist() == [True, False, False] + [True] * 6
    assert found["linear_acceleration"][1].isnan().all()


def test_distances_are_those_of_the_simulators_bodies():
    generator = torch.Generator().manual_seed(0)
    dx, dy, one, other = (torch.rand(4, 2000, generator=generator, dtype=torch.float64) * 2 - 1).unbind()
    dx, dy, one, other = 12 * dx, 6 * dy, 3 * one, 3 * other
    cos, sin = torch.cos(one), torch.sin(one)
    size = (torch.tensor(5.0), torch.tensor(2.0))
    ours = box_distance_of_sizes(dx * cos + dy * sin, dy * cos - dx * sin, other - one, size, size)
    theirs = box_distance(axes_of(dx, dy, one, other), other - one)
    assert 100 < (theirs < 0).sum() < 1900
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)


def test_the_likelihood_is_the_geometric_mean_over_agents_and_steps():
    simulated = torch.tensor([[[0.1, 0.9], [1.1, 9.0]], [[0.2, 1.5], [1.9, 1.0]]])
    recorded, valid = torch.tensor([[0.5, 1.5], [-3.0, 1.2]]), torch.ones(2, 2, dtype=torch.bool)
    # agent 0: 3 of 4 values in the first bin, (3 + .5) / (4 + 1); agent 1: none of 4, and one beyond the last edge
    expected = (0.7 * 0.3 * 0.1 * 0.9) ** 0.25
    assert feature_likelihood("linear_speed", simulated, recorded, valid, HALVES) == pytest.approx(expected)


def test_invalid_and_missing_steps_count_neither_in_the_histogram_nor_in_the_mean():
    simulated = torch.tensor([[[0.1, 0.9, 1.5]], [[0.2, math.nan, 1.5]]])
    recorded, valid = torch.tensor([[0.5, 1.5, 0.5]]), torch.tensor([[True, True, False]])
    # three values are left, all in the first bin
    expected = math.sqrt(3.5 / 4 * 0.5 / 4)
    assert feature_likelihood("linear_speed", simulated, recorded, valid, HALVES) == pytest.approx(expected)
    missing = torch.tensor([[0.5, math.nan, 0.5]])
    assert feature_likelihood("linear_speed", simulated, missing, valid, HALVES) == pytest.approx(2.5 / 3)


def test_an_event_counts_once_in_a_rollout():
    """Of four rollouts one collides, at two steps; agent 0 of the record collides, agent 1 does not."""
    simulated = torch.zeros(4, 2, 5)
    simulated[0, :, 2:4] = 1.0
    recorded = torch.zeros(2, 5)
    recorded[0, 1] = 1.0
    valid = torch.ones(2, 5, dtype=torch.bool)
    setting = WOSAC_2024["collision_indication"]
    expected = math.sqrt(1.001 / 4.002 * 3.001 / 4.002)
    assert feature_likelihood("collision_indication", simulated, recorded, valid, setting) == pytest.approx(expected)
    valid[:, 2:] = False  # then no rollout collides while the record goes on
    expected = math.sqrt(0.001 / 4.002 * 4.001 / 4.002)
    assert feature_likelihood("collision_indication", simulated, recorded, valid, setting) == pytest.approx(expected)
