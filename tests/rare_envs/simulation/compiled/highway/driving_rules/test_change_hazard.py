"""The compiled hazard of lane changes against its torch twin."""

import math

import numpy as np
import pytest
import torch

from agents.learned.adjacent_lanes import look_aside
from agents.learned.lane_changes import patience_of
from rare_envs.sensors.lidar import AHEAD_BEAM
from rare_envs.sensors.perception import RATE_COLUMNS
from rare_envs.simulation.compiled.highway.driving_rules.change_hazard import (
    change_hazard,
    draw_patience,
    lose_patience,
)
from rare_envs.simulation.compiled.highway.driving_rules.lanes_beside import LaneBeside
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import OwnMotion
from tests.rare_envs.simulation.compiled.highway.driving_rules.scenes import (
    EAGER,
    N,
    beams_of,
    draw_features,
    own_motions,
    single_settings,
)

FREE = LaneBeside(*map(np.float32, (np.inf, 0.0, np.inf, 0.0)), True)
SETTINGS = single_settings(EAGER)
ALONG = OwnMotion(*map(np.float32, (1.8, 1.8, 0.0, 10.0, 0.0)))
"""In the middle of a lane of 3.6 m, at the usual speed."""


def test_hazards_of_both_sides():
    features = draw_features(np.random.default_rng(3))
    lanes, owns = look_aside(features), own_motions(features)
    expected = torch.exp(EAGER.covariates(features, lanes) @ torch.tensor(EAGER.coefficients))
    approach = -features[:, RATE_COLUMNS][:, AHEAD_BEAM].numpy()
    found = [
        [
            change_hazard(
                LaneBeside(*(each[i, side].numpy()[()] for each in lanes)),
                np.float32(side),
                approach[i],
                owns[i].speed,
                SETTINGS,
            )
            for side in (0, 1)
        ]
        for i in range(N)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("draw", [-40.0, -6.0, -1.0, 0.0, 0.5, 3.0, 6.0])
def test_patience_of_a_draw(draw):
    expected = patience_of(torch.tensor(draw, dtype=torch.float64)).item()
    found = draw_patience(np.float32(draw))
    assert found == pytest.approx(expected, rel=1e-6) if draw > -38.0 else found > 700.0


def lose(side=0, lane=FREE, own=ALONG, changes_to=0.0, unseen=0.0):
    """The patience that is left of 0.1 after a tick, and whether it is used up."""
    mind = np.zeros(10, np.float32)
    mind[:2], mind[2:4], mind[4] = 0.1, unseen, changes_to
    beams = beams_of(torch.zeros(N, 51))
    ripe = lose_patience(mind, side, lane, beams, 0, own, SETTINGS)
    assert mind[1 - side] == np.float32(0.1)
    return mind[side], ripe


@pytest.mark.parametrize("side", [0, 1])
def test_a_tick_of_hazard(side):
    left, ripe = lose(side)
    assert not ripe and left == pytest.approx(0.1 - 0.1 * math.exp(-1.5 - 0.3 * side), rel=1e-5)


@pytest.mark.parametrize(
    "hindrance",
    [
        {"unseen": 11.0},
        {"changes_to": 1.0},
        {"own": ALONG._replace(speed=np.float32(2.0))},
        {"lane": FREE._replace(lead_gap=np.float32(1.0))},
        {"lane": FREE._replace(lag_gap=np.float32(5.0), lag_closing=np.float32(4.0))},
    ],
)
def test_without_a_lane_a_gap_or_speed_patience_lasts(hindrance):
    assert lose(**hindrance) == (np.float32(0.1), False)
