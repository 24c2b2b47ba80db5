"""Compiled measures of a moment against those of the torch simulation."""

import numpy as np
import torch

from rare_envs.measures import Moment
from rare_envs.measures.time_to_collision import lidar_ttc, lidar_ttc_terms, ttc_terms
from rare_envs.measures.two_dimensional import clearance_terms, pair_clearance_terms
from rare_envs.sensors.perception import find_vehicles_met, perceive_traffic
from rare_envs.simulation.compiled.highway import moment_terms
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers, lane_middle
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_FIELDS, LOOKING
from rare_envs.traffic.lead import lead_of
from rare_envs.traffic.road import i80
from rare_envs.traffic.state import State

N, ROAD, NUMBERS = 300, i80(), CurvedRoadNumbers.of(i80())


def moment() -> Moment:
    """Six vehicles near each other, some of them overlapping, some level."""
    rng = np.random.default_rng(9)
    ranges = ((100, 140), (-1, 19), (-0.3, 0.3), (0, 25))
    x, y, heading, speed = (torch.from_numpy(rng.uniform(low, high, (N, 6))).float() for low, high in ranges)
    x[:20, 2] = x[:20, 1]
    state = State(x, y, heading, speed, theta=x[:, :0])
    return Moment(state, lead_of(state, ROAD), ROAD, perceive_traffic(state, ROAD))


def test_distances_to_the_other_vehicles():
    given = moment()
    place = [field.numpy() for field in ROAD.to_world(*given.state[:3])]
    expected, found = clearance_terms(given).numpy(), np.zeros((N, 5), np.float32)
    for row in range(N):
        moment_terms.clearances(*(field[row] for field in place), np.full(5, np.inf, np.float32), found[row])
    assert np.allclose(found, expected, atol=5e-5)
    assert (expected == np.float32(0.01)).any() and (expected > 5.0).any()


def test_distances_of_all_pairs():
    given = moment()
    place = [field.numpy() for field in ROAD.to_world(*given.state[:3])]
    expected, found = pair_clearance_terms(given).numpy(), np.zeros((N, 15), np.float32)
    for row in range(N):
        moment_terms.clearances(*(field[row] for field in place), np.full(15, np.inf, np.float32), found[row])
    assert np.allclose(found, expected, atol=5e-5)


def test_distances_that_need_not_be_exact_are_still_too_great():
    given = moment()
    place = [field.numpy() for field in ROAD.to_world(*given.state[:3])]
    expected, found, enough = clearance_terms(given).numpy(), np.zeros(5, np.float32), np.full(5, 3.0, np.float32)
    for row in range(N):
        moment_terms.clearances(*(field[row] for field in place), enough, found)
        near = expected[row] < 3.0
        assert np.allclose(found[near], expected[row][near], atol=5e-5) and (found[~near] > 3.0 - 5e-5).all()


def test_times_along_the_beams_by_vehicle_and_side():
    given = moment()
    ego = given.perception[:, 0].numpy()
    met = find_vehicles_met(given.state, ROAD).numpy()
    beams, found = np.zeros((20, BEAM_FIELDS, LOOKING), np.float32), np.zeros((N, 10), np.float32)
    least = []
    for row in range(N):
        beams[:, :, 0] = np.stack((ego[row, 11:31], ego[row, 31:], np.maximum(met[row] - 1, -1)), 1)
        least.append(moment_terms.lidar_times(beams.reshape(20, -1), 0, found[row]))
    assert np.allclose(found, lidar_ttc_terms(given).numpy(), rtol=1e-6)
    assert np.allclose(least, lidar_ttc(given).numpy(), rtol=1e-6)


def test_times_to_the_lead_and_to_the_edge():
    given = moment()
    fields, found = [field.numpy() for field in given.state[:4]], np.zeros((N, 6), np.float32)
    for row in range(N):
        lane = lane_middle(fields[1][row, 0], NUMBERS)
        moment_terms.time_terms(*(field[row] for field in fields), lane, NUMBERS, found[row])
    assert np.allclose(found, ttc_terms(given).numpy(), rtol=1e-4)
    assert (found[:, :5] < 10.0).any()
