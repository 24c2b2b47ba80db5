"""Episode: the state of B rollouts at one moment."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from rare_envs.control.actions import Aim
from rare_envs.measures import EpisodeMeasure
from rare_envs.measures.registry import MEASURES
from rare_envs.sensors.camera import CameraContext
from rare_envs.simulation.background import BackgroundState
from rare_envs.simulation.measurement import EpisodeStatistics
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State


class Episode(NamedTuple):
    """B episodes at one moment.

    Example:
        >>> import torch
        >>> from rare_envs import scenarios, simulation
        >>> x = torch.tensor([[20.0, 15.0, 30.0]])  # ego and lead speed [m/s], gap [m]
        >>> episode = simulation.World(scenarios.scenario_named("car_following")).start(x)
        >>> float(episode.lead.gap), float(episode.f)  # f is the time to collision: 30 m / (5 m/s)
        (30.0, 6.0)
    """

    state: State
    lead: Lead
    """The ego's lead in this state."""
    measure_state: Any
    """State of the measure over the episode so far; see `f`."""
    collided: Tensor
    """Whether the ego has collided by now, boolean, shape (B,)."""
    road: Road
    """The road that all are on."""
    perception: Tensor | None = None
    """Lidar features of the vehicles in this state, `rare_envs.sensors.lidar.FEATURES`, shape (B, N, 51), the ego
    first; None in a world without lidar."""
    background_state: BackgroundState | None = None
    """State of the drivers around the ego, if they are not the scenario's script."""
    overridden: Tensor | None = None
    """Which vehicles have been commanded, so that a script no longer knows them, boolean, shape (B, N); None before
    anyone but the ego has been."""
    measure: EpisodeMeasure = MEASURES["ttc"]
    aim: Aim | None = None
    """Aims of the controllers of vehicles with meta-actions, (B, N) each; None in a world without such actions."""
    statistics: EpisodeStatistics | None = None
    """Least time to collision and crashes so far; None unless the world keeps them."""
    camera_context: CameraContext | None = None
    """Inputs of a camera's picture beside the traffic; None in a world without a camera."""

    @property
    def f(self) -> Tensor:
        """The safety measure of the episode so far, shape (B,); after a collision it stays what it is."""
        return self.measure.f(self.measure_state)
