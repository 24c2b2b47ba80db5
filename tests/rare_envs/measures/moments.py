"""Moments by hand, and drives of an ego that keeps its speed."""

import numpy as np
import torch

import rare_envs
from rare_envs.measures import Moment
from rare_envs.traffic.bodies import lead_of
from rare_envs.traffic.road import straight
from tests.rare_envs.interop.egos import Always
from tests.rare_envs.traffic_states import F64, traffic

COASTING = Always([0.0, 0.0])
Vehicle = tuple[float, float, float, float]
TIME = np.arange(0.0, 40.0, 2e-3)
FOLLOWING, CUT_IN = "rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0"
# 20 m/s behind 10 m/s at 100 m: no collision in 10 s (but at it); at 60 m after 6 s; 10 behind 20: never
CLOSE, HIT, AWAY = (20.0, 10.0, 100.5), (20.0, 10.0, 60.5), (10.0, 20.0, 30.0)


def moment(*vehicles: Vehicle, accelerations: tuple[float, ...] | None = None, lanes: int = 2) -> Moment:
    """One scenario on a straight road, with the accelerations of the last tick."""
    state, road = traffic(*vehicles), straight(lanes)
    before = None
    if accelerations is not None:
        before = state._replace(speed=state.speed - 0.1 * torch.tensor(accelerations, dtype=F64))
    return Moment(state, lead_of(state, road), road, None, before)


def following(gap: float, speed: float, lead_speed: float, *accelerations: float) -> Moment:
    """The ego behind a lead."""
    vehicles = (0.0, 0.0, 0.0, speed), (gap + 5.0, 0.0, 0.0, lead_speed)
    return moment(*vehicles, accelerations=accelerations or None)


def path(speed: float, acceleration: float, stops: bool) -> np.ndarray:
    """Way over `TIME` at constant acceleration; one that brakes may come to rest and stay."""
    time = TIME if not stops or acceleration >= 0 else np.minimum(TIME, speed / -acceleration)
    return speed * time + acceleration * time**2 / 2


def drives(rng: np.random.Generator, count: int) -> list[tuple[float, ...]]:
    low, high = (1.0, 0.5, 0.5, -4.0, -6.0), (60.0, 30.0, 30.0, 2.0, 2.0)
    return [tuple(row) for row in rng.uniform(low, high, (count, 5))]


def problem(measure: object, env_id: str = FOLLOWING, **kwargs: object) -> rare_envs.DrivingProblem:
    return rare_envs.DrivingProblem(env_id, ego=COASTING, measure=measure, **kwargs)


def f(measure: object, *x: float, **kwargs: object) -> float:
    return float(problem(measure, **kwargs).evaluate(np.array([x]))[0])
