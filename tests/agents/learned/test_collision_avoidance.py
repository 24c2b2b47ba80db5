"""Collision avoidance and what is seen of the lanes beside, on paper."""

import math

import pytest
import torch

from agents.learned.rules import LEFT_MARKER_COLUMN, RIGHT_MARKER_COLUMN, AdjacentLanes, CollisionAvoidance, Seen
from rare_envs.sensors.lidar import FEATURES, HEADING_COLUMN, MAX_RANGE, Bodies, OnRoad, perceive

RULE = CollisionAvoidance()
HALF_LENGTH, HALF_WIDTH = 2.5, 1.0


def seen(speed=20.0, **beams):
    """Return features (1, 1, 51) in double precision of a car of 5 m by 2 m whose beams meet nothing but these."""
    values = dict.fromkeys(FEATURES, 0.0) | {"speed": speed, "length": 2 * HALF_LENGTH, "width": 2 * HALF_WIDTH}
    values |= {name: MAX_RANGE for name in FEATURES if name.startswith("range_")}
    values |= {name.replace("m", "-"): value for name, value in beams.items()}
    return torch.tensor([[[values[name] for name in FEATURES]]], dtype=torch.float64)


def limited(features, acceleration=1.0, yaw_rate=0.0):
    action = RULE.limit(Seen.read(features), torch.tensor([[[acceleration, yaw_rate]]], dtype=torch.float64))
    return tuple(action[0, 0].tolist())


def test_free_traffic_is_left_alone():
    assert limited(seen(), 1.5, 0.02) == (1.5, 0.02)
    assert limited(seen(range_0=90.0, rate_0=3.0), 1.5, -0.02) == (1.5, -0.02)
    beside = on_lane(seen(range_90=3.6, range_m90=3.6), 0.01)
    assert limited(beside, 1.5, -0.02) == (1.5, -0.02)


def test_a_stopped_car_ahead_is_braked_for_as_hard_as_needed():
    gap = 40.0
    braking, _ = limited(seen(range_0=gap + HALF_LENGTH, rate_0=-20.0))
    assert braking == pytest.approx(-(20.0**2) / (2.0 * (gap - RULE.least_gap)))
    assert limited(seen(range_0=gap + HALF_LENGTH, rate_0=-20.0), -9.0)[0] == -9.0  # the network may brake harder
    less_urgent = seen(range_0=gap + 10.0 + HALF_LENGTH, rate_0=-10.0)
    assert limited(less_urgent)[0] == -RULE.deceleration


def test_at_equal_speeds_the_gap_of_the_reaction_time_is_kept():
    gap = RULE.standstill_gap + 20.0 * RULE.reaction_time
    assert limited(seen(range_0=gap + HALF_LENGTH), 1.0)[0] == pytest.approx(0.0, abs=1e-12)
    assert limited(seen(range_0=gap + 4.0 + HALF_LENGTH), 1.0)[0] > 0.0
    assert limited(seen(range_0=gap - 4.0 + HALF_LENGTH), 1.0)[0] < 0.0


def test_a_car_beside_is_not_steered_into():
    across, closing = 1.6, 0.4
    features = seen(range_90=HALF_WIDTH + across, rate_90=-closing)
    expected = ((across - RULE.clearance) / RULE.lateral_time - closing) / (RULE.heading_time * 20.0)
    assert limited(features, 1.0, 1.0) == (1.0, pytest.approx(expected))
    assert limited(features, 1.0, -0.1) == (1.0, -0.1), "away from it is free"
    mirrored = seen(**{"range_m90": HALF_WIDTH + across, "rate_m90": -closing})
    assert limited(mirrored, 1.0, -1.0) == (1.0, pytest.approx(-expected))
    near = seen(range_90=HALF_WIDTH + 0.1)  # too near: not steered towards, and nobody is pushed away
    assert (limited(near, 1.0, 0.2)[1], limited(near, 1.0, -0.01)[1]) == (0.0, -0.01)
    assert limited(seen(speed=3.2), 1.0, 0.9)[1] == pytest.approx(3.2 / 6.4)  # it turns no narrower than it can
    assert limited(seen(speed=0.0), 1.0, 0.3)[1] == 0.0


def on_lane(features, heading=0.0, left=1.8, right=1.8):
    """Return features of a car with a heading, between two markers."""
    features[..., HEADING_COLUMN] = heading
    features[..., LEFT_MARKER_COLUMN], features[..., RIGHT_MARKER_COLUMN] = left, right
    return features


