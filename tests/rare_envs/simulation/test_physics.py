"""Physics with answers from pencil and paper."""

import math
from itertools import pairwise

import pytest
import torch
from highway_env.utils import not_zero

from rare_envs.control.idm import IDM
from rare_envs.control.steering import lane_keeping
from rare_envs.measures import TTC_MAX, Moment, ttc
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.cut_in import CUT_IN, bezier
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.world import World
from rare_envs.traffic.lead import Lead, lead_of
from rare_envs.traffic.overlap import boxes_overlap
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State
from rare_envs.traffic.vehicle_models import NEAR_ZERO, STEERING_LIMIT, bicycle, steering_for

F64 = torch.float64


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=F64)


def traffic(*vehicles: tuple[float, float, float, float]) -> State:
    """One scenario; x, y, heading, speed of each vehicle."""
    x, y, heading, speed = (tensor(*column)[None] for column in zip(*vehicles, strict=True))
    return State(x, y, heading, speed, x[:, :0])


def test_bicycle_straight_line_is_uniform_acceleration() -> None:
    x, y, heading, speed = tensor(0.0), tensor(0.0), tensor(0.0), tensor(20.0)
    for _ in range(10):
        x, y, heading, speed = bicycle(x, y, heading, speed, tensor(1.0), tensor(0.0), 0.1)
    # explicit Euler: sum of (20 + 0.1 k) 0.1 for k = 0..9
    assert x.item() == pytest.approx(20.0 + 0.45)
    assert (y.item(), heading.item(), speed.item()) == (0.0, 0.0, pytest.approx(21.0))


def test_steering_for_a_yaw_rate_is_how_the_bicycle_turns_at_it() -> None:
    speed, rate = tensor(0.02, 3.0, 20.0, 20.0), tensor(0.004, -0.5, 0.3, 0.0)
    zero = torch.zeros_like(speed)
    *_, heading, _ = bicycle(zero, zero, zero, speed, zero, steering_for(rate, speed), 0.1)
    torch.testing.assert_close(heading, 0.1 * rate)
    # whoever is too slow for it, a vehicle at rest for one, steers as far as it goes
    largest = steering_for(tensor(0.5, -0.5, 0.5), tensor(1.0, 0.0, 0.0))
    torch.testing.assert_close(largest, STEERING_LIMIT * tensor(1.0, -1.0, 1.0))


def test_nothing_is_divided_by_less_than_in_highway_env() -> None:
    assert NEAR_ZERO == not_zero(0.0)


def test_bicycle_turns_on_the_kinematic_circle() -> None:
    # yaw rate = v sin(beta) / (L/2): a full circle takes 2 pi / rate
    steering, v, dt = 0.2, 10.0, 1e-3
    beta = math.atan(math.tan(steering) / 2)
    rate = v * math.sin(beta) / 2.5
    state = (tensor(0.0), tensor(0.0), tensor(0.0), tensor(v))
    for _ in range(round(2 * math.pi / rate / dt)):
        state = bicycle(*state, tensor(0.0), tensor(steering), dt)
    assert state[0].item() == pytest.approx(0.0, abs=0.05)
    assert state[1].item() == pytest.approx(0.0, abs=0.05)


def test_vehicles_stop_and_do_not_reverse() -> None:
    *_, speed = bicycle(tensor(0.0), tensor(0.0), tensor(0.0), tensor(0.3), tensor(-5.0), tensor(0.0), 0.1)
    assert speed.item() == 0.0


def test_bicycle_gradient() -> None:
    inputs = [torch.rand(4, dtype=F64, requires_grad=True) for _ in range(6)]
    inputs[3] = (inputs[3] + 5).detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda *a: bicycle(*a, 0.1), inputs)


def test_idm_equilibrium() -> None:
    # at equal speeds below v0, a = 0 where gap = s* / sqrt(1 - (v/v0)^4)
    idm, v = IDM(), 15.0
    wanted = 1.0 + 2.0 * math.sqrt(v / 21.72) + 1.2 * v
    gap = wanted / math.sqrt(1.0 - (v / 21.72) ** 4)
    acceleration = idm.acceleration(tensor(v), Lead(tensor(gap), tensor(0.0)))
    assert acceleration.item() == pytest.approx(0.0, abs=1e-12)


def test_idm_by_hand() -> None:
    # v = 20, dv = 5, gap = 40: s* = 1 + 2 sqrt(20/21.72) + 24 + 100 / (2 sqrt(5.328))
    wanted = 1 + 2 * math.sqrt(20 / 21.72) + 24 + 100 / (2 * math.sqrt(2.22 * 2.4))
    expected = 2.22 * (1 - (20 / 21.72) ** 4 - (wanted / 40) ** 2)
    assert -5.0 < expected < 0.0
    acceleration = IDM().acceleration(tensor(20.0), Lead(tensor(40.0), tensor(5.0)))
    assert acceleration.item() == pytest.approx(expected, rel=1e-14)


