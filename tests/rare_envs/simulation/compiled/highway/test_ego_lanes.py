"""Compiled egos among learned drivers against the drivers that they are read from."""

import numpy as np
import torch

import agents
import rare_envs
from rare_envs.control import IDM
from rare_envs.sensors.lidar import AHEAD_BEAM, MAX_RANGE
from rare_envs.simulation.compiled.highway import ego_lanes, read_dense_driver
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import TrafficRules
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_FIELDS, LOOKING
from rare_envs.simulation.compiled.highway.row_measures import measure_rows
from rare_envs.simulation.compiled.highway.traffic_slots import Found, Rules, Slots, TrafficRows, place_row
from rare_envs.traffic.road import i80

ROAD = CurvedRoadNumbers.of(i80())
NO_BEAMS = np.zeros((20, BEAM_FIELDS * LOOKING), np.float32)
NO_BEAMS[:, :LOOKING] = MAX_RANGE


def test_the_idm_decides_as_in_torch():
    problem = rare_envs.DrivingProblem("rare_envs/Highway-v0", noise=False, core="torch")
    x = torch.from_numpy(problem.base.sample(10, np.random.default_rng(0))).float()
    episode = problem.world.start(x)
    expected, _ = problem.driver.act(episode, None)
    dense = read_dense_driver(problem.world.background)
    ego = ego_lanes.EgoNumbers.of(IDM(), dense)
    fields = [field.numpy() for field in episode.state[:4]]
    shapes = ((10, 0), (10, 0, 5, 2), (10, 5, 2, 2), (10, 5, 0))
    rows = TrafficRows(*fields, *(np.zeros(shape, np.float32) for shape in shapes))
    slots = Slots.of(10, 6)
    slots.row[:] = np.arange(10)
    for row in range(10):
        place_row(rows, row, row, slots.poses, ROAD)
    found = Found(np.full(10, np.inf, np.float32), np.zeros((10, 0), np.float32), np.zeros((10, 0), int))
    measure_rows(rows, slots, NO_BEAMS, ROAD, Rules(0, False, 0, np.inf, np.float32(0.1), 9), found)
    decided = [ego_lanes.decide_ego(rows, slots, slot, ego, ROAD) for slot in range(10)]
    assert ego.kind == ego_lanes.BY_RULE and np.allclose(decided, expected, atol=1e-5)


def two_rows() -> tuple[TrafficRows, Slots]:
    """Egos at 20 m/s along their lanes, without others, in slots of their own."""
    fields = (np.full((2, 1), value, np.float32) for value in (100.0, 5.0, 0.0, 20.0))
    shapes = ((2, 0), (2, 0, 0, 2), (2, 0, 2, 2), (2, 0, 0))
    rows, slots = TrafficRows(*fields, *(np.zeros(shape, np.float32) for shape in shapes)), Slots.of(2, 1)
    slots.row[:] = 0, 1
    return rows, slots


def test_a_learned_ego_adds_the_curvature_of_the_road():
    dense = read_dense_driver(agents.load_ego("imitation"))
    ego, (rows, slots) = ego_lanes.EgoNumbers.of(dense, dense), two_rows()
    slots.poses.curvature[:, 0] = 0.0, 1e-3
    ego_lanes.steer_as_learned(rows, slots, NO_BEAMS, ego, ROAD, None)
    straight, turning = ego.actions[:2]
    assert ego.kind == ego_lanes.BY_DRIVER and straight[0] == turning[0]
    assert np.isclose(straight[0], np.clip(dense.action_mean[0], dense.low[0], dense.high[0]))
    slip = [np.arctan(np.tan(steering) / 2.0) for _, steering in (straight, turning)]
    yaw_rates = [20.0 * np.sin(each) / 2.5 for each in slip]
    assert np.isclose(yaw_rates[1] - yaw_rates[0], 20.0 * 1e-3, rtol=1e-3)


def test_a_learned_ego_has_its_own_rules():
    """1 m behind somebody, closing at 1 m/s: b is 2 m/s^2 without close range, and b + dv / 0.3 s with it."""
    plain, close = (read_dense_driver(agents.load_ego(name)) for name in ("mgail2", "mgail5"))
    beams = NO_BEAMS.copy()
    beams[AHEAD_BEAM, 0], beams[AHEAD_BEAM, LOOKING] = 3.5, -1.0
    found = []
    for each, drivers in ((plain, close), (close, plain)):
        ego, (rows, slots) = ego_lanes.EgoNumbers.of(each, drivers), two_rows()
        ego_lanes.steer_as_learned(rows, slots, beams, ego, ROAD, TrafficRules.of(drivers, each))
        found.append(ego.actions[0, 0])
    assert np.allclose(found, (-2.0, -2.0 - 1.0 / 0.3))
