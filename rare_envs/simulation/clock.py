"""Clock: the tick, the length of an episode, and how often a policy decides."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

from rare_envs.control.actions import DECISION

LONGEST_TICK = 1.0
"""Largest dt [s]: at motorway speed a vehicle moves 40 m in it, farther than gaps are."""
LONGEST_HORIZON = 1e6
"""Episodes are shorter than this [s]; longer ones are a mistake of units."""
LEARNED_TICK = 0.1
"""The dt [s] of the recordings that learned drivers were trained on."""
_ROUNDING = 1e-6
"""By so much a number of ticks may differ from a whole one."""


@dataclass(frozen=True)
class Clock:
    """Time of an episode.

    Example:
        >>> clock = Clock(dt=0.1, horizon=4.0)
        >>> clock.ticks, clock.stride
        (40, 1)
        >>> Clock(dt=0.1, horizon=4.0, action="meta").stride  # ticks from one decision to the next
        10

    Raises:
        ValueError: If dt is not in (0, 1] s, the horizon is not a whole number of ticks, or, with meta-actions, either
            does not go with decisions of one second.
    """

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
        in_range = _is_number(self.horizon) and self.dt <= self.horizon
        if not in_range or abs(self.horizon / self.dt - self.ticks) > _ROUNDING:
            raise ValueError(f"Expected a horizon of one or more whole ticks of {self.dt} s, got {self.horizon!r}.")
        decisions = {"dt": (self.dt, 1.0 / self.dt), "horizon": (self.horizon, self.horizon / DECISION)}
        for name, (value, number) in decisions.items():
            if self.action == "meta" and abs(number - round(number)) > _ROUNDING:
                raise ValueError(
                    f"Expected a dt that divides 1 s and a horizon of whole seconds with action='meta', in which a "
                    f"decision takes 1 s; got {name} = {value!r}."
                )

    @property
    def seconds(self) -> float:
        """Length of an episode [s]."""
        assert self.horizon is not None
        return self.horizon

    @property
    def ticks(self) -> int:
        """Length of an episode in ticks."""
        return round(self.seconds / self.dt)

    @property
    def stride(self) -> int:
        """Ticks from one decision of a policy to the next."""
        return round(DECISION / self.dt) if self.action == "meta" else 1

    @property
    def decisions_per_second(self) -> int:
        """Decisions of a policy each second, which is the frame rate of a picture at each."""
        return round(1.0 / (self.dt * self.stride))


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
