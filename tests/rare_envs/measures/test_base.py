"""Measures of one moment, by hand and against motion in small steps."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.measures import (
    DECELERATION_MAX,
    TTC_MAX,
    EpisodeMeasure,
    Measure,
    Moment,
    btn,
    clearance,
    drac,
    evasive_manoeuvre,
    mttc,
    required_deceleration,
    tet,
    thw,
    tit,
    ttb,
    ttc,
    ttc_2d,
)
from rare_envs.measures.registry import MEASURES, find_measure
from rare_envs.traffic.neighbours import lead_of
from rare_envs.traffic.road import i80, straight
from rare_envs.traffic.state import State
from tests.rare_envs.measures.moments import (
    following,
    moment,
    problem,
)


@pytest.mark.parametrize(
    ("measure", "now", "value"),
    [
        (ttc, following(30.0, 20.0, 10.0), 3.0),
        (mttc, following(30.0, 20.0, 10.0), 3.0),  # no accelerations: as TTC
        (mttc, following(30.0, 20.0, 10.0, 1.0, -3.0), (-10.0 + math.sqrt(100.0 + 2 * 4.0 * 30.0)) / 4.0),
        (mttc, following(30.0, 20.0, 10.0, -2.0, 0.0), TTC_MAX),  # 100 - 2 x 2 x 30 < 0: never meets
        (mttc, following(20.0, 20.0, 10.0, -2.0, 0.0), (10.0 - math.sqrt(100.0 - 80.0)) / 2.0),
        (
            mttc,
            following(8.0, 10.0, 12.0, 2.0, -2.0),
            (2.0 + math.sqrt(4.0 + 2 * 4.0 * 8.0)) / 4.0,
        ),  # first opens
        (mttc, following(30.0, 10.0, 20.0, 0.0, 0.0), TTC_MAX),
        (thw, following(30.0, 20.0, 10.0), 1.5),
        (thw, following(30.0, 0.0, 10.0), TTC_MAX),
        (drac, following(25.0, 20.0, 10.0), 2.0),
        (drac, following(25.0, 10.0, 20.0), 0.0),
        (drac, following(0.1, 20.0, 10.0), DECELERATION_MAX),  # 500 m/s^2, capped
        (required_deceleration, following(25.0, 20.0, 10.0), 2.0),
        # equal at 12 m/s after 2 s, in which the lead drives 28 m and the ego 40 - 8 = 32 m
        (required_deceleration, following(4.0, 20.0, 16.0, 0.0, -2.0), 4.0),
        # the lead stops from 10 m/s in 10 m; the ego has 30 m for 20 m/s
        (required_deceleration, following(20.0, 20.0, 10.0, 0.0, -5.0), 400.0 / 60.0),
        (required_deceleration, following(15.0, 10.0, 10.0, 0.0, -5.0), 100.0 / 50.0),
        (required_deceleration, following(15.0, 10.0, 10.0, 0.0, 5.0), 0.0),  # a lead that speeds up
        (required_deceleration, following(25.0, 20.0, 0.0), 8.0),  # stands
        (btn, following(25.0, 20.0, 10.0), 0.4),
        (evasive_manoeuvre, following(25.0, 20.0, 10.0), 0.0),
        (evasive_manoeuvre, following(25.0, 20.0, 20.0, 6.0, 0.0), 0.0),  # speeds up
        (evasive_manoeuvre, following(25.0, 20.0, 20.0, -0.75 * 9.80665, 0.0), 1.5),
        (partial(btn, brakes=8.0), following(25.0, 20.0, 10.0), 0.25),
        (ttb, following(25.0, 20.0, 10.0), 1.5),  # 2.5 s less 10 / (2 x 5)
        (ttb, following(5.0, 20.0, 10.0), -0.5),  # half a second too late
        (partial(ttb, brakes=10.0), following(5.0, 20.0, 10.0), 0.0),
        (ttb, following(25.0, 10.0, 20.0), TTC_MAX),
        (tet, following(25.0, 20.0, 10.0), 1.0),
        (tet, following(31.0, 20.0, 10.0), 0.0),
        (tit, following(25.0, 20.0, 10.0), 0.5),
        (tit, following(31.0, 20.0, 10.0), 0.0),
        (ttc_2d, following(25.0, 20.0, 10.0), 2.5),
        (clearance, following(25.0, 20.0, 10.0), 25.0),
        (clearance, moment((0.0, 0.0, 0.0, 20.0), (8.0, 6.0, 0.0, 20.0), (-9.0, 0.0, 0.0, 20.0)), 4.0),
        (ttc_2d, moment((0.0, 0.0, 0.0, 20.0), (0.0, 4.0, 0.0, 20.0)), TTC_MAX),
        (ttc_2d, moment((0.0, 0.0, math.pi / 4, 20.0), lanes=1), 2.0 / (20.0 * math.sin(math.pi / 4))),
    ],
)
def test_by_hand(measure: object, now: Moment, value: float) -> None:
    assert callable(measure)
    assert measure(now).item() == pytest.approx(value, abs=1e-9)


def random_moment(count: int) -> tuple[Tensor, ...]:
    rng = np.random.default_rng(11)
    x = np.column_stack((np.zeros(count), rng.uniform(8.0, 25.0, count), rng.uniform(-30.0, 60.0, (count, 2))))
    y = np.column_stack((rng.normal(0.0, 0.3, (count, 2)), rng.uniform(3.0, 5.0, (count, 2))))
    heading, speed = rng.normal(0.02, 0.02, (count, 4)), rng.uniform(5.0, 25.0, (count, 4))
    before = speed - rng.uniform(-0.3, 0.3, (count, 4))
    return tuple(torch.from_numpy(each) for each in (x, y, heading, speed, before))


def of_tensors(function: object, x: Tensor, y: Tensor, heading: Tensor, speed: Tensor, before: Tensor) -> Tensor:
    state, road = State(x, y, heading, speed, x[:, :0]), straight(2)
    assert callable(function)
    result: Tensor = function(Moment(state, lead_of(state, road), road, None, state._replace(speed=before)))
    return result


MOMENTS = [name for name, measure in MEASURES.items() if isinstance(measure, Measure) and name != "lidar_ttc"]


@pytest.mark.parametrize("name", [name for name in MOMENTS if name != "tet"])
def test_gradient(name: str) -> None:
    function = MEASURES[name].of  # type: ignore[attr-defined]
    inputs = tuple(each.requires_grad_() for each in random_moment(6))
    assert torch.autograd.gradcheck(partial(of_tensors, function), inputs, atol=1e-4, rtol=1e-3)
    slopes = torch.autograd.grad(of_tensors(function, *inputs).sum(), inputs, allow_unused=True)
    found = torch.stack([slope for slope in slopes if slope is not None])
    assert torch.isfinite(found).all()
    assert found.abs().sum() > 0


@pytest.mark.parametrize("name", MOMENTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_are_finite_and_keep_their_dtype_anywhere(name: str, dtype: torch.dtype) -> None:
    rng = np.random.default_rng(7)
    sizes = [rng.uniform(*span, (300, 4)) for span in ((-60, 60), (-6, 10), (-1.0, 1.0), (0.0, 40.0))]
    sizes[3][:40] = 0.0  # a standstill
    sizes[2][:60] = 0.0
    x, y, heading, speed = (torch.from_numpy(each).to(dtype) for each in sizes)
    for road in (straight(2), i80()):
        state = State(x + 100.0, y, heading, speed, x[:, :0])
        for before in (None, state._replace(speed=speed.flip(0))):
            now = Moment(state, lead_of(state, road), road, None, before)
            value = MEASURES[name].of(now)  # type: ignore[attr-defined]
            assert value.shape == (300,)
            assert value.dtype == dtype
            assert torch.isfinite(value).all()
            f = MEASURES[name].f(MEASURES[name].start(now, 10))
            assert (f > MEASURES[name].collision).all() if name != "margin" else (f > 0).all()  # type: ignore[attr-defined]


class Steps(EpisodeMeasure):
    """Counts moments after the first."""

    def start(self, moment: Moment, ticks: int) -> Tensor:
        return torch.zeros_like(moment.state.x[:, 0])

    def update(self, state: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        return state + 1

    def f(self, state: Tensor) -> Tensor:
        return state


def test_a_measure_of_ones_own_needs_three_methods() -> None:
    measure = Steps()
    assert (measure.sees, measure.records, measure.unit) == (False, False, "")
    assert find_measure(measure) is measure
    assert problem(measure, horizon=2.0).evaluate(np.array([[20.0, 20.0, 50.0]])).tolist() == [20.0]


def test_what_only_looks_like_a_measure_is_refused() -> None:
    class Undeclared:
        start, update, f = Steps.start, Steps.update, Steps.f

    with pytest.raises(ValueError, match="Unknown measure"):
        find_measure(Undeclared())
