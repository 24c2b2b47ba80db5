"""What measures ask of the ego's lead."""

import torch
from torch import Tensor

from rare_envs.geometry import lead_index
from rare_envs.measures.moment import Moment

GAP_MIN = 0.01
"""Gaps are floored here [m] so that only a collision, never a narrow escape, comes to 0 or less."""
GAP_MAX = 1e6
"""And cut here [m], where there is no lead."""
STILL = 1e-4
"""Speeds in a denominator are floored here [m/s], far below gap / TTC_MAX, so no value under the cap changes."""


def gap_of(moment: Moment) -> Tensor:
    """Gap to the lead [m], positive and finite, shape (B,)."""
    return moment.lead.gap.clamp(GAP_MIN, GAP_MAX)


def acceleration_of_lead(moment: Moment) -> Tensor:
    """Acceleration of the lead along the ego's heading over the last tick [m/s^2], 0 without a lead, shape (B,)."""
    lead, heading = lead_index(moment.state, moment.road), moment.state.heading
    along = moment.acceleration * torch.cos(heading - heading[:, :1])
    found = along.gather(1, lead[:, None])[:, 0]
    return torch.where(lead > 0, found, 0.0)
