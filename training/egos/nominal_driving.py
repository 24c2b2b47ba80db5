"""Nominal driving: the share of minutes of ordinary traffic in which an ego keeps its lane and its distance.

    python -m training.egos.nominal_driving --ego idm
    python -m training.egos.nominal_driving --ego vision --case straight --rollouts 100

An ego keeps its lane if its body never crosses a line of the lane that it starts in. It keeps its distance if it runs
into nobody and never follows its lead closer than 0.5 s or 1 m; after a lead cuts in closer than that it has 10 s.
It must also advance: an ego that covers less than half of the distance of its lead (or, without a lead, of that at its
first speed) is left behind. If another vehicle runs into it from behind or from the side, the rollout counts neither
way, and is reported as excluded.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from agents import load_ego
from rare_envs.egos.needs import resolve
from rare_envs.egos.policy import as_driver
from rare_envs.plugins import did_you_mean
from rare_envs.sensors.kinds import kinds_of
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.rollout import Driver, drive
from rare_envs.simulation.sensing import Sensing
from rare_envs.simulation.world import World
from rare_envs.traffic.crash import NONE, ROAD_EDGE
from rare_envs.traffic.neighbours import lead_index
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State
from samplers.statistics import clopper_pearson
from training.command_line import report_errors, run_command
from training.egos.nominal_traffic import CASES, FLOOR_GAP, FLOOR_HEADWAY, SECONDS, Case

VERDICT_NAMES = ("passed", "left its lane", "collided", "too close", "left behind", "hit by others")
"""Verdicts by number; a rollout gets the one that comes first in time, "left behind" at its end."""
PASSED, LEFT_LANE, COLLIDED, TOO_CLOSE, LEFT_BEHIND, HIT_BY_OTHER = range(len(VERDICT_NAMES))
GRACE = 10.0
"""Time [s] in which an ego must open the gap to a lead that has cut in too close."""
LEAST_WAY = 0.5
"""Share of its lead's distance that it must cover."""
DRIVE_BATCH, CAMERA_DRIVE_BATCH = 256, 64
"""Rollouts driven at once."""


class Verdicts(NamedTuple):
    """Verdicts of n rollouts.

    Example:
        >>> verdicts = judge("idm", "straight", rollouts=3, seed=0, seconds=2.0)
        >>> [VERDICT_NAMES[number] for number in verdicts.reason]
        ['passed', 'passed', 'passed']
    """

    reason: NDArray[np.int64]
    """Index of `VERDICT_NAMES`, shape (n,)."""
    time: NDArray[np.float64]
    """Time of the verdict [s], shape (n,)."""
    headway: NDArray[np.float64]
    """Least time headway until then [s], inf without a lead, shape (n,)."""
    margin: NDArray[np.float64]
    """Least distance from the body to a line of the lane until then [m], negative beyond it, shape (n,)."""
    speed: NDArray[np.float64]
    """Mean speed of the whole rollout [m/s], shape (n,)."""
    x: NDArray[np.float64]
    """Inputs, shape (n, d)."""


@dataclass(frozen=True)
class Summary:
    """Summary of an ego in one case.

    Example:
        >>> summary = summarise_verdicts(judge("idm", "straight", rollouts=3, seed=0, seconds=2.0))
        >>> summary.passed, summary.judged, summary.share, round(summary.interval[0], 3)
        (3, 3, 1.0, 0.292)
    """

    passed: int
    judged: int
    """Rollouts that count."""
    excluded: int
    """Rollouts in which another vehicle ran into the ego."""
    interval: tuple[float, float]
    """Interval of the share of passed rollouts, Clopper and Pearson, 95 %."""
    reasons: dict[str, int]
    """Number of the other verdicts, by name."""
    speed: float
    """Mean [m/s]."""
    headway: float
    """Median over rollouts of the least time headway [s]."""
    margin: float
    """Median over rollouts of the least distance from the body to the lane's lines [m]."""

    @property
    def share(self) -> float:
        """Share of passed rollouts among the judged ones."""
        return self.passed / max(self.judged, 1)


