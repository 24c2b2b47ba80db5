"""Replay: one scenario driven again, every moment of it kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.measures import Moment
from rare_envs.problem import DrivingProblem
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.rollout import drive
from rare_envs.traffic.crash import describe_crash
from rare_envs.traffic.road import Road
from samplers.problem import FloatArray


@dataclass(frozen=True)
class Drive:
    """T + 1 moments of N vehicles, the ego first; the last one is the collision, if there is one.

    Attributes:
        problem: The world and its ego.
        episodes: The moments, each a batch of one.

    Example:
        >>> problem = DrivingProblem("rare_envs/CarFollowing-v0", horizon=1.0)
        >>> drive = drive_again(problem, np.array([10.0, 10.0, 50.0]))
        >>> drive.position.shape, float(drive.gap[0]), drive.collided, drive.names
        ((11, 2, 2), 50.0, False, ('the ego', 'the lead'))
    """

    problem: DrivingProblem
    episodes: tuple[Episode, ...]

    @cached_property
    def time(self) -> FloatArray:
        """Time [s], shape (T + 1,)."""
        return np.arange(len(self.episodes), dtype=np.float64) * self.problem.world.clock.dt

    @cached_property
    def position(self) -> FloatArray:
        """Centres, along and across the road [m], shape (T + 1, N, 2)."""
        return self._stack(lambda each: torch.stack((each.state.x[0], each.state.y[0]), dim=-1))

    @cached_property
    def heading(self) -> FloatArray:
        """Heading [rad], shape (T + 1, N)."""
        return self._stack(lambda each: each.state.heading[0])

    @cached_property
    def speed(self) -> FloatArray:
        """Speed [m/s], shape (T + 1, N)."""
        return self._stack(lambda each: each.state.speed[0])

    @cached_property
    def gap(self) -> FloatArray:
        """Bumper to bumper from the ego to its lead [m], shape (T + 1,)."""
        return self._stack(lambda each: each.lead.gap[0])

    @cached_property
    def closing_speed(self) -> FloatArray:
        """Of the ego on its lead, positive when closing [m/s], shape (T + 1,)."""
        return self._stack(lambda each: each.lead.closing_speed[0])

    @cached_property
    def f_so_far(self) -> FloatArray:
        """Safety measure of the episode up to each moment, shape (T + 1,)."""
        return self._stack(lambda each: each.f[0])

    @cached_property
    def f_alone(self) -> FloatArray:
        """Safety measure of each moment as if it were the whole episode, shape (T + 1,)."""
        clock, values = self.problem.world.clock, []
        for before, episode in zip([None, *self.episodes], self.episodes, strict=False):
            state = None if before is None else before.state
            moment = Moment(episode.state, episode.lead, episode.road, episode.perception, state, clock.dt)
            values.append(float(episode.measure.f(episode.measure.start(moment, clock.ticks))))
        return np.array(values)

    @property
    def worst(self) -> int:
        """Index of the moment that decides f: the collision, else the least measure."""
        return int(self.f_so_far.argmin())

    @property
    def f(self) -> float:
        """Safety measure of the whole drive."""
        return float(self.f_so_far[-1])

    @property
    def collided(self) -> bool:
        """Whether the ego collided."""
        return bool(self.episodes[-1].collided)

    @property
    def crash(self) -> dict[str, Any] | None:
        """The crash, as `rare_envs.traffic.crash.describe_crash` gives it; None if nobody crashed."""
        statistics = self.episodes[-1].statistics
        return None if statistics is None else describe_crash(statistics.crash)

    @property
    def road(self) -> Road:
        """The road that the vehicles are on."""
        return self.problem.world.scenario.road

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the vehicles, length N."""
        return self.problem.world.scenario.labels

    def _stack(self, value: Callable[[Episode], Tensor]) -> FloatArray:
        return torch.stack([value(each) for each in self.episodes]).double().numpy()


@torch.inference_mode()
def drive_again(problem: DrivingProblem, x: NDArray[np.float64]) -> Drive:
    """Drive one scenario and keep every moment up to the collision or the horizon.

    Args:
        problem: The world and its ego.
        x: Scenario parameters, shape (d,).

    Returns:
        The drive, made on the CPU; its f is that of `problem.evaluate`, but for rounding where that is on a GPU.

    Example:
        >>> problem = DrivingProblem("rare_envs/CarFollowing-v0", horizon=3.0)
        >>> drive = drive_again(problem, np.array([20.0, 5.0, 10.0]))  # ego at 20 m/s, 10 m behind a lead at 5 m/s
        >>> drive.f, drive.crash["kind"], round(float(drive.time[-1]), 1)
        (-1.0, 'rear_end', 0.8)
    """
    episodes: list[Episode] = []
    # single precision, as in `DrivingProblem.evaluate`, so that f comes out the same
    world, driver = problem.on_cpu()
    for episode in drive(world.with_statistics(), driver, torch.from_numpy(x).float()[None]):
        episodes.append(episode)
        if bool(episode.collided):
            break
    return Drive(problem, tuple(episodes))
