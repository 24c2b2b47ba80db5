"""Settings of a world: sensors of the ego, time, and measurement."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any

from torch import Tensor

from rare_envs.control.actions import DECISION
from rare_envs.measures import EpisodeMeasure
from rare_envs.measures.registry import find_measure
from rare_envs.sensors.camera import Camera, CameraContext, clear_day, read_weather


@dataclass(frozen=True)
class Sensing:
    """Sensors of the ego."""

    observation: str = "features"
    """One of `rare_envs.simulation.observation.OBSERVATIONS`, or several joined by "+"."""
    camera: Camera = Camera()  # noqa: RUF009  (frozen)
    """The camera that takes the pictures where "camera" is observed."""
    weather: bool = False
    """Whether weather is part of x; a camera sees it."""
    lidar: bool = False
    """Whether all vehicles' lidar features are computed even if neither observation, drivers nor measure need them."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of observation by name."""
        return tuple(self.observation.split("+"))

    @property
    def uses_lidar(self) -> bool:
        """Whether lidar features are computed for the ego."""
        return self.lidar or "lidar" in self.kinds

    def start_camera(self, weather: Tensor, key: Tensor) -> CameraContext | None:
        """Return what pictures depend on beside the traffic, from weather (B, W) and key (B, 1), or None."""
        if "camera" not in self.kinds:
            return None
        return CameraContext.at_start(self.camera, read_weather(weather, key) if self.weather else clear_day(weather))


LONGEST_TICK = 1.0
"""Largest dt [s]: at motorway speed a vehicle moves 40 m in it, farther than gaps are."""
LONGEST_HORIZON = 1e6
"""Episodes are shorter than this [s]; longer ones are a mistake of units."""
_ROUNDING = 1e-6
"""By so much a number of ticks may differ from a whole one."""


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
        if self.action == "meta" and not (_is_whole(1.0 / self.dt) and _is_whole(self.horizon / DECISION)):
            raise ValueError(
                "Expected a dt that divides 1 s and a horizon of whole seconds with action='meta', in which a decision "
                f"takes 1 s; got dt = {self.dt!r} and horizon = {self.horizon!r}."
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


COLLISIONS = ("ego", "any")
"""Choices of the collisions that count."""


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