def judge(
    ego: Any,
    case: str | Case = "straight",
    rollouts: int = 400,
    seed: int = 0,
    seconds: float = SECONDS,
    observation: str | None = None,
    measured: World | None = None,
) -> Verdicts:
    """Return for each rollout in ordinary traffic whether an ego keeps its lane and its distance.

    Args:
        ego: An ego as `rare_envs.DrivingProblem` takes it, such as one from `agents.load_ego`.
        case: One of `CASES`, or a `Case`.
        rollouts: Number of rollouts.
        seed: Seed of the starts and of the others' noise.
        seconds: Length of each rollout [s].
        observation: Observation of an ego with `predict`; None for the one that it declares.
        measured: World to drive in instead of that of the case.

    Raises:
        ValueError: If there is no such case, or the ego does not fit.

    Example:
        >>> judge("idm", "bends", rollouts=2, seed=0, seconds=1.0).x.shape[0]
        2
    """
    if isinstance(case, str) and case not in CASES:
        raise ValueError(f"Unknown case {case!r}{did_you_mean(case, CASES)}; expected one of {', '.join(CASES)}.")
    case = CASES[case] if isinstance(case, str) else case
    needs = resolve(ego)
    observation = observation or needs.observation
    world = measured or make_world(case, seconds, observation)
    driver = as_driver(ego, world, needs)
    if needs.lidar:
        world = world.with_lidar()
    x = draw_inputs(case, world, rollouts, needs.noise_columns(world), np.random.default_rng(seed))
    tile = CAMERA_DRIVE_BATCH if "camera" in kinds_of(observation) else DRIVE_BATCH
    parts = [_judge_tile(world, driver, part) for part in torch.split(torch.from_numpy(x).float(), tile)]
    reason, time, headway, margin, speed = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Verdicts(reason, time, headway, margin, speed, x)


def make_world(case: Case, seconds: float = SECONDS, observation: str = "features") -> World:
    """Return the world of a case, with the vehicles of each collision."""
    return World(
        case.scenario,
        Sensing(observation, lidar=True),
        case.drivers(),
        Measurement(statistics=True),
        Clock(horizon=seconds),
    )


