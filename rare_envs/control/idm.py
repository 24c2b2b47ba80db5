"""IDM: the Intelligent Driver Model, the ego that follows it and keeps its lane; and HighwayEnv's steering.

References:
    Leurent, "An environment for autonomous driving decision-making", 2018: HighwayEnv, `vehicle/controller.py`.
    Kesting, Treiber and Helbing, "Enhanced intelligent driver model to access the impact of driving strategies on
    traffic capacity", Philosophical Transactions of the Royal Society A 368, 2010 (arXiv 0912.3613).
    Treiber and Kesting, "Traffic Flow Dynamics", Springer, 2013, sections 11.3.7 and 11.3.8.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any, ClassVar, Final

import numpy as np
import torch
from torch import Tensor

from rare_envs.devices import are_zero, may_hold, scalars
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import NEAR_ZERO, VEHICLE_LENGTH, steering_for

TAU_LATERAL = 0.6
"""Time constant of the way back to the line [s], HighwayEnv's `TAU_LATERAL`."""
TAU_HEADING = 0.2
"""Time constant of the heading [s], HighwayEnv's `TAU_HEADING`."""
MAX_HEADING_COMMAND = np.pi / 4
"""Largest angle towards the line that is asked for [rad], HighwayEnv's."""


def lane_keeping(y: Tensor, heading: Tensor, speed: Tensor, road: Road) -> Tensor:
    """Return the steering angle of HighwayEnv's controller towards the centre of the nearest lane [rad], (B,).

    Offset to heading command (proportional, 0.6 s), heading error to yaw rate (0.2 s), yaw rate to steering angle.
    On a curve of radius R it runs wide by 0.12 s^2 v^2 / R, 3 cm at 30 m/s on the I-80.
    """
    offset = y - road.centre_of(y)
    if are_zero(offset, heading):
        return torch.zeros_like(y)
    return steering_for(yaw_rate_towards(offset, heading, speed), speed)


def yaw_rate_towards(offset: Tensor, heading: Tensor, speed: Tensor) -> Tensor:
    """Return HighwayEnv's yaw rate [rad/s] back to a line at an offset to the right of it [m], any shape."""
    heading_command = torch.asin((offset / (-TAU_LATERAL * speed.clamp(min=NEAR_ZERO))).clamp(-1.0, 1.0))
    heading_command = heading_command.clamp(-MAX_HEADING_COMMAND, MAX_HEADING_COMMAND)
    return (1.0 / TAU_HEADING) * (heading_command - heading)


RANGES: Final[Mapping[str, Callable[[float], bool]]] = {
    "from 0 to 1": lambda value: 0.0 <= value <= 1.0,
    "from 0 to 180 degrees": lambda value: 0.0 <= value <= 180.0,
    "of at least 0": lambda value: value >= 0.0,
    "of at least 0, finite": lambda value: 0.0 <= value < math.inf,
    "above 0": lambda value: value > 0.0,
    "above 0, finite": lambda value: 0.0 < value < math.inf,
}
"""Ranges of the parameters of a model, in words."""


def check_numbers(model: object, who: str, ranges: Mapping[str, Sequence[str]]) -> None:
    """Raise a ValueError where a field of a model, by its range, is no number in it."""
    for words, names in ranges.items():
        for name in names:
            value = getattr(model, name)
            if isinstance(value, bool) or not isinstance(value, Real) or not RANGES[words](float(value)):
                raise ValueError(f"Expected {name} of the {who} to be a number {words}, got {value!r}.")


_RANGES: Final = {
    "above 0, finite": (
        "desired_speed",
        "max_acceleration",
        "comfortable_deceleration",
        "exponent",
        "max_deceleration",
    ),
    "of at least 0, finite": ("time_headway", "jam_distance", "jam_distance_speed", "added_length"),
}
MIN_RATIO = 1e-24
"""Floor of speed / desired speed under the root: its slope stays finite at standstill, in single precision too."""


