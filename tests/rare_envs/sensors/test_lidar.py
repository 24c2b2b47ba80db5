"""Lidar against pencil and paper, against a slow implementation, and its gradient against finite differences."""

import math

import pytest
import torch

from rare_envs.sensors.lidar import AHEAD_BEAM, BEAMS, MAX_RANGE, Bodies, sense


def bodies(*rows, dtype=torch.float64):
    """One scene from rows of x, y, heading, speed, length, width."""
    return Bodies(*torch.tensor([rows], dtype=dtype).unbind(dim=2))


def drawn(scenes, vehicles, seed, dtype=torch.float64):
    """Vehicles on six lanes, none so near another that its middle is inside."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high):
        return low + (high - low) * torch.rand(scenes, vehicles, generator=generator, dtype=torch.float64)

    x = torch.sort(uniform(0.0, 60.0), dim=1)[0] + 6.0 * torch.arange(vehicles)
    y = torch.floor(uniform(0.0, 6.0)) * 3.7
    fields = x, y, uniform(-0.3, 0.3), uniform(5.0, 25.0), uniform(3.5, 5.0), uniform(1.6, 2.4)
    return Bodies(*(field.to(dtype) for field in fields))


def slowly(scene, i, k):
    """Range and rate of beam k of vehicle i of the first scene, by the sides of every box."""
    x, y, heading, speed, length, width = (field[0].tolist() for field in scene)
    angle = heading[i] + math.radians(-162 + 18 * k)
    way = math.cos(angle), math.sin(angle)
    best, who = MAX_RANGE, None
    for j in range(len(x)):
        if j == i:
            continue
        cos, sin = math.cos(heading[j]), math.sin(heading[j])
        half = [(length[j] / 2 * a, width[j] / 2 * b) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        corners = [(x[j] + a * cos - b * sin, y[j] + a * sin + b * cos) for a, b in half]
        for (x1, y1), (x2, y2) in zip(corners, corners[1:] + corners[:1], strict=True):
            side = x2 - x1, y2 - y1
            denominator = way[0] * side[1] - way[1] * side[0]
            if abs(denominator) < 1e-12:
                continue
            along = ((x1 - x[i]) * side[1] - (y1 - y[i]) * side[0]) / denominator
            share = ((x1 - x[i]) * way[1] - (y1 - y[i]) * way[0]) / denominator
            if along >= 0 and 0 <= share <= 1 and along < best:
                best, who = along, j
    if who is None:
        return best, 0.0
    own = speed[i] * math.cos(heading[i]), speed[i] * math.sin(heading[i])
    other = speed[who] * math.cos(heading[who]), speed[who] * math.sin(heading[who])
    return best, (other[0] - own[0]) * way[0] + (other[1] - own[1]) * way[1]


def test_a_car_ahead_is_seen_by_the_beam_ahead():
    readings = sense(bodies((0, 0, 0, 20, 5, 2), (30, 0, 0, 15, 5, 2)))
    assert readings.range[0, 0, AHEAD_BEAM] == pytest.approx(27.5)
    assert readings.rate[0, 0, AHEAD_BEAM] == pytest.approx(-5.0)
    # and the ego by the one behind, which is beam 19
    assert readings.range[0, 1, 19] == pytest.approx(27.5)
    assert readings.rate[0, 1, 19] == pytest.approx(-5.0)


def test_a_beam_that_meets_nothing_reads_the_full_range_and_no_rate():
    readings = sense(bodies((0, 0, 0, 20, 5, 2), (150, 0, 0, 15, 5, 2)))
    assert (readings.range == MAX_RANGE).all()
    assert (readings.rate == 0).all()


def test_beams_turn_with_the_heading():
    level = sense(bodies((0, 0, 0.0, 10, 5, 2), (20, 3, 0.0, 10, 5, 2)))
    turn = 0.7
    x, y = 20 * math.cos(turn) - 3 * math.sin(turn), 20 * math.sin(turn) + 3 * math.cos(turn)
    turned = sense(bodies((0, 0, turn, 10, 5, 2), (x, y, turn, 10, 5, 2)))
    torch.testing.assert_close(turned, level)


def test_the_side_of_a_neighbour_is_seen_to_the_right_of_the_heading():
    readings = sense(bodies((0, 0, 0, 10, 5, 2), (0, 3.7, 0, 12, 5, 2)))
    right = AHEAD_BEAM + 5  # 90 degrees
    assert readings.range[0, 0, right] == pytest.approx(2.7)
    assert readings.range[0, 0, right - 10] == MAX_RANGE
    assert readings.rate[0, 0, right] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_equal_to_a_slow_implementation(seed):
    scene = drawn(1, 9, seed)
    readings = sense(scene)
    for i in range(9):
        for k in range(BEAMS):
            distance, rate = slowly(scene, i, k)
            assert readings.range[0, i, k] == pytest.approx(distance, abs=1e-9)
            assert readings.rate[0, i, k] == pytest.approx(rate, abs=1e-9)


def test_without_gradients_single_precision_reads_the_same():
    scene = drawn(50, 6, seed=1, dtype=torch.float32)
    with torch.inference_mode():
        fast = sense(scene, 3)
    torch.testing.assert_close(fast, sense(scene, 3))
    exact = sense(Bodies(*(field.double() for field in scene)))
    # a beam that passes a corner may or may not meet it in single precision
    assert ((fast.range - exact.range[:, :3]).abs() < 1e-3).double().mean() > 0.999


def test_the_gradient_is_that_of_finite_differences():
    scene = drawn(2, 5, seed=3)
    inputs = [field.clone().requires_grad_(True) for field in scene]

    def read(*fields):
        readings = sense(Bodies(*fields))
        return readings.range, readings.rate

    assert torch.autograd.gradcheck(read, inputs, eps=1e-7, atol=1e-5)


def test_vehicles_that_are_parked_far_away_are_not_seen():
    scene = drawn(3, 4, seed=0)
    far = Bodies(*(torch.cat((field, field[:, :1]), dim=1) for field in scene))
    far.x[:, -1] = -1e4
    torch.testing.assert_close(sense(far, 4), sense(scene))
