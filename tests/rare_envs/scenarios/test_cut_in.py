"""The cut-in: its path, and a cutter that minds its lead."""

from itertools import pairwise

import pytest
import torch

from rare_envs.scenarios.cut_in import CUT_IN, bezier
from rare_envs.simulation.world import World
from tests.rare_envs.traffic_states import F64, tensor


def test_bezier_is_de_casteljau_and_level_at_both_ends() -> None:
    length, offset = 60.0, 3.5
    control = [(0.0, offset), (length / 3, offset), (2 * length / 3, 0.0), (length, 0.0)]
    for t in (0.0, 0.2, 0.5, 0.9, 1.0):
        points = control
        while len(points) > 1:
            points = [((1 - t) * a[0] + t * b[0], (1 - t) * a[1] + t * b[1]) for a, b in pairwise(points)]
        y, slope = bezier(tensor(t * length), tensor(length), tensor(offset))
        assert y.item() == pytest.approx(points[0][1], abs=1e-14)
        eps = 1e-6
        if 0.0 < t < 1.0:
            ahead, behind = (bezier(tensor(t * length + e), tensor(length), tensor(offset))[0] for e in (eps, -eps))
            assert slope.item() == pytest.approx((ahead - behind).item() / (2 * eps), abs=1e-8)
        else:
            assert slope.item() == 0.0


def test_cutter_arrives_in_the_lane_and_minds_its_lead() -> None:
    world = World(CUT_IN)
    episode = world.start(tensor(10.0, 20.0, 12.0, 40.0, 25.0, 3.5)[None])
    for _ in range(world.clock.ticks):
        episode = world.step(episode, torch.zeros(1, 2, dtype=F64))
    state = episode.state
    assert state.y[0, 1].item() == 0.0
    assert state.heading[0, 1].item() == 0.0
    assert state.x[0, 2] - state.x[0, 1] > 5.0  # 8 m/s faster than the lead at first, and still behind it
    assert state.speed[0, 2].item() == 12.0