@dataclass(frozen=True)
class IDM:
    """Intelligent Driver Model with a hard maximum deceleration, on the bumper-to-bumper gap.

    a = a_max [1 - (v/v0)^delta - (s*/gap)^2], at least -b_max, with
    s* = s0 + s1 sqrt(v/v0) + T v + v dv / (2 sqrt(a_max b)).

    The defaults are Tian et al.'s (2024, Table I; as found in their group's public code). Without `cut_off` the last
    term of s* may be negative: a lead that pulls away fast from a short gap is braked for, as in HighwayEnv and in
    their code.

    Raises:
        ValueError: A parameter is not finite, is negative, or is 0 and divides or scales.

    Example:
        >>> import rare_envs, torch
        >>> from rare_envs.control.idm import Lead
        >>> nobody_ahead = Lead(gap=torch.tensor([torch.inf]), closing_speed=torch.tensor([0.0]))
        >>> rare_envs.IDM(desired_speed=20.0).acceleration(torch.tensor([20.0]), nobody_ahead)
        tensor([0.])
    """

    desired_speed: float = 21.72
    """v0 [m/s]."""
    time_headway: float = 1.2
    """T [s]."""
    max_acceleration: float = 2.22
    """a_max [m/s^2]."""
    comfortable_deceleration: float = 2.4
    """b [m/s^2]."""
    exponent: float = 4.0
    """delta."""
    jam_distance: float = 1.0
    """s0 [m]."""
    jam_distance_speed: float = 2.0
    """s1 [m]."""
    max_deceleration: float = 5.0
    """b_max [m/s^2]: what the brakes can do."""
    added_length: float = 0.0
    """[m] added to the gap; HighwayEnv measures between centres, so its jam distance contains a vehicle length."""
    cut_off: bool = False
    """Whether T v + v dv / (2 sqrt(a_max b)) is cut off at 0, as Treiber and Kesting write it ("Traffic Flow Dynamics",
    2013, chapter 11): a lead that pulls away fast is then not braked for."""
    recordable: ClassVar[bool] = True
    """Whether its operations may be recorded: nothing about it changes."""

    def __post_init__(self) -> None:
        check_numbers(self, "IDM", _RANGES)

    @cached_property
    def closing_gain(self) -> float:
        """1 / (2 sqrt(a_max b)) [s^2/m], the factor of v dv in s*."""
        return 0.5 / math.sqrt(self.max_acceleration * self.comfortable_deceleration)

    @cached_property
    def _interaction_numbers(self) -> tuple[float, ...]:
        jam = (self.jam_distance, self.jam_distance_speed)
        return (self.time_headway, self.closing_gain, *jam, self.added_length)

    @classmethod
    def highway_env(cls, desired_speed: float) -> IDM:
        """Return HighwayEnv's `IDMVehicle`: distances of centres, jam distance 10 m, accelerations within 6 m/s^2."""
        return cls(desired_speed, 1.5, 3.0, 5.0, 4.0, 10.0, 0.0, 6.0, VEHICLE_LENGTH)

    def acceleration(self, speed: Tensor, lead: Lead, desired_speed: Tensor | None = None) -> Tensor:
        """Return accelerations [m/s^2] of followers at speeds [m/s], (B,), with a desired one of their own or one."""
        ratio = speed / (scalars((self.desired_speed,), speed)[0] if desired_speed is None else desired_speed)
        return self.combine(ratio, self.interaction(speed, ratio, lead))

    def interaction(self, speed: Tensor, ratio: Tensor, lead: Lead) -> Tensor:
        """Return (s*/gap)^2 of followers at a speed [m/s], and its ratio to the desired one, for leads; any shapes."""
        time, gain, jam, jam_speed, added = scalars(self._interaction_numbers, speed)
        headway = time + lead.closing_speed * gain
        desired_gap = jam + speed * (headway.clamp_min(0.0) if self.cut_off else headway)
        if self.jam_distance_speed:
            desired_gap = desired_gap + jam_speed * ratio.clamp_min(MIN_RATIO).sqrt()
        gap = lead.gap + added if self.added_length else lead.gap
        share: Tensor = desired_gap / gap.clamp_min(NEAR_ZERO)
        return share.square()

    def combine(self, ratio: Tensor, interaction: Tensor) -> Tensor:
        """Return the acceleration [m/s^2] from speed / desired speed and (s*/gap)^2, of one shape."""
        free = ratio.square().square() if self.exponent == 4.0 else ratio.pow(self.exponent)
        one, largest = scalars((1.0, self.max_acceleration), ratio)
        acceleration: Tensor = largest * (one - free - interaction)
        return acceleration.clamp_min(-self.max_deceleration)

    def act(self, episode: Any, memory: Any) -> tuple[Tensor, Any]:
        """Return IDM behind the lead and lane keeping across, shape (B, 2); there is no memory."""
        _, y, heading, speed = episode.state.vehicles[0]
        steering = lane_keeping(y, heading, speed, episode.road)
        return torch.stack((self.acceleration(speed, episode.lead), steering)).T, memory


