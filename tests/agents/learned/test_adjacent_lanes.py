import math

import pytest
import torch

from agents.learned.rules import LEFT_MARKER_COLUMN, RIGHT_MARKER_COLUMN, AdjacentLanes
from rare_envs.sensors.lidar import HEADING_COLUMN, LANE_OFFSET_COLUMN, Bodies, OnRoad, perceive
from tests.agents.learned.test_collision_avoidance import seen

WIDTH = 3.6


def perceived(x, y, speed, heading=None):
    """Return the features (51,) of the first of some cars of 5 m by 2 m; its lane's middle is at y = 0."""
    x, y, speed = (torch.tensor([values], dtype=torch.float64) for values in (x, y, speed))
    heading = 0.0 * x if heading is None else torch.tensor([heading], dtype=torch.float64)
    sizes = (torch.tensor(5.0), torch.tensor(2.0))
    place = OnRoad(y, heading, 0.0 * y, 0.5 * WIDTH + y, 0.5 * WIDTH - y)
    return perceive(Bodies(x, y, heading, speed, *sizes), place, 1)[0, 0]


def test_gaps_and_closing_speeds_in_the_next_lanes():
    # to the right one 12 m ahead that is 2 m/s slower, to the left one 9 m behind that is 3 m/s faster
    lanes = AdjacentLanes.read(perceived([0.0, 12.0, -9.0], [0.0, WIDTH, -WIDTH - 0.2], [20.0, 18.0, 23.0]))
    assert lanes.lead_gap[0] == lanes.lag_gap[1] == math.inf
    assert float(lanes.lead_gap[1]) == pytest.approx(7.0, abs=1e-5)
    assert float(lanes.lead_closing[1]) == pytest.approx(2.0, abs=1e-6)
    assert float(lanes.lag_gap[0]) == pytest.approx(4.0, abs=1e-5)
    assert float(lanes.lag_closing[0]) == pytest.approx(3.0, abs=1e-6)
    assert lanes.beyond.tolist() == [True, True]


def test_who_is_beside_leaves_no_gap():
    lanes = AdjacentLanes.read(perceived([0.0, 1.0], [0.0, WIDTH], [20.0, 20.0]))
    assert float(lanes.lead_gap[1]) < 0.0
    assert float(lanes.lag_gap[1]) < 0.0


def test_the_own_lane_and_lanes_further_off_do_not_count_but_show_that_there_is_a_lane():
    lanes = AdjacentLanes.read(perceived([0.0, 20.0, 3.0], [0.0, 0.0, 2 * WIDTH], [20.0, 20.0, 20.0]))
    assert torch.isinf(lanes.lead_gap).all() and torch.isinf(lanes.lag_gap).all()
    assert (lanes.lead_closing == 0.0).all() and (lanes.lag_closing == 0.0).all()
    assert lanes.beyond.tolist() == [False, True]


def test_beams_are_turned_with_the_vehicle():
    """A car 20 m straight ahead is in the own lane, also for one whose beams point 18 degrees to its left."""
    features = perceived([0.0, 20.0], [0.0, 0.0], [20.0, 20.0], [-math.radians(18.0), 0.0])
    assert torch.isinf(AdjacentLanes.read(features).lead_gap).all()


def test_gradients_are_those_of_finite_differences():
    features = seen(range_18=9.0, rate_18=-1.0, range_m144=7.0, rate_m144=-2.0, range_90=8.0)
    features[..., LEFT_MARKER_COLUMN], features[..., RIGHT_MARKER_COLUMN], features[..., LANE_OFFSET_COLUMN] = (
        1.9,
        1.7,
        0.1,
    )
    features[..., HEADING_COLUMN] = 0.02

    def finite(values):
        lanes = AdjacentLanes.read(values)
        return [torch.where(torch.isinf(each), 0.0, each) for each in lanes[:4]]

    assert torch.autograd.gradcheck(finite, features.requires_grad_())
