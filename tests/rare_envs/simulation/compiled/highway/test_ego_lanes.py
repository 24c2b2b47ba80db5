"""Compiled egos among learned drivers against the drivers that they are read from."""

import numpy as np
import torch

import agents
import rare_envs
from rare_envs.control import IDM
from rare_envs.simulation.compiled.highway import ego_lanes, read_dense_driver
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers
from rare_envs.simulation.compiled.highway.row_measures import measure_rows
from rare_envs.simulation.compiled.highway.traffic_slots import Found, Rules, Slots, TrafficRows, place_row
from rare_envs.traffic.road import i80

ROAD = CurvedRoadNumbers.of(i80())


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
    measure_rows(
        rows, slots, np.zeros((20, 384), np.float32), ROAD, Rules(0, False, 0, np.inf, np.float32(0.1), 9), found
    )
    beams = np.zeros((20, 384), np.float32)
    decided = [ego_lanes.decide_ego(rows, slots, slot, beams, ego, ROAD, None) for slot in range(10)]
    assert ego.kind == ego_lanes.BY_RULE and np.allclose(decided, expected, atol=1e-5)


def test_a_learned_ego_adds_the_curvature_of_the_road():
    dense = read_dense_driver(agents.load_ego("imitation"))
    ego = ego_lanes.EgoNumbers.of(dense, dense)
    ego.buffers.outputs[:] = 0.0
    beams = np.zeros((20, 384), np.float32)
    own = [np.float32(each) for each in (5.0, 0.0, 20.0)]  # y, heading and speed
    straight, turning = (
        ego_lanes.steer_as_learned(ego, 0, beams, *own, np.float32(k), ROAD, None) for k in (0.0, 1e-3)
    )
    assert ego.kind == ego_lanes.BY_DRIVER and straight[0] == turning[0]
    assert np.isclose(straight[0], np.clip(dense.action_mean[0], dense.low[0], dense.high[0]))
    slip = [np.arctan(np.tan(steering) / 2.0) for _, steering in (straight, turning)]
    yaw_rates = [20.0 * np.sin(each) / 2.5 for each in slip]
    assert np.isclose(yaw_rates[1] - yaw_rates[0], 20.0 * 1e-3, rtol=1e-3)