def draw_inputs(case: Case, world: World, n: int, own: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw starts, drivers' weights, noise of drivers and (`own` columns) of the ego, side by side, shape (n, d)."""
    parts = [case.starts(n, rng)]
    if world.columns.weights:
        assert world.background is not None and world.background.weights is not None
        parts.append(world.background.weights.sample(n, rng))
    return np.concatenate((*parts, rng.standard_normal((n, world.columns.noise + own))), axis=1)


@torch.inference_mode()
def _judge_tile(world: World, driver: Driver, x: Tensor) -> tuple[NDArray[Any], ...]:
    """Return the columns of `Verdicts` without x, of one tile."""
    reason = torch.full((len(x),), PASSED)
    time = torch.full((len(x),), world.clock.seconds)
    least, room = torch.full_like(time, torch.inf), torch.full_like(time, torch.inf)
    lead, since, had = torch.zeros_like(reason), torch.zeros_like(time), torch.zeros(len(x), dtype=torch.bool)
    first: Episode | None = None
    for tick, episode in enumerate(drive(world, driver, x)):
        first = first or episode
        state, now = episode.state, tick * world.clock.dt
        running = reason == PASSED
        follows = lead_index(state, world.scenario.road)
        gap, speed = episode.lead.gap, state.speed[:, 0]
        headway = torch.where(gap < torch.inf, gap / speed.clamp(min=0.1), torch.inf)
        far = (headway >= FLOOR_HEADWAY) & (gap >= FLOOR_GAP)
        same = follows == lead
        since, had = torch.where(same, since + world.clock.dt, 0.0), (had & same) | far
        margin = lane_margin(state, first)
        verdict = torch.full_like(reason, PASSED)
        verdict[~far & (had | (since >= GRACE))] = TOO_CLOSE
        verdict[margin < 0.0] = LEFT_LANE
        verdict = torch.where(episode.collided, _blame(episode), verdict)
        lead = follows
        least = torch.where(running, torch.minimum(least, headway), least)
        room = torch.where(running, torch.minimum(room, margin), room)
        time = torch.where(running & (verdict != PASSED), now, time)
        reason = torch.where(running, verdict, reason)
    assert first is not None
    way, due = _distances(first.state, episode.state, lead_index(first.state, world.scenario.road), world.clock.seconds)
    reason = torch.where((reason == PASSED) & (way < LEAST_WAY * due), LEFT_BEHIND, reason)
    return tuple(column.numpy() for column in (reason, time.double(), least, room, way / world.clock.seconds))


def lane_margin(state: State, first: Episode) -> Tensor:
    """Return the distance from the ego's body to the nearer line of its first lane [m], shape (B,)."""
    road, y, heading = first.road, state.y[:, 0], state.heading[:, 0]
    left, right = road.markers(first.state.y[:, 0])
    middle, half_lane = first.state.y[:, 0] + 0.5 * (right - left), 0.5 * (left + right)
    half = 0.5 * (VEHICLE_WIDTH * torch.cos(heading).abs() + VEHICLE_LENGTH * torch.sin(heading).abs())
    return half_lane - (y - middle).abs() - half


def _blame(episode: Episode) -> Tensor:
    """Return `COLLIDED` where the ego ran into something, `HIT_BY_OTHER` where a vehicle ran into it."""
    assert episode.statistics is not None
    crash = episode.statistics.own
    own = (crash.vehicles[:, 0] == 0) | (crash.kind == ROAD_EDGE)
    return torch.where(crash.kind == NONE, PASSED, torch.where(own, COLLIDED, HIT_BY_OTHER))


def _distances(first: State, last: State, lead: Tensor, seconds: float) -> tuple[Tensor, Tensor]:
    """Return the ego's distance [m], and that of its first lead, or at its first speed where it had none."""
    ways = last.x - first.x
    of_lead = ways.gather(1, lead[:, None])[:, 0]
    return ways[:, 0], torch.where(lead > 0, of_lead, first.speed[:, 0] * seconds)


def summarise_verdicts(verdicts: Verdicts) -> Summary:
    """Return counts of verdicts, and the interval of the share of passed rollouts.

    Example:
        >>> columns = [np.array([1.0, 2.0])] * 4
        >>> verdicts = Verdicts(np.array([PASSED, TOO_CLOSE]), *columns, x=np.zeros((2, 3)))
        >>> summarise_verdicts(verdicts).reasons
        {'too close': 1}
    """
    counts = Counter(VERDICT_NAMES[k] for k in verdicts.reason.tolist())
    passed, excluded = counts.pop(VERDICT_NAMES[PASSED], 0), counts.pop(VERDICT_NAMES[HIT_BY_OTHER], 0)
    judged = len(verdicts.reason) - excluded
    return Summary(
        passed,
        judged,
        excluded,
        clopper_pearson(passed, judged, 0.95) if judged else (0.0, 1.0),
        dict(counts),
        float(verdicts.speed.mean()),
        float(np.median(verdicts.headway)),
        float(np.median(verdicts.margin)),
    )


def judge_all_cases(ego: Any, rollouts: int, seed: int) -> dict[str, dict[str, float]]:
    """Return rollouts passed, judged, and the interval's lower end for each case, for the header of an ego's file."""
    results = {case: summarise_verdicts(judge(ego, case, rollouts, seed)) for case in CASES}
    return {
        case: {"passed": one.passed, "judged": one.judged, "at least": one.interval[0]} for case, one in results.items()
    }


def main(
    ego: Annotated[str, typer.Option(help="As in every command: idm, imitation, a file ...")] = "idm",
    case: Annotated[list[str], typer.Option(help="Kinds of traffic; may be repeated.")] = list(CASES),  # noqa: B006
    rollouts: Annotated[int, typer.Option(min=1)] = 400,
    seed: Annotated[int, typer.Option()] = 0,
    seconds: Annotated[float, typer.Option(help="Length of a rollout.")] = SECONDS,
    observation: Annotated[str | None, typer.Option(help="Observation of an ego with predict.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Judge an ego in ordinary traffic."""
    with report_errors("nominal"):
        driver = load_ego(ego)
        results = {name: summarise_verdicts(judge(driver, name, rollouts, seed, seconds, observation)) for name in case}
    if as_json:
        print(json.dumps({name: {"share": one.share, **vars(one)} for name, one in results.items()}, allow_nan=True))
        return
    print("| case | passed | share (95 %) | why not | excluded | mean speed | least headway | least margin |")
    print("|---|---|---|---|---|---|---|---|")
    for name, one in results.items():
        why = ", ".join(f"{count} {reason}" for reason, count in one.reasons.items()) or "-"
        share = f"{one.share:.4f} ({one.interval[0]:.4f} to {one.interval[1]:.4f})"
        spread = f"{one.speed:.1f} m/s | {one.headway:.2f} s | {one.margin:.2f} m"
        print(f"| {name} | {one.passed} of {one.judged} | {share} | {why} | {one.excluded} | {spread} |")


if __name__ == "__main__":
    run_command(main)