def test_idm_limits() -> None:
    idm = IDM()
    emergency = idm.acceleration(tensor(20.0), Lead(tensor(2.0), tensor(10.0)))
    start = idm.acceleration(tensor(0.0), Lead(tensor(math.inf), tensor(0.0)))
    side_by_side = idm.acceleration(tensor(20.0), Lead(tensor(-3.0), tensor(0.0)))
    assert (emergency.item(), side_by_side.item()) == (-5.0, -5.0)
    assert start.item() == pytest.approx(2.22)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_lane_keeping_never_steers_the_wrong_way(dtype: torch.dtype) -> None:
    """At low speed the wanted yaw rate is beyond what the wheels can do: as far as they turn, and to the lane."""
    y = torch.tensor([1.5, -1.5, 1.5, -1.5], dtype=dtype)
    speed = torch.tensor([0.5, 0.5, 0.0, 0.0], dtype=dtype)
    steering = lane_keeping(y, torch.zeros_like(y), speed, straight(1))
    limit = math.pi / 3
    assert steering.tolist() == pytest.approx([-limit, limit, -limit, limit], abs=1e-5)
    grid = torch.linspace(-1.9, 1.9, 39, dtype=dtype)
    y, heading, speed = torch.meshgrid(grid, 0.4 * grid, 10 * grid.abs(), indexing="ij")
    steering = lane_keeping(y, heading, speed, straight(1))
    exact = lane_keeping(y.double(), heading.double(), speed.double(), straight(1))
    torch.testing.assert_close(steering.double(), exact, rtol=0, atol=1e-4)


def test_lane_keeping_returns_to_the_lane() -> None:
    state = (tensor(0.0), tensor(1.0), tensor(0.05), tensor(20.0))
    for _ in range(100):
        state = bicycle(*state, tensor(0.0), lane_keeping(*state[1:], straight(1)), 0.1)
    assert state[1].item() == pytest.approx(0.0, abs=1e-4)
    assert state[2].item() == pytest.approx(0.0, abs=1e-4)


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


def test_lead_is_the_nearest_ahead_that_reaches_into_the_lane() -> None:
    ego = (0.0, 0.0, 0.0, 20.0)
    far, near, beside, behind = (
        (60.0, 0.0, 0.0, 15.0),
        (30.0, 2.9, 0.0, 12.0),
        (20.0, 3.1, 0.0, 5.0),
        (-8.0, 0, 0, 30.0),
    )
    lead = lead_of(traffic(ego, far, near, beside, behind), straight(2))
    assert (lead.gap.item(), lead.closing_speed.item()) == (25.0, 8.0)
    nobody = lead_of(traffic(ego, beside, behind), straight(2))
    assert (nobody.gap.item(), nobody.closing_speed.item()) == (math.inf, 0.0)


def test_ego_in_the_other_lane_minds_that_lane() -> None:
    ego, here, there = (0.0, 3.5, 0.0, 20.0), (40.0, 4.0, 0.0, 15.0), (20.0, 0.0, 0.0, 10.0)
    assert lead_of(traffic(ego, here, there), straight(2)).gap.item() == 35.0


def test_ttc_of_two_cars() -> None:
    state = traffic((0.0, 0.0, 0.0, 20.0))
    assert ttc(Moment(state, Lead(tensor(30.0), tensor(10.0)), straight(1), None)).item() == pytest.approx(3.0)
    assert ttc(Moment(state, Lead(tensor(30.0), tensor(-1.0)), straight(1), None)).item() == TTC_MAX
    assert ttc(Moment(state, Lead(tensor(500.0), tensor(10.0)), straight(1), None)).item() == TTC_MAX
    assert ttc(Moment(state, Lead(tensor(math.inf), tensor(0.0)), straight(1), None)).item() == TTC_MAX
    assert (
        0.0 < ttc(Moment(state, Lead(tensor(-2.0), tensor(10.0)), straight(1), None)).item() < 0.01
    )  # beside, not a collision


@pytest.mark.parametrize(
    ("y", "heading", "lanes", "expected"),
    [
        (0.0, 0.05, 1, 2.0 / (20.0 * math.sin(0.05))),  # to the right edge, 2 m away
        (0.5, -0.05, 1, 2.5 / (20.0 * math.sin(0.05))),  # back to the left one
        (0.0, 0.05, 2, 6.0 / (20.0 * math.sin(0.05))),  # a second lane on the right
        (1.9, 0.0, 1, TTC_MAX),  # along the edge, not towards it
        (3.0, 0.05, 1, 0.01 / (20.0 * math.sin(0.05))),  # beyond it
    ],
)
def test_ttc_of_the_edge_of_the_road(y: float, heading: float, lanes: int, expected: float) -> None:
    state, nobody = traffic((0.0, y, heading, 20.0)), Lead(tensor(math.inf), tensor(0.0))
    assert ttc(Moment(state, nobody, straight(lanes), None)).item() == pytest.approx(expected)


def test_off_road() -> None:
    for lanes, y, outside in [(1, 1.9, False), (1, 2.1, True), (1, -2.1, True), (2, 5.9, False), (2, 6.1, True)]:
        assert straight(lanes).off_road(tensor(y)).item() is outside


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


def test_car_following_without_brakes_collides_when_the_gap_is_used_up() -> None:
    # 20 m/s behind 10 m/s with a gap of 12.05 m: bumpers meet between 1.2 and 1.3 s
    world = World(CAR_FOLLOWING)
    episode, still = world.start(tensor(20.0, 10.0, 12.05)[None]), torch.zeros(1, 2, dtype=F64)
    assert episode.f.item() == pytest.approx(1.205)
    for _ in range(12):
        episode = world.step(episode, still)
    assert not episode.collided
    assert episode.f.item() == pytest.approx(0.005)
    episode = world.step(episode, still)
    assert episode.collided
    assert episode.f.item() == -1.0


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


def test_worlds_refuse_nonsense() -> None:
    for kwargs in ({"dt": 0.0}, {"dt": float("nan")}, {"horizon": 0.01}, {"horizon": float("inf")}):
        with pytest.raises(ValueError, match="Expected"):
            World(CAR_FOLLOWING, clock=Clock(**kwargs))
    with pytest.raises(ValueError, match="ttc"):
        Measurement("tcc")
