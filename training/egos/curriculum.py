"""Curriculum of the ego `vision`: following, cut-ins, hard brakes and the I-80, on many roads in all weathers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.vision import OBSERVATION
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import SPEED_RANGE, Others, Scenario, columns
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import scenario_named
from rare_envs.sensors.camera.context import CLEAR, SENSOR_NOISE_DISTRIBUTION, SUN_DISTRIBUTION
from rare_envs.sensors.lidar import perceive_traffic
from rare_envs.simulation.background import Background, TrafficBackground, find_drivers
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.sensing import Sensing
from rare_envs.simulation.world import World
from rare_envs.traffic.road import ReferenceLine, Road, i80
from rare_envs.traffic.state import VEHICLE_LENGTH, State
from training.egos.nominal_traffic import OrdinaryDrivers, draw_starts, make_ordinary_traffic

Array = NDArray[np.float64]
LEAD_RETURN_RATE = 0.2
"""Rate [1/s] at which the lead returns to its usual speed."""
HIGHWAY_VEHICLES = 6
"""Vehicles of the scenario `highway`, in which the ego is also moved back and into any lane."""


@dataclass(frozen=True)
class CurriculumSettings:
    """Ranges and shares that situations are drawn from; pairs are the ends of uniform distributions.

    They are those with which the shipped ego was trained. Ranges are wide, so that dangerous situations are common;
    shares say how often a rare kind of situation is seen.
    """

    top_speed: float = 32.0
    """Largest speed of the ego at the start [m/s], 115 km/h."""
    slow_share: float = 0.25
    """Share of egos that crawl, as in a jam."""
    slow_speeds: tuple[float, float] = (0.0, 6.0)
    """Their speeds [m/s]."""
    least_speed: float = 2.0
    """Least speed of the other egos [m/s]."""
    speed_std: float = 4.0
    """Standard deviation of the lead's speed about the ego's [m/s]."""
    lead_excess: float = 5.0
    """Speed by which a lead may exceed the fastest ego [m/s]."""
    far_share: float = 0.15
    """Share of leads that are out of sight."""
    far_gap: float = 200.0
    """Gap to these [m], the end of the parameter's range."""
    far_excess: float = 10.0
    """Speed by which they exceed the fastest ego [m/s], so that they stay out of sight."""
    standstill: float = 2.0
    """Gap [m] at speed 0 behind a lead."""
    headways: tuple[float, float] = (0.3, 3.5)
    """Time headways behind a lead [s]."""
    swings: tuple[float, float] = (0.0, 1.5)
    """Amplitudes of the lead's acceleration [m/s^2]."""
    swing_share: float = 0.6
    """Share of leads that swing at all."""
    swing_lengths: tuple[float, float] = (100.0, 600.0)
    """Way of the lead from one swing to the next [m]."""
    beside: float = 3.75
    """Lateral distance of the vehicle in the next lane [m], a lane's width."""
    ahead: tuple[float, float] = (-20.0, 60.0)
    """Its place along the road [m]."""
    other_speed_std: float = 3.0
    """Standard deviation of the speed of a vehicle in the next lane about the ego's [m/s]."""
    other_top_speed: float = 45.0
    """Largest speed of such a vehicle [m/s]."""
    cut_in_gaps: tuple[float, float] = (2.0, 60.0)
    """Gaps from the ego to the vehicle that cuts in [m]."""
    cut_in_lead_gaps: tuple[float, float] = (5.0, 100.0)
    """Gaps from that vehicle to the lead [m]."""
    cut_in_offsets: tuple[float, float] = (3.2, 4.5)
    """Its lateral distance at the start [m]."""
    brake_least_speed: float = 3.0
    """Least speed before a hard brake [m/s]."""
    brake_standstill: float = 3.0
    """Gap [m] at speed 0 before a hard brake."""
    brake_headways: tuple[float, float] = (0.8, 3.0)
    """Time headways before a hard brake [s]."""
    brakings: tuple[float, float] = (0.5, 6.0)
    """Decelerations of the lead [m/s^2]."""
    i80_share: float = 1 / 3
    """Share of ordinary traffic that drives on the I-80."""
    straight_share: float = 1 / 3
    """Share of the other roads that are straight."""
    most_lanes: int = 4
    lane_widths: tuple[float, ...] = (3.6, 3.75, 4.0)
    """Widths of lanes [m]: 3.6 m in the US, 3.75 m in Germany, and the 4 m of `FOLLOWING`."""
    largest_curvature: float = 1 / 400
    """Largest of curved roads [1/m]; the I-80 has about a third."""
    curve_points: int = 7
    """Points at which the curvature of a road is drawn."""
    curve_spacing: float = 80.0
    """Distance between them [m]."""
    clear_share: float = 0.5
    """Share of clear days."""
    fog: tuple[float, float] = (5e-5, 1e-2)
    """Extinction coefficients of fog [1/m], uniform in the logarithm; the largest is a visibility of 300 m."""
    offset_std: float = 0.5
    """Standard deviation of the ego's lateral offset at the start [m]."""
    largest_offset: float = 1.4
    """Largest such offset [m]."""
    heading_std: float = 0.03
    """Standard deviation of its heading [rad]."""
    largest_heading: float = 0.09
    """Largest such heading [rad], three standard deviations."""
    moved_share: float = 0.6
    """Share of egos of the scenario `highway` that are moved back and into any lane."""
    moved_back: tuple[float, float] = (25.0, 70.0)
    """Distances that these are moved back [m]."""


