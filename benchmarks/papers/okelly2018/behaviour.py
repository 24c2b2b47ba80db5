"""Behaviour of the vehicles in some runs: hard brakes, lane changes, and on which side danger was."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.papers.okelly2018.findings import PaperClaim, compare_means
from benchmarks.papers.record import TestedClaim
from rare_envs.measures.longitudinal import TTC_MAX
from rare_envs.sensors.lidar import RANGE_COLUMNS, RATE_COLUMNS, beam_angles
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.rollout import drive
from samplers.problem import FloatArray

HARD_BRAKE_LIMIT = -3.0
"""Acceleration that counts as a hard brake [m/s^2]."""
SIDEWAYS_ANGLES = (math.radians(45.0), math.radians(135.0))
"""Angles to the heading between which a beam looks sideways."""


class RunBehaviour(NamedTuple):
    """Each of n runs, (n,) each."""

    hard_brakes: FloatArray
    """Share of the steps of the five other vehicles."""
    lane_changes: FloatArray
    """Of the five other vehicles, for each of them in 10 s."""
    sideways: FloatArray
    """1 where the least time to collision was along a beam to the side, else 0."""
    collided: FloatArray
    """1 where the ego has collided, else 0."""


def measure_behaviour(problem: Any, x: FloatArray) -> RunBehaviour:
    """Drive scenarios again.

    Args:
        problem: A `DrivingProblem` whose world has lidar.
        x: Scenarios, shape (n, d).
    """
    parts = [_measure_tile(problem, rows) for rows in np.array_split(x, max(1, math.ceil(len(x) / problem.tile)))]
    return RunBehaviour(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _measure_tile(problem: Any, x: FloatArray) -> RunBehaviour:
    clock = problem.world.clock
    with torch.inference_mode():
        episodes = drive(problem.world, problem.driver, torch.from_numpy(x).float())
        before = next(episodes)
        least, side = find_least_time(before)
        brakes, changes = torch.zeros(len(x)), torch.zeros(len(x))
        for episode in episodes:
            slowing = (episode.state.speed - before.state.speed)[:, 1:] / clock.dt
            brakes += (slowing <= HARD_BRAKE_LIMIT).float().mean(dim=1)
            lane, lane_before = (each.road.lane_of(each.state.y[:, 1:]) for each in (episode, before))
            changes += (lane != lane_before).float().mean(dim=1)
            now, here = find_least_time(episode)
            nearer = (now < least) & ~episode.collided
            least, side = torch.where(nearer, now, least), torch.where(nearer, here, side)
            before = episode
    values = (brakes / clock.ticks, changes * 10.0 / clock.seconds, side.float(), before.collided.float())
    return RunBehaviour(*(value.double().numpy() for value in values))


def find_least_time(episode: Episode) -> tuple[Tensor, Tensor]:
    """Return the least time to collision along the ego's beams [s], and whether that beam looks sideways, (B,) each."""
    assert episode.perception is not None
    ego = episode.perception[:, 0]
    closing = -ego[:, RATE_COLUMNS]
    times = torch.where(closing > 0.0, ego[:, RANGE_COLUMNS] / closing.clamp(min=1e-4), TTC_MAX)
    least, beam = times.min(dim=1)
    angle = beam_angles(times).abs()[beam]
    return least, (angle >= SIDEWAYS_ANGLES[0]) & (angle <= SIDEWAYS_ANGLES[1])


MORE_LANE_CHANGES = PaperClaim("perturbed weights make lane changes more frequent", above=True)
MORE_HARD_BRAKES = PaperClaim("perturbed weights make hard brakes more frequent", above=True)
MORE_SIDESWIPES = PaperClaim("dangerous events include frequent sideswipes", above=True)


def compare_behaviour(
    failing: RunBehaviour, ordinary: RunBehaviour, with_their_weights: RunBehaviour, all_failing: int
) -> list[TestedClaim]:
    """Test what the paper says of behaviour.

    Args:
        failing: Of failing runs.
        ordinary: Of ordinary runs.
        with_their_weights: Of the same ordinary starts driven by drivers with the weights of failing runs.
        all_failing: Failing runs that there are, of which some were driven again.
    """
    groups = "ordinary starts with weights of failing runs / with their own"
    found = [
        compare_means(
            MORE_LANE_CHANGES,
            "lane changes of a vehicle in 10 s",
            with_their_weights.lane_changes,
            ordinary.lane_changes,
            groups,
        ),
        compare_means(
            MORE_HARD_BRAKES,
            "share of steps that brake at 3 m/s^2 or more",
            with_their_weights.hard_brakes,
            ordinary.hard_brakes,
            groups,
        ),
    ]
    words = "share of runs whose least time to collision is along a beam to the side (45 to 135 degrees)"
    collided = f"the ego collides in {failing.collided.mean():.0%} of the failing runs"
    return [
        *found,
        compare_means(
            MORE_SIDESWIPES,
            f"{words}; {collided}, {len(failing.collided):,} of {all_failing:,} driven again",
            failing.sideways,
            ordinary.sideways,
        ),
    ]
