"""Bodies of vehicles: overlap, distance, time to contact, pairs."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.traffic.bodies import (
    Axes,
    axes_of,
    box_distance,
    boxes_overlap,
    encounter,
    overlaps,
    pairs,
    project_on_axes,
    time_to_contact,
)
from rare_envs.traffic.road import ReferenceLine, Road, i80
from rare_envs.traffic.state import State
from tests.rare_envs.traffic.slow_boxes import corners, nearest, overlap
from tests.rare_envs.traffic_states import ARC, F64, RADIUS, traffic


def tensors(values: np.ndarray) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(column.copy()) for column in values.T)


def axes(*values: float) -> Axes:
    return axes_of(*(torch.tensor(value, dtype=F64) for value in values))


@pytest.fixture(scope="module")
def scenes() -> np.ndarray:
    """500 pairs: dx, dy, both headings, and the velocity of the other less that of the first."""
    rng = np.random.default_rng(3)
    place = rng.uniform(-12, 12, (500, 2))
    towards = -place * rng.uniform(0.2, 1.5, (500, 1)) + rng.normal(0.0, 4.0, (500, 2))
    return np.column_stack((place, rng.uniform(-math.pi, math.pi, (500, 2)), towards))


def bodies(scene: np.ndarray, time: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    dx, dy, heading, other, vx, vy = scene
    return corners(0.0, 0.0, heading), corners(dx + vx * time, dy + vy * time, other)


def test_clearance_is_the_distance_of_the_nearest_corner_and_side(scenes: np.ndarray) -> None:
    dx, dy, heading, other, _, _ = tensors(scenes)
    found = box_distance(axes_of(dx, dy, heading, other), other - heading).numpy()
    for scene, gap in zip(scenes[:250], found, strict=False):
        one, two = bodies(scene)
        assert overlap(one, two) == (gap < 0)
        if gap > 0:
            assert gap == pytest.approx(nearest(one, two)[0], abs=1e-12)
    assert 50 < (found < 0).sum() < 450


@pytest.mark.parametrize(
    ("place", "velocity", "time"),
    [
        ((25.0, 0.0, 0.0, 0.0), (-10.0, 0.0), 2.0),  # 20 m of gap
        ((25.0, 0.0, 0.0, 0.0), (10.0, 0.0), math.inf),
        ((0.0, 4.0, 0.0, 0.0), (0.0, -0.5), 4.0),  # side-swipe over 2 m
        ((25.0, 3.0, 0.0, 0.0), (-10.0, 0.0), math.inf),  # passes in the next lane
        ((25.0, 3.0, 0.0, 0.0), (-10.0, -0.45), 1.0 / 0.45),  # lengthwise after 2 s, sideways later
        ((25.0, 3.0, 0.0, 0.0), (-10.0, -0.3), math.inf),  # lengthwise 2 to 3 s, sideways from 3.33 s: behind it
        ((3.0, 0.0, 0.0, 0.0), (10.0, 0.0), 0.0),  # in contact already
        ((20.0, -20.0, 0.0, math.pi / 2), (-10.0, 10.0), 1.65),  # crossing at right angles: 16.5 m each way
    ],
)
def test_time_to_contact_by_hand(place: tuple[float, ...], velocity: tuple[float, float], time: float) -> None:
    headings = (torch.tensor(place[2], dtype=F64), torch.tensor(place[3], dtype=F64))
    rate = project_on_axes(*(torch.tensor(v, dtype=F64) for v in velocity), *headings)
    assert time_to_contact(axes(*place), rate).item() == pytest.approx(time)


def test_time_to_contact_is_when_small_steps_in_time_first_touch(scenes: np.ndarray) -> None:
    dx, dy, heading, other, vx, vy = tensors(scenes)
    found = time_to_contact(axes_of(dx, dy, heading, other), project_on_axes(vx, vy, heading, other)).numpy()
    assert 50 < (np.isfinite(found) & (found > 0)).sum() < 450
    for scene, time in zip(scenes[:150], found, strict=False):
        grid = np.arange(0.0, 3.0, 0.01)
        # whoever is a circle apart does not touch: the slow test is only made where they may
        close = np.hypot(scene[0] + scene[4] * grid, scene[1] + scene[5] * grid) < 5.4
        first = next((t for t in grid[close] if overlap(*bodies(scene, t))), math.inf)
        if math.isfinite(first):
            assert first - 0.01 - 1e-9 <= time <= first + 1e-9
        elif math.isfinite(time) and time < 2.99:  # a touch so short that it falls between two steps
            assert overlap(*bodies(scene, time + 1e-7)) or nearest(*bodies(scene, time))[0] < 1e-9


def test_overlap_is_a_negative_separation() -> None:
    """Two formulas, one answer: of 400,000 boxes near each other none is told differently."""
    generator = torch.Generator().manual_seed(0)
    for dtype in (torch.float32, F64):
        dx, dy, heading, other = (
            width * (2.0 * torch.rand(200_000, generator=generator, dtype=dtype) - 1.0)
            for width in (6.0, 6.0, math.pi, math.pi)
        )
        overlapping = boxes_overlap(dx, dy, heading, other)
        assert torch.equal(overlapping, axes_of(dx, dy, heading, other).gap.amax(-1) < 0)
        assert 0.1 < overlapping.double().mean() < 0.5


def test_contacts_of_all_pairs_are_those_of_each_vehicle_as_ego() -> None:
    rng = np.random.default_rng(0)
    fields = [rng.uniform(low, high, (500, 6)) for low, high in ((0, 25), (0, 12), (-0.5, 0.5), (0, 20))]
    state = State(*map(torch.from_numpy, fields), theta=torch.zeros(500, 0))
    road = i80()
    found, first, second = overlaps(state, road, "all"), *map(np.array, pairs(6))
    assert 0.05 < found.double().mean() < 0.5
    assert torch.equal(found[:, first > 0], overlaps(state, road, "others"))
    for vehicle in range(6):
        expected = overlaps(state.seen_by(vehicle), road)
        assert torch.equal(found[:, (first == vehicle) | (second == vehicle)], expected)


def test_bodies_overlap_in_the_world_not_along_the_road() -> None:
    """Where 5 m of the road's line are 5 (1 - k y) m at y."""
    road = Road((-30.0, 0.0, 30.0), ReferenceLine(50.0, (0.0, 0.004, 0.004, 0.0)))
    for y, other_x, touch in [(20.0, 5.3, True), (20.0, 5.5, False), (-20.0, 4.7, False), (-20.0, 4.55, True)]:
        assert overlaps(traffic((75.0, y, 0.0, 0.0), (75.0 + other_x, y, 0.0, 0.0)), road).item() is touch
    state = traffic((75.0, 20.0, 0.0, 0.0), (75.0, 21.9, 0.0, 0.0))
    assert overlaps(state, road).item() is True
    assert overlaps(state._replace(y=torch.tensor([[20.0, 22.1]], dtype=F64)), road).item() is False


def test_vehicles_on_a_bend_meet_along_the_chord() -> None:
    """Both on a circle of radius R - y, their headings an angle of ds / R apart, however long the way between them."""
    y, ahead, speed, lead_speed = 4.0, 40.0, 20.0, 15.0
    met = encounter(traffic((55.0, y, 0.0, speed), (55.0 + ahead, y, 0.0, lead_speed)), ARC)
    angle, radius = ahead / RADIUS, RADIUS - y
    along, across = radius * math.sin(angle), radius * (1.0 - math.cos(angle))
    other = along, -across  # as seen from the lead, which has turned by the angle
    assert met.axes.offset[0, 0].tolist() == pytest.approx([along, across, *other], abs=5e-4)
    assert math.hypot(along, across) == pytest.approx(2.0 * radius * math.sin(angle / 2))
    rates = [lead_speed * math.cos(angle) - speed, lead_speed * math.sin(angle)]
    rates += [lead_speed - speed * math.cos(angle), speed * math.sin(angle)]
    assert met.rate[0, 0].tolist() == pytest.approx(rates, abs=1e-6)
    assert (met.other_heading - met.heading).item() == pytest.approx(angle, abs=1e-12)