COOLNESS = 0.99
"""Weight of the constant-acceleration heuristic (Kesting, Treiber and Helbing 2010, table 1)."""


def improved_acceleration(
    idm: IDM,
    speed: Tensor,
    lead: Lead,
    lead_acceleration: Tensor | float = 0.0,
    desired_speed: Tensor | None = None,
    coolness: Tensor | float = COOLNESS,
) -> Tensor:
    """Return accelerations [m/s^2] of the improved IDM with the constant-acceleration heuristic, (B,).

    A driver behind a lead that has just come close does not brake for the gap as the IDM does, but by no more than what
    avoids a contact if the lead keeps its acceleration ("eliminates unrealistic behaviour in cut-in situations").

        improved: a_f = a (1 - (v/v0)^delta), z = s*/s;  a (1 - z^2) if z >= 1, else a_f (1 - z^(2 a / a_f));
                  above v0: a_f = -b (1 - (v0/v)^(a delta / b));  a_f + a (1 - z^2) if z >= 1, else a_f
        heuristic: a~ = min(a_lead, a), v_lead = max(v - dv, 0);
                  v^2 a~ / (v_lead^2 - 2 s a~) if v_lead dv < -2 s a~, else
                  a~ - max(dv, 0)^2 / (2 s): behind a lead that stands both say -v^2 / (2 s)
        both:     the improved one where it is the larger, else (1 - c) improved + c (heuristic + b tanh((improved -
                  heuristic) / b))

    Args:
        idm: Parameters; the result is within [-max_deceleration, max_acceleration].
        speed: Own speeds v [m/s], (B,).
        lead: Gaps s [m], inf for nobody, and closing speeds dv [m/s], (B,).
        lead_acceleration: Of the lead [m/s^2].
        desired_speed: v0 [m/s], by default that of `idm`.
        coolness: c; 0 is the improved IDM alone.

    Example:
        >>> close = Lead(gap=torch.tensor([8.0]), closing_speed=torch.tensor([0.0]))
        >>> motorway = IDM(33.0, 1.0, 1.0, 1.5, jam_distance=2.0, jam_distance_speed=0.0)
        >>> motorway.acceleration(torch.tensor([20.0]), close).round(decimals=2).item()  # brakes for the gap
        -5.0
        >>> f"{improved_acceleration(motorway, torch.tensor([20.0]), close).item():.2f}"
        '-1.55'
    """
    a, b, limit = idm.max_acceleration, idm.comfortable_deceleration, idm.max_deceleration
    ratio = speed / (scalars((idm.desired_speed,), speed)[0] if desired_speed is None else desired_speed)
    improved = _improve(a, b, idm.exponent, ratio, idm.interaction(speed, ratio, lead))
    closing, room = lead.closing_speed, lead.gap.clamp(NEAR_ZERO, FAR_AWAY) * 2.0
    held = torch.as_tensor(lead_acceleration, dtype=speed.dtype, device=speed.device).clamp_max(a)
    ahead, change = (speed - closing).clamp_min(0.0), room * held
    stopping = speed.square() * held / (ahead.square() - change).clamp_min(NEAR_ZERO)
    closing_up = held - closing.clamp_min(0.0).square() / room
    heuristic = torch.where(ahead * closing < -change, stopping, closing_up)
    less = (improved - heuristic).clamp_max(0.0)
    both = torch.lerp(improved, torch.tanh(less / b) * b + heuristic, (lead.gap < FAR_AWAY).to(speed.dtype) * coolness)
    return torch.where(less < 0.0, both, improved).clamp(-limit, a)


FAR_AWAY = 1e6
"""Beyond this gap [m] there is nobody."""


def _improve(a: float, b: float, exponent: float, ratio: Tensor, interaction: Tensor) -> Tensor:
    """Return the improved IDM's acceleration [m/s^2] by v / v0 and (s* / s)^2, (B,) each."""
    below = (1.0 - ratio.clamp_max(1.0).pow(exponent)) * a
    near = a - interaction * a
    share = torch.exp(torch.log(interaction.clamp(MIN_RATIO, 1.0)) * (a / below.clamp_min(1e-3)))
    slow = torch.where(interaction >= 1.0, near, below - below * share)
    fast = ratio > 1.0
    if not may_hold(fast):
        return slow
    above = (ratio.clamp_min(1.0).pow(-a * exponent / b) - 1.0) * b
    return torch.where(fast, above + near.clamp_max(0.0), slow)
