import math
from dataclasses import replace

import pytest
import torch

from agents import load_driver, read_driver, read_provenance, save_driver
from agents.learned.collision_avoidance import CollisionAvoidance
from agents.learned.networks import head_weights
from rare_envs.sensors.lidar import MAX_RANGE
from rare_envs.sensors.perception import FEATURES

RULE = CollisionAvoidance()
HALF_LENGTH, HALF_WIDTH = 2.5, 1.0


def seen(speed=20.0, **beams):
    """Return features (1, 1, 51) in double precision of a car of 5 m by 2 m whose beams meet nothing but these."""
    values = dict.fromkeys(FEATURES, 0.0) | {"speed": speed, "length": 2 * HALF_LENGTH, "width": 2 * HALF_WIDTH}
    values |= {name: MAX_RANGE for name in FEATURES if name.startswith("range_")}
    values |= {name.replace("m", "-"): value for name, value in beams.items()}
    return torch.tensor([[[values[name] for name in FEATURES]]], dtype=torch.float64)


def limited(features, acceleration=1.0, yaw_rate=0.0):
    action = RULE.limit(features, torch.tensor([[[acceleration, yaw_rate]]], dtype=torch.float64))
    return tuple(action[0, 0].tolist())


def test_free_traffic_is_left_alone():
    assert limited(seen(), 1.5, 0.02) == (1.5, 0.02)
    assert limited(seen(range_0=90.0, rate_0=3.0), 1.5, -0.02) == (1.5, -0.02)


@pytest.mark.parametrize("gap", [30.0, 50.0])
def test_a_stopped_car_ahead_is_braked_for_as_hard_as_needed(gap):
    braking, _ = limited(seen(range_0=gap + HALF_LENGTH, rate_0=-20.0))
    assert braking == pytest.approx(-(20.0**2) / (2.0 * (gap - RULE.least_gap)))


def test_less_urgent_braking_is_comfortable():
    braking, _ = limited(seen(range_0=40.0 + HALF_LENGTH, rate_0=-10.0))  # 1.27 m/s^2 would do
    assert braking == -RULE.deceleration


def test_at_equal_speeds_the_gap_of_the_reaction_time_is_kept():
    gap = RULE.standstill_gap + 20.0 * RULE.reaction_time
    assert limited(seen(range_0=gap + HALF_LENGTH), 1.0)[0] == pytest.approx(0.0, abs=1e-12)
    assert limited(seen(range_0=gap + 4.0 + HALF_LENGTH), 1.0)[0] > 0.0
    assert limited(seen(range_0=gap - 4.0 + HALF_LENGTH), 1.0)[0] < 0.0


def test_the_network_may_brake_harder_than_the_rule():
    assert limited(seen(range_0=50.0 + HALF_LENGTH, rate_0=-20.0), -6.0)[0] == -6.0


def test_braking_by_the_rule_stops_before_a_standing_car():
    gap, speed = 60.0, 20.0
    for _ in range(400):
        acceleration, _ = limited(seen(speed, range_0=gap + HALF_LENGTH, rate_0=-speed))
        gap, speed = gap - 0.1 * speed, max(speed + 0.1 * acceleration, 0.0)
    assert speed < 0.1
    assert 0.0 < gap < 3.0


def test_a_car_beside_is_not_steered_into():
    across, closing = 1.6, 0.4
    features = seen(range_90=HALF_WIDTH + across, rate_90=-closing)
    expected = ((across - RULE.clearance) / RULE.lateral_time - closing) / (RULE.heading_time * 20.0)
    assert limited(features, 1.0, 1.0) == (1.0, pytest.approx(expected))
    assert limited(features, 1.0, -0.1) == (1.0, -0.1), "away from it is free"
    mirrored = seen(**{"range_m90": HALF_WIDTH + across, "rate_m90": -closing})
    assert limited(mirrored, 1.0, -1.0) == (1.0, pytest.approx(-expected))


def test_a_car_that_is_too_near_is_not_steered_towards_and_nobody_is_pushed_away():
    features = seen(range_90=HALF_WIDTH + 0.1)
    assert limited(features, 1.0, 0.2)[1] == 0.0
    assert limited(features, 1.0, -0.01)[1] == -0.01


def test_a_car_turns_no_narrower_than_it_can():
    assert limited(seen(speed=3.2), 1.0, 0.9)[1] == pytest.approx(3.2 / 6.4)
    assert limited(seen(speed=0.0), 1.0, 0.3)[1] == 0.0


def test_gradients_are_those_of_finite_differences():
    features = torch.cat(
        [
            seen(range_0=30.0, rate_0=-15.0),
            seen(range_0=15.0, rate_0=-1.0, range_90=2.3, rate_90=-0.2, range_m90=1.8, rate_m90=0.1),
            seen(),
        ]
    ).requires_grad_()
    action = torch.tensor([[[1.0, 0.6]], [[0.5, 0.5]], [[0.3, -0.01]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(RULE.limit, (features, action))


def test_the_shipped_driver_is_mgail_with_the_rule():
    plain, ruled = load_driver("mgail"), load_driver("mgail2")
    assert torch.equal(head_weights(plain.policy), head_weights(ruled.policy))
    assert ruled.avoidance == RULE
    features = seen(range_0=30.0 + HALF_LENGTH, rate_0=-20.0).float()
    one, other = (replace(driver, avoidance=None).act(features)[0] for driver in (plain, ruled))
    assert torch.equal(one, other)
    assert float(ruled.act(features)[0][0, 0, 0]) == pytest.approx(-400.0 / 59.0)
    assert float(one[0, 0, 0]) > -400.0 / 59.0


def test_the_rule_is_read_from_the_file(tmp_path):
    rule = CollisionAvoidance(reaction_time=0.9)
    origin = read_provenance("agents/data/mgail.safetensors")
    path = save_driver(replace(load_driver("mgail"), avoidance=rule), origin, tmp_path / "mine.safetensors")
    assert read_driver(path).avoidance == rule


def test_compiled_rollouts_take_the_rule_unless_it_was_changed():
    class Other(CollisionAvoidance):
        """Bounds of its own."""

    dense = load_driver("mgail2").dense_driver()
    assert dense is not None and dense.avoidance is not None and dense.avoidance.deceleration == 2.0
    assert replace(load_driver("mgail2"), avoidance=Other()).dense_driver() is None


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, True, "2"])
def test_settings_are_positive_numbers(value):
    with pytest.raises(ValueError, match="Expected deceleration of the collision avoidance above 0"):
        CollisionAvoidance(deceleration=value)