def test_at_close_range_who_moves_towards_a_body_is_steered_back_but_not_past_the_road():
    for sign, beam in ((1.0, "90"), (-1.0, "m90")):
        near = {f"range_{beam}": HALF_WIDTH + 0.1, f"rate_{beam}": -0.4}
        heading = sign * 0.4 / 20.0
        back = limited(on_lane(seen(**near), heading), yaw_rate=sign * 0.2)[1]
        assert back == pytest.approx(-math.sin(heading) / RULE.heading_time)  # as much as goes along the road
        away = limited(on_lane(seen(**near), -heading), yaw_rate=sign * 0.2)[1]
        assert away == 0.0  # the other comes nearer, and it goes away from it already
        assert limited(on_lane(seen(**near), heading), yaw_rate=-sign * 0.3)[1] == -sign * 0.3


def test_queues_that_brake_comfortably_are_followed_without_contact():
    """The one ahead brakes by 2 m/s^2 to a stop; the one behind is near and 0.6 m/s faster."""
    gap, speed, ahead = 0.5, 8.6, 8.0
    for _ in range(60):
        acceleration, _ = limited(on_lane(seen(speed, range_0=gap + HALF_LENGTH, rate_0=ahead - speed)))
        gap += 0.1 * (ahead - speed)
        speed, ahead = max(speed + 0.1 * acceleration, 0.0), max(ahead - 0.2, 0.0)
        assert gap > 0.0


@pytest.mark.parametrize("side", [0, 1])
def test_within_some_room_steering_is_bounded_by_the_way_that_is_left_and_leads_back_from_beyond(side):
    """At 20 m/s and 0.6 m/s towards a line, or away from it: (d / 0.6 s - v) / (0.2 s 20 m/s)."""
    towards = -1.0 if side == 0 else 1.0
    for across, distance in ((0.6, 0.9), (0.6, -0.3), (-0.6, 0.0)):
        features = seen(speed=20.0)
        features[..., HEADING_COLUMN] = towards * math.asin(across / 20.0)
        room = torch.full((1, 1, 2), MAX_RANGE, dtype=torch.float64)
        room[..., side] = distance
        bounds = RULE.bound_yaw_rates_within(Seen.read(features), room)
        assert bounds[side].item() == pytest.approx((distance / 0.6 - across) / (0.2 * 20.0))
        assert bounds[1 - side].item() > 40.0  # no bound
    assert RULE.bound_yaw_rates_within(Seen.read(seen(speed=0.0)), torch.zeros(1, 1, 2))[0].item() == 0.0


# --- the lanes beside ----------------------------------------------------------------------------


WIDTH = 3.6


def perceived(x, y, speed, heading=None):
    """Return what is seen by the first of some cars of 5 m by 2 m; its lane's middle is at y = 0."""
    x, y, speed = (torch.tensor([values], dtype=torch.float64) for values in (x, y, speed))
    heading = 0.0 * x if heading is None else torch.tensor([heading], dtype=torch.float64)
    sizes = (torch.tensor(5.0), torch.tensor(2.0))
    place = OnRoad(y, heading, 0.0 * y, 0.5 * WIDTH + y, 0.5 * WIDTH - y)
    return Seen.read(perceive(Bodies(x, y, heading, speed, *sizes), place, 1)[0, 0])


def test_gaps_and_closing_speeds_in_the_next_lanes():
    # to the right one 12 m ahead that is 2 m/s slower, to the left one 9 m behind that is 3 m/s faster
    lanes = AdjacentLanes.read(perceived([0.0, 12.0, -9.0], [0.0, WIDTH, -WIDTH - 0.2], [20.0, 18.0, 23.0]))
    assert lanes.lead_gap[0] == lanes.lag_gap[1] == math.inf
    assert float(lanes.lead_gap[1]) == pytest.approx(7.0, abs=1e-5)
    assert float(lanes.lead_closing[1]) == pytest.approx(2.0, abs=1e-6)
    assert float(lanes.lag_gap[0]) == pytest.approx(4.0, abs=1e-5)
    assert float(lanes.lag_closing[0]) == pytest.approx(3.0, abs=1e-6)
    assert lanes.beyond.tolist() == [True, True]


def test_the_own_lane_and_lanes_further_off_do_not_count_but_show_that_there_is_a_lane():
    lanes = AdjacentLanes.read(perceived([0.0, 20.0, 3.0], [0.0, 0.0, 2 * WIDTH], [20.0, 20.0, 20.0]))
    assert torch.isinf(lanes.lead_gap).all() and torch.isinf(lanes.lag_gap).all()
    assert (lanes.lead_closing == 0.0).all() and (lanes.lag_closing == 0.0).all()
    assert lanes.beyond.tolist() == [False, True]
