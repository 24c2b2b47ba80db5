"""What measures ask of the ego's lead."""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.traffic.lead import Lead, lead_index
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

GAP_MIN = 0.01
"""Gaps are floored here [m] so that only a collision, never a narrow escape, comes to 0 or less."""
GAP_MAX = 1e6
"""And cut here [m], where there is no lead."""
STILL = 1e-4
"""Speeds in a denominator are floored here [m/s], far below gap / TTC_MAX, so no value under the cap changes."""


class Moment(NamedTuple):
    """B scenarios at one moment."""

    state: State
    lead: Lead
    """The ego's."""
    road: Road
    perception: Tensor | None
    """What vehicles see, shape (B, M, 51), the ego first; None unless the measure needs it."""
    before: State | None = None
    """The state one tick earlier; None at the start."""
    dt: float = 0.1
    """Tick [s]."""

    @property
    def acceleration(self) -> Tensor:
        """Mean acceleration of every vehicle over the last tick [m/s^2], shape (B, N); 0 at the start."""
        if self.before is None:
            return torch.zeros_like(self.state.speed)
        return (self.state.speed - self.before.speed) / self.dt


def gap_of(moment: Moment) -> Tensor:
    """Gap to the lead [m], positive and finite, shape (B,)."""
    return moment.lead.gap.clamp(GAP_MIN, GAP_MAX)


def acceleration_of_lead(moment: Moment) -> Tensor:
    """Acceleration of the lead along the ego's heading over the last tick [m/s^2], 0 without a lead, shape (B,)."""
    lead, heading = lead_index(moment.state, moment.road), moment.state.heading
    along = moment.acceleration * torch.cos(heading - heading[:, :1])
    found = along.gather(1, lead[:, None])[:, 0]
    return torch.where(lead > 0, found, 0.0)
