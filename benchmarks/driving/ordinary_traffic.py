"""Does an ego drive properly in ordinary traffic, in which one that does is safe for minutes?

    python -m benchmarks.driving.ordinary_traffic --ego imitation

prints one JSON object: by case the rollouts passed and judged, the lower limit of a 95 % interval, the other verdicts.

The ego follows a lead in the middle of several lanes, with a follower behind it and a vehicle in each lane beside it.
All of them keep to their lanes. Their speeds vary as recorded ones do, and a vehicle that approaches another brakes.

An ego keeps its lane if its body never crosses a line of the lane that it starts in. It keeps its distance if it runs
into nobody and never follows its lead closer than 0.5 s or 1 m; after a lead cuts in closer than that it has 10 s.
It must also advance: an ego that covers less than half of the distance of its lead (or, without a lead, of that at its
first speed) is left behind. If another vehicle runs into it from behind or from the side, the rollout counts neither
way.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from agents import load_driver, load_ego
from agents.learned.driver import RuleDriver
from agents.learned.networks import HUMAN_NOISE
from rare_envs.distributions.space import Parameter
from rare_envs.egos.needs import resolve
from rare_envs.egos.policy import as_driver
from rare_envs.scenarios.base import SPEED_RANGE, Others, Scenario, columns, load_base
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.highway import HIGHWAY
from rare_envs.sensors.lidar import SPEED_COLUMN
from rare_envs.simulation.background import Background, TrafficBackground
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.settings import Clock, Measurement, Sensing
from rare_envs.simulation.world import Driver, World, drive
from rare_envs.traffic.bodies import lead_index
from rare_envs.traffic.crash import NONE, ROAD_EDGE
from rare_envs.traffic.road import ReferenceLine, Road, i80, straight
from rare_envs.traffic.state import LANE_WIDTH, VEHICLE_LENGTH, VEHICLE_WIDTH, State
from samplers.sample import clopper_pearson

FloatArray = NDArray[np.float64]
SECONDS = 60.0
"""Length of a rollout [s]."""
FLOOR_HEADWAY, FLOOR_GAP = 0.5, 1.0
"""Nobody should drive closer than this [s] to the lead, nor than this [m]: of the recorded starts of car-following on
US 101, one in twenty is closer than 0.5 s."""
START_HEADWAY, COMFORTABLE = 0.8, 2.0
"""Least time headway at the start [s] (87 % of the recorded ones have more), and the braking [m/s^2] at which the start
must leave the floor to the ego."""
SWAY, RETURN = 0.72, 60.0
"""Standard deviation of recorded accelerations [m/s^2], and the time [s] in which a speed goes back to what it was at
the start: recorded speeds spread by 2.0 to 4.8 m/s (10 and 90 %) over 640 m of US 101."""
GRACE, LEAST_WAY = 10.0, 0.5
"""Time [s] in which an ego must open the gap to a lead that has cut in, and the share of its lead's way to cover."""
VERDICT_NAMES = ("passed", "left its lane", "collided", "too close", "left behind", "hit by others")
"""Verdicts by number; a rollout gets the one that comes first in time, "left behind" at its end."""
PASSED, LEFT_LANE, COLLIDED, TOO_CLOSE, LEFT_BEHIND, HIT_BY_OTHER = range(len(VERDICT_NAMES))
_NEIGHBOURS = ("follower", "left", "right")


@dataclass(frozen=True)
class OrdinaryDrivers:
    """Drivers whose speeds vary about those at the start, with IDM behind a lead; steering is the scenario's."""

    weights: ClassVar[None] = None
    noisy: ClassVar[bool] = True

    def begin(self, draws: Tensor) -> Tensor:
        """Return the memory: of the noise, then the speed at the start, NaN as yet: (B, M, 2, 2) -> (B, M, 5)."""
        noise = HUMAN_NOISE.begin(draws).flatten(-2)
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
            noise, swings = HUMAN_NOISE.step(swings, innovations)
        action, _ = RuleDriver().act(features)
        acceleration = torch.minimum(SWAY * noise[..., 0] + (wanted - speed) / RETURN, action[..., 0])
        memory = torch.cat((swings.flatten(-2), wanted[..., None]), dim=-1)
        return torch.stack((acceleration, action[..., 1]), dim=-1), memory


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
        others=lambda state, dt: driven(state, torch.zeros_like(state.x[:, 1:, None]).expand(-1, -1, 2), dt),
        driven=driven,
    )


