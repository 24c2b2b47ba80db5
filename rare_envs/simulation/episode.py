"""Episodes: the state of B of them at one moment, and what is kept of their crashes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.control.actions import Aim
from rare_envs.measures import EpisodeMeasure, Moment, ttc
from rare_envs.measures.registry import MEASURES
from rare_envs.sensors.camera import CameraContext
from rare_envs.simulation.background import BackgroundState
from rare_envs.traffic.bodies import Lead, overlaps
from rare_envs.traffic.crash import NONE, Crash, crash_of, crash_of_others
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

LEARNED_TICK = 0.1
"""The dt [s] of the recordings that learned drivers were trained on."""


class EpisodeStatistics(NamedTuple):
    """Statistics of B episodes up to one moment."""

    least_ttc: Tensor
    """Least time to collision [s], shape (B,), without meaning after a collision."""
    own: Crash
    """Crash of the ego."""
    others: Crash
    """First crash between two other vehicles while the episode ran."""

    @property
    def crash(self) -> Crash:
        """Crash of the ego; where it had none, that of others."""
        return self.own.replace_where(self.own.kind == NONE, self.others)

    @classmethod
    def start(cls, moment: Moment, least_ttc: Tensor | None = None) -> EpisodeStatistics:
        """Return the statistics at time 0; arguments as of `update`."""
        nothing = Crash.nothing(moment.state.x[:, 0])
        return cls(ttc(moment) if least_ttc is None else least_ttc, nothing, nothing)

    def update(self, moment: Moment, before: Tensor, now: Tensor, least_ttc: Tensor | None = None) -> EpisodeStatistics:
        """Return the statistics a moment later: had it ended `before`, has it `now` (B,); `least_ttc` if known."""
        least = torch.minimum(self.least_ttc, ttc(moment)) if least_ttc is None else least_ttc
        touch = overlaps(moment.state, moment.road, "others").any(dim=1) & (self.others.kind == NONE) & ~before
        own = _record_crashes(self.own, now & ~before, crash_of, moment)
        return EpisodeStatistics(least, own, _record_crashes(self.others, touch, crash_of_others, moment))


def _record_crashes(crash: Crash, where: Tensor, find: Callable[..., Crash], moment: Moment) -> Crash:
    """Return crashes with those found in the episodes `where`, boolean (B,), put in."""
    if not bool(where.any()):
        return crash
    rows = where.nonzero()[:, 0]
    state = State(*(field[rows] for field in moment.state))
    before = None if moment.before is None else State(*(field[rows] for field in moment.before))
    latest = find(state, moment.road, before, moment.dt)
    return Crash(*(old.index_put((rows,), new) for old, new in zip(crash, latest, strict=True)))


class Episode(NamedTuple):
    """B episodes at one moment.

    Example:
        >>> import torch
        >>> from rare_envs import scenarios, simulation
        >>> x = torch.tensor([[20.0, 15.0, 30.0]])  # ego and lead speed [m/s], gap [m]
        >>> episode = simulation.World(scenarios.find_scenario("car_following")).start(x)
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
    disabled: Tensor | None = None
    """Which vehicles have crashed and roll out, boolean, shape (B, N); None in a world without policies in traffic."""
    memories: Mapping[int, Any] | None = None
    """Memories of the policies in traffic, by vehicle."""
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