CURRICULUM = CurriculumSettings()
"""Settings of the curriculum of the ego `vision`."""


class Situation(NamedTuple):
    """Traffic to train in."""

    scenario: Callable[[np.random.Generator], Scenario]
    """Draws a scenario, with another road each time."""
    sample: Callable[[int, np.random.Generator], Array]
    """Draws the scenario's own columns of x, shape (n, d)."""
    drivers: Background | TrafficBackground | None = None
    """Drivers of the other vehicles; None for those of the scenario."""


def _initial(x: Tensor) -> State:
    """Return the initial state; columns as in `FOLLOWING`.

    theta: amplitude of the lead's acceleration [m/s^2], wave length [m] and usual speed of the lead [m/s].
    """
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
    acceleration = swing * torch.sin(2 * math.pi / length * x[:, 0]) + LEAD_RETURN_RATE * (usual - speed[:, 0])
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
    """Draw speeds of the ego, some of them slow, and speeds near those [m/s]."""
    c = CURRICULUM
    slow = rng.random(n) < c.slow_share
    own = np.where(slow, rng.uniform(*c.slow_speeds, n), rng.uniform(c.least_speed, c.top_speed, n))
    return own, np.clip(own + rng.normal(0.0, c.speed_std, n), 0.0, c.top_speed + c.lead_excess)


def _draw_following(n: int, rng: np.random.Generator) -> Array:
    """Draw columns of `FOLLOWING`, shape (n, 8)."""
    c = CURRICULUM
    own, lead = _draw_speeds(n, rng)
    far = rng.random(n) < c.far_share
    gap = np.where(far, c.far_gap, c.standstill + own * rng.uniform(*c.headways, n))
    lead = np.where(far, c.top_speed + c.far_excess, lead)
    swing = rng.uniform(*c.swings, n) * (rng.random(n) < c.swing_share)
    side = rng.choice((-1.0, 1.0), n) * c.beside
    other = np.clip(own + rng.normal(0.0, c.other_speed_std, n), 0.0, c.other_top_speed)
    return np.column_stack(
        (own, lead, gap, swing, rng.uniform(*c.swing_lengths, n), side, rng.uniform(*c.ahead, n), other)
    )


def _draw_cut_in(n: int, rng: np.random.Generator) -> Array:
    """Draw columns of the cut-in, shape (n, 6)."""
    c = CURRICULUM
    own, lead = _draw_speeds(n, rng)
    cutter = np.clip(own + rng.normal(0.0, c.other_speed_std, n), 0.0, c.other_top_speed)
    gaps = rng.uniform(*c.cut_in_gaps, n), rng.uniform(*c.cut_in_lead_gaps, n)
    return np.column_stack((own, cutter, lead, *gaps, rng.uniform(*c.cut_in_offsets, n)))


def _draw_hard_brake(n: int, rng: np.random.Generator) -> Array:
    """Draw columns of the hard brake, shape (n, 3)."""
    c = CURRICULUM
    own = rng.uniform(c.brake_least_speed, c.top_speed, n)
    gap = c.brake_standstill + own * rng.uniform(*c.brake_headways, n)
    return np.column_stack((own, gap, rng.uniform(*c.brakings, n)))


def _draw_highway(n: int, rng: np.random.Generator) -> Array:
    """Draw columns of the highway from its own base."""
    return load_base(scenario_named("highway")).sample(n, rng)


