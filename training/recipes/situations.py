"""Situations in which the ego `vision` is trained: following, cut-ins, hard brakes and the I-80, in all weathers.

Ranges are wide, so that dangerous situations are common; shares say how often a rare kind of situation is seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.vision import OBSERVATION
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import SPEED_RANGE, Others, Scenario, columns, load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.sensors.camera import CLEAR, SENSOR_NOISE_DISTRIBUTION, SUN_DISTRIBUTION
from rare_envs.sensors.lidar import perceive_traffic
from rare_envs.simulation.background import Background, TrafficBackground, find_drivers
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.settings import Clock, Sensing
from rare_envs.simulation.world import World
from rare_envs.traffic.road import ReferenceLine, Road, i80
from rare_envs.traffic.state import VEHICLE_LENGTH, State
from training.recipes.ordinary_traffic import OrdinaryDrivers, draw_starts, make_ordinary_traffic

Array = NDArray[np.float64]
TOP_SPEED = 32.0
"""Largest speed of the ego at the start [m/s], 115 km/h."""


class Situation(NamedTuple):
    """Traffic to train in."""

    scenario: Callable[[np.random.Generator], Scenario]
    """Draws a scenario, with another road each time."""
    sample: Callable[[int, np.random.Generator], Array]
    """Draws the scenario's own columns of x, shape (n, d)."""
    drivers: Background | TrafficBackground | None = None
    """Drivers of the other vehicles; None for those of the scenario."""


def _initial(x: Tensor) -> State:
    """Return the initial state; theta: amplitude of the lead's acceleration, wave length and its usual speed."""
    ego_speed, lead_speed, gap, swing, length, beside, ahead, other_speed = x.unbind(dim=1)
    zero = torch.zeros_like(gap)
    return State(
        x=columns(zero, gap + VEHICLE_LENGTH, ahead),
        y=columns(zero, zero, beside),
        heading=columns(zero, zero, zero),
        speed=columns(ego_speed, lead_speed, other_speed),
        theta=columns(swing, length, lead_speed),
    )


def _step_others(state: State, dt: float) -> Others:
    """Step the others: the lead oscillates about its usual speed, the vehicle in the next lane keeps its speed."""
    swing, length, usual = state.theta.unbind(dim=1)
    speed, x = state.speed[:, 1:], state.x[:, 1:]
    acceleration = swing * torch.sin(2 * math.pi / length * x[:, 0]) + 0.2 * (usual - speed[:, 0])
    after = columns((speed[:, 0] + acceleration * dt).clamp(min=0.0), speed[:, 1])
    return Others(x + speed * dt, state.y[:, 1:], state.heading[:, 1:], after)


FOLLOWING = Scenario(
    name="following",
    road=Road((-2.0, 2.0)),
    vehicle_names=("ego", "lead", "other"),
    horizon=20.0,
    parameters=(
        Parameter("ego_speed", *SPEED_RANGE, "of the ego at the start"),
        Parameter("lead_speed", *SPEED_RANGE, "usual speed of the lead"),
        Parameter("gap", "m", 1.0, 200.0, "from ego to lead at the start"),
        Parameter("swing", "m/s^2", 0.0, 2.0, "largest acceleration of the lead"),
        Parameter("length", "m", 50.0, 1000.0, "way of the lead from one of its swings to the next"),
        Parameter("beside", "m", -5.0, 5.0, "lateral place of the vehicle in the next lane"),
        Parameter("ahead", "m", -500.0, 200.0, "its place along the road"),
        Parameter("other_speed", *SPEED_RANGE, "its speed"),
    ),
    bases={"any": {"alpha": [1.0] * 8, "beta": [1.0] * 8}},
    initial=_initial,
    others=_step_others,
    driven=lambda state, action, dt: _step_others(state, dt),
)


