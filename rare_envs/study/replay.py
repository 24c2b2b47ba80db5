"""One scenario driven again, every moment of it kept."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs import DrivingProblem
from rare_envs.simulation.rollout import drive
from rare_envs.traffic.road import Road


class Replay(NamedTuple):
    """T + 1 moments of N vehicles, the ego first; the last one is the collision, if there is one."""

    time: NDArray[np.float64]
    """Time [s], shape (T + 1,)."""
    position: NDArray[np.float64]
    """Centres, along and across the road [m], shape (T + 1, N, 2)."""
    heading: NDArray[np.float64]
    """Heading [rad], shape (T + 1, N)."""
    speed: NDArray[np.float64]
    """Speed [m/s], shape (T + 1, N)."""
    gap: NDArray[np.float64]
    """Bumper to bumper from the ego to its lead [m], shape (T + 1,)."""
    closing_speed: NDArray[np.float64]
    """Of the ego on its lead, positive when closing [m/s], shape (T + 1,)."""
    worst: int
    """The moment at which f is decided: the collision, else the least measure; an index of `time`."""
    f: float
    """The safety measure of the drive."""
    collided: bool
    """Whether the ego collided."""
    road: Road
    """The road that they are on."""
    names: tuple[str, ...]
    """What the vehicles are called, length N."""


@torch.inference_mode()
def replay(problem: DrivingProblem, x: NDArray[np.float64]) -> Replay:
    """Drive one scenario again and keep every moment up to the collision or the horizon.

    Args:
        problem: The world and its ego.
        x: Scenario parameters, shape (d,).

    Returns:
        The drive.
    """
    world, episodes = problem.world, []
    # single precision, as in `DrivingProblem.evaluate`, so that f comes out the same
    for episode in drive(world, problem.driver, torch.from_numpy(x).float()[None]):
        episodes.append(episode)
        if bool(episode.collided):
            break
    states = [each.state for each in episodes]
    x_y = torch.stack([torch.stack((s.x[0], s.y[0]), dim=-1) for s in states])
    return Replay(
        time=np.arange(len(episodes), dtype=np.float64) * world.clock.dt,
        position=x_y.double().numpy(),
        heading=torch.stack([s.heading[0] for s in states]).double().numpy(),
        speed=torch.stack([s.speed[0] for s in states]).double().numpy(),
        gap=torch.stack([each.lead.gap[0] for each in episodes]).double().numpy(),
        closing_speed=torch.stack([each.lead.closing_speed[0] for each in episodes]).double().numpy(),
        worst=int(torch.cat([each.f for each in episodes]).argmin()),
        f=float(episodes[-1].f),
        collided=bool(episodes[-1].collided),
        road=world.scenario.road,
        names=world.scenario.labels,
    )
