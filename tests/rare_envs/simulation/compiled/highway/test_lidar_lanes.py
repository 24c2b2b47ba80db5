"""Compiled lidar against the lidar of the torch simulation."""

import numpy as np
import torch

from rare_envs.sensors.lidar import Bodies, find_met, sense
from rare_envs.simulation.compiled.highway.lidar_lanes import (
    BEAM_FIELDS,
    BODY_FIELDS,
    LOOKING,
    measure_beams,
    place_body,
)

BATCH, VEHICLES = LOOKING, 6


def scene() -> Bodies:
    """Vehicles within 60 m of each other, some of them overlapping."""
    rng = np.random.default_rng(8)
    ranges = ((0, 120), (0, 20), (-0.5, 0.5), (0, 30))
    fields = (torch.from_numpy(rng.uniform(low, high, (BATCH, VEHICLES))).float() for low, high in ranges)
    return Bodies(*fields, torch.tensor(5.0), torch.tensor(2.0))


def measured(bodies: Bodies, observer: int):
    """Ranges, rates and numbers of the vehicles met, shape (3, BATCH, 20)."""
    x, y, heading, speed = (field.numpy() for field in bodies[:4])
    cos, sin = np.cos(heading), np.sin(heading)
    seen = np.zeros((VEHICLES - 1, BODY_FIELDS * LOOKING), np.float32)
    others = [vehicle for vehicle in range(VEHICLES) if vehicle != observer]
    for row in range(BATCH):
        for body, other in enumerate(others):
            place_body(
                seen[body],
                row,
                x[row, other] - x[row, observer],
                y[row, other] - y[row, observer],
                cos[row, observer],
                sin[row, observer],
                cos[row, other],
                sin[row, other],
                speed[row, other] * cos[row, other] - speed[row, observer] * cos[row, observer],
                speed[row, other] * sin[row, other] - speed[row, observer] * sin[row, observer],
            )
    beams = np.zeros((20, BEAM_FIELDS * LOOKING), np.float32)
    measure_beams(seen, beams)
    ranges, rates, met = beams.reshape(20, BEAM_FIELDS, LOOKING).transpose(1, 2, 0)
    return ranges, rates, np.where(met < 0, -1, np.array([*others, -1])[met.astype(int)])


def test_ranges_rates_and_who_is_met():
    bodies = scene()
    readings, met = sense(bodies), find_met(bodies, VEHICLES)
    for observer in range(VEHICLES):
        ranges, rates, vehicles = measured(bodies, observer)
        same = vehicles == met[:, observer].numpy()
        assert same.mean() > 0.999  # a beam along a corner may meet it or not
        assert 0.05 < (vehicles >= 0).mean() < 0.95
        assert np.allclose(ranges[same], readings.range[:, observer].numpy()[same], rtol=1e-3, atol=2e-4)
        assert np.abs(ranges[same] - readings.range[:, observer].numpy()[same]).mean() < 1e-5
        assert np.allclose(rates[same], readings.rate[:, observer].numpy()[same], atol=1e-4)


def test_a_car_straight_ahead():
    x = torch.zeros(BATCH, VEHICLES)
    x[:, 1], x[:, 2:] = 30.0, 1000.0
    speed = torch.full((BATCH, VEHICLES), 20.0)
    speed[:, 1] = 10.0
    ranges, rates, met = measured(Bodies(x, 0 * x, 0 * x, speed, torch.tensor(5.0), torch.tensor(2.0)), 0)
    assert np.allclose(ranges[:, 9], 27.5) and np.allclose(rates[:, 9], -10.0)
    assert (np.delete(ranges, 9, 1) == 100.0).all() and (np.delete(met, 9, 1) == -1).all()
