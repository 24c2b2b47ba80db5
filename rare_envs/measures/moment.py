"""Moments: the traffic of B scenarios at one time, and what measures need of the ego's lead."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.traffic.lead import Lead, lead_index, lead_of
from rare_envs.traffic.road import Road, straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State

GAP_MIN = 0.01
"""Gaps are floored here [m] so that only a collision, never a narrow escape, comes to 0 or less."""
GAP_MAX = 1e6
"""And cut here [m], where there is no lead."""
STILL = 1e-4
"""Speeds in a denominator are floored here [m/s], far below gap / TTC_MAX, so no value under the cap changes."""


class Moment(NamedTuple):
    """B scenarios at one moment.

    Example:
        >>> moment = Moment.of_two(gap=25.0, speed=20.0, lead_speed=15.0)
        >>> moment.lead.gap.item(), moment.lead.closing_speed.item()
        (25.0, 5.0)
        >>> moment.acceleration.tolist()  # nothing is known of the tick before
        [[0.0, 0.0]]
    """

    state: State
    """The traffic."""
    lead: Lead
    """The ego's lead."""
    road: Road
    """The road that all are on."""
    perception: Tensor | None
    """Lidar features of the vehicles, shape (B, M, 51), the ego's first; None unless the measure needs them."""
    before: State | None = None
    """The state one tick earlier; None at the start."""
    dt: float = 0.1
    """Tick [s]."""

    @classmethod
    def of_two(cls, gap: float, speed: float, lead_speed: float) -> Moment:
        """Return one scenario of an ego and its lead in the middle of one straight lane: for examples and tests.

        Args:
            gap: Bumper to bumper [m].
            speed: Of the ego [m/s].
            lead_speed: Of the lead [m/s].
        """
        x = torch.tensor([[0.0, gap + VEHICLE_LENGTH]])
        zero, road = torch.zeros_like(x), straight(1)
        state = State(x, zero, zero, torch.tensor([[speed, lead_speed]]), theta=x[:, :0])
        return cls(state, lead_of(state, road), road, None)

    @property
    def acceleration(self) -> Tensor:
        """Mean acceleration of every vehicle over the last tick [m/s^2], shape (B, N); 0 at the start."""
        if self.before is None:
            return torch.zeros_like(self.state.speed)
        return (self.state.speed - self.before.speed) / self.dt


def gap_of(moment: Moment) -> Tensor:
    """Return the gap to the lead [m], positive and finite, shape (B,)."""
    return moment.lead.gap.clamp(GAP_MIN, GAP_MAX)


def acceleration_of_lead(moment: Moment) -> Tensor:
    """Return the lead's acceleration along the ego's heading over the last tick [m/s^2], 0 without a lead, (B,)."""
    lead, heading = lead_index(moment.state, moment.road), moment.state.heading
    along = moment.acceleration * torch.cos(heading - heading[:, :1])
    of_lead = along.gather(1, lead[:, None])[:, 0]
    return torch.where(lead > 0, of_lead, 0.0)
