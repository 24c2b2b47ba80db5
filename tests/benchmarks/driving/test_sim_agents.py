"""Features of motion and the realism score by hand, and distances against those of the simulator's bodies."""

import math

import pytest
import torch

from benchmarks.driving.sim_agents import (
    FAR,
    FEATURE_NAMES,
    MAX_TIME_TO_COLLISION,
    WOSAC_2024,
    FeatureSetting,
    box_distance_of_sizes,
    feature_likelihood,
    histogram_log_likelihood,
    kinematic_features,
    motion_features,
)
from rare_envs.traffic.bodies import axes_of, box_distance

EDGES = (-1.75, 5.25)
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
    return motion_features(states, valid, sizes, EDGES, **kwargs)


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


def test_a_heading_that_passes_pi_does_not_jump():
    heading = torch.remainder(3.1 + 0.5 * CLOCK + math.pi, 2 * math.pi) - math.pi
    _, _, turn, _ = kinematic_features(torch.stack((CLOCK, CLOCK, heading), dim=-1))
    torch.testing.assert_close(turn[1:-1], torch.full((T - 2,), 0.5, dtype=torch.float64))


def test_behind_a_slower_one():
    found = features(agent(speed=20.0), agent(x=30.0, speed=15.0))
    gap = 26.0 - 5.0 * CLOCK  # bumper to bumper
    torch.testing.assert_close(found["distance_to_nearest_object"][0], gap)
    torch.testing.assert_close(found["time_to_collision"][0, 1:-1], (gap / 5.0).clamp(max=MAX_TIME_TO_COLLISION)[1:-1])
    assert found["time_to_collision"][1, 1:-1].eq(MAX_TIME_TO_COLLISION).all()  # the one in front follows nobody
    assert not found["collision_indication"].any()


def test_who_is_followed():
    """Only one ahead, across by less than both half widths, and by more than 0.5 m or nearly parallel."""
    slow = {"x": 12.0, "speed": 15.0}
    time = [
        features(agent(speed=20.0), agent(y=y, heading=turn, **slow))["time_to_collision"][0, 1].item() < 5.0
        for y, turn in ((0.0, 0.0), (1.4, 0.0), (1.9, 0.0), (2.1, 0.0), (1.9, 0.1), (2.2, 0.2), (0.5, 0.2))
    ]
    assert time == [True, True, True, False, True, False, True]


def test_bodies_that_overlap_collide_by_their_depth():
    found = features(agent(), agent(x=3.0, y=1.5))
    torch.testing.assert_close(found["distance_to_nearest_object"], torch.full((2, T), -0.5, dtype=torch.float64))
    assert found["collision_indication"].eq(1).all()


def test_the_outermost_corner_leaves_the_road_first():
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


def test_only_the_scored_are_returned_and_rollouts_are_leading_axes():
    states = torch.stack((agent(speed=20.0), agent(x=30.0, speed=15.0)))
    both = torch.stack((states, states + 1.0))
    valid, sizes = torch.ones(2, T, dtype=torch.bool), torch.full((2, 2), 2.0, dtype=torch.float64)
    found = motion_features(both, valid, sizes, EDGES, scored=torch.tensor([False, True]))
    assert set(found) == set(FEATURE_NAMES)
    alone = motion_features(states, valid, sizes, EDGES)
    for name, values in found.items():
        assert values.shape == (2, 1, T)
        torch.testing.assert_close(values[0, 0], alone[name][1], equal_nan=True)


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


def test_a_distance_does_not_depend_on_who_is_first():
    long, short = (torch.tensor(16.0), torch.tensor(2.6)), (torch.tensor(4.0), torch.tensor(1.8))
    at, turn = torch.tensor([9.0, 30.0]), torch.tensor([0.7, 0.7])
    there = box_distance_of_sizes(at, at / 2, turn, long, short)
    cos, sin = torch.cos(turn), torch.sin(turn)
    back = box_distance_of_sizes(-at * cos - at / 2 * sin, -at / 2 * cos + at * sin, -turn, short, long)
    torch.testing.assert_close(there, back)


def test_a_histogram_of_two_bins():
    """Agent 0: 3 of 4 values in the first bin, (3 + .5) / (4 + 1); agent 1: none of 4, and one beyond the last edge."""
    simulated = torch.tensor([[[0.1, 0.9], [1.1, 9.0]], [[0.2, 1.5], [1.9, 1.0]]])
    recorded = torch.tensor([[0.5, 1.5], [-3.0, 1.2]])
    found = histogram_log_likelihood(simulated, recorded, torch.ones(2, 2, dtype=torch.bool), HALVES).exp()
    torch.testing.assert_close(found, torch.tensor([[3.5 / 5, 1.5 / 5], [0.5 / 5, 4.5 / 5]], dtype=torch.float64))


def test_the_likelihood_is_the_geometric_mean_over_agents_and_steps():
    simulated = torch.tensor([[[0.1, 0.9], [1.1, 9.0]], [[0.2, 1.5], [1.9, 1.0]]])
    recorded, valid = torch.tensor([[0.5, 1.5], [0.5, 1.2]]), torch.ones(2, 2, dtype=torch.bool)
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
