"""Episodes: their clock, what is measured in them, and the state of B of them at one moment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.control.actions import DECISION, Aim
from rare_envs.measures import EpisodeMeasure, Moment, ttc
from rare_envs.measures.registry import MEASURES, find_measure
from rare_envs.sensors.camera import CameraContext
from rare_envs.simulation.background import BackgroundState
from rare_envs.traffic.bodies import Lead, others_overlap
from rare_envs.traffic.crash import NONE, Crash, crash_of, crash_of_others
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

LONGEST_TICK = 1.0
"""Largest dt [s]: at motorway speed a vehicle moves 40 m in it, farther than gaps are."""
LONGEST_HORIZON = 1e6
"""Episodes are shorter than this [s]; longer ones are a mistake of units."""
LEARNED_TICK = 0.1
"""The dt [s] of the recordings that learned drivers were trained on."""
_ROUNDING = 1e-6
"""By so much a number of ticks may differ from a whole one."""
COLLISIONS = ("ego", "any")
"""Choices of the collisions that count."""


@dataclass(frozen=True)
class Clock:
    """Time of an episode; a ValueError for a tick or a horizon that makes no whole ticks or decisions."""

    dt: float = 0.1
    """Tick [s]."""
    horizon: float | None = None
    """Length of an episode [s]; None for the scenario's, which a `World` fills in."""
    action: str = "continuous"
    """Kind of a policy's actions: "continuous" or "discrete" ones, each tick, or "meta"-actions, each second."""

    def __post_init__(self) -> None:
        if not (_is_number(self.dt) and 0.0 < self.dt <= LONGEST_TICK):
            raise ValueError(f"Expected dt in (0, 1] s, got {self.dt!r}.")
        if self.horizon is None:
            return
        if _is_number(self.horizon) and self.horizon >= LONGEST_HORIZON:
            raise ValueError(f"Expected a horizon below {LONGEST_HORIZON:g} s, got {self.horizon!r}: it is in seconds.")
        if not (_is_number(self.horizon) and self.dt <= self.horizon and _is_whole(self.horizon / self.dt)):
            raise ValueError(f"Expected a horizon of one or more whole ticks of {self.dt} s, got {self.horizon!r}.")
        for name, value, number in (("dt", self.dt, 1.0 / self.dt), ("horizon", self.horizon, self.horizon / DECISION)):
            if self.action == "meta" and not _is_whole(number):
                raise ValueError(
                    f"Expected a dt that divides 1 s and a horizon of whole seconds with action='meta', in which a "
                    f"decision takes 1 s; got {name} = {value!r}."
                )

    @property
    def seconds(self) -> float:
        """Length of an episode [s]."""
        assert self.horizon is not None
        return self.horizon

    @cached_property
    def ticks(self) -> int:
        """Length of an episode in ticks."""
        return round(self.seconds / self.dt)

    @cached_property
    def stride(self) -> int:
        """Ticks from one decision of a policy to the next."""
        return round(DECISION / self.dt) if self.action == "meta" else 1

    @property
    def decisions_per_second(self) -> int:
        """Decisions of a policy each second, which is the frame rate of a picture at each."""
        return round(1.0 / (self.dt * self.stride))


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_whole(number: float) -> bool:
    return abs(number - round(number)) <= _ROUNDING


@dataclass(frozen=True)
class Measurement:
    """Measurement of an episode: its safety measure, and the collisions that count; a ValueError for unknown ones."""

    measure: Any = "ttc"
    """Argument of `rare_envs.measures.find_measure`: a name, a `Measure`, a function of a `Moment`."""
    collisions: str = "ego"
    """Collisions that count: those of the "ego", or "any", those between other vehicles too."""
    statistics: bool = False
    """Whether to keep the least time to collision and who crashed with whom; see `Episode.statistics`."""

    def __post_init__(self) -> None:
        find_measure(self.measure)
        if self.collisions not in COLLISIONS:
            raise ValueError(f"Expected collisions 'ego' or 'any', got {self.collisions!r}.")

    @cached_property
    def episode_measure(self) -> EpisodeMeasure:
        """The measure itself."""
        return find_measure(self.measure)


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
        """Return the statistics a moment later: had it ended `before`, has it `now`, boolean (B,).

        `least_ttc` is the least time to collision [s] (B,) where that is known already.
        """
        least = torch.minimum(self.least_ttc, ttc(moment)) if least_ttc is None else least_ttc
        touch = others_overlap(moment.state, moment.road) & (self.others.kind == NONE) & ~before
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