def draw_starts(n: int, rng: np.random.Generator) -> FloatArray:
    """Draw starts of `make_ordinary_traffic`: `us101-gap` car-following in which nobody is too close, shape (n, 12)."""
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


def _is_nominal(x: FloatArray) -> NDArray[np.bool_]:
    """Return which starts (n, 3) leave the floor to an ego that brakes comfortably, shape (n,)."""
    speed, lead_speed, gap = x.T
    left = gap - np.maximum(speed - lead_speed, 0.0) ** 2 / (2.0 * COMFORTABLE)
    floor = np.maximum(FLOOR_HEADWAY * np.minimum(speed, lead_speed), 2.0 * FLOOR_GAP)
    return np.asarray((left >= floor) & (gap >= START_HEADWAY * speed))


class Case(NamedTuple):
    """A kind of traffic that an ego is judged in; `starts` draws the scenario's own parameters, shape (n, d)."""

    scenario: Scenario
    drivers: Callable[[], Background | TrafficBackground]
    starts: Callable[[int, np.random.Generator], FloatArray]


_BENDS = Road(straight(3).edges, ReferenceLine(75.0, (0.0, *(1e-3, 0.0, -1e-3, 0.0) * 8)))
"""Three lanes that wind with radii down to 1 km, 3.6 times as sharply as the I-80 does, for 2.4 km."""
CASES = {
    "straight": Case(make_ordinary_traffic("straight", straight(3, LANE_WIDTH), 1), OrdinaryDrivers, draw_starts),
    "i80": Case(make_ordinary_traffic("i80", i80(), 2), OrdinaryDrivers, draw_starts),
    "bends": Case(make_ordinary_traffic("bends", _BENDS, 1), OrdinaryDrivers, draw_starts),
    "highway": Case(HIGHWAY, partial(load_driver, "mgail?rules=0"), load_base(HIGHWAY).sample),
}
"""A straight road, the I-80 as it is, a road that winds more, and `rare_envs/Highway-v0` with its learned drivers."""


def make_world(case: Case, seconds: float = SECONDS, observation: str = "features") -> World:
    """Return the world of a case, with the vehicles of each collision."""
    sensing, clock = Sensing(observation, lidar=True), Clock(horizon=seconds)
    return World(case.scenario, sensing, case.drivers(), Measurement(statistics=True), clock)


def draw_inputs(case: Case, world: World, n: int, own: int, rng: np.random.Generator) -> FloatArray:
    """Draw starts, drivers' weights, noise of drivers and (`own` columns) of the ego, side by side, shape (n, d)."""
    parts = [case.starts(n, rng)]
    if world.columns["weights"]:
        assert world.background is not None and world.background.weights is not None
        parts.append(world.background.weights.sample(n, rng))
    return np.concatenate((*parts, rng.standard_normal((n, world.columns["noise"] + own))), axis=1)


class Verdicts(NamedTuple):
    """Of n rollouts, (n,) each: index of `VERDICT_NAMES`, and before the verdict the least headway [s] and margin [m].

    The headway is inf without a lead, the margin that from the body to a line of the lane, negative beyond it.
    """

    reason: NDArray[np.int64]
    headway: FloatArray
    margin: FloatArray


def judge(ego: Any, case: str = "straight", rollouts: int = 400, seed: int = 0, seconds: float = SECONDS) -> Verdicts:
    """Return verdicts on an ego, as `rare_envs.DrivingProblem` takes it, in one of `CASES`, from a seed."""
    needs = resolve(ego)
    world = make_world(CASES[case], seconds, needs.observation)
    driver = as_driver(ego, world, needs)
    world = replace(world, sensing=replace(world.sensing, lidar=True)) if needs.lidar else world
    x = draw_inputs(CASES[case], world, rollouts, needs.noise_columns(world), np.random.default_rng(seed))
    tile = 64 if "camera" in needs.observation.split("+") else 256
    parts = [_judge_tile(world, driver, part) for part in torch.split(torch.from_numpy(x).float(), tile)]
    return Verdicts(*(torch.cat(column).numpy() for column in zip(*parts, strict=True)))


