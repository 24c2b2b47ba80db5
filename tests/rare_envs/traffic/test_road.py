"""Roads: lanes, road and world coordinates, motion along a curve."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from rare_envs.control.idm import IDM
from rare_envs.distributions.space import Parameter
from rare_envs.envs.rendering import FRAME_WIDTH, TEXT_HEIGHT, Renderer
from rare_envs.scenarios.base import Others, Scenario, columns
from rare_envs.scenarios.highway import HIGHWAY
from rare_envs.simulation.rollout import drive
from rare_envs.simulation.world import World
from rare_envs.traffic.palette import as_rgb, vehicle_colour
from rare_envs.traffic.road import ReferenceLine, Road, i80, straight
from rare_envs.traffic.state import State
from rare_envs.traffic.vehicle_models import bicycle, point_mass

F64 = torch.float64
BEND = Road((-2.0, 2.0, 5.0), ReferenceLine(25.0, (0.0, 0.002, 0.004, -0.002, 0.0)))
CURVED = pytest.mark.parametrize("road", [i80(), BEND], ids=["i80", "bend"])


def spread(low: float, high: float, n: int = 500, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(low, high, n))


def test_lanes_of_a_straight_road() -> None:
    road = straight(3)
    assert road.edges == (-2.0, 2.0, 6.0, 10.0)
    assert (road.lanes, road.width, road.middle, road.centre(2)) == (3, 4.0, 4.0, 8.0)
    y = torch.tensor([-9.0, -2.1, -1.9, 1.9, 2.1, 7.0, 9.9, 10.1], dtype=F64)
    assert road.lane_of(y).tolist() == [0, 0, 0, 0, 1, 2, 2, 2]
    assert road.centre_of(y).tolist() == [0, 0, 0, 0, 4, 8, 8, 8]
    assert road.off_road(y).tolist() == [True, True, False, False, False, False, False, True]
    left, right = road.markers(y)
    torch.testing.assert_close(left, y - torch.tensor([-2.0, -2, -2, -2, 2, 6, 6, 6], dtype=F64))
    torch.testing.assert_close(left + right, torch.full_like(y, 4.0))


@pytest.mark.parametrize("road", [straight(1), straight(4), straight(2, 3.5), i80(), Road((1.0, 5.0, 9.0))])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_centre_is_that_of_the_own_lane(road: Road, dtype: torch.dtype) -> None:
    y = spread(road.edges[0] - 3.0, road.edges[-1] + 3.0).to(dtype).reshape(50, 10)
    centres = torch.tensor([road.centre(k) for k in range(road.lanes)], dtype=dtype)
    torch.testing.assert_close(road.centre_of(y), centres[road.lane_of(y)])
    left, right = road.markers(y)
    torch.testing.assert_close((left - right) / 2, y - road.centre_of(y))
    assert torch.equal((left < 0) | (right < 0), road.off_road(y))


def test_i80_has_the_lanes_of_the_survey() -> None:
    road = i80()
    widths = np.diff(road.edges)
    assert road.lanes == 6
    assert not road.equal
    assert widths == pytest.approx([3.61, 3.66, 3.66, 3.66, 3.66, 3.72], abs=0.01)
    assert road.centre(0) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("edges", [(), (1.0,), (0.0, 0.0), (4.0, 0.0), (0.0, math.nan), (0.0, math.inf)])
def test_edges_must_increase(edges: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="Expected two or more increasing edges"):
        Road(edges)


@CURVED
def test_round_trip(road: Road) -> None:
    x, y, heading = spread(-100.0, 2000.0, 20_000), spread(-30.0, 30.0, 20_000, 1), spread(-0.5, 0.5, 20_000, 2)
    back = road.from_world(*road.to_world(x, y, heading))
    for there, again in zip((x, y, heading), back, strict=True):
        torch.testing.assert_close(again, there, atol=1e-8, rtol=0.0)


def test_round_trip_in_single_precision() -> None:
    x, y, heading = (v.float().reshape(50, 10) for v in (spread(0, 2e3), spread(-3, 25, seed=1), spread(-0.2, 0.2)))
    back = i80().from_world(*i80().to_world(x, y, heading))
    for there, again in zip((x, y, heading), back, strict=True):
        assert (again.dtype, again.shape) == (torch.float32, (50, 10))
        torch.testing.assert_close(again, there, atol=2e-3, rtol=0.0)


def test_a_straight_road_is_the_world() -> None:
    inputs = (spread(0, 1e3), spread(-3, 9), spread(-1, 1))
    for there, here in zip(straight(3).to_world(*inputs), straight(3).from_world(*inputs), strict=True):
        assert any(there is each for each in inputs)
        assert here is there
    assert not straight(3).curvature(inputs[0]).any()


def test_world_frame_is_that_of_the_start_with_y_to_the_right() -> None:
    x, y, heading = (torch.tensor([v], dtype=F64) for v in (0.0, 3.0, 0.1))
    assert [float(v) for v in BEND.to_world(x, y, heading)] == [0.0, 3.0, 0.1]
    # the bend begins to the right: the reference line goes towards +Y, and a car that keeps to it turns to the right
    _, side, turned = BEND.to_world(x + 50.0, y * 0, heading * 0)
    assert side.item() > 1.0
    assert turned.item() == pytest.approx(0.1)  # (0.002 + 0.004 / 2) * 25


@CURVED
def test_gradients(road: Road) -> None:
    x, y, heading = (v.requires_grad_() for v in (spread(-20, 750, 40), spread(-3, 20, 40, 1), spread(-0.2, 0.2, 40)))
    assert torch.autograd.gradcheck(road.to_world, (x, y, heading))
    world = tuple(v.detach().requires_grad_() for v in road.to_world(x, y, heading))
    assert torch.autograd.gradcheck(road.from_world, world)
    assert torch.autograd.gradcheck(road.curvature, (x,))
    assert torch.autograd.gradcheck(road.markers, (y,))
    speed, acceleration, rate = (
        v.requires_grad_() for v in (spread(5, 30, 40), spread(-3, 3, 40), spread(-0.1, 0.1, 40))
    )

    def step(*state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return point_mass(*state, 0.1, road.curvature(state[0]))

    assert torch.autograd.gradcheck(step, (x, y, heading, speed, acceleration, rate))


def test_gradients_after_inference_mode() -> None:
    road = Road((-2.0, 2.0, 5.0), ReferenceLine(30.0, (0.0, 0.001, 0.0)))
    x, y = spread(0, 100), spread(-2, 5)
    with torch.inference_mode():
        road.to_world(x, y, y)
        road.markers(y)
    x.requires_grad_(), y.requires_grad_()
    sum(part.sum() for part in (*road.to_world(x, y, y), *road.markers(y))).backward()
    assert torch.isfinite(x.grad).all()


def test_point_mass_by_hand() -> None:
    state = [torch.tensor(v, dtype=F64) for v in (10.0, 1.0, 0.3, 20.0)]
    action = [torch.tensor(v, dtype=F64) for v in (-2.0, 0.5)]
    moved = point_mass(*state, *action, 0.1)
    wanted = (10.0 + 2.0 * math.cos(0.3), 1.0 + 2.0 * math.sin(0.3), 0.35, 19.8)
    assert [v.item() for v in moved] == pytest.approx(wanted)
    *_, speed = point_mass(*state[:3], torch.tensor(0.1, dtype=F64), *action, 0.1)
    assert speed.item() == 0.0


def test_bicycle_and_point_mass_agree_without_slip() -> None:
    x, y, heading, speed, acceleration = spread(0, 650), spread(0, 18), spread(-0.1, 0.1), spread(5, 30), spread(-3, 3)
    curvature, zero = i80().curvature(x), torch.zeros_like(x)
    one = bicycle(x, y, heading, speed, acceleration, zero, 0.1, curvature)
    other = point_mass(x, y, heading, speed, acceleration, zero, 0.1, curvature)
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a, b)


@CURVED
def test_without_turning_a_car_drives_straight_through_the_world(road: Road) -> None:
    """The error of explicit Euler is of first order in the tick: a tenth of it has a tenth of the error."""
    errors = []
    for dt in (0.1, 0.01):
        state = [torch.tensor(v, dtype=F64) for v in (5.0, 2.0, 0.01, 30.0)]
        zero = torch.zeros((), dtype=F64)
        start_x, start_y, course = road.to_world(*state[:3])
        for _ in range(round(4.0 / dt)):
            state = list(point_mass(*state, zero, zero, dt, road.curvature(state[0])))
        world_x, world_y, heading = road.to_world(*state[:3])
        assert heading.item() == pytest.approx(course.item(), abs=0.1 * dt)
        missed = math.hypot(
            world_x - start_x - 120.0 * torch.cos(course), world_y - start_y - 120.0 * torch.sin(course)
        )
        errors.append(missed)
    assert errors[0] < 0.6
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.25)


@CURVED
def test_a_car_that_turns_with_the_road_stays_in_its_lane(road: Road) -> None:
    y0, speed, dt = 4.0, 20.0, 0.1
    state = [torch.tensor(v, dtype=F64) for v in (0.0, y0, 0.0, speed)]
    zero = torch.zeros((), dtype=F64)
    for _ in range(300):
        curvature = road.curvature(state[0])
        rate = curvature * speed / (1.0 - curvature * state[1])
        state = list(point_mass(*state, zero, rate, dt, curvature))
    assert (state[1].item(), state[2].item()) == pytest.approx((y0, 0.0), abs=1e-12)
    # in the world it went 600 m along its own line, which is longer than the reference line where that turns left
    assert road.reference_line is not None
    s = torch.arange(0.0, state[0].item(), 0.01, dtype=F64)
    own_line = state[0].item() - y0 * float(road.reference_line.at(s[-1]).heading)
    assert own_line == pytest.approx(600.0, abs=0.05)


def pair(x: float, y: float, other_x: float, other_y: float, heading: float = 0.0) -> State:
    """The ego and one other vehicle at 25 m/s."""
    rows = ((x, other_x), (y, other_y), (heading, 0.0), (25.0, 25.0), ())
    return State(*(torch.tensor([row], dtype=F64) for row in rows))


def others(state: State, dt: float) -> Others:
    x, y, heading, speed, _ = (field[:, 1:] for field in state)
    return Others(x + speed * dt, y, heading, speed)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_an_ego_keeps_its_lane_of_the_i80(dtype: torch.dtype) -> None:
    def initial(x: torch.Tensor) -> State:
        ones = torch.ones_like(x[:, 0])
        return State(
            columns(0 * ones, 60 * ones),
            columns(x[:, 0], 11 * ones),
            columns(*[0 * ones] * 2),
            columns(*[25 * ones] * 2),
            x[:, :0],
        )

    road = i80()
    script = Scenario(
        name="drive",
        road=road,
        vehicle_names=("ego", "other"),
        horizon=30.0,
        parameters=(Parameter("y", "m", -2.0, 30.0, "initial place across the road"),),
        bases={"even": {"alpha": [1.0], "beta": [1.0]}},
        initial=initial,
        others=others,
        driven=lambda state, action, dt: others(state, dt),
    )
    world = World(script)
    starts = torch.tensor([[road.centre(lane) + 0.8] for lane in range(6)], dtype=dtype)
    episodes = list(drive(world, IDM(desired_speed=25.0), starts))
    assert not episodes[-1].collided.any()
    y = torch.stack([episode.state.y[:, 0] for episode in episodes[50:]])
    off = (y - torch.tensor([road.centre(lane) for lane in range(6)], dtype=dtype)).abs().amax(0)
    assert (off < 0.02).all()  # 0.12 v^2 / R at 25 m/s and R = 3600 m
    assert (off > 0.005).all()  # the road does turn


def test_a_curved_road_is_drawn_in_the_world() -> None:
    road = i80()
    world = World(replace(HIGHWAY, vehicle_names=("ego", "lead"), labels=(), drivers=None))
    renderer = Renderer(world)
    for x in (0.0, 400.0, 1500.0):
        state = pair(x, road.centre(1), x + 30.0, road.centre(4))
        image = renderer.draw(world.start_from(state, None))
        assert image.shape == (240 + 2 * TEXT_HEIGHT, FRAME_WIDTH, 3)
        image = image[TEXT_HEIGHT:-TEXT_HEIGHT]
        at = {}
        for name, ahead, y in [
            ("ego", 0.0, road.centre(1)),
            ("other", 30.0, road.centre(4)),
            ("road", 60.0, road.centre(2)),
        ]:
            point, camera = (
                torch.stack(road.to_world(*torch.tensor([px, py, 0.0], dtype=F64))[:2])
                for px, py in ((x + ahead, y), (x, road.middle))
            )
            column, row = (8.0 * (point - camera) + torch.tensor([0.3 * FRAME_WIDTH, 120.0])).round().long().tolist()
            at[name] = image[row, column].tolist()
        colours = {"ego": list(as_rgb(vehicle_colour("ego"))), "other": list(as_rgb(vehicle_colour("lead")))}
        assert at == {**colours, "road": [100, 100, 100]}
        # white lines: the two edges whole, so that every column of the image crosses both
        assert ((image == 255).all(axis=-1).sum(axis=0) >= 2 * 2).all()
    renderer.close()


def test_fast_enough_to_be_called_every_tick() -> None:
    road, y = i80(), spread(-1.8, 20.0, 6144).float().reshape(1024, 6)
    x = spread(0, 700, 6144).float().reshape(1024, 6)
    with torch.inference_mode():
        best = math.inf
        for _ in range(20):
            start = time.perf_counter()
            road.to_world(x, y, y)
            road.markers(y)
            best = min(best, time.perf_counter() - start)
    assert best < 5e-3  # 10 times what it takes


def test_off_road() -> None:
    for lanes, y, outside in [(1, 1.9, False), (1, 2.1, True), (1, -2.1, True), (2, 5.9, False), (2, 6.1, True)]:
        assert straight(lanes).off_road(torch.tensor([y])).item() is outside


def test_a_lane_s_centre_may_be_changed_by_whoever_asks_for_it() -> None:
    road, y = straight(1), torch.zeros(1)
    road.centre_of(y).add_(5.0)
    assert road.centre_of(y).item() == 0.0
