"""Situations have roads with a lane for the ego."""

import numpy as np
import pytest
import torch

from training.egos.curriculum import draw_road


def test_roads_have_lanes_of_which_one_is_the_egos() -> None:
    rng = np.random.default_rng(1)
    roads = [draw_road(rng) for _ in range(60)]
    assert {road.lanes for road in roads} == {1, 2, 3, 4}
    assert 10 < sum(road.reference_line is None for road in roads) < 35
    for road in roads:
        assert float(road.centre_of(torch.zeros(1))[0]) == pytest.approx(0.0, abs=1e-5)