@torch.inference_mode()
def _judge_tile(world: World, driver: Driver, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the columns of `Verdicts` of one tile."""
    reason = torch.full((len(x),), PASSED)
    least, room = torch.full((2, len(x)), torch.inf)
    lead, since, had = torch.zeros_like(reason), torch.zeros_like(least), torch.zeros(len(x), dtype=torch.bool)
    first: Episode | None = None
    for episode in drive(world, driver, x):
        first = first or episode
        state, running = episode.state, reason == PASSED
        follows = lead_index(state, world.scenario.road)
        gap, speed = episode.lead.gap, state.speed[:, 0]
        headway = torch.where(gap < torch.inf, gap / speed.clamp(min=0.1), torch.inf)
        far, same = (headway >= FLOOR_HEADWAY) & (gap >= FLOOR_GAP), follows == lead
        since, had, lead = torch.where(same, since + world.clock.dt, 0.0), (had & same) | far, follows
        margin = _lane_margin(state, first)
        verdict = torch.full_like(reason, PASSED)
        verdict[~far & (had | (since >= GRACE))] = TOO_CLOSE
        verdict[margin < 0.0] = LEFT_LANE
        verdict = torch.where(episode.collided, _blame(episode), verdict)
        least = torch.where(running, torch.minimum(least, headway), least)
        room = torch.where(running, torch.minimum(room, margin), room)
        reason = torch.where(running, verdict, reason)
    assert first is not None
    ways, leader = episode.state.x - first.state.x, lead_index(first.state, world.scenario.road)
    of_lead = ways.gather(1, leader[:, None])[:, 0]
    due = torch.where(leader > 0, of_lead, first.state.speed[:, 0] * world.clock.seconds)
    behind = (reason == PASSED) & (ways[:, 0] < LEAST_WAY * due)
    return torch.where(behind, LEFT_BEHIND, reason), least, room


def _lane_margin(state: State, first: Episode) -> Tensor:
    """Return the distance from the ego's body to the nearer line of its first lane [m], shape (B,)."""
    road, y, heading = first.road, state.y[:, 0], state.heading[:, 0]
    left, right = road.markers(first.state.y[:, 0])
    middle, half_lane = first.state.y[:, 0] + 0.5 * (right - left), 0.5 * (left + right)
    half = 0.5 * (VEHICLE_WIDTH * torch.cos(heading).abs() + VEHICLE_LENGTH * torch.sin(heading).abs())
    return half_lane - (y - middle).abs() - half


def _blame(episode: Episode) -> Tensor:
    """Return `COLLIDED` if the ego ran into something, `HIT_BY_OTHER` where a vehicle ran into it."""
    assert episode.statistics is not None
    crash = episode.statistics.own
    own = (crash.vehicles[:, 0] == 0) | (crash.kind == ROAD_EDGE)
    return torch.where(crash.kind == NONE, PASSED, torch.where(own, COLLIDED, HIT_BY_OTHER))


def judge_all_cases(ego: Any, rollouts: int, seed: int) -> dict[str, dict[str, Any]]:
    """Return rollouts passed and judged, the lower limit of a 95 % interval, and the other verdicts, for each case."""
    found = {}
    for case in CASES:
        counts = Counter(VERDICT_NAMES[k] for k in judge(ego, case, rollouts, seed).reason.tolist())
        passed, judged = counts.pop("passed", 0), rollouts - counts.pop("hit by others", 0)
        least = clopper_pearson(passed, judged, 0.95)[0] if judged else 0.0
        found[case] = {"passed": passed, "judged": judged, "at least": least, **counts}
    return found


def main(
    ego: Annotated[str, typer.Option(help="As for rare-envs estimate.")] = "imitation",
    rollouts: Annotated[int, typer.Option(help="Of a minute each, in each case.")] = 400,
    seed: Annotated[int, typer.Option(help="Of the starts and of all noise.")] = 1000,
) -> None:
    """Judge an ego in ordinary traffic."""
    typer.echo(json.dumps(judge_all_cases(load_ego(ego), rollouts, seed), indent=1))


if __name__ == "__main__":
    typer.run(main)
