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
    project_on_axes,
    separation,
    time_to_contact,
)
from tests.rare_envs.traffic.slow_boxes import corners, nearest, overlap
from tests.rare_envs.traffic_states import F64, tensor


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


@pytest.mark.parametrize(
    ("place", "gap"),
    [
        ((8.0, 0.0, 0.0, 0.0), 3.0),  # bumper to bumper
        ((0.0, 3.5, 0.0, math.pi), 1.5),  # flank to flank
        ((8.0, 6.0, 0.0, 0.0), 5.0),  # corner to corner: 3 m and 4 m
        ((8.0, 0.0, 0.0, math.pi / 2), 4.5),  # broadside
        ((4.0, 0.0, 0.0, 0.0), -1.0),  # 1 m deep lengthwise, 2 m sideways
        ((0.0, 0.0, 0.0, math.pi / 2), -3.5),  # a cross, in which no corner lies inside
    ],
)
def test_clearance_by_hand(place: tuple[float, ...], gap: float) -> None:
    assert box_distance(axes(*place), torch.tensor(place[3] - place[2], dtype=F64)).item() == pytest.approx(gap)


def test_clearance_is_the_distance_of_the_nearest_corner_and_side(scenes: np.ndarray) -> None:
    dx, dy, heading, other, _, _ = tensors(scenes)
    found = box_distance(axes_of(dx, dy, heading, other), other - heading).numpy()
    for scene, gap in zip(scenes[:250], found, strict=False):
        one, two = bodies(scene)
        assert overlap(one, two) == (gap < 0)
        if gap > 0:
            assert gap == pytest.approx(nearest(one, two)[0], abs=1e-12)
    assert 50 < (found < 0).sum() < 450


def test_depth_of_an_overlap_is_the_least_way_out(scenes: np.ndarray) -> None:
    dx, dy, heading, other, _, _ = tensors(scenes)
    depth = -separation(axes_of(dx, dy, heading, other)).numpy()
    overlapping = np.flatnonzero(depth > 0)[:40]
    for scene, way in zip(scenes[overlapping], depth[overlapping], strict=True):

        def moved(angle: float, length: float, scene: np.ndarray = scene) -> bool:
            place = scene[:2] + length * np.array([math.cos(angle), math.sin(angle)])
            return overlap(corners(0.0, 0.0, scene[2]), corners(*place, scene[3]))

        assert all(moved(angle, 0.99 * way) for angle in np.linspace(0.0, 2 * math.pi, 25))
        sides = (scene[2:4, None] + np.arange(4) * math.pi / 2).flat
        assert not all(moved(angle, way + 1e-6) for angle in sides)


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
            assert overlap(*bodies(scene, time + 1e-7)) or separation_at(scene, time) < 1e-9


def separation_at(scene: np.ndarray, time: float) -> float:
    return nearest(*bodies(scene, time))[0]


def test_gradients_are_those_of_finite_differences(scenes: np.ndarray) -> None:
    dx, dy, heading, other, vx, vy = (values.requires_grad_() for values in tensors(scenes[:25]))

    def apart(*values: Tensor) -> Tensor:
        return box_distance(axes_of(*values), values[3] - values[2])

    assert torch.autograd.gradcheck(apart, (dx, dy, heading, other))
    with torch.no_grad():
        times = time_to_contact(axes_of(dx, dy, heading, other), project_on_axes(vx, vy, heading, other))
    meeting = torch.isfinite(times) & (times > 0.01)
    inputs = tuple(v.detach()[meeting].requires_grad_() for v in (dx, dy, heading, other, vx, vy))

    def meet(*values: Tensor) -> Tensor:
        return time_to_contact(axes_of(*values[:4]), project_on_axes(*values[4:], values[2], values[3]))

    assert len(inputs[0]) > 5
    assert torch.autograd.gradcheck(meet, inputs)


@pytest.mark.parametrize(
    ("dx", "dy", "turn", "overlap"),
    [
        (4.99, 0.0, 0.0, True),
        (5.01, 0.0, 0.0, False),
        (0.0, 1.99, 0.0, True),
        (0.0, 2.01, 0.0, False),
        (3.49, 0.0, math.pi / 2, True),  # 2.5 + 1
        (3.51, 0.0, math.pi / 2, False),
        # a box turned by 45 degrees has its nearest corner (5 + 2) / 2 / sqrt(2) = 2.4749 along
        # and (5 - 2) / 2 / sqrt(2) = 1.06 across from its centre
        (2.5 + 2.47, 1.06, math.pi / 4, True),
        (2.5 + 2.48, 1.06, math.pi / 4, False),
        # within reach on both axes of the first box, apart on an axis of the turned one
        (4.6, 2.6, math.pi / 4, False),
        (0.0, 0.0, 1.0, True),
    ],
)
def test_box_overlap(dx: float, dy: float, turn: float, overlap: bool) -> None:
    for rotation in (0.0, 0.7, -2.0):  # the answer does not depend on the frame
        c, s = math.cos(rotation), math.sin(rotation)
        turned = (tensor(c * dx - s * dy), tensor(s * dx + c * dy))
        assert boxes_overlap(*turned, tensor(rotation), tensor(rotation + turn)).item() is overlap


def test_overlap_is_a_negative_separation() -> None:
    """Two formulas, one answer: of two million boxes near each other none is told differently."""
    generator = torch.Generator().manual_seed(0)
    for dtype in (torch.float32, F64):
        dx, dy, heading, other = (
            width * (2.0 * torch.rand(1_000_000, generator=generator, dtype=dtype) - 1.0)
            for width in (6.0, 6.0, math.pi, math.pi)
        )
        overlapping = boxes_overlap(dx, dy, heading, other)
        assert torch.equal(overlapping, separation(axes_of(dx, dy, heading, other)) < 0)
        assert 0.1 < overlapping.double().mean() < 0.5


def test_boxes_may_have_sizes_of_their_own() -> None:
    """A lorry of 16 m and a motorcycle of 2 m: apart from 9 m on along, from 1.75 m on across."""
    zero, lorry, motorcycle = tensor(0.0), (16.0, 2.5), (2.0, 1.0)
    for dx, dy, overlapping in ((8.99, 0.0, True), (9.01, 0.0, False), (0.0, 1.74, True), (0.0, 1.76, False)):
        assert boxes_overlap(tensor(dx), tensor(dy), zero, zero, lorry, motorcycle).item() is overlapping
        assert boxes_overlap(tensor(-dx), tensor(-dy), zero, zero, motorcycle, lorry).item() is overlapping
