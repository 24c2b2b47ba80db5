"""Slots in which rows are driven side by side."""

import numpy as np
import torch

import agents
from rare_envs.simulation.compiled.highway import read_dense_driver, traffic_slots
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers
from rare_envs.simulation.compiled.highway.driver_lanes import DriverBuffers
from rare_envs.traffic.road import i80

ROAD, VEHICLES, SLOTS = CurvedRoadNumbers.of(i80()), 3, 2


def three_rows() -> traffic_slots.TrafficRows:
    """Three rows of three vehicles, whose drivers have weights of their own."""
    x = np.arange(9, dtype=np.float32).reshape(3, 3) * 20.0 + 50.0
    y, heading, speed = np.full_like(x, 5.0), np.zeros_like(x), np.full_like(x, 10.0)
    weights = np.arange(12, dtype=np.float32).reshape(3, 4)
    draws, memory = np.zeros((3, 0, 2, 2), np.float32), np.zeros((3, 2, 2, 2), np.float32)
    minds = np.zeros((3, 2, 0), np.float32)
    return traffic_slots.TrafficRows(x, y, heading, speed, weights, draws, memory, minds)


def begun():
    """Rows, slots, buffers and results after the first rows have begun."""
    rows, slots = three_rows(), traffic_slots.Slots.of(SLOTS, VEHICLES)
    buffers = DriverBuffers.of(read_dense_driver(agents.load_driver("mgail")), 128)
    found = traffic_slots.Found(*(np.zeros(shape, np.float32) for shape in (3, (3, 0))), np.zeros((3, 0), np.int64))
    assert traffic_slots.are_free(slots)
    assert traffic_slots.fill_slots(rows, 0, slots, buffers, ROAD, found) == SLOTS
    return rows, slots, buffers, found


def test_rows_begin_in_free_slots_with_their_weights_and_poses():
    rows, slots, buffers, found = begun()
    assert slots.row.tolist() == [0, 1] and not traffic_slots.are_free(slots)
    slots.row[0], slots.tick[0] = traffic_slots.NO_ROW, 7
    assert traffic_slots.fill_slots(rows, 2, slots, buffers, ROAD, found) == 3
    assert slots.row.tolist() == [2, 1] and slots.tick.tolist() == [0, 0]
    assert found.f.tolist() == [np.inf] * 3
    assert buffers.head[:4, :4].T.tolist() == rows.weights[[2, 2, 1, 1]].tolist()  # two drivers a slot
    x, _, heading = i80().to_world(*(torch.from_numpy(field[[2]]) for field in rows[:3]))
    assert np.allclose(slots.poses.x[0], x[0]) and np.allclose(slots.poses.heading[0], heading[0])
    assert np.allclose(slots.poses.cos[0], torch.cos(heading[0]))


def test_each_vehicle_sees_the_others_of_its_slot():
    rows, slots, *_ = begun()
    sight = traffic_slots.Sight.of(VEHICLES)
    traffic_slots.see_others(rows, slots, sight, False)
    along = sight.seen[:, :4]  # middles of the two bodies, as the four drivers see them [m]
    assert np.allclose(along, [[-20.0, -40.0] * 2, [20.0, -20.0] * 2], atol=0.2)
    assert not sight.ego_seen.any()
    traffic_slots.see_others(rows, slots, sight, True)
    assert np.allclose(sight.ego_seen[:, :2], [[20.0] * 2, [40.0] * 2], atol=0.2)
