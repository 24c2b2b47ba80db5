"""Ordinary traffic: roads, starts and drivers in which an ego that drives properly is safe for minutes.

The ego follows a lead in the middle of several lanes, with a follower behind it and a vehicle in each lane beside it.
All of them keep to their lanes. Their speeds vary as recorded ones do, and a vehicle that approaches another brakes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from types import MappingProxyType
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents import load_driver
from agents.learned.coloured_noise import HUMAN_NOISE, AutoregressiveNoise
from agents.learned.rule_driver import RuleDriver
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import SPEED_RANGE, Others, Scenario, columns
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.highway import HIGHWAY
from rare_envs.sensors.lidar import SPEED_COLUMN
from rare_envs.simulation.background import Background, DriverWeights, TrafficBackground
from rare_envs.traffic.road import ReferenceLine, Road, i80, straight
from rare_envs.traffic.state import LANE_WIDTH, VEHICLE_LENGTH, State

SECONDS = 60.0
"""Length of a rollout [s]."""
FLOOR_HEADWAY, FLOOR_GAP = 0.5, 1.0
"""Nobody should drive closer than this [s] to the lead, nor than this [m]: of the recorded starts of car-following on
US 101, one in twenty is closer than 0.5 s."""
START_HEADWAY = 0.8
"""Least time headway at the start [s]: 87 % of the recorded ones have more."""
COMFORTABLE = 2.0
"""Braking [m/s^2] at which the start must leave the floor to the ego."""
SWAY = 0.72
"""Standard deviation of recorded accelerations [m/s^2]."""
RETURN = 60.0
"""Time [s] in which a speed goes back to what it was at the start. Recorded speeds spread by 2.0 to 4.8 m/s (10 and
90 %) over 640 m of US 101."""
_NEIGHBOURS = ("follower", "left", "right")


@dataclass(frozen=True)
class OrdinaryDrivers:
    """Drivers whose speeds vary about those at the start, with IDM behind a lead; steering is the scenario's."""

    rule: RuleDriver = RuleDriver()  # noqa: RUF009  (frozen)
    colour: AutoregressiveNoise = HUMAN_NOISE
    weights: ClassVar[DriverWeights | None] = None
    noisy: ClassVar[bool] = True

    def begin(self, draws: Tensor) -> Tensor:
        """Return the memory: of the noise, then the speed at the start, NaN as yet: (B, M, 2, 2) -> (B, M, 5)."""
        noise = self.colour.begin(draws).flatten(-2)
        return torch.cat((noise, torch.full_like(noise[..., :1], torch.nan)), dim=-1)

    def act(
        self, features: Tensor, weights: Tensor | None, innovations: Tensor | None, memory: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Decide for one tick; see `rare_envs.simulation.background.Background`."""
        assert memory is not None
        speed = features[..., SPEED_COLUMN]
        wanted = torch.where(memory[..., 4].isnan(), speed, memory[..., 4])
        noise, swings = torch.zeros_like(features[..., :2]), memory[..., :4].reshape(*speed.shape, 2, 2)
        if innovations is not None:
            noise, swings = self.colour.step(swings, innovations)
        action, _ = self.rule.act(features)
        freely = SWAY * noise[..., 0] + (wanted - speed) / RETURN
        acceleration = torch.minimum(freely, action[..., 0])
        memory = torch.cat((swings.flatten(-2), wanted[..., None]), dim=-1)
        return torch.stack((acceleration, action[..., 1]), dim=-1), memory


@cache
def make_bends() -> Road:
    """Return three lanes that wind with radii down to 1 km, 3.6 times as sharply as the I-80 does, for 2.4 km."""
    sharpest = 1e-3
    return Road(straight(3).edges, ReferenceLine(75.0, (0.0, *(sharpest, 0.0, -sharpest, 0.0) * 8)))


def make_ordinary_traffic(name: str, road: Road, lane: int) -> Scenario:
    """Return the scenario of traffic around an ego in one of the inner lanes of a road."""

    def initial(x: Tensor) -> State:
        speed, lead_speed, gap, start, offset, heading, behind, left, right, *others = x.unbind(dim=1)
        middle = [torch.full_like(gap, road.centre(k)) for k in (lane, lane, lane, lane - 1, lane + 1)]
        zero = torch.zeros_like(gap)
        along = (zero, gap + VEHICLE_LENGTH, -behind - VEHICLE_LENGTH, left, right)
        return State(
            x=columns(*along) + start[:, None],
            y=columns(middle[0] + offset, *middle[1:]),
            heading=columns(torch.deg2rad(heading), *[zero] * 4),
            speed=columns(speed, lead_speed, *others),
            theta=x[:, :0],
        )

    def driven(state: State, action: Tensor, dt: float) -> Others:
        x, y, speed = state.x[:, 1:], state.y[:, 1:], state.speed[:, 1:]
        ahead = speed * dt / (1.0 - road.curvature(x) * y)
        return Others(x + ahead, y, state.heading[:, 1:], (speed + action[..., 0] * dt).clamp(min=0.0))

    def others(state: State, dt: float) -> Others:
        return driven(state, torch.zeros_like(state.x[:, 1:, None]).expand(-1, -1, 2), dt)

    return Scenario(
        name=name,
        road=road,
        vehicle_names=("ego", "lead", *_NEIGHBOURS),
        horizon=SECONDS,
        parameters=(
            *CAR_FOLLOWING.parameters,
            Parameter("start", "m", 0.0, 100.0, "initial place of the ego along the road"),
            Parameter("offset", "m", -0.25, 0.25, "initial place of the ego to the right of its lane's middle"),
            Parameter("heading", "deg", -1.0, 1.0, "initial heading of the ego relative to the road"),
            Parameter("follower_gap", "m", 1.0, 150.0, "initial gap from the follower to the ego"),
            Parameter("left", "m", -60.0, 60.0, "initial place of the vehicle on the left relative to the ego"),
            Parameter("right", "m", -60.0, 60.0, "and of that on the right"),
            *(Parameter(f"{who}_speed", *SPEED_RANGE, "initial speed") for who in _NEIGHBOURS),
        ),
        bases=CAR_FOLLOWING.bases,
        initial=initial,
        others=others,
        driven=driven,
    )


def draw_starts(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw starts of `make_ordinary_traffic`: `us101-gap` car-following in which nobody is too close or comes too fast.

    Returns:
        Parameters, shape (n, 12).
    """
    base, starts = load_base(CAR_FOLLOWING, "us101-gap"), np.empty((0, 3))
    while len(starts) < n:
        drawn = base.sample(2 * n, rng)
        starts = np.concatenate((starts, drawn[_is_nominal(drawn)]))
    speed, lead_speed, gap = starts[:n].T
    uniform = partial(rng.uniform, size=n)
    others = [(speed + uniform(-2.0, 2.0)).clip(min=0.0) for _ in _NEIGHBOURS]
    return np.column_stack(
        (
            *(speed, lead_speed, gap, uniform(0.0, 100.0), uniform(-0.25, 0.25), uniform(-1.0, 1.0)),
            *((5.0 + speed * uniform(1.2, 3.0)).clip(max=150.0), uniform(-60.0, 60.0), uniform(-60.0, 60.0)),
            *others,
        )
    )


def _is_nominal(x: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which starts (n, 3) leave the floor to an ego that brakes comfortably, shape (n,)."""
    speed, lead_speed, gap = x.T
    left = gap - np.maximum(speed - lead_speed, 0.0) ** 2 / (2.0 * COMFORTABLE)
    floor = np.maximum(FLOOR_HEADWAY * np.minimum(speed, lead_speed), 2.0 * FLOOR_GAP)
    return np.asarray((left >= floor) & (gap >= START_HEADWAY * speed))


@dataclass(frozen=True)
class Case:
    """A kind of traffic that an ego is judged in."""

    scenario: Scenario
    drivers: Callable[[], Background | TrafficBackground]
    starts: Callable[[int, np.random.Generator], NDArray[np.float64]]
    """Of the scenario's own parameters, shape (n, d)."""


def _highway_starts(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(load_base(HIGHWAY).sample(n, rng))


CASES = MappingProxyType(
    {
        "straight": Case(make_ordinary_traffic("straight", straight(3, LANE_WIDTH), 1), OrdinaryDrivers, draw_starts),
        "i80": Case(make_ordinary_traffic("i80", i80(), 2), OrdinaryDrivers, draw_starts),
        "bends": Case(make_ordinary_traffic("bends", make_bends(), 1), OrdinaryDrivers, draw_starts),
        "highway": Case(HIGHWAY, partial(load_driver, "mgail?rules=0"), _highway_starts),
    }
)
"""A straight road, the I-80 as it is, a road that winds more, and `rare_envs/Highway-v0` with its learned drivers."""