def make_situations() -> tuple[Situation, ...]:
    """Return all situations, in the order in which they are taken; the common ones twice."""

    def somewhere(scenario: Scenario) -> Callable[[np.random.Generator], Scenario]:
        return lambda rng: replace(scenario, road=draw_road(rng))

    def in_traffic(rng: np.random.Generator) -> Scenario:
        if rng.random() < CURRICULUM.i80_share:
            return make_ordinary_traffic("traffic", i80(), int(rng.integers(1, 5)))
        road = draw_road(rng, least=3)
        inner = 1 if road.lanes == 3 else int(rng.integers(1, road.lanes - 1))
        return make_ordinary_traffic("traffic", road, inner)

    following, highway = Situation(somewhere(FOLLOWING), _draw_following), scenario_named("highway")
    traffic = Situation(in_traffic, draw_starts, OrdinaryDrivers())
    return (
        traffic,
        following,
        Situation(lambda rng: highway, _draw_highway, find_drivers(highway.drivers)),
        Situation(somewhere(scenario_named("rare_envs/CutIn-v0")), _draw_cut_in),
        traffic,
        following,
        Situation(somewhere(scenario_named("hard_brake")), _draw_hard_brake),
    )


def draw_road(rng: np.random.Generator, least: int = 1) -> Road:
    """Draw a road of `least` to four lanes, one of them centred on y = 0; one in three is straight."""
    lanes, width = int(rng.integers(least, CURRICULUM.most_lanes + 1)), float(rng.choice(CURRICULUM.lane_widths))
    own = int(rng.integers(0, lanes))
    edges = tuple(width * (k - own - 0.5) for k in range(lanes + 1))
    if rng.random() < CURRICULUM.straight_share:
        return Road(edges)
    curvature = rng.uniform(-CURRICULUM.largest_curvature, CURRICULUM.largest_curvature, CURRICULUM.curve_points)
    curvature -= curvature.mean()  # it returns to its first direction
    return Road(edges, ReferenceLine(CURRICULUM.curve_spacing, (0.0, *(0.5 * curvature), 0.0)))


def start_situation(situation: Situation, rows: int, seconds: float, rng: np.random.Generator) -> tuple[World, Episode]:
    """Start a situation with egos in or beside their lanes.

    Args:
        situation: Traffic to train in.
        rows: Number of scenarios B.
        seconds: Length of the episodes.
        rng: Source of roads, scenarios and places.

    Returns:
        The world and the episodes at time 0.
    """
    scenario = situation.scenario(rng)
    world = World(scenario, Sensing(OBSERVATION, weather=True), situation.drivers, clock=Clock(horizon=seconds))
    own = situation.sample(rows, rng)
    parts = [own, _draw_weather(rows, rng)]
    if world.background is not None and world.background.weights is not None:
        parts.append(world.background.weights.sample(rows, rng))
    parts.append(rng.standard_normal((rows, world.columns.noise + world.columns.camera_noise)))
    start = world.start(torch.from_numpy(np.concatenate(parts, axis=1)).float())
    state = _displace_ego(start.state, scenario, rng)
    perception = perceive_traffic(state, scenario.road) if world.uses_lidar else None
    return world, world.start_from(state, perception, start.background_state, start.camera_context)


def _draw_weather(n: int, rng: np.random.Generator) -> Array:
    """Draw weather: half of the days are clear; on the others the fog is thicker than in the base distribution."""
    least, most = CURRICULUM.fog
    fog = np.exp(rng.uniform(math.log(least), math.log(most), (n, 1)))
    some = np.concatenate((fog, SUN_DISTRIBUTION.sample(n, rng), SENSOR_NOISE_DISTRIBUTION.sample(n, rng)), axis=1)
    clear = np.array([CLEAR[0], math.degrees(CLEAR[1]), math.degrees(CLEAR[2]), 0.0])
    return np.where(rng.random((n, 1)) < CURRICULUM.clear_share, clear, some)


def _displace_ego(state: State, scenario: Scenario, rng: np.random.Generator) -> State:
    """Displace and turn the ego in its lane; on the highway also move it back and into any lane."""
    n, c = len(state.x), CURRICULUM
    offset = np.clip(rng.normal(0.0, c.offset_std, n), -c.largest_offset, c.largest_offset)
    x, y = state.x[:, 0].double().numpy(), state.y[:, 0].double().numpy() + offset
    heading = np.clip(rng.normal(0.0, c.heading_std, n), -c.largest_heading, c.largest_heading)
    if scenario.vehicles == HIGHWAY_VEHICLES:
        moved = rng.random(n) < c.moved_share
        lane = np.array([scenario.road.centre(k) for k in range(scenario.road.lanes)])
        old = np.asarray(scenario.road.centre_of(state.y[:, 0]))
        y = np.where(moved, y - old + rng.choice(lane, n), y)
        x = np.where(moved, x - rng.uniform(*c.moved_back, n), x)

    def with_ego(field: Tensor, values: Array) -> Tensor:
        return torch.cat((torch.from_numpy(values).to(field)[:, None], field[:, 1:]), dim=1)

    return state._replace(x=with_ego(state.x, x), y=with_ego(state.y, y), heading=with_ego(state.heading, heading))
