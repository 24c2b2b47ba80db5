"""Scenarios: what contradicts itself is refused, labels in words, and the motion of other vehicles by hand."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import drive_points, keep_straight
from rare_envs.traffic.road import ReferenceLine, Road, straight
from rare_envs.traffic.state import State
from tests.rare_envs.scenarios.standing import STANDING

F64 = torch.float64
BEND = ReferenceLine(25.0, (0.0, 0.002, 0.004, -0.002, 0.0))
SPEED = Parameter("speed", "m/s", 5.0, 30.0, "")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"vehicle_names": ("car", "stalled")}, 'vehicles with different names, "ego" first'),
        ({"vehicle_names": ("ego", "ego")}, 'vehicles with different names, "ego" first'),
        ({"vehicle_names": ()}, 'vehicles with different names, "ego" first'),
        ({"vehicle_names": ("ego", "")}, "vehicles with names, got ('ego', '')"),
        ({"vehicle_names": ("ego", 2)}, "vehicles with names, got ('ego', 2)"),
        ({"labels": ("the ego",)}, "as many labels as vehicles"),
        ({"bases": {}}, "at least one base distribution"),
        ({"horizon": math.inf}, "a horizon in s"),
        ({"horizon": 0.0}, "a horizon in s"),
        ({"parameters": ()}, "parameters with different names, none of them 'x'"),
        ({"parameters": (SPEED, SPEED)}, "parameters with different names, none of them 'x'"),
        ({"parameters": (replace(SPEED, name="x"),)}, "parameters with different names, none of them 'x'"),
        ({"parameters": (replace(SPEED, low=30.0),)}, "parameters with low < high"),
        ({"parameters": (replace(SPEED, size=0),)}, "parameters with low < high"),
    ],
)
def test_a_scenario_that_contradicts_itself_is_refused(change: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=r"^Expected .* in the scenario 'standing'") as caught:
        replace(STANDING, **change)
    assert expected in str(caught.value)


def test_a_block_takes_as_many_columns_as_its_size() -> None:
    gaps = Parameter("gap", "m", 1.0, 50.0, "", size=3)
    scenario = replace(STANDING, parameters=(SPEED, gaps))
    assert scenario.size == 4
    assert scenario.column_parameters == [SPEED, gaps, gaps, gaps]
    assert (STANDING.size, STANDING.vehicles) == (2, 2)


def traffic(rows: list[list[tuple[float, float, float, float]]]) -> State:
    """Scenarios of vehicles (x, y, heading, speed)."""
    return State(*torch.tensor(rows, dtype=F64).unbind(dim=-1), theta=torch.zeros(len(rows), 0, dtype=F64))


EGO = (0.0, 0.0, 0.0, 99.0)


def test_vehicles_that_keep_straight_move_by_their_speed_before_the_tick() -> None:
    state = traffic([[EGO, (30.0, 1.0, 0.1, 20.0), (60.0, 2.0, 0.0, 1.0)]])
    after = keep_straight(state, torch.tensor([[-2.0, -4.0]], dtype=F64), 0.5)
    assert after.x.tolist() == [[40.0, 60.5]]
    assert after.speed.tolist() == [[19.0, 0.0]]  # -1 m/s would be backwards
    assert after.y.tolist() == [[1.0, 2.0]]
    assert after.heading.tolist() == [[0.1, 0.0]]
    assert keep_straight(state, 0.0, 0.5).speed.tolist() == [[20.0, 1.0]]


def test_a_braking_vehicle_stands_after_its_braking_distance() -> None:
    """v^2 / 2a = 50 m, and v dt / 2 = 1 m that explicit Euler drives too far; then it stays."""
    state, dt = traffic([[EGO, (0.0, 0.0, 0.0, 20.0)]]), 0.1
    for _ in range(80):
        after = keep_straight(state, -4.0, dt)
        state = State(*(torch.cat((mine[:, :1], new), 1) for mine, new in zip(state[:4], after, strict=True)), state[4])
    assert state.speed[0, 1].item() == 0.0
    assert state.x[0, 1].item() == pytest.approx(50.0 + 20.0 * dt / 2, abs=1e-9)


def test_points_on_a_straight_road_by_hand() -> None:
    state = traffic([[EGO, (30.0, 1.0, 0.2, 20.0), (60.0, 2.0, 0.0, 0.1)]])
    after = drive_points(state, torch.tensor([[[1.0, 0.3], [-5.0, 0.0]]], dtype=F64), 0.1, straight(2))
    first = [field[0, 0].item() for field in after]
    assert first == pytest.approx([30.0 + 2.0 * math.cos(0.2), 1.0 + 2.0 * math.sin(0.2), 0.23, 20.1])
    assert [field[0, 1].item() for field in after] == pytest.approx([60.01, 2.0, 0.0, 0.0])


def drive_in_the_bend(y: float, heading: float, action: Tensor, ticks: int) -> list[float]:
    """Drive a point at 20 m/s in the bend; x, y, heading and speed at the end."""
    state, road = traffic([[EGO, (0.0, y, heading, 20.0)]]), Road((-2.0, 2.0, 5.0), BEND)
    for _ in range(ticks):
        after = drive_points(state, action, 0.1, road)
        state = State(*(torch.cat((mine[:, :1], new), 1) for mine, new in zip(state[:4], after, strict=True)), state[4])
    return [field[0, 1].item() for field in state[:4]]


def test_a_point_that_does_not_turn_relative_to_the_road_follows_it() -> None:
    """In 10 s at 20 m/s it drives 200 m of its own line, which at y is (1 - k y) of the reference line: x - y theta."""
    x, y, heading, speed = drive_in_the_bend(4.0, 0.0, torch.zeros(1, 1, 2, dtype=F64), 100)
    assert (y, heading, speed) == pytest.approx((4.0, 0.0, 20.0), abs=1e-12)
    turned = BEND.at(torch.tensor([x], dtype=F64)).heading.item()
    assert turned == pytest.approx(0.1, abs=1e-9)  # (0.002 + 0.004 - 0.002) / m times 25 m
    assert x - y * turned == pytest.approx(200.0, abs=0.05)  # explicit Euler, of first order in the tick


def test_a_yaw_rate_is_relative_to_the_road() -> None:
    """0.02 rad/s for 4 s, wherever the road turns meanwhile."""
    action = torch.tensor([[[0.0, 0.02]]], dtype=F64)
    _, _, heading, _ = drive_in_the_bend(0.0, -0.03, action, 40)
    assert heading == pytest.approx(-0.03 + 0.08, abs=1e-12)