def _draw_speeds(n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw speeds of the ego, a quarter of them as in a jam, and speeds near those [m/s]."""
    slow = rng.random(n) < 0.25
    own = np.where(slow, rng.uniform(0.0, 6.0, n), rng.uniform(2.0, TOP_SPEED, n))
    return own, np.clip(own + rng.normal(0.0, 4.0, n), 0.0, TOP_SPEED + 5.0)


def _draw_following(n: int, rng: np.random.Generator) -> Array:
    """Draw columns of `FOLLOWING`, shape (n, 8): headways of 0.3 to 3.5 s, and in 15 % a lead that is out of sight."""
    own, lead = _draw_speeds(n, rng)
    far = rng.random(n) < 0.15
    gap = np.where(far, 200.0, 2.0 + own * rng.uniform(0.3, 3.5, n))
    lead = np.where(far, TOP_SPEED + 10.0, lead)
    swing = rng.uniform(0.0, 1.5, n) * (rng.random(n) < 0.6)
    side = rng.choice((-1.0, 1.0), n) * 3.75
    other = np.clip(own + rng.normal(0.0, 3.0, n), 0.0, 45.0)
    return np.column_stack(
        (own, lead, gap, swing, rng.uniform(100.0, 600.0, n), side, rng.uniform(-20.0, 60.0, n), other)
    )


def _draw_cut_in(n: int, rng: np.random.Generator) -> Array:
    """Draw columns of the cut-in, shape (n, 6)."""
    own, lead = _draw_speeds(n, rng)
    cutter = np.clip(own + rng.normal(0.0, 3.0, n), 0.0, 45.0)
    gaps = rng.uniform(2.0, 60.0, n), rng.uniform(5.0, 100.0, n)
    return np.column_stack((own, cutter, lead, *gaps, rng.uniform(3.2, 4.5, n)))


def _draw_hard_brake(n: int, rng: np.random.Generator) -> Array:
    """Draw columns of the hard brake, shape (n, 4): headways of 0.8 to 3 s, peaks of 0.5 to 6 m/s^2, half to a stop."""
    own = rng.uniform(3.0, TOP_SPEED, n)
    gap, peak = 3.0 + own * rng.uniform(0.8, 3.0, n), rng.uniform(0.5, 6.0, n)
    return np.column_stack((own, gap, peak, np.maximum(own * rng.uniform(0.2, 1.8, n), 1.0)))


def make_situations() -> tuple[Situation, ...]:
    """Return all situations, in the order in which they are taken; the common ones twice."""

    def somewhere(scenario: Scenario) -> Callable[[np.random.Generator], Scenario]:
        return lambda rng: replace(scenario, road=draw_road(rng))

    def in_traffic(rng: np.random.Generator) -> Scenario:
        if rng.random() < 1 / 3:
            return make_ordinary_traffic("traffic", i80(), int(rng.integers(1, 5)))
        road = draw_road(rng, least=3)
        inner = 1 if road.lanes == 3 else int(rng.integers(1, road.lanes - 1))
        return make_ordinary_traffic("traffic", road, inner)

    following, highway = Situation(somewhere(FOLLOWING), _draw_following), find_scenario("highway")
    traffic = Situation(in_traffic, draw_starts, OrdinaryDrivers())
    return (
        traffic,
        following,
        Situation(lambda rng: highway, load_base(highway).sample, find_drivers(highway.drivers)),
        Situation(somewhere(find_scenario("rare_envs/CutIn-v0")), _draw_cut_in),
        traffic,
        following,
        Situation(somewhere(find_scenario("hard_brake")), _draw_hard_brake),
    )


def draw_road(rng: np.random.Generator, least: int = 1) -> Road:
    """Draw a road of `least` to four lanes, one of them centred on y = 0; one in three is straight.

    Lanes are 3.6 m wide as in the US, 3.75 as in Germany, or 4; radii go down to 400 m, a third of the I-80's.
    """
    lanes, width = int(rng.integers(least, 5)), float(rng.choice((3.6, 3.75, 4.0)))
    own = int(rng.integers(0, lanes))
    edges = tuple(width * (k - own - 0.5) for k in range(lanes + 1))
    if rng.random() < 1 / 3:
        return Road(edges)
    curvature = rng.uniform(-1 / 400, 1 / 400, 7)
    curvature -= curvature.mean()  # it returns to its first direction
    return Road(edges, ReferenceLine(80.0, (0.0, *(0.5 * curvature), 0.0)))


def start_situation(situation: Situation, rows: int, seconds: float, rng: np.random.Generator) -> tuple[World, Episode]:
    """Return a world of so many scenarios, with episodes at time 0 of some length [s]."""
    scenario = situation.scenario(rng)
    world = World(scenario, Sensing(OBSERVATION, weather=True), situation.drivers, clock=Clock(horizon=seconds))
    own = situation.sample(rows, rng)
    parts = [own, _draw_weather(rows, rng)]
    if world.background is not None and world.background.weights is not None:
        parts.append(world.background.weights.sample(rows, rng))
    parts.append(rng.standard_normal((rows, world.columns["noise"] + world.columns["camera_noise"])))
    start = world.start(torch.from_numpy(np.concatenate(parts, axis=1)).float())
    state = _displace_ego(start.state, scenario, rng)
    perception = perceive_traffic(state, scenario.road) if world.uses_lidar else None
    return world, world.start_from(state, perception, start.background_state, start.camera_context)


def _draw_weather(n: int, rng: np.random.Generator) -> Array:
    """Draw weather: half of the days are clear; on the others the fog is thicker than in the traffic model."""
    fog = np.exp(rng.uniform(math.log(5e-5), math.log(1e-2), (n, 1)))
    some = np.concatenate((fog, SUN_DISTRIBUTION.sample(n, rng), SENSOR_NOISE_DISTRIBUTION.sample(n, rng)), axis=1)
    clear = np.array([CLEAR[0], math.degrees(CLEAR[1]), math.degrees(CLEAR[2]), 0.0])
    return np.where(rng.random((n, 1)) < 0.5, clear, some)


def _displace_ego(state: State, scenario: Scenario, rng: np.random.Generator) -> State:
    """Displace and turn the ego in its lane; on the highway also move most of them back and into any lane."""
    n = len(state.x)
    offset = np.clip(rng.normal(0.0, 0.5, n), -1.4, 1.4)
    x, y = state.x[:, 0].double().numpy(), state.y[:, 0].double().numpy() + offset
    heading = np.clip(rng.normal(0.0, 0.03, n), -0.09, 0.09)
    if scenario.vehicles == 6:  # the highway
        moved = rng.random(n) < 0.6
        lane = np.array([scenario.road.centre(k) for k in range(scenario.road.lanes)])
        old = np.asarray(scenario.road.centre_of(state.y[:, 0]))
        y = np.where(moved, y - old + rng.choice(lane, n), y)
        x = np.where(moved, x - rng.uniform(25.0, 70.0, n), x)

    def with_ego(values: Tensor, own: Array) -> Tensor:
        return torch.cat((torch.from_numpy(own).to(values)[:, None], values[:, 1:]), dim=1)

    return state._replace(x=with_ego(state.x, x), y=with_ego(state.y, y), heading=with_ego(state.heading, heading))
